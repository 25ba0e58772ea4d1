"""Tables 1 to 3 by the same rules for all: every method asked in every way, chosen on some seeds, reported on others.

    python -m experiments.fair [--tables lerf ovs3d replica] [--scenes NAME ...] [--levels medium high]
                               [--seeds 10 11 ...] [--choosing 0 ...] [--seeds-trained ...] [--choosing-trained ...]
                               [--scenes-trained NAME ...] [--methods NAME ...] [--read READING ...]
                               [--read-as FILE] [--quick] [--out FOLDER] [--processes N]

Each method is read by every text rule and way of choosing Gaussians (`experiments.tables.rows`), and none may refuse a
text. A method's reading is the one that is best on the seeds `--choosing` at the level of noise, for each figure its
own; one row of ours, "one reading", takes the same for both. Those readings alone, and the published one, are then
measured on the seeds that `--seeds` names, on which nothing was chosen, with a paired bootstrap over (scene, seed,
text) of ours against each. Methods that train take minutes a setting: they may be given fewer seeds and scenes, and
ours is compared with each on its own ("ours there"). `--read-as` takes the readings of another run's metrics.json, and
chooses none.
"""

import argparse
import contextlib
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments import lerf, ovs3d, replica, results
from experiments.tables.fill import Plan, fill
from experiments.tables.rows import TRAINED, WITH_PARTS, rows_of
from jsecon.process import cores

CHOOSING, REPORTED = (0, 1, 2), (10, 11, 12, 13, 14)
TABLES = {"lerf": (lerf.PLAN, lerf.QUICK), "ovs3d": (ovs3d.PLAN, ovs3d.QUICK), "replica": (replica.PLAN, replica.QUICK)}
RESAMPLED = 2000
BESIDE = "macc", "loc_box"
"""of the reading that is best by the first figure; loc_box is the paper's Loc. Acc., where silhouettes are judged"""
_QUICK_RULES = ("contrast", "apart")
QUICK_READ = (
    "as published",
    *(f"{rule}, {way}" for rule in _QUICK_RULES for way in ("threshold", "lenient silhouette", "threshold, centre")),
)
_QUICK_TRAINED = ("OpenGaussian",)
"""of the methods that train, those of a quick run; the quick tables have all"""
MINE, ONE_READING, PUBLISHED = (WITH_PARTS, "ours, consensus"), ", one reading", "as published"
"""of MINE the first that a table has is held against the others"""


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    tables: tuple[str, ...]
    scenes: tuple[str, ...]
    """empty: all of a table."""
    levels: tuple[str, ...]
    seeds: tuple[int, ...]
    choosing: tuple[int, ...]
    seeds_trained: tuple[int, ...]
    """of `seeds`, those that the methods which train are reported on."""
    choosing_trained: tuple[int, ...]
    scenes_trained: tuple[str, ...]
    """the scenes of those methods; empty: the same as the others'."""
    methods: tuple[str, ...]
    """empty: all."""
    read: tuple[str, ...]
    """the readings that are chosen from, without the methods' own constants; empty: all."""
    read_as: str
    """a metrics.json whose readings are taken; empty: they are chosen."""
    quick: bool
    out: str


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
    """The best row of each method for each figure on `seeds`; and of `mine_of` the best by the sum of all figures."""
    here = [cell for cell in cells if cell["seed"] in seeds]
    value = {}
    for row in dict.fromkeys(cell["method"] for cell in here):
        value[row] = [float(np.mean([c[f] for c in here if c["method"] == row])) for f in figures]
    best: dict[str, dict[str, str]] = {}
    for method in dict.fromkeys(row.split(": ")[0] for row in value):
        own = [row for row in value if row.split(": ")[0] == method]
        best[method] = {f: max(own, key=lambda row, n=n: value[row][n]) for n, f in enumerate(figures)}
        if method == mine_of(cells) and len(figures) > 1:
            best[method + ONE_READING] = dict.fromkeys(figures, max(own, key=lambda row: sum(value[row])))
    return best


