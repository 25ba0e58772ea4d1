"""Tables 1 and 2 on Gaussians fitted as `jsecon fit` fits them, in place of the tables' own short fit.

    python -m experiments.default_fit [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

All rows of `experiments.lerf` and `experiments.ovs3d`, every scene, the first seed, medium noise: with as many
Gaussians as the start has, and with twice as many. What those tables' own cells say stands beside. --root is of a
folder that holds both datasets' scenes.
"""

import contextlib
import dataclasses
from pathlib import Path
from typing import get_args

import numpy as np

from experiments import lerf, ovs3d, results
from experiments.tables.fill import Plan, fill, options_of, totals
from experiments.tables.methods import METHODS
from experiments.tables.setting import Fitted
from jsecon.pipeline.options import Options

FIGURES = ("miou", "miou_vala")
FITS: tuple[Fitted, ...] = get_args(Fitted)


def plan_of(table: Plan, asked: Plan, fitted: Fitted) -> Plan:
    """`table` with its first seed alone, on Gaussians that are `fitted` so; the short fit's cells are the table's."""
    data = dataclasses.replace(table.data, root=asked.data.root, seeds=table.data.seeds[:1])
    plan = dataclasses.replace(table, data=data, sweep=(), processes=asked.processes, fitted=fitted)
    if fitted == "short":
        return plan
    steps = Options.steps if table.fit_steps == lerf.PLAN.fit_steps else table.fit_steps
    return dataclasses.replace(plan, fit_steps=steps, out=asked.out, cells=str(Path(asked.out) / "cells.jsonl"))


def table_of(name: str, cells: dict[Fitted, list[dict]]) -> str:
    """A Markdown table: methods in rows, for each figure and fit the mean of the scenes; the best in bold."""
    columns = [(figure, fitted) for figure in FIGURES for fitted in cells]
    rows = {method: [] for method in METHODS}
    for figure, fitted in columns:
        own = {m: float(np.mean([c[figure] for c in cells[fitted] if c["method"] == m])) for m in METHODS}
        for method, value in own.items():
            rows[method].append(f"**{value:.3f}**" if value == max(own.values()) else f"{value:.3f}")
    header = (name, *(f"{figure}, {fitted}" for figure, fitted in columns))
    return results.table(header, [(method, *row) for method, row in rows.items()])


def main(asked: Plan, tables: tuple[Plan, ...]) -> str:
    """The tables, written to `asked.out`."""
    parts, kept = [], {}
    for table in tables:
        cells: dict[Fitted, list[dict]] = {}
        for fitted in FITS:
            with contextlib.suppress(SystemExit):  # with which a helper ends a plan
                cells[fitted] = fill(plan_of(table, asked, fitted), METHODS, tell=lambda line: print(line, flush=True))
        if len(cells) == len(FITS):
            parts.append(table_of(table.data.dataset, cells))
            kept[table.data.dataset] = totals([cell for fitted in FITS[1:] for cell in cells[fitted]])
    text = "\n\n".join(parts)
    if parts:
        results.save(Path(asked.out), asked, kept, text)
        print(text)
    return text


if __name__ == "__main__":
    places = {"out": str(results.HOME / "results" / "default_fit")}
    chosen = options_of(dataclasses.replace(lerf.PLAN, **places), dataclasses.replace(lerf.QUICK, **places))
    quick = chosen.fit_steps == lerf.QUICK.fit_steps
    main(chosen, (lerf.QUICK, ovs3d.QUICK) if quick else (lerf.PLAN, ovs3d.PLAN))
