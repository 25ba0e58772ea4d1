"""Codes of the Gaussians by every path and start: rendered L1, point accuracy and IoU against seconds.

    python -m experiments.distillation [--quick] [FOLDER_OF_DEMOS]

Scenes: replica_apartment_0 (where it lies beside the checkout) and demo rooms, seen by simulated vision
(experiments.simulated_vision): masks with faults, one embedding per region as in the paper, LangSplat's autoencoder.
Paths: votes reduced by mean, median, geometric median and mode; the L1 solver from the mode; and the paper's Adam on
the rendered L1 (LangSplat's train.py), looked at several times on its way: from zero, and on one scene from random
codes and the mode too. Points are compared through the nearest region's true object, and by the selections that the
objects' texts anchor: by code (the last row of "Adam from zero" is the whole of the paper's path) and by votes. Seconds
are CPU time of all threads, without compilation, what a start costs included. Each path is kept as soon as it is done,
Adam's every few minutes: a run that was stopped goes on where it was.
"""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np

from experiments import results
from experiments.cells import append_cell, read_cells
from experiments.codes.paths import adam_path, task_of, votes_paths
from experiments.ideas import scenes
from experiments.ideas.scenes import rooms_of
from jsecon.errors import InputError


@dataclasses.dataclass(frozen=True)
class Options(scenes.Places):
    """What the experiment can vary."""

    level: str = "medium"
    """of vision's faults."""
    latent: int = 3
    steps: int = 30_000
    """of Adam."""
    looks: tuple[float, ...] = (0.02, 0.1, 0.3, 1.0)
    """at which parts of Adam's way it is measured."""
    all_starts: tuple[str, ...] = ("demo 0",)
    """scenes on which Adam starts from random codes and the votes' mode too; elsewhere from zero, as the paper's."""
    loyalties: tuple[float, ...] = (0.1,)
    """of the solver."""
    sweeps: tuple[int, ...] = (4, 24)
    """most passes over the views that the solver takes."""
    views: int | None = None
    """at most so many views of a scene, evenly spaced; None: all."""
    shrink: int = 1
    """frames of a demo are made so many times smaller."""
    replica_shrink: int = 2
    """and those of the capture: 30,000 steps at 512x512 take an hour."""
    out: str = str(results.HOME / "results" / "distillation")


QUICK = Options(
    seeds=(), steps=60, looks=(0.5, 1.0), loyalties=(0.1,), sweeps=(4,), views=6, shrink=2, replica_shrink=8,
    out=str(results.HOME / "results" / "distillation_quick"),
)  # fmt: skip


_SCENE = ("level", "latent", "views", "shrink", "replica_shrink")
_OF_PATH = {"votes": (*_SCENE, "loyalties", "sweeps"), "Adam": (*_SCENE, "steps", "looks")}
"""options that make a path be taken again where they change"""


def main(options: Options = Options()) -> dict:
    """Runs the experiment, or what is left of it, writes its results and returns the metrics."""
    out = Path(options.out)
    file, rows = out / "cells.jsonl", []
    made = options.scenes()
    if not made:
        raise InputError(
            options.replica,
            "no capture there, and no demo seeds",
            "a scene to measure on",
            "Give a folder of demos, or put replica_apartment_0 beside the checkout.",
        )
    paths = [(name, path) for name in made for path in ("votes", "Adam from zero")]
    paths += [(n, path) for n in made if n in options.all_starts for path in ("Adam from random", "Adam from votes")]
    space, task = options.space(), None
    for name, path in paths:
        given = {option: getattr(options, option) for option in _OF_PATH[path.split()[0]]}
        digest = hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:10]
        key = f"{name}-{path}-{digest}".replace(" ", "_")
        if key not in read_cells(file):
            if task is None or task.name != name:
                shrink = options.replica_shrink if name == "replica_apartment_0" else options.shrink
                size = {"views": options.views, "shrink": shrink}
                task = task_of(made[name](), space, level=options.level, latent=options.latent, **size)
            record = out / f"{key}.npz"
            out.mkdir(parents=True, exist_ok=True)
            if path == "votes":
                found = votes_paths(task, loyalties=options.loyalties, sweeps=options.sweeps)
            else:
                start = path.rpartition(" ")[2]
                found = adam_path(task, start, record, steps=options.steps, looks=options.looks)
            append_cell(file, key, found)
            record.unlink(missing_ok=True)
        rows += [{"scene": name, **row} for row in read_cells(file)[key]]
    metrics = {"rows": rows, "speed": speed(rows)}
    header = (
        "scene",
        "path",
        "steps",
        "seconds",
        "rendered L1",
        "point accuracy",
        "point mIoU",
        "anchored",
        "by votes",
        "gap",
    )
    lines = [
        (
            r["scene"],
            r["path"],
            r.get("steps", ""),
            f"{r['seconds']:.2f}",
            f"{r['l1']:.4f}",
            r["accuracy"],
            r["miou"],
            r["anchored"],
            r.get("anchored_by_votes", ""),
            f"{r['gap']:.1e}" if "gap" in r else "",
        )
        for r in rows
    ]
    table = results.table(header, lines) + "\n\n" + results.table(
        ("scene", "Adam, last L1", "Adam, s", "first other path at that L1", "its s", "times fewer"),
        [tuple(row.values()) for row in metrics["speed"]],
    )  # fmt: skip
    results.save(out, options, metrics, table, draw(rows))
    print(table)
    return metrics


def speed(rows: list[dict]) -> list[dict]:
    """For each scene the rendered L1 that the paper's path (from zero) ends at, and the fewest seconds of a path from
    votes to it; None where none reaches it."""
    told = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        adam = max((r for r in own if r["path"] == "Adam from zero"), key=lambda r: r["steps"])
        others = [r for r in own if r["l1"] <= adam["l1"] and r["path"] not in ("Adam from zero", "Adam from random")]
        first = min(others, key=lambda r: r["seconds"], default=None)
        told.append(
            {
                "scene": scene,
                "l1": round(adam["l1"], 4),
                "seconds": round(adam["seconds"], 1),
                "path": first and first["path"],
                "its_seconds": first and round(first["seconds"], 2),
                "times": first and round(adam["seconds"] / first["seconds"], 1),
            }
        )
    return told


def draw(rows: list[dict]):
    """Rendered L1 and point accuracy against seconds, a curve a path; all scenes' means at equal places."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4))
    kinds: dict[str, dict[int, list[dict]]] = {}
    for row in rows:
        kind, place = (row["path"], row["steps"]) if "steps" in row else (row["path"], 0)
        kinds.setdefault(kind, {}).setdefault(place, []).append(row)
    for column, (key, title) in enumerate((("l1", "rendered L1"), ("accuracy", "point accuracy"))):
        axes = figure.add_subplot(1, 2, column + 1)
        for kind, places in kinds.items():
            x, y = (
                [float(np.mean([r[name] for r in found])) for _, found in sorted(places.items())]
                for name in ("seconds", key)
            )
            axes.plot(x, y, marker="o" if len(x) == 1 else ".", linestyle="-" if len(x) > 1 else "none", label=kind)
        axes.set_xscale("log")
        axes.set_xlabel("CPU seconds")
        axes.set_ylabel(title)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


if __name__ == "__main__":
    quick = QUICK if Path(QUICK.replica).is_dir() else dataclasses.replace(QUICK, seeds=(0,))
    main(rooms_of(Options(), quick))
