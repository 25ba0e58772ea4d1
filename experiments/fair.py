"""Tables 1 to 3 by the same rules for all: every method asked in every way, chosen on some seeds, reported on others.

    python -m experiments.fair [--tables lerf ovs3d replica] [--levels medium high] [--quick] [--processes N] ...

Each method is read by every text rule and way of choosing Gaussians (`experiments.tables.rows`), and none may refuse a
text. A method's reading is the one that is best on the seeds `--choosing` at the level of noise, for each figure its
own; one row of ours, "one reading", takes the same for both. Those readings alone, and the published one, are then
measured on the seeds that `--seeds` names, on which nothing was chosen, with a paired bootstrap over (scene, seed,
text) of ours against each. Methods that train take minutes a setting: they may be given fewer seeds, and ours is
compared with each on its own ("ours there").
"""

import contextlib
import dataclasses
import re
from pathlib import Path
from typing import Literal

import numpy as np

from experiments import lerf, ovs3d, replica, results
from experiments.tables.fill import Plan, fill
from experiments.tables.rows import TRAINED, rows_of
from jsecon.process import cores

TABLES = {"lerf": (lerf.PLAN, lerf.QUICK), "ovs3d": (ovs3d.PLAN, ovs3d.QUICK), "replica": (replica.PLAN, replica.QUICK)}
RESAMPLED = 2000
BESIDE = "macc", "loc_box"
"""of the reading that is best by the first figure; loc_box is the paper's Loc. Acc., where silhouettes are judged"""
_QUICK_RULES = ("centred", "contrast")
QUICK_READ = (
    "as published",
    *(f"{rule}, {way}" for rule in _QUICK_RULES for way in ("threshold", "lenient silhouette", "threshold, centre")),
)
_QUICK_TRAINED = ("OpenGaussian",)
"""of the methods that train, those of a quick run; the quick tables have all"""
MINE, ONE_READING, PUBLISHED = "ours, consensus", ", one reading", "as published"
"""MINE is held against the others"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    tables: tuple[Literal["lerf", "ovs3d", "replica"], ...] = ()
    """Tables to measure; empty: all, or LERF in a quick run."""
    scenes: tuple[str, ...] = ()
    """Scenes of the one table; empty: all."""
    levels: tuple[str, ...] = ("medium", "high")
    seeds: tuple[int, ...] = (10, 11, 12, 13, 14)
    """Seeds that are reported."""
    choosing: tuple[int, ...] = (0, 1, 2)
    """Seeds that readings are chosen on."""
    seeds_trained: tuple[int, ...] = ()
    """`seeds` of methods that train; empty: the same."""
    choosing_trained: tuple[int, ...] = ()
    """`choosing` of methods that train; empty: the same."""
    methods: tuple[str, ...] = ()
    """Methods that are compared, ours among them; empty: all."""
    read: tuple[str, ...] = ()
    """Readings that are chosen from, without the methods' own constants; empty: all."""
    quick: bool = False
    """Run one tiny scene of one table with one seed."""
    out: str = ""
    processes: int = cores()
    """Number of processes that share the settings; 0: a helper of another."""


QUICK = {"levels": ("medium",), "seeds": (0,), "choosing": (0,)}
"""A quick run reports on the seed that it chose on; 3D-OVS has the rows of LERF."""


def by_text(cells: list[dict], figure: int) -> dict[tuple, float]:
    """IoU by (scene, seed, text), the mean of its frames; `figure` 0 is alpha > 0.7 or the points, 1 alpha > 10/255."""
    return {
        (cell["scene"], cell["seed"], text): float(np.mean(found[figure]))
        for cell in cells
        for text, found in cell["texts"].items()
    }


def ahead(ours: dict[tuple, float], other: dict[tuple, float]) -> tuple[float, float, float]:
    """Mean of ours - other over (scene, seed, text) of both, and its 95 % interval by the paired bootstrap."""
    apart = np.array([value - other[key] for key, value in sorted(ours.items()) if key in other])
    drawn = np.random.default_rng(0).integers(len(apart), size=(RESAMPLED, len(apart)))
    low, high = np.quantile(apart[drawn].mean(1), (0.025, 0.975))
    return float(apart.mean()), float(low), float(high)


