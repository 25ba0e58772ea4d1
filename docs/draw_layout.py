"""Draws the figures of how.svg and layout.svg: `python docs/draw_layout.py`.

The arrows of layout.svg are the imports between the packages of jsecon, as `ast` reads them from the files.
"""

import ast
import collections
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

HOME = Path(__file__).resolve().parent.parent
OUT = HOME / "docs" / "_static"
CAPTURE, QUESTION, PLAIN = "#c2410c", "#1d4ed8", "#94a3b8"
STYLE = {"font.family": "DejaVu Sans", "svg.fonttype": "none", "svg.hashsalt": "jsecon"}
ROUTES = {
    CAPTURE: ("a capture", ("pipeline", "read", "fit", "splat", "vision", "association", "field")),
    QUESTION: ("a question", ("app", "query", "field", "splat")),
}
"""colour -> a route and the packages that it passes"""


def packages() -> list[str]:
    """Names of jsecon's packages."""
    return sorted(path.parent.name for path in (HOME / "jsecon").glob("*/__init__.py"))


def package_imports() -> dict[str, set[str]]:
    """Package -> the other packages that its modules import."""
    names = set(packages())
    imports = collections.defaultdict(set)
    for package in names:
        for file in (HOME / "jsecon" / package).rglob("*.py"):
            for node in ast.parse(file.read_text()).body:  # imports within functions are of what is rarely needed
                modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.module:
                    modules = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
                parts = [module.split(".") for module in modules]
                imports[package] |= {part[1] for part in parts if part[0] == "jsecon" and len(part) > 1}
    return {package: (imports[package] & names) - {package} for package in names}


def floors(imports: dict[str, set[str]]) -> list[list[str]]:
    """Packages by floor: each stands above all packages that it imports."""
    level: dict[str, int] = {}

    def floor(package: str) -> int:
        if package not in level:
            level[package] = 1 + max((floor(other) for other in imports[package]), default=-1)
        return level[package]

    height = 1 + max(map(floor, imports))
    return [sorted(name for name in imports if level[name] == storey) for storey in range(height)]


def _box(axes: Axes, x: float, y: float, text: str, colour: str, *, width: float, height: float = 0.56) -> None:
    """Draws a box around its centre."""
    shape = "round,pad=0.02,rounding_size=0.1"
    patch = FancyBboxPatch(
        (x - width / 2, y - height / 2), width, height, boxstyle=shape, fc="white", ec=colour, lw=1.6
    )
    axes.add_patch(patch)
    axes.text(x, y, text, ha="center", va="center", fontsize=10, color="#0f172a", linespacing=1.35)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str, width: float = 1.6) -> None:
    """Draws an arrow."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=colour, lw=width, zorder=0))


def _figure(width: float, height: float) -> tuple[plt.Figure, Axes]:
    """Opens a figure without axes, in inches."""
    figure, axes = plt.subplots(figsize=(width, height))
    axes.axis("off")
    figure.subplots_adjust(0, 0, 1, 1)
    return figure, axes


def draw_layout() -> None:
    """Draws the packages by floor, the imports between them, and the two routes."""
    imports = package_imports()
    storeys = floors(imports)
    place = {}
    for storey, names in enumerate(storeys):
        for k, name in enumerate(names):
            place[name] = (1.75 * (k - (len(names) - 1) / 2), 1.05 * storey)
    figure, axes = _figure(8, 0.85 * len(storeys) + 0.9)
    for package, others in imports.items():
        for other in others:
            (x0, y0), (x1, y1) = place[package], place[other]
            _arrow(axes, (x0, y0 - 0.3), (x1, y1 + 0.3), "#cbd5e1", 0.8)
    for name, (x, y) in place.items():
        colours = [colour for colour, (_, route) in ROUTES.items() if name in route]
        _box(axes, x, y, name, colours[0] if colours else PLAIN, width=1.45)
        if len(colours) > 1:
            _box(axes, x, y, name, colours[1], width=1.3, height=0.44)
    top = 1.05 * len(storeys) - 0.1
    for k, (colour, (title, route)) in enumerate(ROUTES.items()):
        axes.text(-3.9, top - 0.42 * k, f"{title}: {', '.join(route)}", color=colour, fontsize=10)
    axes.set_xlim(-4, 4)
    axes.set_ylim(-0.5, top + 0.4)
    figure.savefig(OUT / "layout.svg", facecolor="white", metadata={"Date": None})


def draw_how() -> None:
    """Draws what flows through a run and through a query."""
    figure, axes = _figure(9, 2.7)
    run = ["frames,\nposes", "masks", "regions and\nembeddings", "votes", "field"]
    query = [
        "text, pixel\nor outline",
        "best region",
        "Gaussians\nthat lie in it",
        "outliers\ndropped",
        "files,\nplaces",
    ]
    for y, steps, colour in ((1.0, run, CAPTURE), (-0.35, query, QUESTION)):
        for k, step in enumerate(steps):
            _box(axes, 1.9 * k, y, step, colour, width=1.5, height=0.8)
            if k:
                _arrow(axes, (1.9 * k - 1.13, y), (1.9 * k - 0.77, y), colour)
    _arrow(axes, (7.6, 0.58), (1.95, 0.07), PLAIN)
    axes.text(-0.75, 1.62, "jsecon run", color=CAPTURE, fontsize=11)
    axes.text(-0.75, -0.98, "jsecon query", color=QUESTION, fontsize=11)
    axes.set_xlim(-0.85, 8.45)
    axes.set_ylim(-1.15, 1.9)
    figure.savefig(OUT / "how.svg", facecolor="white", metadata={"Date": None})


if __name__ == "__main__":
    plt.rcParams.update(STYLE)
    draw_layout()
    draw_how()
