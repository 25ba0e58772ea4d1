"""The paper's Algorithm 1 with the scene's own Gaussians for a tracker: how much does its threshold kappa matter?

    python -m experiments.kappa [--scenes figurines teatime] [--seeds 10 11] [--quick] [--out FOLDER] [--processes N]

Twins of LERF at medium noise; the field is asked as ours is, by the contrast and its pieces, no text refused. Beside
stand the ids that a simulated tracker left on disk, and consensus.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from experiments import lerf, results
from experiments.tables.answers import Method
from experiments.tables.fill import fill
from experiments.tables.readings import own
from jsecon.process import cores

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
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", nargs="+", default=["figurines", "teatime"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 11])
    parser.add_argument("--quick", action="store_true", help="one tiny scene, one seed")
    parser.add_argument("--out", default="")
    parser.add_argument("--processes", type=int, default=cores(), help="that share the settings; default: one per core")
    given = parser.parse_args()
    place = given.out or str(results.HOME / "results" / ("quick/kappa" if given.quick else "kappa"))
    seeds = (0,) if given.quick else tuple(given.seeds)
    main(Asked(tuple(given.scenes), seeds, given.quick, place), given.processes)
