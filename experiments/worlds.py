"""Worlds that fight back: every fault that real vision has and the tables' does not, swept alone and together.

    python -m experiments.worlds [--scenes-trained figurines] [--seeds-trained 10] [--quick] [--processes N]

Twins of LERF at medium noise. The rows are those of `experiments.fair` that need no training, each read as its paper
does (by the relevancy) and by the centred cosine or "contrast" with a threshold or an ascent, for > 0.7 or > 10/255
(the baselines' of linear and of sharp shares; ours of one region, and of all that answer): the best in that world on
the seeds `--choosing`, for each figure its own. None may refuse a text. Methods that train take minutes: those
of `--scenes-trained` and `--seeds-trained` have them too, in tables of their own beside all the others there; a method
that trains is read as is best on those very seeds, so that its figure is the most that a reading could give.
"""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np

from experiments import fair, lerf, results
from experiments.simulated_vision.worlds import World
from experiments.tables.fill import Plan, fill
from experiments.tables.readings import SHARP
from experiments.tables.rows import TRAINED, rows_of
from jsecon.process import cores

HARD, HALF = 1.0, 0.5
APART = "names", "shared"
"""not among all faults at once: names near each other, as those of LVIS are there; and errors of the embedding alone,
under which no answer would be left to be told from another"""
FRAMES = "kinds", "camouflage"
"""faults of the labels and of the pictures (options of the twins' writer), not of the vision"""
FAULTS = (*(field.name for field in dataclasses.fields(World)), *FRAMES)
_RULES = ("centred", "contrast")
READ = ("relevancy, threshold", *(f"{rule}, threshold{way}" for rule in _RULES for way in ("", ", all")))
READ += tuple(
    f"{rule}, {kind} silhouette{way}" for rule in _RULES for kind in ("strict", "lenient") for way in ("", SHARP)
)
QUICK_READ = (
    *("relevancy, threshold", "contrast, threshold", "contrast, threshold, all"),
    *("contrast, strict silhouette", f"centred, lenient silhouette{SHARP}"),
)
"""of a quick run: each rule and each way of choosing Gaussians once"""
READ_TRAINED = (*READ, fair.PUBLISHED, "one mask", "cosine, threshold")
"""of methods that train; with any of their own constants ("16 roots", "one mask", 0.98)"""
FIGURES = ("miou", "miou_vala")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    scenes: tuple[str, ...] = ("figurines", "teatime")
    seeds: tuple[int, ...] = (10, 11)
    """Seeds to report."""
    choosing: tuple[int, ...] = (0,)
    """Seeds that readings are chosen on."""
    only: tuple[str, ...] = FAULTS
    values: tuple[float, ...] = (HARD, HALF)
    """How hard the faults are, 0 to 1."""
    scenes_trained: tuple[str, ...] = ()
    """Scenes on which methods that train are measured too."""
    seeds_trained: tuple[int, ...] = ()
    """Seeds that they have there; empty: the first of `seeds`."""
    quick: bool = False
    """Run one tiny scene with two faults."""
    out: str = ""
    processes: int = cores()
    """Number of processes that share the settings."""


QUICK = {"seeds": (0,), "choosing": (0,), "only": ("parts", "kinds"), "values": (HARD,)}


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


def plan_of(level: str, changes: dict, options: Options, trained: bool) -> Plan:
    """Every row that needs no training on every scene and seed of a world, or the others where they are asked for."""
    table = lerf.QUICK if options.quick else lerf.PLAN
    data, size = table.data, tuple({**dict(table.data.size), **changes}.items())
    seeds = options.seeds_trained if trained else tuple(dict.fromkeys((*options.choosing, *options.seeds)))
    scenes = options.scenes_trained if trained else options.scenes
    return dataclasses.replace(
        table,
        data=dataclasses.replace(data, seeds=seeds, scenes=data.scenes if options.quick else scenes, size=size),
        methods=tuple(row for row in rows_of(points=False) if is_read(row, trained, options.quick)),
        level=level,
        sweep=(),
        processes=options.processes,
        out=options.out,
        cells=str(Path(options.out) / "cells.jsonl"),
    )


def is_read(row: str, trained: bool, quick: bool = False) -> bool:
    """Whether a row of `experiments.fair` is one of these tables."""
    method, way = row.split(": ")
    if not trained:
        return way in (QUICK_READ if quick else READ) and method not in TRAINED
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


def main(options: Options) -> str:
    """The tables, written."""
    options = dataclasses.replace(options, seeds_trained=options.seeds_trained or options.seeds[:1])
    methods, found, trained = rows_of(points=False), {}, {}

    def filled(name: tuple[str, float], trained: bool) -> list[dict]:
        plan = plan_of(*worlds(options.only, options.values)[name], options, trained)
        with contextlib.suppress(SystemExit):  # of a helper, which has no table to write
            return fill(plan, methods, tell=lambda line: print(line, flush=True))
        return []

    for name in worlds(options.only, options.values):
        own = filled(name, trained=False)
        training = filled(name, trained=True) if options.scenes_trained and name[1] in (0.0, HARD) else []
        if own:
            found[name] = of_world(own, options.choosing, options.seeds)
            print(name, found[name], flush=True)
        if training:
            here = [cell for cell in own if cell["scene"] in options.scenes_trained]
            trained[name] = of_world(here, options.choosing, options.seeds_trained)
            trained[name] |= of_world(training, options.seeds_trained, options.seeds_trained)
    if not options.processes:
        return ""
    text = layout(found)
    if trained:
        where = f"{', '.join(options.scenes_trained)}, seed {', '.join(map(str, options.seeds_trained))}"
        text += f"\n\nWith the methods that train, at {where} alone:\n\n{layout(trained)}"
    metrics = {f"{fault} {value:g}": told for (fault, value), told in found.items()}
    metrics |= {f"{fault} {value:g}, with those that train": told for (fault, value), told in trained.items()}
    results.save(Path(options.out), options, metrics, text, curves(found, trained))
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "worlds", __doc__, QUICK))
