"""How many views of a region must be embedded: error against the seconds of a network.

    python -m experiments.crops [--model FOLDER]

The views are those that `jsecon.field.regions` chooses. Real words are those of `experiments.real_words` on given
masks, twins those of Table 1 with consensus, under simulated vision of three levels of noise. A crop costs what
`experiments.vision_speed` measured for SigLIP 2 on two cores. Intervals are the middle 95 % of the mean difference to
all views, under resampling of the texts.
"""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np

from experiments import lerf, real_words, results
from experiments.tables import published
from experiments.tables.answers import Answers, Steps
from experiments.tables.association import Association, associated
from experiments.tables.fill import Plan, fill
from experiments.tables.ours import ask_field, association, field_of
from experiments.tables.setting import Setting
from experiments.words import rules
from experiments.words.scenes import GIVEN, load_scene
from jsecon.field.regions import choose_crops, crop_geometry

ALL = 0
"""of the limits: every view is embedded"""
SCENES = ("replica_apartment_0", "apc_bin")
WAYS = ("jsecon: query_anchored", "jsecon: query_several")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    model: str = ""
    """As of `experiments.real_words`."""
    limits: tuple[int, ...] = (3, 5, 8, ALL)
    seeds: tuple[int, ...] = (70,)
    """Of the twins."""
    twins: tuple[str, ...] = published.LERF_SCENES
    """Scenes of Table 1."""
    levels: tuple[str, ...] = ("low", "medium", "high")
    """Of the noise of the twins."""
    out: str = ""


def chosen_views(labels: np.ndarray, cameras, limit: int) -> np.ndarray:
    """(R, T) the views of each region that are embedded."""
    pixels, cut, directions = crop_geometry(labels, cameras, int(labels.max()) + 1)
    return choose_crops(pixels, cut, directions, limit or len(labels))


def real_row(options: Options, name: str, limit: int) -> dict:
    """Crops and IoUs of a scene with real words."""
    scene = load_scene(name, GIVEN)
    _, region, view = scene.crops
    views = chosen_views(scene.labels, scene.cameras, limit)
    case = _case(options.model, name)
    regions = scene.regions(np.where(views[region, view][:, None], case.crops, 0.0))
    field = dataclasses.replace(case.field, regions=regions, votes=real_words.normalise_votes(scene.votes, regions))
    limited = dataclasses.replace(case, regions=regions, field=field)
    ious = {way: rules.ious(real_words.PRODUCT[way](limited), scene.truth, scene.asked).tolist() for way in WAYS}
    print(name, limit or "all", {way: round(float(np.mean(own)), 4) for way, own in ious.items()}, flush=True)
    return {"crops": int(views.sum()), "ious": ious}


@functools.cache
def _case(model: str, name: str) -> real_words.Case:
    embedder = real_words.open_embedder(real_words.Options(model=model))
    return real_words.case_of(load_scene(name, GIVEN), embedder, real_words.VARIANTS[0])


def of_few_views(setting: Setting, steps: Steps, limit: int) -> Answers:
    """The row "ours, consensus" where the regions are embedded in few views."""
    found = association(setting, "consensus")
    views = chosen_views(found.labels, setting.evidence.cameras, limit)
    shown = views[np.maximum(found.labels, 0), np.arange(len(found.labels))[:, None, None]]

    def embedded() -> Association:
        rows = associated(setting.levels, np.where(shown, found.labels, -1)).embeddings
        return dataclasses.replace(found, embeddings=rows)

    by = f"consensus, {limit} views"
    setting.shared.get(by, embedded)
    answers = ask_field(setting, field_of(setting, by=by, labels=found.labels), "votes", pieces=True)
    return dataclasses.replace(answers, beside={"crops": int(views.sum())})


def twin_rows(options: Options) -> dict[str, dict]:
    """Crops and IoUs of the twins by level and limit."""
    data = dataclasses.replace(lerf.PLAN.data, scenes=options.twins, seeds=options.seeds)
    methods = {str(limit): functools.partial(of_few_views, limit=limit) for limit in options.limits}
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
    metrics = {name: {str(limit): real_row(options, name, limit) for limit in options.limits} for name in SCENES}
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
        for way in limits[str(ALL)]["ious"]:
            every = np.array(limits[str(ALL)]["ious"][way])
            for limit, row in limits.items():
                ious = np.array(row["ious"][way])
                low, high = rules.interval(ious - every)
                gain = f"{(ious - every).mean():+.3f} [{low:+.3f}, {high:+.3f}]" if limit != str(ALL) else ""
                cost = f"{row['crops']}", f"{row['crops'] * seconds:.0f}"
                rows.append((name, way, "all" if limit == str(ALL) else limit, *cost, f"{ious.mean():.3f}", gain))
    return results.table(("data", "asked by", "views", "crops", "s", "mean IoU", "less all views"), rows)


if __name__ == "__main__":
    main(results.read_options(Options, "crops", __doc__))
