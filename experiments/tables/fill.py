"""Tables of methods over scenes and seeds: every cell computed once and kept, so that a stopped run goes on."""

import argparse
import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from experiments import results
from experiments.cells import append_cell, exclusive_lock, read_cells, run_helpers
from experiments.datasets.benchmark import Benchmark
from experiments.protocols.points import evaluate_points
from experiments.tables import twins
from experiments.tables.answers import Answers, Method, Steps
from experiments.tables.setting import Setting, prepare
from jsecon.evaluate.lerf import ALPHA_THRESHOLD, VALA_THRESHOLD, evaluate_at_thresholds
from jsecon.process import clear_programs, cores, peak_memory_mib

DIGITS = 4
"""of the IoU of single texts and frames"""
KEPT = ("miou", "macc", "acc_50", "loc_acc", "loc_mask", "loc_box", "pairs", "missing", "accuracy")


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
    """the file of the cells; empty: OUT/cells.jsonl. Tables of the same data have rows in common: one file spares the
    second its training."""
    processes: int = 1
    """that share the settings, each on cores of its own. 0: this one is one of them, which computes what it finds free,
    waits for the others, and ends; 1: this one computes all, with all cores."""


def options_of(plan: Plan, quick: Plan, words: list[str] | None = None) -> Plan:
    """The plan that the command line, or `words` of it, asks for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="one tiny scene, a few steps: at most two minutes")
    parser.add_argument("--root", default="", help="the real dataset; without it twins are made")
    parser.add_argument("--seeds", type=int, nargs="+", help="of the twins and their vision")
    parser.add_argument("--out", default="", help="where the results go")
    parser.add_argument("--processes", type=int, default=cores(), help="that share the settings; default: one per core")
    given = parser.parse_args(words)
    chosen = dataclasses.replace(quick if given.quick else plan, processes=given.processes)
    if given.seeds:
        chosen = dataclasses.replace(chosen, data=dataclasses.replace(chosen.data, seeds=tuple(given.seeds)))
    if given.root:
        data = dataclasses.replace(chosen.data, root=given.root, seeds=chosen.data.seeds[:1])
        chosen = dataclasses.replace(chosen, data=data)
    return dataclasses.replace(chosen, out=given.out, cells="") if given.out else chosen


def twins_asked(name: str, quick: str) -> argparse.ArgumentParser:
    """Options of experiments that report a few scenes and seeds of twins; OUT is results/`name`, or quick/`name`."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", default=["figurines", "teatime"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 11], help="that are reported")
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--out", default="", help=f"where the results go (default: results/{name})")
    parser.add_argument("--processes", type=int, default=cores(), help="that share the settings; default: one per core")
    return parser


def place_of(given: argparse.Namespace, name: str) -> str:
    """The folder of the results that `twins_asked` asked for."""
    return given.out or str(results.HOME / "results" / (f"quick/{name}" if given.quick else name))


def fill(plan: Plan, methods: Mapping[str, Method], *, tell: Callable[[str], None]) -> list[dict]:
    """All cells: {"scene", "seed", "level", "method", figures, "seconds", "peak_memory_mib", "twin"}.

    A cell that an earlier run with the same options left in the plan's file of cells is read. A setting is computed
    by one process at a time, so the same command may run more than once, and does, `plan.processes` times. `seconds`
    are of training and all queries, without loading and fitting, what methods share charged to each; the memory is the
    process's highest so far, so later rows hide behind earlier ones.
    """
    wanted = [(scene, seed, plan.level) for scene in plan.data.scenes for seed in plan.data.seeds]
    if not plan.data.root:
        first = plan.data.scenes[0], plan.data.seeds[0]
        wanted += [(*first, level) for level in plan.sweep if level != plan.level]
    keys = {where: {name: _key(plan, *where, name) for name in plan.methods} for where in wanted}
    known = read_cells(_file(plan))
    todo = [where for where in wanted if not known.keys() >= set(keys[where].values())]
    if plan.processes == 0:
        for where in todo:  # what is free: what another process is at, or leaves undone, the caller sees to
            _complete(plan, methods, where, keys[where], tell, wait=False)
        raise SystemExit(0)
    if min(plan.processes, len(todo)) > 1:
        run_helpers(min(plan.processes, len(todo)))
    for where in todo:  # of one process all; of several what another command took, or a helper left undone
        _complete(plan, methods, where, keys[where], tell, wait=True)
    known = read_cells(_file(plan))
    return [known[key] for where in wanted for key in keys[where].values()]


def _complete(plan: Plan, methods: Mapping[str, Method], where: tuple, keys: dict[str, str], tell, *, wait: bool):
    """Computes the missing cells of a setting; none where another process is at it, unless that one is waited for."""
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
    """Of a cell: its setting, and a digest of all that its value depends on but the code."""
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
    digest = hashlib.sha1(json.dumps([*given, scene, seed, level, method], default=str).encode()).hexdigest()[:12]
    return f"{scene}-{seed}-{level}-{digest}"


def totals(cells: list[dict]) -> list[dict]:
    """The cells without the figures of single texts, which the file of cells keeps."""
    return [{name: told for name, told in cell.items() if name != "texts"} for cell in cells]


def measure(setting: Setting, answers: Answers) -> dict:
    """The figures of one method on one setting, under the dataset's protocol; denominators checked."""
    bench: Benchmark = setting.bench
    if not bench.frames:
        opacity = 1 / (1 + np.exp(-np.asarray(setting.evidence.gaussians.opacity_logits)))
        rows, told = evaluate_points(
            answers.classes(),
            bench.point_classes,
            bench.queries,
            expected_classes=bench.pairs,
            opacities=opacity,
        )
        texts = {row.query: [round(row.iou, DIGITS)] for row in rows}
        return {name: told[name] for name in KEPT if name in told} | {"texts": texts}
    both = evaluate_at_thresholds(
        answers.gaussians or setting.evidence.gaussians,
        setting.cameras,
        bench.frames,
        lambda query: answers.select(bench.queries.index(query)),
        expected_pairs=bench.pairs,
    )
    (rows, strict), (beside, lenient) = both[ALPHA_THRESHOLD], both[VALA_THRESHOLD]
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
