"""Tables 1 to 3 by the same rules for all: every method asked in every way, chosen on some seeds, reported on others.

    python -m experiments.fair [--tables lerf ovs3d replica] [--scenes NAME ...] [--levels medium high]
                               [--seeds 10 11 ...] [--choosing 0 1 ...] [--quick] [--out FOLDER] [--processes N]

Each method is read by every text rule and way of choosing Gaussians (`experiments.tables.readings`), and none may
refuse a text. A method's reading is the one that is best on the seeds `--choosing`, for each figure its own; one row of
ours, "one reading", takes the same for both. The figures are of the seeds that `--seeds` names, on which nothing was
chosen, with a paired bootstrap over (scene, seed, text) of ours against each.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from experiments import lerf, ovs3d, replica, results
from experiments.tables.fill import Plan, fill
from experiments.tables.readings import rows_of
from jsecon.process import cores

CHOOSING, REPORTED = (0, 1, 2), (10, 11, 12, 13, 14)
TABLES = {"lerf": (lerf.PLAN, lerf.QUICK), "ovs3d": (ovs3d.PLAN, ovs3d.QUICK), "replica": (replica.PLAN, replica.QUICK)}
RESAMPLED = 2000
MINE, ONE_READING = "ours, consensus", "ours, consensus, one reading"


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    tables: tuple[str, ...]
    scenes: tuple[str, ...]
    """empty: all of a table."""
    levels: tuple[str, ...]
    seeds: tuple[int, ...]
    choosing: tuple[int, ...]
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
    """Mean of ours - other over (scene, seed, text), and its 95 % interval by the paired bootstrap."""
    apart = np.array([value - other[key] for key, value in sorted(ours.items())])
    drawn = np.random.default_rng(0).integers(len(apart), size=(RESAMPLED, len(apart)))
    low, high = np.quantile(apart[drawn].mean(1), (0.025, 0.975))
    return float(apart.mean()), float(low), float(high)


def chosen(cells: list[dict], seeds: tuple[int, ...], figures: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """The best row of each method for each figure on `seeds`; and ONE_READING's, the best by the sum of all figures."""
    here = [cell for cell in cells if cell["seed"] in seeds]
    value = {}
    for row in dict.fromkeys(cell["method"] for cell in here):
        value[row] = [float(np.mean([c[f] for c in here if c["method"] == row])) for f in figures]
    best: dict[str, dict[str, str]] = {}
    for method in dict.fromkeys(row.split(": ")[0] for row in value):
        own = [row for row in value if row.split(": ")[0] == method]
        best[method] = {f: max(own, key=lambda row, n=n: value[row][n]) for n, f in enumerate(figures)}
        if method == MINE and len(figures) > 1:
            best[ONE_READING] = dict.fromkeys(figures, max(own, key=lambda row: sum(value[row])))
    return best


def report(name: str, level: str, cells: list[dict], asked: Asked) -> tuple[str, dict]:
    """A Markdown table of one table and level, and its figures."""
    figures = ("miou",) if name == "replica" else ("miou", "miou_vala")
    best = chosen(cells, asked.choosing, figures)
    held = [cell for cell in cells if cell["seed"] in asked.seeds]
    of = lambda row: [cell for cell in held if cell["method"] == row]
    rows, told = [], {}
    mine = best[MINE]
    for method, by_figure in best.items():
        row = [method]
        for n, figure in enumerate(figures):
            own = of(by_figure[figure])
            scenes = sorted({cell["scene"] for cell in own})
            mean = float(np.mean([np.mean([c[figure] for c in own if c["scene"] == s]) for s in scenes]))
            difference = ahead(by_text(of(mine[figure]), n), by_text(own, n))
            wins = [
                s
                for s in scenes
                if np.mean([c[figure] for c in own if c["scene"] == s])
                > np.mean([c[figure] for c in of(mine[figure]) if c["scene"] == s])
            ]
            told[f"{method}, {figure}"] = {"row": by_figure[figure], "mean": mean, "ahead": difference, "wins": wins}
            way = by_figure[figure].split(": ", 1)[1]
            row += [f"{mean:.3f}", way, f"{difference[0]:+.3f} [{difference[1]:+.3f}, {difference[2]:+.3f}]"]
            row.append("" if method.startswith("ours") else ", ".join(wins))
        rows.append(tuple(row))
    columns = [c for f in figures for c in (f, "read by", "ours, consensus ahead by [95 %]", "ahead of it in")]
    return results.table((f"{name}, {level}", *columns), rows), told


def plan_of(name: str, level: str, asked: Asked, processes: int) -> Plan:
    """All rows of a table at a level of noise, on the seeds to choose on and those to report."""
    table = TABLES[name][1 if asked.quick else 0]
    seeds = tuple(dict.fromkeys((*asked.choosing, *asked.seeds)))
    data = dataclasses.replace(table.data, seeds=seeds, scenes=asked.scenes or table.data.scenes)
    place = {"out": asked.out, "cells": str(Path(asked.out) / "cells.jsonl")}
    return dataclasses.replace(
        table,
        data=data,
        methods=tuple(rows_of(name == "replica")),
        level=level,
        sweep=(),
        processes=processes,
        **place,
    )


def main(asked: Asked, processes: int) -> str:
    """The tables, written."""
    parts, kept, helper = [], {}, False
    for name in asked.tables:
        methods = rows_of(name == "replica")
        for level in asked.levels:
            try:
                cells = fill(plan_of(name, level, asked, processes), methods, tell=lambda line: print(line, flush=True))
            except SystemExit:  # of a helper, which has no table to write
                helper = True
                continue
            text, told = report(name, level, cells, asked)
            parts.append(text)
            kept[f"{name} {level}"] = told
            print(text, flush=True)
    text = "\n\n".join(parts)
    if not helper:
        results.save(Path(asked.out), asked, kept, text)
    return text


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=TABLES)
    parser.add_argument("--scenes", nargs="+", default=[], help="of the one table asked for; default: all")
    parser.add_argument("--levels", nargs="+", default=["medium", "high"])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(REPORTED), help="that are reported")
    parser.add_argument("--choosing", nargs="+", type=int, default=list(CHOOSING), help="that readings are chosen on")
    parser.add_argument("--quick", action="store_true", help="one tiny scene of each, one seed: two minutes")
    parser.add_argument("--out", default="")
    parser.add_argument("--processes", type=int, default=cores(), help="that share the settings; default: one per core")
    given = parser.parse_args()
    seeds, choosing = ((1,), (0,)) if given.quick else (tuple(given.seeds), tuple(given.choosing))
    levels = ("medium",) if given.quick else tuple(given.levels)
    place = given.out or str(results.HOME / "results" / ("quick/fair" if given.quick else "fair"))
    main(Asked(tuple(given.tables), tuple(given.scenes), levels, seeds, choosing, given.quick, place), given.processes)
