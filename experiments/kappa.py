"""The paper's Algorithm 1 with the scene's own Gaussians for a tracker: how much does its threshold kappa matter?

    python -m experiments.kappa [--scenes figurines teatime] [--seeds 10 11] [--quick] [--out FOLDER] [--processes N]

Twins of LERF at medium noise; the field is asked as ours is, by the contrast and its pieces, no text refused. Beside
stand the ids that a simulated tracker left on disk, and consensus.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments import lerf, results
from experiments.tables.answers import Method
from experiments.tables.fill import fill, place_of, twins_asked
from experiments.tables.rows import own

KAPPAS = 0.1, 0.3, 0.5, 0.7, 0.9
ROWS: dict[str, Method] = {f"kappa {k}": own(f"kappa {k}", "contrast", "threshold") for k in KAPPAS}
ROWS |= {"ids from disk": own("tracks", "contrast", "threshold")}
ROWS |= {"consensus": own("consensus", "contrast", "threshold")}
FIGURES = ("miou", "macc", "miou_vala")


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    quick: bool
    out: str


def main(asked: Asked, processes: int) -> str:
    """The table, written."""
    table = lerf.QUICK if asked.quick else lerf.PLAN
    scenes = table.data.scenes if asked.quick else asked.scenes
    data = dataclasses.replace(table.data, scenes=scenes, seeds=asked.seeds)
    place = {"out": asked.out, "cells": str(Path(asked.out) / "cells.jsonl")}
    plan = dataclasses.replace(table, data=data, methods=tuple(ROWS), sweep=(), processes=processes, **place)
    cells = fill(plan, ROWS, tell=lambda line: print(line, flush=True))
    of = lambda row, figure: float(np.mean([cell[figure] for cell in cells if cell["method"] == row]))
    text = results.table(("regions by", *FIGURES), [(row, *(of(row, figure) for figure in FIGURES)) for row in ROWS])
    results.save(Path(asked.out), asked, {"cells": cells}, text)
    print(text)
    return text


if __name__ == "__main__":
    given = twins_asked("kappa", "one tiny scene, one seed").parse_args()
    seeds = (0,) if given.quick else tuple(given.seeds)
    main(Asked(tuple(given.scenes), seeds, given.quick, place_of(given, "kappa")), given.processes)
