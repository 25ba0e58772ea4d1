"""The threshold figure: mIoU over the threshold, for each way of asking one field.

    python -m experiments.threshold_sweep [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`; outliers are left in, so that only the threshold
acts. The spread of a way is its largest less its smallest mean: what the choice of a threshold can cost.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments import lerf, results
from experiments.tables import layout
from experiments.tables.fill import Plan, fill, options_of
from experiments.tables.ours import ask_field, field_of

WAYS = ("one_step", "canonical", "code", "votes", "probability", "lead")


@dataclasses.dataclass(frozen=True)
class Sweep(Plan):
    """A plan whose cells are ways and thresholds."""

    thresholds: tuple[float, ...] = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


def _sweep(plan: Plan, name: str, **changes) -> Sweep:
    given = {field.name: getattr(plan, field.name) for field in dataclasses.fields(plan)}
    place = HOME / "quick" if plan.sweep == () else HOME
    return Sweep(**(given | {"methods": WAYS, "sweep": (), "out": str(place / name)} | changes))


HOME = results.HOME / "results"
PLAN = _sweep(lerf.PLAN, "threshold_sweep")
QUICK = _sweep(lerf.QUICK, "threshold_sweep", thresholds=(0.4, 0.9))


def main(plan: Sweep) -> str:
    """Sweeps, writes the table and the figure, returns the table."""

    def at(way: str, threshold: float):
        return lambda setting, steps: ask_field(setting, _field(setting), way, clean=False, threshold=threshold)

    fields: dict[int, object] = {}

    def _field(setting):
        if id(setting) not in fields:
            fields.clear()
            fields[id(setting)] = field_of(setting)
        return fields[id(setting)]

    methods = {f"{way} {threshold:g}": at(way, threshold) for way in WAYS for threshold in plan.thresholds}
    cells = fill(dataclasses.replace(plan, methods=tuple(methods)), methods, tell=print)
    found = layout.means(cells, plan.level)
    curves = {way: [found[f"{way} {threshold:g}"] for threshold in plan.thresholds] for way in WAYS}
    rows = [(way, *curve, float(np.ptp(curve))) for way, curve in curves.items()]
    header = ("asked by", *(f"{threshold:g}" for threshold in plan.thresholds), "spread")
    source = "twins in LERF-OVS's layout" if any(cell["twin"] for cell in cells) else "LERF-OVS"
    text = f"mIoU over the threshold, {source}; {lerf.NOTES}\n\n" + results.table(header, rows)
    results.save(Path(plan.out), plan, {"curves": curves, "cells": cells}, text, _figure(plan.thresholds, curves))
    print(text)
    return text


def _figure(thresholds: tuple[float, ...], curves: dict[str, list[float]]):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.4))
    axes = figure.add_subplot()
    for way, curve in curves.items():
        axes.plot(thresholds, curve, marker="o", markersize=3, label=way)
    axes.set_xlabel("threshold")
    axes.set_ylabel("mIoU")
    axes.set_ylim(0, 1)
    axes.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
