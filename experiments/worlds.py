"""Worlds that fight back: every fault that real vision has and the tables' does not, swept alone and together.

    python -m experiments.worlds [--scenes figurines teatime] [--seeds 10 11] [--choosing 0] [--only FAULT ...]
                                 [--values 1 0.5] [--scenes-trained figurines] [--seeds-trained 10] [--quick]
                                 [--out FOLDER] [--processes N]

Twins of LERF at medium noise. The rows are those of `experiments.fair` that need no training, each read as its paper
does (by the relevancy) and by the contrast or "apart" with a threshold or an ascent, for > 0.7 or > 10/255 (the rivals'
of linear and of sharp shares; ours of one region, and of all that answer): the best in that world on the seeds
`--choosing`, for each figure its own. None may refuse a text. Methods that train take minutes a setting: those of
`--scenes-trained` and `--seeds-trained` have them too, in tables of their own beside all the others there; a method
that trains is read as is best on those very seeds, so that its figure is the most that a reading could give.
"""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np

from experiments import fair, lerf, results
from experiments.simulated_vision.worlds import World
from experiments.tables.fill import Plan, fill, results_folder, twins_parser
from experiments.tables.readings import SHARP
from experiments.tables.rows import TRAINED, WITH_PARTS, rows_of

HARD, HALF = 1.0, 0.5
APART = "names", "shared"
"""not among all faults at once: names near each other, as those of LVIS are there; and errors of the embedding alone,
under which no answer would be left to be told from another"""
FRAMES = "kinds", "camouflage"
"""faults of the labels and of the pictures (options of the twins' writer), not of the vision"""
FAULTS = (*(field.name for field in dataclasses.fields(World)), *FRAMES)
_RULES = ("contrast", "apart")
READ = ("relevancy, threshold", *(f"{rule}, threshold{way}" for rule in _RULES for way in ("", ", all")))
READ += tuple(
    f"{rule}, {kind} silhouette{way}" for rule in _RULES for kind in ("strict", "lenient") for way in ("", SHARP)
)
QUICK_READ = (
    *("relevancy, threshold", "apart, threshold", "apart, threshold, all"),
    *("apart, strict silhouette", f"contrast, lenient silhouette{SHARP}"),
)
"""of a quick run: each rule and each way of choosing Gaussians once"""
READ_TRAINED = (*READ, fair.PUBLISHED, "one mask", "cosine, threshold")
"""of methods that train; with any of their own constants ("16 roots", "one mask", 0.98)"""
LEFT_OUT = "ours, outspoken views", WITH_PARTS
"""of `experiments.fair`: an older one of ours, and one that was not measured here yet"""
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
    scenes_trained: tuple[str, ...]
    """of `scenes`, and"""
    seeds_trained: tuple[int, ...]
    """of `seeds`: where methods that train are measured too."""
    quick: bool
    out: str


def worlds(only: tuple[str, ...], values: tuple[float, ...]) -> dict[tuple[str, float], tuple[str, dict]]:
    """(fault, how hard) -> (the level of a twin, options of its writer). ("none", 0) is the tables' own world,
    ("together", 1) all faults at once but those of APART."""
    found: dict[tuple[str, float], tuple[str, dict]] = {("none", 0.0): ("medium", {})}
    for fault, value in ((fault, value) for value in values for fault in only):
        if fault != "kinds" or value == HARD:
            if fault in FRAMES:
                found[fault, value] = "medium", {fault: value if fault == "camouflage" else True}
            else:
                found[fault, value] = f"medium+{fault}={value:g}", {}
    if set(only) == set(FAULTS) and HARD in values:
        every = "+".join(f"{field.name}=1" for field in dataclasses.fields(World) if field.name not in APART)
        found["together", HARD] = f"medium+{every}", {"kinds": True, "camouflage": HARD}
    return found


def plan_of(level: str, size: dict, asked: Asked, processes: int, trained: bool) -> Plan:
    """Every row that needs no training on every scene and seed of a world, or the others where they are asked for."""
    table = lerf.QUICK if asked.quick else lerf.PLAN
    data = table.data
    options = tuple({**dict(data.size), **size}.items())
    seeds = asked.seeds_trained if trained else tuple(dict.fromkeys((*asked.choosing, *asked.seeds)))
    scenes = asked.scenes_trained if trained else asked.scenes
    return dataclasses.replace(
        table,
        data=dataclasses.replace(data, seeds=seeds, scenes=data.scenes if asked.quick else scenes, size=options),
        methods=tuple(row for row in rows_of(points=False) if is_read(row, trained, asked.quick)),
        level=level,
        sweep=(),
        processes=processes,
        out=asked.out,
        cells=str(Path(asked.out) / "cells.jsonl"),
    )


def is_read(row: str, trained: bool, quick: bool = False) -> bool:
    """Whether a row of `experiments.fair` is one of these tables."""
    method, way = row.split(": ")
    if not trained:
        return way in (QUICK_READ if quick else READ) and method not in (*LEFT_OUT, *TRAINED)
    return method in TRAINED and fair.reading_of(row) in READ_TRAINED


