"""Tables of methods over scenes and seeds: every cell computed once and kept, so that a stopped run goes on."""

import dataclasses
import hashlib
import json
import resource
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from experiments import results, twins
from experiments.methods import Answers, Method, Steps
from experiments.setting import Setting, prepare
from experiments.sharing import alone, helped
from jsecon.data.benchmark import Benchmark
from jsecon.evaluate.lerf import ALPHA_THRESHOLD, VALA_THRESHOLD, evaluate_at_thresholds
from jsecon.evaluate.points import evaluate_points
from jsecon.files import write_text
from jsecon.process import forget_programs

KEPT = ("miou", "macc", "acc_50", "loc_acc", "loc_mask", "pairs", "missing", "accuracy")


@dataclasses.dataclass(frozen=True)
class Plan:
    """A table to be filled."""

    data: twins.Data
    methods: tuple[str, ...]
    steps: Steps = dataclasses.field(default_factory=Steps)
    fit_steps: int = 700
    level: str = "medium"
    """of the twins' simulated vision; unused for real data."""
    sweep: tuple[str, ...] = ("perfect", "low", "medium", "high")
    """levels at which the first scene and seed are run once more."""
    out: str = ""
    cells: str = ""
    """where the cells are kept; empty: OUT/cells. Tables of the same data have rows in common: one folder spares the
    second its training."""
    processes: int = 1
    """that share the settings, each on cores of its own. 0: this one is one of them, which computes what it finds free
    and ends; 1: this one computes all, with all cores."""


def fill(plan: Plan, methods: Mapping[str, Method], *, tell: Callable[[str], None]) -> list[dict]:
    """All cells: {"scene", "seed", "level", "method", figures, "seconds", "peak_memory_mib", "twin"}.

    A cell that an earlier run with the same options left in the plan's folder of cells is read. A setting is computed
    by one process at a time, so the same command may run more than once, and does, `plan.processes` times. `seconds`
    are of training and all queries, without loading and fitting, what methods share charged to each; the memory is the
    process's highest so far, so later rows hide behind earlier ones.
    """
    wanted = [(scene, seed, plan.level) for scene in plan.data.scenes for seed in plan.data.seeds]
    if not plan.data.root:
        first = plan.data.scenes[0], plan.data.seeds[0]
        wanted += [(*first, level) for level in plan.sweep if level != plan.level]
    files = {where: {name: _file(plan, *where, name) for name in plan.methods} for where in wanted}
    todo = [where for where in wanted if not all(file.exists() for file in files[where].values())]
    if plan.processes == 0:
        for where in todo:
            _complete(plan, methods, where, files[where], tell, wait=False)
        raise SystemExit(0)
    if min(plan.processes, len(todo)) > 1:
        helped(min(plan.processes, len(todo)))
    for where in todo:  # of one process all; of several what another command took, or a helper left undone
        _complete(plan, methods, where, files[where], tell, wait=True)
    return [json.loads(file.read_text()) for where in wanted for file in files[where].values()]


def _complete(plan: Plan, methods: Mapping[str, Method], where: tuple, files: dict[str, Path], tell, *, wait: bool):
    """Computes the missing cells of a setting; none where another process is at it, unless that one is waited for."""
    scene, seed, level = where
    lock = next(iter(files.values())).parent / f"{scene}-{seed}-{level}.lock"
    with alone(lock, wait=wait) as free:
        missing = [name for name, file in files.items() if not file.exists()] if free else []
        if not missing:
            return
        forget_programs()
        setting = prepare(plan.data, scene, seed, level, fit_steps=plan.fit_steps)
        for name in missing:
            began = time.perf_counter()
            cell = measure(setting, methods[name](setting, plan.steps))
            cell |= {"scene": scene, "seed": seed, "level": level, "method": name, "twin": setting.bench.twin}
            cell["seconds"] = round(time.perf_counter() - began + setting.shared.settle(), 2)
            cell["peak_memory_mib"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)
            write_text(files[name], json.dumps(cell))
            tell(f"{scene} seed {seed} {level}: {name}: mIoU {cell['miou']:.3f}, {cell['seconds']:.1f} s")


def _file(plan: Plan, scene: str, seed: int, level: str, method: str) -> Path:
    given = [
        plan.data.dataset,
        plan.data.root,
        plan.data.size,
        twins.KIND,
        plan.data.every,
        plan.data.downscale,
        plan.fit_steps,
        dataclasses.asdict(plan.steps),
    ]
    key = hashlib.sha1(json.dumps([*given, scene, seed, level, method], default=str).encode()).hexdigest()[:12]
    return Path(plan.cells or Path(plan.out) / "cells") / f"{scene}-{seed}-{level}-{key}.json"


