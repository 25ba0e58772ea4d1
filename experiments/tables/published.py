"""Numbers that others published on the real datasets, per cent: to stand beside ours, never to be ranked against them.

Each row names the paper, or the table of another paper, that it is from. A scene's entry is (mIoU, mAcc), or with Loc.
Acc. after it; None = not published.
"""

from experiments.datasets.lerf_ovs import LERF_PAIRS

LERF_SCENES = tuple(LERF_PAIRS)
OVS3D_SCENES = "bed", "bench", "lawn", "room", "sofa"
Number = float | None
Cell = tuple[Number, ...]

LERF: dict[str, tuple[Cell, ...]] = {
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
    "LangSplat-m (seconGS)": (
        (12.43, 21.43, 5.36),
        (6.39, 7.04, 0.00),
        (20.60, 37.29, 3.39),
        (17.58, 18.18, 4.55),
        (14.25, 20.99, 3.33),
    ),
    "Gaussian Grouping-m (seconGS)": (
        (7.75, 10.71, 10.71),
        (8.80, 9.86, 2.82),
        (10.94, 10.17, 5.08),
        (16.29, 27.27, 4.55),
        (10.95, 14.50, 5.79),
    ),
    "OpenGaussian": ((39.29, 55.36), (31.01, 42.25), (60.44, 76.27), (22.70, 31.82), (38.36, 51.43)),
    "Occam's LGS (VALA's table 1)": ((52.90, 78.57), (32.01, 54.92), (61.02, 93.22), (42.95, 72.72), (47.22, 74.84)),
    "LUDVIG (ExtrinSplat's table 2)": ((58.0, None), (42.3, None), (58.6, None), (42.8, None), (50.4, None)),
    "VALA": ((60.38, 89.29), (45.41, 67.61), (70.61, 88.14), (55.71, 86.36), (58.02, 82.85)),
    "seconGS (the paper)": (
        (58.91, 82.14, 82.14),
        (37.85, 61.97, 61.97),
        (43.57, 54.24, 62.71),
        (29.67, 50.00, 40.91),
        (42.50, 62.09, 61.93),
    ),
    "seconGS, first version": ((58.98, None), (None, None), (None, None), (None, None), (None, None)),
}
"""scene by scene in the order of `LERF_SCENES`, then the mean: point level, alpha > 0.7 (VALA: > 10/255)"""
LERF_REMARKS = (
    "Loc. Acc. of seconGS in its first version: 30.36 / 9.86 / 11.86 / 13.64, mean 16.43; its tables of components "
    "still have the 30.36. LangSplat under its own 2D protocol: mIoU 51.4."
)

OVS3D: dict[str, tuple[Cell, ...]] = {
    "OpenGaussian (Segment-then-Splat's table)": (*((None, None),) * 5, (31.00, None)),
    "LangSplat-m (seconGS)": (
        (29.83, 43.33, 3.00),
        (17.38, 28.57, 48.57),
        (33.64, 63.33, 40.00),
        (23.35, 33.33, 43.33),
        (24.64, 43.33, 43.33),
        (25.77, 42.38, 35.64),
    ),
    "Gaussian Grouping-m (seconGS)": (
        (48.51, 100.00, 96.67),
        (35.49, 71.43, 42.86),
        (65.13, 100.00, 100.00),
        (46.39, 76.67, 53.33),
        (29.86, 40.00, 43.33),
        (45.08, 77.62, 67.24),
    ),
    "OpenGaussian (seconGS)": (
        (48.50, 100.00, 23.33),
        (46.02, 57.14, 37.14),
        (64.63, 100.00, 20.00),
        (47.60, 83.33, 50.00),
        (44.06, 66.67, 56.67),
        (50.16, 81.43, 37.43),
    ),
    "seconGS (the paper)": (
        (56.81, 66.67, 83.33),
        (87.58, 100.00, 100.00),
        (87.12, 100.00, 100.00),
        (64.70, 83.33, 83.33),
        (56.70, 66.67, 100.00),
        (70.58, 83.33, 93.33),
    ),
}
"""scene by scene in the order of `OVS3D_SCENES`, then the mean"""
OVS3D_REMARKS = "Loc. Acc. of LangSplat-m on bed in seconGS: 3.00, which is no multiple of 1/30."

REPLICA: dict[str, tuple[Cell, ...]] = {
    "LangSplat-m (seconGS)": (
        (3.86, 12.82),
        (4.08, 12.24),
        (0.92, 10.05),
        (2.43, 11.09),
        (2.10, 1.36),
        (5.68, 10.70),
        (4.65, 13.99),
        (1.49, 2.37),
        (3.15, 9.33),
    ),
    "Gaussian Grouping-m (seconGS)": (
        (13.08, 36.21),
        (17.81, 31.57),
        (17.06, 24.17),
        (19.58, 38.42),
        (0.00, 0.00),
        (32.77, 74.48),
        (10.18, 26.17),
        (30.29, 45.67),
        (17.60, 34.59),
    ),
    "OpenGaussian (seconGS)": (
        (31.45, 41.74),
        (40.36, 31.72),
        (42.14, 54.01),
        (17.20, 36.54),
        (23.13, 35.11),
        (43.72, 66.38),
        (42.36, 42.64),
        (61.33, 69.62),
        (37.71, 47.22),
    ),
    "seconGS (the paper)": (
        (40.33, 60.00),
        (64.39, 84.72),
        (47.81, 63.64),
        (25.77, 50.76),
        (20.15, 35.97),
        (15.06, 29.01),
        (37.29, 45.12),
        (64.83, 82.85),
        (39.45, 56.51),
    ),
}
"""scene by scene in the order of `experiments.datasets.replica.REPLICA_SCENES`, then the mean; ten classes that the
paper does not name"""

COMPONENTS: dict[str, tuple[Cell, ...]] = {
    "no tracking, anchored": ((4.56, 7.14, 5.36),),
    "tracking, weighted mean, one-step": ((9.09, 12.50, 8.93),),
    "tracking, standard mean, anchored": ((48.84, 67.86, 23.21),),
    "tracking, weighted mean, anchored": ((58.91, 82.14, 30.36),),
}
"""seconGS, figurines, its ablation of components"""
QUERIES: dict[str, tuple[Cell, ...]] = {
    "SAM 2, DBSCAN, canonical": ((15.67, 26.79, 14.29),),
    "SAM 2, anchored, no DBSCAN": ((40.06, 66.07, 14.50),),
    "SAM 2, anchored, DBSCAN": ((58.91, 82.14, 30.36),),
}
"""seconGS, figurines, its ablation of queries"""


def table(title: str, rows: dict[str, tuple[Cell, ...]], columns: tuple[str, ...], remarks: str = "") -> str:
    """A Markdown table of published numbers, under a line that says what they are."""
    show = lambda value: "-" if value is None else f"{value:.2f}"
    lines = [
        f"**{title}: published, measured on the real data (per cent: mIoU / mAcc, or these / Loc. Acc.).** No twin's "
        "number compares.",
        "",
        "| method | " + " | ".join(columns) + " |",
        "|" + "---|" * (len(columns) + 1),
    ]
    for name, cells in rows.items():
        lines.append(f"| {name} | " + " | ".join(" / ".join(map(show, cell)) for cell in cells) + " |")
    return "\n".join([*lines, "", remarks] if remarks else lines)
