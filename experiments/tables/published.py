"""Numbers that others published on the real datasets, per cent: to stand beside ours, never to be ranked against them.

Each row names the paper, or the table of another paper, that it is from. A scene's entry is (mIoU, mAcc); None = not
known to us.
"""

from experiments.datasets.lerf_ovs import LERF_PAIRS

LERF_SCENES = tuple(LERF_PAIRS)
Number = float | None

LERF: dict[str, tuple[tuple[Number, Number], ...]] = {
    "LangSplat at the points (VALA's table 1)": (
        (7.27, 10.71),
        (10.05, 9.86),
        (14.38, 20.34),
        (9.71, 9.09),
        (10.35, 13.64),
    ),
    "LangSplat at the points (OpenGaussian's issue 14)": (
        (None, None),
        (None, None),
        (None, None),
        (None, None),
        (9.66, None),
    ),
    "LangSplat-m (seconGS)": ((None, None), (None, None), (None, None), (None, None), (14.25, None)),
    "OpenGaussian": ((39.29, 55.36), (31.01, 42.25), (60.44, 76.27), (22.70, 31.82), (38.36, 51.43)),
    "Occam's LGS (VALA's table 1)": ((52.90, 78.57), (32.01, 54.92), (61.02, 93.22), (42.95, 72.72), (47.22, 74.84)),
    "LUDVIG (ExtrinSplat's table 2)": ((58.0, None), (42.3, None), (58.6, None), (42.8, None), (50.4, None)),
    "VALA": ((60.38, 89.29), (45.41, 67.61), (70.61, 88.14), (55.71, 86.36), (58.02, 82.85)),
    "seconGS (the paper)": ((58.91, 82.14), (None, 61.97), (43.57, 54.24), (None, 50.00), (42.50, 62.09)),
    "seconGS, first version": ((58.98, None), (None, None), (None, None), (None, None), (None, None)),
}
"""scene by scene in the order of `LERF_SCENES`, then the mean: point level, alpha > 0.7 (VALA: > 10/255)"""
LERF_REMARKS = (
    "Loc. Acc. of seconGS: 82.14 / 61.97 / 62.71 / 40.91, mean 61.93, in the paper; 30.36 / 9.86 / 11.86 / 13.64, mean "
    "16.43, in its first version: two definitions, neither stated. LangSplat under its own 2D protocol: mIoU 51.4."
)

OVS3D: dict[str, tuple[tuple[Number, Number], ...]] = {
    "OpenGaussian (Segment-then-Splat's table)": ((31.00, None),),
    "seconGS (the paper)": ((70.58, None),),
}
"""means over bed, bench, lawn, room, sofa"""
OVS3D_REMARKS = "Loc. Acc. of LangSplat-m on bed in seconGS: 3.00, which is no multiple of 1/30."

REPLICA: dict[str, tuple[tuple[Number, Number], ...]] = {
    "OpenGaussian": (
        *((None, None),) * 4,
        (23.13, None),
        (43.72, None),
        (42.36, None),
        (None, None),
        (37.71, None),
    ),
    "seconGS (the paper)": (
        *((None, None),) * 4,
        (20.15, None),
        (15.06, None),
        (37.29, None),
        (None, None),
        (39.45, None),
    ),
}
"""scene by scene in the order of `experiments.datasets.replica.REPLICA_SCENES`, then the mean; ten classes that the
paper does not name. OpenGaussian's mean is the paper's less the gain of 1.74 that it states."""


def table(
    title: str, rows: dict[str, tuple[tuple[Number, Number], ...]], columns: tuple[str, ...], remarks: str = ""
) -> str:
    """A Markdown table of published numbers, under a line that says what they are."""
    show = lambda value: "-" if value is None else f"{value:.2f}"
    lines = [
        f"**{title}: published, measured on the real data (per cent, mIoU / mAcc).** No twin's number compares.",
        "",
        "| method | " + " | ".join(columns) + " |",
        "|" + "---|" * (len(columns) + 1),
    ]
    for name, cells in rows.items():
        lines.append(f"| {name} | " + " | ".join(f"{show(a)} / {show(b)}" for a, b in cells) + " |")
    return "\n".join([*lines, "", remarks] if remarks else lines)