def of_world(cells: list[dict], choosing: tuple[int, ...], seeds: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """Each method's figures on `seeds`, read as was best on the seeds `choosing`."""
    best = fair.chosen(cells, choosing, FIGURES)
    best = {method: rows for method, rows in best.items() if not method.endswith(fair.ONE_READING)}
    held = [cell for cell in cells if cell["seed"] in seeds]
    found = {}
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


def curves(found: dict[tuple[str, float], dict[str, dict[str, float]]], trained: dict):
    """mIoU over how hard each fault is, a line for each method; dashed, on their own scenes, for those that train."""
    from matplotlib.figure import Figure

    faults = [f for f in dict.fromkeys(fault for fault, _ in found) if f not in ("none", "together")]
    across = min(3, len(faults))
    figure = Figure(figsize=(3.4 * across, 2.6 * -(-len(faults) // across)))
    for n, fault in enumerate(faults):
        axes = figure.add_subplot(-(-len(faults) // across), across, n + 1, title=fault, ylim=(0, 1))
        hard = [0.0, *sorted(v for f, v in found if f == fault)]
        for method in found["none", 0.0]:
            axes.plot(hard, [found["none" if v == 0 else fault, v][method]["miou"] for v in hard], "o-", label=method)
        ends = [trained.get(name, {}) for name in (("none", 0.0), (fault, HARD))]
        for method in sorted(set(ends[0]) & set(ends[1]) - set(found["none", 0.0])):
            told = [end[method]["miou"] for end in ends]
            axes.plot([0.0, HARD], told, "s--", markersize=3, label=method)
        if n % across == 0:
            axes.set_ylabel("mIoU at alpha > 0.7")
        axes.set_xlabel("how hard")
    lines = {str(line.get_label()): line for axes in figure.axes for line in axes.lines}
    figure.tight_layout()
    figure.legend(lines.values(), lines, loc="upper left", bbox_to_anchor=(1, 1), fontsize=8)  # beside them
    return figure


def main(asked: Asked, processes: int) -> str:
    """The tables, written."""
    methods, found, trained = rows_of(points=False), {}, {}

    def filled(name: tuple[str, float], trained: bool) -> list[dict]:
        plan = plan_of(*worlds(asked.only, asked.values)[name], asked, processes, trained)
        with contextlib.suppress(SystemExit):  # of a helper, which has no table to write
            return fill(plan, methods, tell=lambda line: print(line, flush=True))
        return []

    for name in worlds(asked.only, asked.values):
        own = filled(name, trained=False)
        training = filled(name, trained=True) if asked.scenes_trained and name[1] in (0.0, HARD) else []
        if own:
            found[name] = of_world(own, asked.choosing, asked.seeds)
            print(name, found[name], flush=True)
        if training:
            here = [cell for cell in own if cell["scene"] in asked.scenes_trained]
            trained[name] = of_world(here, asked.choosing, asked.seeds_trained)
            trained[name] |= of_world(training, asked.seeds_trained, asked.seeds_trained)
    if not processes:
        return ""
    text = layout(found)
    if trained:
        where = f"{', '.join(asked.scenes_trained)}, seed {', '.join(map(str, asked.seeds_trained))}"
        text += f"\n\nWith the methods that train, at {where} alone:\n\n{layout(trained)}"
    metrics = {f"{fault} {value:g}": told for (fault, value), told in found.items()}
    metrics |= {f"{fault} {value:g}, with those that train": told for (fault, value), told in trained.items()}
    results.save(Path(asked.out), asked, metrics, text, curves(found, trained))
    print(text)
    return text


if __name__ == "__main__":
    parser = twins_parser("worlds", "one tiny scene, two faults")
    parser.add_argument("--choosing", nargs="+", type=int, default=[0], help="that readings are chosen on")
    parser.add_argument("--only", nargs="+", default=list(FAULTS), choices=FAULTS)
    parser.add_argument("--values", nargs="+", type=float, default=[HARD, HALF], help="how hard, 0 to 1")
    parser.add_argument("--scenes-trained", nargs="+", default=[], help="that methods which train are measured on too")
    parser.add_argument("--seeds-trained", nargs="+", type=int, default=[], help="and the seeds that they have there")
    given = parser.parse_args()
    seeds, choosing, only = tuple(given.seeds), tuple(given.choosing), tuple(given.only)
    if given.quick:
        seeds, choosing, only = (0,), (0,), ("parts", "kinds")
    values = (HARD,) if given.quick else tuple(given.values)
    there = tuple(given.scenes_trained), tuple(given.seeds_trained) or seeds[:1]
    out = results_folder(given, "worlds")
    asked = Asked(
        tuple(given.scenes), seeds, choosing, only, values, *there, given.quick, results_folder(given, "worlds")
    )
    main(asked, given.processes)
