"""The threshold figure: mIoU over the threshold, for each way of asking one field.

    python -m experiments.threshold_sweep [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`; outliers are left in, so that only the threshold
acts. The spread of a way is its largest less its smallest mean: what the choice of a threshold can cost. Query by query
(a text in one scene and seed): where its own best thresholds lie, and what one threshold for all loses against them.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments import lerf, results
from experiments.tables import layout
from experiments.tables.fill import Plan, fill, options_of, totals
from experiments.tables.ours import ask_field, field_of

WAYS = ("one_step", "canonical", "code", "votes", "probability")


@dataclasses.dataclass(frozen=True)
class Sweep(Plan):
    """A plan whose cells are ways and thresholds."""

    thresholds: tuple[float, ...] = ()


def _sweep(plan: Plan, *thresholds: float) -> Sweep:
    out = str(Path(plan.out).with_name("threshold_sweep"))
    return Sweep(**vars(plan) | {"methods": WAYS, "sweep": (), "out": out}, thresholds=thresholds)


PLAN = _sweep(lerf.PLAN, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
QUICK = _sweep(lerf.QUICK, 0.4, 0.9)


def main(plan: Sweep) -> str:
    """Sweeps, writes the table and the figure, returns the table."""

    def at(way: str, threshold: float):
        def ask(setting, steps):
            field = setting.shared.get("field", lambda: field_of(setting))
            return ask_field(setting, field, way, clean=False, threshold=threshold)

        return ask

    methods = {f"{way} {threshold:g}": at(way, threshold) for way in WAYS for threshold in plan.thresholds}
    cells = fill(dataclasses.replace(plan, methods=tuple(methods)), methods, tell=print)
    found = layout.means(cells, plan.level)
    curves = {way: [found[f"{way} {threshold:g}"] for threshold in plan.thresholds] for way in WAYS}
    rows = [(way, *curve, float(np.ptp(curve))) for way, curve in curves.items()]
    header = ("asked by", *(f"{threshold:g}" for threshold in plan.thresholds), "spread")
    source = "twins in LERF-OVS's layout" if any(cell["twin"] for cell in cells) else "LERF-OVS"
    text = f"mIoU over the threshold, {source}; {lerf.NOTES}\n\n" + results.table(header, rows)
    each = {way: by_query(cells, way, plan.thresholds) for way in WAYS}
    apart = {way: best_thresholds(rows, plan.thresholds) for way, rows in each.items()}
    columns = ("asked by", "queries", "best threshold: median", "10 %", "90 %", "lost by one threshold for all")
    text += "\n\nQuery by query, where single texts are kept:\n\n"
    text += results.table(columns, [(way, *told) for way, told in apart.items()])
    figure = _figure(plan.thresholds, curves, each)
    told = {"curves": curves, "best thresholds": apart, "cells": totals(cells)}
    results.save(Path(plan.out), plan, told, text, figure)
    print(text)
    return text


def by_query(cells: list[dict], way: str, thresholds: tuple[float, ...]) -> np.ndarray:
    """(Q, K) IoU, the mean of its frames, of each (scene, seed, text) at each threshold."""
    found: dict[tuple, list[float]] = {}
    for threshold in thresholds:
        for cell in (cell for cell in cells if cell["method"] == f"{way} {threshold:g}"):
            for text, (strict, _) in cell["texts"].items():
                found.setdefault((cell["scene"], cell["seed"], text), []).append(float(np.mean(strict)))
    return np.array(list(found.values()))


def best_thresholds(each: np.ndarray, thresholds: tuple[float, ...]) -> tuple[float, ...]:
    """Of curves (Q, K) over K thresholds: Q; the median, 10 % and 90 % quantiles of the best thresholds, the middle of
    those that are within 0.005 of the best; and the mean that one threshold for all loses against each one's best."""
    good = each >= each.max(1, keepdims=True) - 0.005
    own = (good * np.array(thresholds)).sum(1) / good.sum(1)
    lost = each.max(1).mean() - each.mean(0).max()
    return len(each), *(float(q) for q in np.quantile(own, (0.5, 0.1, 0.9))), float(lost)


def _figure(thresholds: tuple[float, ...], curves: dict[str, list[float]], each: dict[str, np.ndarray]):
    """Above the means of all ways; below, for each way, a line for each query and a mark at its best threshold."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 7))
    axes = figure.add_subplot(2, 1, 1)
    for way, curve in curves.items():
        axes.plot(thresholds, curve, marker="o", markersize=3, label=way)
    axes.set(xlabel="threshold", ylabel="mIoU", ylim=(0, 1))
    axes.legend(fontsize=8)
    for n, (way, rows) in enumerate(each.items()):
        axes = figure.add_subplot(2, len(each), len(each) + n + 1)
        axes.plot(thresholds, rows.T, color="0.6", linewidth=0.4)
        axes.plot(thresholds, rows.mean(0), color="C3")
        axes.plot(np.array(thresholds)[rows.argmax(1)], rows.max(1), ".", markersize=2)
        axes.set(ylim=(0, 1), title=way)
        axes.tick_params(labelsize=6)
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
