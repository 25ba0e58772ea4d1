"""Several things of a kind under one text: which of them does an answer hold, counted thing by thing?

    python -m experiments.kinds [--scenes figurines teatime] [--seeds 10 11] [--levels perfect medium] [--quick]
                                [--out FOLDER] [--processes N]

Twins of LERF whose texts name shapes ("mug", "book"), of which a room has up to three. A thing is held where an answer,
rendered alone, covers at least half of its pixels in a labelled frame. found: of the things of the text's kind that the
frame shows, how many are held; right: of all objects that are held, how many are of the kind.
"""

import dataclasses
import json
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments import lerf, results
from experiments.datasets.mesh import SURROUNDINGS
from experiments.tables.answers import Answers, Method, Steps
from experiments.tables.fill import fill, place_of, twins_asked
from experiments.tables.rows import rows_of
from experiments.tables.setting import Setting
from jsecon.evaluate.lerf import resize_camera
from jsecon.query.render import selection_mask
from jsecon.types import Selection

COVERED, LEAST_PX = 0.5, 40
READ = {
    "Occam's LGS": "Occam's LGS: contrast, threshold",
    "weighted back-projection": "weighted back-projection: contrast, threshold",
    "VALA": "VALA: contrast, threshold",
    "ours, the best region": "ours, consensus: contrast, threshold",
    "ours, --all": "ours, consensus: contrast, threshold, all",
    "ours, --all with --parts": "ours, consensus: contrast, threshold, parts",
}
FIGURES = ("miou", "miou_vala", "found", "right")


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    levels: tuple[str, ...]
    quick: bool
    out: str


def counted(method: Method) -> Method:
    """The row, with its answers counted thing by thing beside."""

    def row(setting: Setting, steps: Steps) -> Answers:
        answers, known = method(setting, steps), {}

        def select(k: int) -> Selection | None:
            if k not in known:
                known[k] = answers.select(k)
            return known[k]

        return dataclasses.replace(answers, select=select, beside=things(setting, select))

    return row


def things(setting: Setting, select) -> dict[str, float]:
    """{"found", "right"} over all labelled frames and texts of a twin."""
    bench, root = setting.bench, setting.folder.parent
    names = np.array(json.loads((root / "twin.json").read_text())["scenes"][bench.name]["objects"])
    gaussians = setting.evidence.gaussians
    shown = held = of_kind = 0
    for frame in bench.frames:
        truth = cv2.imread(str(root / "truth" / bench.name / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED).astype(int) - 1
        camera = jax.tree.map(jnp.asarray, resize_camera(setting.cameras[frame.name], truth.shape[1], truth.shape[0]))
        pixels = np.bincount(truth[truth >= 0], minlength=len(names))
        objects = (pixels >= LEAST_PX) & ~np.isin(names, SURROUNDINGS)
        for text in frame.objects:
            kind, answer = objects & (names == text), select(bench.queries.index(text))
            covered = np.zeros(len(names), bool)
            if answer is not None and np.asarray(answer.mask).any():
                mask = np.asarray(selection_mask(gaussians, camera, jnp.asarray(answer.mask)))
                inside = np.bincount(truth[mask & (truth >= 0)], minlength=len(names))
                covered = objects & (inside >= COVERED * pixels)
            shown, held, of_kind = shown + kind.sum(), held + covered.sum(), of_kind + (covered & kind).sum()
    return {"found": float(of_kind / max(shown, 1)), "right": float(of_kind / max(held, 1))}


def main(asked: Asked, processes: int) -> str:
    """The table, written."""
    table = lerf.QUICK if asked.quick else lerf.PLAN
    rows, kept, parts = rows_of(points=False), {}, []
    methods = {name: counted(rows[row]) for name, row in READ.items()}
    scenes = table.data.scenes if asked.quick else asked.scenes
    size = tuple({**dict(table.data.size), "kinds": True}.items())
    data = dataclasses.replace(table.data, scenes=scenes, seeds=asked.seeds, size=size)
    place = {"out": asked.out, "cells": str(Path(asked.out) / "cells.jsonl")}
    helper = False
    for level in asked.levels:
        options = {"methods": tuple(methods), "level": level, "sweep": (), "processes": processes}
        plan = dataclasses.replace(table, data=data, **options, **place)
        try:
            cells = fill(plan, methods, tell=lambda line: print(line, flush=True))
        except SystemExit:  # of a helper, which has no table to write
            helper = True
            continue
        of = lambda row, figure, cells=cells: float(np.mean([c[figure] for c in cells if c["method"] == row]))
        kept[level] = {row: {figure: of(row, figure) for figure in FIGURES} for row in methods}
        parts.append(results.table((level, *FIGURES), [(row, *told.values()) for row, told in kept[level].items()]))
    text = "\n\n".join(parts)
    if not helper:
        results.save(Path(asked.out), asked, kept, text)
        print(text)
    return text


if __name__ == "__main__":
    parser = twins_asked("kinds", "one tiny scene, one seed")
    parser.add_argument("--levels", nargs="+", default=["perfect", "medium"])
    given = parser.parse_args()
    seeds, levels = ((0,), ("medium",)) if given.quick else (tuple(given.seeds), tuple(given.levels))
    main(Asked(tuple(given.scenes), seeds, levels, given.quick, place_of(given, "kinds")), given.processes)
