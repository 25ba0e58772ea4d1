"""How many views of a region must be embedded: error against the seconds of a network.

    python -m experiments.crops [--model FOLDER]

The views are those that `jsecon.field.regions` chooses. Real words are those of `experiments.real_words` on given
masks, twins those of Table 1 with consensus, under simulated vision of three levels of noise. A crop costs what
`experiments.vision_speed` measured for SigLIP 2 on two cores. "5, scatter 0.2" takes five, and more of regions whose
views scatter, as a run does. Intervals are the middle 95 % of the mean difference to all views, under resampling of the
texts.
"""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np

from experiments import lerf, real_words, results
from experiments.baselines.evidence import unit
from experiments.tables import published
from experiments.tables.answers import Answers, Steps
from experiments.tables.association import Association, associated, overlaps
from experiments.tables.fill import Plan, fill
from experiments.tables.ours import ask_field, association, field_of
from experiments.tables.setting import Setting
from experiments.words import rules
from experiments.words.scenes import GIVEN, load_scene
from jsecon.field.regions import choose_crops, crop_geometry, views_needed
from jsecon.types import Regions

ALL = "all"
SCENES = ("replica_apartment_0", "apc_bin")
WAYS = ("jsecon: query_anchored", "jsecon: query_several")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    model: str = ""
    """As of `experiments.real_words`."""
    limits: tuple[str, ...] = ("3", "5", "8", "5, scatter 0.2", "5, scatter 0.1", ALL)
    """Views of a region."""
    seeds: tuple[int, ...] = (70,)
    """Of the twins."""
    twins: tuple[str, ...] = published.LERF_SCENES
    """Scenes of Table 1."""
    levels: tuple[str, ...] = ("low", "medium", "high")
    """Of the noise of the twins."""
    out: str = ""


def chosen_views(labels: np.ndarray, cameras, limit: str, crops: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(R, T) the views of each region that are embedded, given the crops of all views: region and view, embedding."""
    count, (most, *scatter) = int(labels.max()) + 1, limit.replace(ALL, str(len(labels))).split(", scatter ")
    geometry = crop_geometry(labels, cameras, count)
    chosen = choose_crops(*geometry, int(most))
    for tolerance in map(float, scatter):
        places, rows = crops
        first = chosen[places[:, 0], places[:, 1]]
        regions = Regions(np.zeros((count, rows.shape[1])), geometry[0], places[first], rows[first])
        chosen = choose_crops(*geometry, np.maximum(views_needed(regions, scatter=tolerance), int(most)))
    return chosen


def real_row(options: Options, name: str, limit: str) -> dict:
    """Crops and IoUs of a scene with real words."""
    scene = load_scene(name, GIVEN)
    _, region, view = scene.crops
    case = _case(options.model, name)
    views = chosen_views(scene.labels, scene.cameras, limit, (np.stack([region, view], 1), case.crops))
    regions = scene.regions(np.where(views[region, view][:, None], case.crops, 0.0))
    field = dataclasses.replace(case.field, regions=regions, votes=real_words.normalise_votes(scene.votes, regions))
    limited = dataclasses.replace(case, regions=regions, field=field)
    ious = {way: rules.ious(real_words.PRODUCT[way](limited), scene.truth, scene.asked).tolist() for way in WAYS}
    print(name, limit, {way: round(float(np.mean(own)), 4) for way, own in ious.items()}, flush=True)
    return {"crops": int(views.sum()), "ious": ious}


@functools.cache
def _case(model: str, name: str) -> real_words.Case:
    embedder = real_words.open_embedder(real_words.Options(model=model))
    return real_words.case_of(load_scene(name, GIVEN), embedder, real_words.VARIANTS[0])


def of_few_views(setting: Setting, steps: Steps, limit: str) -> Answers:
    """The row "ours, consensus" where the regions are embedded in few views."""
    found = association(setting, "consensus")
    views = chosen_views(found.labels, setting.evidence.cameras, limit, view_embeddings(setting, found.labels))
    shown = views[np.maximum(found.labels, 0), np.arange(len(found.labels))[:, None, None]]

    def embedded() -> Association:
        rows = associated(setting.levels, np.where(shown, found.labels, -1)).embeddings
        return dataclasses.replace(found, embeddings=rows)

    by = f"consensus, {limit} views"
    setting.shared.get(by, embedded)
    answers = ask_field(setting, field_of(setting, by=by, labels=found.labels), "votes", pieces=True)
    return dataclasses.replace(answers, beside={"crops": int(views.sum())})


def view_embeddings(setting: Setting, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 2) region and view, and (C, E) the embedding there: the mean of the masks that it shares pixels with."""
    places, rows = [], []
    for t, image in enumerate(labels):
        total = sum(overlaps(image, np.asarray(e.masks)[t], len(e.embeddings)) @ e.embeddings for e in setting.levels)
        shown = np.flatnonzero(total.any(1))
        places.append(np.stack([shown, np.full(len(shown), t)], 1))
        rows.append(unit(total[shown]))
    return np.concatenate(places), np.concatenate(rows)


def twin_rows(options: Options) -> dict[str, dict]:
    """Crops and IoUs of the twins by level and limit."""
    data = dataclasses.replace(lerf.PLAN.data, scenes=options.twins, seeds=options.seeds)
    methods = {limit: functools.partial(of_few_views, limit=limit) for limit in options.limits}
    found = {}
    for level in options.levels:
        rows = found[f"twins, {level} noise"] = {
            name: {"crops": 0, "ious": {"ours, consensus": []}} for name in methods
        }
        plan = Plan(data, tuple(methods), level=level, sweep=(), out=str(Path(options.out) / "run"))
        for cell in fill(plan, methods, tell=print):
            rows[cell["method"]]["crops"] += cell["crops"]
            rows[cell["method"]]["ious"]["ours, consensus"] += [np.mean(strict) for strict, _ in cell["texts"].values()]
    return found


def main(options: Options) -> dict:
    """Measures all limits, writes the results and returns them."""
    metrics = {name: {limit: real_row(options, name, limit) for limit in options.limits} for name in SCENES}
    metrics |= twin_rows(options)
    text = table(metrics)
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return metrics


def table(metrics: dict) -> str:
    """A row per data set, way of asking and limit."""
    speed = json.loads((results.HOME / "results" / "vision_speed" / "metrics.json").read_text())["seconds"]
    seconds, rows = min(speed["ViT-B-16-SigLIP2"]["crop"].values()), []
    for name, limits in metrics.items():
        for way in limits[ALL]["ious"]:
            every = np.array(limits[ALL]["ious"][way])
            for limit, row in limits.items():
                ious = np.array(row["ious"][way])
                low, high = rules.interval(ious - every)
                gain = f"{(ious - every).mean():+.3f} [{low:+.3f}, {high:+.3f}]" if limit != ALL else ""
                cost = f"{row['crops']}", f"{row['crops'] * seconds:.0f}"
                rows.append((name, way, limit, *cost, f"{ious.mean():.3f}", gain))
    return results.table(("data", "asked by", "views", "crops", "s", "mean IoU", "less all views"), rows)


if __name__ == "__main__":
    main(results.read_options(Options, "crops", __doc__))