def taken(name: str, asked: Asked) -> dict[str, dict[str, str]]:
    """The readings that `--read-as` names for a table, of the methods that are compared; none where it names none."""
    if not asked.read_as:
        return {}
    every = json.loads(Path(asked.read_as).read_text())
    best: dict[str, dict[str, str]] = {}
    for key, told in next(told for level, told in every.items() if level.startswith(f"{name} ")).items():
        method, figure = key.rsplit(", ", 1)
        if not method.endswith(ONE_READING) and (not asked.methods or method in asked.methods):
            best.setdefault(method, {})[figure] = told["row"]
    return best


def mine_of(cells: list[dict]) -> str:
    """The method that is held against the others."""
    known = {cell["method"].split(": ")[0] for cell in cells}
    return next((method for method in MINE if method in known), MINE[-1])


def report(name: str, level: str, cells: list[dict], asked: Asked) -> tuple[str, dict]:
    """A Markdown table of one table and level, and its figures."""
    figures = figures_of(name)
    here = [cell for cell in cells if cell["level"] == level]
    best = taken(name, asked) or chosen(here, asked.choosing, figures)
    ours_is = mine_of(cells)
    held = [cell for cell in cells if cell["seed"] in asked.seeds]

    def of(row):
        return [cell for cell in held if cell["method"] == row]

    def mean(own, figure):
        return by_scene(own, figure, lambda values: float(np.mean(values)))

    rows, told = [], {}
    for method, by_figure in best.items():
        row, settings = [method], 0
        for n, figure in enumerate(figures):
            own = of(by_figure[figure])
            seeds = sorted({cell["seed"] for cell in own})
            scenes = sorted({cell["scene"] for cell in own})
            mine = [cell for cell in of(best[ours_is][figure]) if cell["seed"] in seeds and cell["scene"] in scenes]
            difference = ahead(by_text(mine, n), by_text(own, n))
            values, ours = mean(own, figure), mean(mine, figure)
            wins = [scene for scene, value in values.items() if value > ours[scene]]
            published = mean(of(f"{method}: {PUBLISHED}"), figure)
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
        columns += ["read by", "ours there", f"{ours_is} ahead by [95 %]", "behind in"]
    return results.table((f"{name}, {level}", *columns, "settings"), rows), told


def by_scene(cells: list[dict], figure: str, fold: Callable[[list[float]], float]) -> dict[str, float]:
    """A figure of each scene, folded over its seeds."""
    scenes = sorted({cell["scene"] for cell in cells})
    return {scene: fold([cell[figure] for cell in cells if cell["scene"] == scene]) for scene in scenes}


def reading_of(row: str) -> str:
    """A row's reading without the constants that a method has a row for each of ("16 roots", "no quantile", 0.98)."""
    way = row.split(": ", 1)[1]
    return re.sub(r"^(\d+ roots|no quantile|ScanNet's \w+), | 0\.\d+$|, one mask$", "", way)


def figures_of(table: str) -> tuple[str, ...]:
    """What of a table's cells is compared: at the points there is one figure."""
    return ("miou",) if table == "replica" else ("miou", "miou_vala")


def plan_of(name: str, level: str, asked: Asked, processes: int, seeds: tuple[int, ...], rows: list[str]) -> Plan:
    """Some rows of a table, which all train or none, at a level of noise, on some seeds."""
    table = TABLES[name][1 if asked.quick else 0]
    trained = asked.scenes_trained if rows[0].split(": ")[0] in TRAINED else ()
    data = dataclasses.replace(table.data, seeds=seeds, scenes=trained or asked.scenes or table.data.scenes)
    place = {"out": asked.out, "cells": str(Path(asked.out) / "cells.jsonl")}
    return dataclasses.replace(
        table, data=data, methods=tuple(rows), level=level, sweep=(), processes=processes, **place
    )


