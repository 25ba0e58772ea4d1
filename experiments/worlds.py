"""Worlds that fight back: every fault that real vision has and the tables' does not, swept alone and together.

    python -m experiments.worlds [--scenes figurines teatime] [--seeds 10 11] [--choosing 0] [--only FAULT ...]
                                 [--values 1 0.5] [--quick] [--out FOLDER] [--processes N]

Twins of LERF at medium noise. The rows are those of `experiments.fair` that need no training, each read as its paper
does (by the relevancy) and by the contrast with a threshold or the ascent for > 10/255 (ours: of one region, of all
that answer, and of their parts): the best in that world on the seeds `--choosing`, for each figure its own. None may
refuse a text.
"""

import dataclasses
from pathlib import Path

import numpy as np

from experiments import fair, lerf, results
from experiments.simulated_vision.worlds import World
from experiments.tables.fill import Plan, fill, place_of, twins_asked
from experiments.tables.rows import TRAINED, rows_of

HARD, HALF = 1.0, 0.5
FRAMES = "kinds", "camouflage"
"""faults of the labels and of the pictures (options of the twins' writer), not of the vision"""
FAULTS = (*(field.name for field in dataclasses.fields(World)), *FRAMES)
READ = ("relevancy, threshold", *(f"contrast, threshold{way}" for way in ("", ", all", ", parts")))
READ += tuple(f"contrast, lenient silhouette{way}" for way in ("", ", parts"))
LEFT_OUT = "ours, outspoken views"
"""a row of `experiments.fair` that is an older one of ours"""
FIGURES = ("miou", "miou_vala")


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    choosing: tuple[int, ...]
    only: tuple[str, ...]
    values: tuple[float, ...]
    """how hard"""
    quick: bool
    out: str


def worlds(only: tuple[str, ...], values: tuple[float, ...]) -> dict[tuple[str, float], tuple[str, dict]]:
    """(fault, how hard) -> (the level of a twin, options of its writer). ("none", 0) is the tables' own world,
    ("together", 1) all faults at once, of names those of LVIS."""
    found: dict[tuple[str, float], tuple[str, dict]] = {("none", 0.0): ("medium", {})}
    for fault, value in ((fault, value) for value in values for fault in only):
        if fault != "kinds" or value == HARD:
            if fault in FRAMES:
                found[fault, value] = "medium", {fault: value if fault == "camouflage" else True}
            else:
                found[fault, value] = f"medium+{fault}={value:g}", {}
    if set(only) == set(FAULTS) and HARD in values:
        every = "+".join(f"{field.name}=1" for field in dataclasses.fields(World) if field.name != "names")
        found["together", HARD] = f"medium+{every}", {"kinds": True, "camouflage": HARD}
    return found


def plan_of(level: str, size: dict, asked: Asked, processes: int) -> Plan:
    """Every row on every scene and seed of a world."""
    table = lerf.QUICK if asked.quick else lerf.PLAN
    data = table.data
    options = tuple({**dict(data.size), **size}.items())
    seeds = tuple(dict.fromkeys((*asked.choosing, *asked.seeds)))
    scenes = data.scenes if asked.quick else asked.scenes
    return dataclasses.replace(
        table,
        data=dataclasses.replace(data, seeds=seeds, scenes=scenes, size=options),
        methods=tuple(
            row
            for row in rows_of(points=False)
            if row.split(": ")[1] in READ and not row.startswith((LEFT_OUT, *TRAINED))
        ),
        level=level,
        sweep=(),
        processes=processes,
        out=asked.out,
        cells=str(Path(asked.out) / "cells.jsonl"),
    )


def of_world(cells: list[dict], asked: Asked) -> dict[str, dict[str, float]]:
    """Each method's figures on the seeds that are reported, read as was best on the others."""
    best = fair.chosen(cells, asked.choosing, FIGURES)
    held = [cell for cell in cells if cell["seed"] in asked.seeds]
    found = {}
    best.pop(fair.ONE_READING)
    for method, rows in best.items():
        found[method] = {f: float(np.mean([c[f] for c in held if c["method"] == rows[f]])) for f in FIGURES}
    return found


def layout(found: dict[tuple[str, float], dict[str, dict[str, float]]]) -> str:
    """A table for each figure: the worlds in rows, the methods in columns, and where ours stands."""
    parts = []
    for figure in FIGURES:
        methods = list(next(iter(found.values())))
        rows, behind = [], []
        for (fault, value), told in found.items():
            mine = told["ours, consensus"][figure]
            other, best = max(((m, told[m][figure]) for m in methods if not m.startswith("ours")), key=lambda x: x[1])
            rows.append((f"{fault} {value:g}", *(told[m][figure] for m in methods), mine - best))
            behind += [f"{fault} {value:g} ({other}, by {best - mine:.3f})"] if mine < best else []
        parts.append(results.table((figure, *methods, "ours, consensus - best other"), rows))
        parts.append(f"Ours by consensus is behind in: {', '.join(behind)}." if behind else "Ours is behind in none.")
    return "\n\n".join(parts)


def curves(found: dict[tuple[str, float], dict[str, dict[str, float]]]):
    """mIoU over how hard each fault is, a line for each method."""
    from matplotlib.figure import Figure

    faults = [f for f in dict.fromkeys(fault for fault, _ in found) if f not in ("none", "together")]
    across = min(3, len(faults))
    figure = Figure(figsize=(3.4 * across, 2.6 * -(-len(faults) // across)))
    for n, fault in enumerate(faults):
        axes = figure.add_subplot(-(-len(faults) // across), across, n + 1, title=fault, ylim=(0, 1))
        hard = [0.0, *sorted(v for f, v in found if f == fault)]
        for method in found["none", 0.0]:
            axes.plot(hard, [found["none" if v == 0 else fault, v][method]["miou"] for v in hard], "o-", label=method)
        if n == 0:
            axes.legend(fontsize=6)
    figure.tight_layout()
    return figure


def main(asked: Asked, processes: int) -> str:
    """The table, written."""
    methods, found, helper = rows_of(points=False), {}, False
    for name, (level, size) in worlds(asked.only, asked.values).items():
        try:
            plan = plan_of(level, size, asked, processes)
            cells = fill(plan, methods, tell=lambda line: print(line, flush=True))
        except SystemExit:  # of a helper, which has no table to write
            helper = True
            continue
        found[name] = of_world(cells, asked)
        print(name, found[name], flush=True)
    if helper:
        return ""
    text = layout(found)
    metrics = {f"{fault} {value:g}": told for (fault, value), told in found.items()}
    results.save(Path(asked.out), asked, metrics, text, curves(found))
    print(text)
    return text


if __name__ == "__main__":
    parser = twins_asked("worlds", "one tiny scene, two faults")
    parser.add_argument("--choosing", nargs="+", type=int, default=[0], help="that readings are chosen on")
    parser.add_argument("--only", nargs="+", default=list(FAULTS), choices=FAULTS)
    parser.add_argument("--values", nargs="+", type=float, default=[HARD, HALF], help="how hard, 0 to 1")
    given = parser.parse_args()
    seeds, choosing, only = tuple(given.seeds), tuple(given.choosing), tuple(given.only)
    if given.quick:
        seeds, choosing, only = (1,), (0,), ("parts", "kinds")
    values = (HARD,) if given.quick else tuple(given.values)
    place = place_of(given, "worlds")
    main(Asked(tuple(given.scenes), seeds, choosing, only, values, given.quick, place), given.processes)
