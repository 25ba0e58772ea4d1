"""Fills tables of methods over scenes and seeds. Every cell is computed once and kept, so that a run resumes."""

import argparse
import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from experiments.cells import append_cell, exclusive_lock, read_cells, run_helpers
from experiments.datasets.benchmark import Benchmark
from experiments.memory_maps import clear_programs
from experiments.protocols.points import evaluate_points
from experiments.protocols.rendered import VALA_THRESHOLD, by_masks
from experiments.tables import twins
from experiments.tables.answers import QUICK_STEPS, Answers, Method, Steps
from experiments.tables.setting import Setting, prepare
from jsecon.evaluate.lerf import ALPHA_THRESHOLD, evaluate_labels
from jsecon.process import cores, peak_memory_mib

DIGITS = 4
"""Decimal places of the IoU of single texts and frames."""
KEPT = ("miou", "macc", "acc_50", "loc_acc", "loc_mask", "loc_box", "pairs", "missing", "accuracy")
"""Figures that a cell keeps."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """A table to be filled."""

    data: twins.Data
    methods: tuple[str, ...]
    steps: Steps = dataclasses.field(default_factory=Steps)
    fit_steps: int = 700
    level: str = "medium"
    """Level of noise of the simulated vision of twins; unused for real data."""
    sweep: tuple[str, ...] = ("perfect", "low", "medium", "high")
    """Levels of noise at which the first scene and seed run once more."""
    out: str = ""
    cells: str = ""
    """File of the cells; empty: OUT/cells.jsonl. Tables with common rows share a file, and so the training."""
    processes: int = 1
    """Processes that share the settings, each on its own cores. 1: this process computes all on all cores. 0: this
    process is a helper, which computes free settings and ends."""


def quick_plan(plan: Plan, scene: str, **size: int | float) -> Plan:
    """The quick run of a table: one tiny twin of a scene, few steps; its figures say nothing."""
    data = dataclasses.replace(plan.data, scenes=(scene,), seeds=(0,), size=tuple(size.items()))
    out = Path(plan.out).parent / "quick" / Path(plan.out).name
    return dataclasses.replace(plan, data=data, steps=QUICK_STEPS, fit_steps=80, sweep=(), out=str(out))


def options_of(plan: Plan, quick: Plan, words: list[str] | None = None) -> Plan:
    """Reads the plan of a table from the command line, or from `words`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="run one tiny scene with few steps (two minutes)")
    parser.add_argument("--root", default="", help="folder of the real dataset; without it twins are made")
    parser.add_argument("--seeds", type=int, nargs="+", help="seeds of the twins and of their simulated vision")
    parser.add_argument("--out", default="", help="folder of the results")
    parser.add_argument("--processes", type=int, default=cores(), help="number of processes (default: one per core)")
    options = parser.parse_args(words)
    chosen = dataclasses.replace(quick if options.quick else plan, processes=options.processes)
    if options.seeds:
        chosen = dataclasses.replace(chosen, data=dataclasses.replace(chosen.data, seeds=tuple(options.seeds)))
    if options.root:
        data = dataclasses.replace(chosen.data, root=options.root, seeds=chosen.data.seeds[:1])
        chosen = dataclasses.replace(chosen, data=data)
    return dataclasses.replace(chosen, out=options.out, cells="") if options.out else chosen


def fill(plan: Plan, methods: Mapping[str, Method], *, tell: Callable[[str], None]) -> list[dict]:
    """Computes the missing cells of a table.

    The cells of earlier runs with the same options are read. One process computes a setting at a time, so that the
    same command may run several times.

    Args:
      plan: The table.
      methods: Methods by the names of the rows.
      tell: Prints a line per finished cell.

    Returns:
      Cells {"scene", "seed", "level", "method", figures, "seconds", "peak_memory_mib", "twin"}. `seconds` are those of
      training and all queries without loading and fitting; work that methods share is charged to each. The memory is
      the peak of the process so far.
    """
    settings = [(scene, seed, plan.level) for scene in plan.data.scenes for seed in plan.data.seeds]
    if not plan.data.root:
        first = plan.data.scenes[0], plan.data.seeds[0]
        settings += [(*first, level) for level in plan.sweep if level != plan.level]
    keys = {where: {name: _key(plan, *where, name) for name in plan.methods} for where in settings}
    known = read_cells(_file(plan))
    todo = [where for where in settings if not known.keys() >= set(keys[where].values())]
    if plan.processes == 0:
        for where in todo:  # The caller computes what a failed helper leaves undone.
            _complete(plan, methods, where, keys[where], tell, wait=False)
        raise SystemExit(0)
    if min(plan.processes, len(todo)) > 1:
        run_helpers(min(plan.processes, len(todo)))
    for where in todo:
        _complete(plan, methods, where, keys[where], tell, wait=True)
    known = read_cells(_file(plan))
    return [known[key] for where in settings for key in keys[where].values()]


