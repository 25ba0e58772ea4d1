"""Numbers that others published on the real datasets, per cent. They stand beside ours and do not compare with them.

`published.json` holds them by table and by row, which names the paper, or the table of another paper, that it is from.
The cells of a row are scenes and then their mean, (mIoU, mAcc) or (mIoU, mAcc, Loc. Acc.); None = not published.
Point level: alpha > 0.7, VALA's > 10/255. The paper does not name its ten classes of Replica.
"""

import json
from pathlib import Path

from experiments.datasets.lerf_ovs import LERF_PAIRS

LERF_SCENES = tuple(LERF_PAIRS)
OVS3D_SCENES = "bed", "bench", "lawn", "room", "sofa"
Number = float | None
Cell = tuple[Number, ...]
Rows = dict[str, tuple[Cell, ...]]


def _read(name: str) -> Rows:
    """Rows of one table."""
    tables = json.loads(Path(__file__).with_name("published.json").read_text())
    return {row: tuple(map(tuple, cells)) for row, cells in tables[name].items()}


LERF = _read("LERF")
LERF_REMARKS = (
    "Loc. Acc. of seconGS in its first version: 30.36 / 9.86 / 11.86 / 13.64, mean 16.43; its tables of components "
    "still have the 30.36. LangSplat under its own 2D protocol: mIoU 51.4."
)
OVS3D = _read("OVS3D")
OVS3D_REMARKS = "Loc. Acc. of LangSplat-m on bed in seconGS: 3.00, which is no multiple of 1/30."
REPLICA = _read("REPLICA")
COMPONENTS = _read("COMPONENTS")
"""seconGS, figurines, its ablation of components."""
QUERIES = _read("QUERIES")
"""seconGS, figurines, its ablation of queries."""


def table(title: str, rows: Rows, columns: tuple[str, ...], remarks: str = "") -> str:
    """Writes published numbers as a Markdown table under a line that says what they are."""

    def show(value):
        return "-" if value is None else f"{value:.2f}"

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
