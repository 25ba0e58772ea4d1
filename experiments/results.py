"""Writes the results of an experiment: results/<name>/{config.json, metrics.json, table.md, figure.webp}."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import tyro

from jsecon.files import atomic_write, write_text

HOME = Path(__file__).resolve().parent
CAPTURES = HOME.parent.parent / "shared" / "captures"
"""Real captures, beside the checkout."""
FIGURE_QUALITY = 90
"""Quality of figures as WebP, 0 to 100: a tenth of the bytes of a PNG where a figure shows frames."""


def read_options(kind: type, name: str, description: str | None, quick: dict[str, Any] | None = None) -> Any:
    """Reads the options of an experiment from the command line.

    Args:
      kind: Dataclass of the options. The docstrings of its fields are their help texts.
      name: Name of the experiment. Its results go to results/NAME, those of a quick run to results/quick/NAME, unless
        `--out` says otherwise.
      description: Description of the experiment.
      quick: Values of a quick run, if there is one.

    Returns:
      The options.
    """
    options = tyro.cli(kind, description=description, config=(tyro.conf.FlagCreatePairsOff,))
    folder = HOME / "results" / name
    if quick and options.quick:
        options = dataclasses.replace(options, **quick)
        folder = HOME / "results" / "quick" / name
    return dataclasses.replace(options, out=options.out or str(folder))


def save(folder: Path, options: Any, metrics: dict, table: str, figure: Any = None) -> None:
    """Writes options, metrics, table and figure.

    Args:
      folder: Folder of the results.
      options: Dataclass of options. Its paths are written by `portable`.
      metrics: Figures for metrics.json.
      table: Table in Markdown.
      figure: Optional matplotlib figure.
    """
    config = {name: portable(value) for name, value in dataclasses.asdict(options).items()}
    write_text(folder / "config.json", json.dumps(config, indent=2) + "\n")
    write_text(folder / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    write_text(folder / "table.md", table + "\n")
    if figure is not None:
        with atomic_write(folder / "figure.webp") as temporary:
            figure.savefig(temporary, dpi=110, bbox_inches="tight", pil_kwargs={"quality": FIGURE_QUALITY})


def portable(value: Any) -> Any:
    """Converts a value to one for JSON that does not depend on the machine.

    Absolute paths become relative to the checkout if they lie in it or in `shared` beside it, or to the home (~). Of
    other paths the last part remains.
    """
    if isinstance(value, dict):
        return {key: portable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [portable(item) for item in value]
    if not isinstance(value, str | Path) or not Path(value).is_absolute():
        return str(value) if isinstance(value, Path) else value
    path = Path(os.path.normpath(value))
    if any(path.is_relative_to(place) for place in (HOME.parent, CAPTURES.parent)):
        return os.path.relpath(path, HOME.parent)
    return f"~/{path.relative_to(Path.home())}" if path.is_relative_to(Path.home()) else f".../{path.name}"


def table(header: tuple[str, ...], rows: list[tuple]) -> str:
    """Formats a Markdown table; floats have three decimals."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for row in rows:
        lines.append("| " + " | ".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in row) + " |")
    return "\n".join(lines)


def bars(labels: list[str], series: dict[str, list[float]], ylabel: str):
    """Draws grouped bars, one group per label and one colour per series."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.6 * len(labels) + 2, 3.2))
    axes = figure.add_subplot()
    width = 0.8 / len(series)
    for n, (name, values) in enumerate(series.items()):
        axes.bar([i + (n - (len(series) - 1) / 2) * width for i in range(len(labels))], values, width, label=name)
    axes.set_xticks(range(len(labels)), labels)
    axes.set_ylim(0, 1)
    axes.set_ylabel(ylabel)
    axes.legend(fontsize=8, loc="lower right")
    return figure