def _complete(plan: Plan, methods: Mapping[str, Method], where: tuple, keys: dict[str, str], tell, *, wait: bool):
    """Computes the missing cells of a setting, unless another process computes it and `wait` is False."""
    scene, seed, level = where
    file = _file(plan)
    with exclusive_lock(file.with_name(f"{scene}-{seed}-{level}.lock"), wait=wait) as free:
        known = read_cells(file) if free else keys.values()
        missing = [name for name, key in keys.items() if key not in known]
        if not missing:
            return
        clear_programs()
        setting = prepare(plan.data, scene, seed, level, fit_steps=plan.fit_steps)
        for name in missing:
            began = time.perf_counter()
            cell = measure(setting, methods[name](setting, plan.steps))
            cell |= {"scene": scene, "seed": seed, "level": level, "method": name, "twin": setting.bench.twin}
            cell["seconds"] = round(time.perf_counter() - began + setting.shared.settle(), 2)
            cell["peak_memory_mib"] = round(peak_memory_mib(), 1)
            append_cell(file, keys[name], cell)
            tell(f"{scene} seed {seed} {level}: {name}: mIoU {cell['miou']:.3f}, {cell['seconds']:.1f} s")


def _file(plan: Plan) -> Path:
    return Path(plan.cells or Path(plan.out) / "cells.jsonl")


def _key(plan: Plan, scene: str, seed: int, level: str, method: str) -> str:
    """Key of a cell: its setting and a digest of all options that its value depends on."""
    options = [
        plan.data.dataset,
        plan.data.root,
        plan.data.size,
        twins.KIND,
        plan.data.every,
        plan.data.downscale,
        plan.fit_steps,
        dataclasses.asdict(plan.steps),
    ]
    digest = hashlib.sha1(json.dumps([*options, scene, seed, level, method], default=str).encode()).hexdigest()[:12]
    return f"{scene}-{seed}-{level}-{digest}"


def totals(cells: list[dict]) -> list[dict]:
    """The cells without the figures of single texts."""
    return [{name: value for name, value in cell.items() if name != "texts"} for cell in cells]


def measure(setting: Setting, answers: Answers) -> dict:
    """Measures a method on a setting under the protocol of the dataset.

    Args:
      setting: The setting.
      answers: The answers of the trained method.

    Returns:
      Figures, and the IoU of each text.

    Raises:
      InputError: The number of pairs or classes differs from that of the protocol.
    """
    bench: Benchmark = setting.bench
    if not bench.frames:
        opacity = 1 / (1 + np.exp(-np.asarray(setting.evidence.gaussians.opacity_logits)))
        ious, figures = evaluate_points(
            answers.classes(), bench.point_classes, bench.queries, expected_classes=bench.pairs, opacities=opacity
        )
        texts = {query: [round(iou, DIGITS)] for query, iou in ious.items()}
        return {name: figures[name] for name in KEPT if name in figures} | {"texts": texts}
    gaussians = answers.gaussians or setting.evidence.gaussians
    select = functools.cache(lambda query: answers.select(bench.queries.index(query)))
    (rows, strict), (beside, lenient) = (
        evaluate_labels(gaussians, setting.cameras, bench.frames, select, alpha_threshold=threshold)
        for threshold in (ALPHA_THRESHOLD, VALA_THRESHOLD)
    )
    strict |= by_masks(rows, bench.frames)
    texts = {
        query: [[round(r.iou, DIGITS) for r in of if r.query == query] for of in (rows, beside)]
        for query in dict.fromkeys(r.query for r in rows)
    }
    return {name: strict[name] for name in KEPT if name in strict} | {
        "miou_vala": lenient["miou"],
        "macc_vala": lenient["macc"],
        "texts": texts,
        **answers.beside,
    }
