"""Writes a table of methods over scenes and seeds: means with deviations, levels of noise, and which row leads."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments import results
from experiments.tables.answers import Method
from experiments.tables.fill import Plan, fill, totals


def summarise(cells: list[dict], scenes: tuple[str, ...], level: str, figures: tuple[str, ...]) -> str:
    """Formats a Markdown table with a row per method.

    Columns are the figures of each scene (mean over the seeds ± deviation), their means over the scenes, seconds and
    peak memory.
    """
    names = list(dict.fromkeys(cell["method"] for cell in cells))
    header = ["method", *(f"{scene} {figure}" for scene in scenes for figure in figures)]
    header += [f"mean {figure}" for figure in figures] + ["seconds", "peak MiB so far"]
    rows = []
    for name in names:
        own = [cell for cell in cells if cell["method"] == name and cell["level"] == level]
        row = [name]
        for scene in scenes:
            row += [_spread([cell[f] for cell in own if cell["scene"] == scene]) for f in figures]
        for figure in figures:
            seeds = sorted({cell["seed"] for cell in own})
            row.append(_spread([np.mean([c[figure] for c in own if c["seed"] == seed]) for seed in seeds]))
        row.append(f"{np.mean([cell['seconds'] for cell in own]):.1f}")
        row.append(f"{max(cell['peak_memory_mib'] for cell in own):.0f}")
        rows.append(tuple(row))
    return results.table(tuple(header), rows)


def _spread(values: list[float]) -> str:
    return f"{np.mean(values):.3f}" + (f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 else "")


def means(cells: list[dict], level: str, figure: str = "miou") -> dict[str, float]:
    """Mean of a figure over scenes and seeds by method."""
    names = list(dict.fromkeys(cell["method"] for cell in cells))
    chosen = [cell for cell in cells if cell["level"] == level]
    return {name: float(np.mean([c[figure] for c in chosen if c["method"] == name])) for name in names}


def leaders(
    cells: list[dict], scenes: tuple[str, ...], level: str, *, ours: str, why: str = "", figure: str = "miou"
) -> str:
    """Lists the scenes on which another method has a larger `figure` than the row `ours`, and then `why`.

    Other rows whose names start with "ours" do not count as other methods.
    """
    lines, compared = [], False
    for scene in scenes:
        comparison = _compare([cell for cell in cells if cell["scene"] == scene], level, ours, figure)
        if comparison is None:
            continue
        compared, (mine, best, value) = True, comparison
        if not mine >= value:
            lines.append(f"* {scene}: {best} leads with {value:.3f} ({ours}: {mine:.3f}).")
    if not lines:
        return f'{figure}: the row "{ours}" leads on every scene.' if compared else ""
    lines = [f'{figure}: the row "{ours}" does not lead on every scene.', "", *lines]
    return "\n".join([*lines, "", why] if why else lines)


def _compare(cells: list[dict], level: str, ours: str, figure: str) -> tuple[float, str, float] | None:
    """The figure of the row `ours`, and the name and figure of the best other method; None without others."""
    by_method = means(cells, level, figure)
    others = {name: value for name, value in by_method.items() if not name.startswith("ours")}
    if not others:
        return None
    best = max(others, key=lambda name: others[name])
    return by_method.get(ours, float("nan")), best, others[best]


def noise(cells: list[dict], plan: Plan, ours: str = "") -> str:
    """Formats mIoU over the levels of noise on the first scene and seed; lists those at which `ours` does not lead."""
    scene, seed = plan.data.scenes[0], plan.data.seeds[0]
    here = [cell for cell in cells if (cell["scene"], cell["seed"]) == (scene, seed)]
    levels = [level for level in plan.sweep if any(cell["level"] == level for cell in here)]
    rows = []
    for name in plan.methods:
        by_level = {cell["level"]: cell["miou"] for cell in here if cell["method"] == name}
        rows.append((name, *(f"{by_level[level]:.3f}" for level in levels)))
    lines = []
    for level in levels if ours else ():
        comparison = _compare(here, level, ours, "miou")
        if comparison is not None and not comparison[0] >= comparison[2]:
            mine, best, value = comparison
            lines.append(f"* noise {level}: {best} leads with {value:.4f} ({ours}: {mine:.4f}).")
    return "\n".join([results.table(("method", *levels), rows), *([""] if lines else []), *lines])


def make(
    plan: Plan,
    methods: Mapping[str, Method],
    figures: tuple[str, ...],
    *,
    notes: str,
    ours: str = "",
    why: dict[str, str] | None = None,
    published: str = "",
) -> str:
    """Fills, writes and prints a table.

    Args:
      plan: The table.
      methods: Methods by the names of the rows.
      figures: Names of the columns.
      notes: How the figures are measured.
      ours: Row that is compared with the other methods; empty: no comparison.
      why: Figures in which it is compared, and the reason where it does not lead.
      published: Published numbers that stand beneath.

    Returns:
      The text of table.md.
    """
    cells = fill(plan, methods, tell=lambda line: print(line, flush=True))
    twin = any(cell["twin"] for cell in cells)
    source = f"made-up twins in {plan.data.dataset}'s layout, simulated vision ({plan.level})" if twin else "real data"
    parts = [f"Measured on {source}. {notes}", "", summarise(cells, plan.data.scenes, plan.level, figures), ""]
    if ours:
        for figure_of, reason in (why or {"miou": ""}).items():
            parts += [leaders(cells, plan.data.scenes, plan.level, ours=ours, why=reason, figure=figure_of), ""]
    if twin and len(plan.sweep) > 1:
        parts += [f"mIoU over the noise of vision, {plan.data.scenes[0]}:", "", noise(cells, plan, ours), ""]
    text = "\n".join([*parts, published]).rstrip()
    averages = means(cells, plan.level)
    figure = results.bars(list(averages), {"mIoU": list(averages.values())}, "mIoU, mean of scenes")
    figure.axes[0].get_legend().remove()
    for label in figure.axes[0].get_xticklabels():
        label.set(rotation=20, ha="right", rotation_mode="anchor")
    results.save(Path(plan.out), plan, {"means": averages, "cells": totals(cells)}, text, figure)
    print(text)
    return text