def measure(setting: Setting, answers: Answers) -> dict:
    """The figures of one method on one setting, under the dataset's protocol; denominators checked."""
    bench: Benchmark = setting.bench
    if not bench.frames:
        opacity = 1 / (1 + np.exp(-np.asarray(setting.evidence.gaussians.opacity_logits)))
        _, told = evaluate_points(
            answers.classes(),
            bench.point_classes,
            bench.queries,
            expected_classes=bench.pairs,
            opacities=opacity,
        )
        return {name: told[name] for name in KEPT if name in told}
    both = evaluate_at_thresholds(
        setting.evidence.gaussians,
        setting.cameras,
        bench.frames,
        lambda query: answers.select(bench.queries.index(query)),
        expected_pairs=bench.pairs,
    )
    strict, lenient = both[ALPHA_THRESHOLD][1], both[VALA_THRESHOLD][1]
    return {name: strict[name] for name in KEPT if name in strict} | {
        "miou_vala": lenient["miou"],
        "macc_vala": lenient["macc"],
        **answers.beside,
    }


def summarise(cells: list[dict], scenes: tuple[str, ...], level: str, figures: tuple[str, ...]) -> str:
    """A Markdown table: a row a method, the figures of each scene as mean over the seeds +- deviation, then the mean
    of the scenes with the deviation of the seeds' means, seconds and memory."""
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
    """Mean over scenes and seeds of a figure, a method each."""
    names = list(dict.fromkeys(cell["method"] for cell in cells))
    chosen = [cell for cell in cells if cell["level"] == level]
    return {name: float(np.mean([c[figure] for c in chosen if c["method"] == name])) for name in names}


def leaders(
    cells: list[dict], scenes: tuple[str, ...], level: str, *, ours: str, why: str = "", figure: str = "miou"
) -> str:
    """Where another method's `figure` of a scene is above that of the row `ours`, a line each, and `why`. Rows whose
    names start with "ours" are not others: the best of several of one's own would be chosen by the answer."""
    lines, compared = [], False
    for scene in scenes:
        held = _held_against([cell for cell in cells if cell["scene"] == scene], level, ours, figure)
        if held is None:
            continue
        compared, (mine, best, value) = True, held
        if not mine >= value:
            lines.append(f"* {scene}: {best} leads with {value:.3f} ({ours}: {mine:.3f}).")
    if not lines:
        return f'{figure}: the row "{ours}" leads on every scene.' if compared else ""
    lines = [f'{figure}: the row "{ours}" does not lead on every scene.', "", *lines]
    return "\n".join([*lines, "", why] if why else lines)


def _held_against(cells: list[dict], level: str, ours: str, figure: str) -> tuple[float, str, float] | None:
    """The figure of the row `ours` at a level of noise, and the name and figure of the best other (none: None)."""
    found = means(cells, level, figure)
    others = {name: value for name, value in found.items() if not name.startswith("ours")}
    if not others:
        return None
    best = max(others, key=lambda name: others[name])
    return found.get(ours, float("nan")), best, others[best]


def noise(cells: list[dict], plan: Plan, ours: str = "") -> str:
    """A Markdown table of mIoU over the levels of noise, on the first scene and seed, and a line for each level at
    which the row `ours` (none: no such comparison) does not lead."""
    scene, seed = plan.data.scenes[0], plan.data.seeds[0]
    here = [cell for cell in cells if (cell["scene"], cell["seed"]) == (scene, seed)]
    levels = [level for level in plan.sweep if any(cell["level"] == level for cell in here)]
    rows = []
    for name in plan.methods:
        found = {cell["level"]: cell["miou"] for cell in here if cell["method"] == name}
        rows.append((name, *(f"{found[level]:.3f}" for level in levels)))
    lines = []
    for level in levels if ours else ():
        held = _held_against(here, level, ours, "miou")
        if held is not None and not held[0] >= held[2]:
            lines.append(f"* noise {level}: {held[1]} leads with {held[2]:.4f} ({ours}: {held[0]:.4f}).")
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
    """Fills the table, writes it, prints it, returns it."""
    cells = fill(plan, methods, tell=lambda line: print(line, flush=True))
    text = write(plan, cells, figures, notes=notes, ours=ours, why=why, published=published)
    print(text)
    return text


def write(
    plan: Plan,
    cells: list[dict],
    figures: tuple[str, ...],
    *,
    notes: str,
    ours: str = "",
    why: dict[str, str] | None = None,
    published: str = "",
) -> str:
    """Writes results/<name>/{config.json, metrics.json, table.md, figure.png}; returns the table. `ours` is the row
    that the others are held against (none: no such comparison) in each figure of `why`, which says why it does not lead
    where it does not."""
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
    results.save(Path(plan.out), plan, {"means": averages, "cells": cells}, text, figure)
    return text
