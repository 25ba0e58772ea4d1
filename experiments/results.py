"""Where an experiment leaves what it found: results/<name>/{config.json, metrics.json, table.md, figure.png}."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from jsecon.files import write_text, written_whole

HOME = Path(__file__).resolve().parent
CAPTURES = HOME.parent.parent / "shared" / "captures"
"""the real captures beside the checkout"""


def save(folder: Path, options: Any, metrics: dict, table: str, figure: Any = None) -> None:
    """Writes the options (a dataclass), the metrics, a table in Markdown and a matplotlib figure into `folder`."""
    write_text(folder / "config.json", json.dumps(dataclasses.asdict(options), indent=2, default=str) + "\n")
    write_text(folder / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    write_text(folder / "table.md", table + "\n")
    if figure is not None:
        with written_whole(folder / "figure.png") as temporary:
            figure.savefig(temporary, dpi=110, bbox_inches="tight")


def table(header: tuple[str, ...], rows: list[tuple]) -> str:
    """A Markdown table; floats with three decimals."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for row in rows:
        lines.append("| " + " | ".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in row) + " |")
    return "\n".join(lines)