def cells_of(name: str, level: str, asked: Asked, processes: int) -> list[dict]:
    """All rows on the seeds to choose on, and of the seeds to report the rows that were best there."""
    methods = rows_of(name == "replica")
    rows = [row for row in methods if not asked.methods or row.split(": ")[0] in asked.methods]
    if asked.quick:
        left_out = set(TRAINED) - set(_QUICK_TRAINED)
        rows = [row for row in rows if row.split(": ")[1] in QUICK_READ and row.split(": ")[0] not in left_out]
    rows = [row for row in rows if not asked.read or reading_of(row) in (*asked.read, PUBLISHED)]

    def filled(rows: list[str], seeds: tuple[int, ...]) -> list[dict]:
        plan = plan_of(name, level, asked, processes, seeds, rows)

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
        choosing: list[dict] = []
        if asked.read_as:
            readings = taken(name, asked)
        else:
            choosing = filled(own, asked.choosing_trained if trains else asked.choosing)
            readings = chosen(choosing, tuple(cell["seed"] for cell in choosing), figures_of(name))
        best = {row for ways in readings.values() for row in ways.values()}
        kept = [row for row in own if row in best or row.endswith(f": {PUBLISHED}")]
        cells += choosing + filled(kept, asked.seeds_trained if trains else asked.seeds)
    return cells


def main(asked: Asked, processes: int) -> str:
    """The tables, written."""
    parts, kept = [], {}
    for name in asked.tables:
        for level in asked.levels:
            cells = cells_of(name, level, asked, processes)
            if processes:  # not a helper
                text, kept[f"{name} {level}"] = report(name, level, cells, asked)
                parts.append(text)
                print(text, flush=True)
    text = "\n\n".join(parts)
    if processes:
        results.save(Path(asked.out), asked, kept, text)
    return text


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--tables", nargs="+", choices=TABLES, help="default: all")
    parser.add_argument("--scenes", nargs="+", default=[], help="of the one table asked for; default: all")
    parser.add_argument("--levels", nargs="+", default=["medium", "high"])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(REPORTED), help="that are reported")
    parser.add_argument("--choosing", nargs="+", type=int, default=list(CHOOSING), help="that readings are chosen on")
    parser.add_argument("--seeds-trained", nargs="+", type=int, help="of them, for methods that train; default: all")
    parser.add_argument("--choosing-trained", nargs="+", type=int, help="of them, for methods that train; default: all")
    parser.add_argument("--scenes-trained", nargs="+", default=[], help="of the one table asked for, for those methods")
    parser.add_argument("--methods", nargs="+", default=[], help="that are compared, ours among them; default: all")
    parser.add_argument("--read", nargs="+", default=[], help="readings that are chosen from; default: all")
    parser.add_argument("--read-as", default="", help="a metrics.json of another run: take its readings, choose none")
    parser.add_argument("--quick", action="store_true", help="one tiny scene of one table, one seed: half a minute")
    parser.add_argument("--out", default="")
    parser.add_argument("--processes", type=int, default=cores(), help="that share the settings; default: one per core")
    given = parser.parse_args()
    # A quick run reports on the seed that it chose on; 3D-OVS has the rows of LERF.
    seeds, choosing = ((0,), (0,)) if given.quick else (tuple(given.seeds), tuple(given.choosing))
    levels = ("medium",) if given.quick else tuple(given.levels)
    place = given.out or str(results.HOME / "results" / ("quick/fair" if given.quick else "fair"))
    asked = Asked(
        tuple(given.tables or (("lerf",) if given.quick else TABLES)),
        tuple(given.scenes),
        levels,
        seeds,
        choosing,
        tuple(given.seeds_trained or seeds),
        tuple(given.choosing_trained or choosing),
        tuple(given.scenes_trained),
        tuple(given.methods),
        tuple(given.read),
        given.read_as,
        given.quick,
        place,
    )
    main(asked, given.processes)