def chosen(cells: list[dict], seeds: tuple[int, ...], figures: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """The best row of each method for each figure on `seeds`; and of MINE the best by the sum of all figures."""
    here = [cell for cell in cells if cell["seed"] in seeds]
    value = {}
    for row in dict.fromkeys(cell["method"] for cell in here):
        value[row] = [float(np.mean([c[f] for c in here if c["method"] == row])) for f in figures]
    best: dict[str, dict[str, str]] = {}
    for method in dict.fromkeys(row.split(": ")[0] for row in value):
        own = [row for row in value if row.split(": ")[0] == method]
        best[method] = {f: max(own, key=lambda row, n=n: value[row][n]) for n, f in enumerate(figures)}
        if method == MINE and len(figures) > 1:
            best[method + ONE_READING] = dict.fromkeys(figures, max(own, key=lambda row: sum(value[row])))
    return best


def report(name: str, level: str, cells: list[dict], options: Options) -> tuple[str, dict]:
    """A Markdown table of one table and level, and its figures."""
    figures = figures_of(name)
    here = [cell for cell in cells if cell["level"] == level]
    best = chosen(here, options.choosing, figures)
    held = [cell for cell in cells if cell["seed"] in options.seeds]

    def of(row):
        return [cell for cell in held if cell["method"] == row]

    rows, told = [], {}
    for method, by_figure in best.items():
        row, settings = [method], 0
        for n, figure in enumerate(figures):
            own = of(by_figure[figure])
            seeds = sorted({cell["seed"] for cell in own})
            scenes = sorted({cell["scene"] for cell in own})
            mine = [cell for cell in of(best[MINE][figure]) if cell["seed"] in seeds and cell["scene"] in scenes]
            difference = ahead(by_text(mine, n), by_text(own, n))
            values, ours = by_scene(own, figure), by_scene(mine, figure)
            wins = [scene for scene, value in values.items() if value > ours[scene]]
            published = by_scene(of(f"{method}: {PUBLISHED}"), figure)
            settings = len(scenes) * len(seeds)
            told[f"{method}, {figure}"] = {
                "row": by_figure[figure],
                "mean": float(np.mean(list(values.values()))),
                "published": float(np.mean(list(published.values()))) if published else None,
                "ahead": difference,
                "seeds": seeds,
                "scenes": scenes,
                "ours there": float(np.mean(list(ours.values()))),
                "wins": wins,
            }
            here = told[f"{method}, {figure}"]
            row += [f"{here['published']:.3f}" if published else "", f"{here['mean']:.3f}"]
            if n == 0:
                beside = {name: float(np.mean([c[name] for c in own])) for name in BESIDE if name in own[0]}
                here |= beside
                row += [f"{value:.3f}" for value in beside.values()]
            row += [by_figure[figure].split(": ", 1)[1], f"{here['ours there']:.3f}"]
            row.append(f"{difference[0]:+.3f} [{difference[1]:+.3f}, {difference[2]:+.3f}]")
            row.append("" if method.startswith("ours") else ", ".join(wins))
        rows.append((*row, str(settings)))
    columns: list[str] = []
    for figure in figures:
        columns += [f"{figure} as published", figure]
        columns += [name for name in BESIDE if name in held[0]] if figure == figures[0] else []
        columns += ["read by", "ours there", f"{MINE} ahead by [95 %]", "behind in"]
    return results.table((f"{name}, {level}", *columns, "settings"), rows), told


def by_scene(cells: list[dict], figure: str) -> dict[str, float]:
    """A figure of each scene, the mean of its seeds."""
    scenes = sorted({cell["scene"] for cell in cells})
    return {scene: float(np.mean([cell[figure] for cell in cells if cell["scene"] == scene])) for scene in scenes}


def reading_of(row: str) -> str:
    """A row's reading without the constants that a method has a row for each of ("16 roots", "no quantile", 0.98)."""
    way = row.split(": ", 1)[1]
    return re.sub(r"^(\d+ roots|no quantile|ScanNet's \w+), | 0\.\d+$|, one mask$", "", way)


def figures_of(table: str) -> tuple[str, ...]:
    """What of a table's cells is compared: at the points there is one figure."""
    return ("miou",) if table == "replica" else ("miou", "miou_vala")


def plan_of(name: str, level: str, options: Options, seeds: tuple[int, ...], rows: list[str]) -> Plan:
    """Some rows of a table, which all train or none, at a level of noise, on some seeds."""
    table = TABLES[name][1 if options.quick else 0]
    data = dataclasses.replace(table.data, seeds=seeds, scenes=options.scenes or table.data.scenes)
    place = {"out": options.out, "cells": str(Path(options.out) / "cells.jsonl")}
    return dataclasses.replace(
        table, data=data, methods=tuple(rows), level=level, sweep=(), processes=options.processes, **place
    )


def cells_of(name: str, level: str, options: Options) -> list[dict]:
    """All rows on the seeds to choose on, and of the seeds to report the rows that were best there."""
    methods = rows_of(name == "replica")
    rows = [row for row in methods if not options.methods or row.split(": ")[0] in options.methods]
    if options.quick:
        left_out = set(TRAINED) - set(_QUICK_TRAINED)
        rows = [row for row in rows if row.split(": ")[1] in QUICK_READ and row.split(": ")[0] not in left_out]
    rows = [row for row in rows if not options.read or reading_of(row) in (*options.read, PUBLISHED)]

    def filled(rows: list[str], seeds: tuple[int, ...]) -> list[dict]:
        plan = plan_of(name, level, options, seeds, rows)

        def tell(line):
            return print(line, flush=True)

        with contextlib.suppress(SystemExit):  # of a helper: what others are at is waited for below
            fill(plan, methods, tell=tell)
        return fill(dataclasses.replace(plan, processes=1), methods, tell=tell)

    cells: list[dict] = []
    for trains in (False, True):
        own = [row for row in rows if (row.split(": ")[0] in TRAINED) == trains]
        if not own:
            continue
        choosing = filled(own, options.choosing_trained or options.choosing if trains else options.choosing)
        readings = chosen(choosing, tuple(cell["seed"] for cell in choosing), figures_of(name))
        best = {row for ways in readings.values() for row in ways.values()}
        kept = [row for row in own if row in best or row.endswith(f": {PUBLISHED}")]
        cells += choosing + filled(kept, options.seeds_trained or options.seeds if trains else options.seeds)
    return cells


def main(options: Options) -> str:
    """The tables, written."""
    parts, kept = [], {}
    for name in options.tables or (("lerf",) if options.quick else TABLES):
        for level in options.levels:
            cells = cells_of(name, level, options)
            if options.processes:  # not a helper
                text, kept[f"{name} {level}"] = report(name, level, cells, options)
                parts.append(text)
                print(text, flush=True)
    text = "\n\n".join(parts)
    if options.processes:
        results.save(Path(options.out), options, kept, text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "fair", __doc__, QUICK))
