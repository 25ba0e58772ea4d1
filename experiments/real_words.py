"""Real words on real pictures: which rule finds what a text names, where embeddings err as real ones do?

    python -m experiments.real_words [--out FOLDER] [--cache FOLDER]

The embedder is ConSE (`experiments.words.conse`): a labeller of 631 classes, whose probabilities weight the text
vectors of its classes' names. Both lie in ../shared/words, and so do the named points. The scenes
(`experiments.words.scenes`) are replica_apartment_0 (15 classes), apc_bin (four things) and bonsai (its nouns). Crops
and rules are chosen on apc_bin and bonsai, and reported on replica.

Truth at the points: T1, the name of the nearest named point within 0.10 m; T2, the name of the object that the views
whose masks did not vote show there. IoU of the Gaussians selected for a text, over those with a truth, mean over the
texts. Rendered: the selected Gaussians alone, alpha > 0.7, in up to 20 of those views. The error has three parts:

    representation  the true Gaussians, rendered (at the points nothing is lost by T2)
    lifting         the regions whose true name is the text's
    recognition     the regions that a rule finds by the text
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from experiments import results
from experiments.rivals.lifting import READOUT, smoothed
from experiments.words import rules
from experiments.words.absent import absent_names
from experiments.words.conse import WORDS, Conse, Crop, Labeller, TextVectors, class_weights, conse
from experiments.words.scenes import (
    DEFAULT,
    GIVEN,
    RIVALS,
    Sources,
    WordScene,
    load_scene,
    rival_weights,
    scores_of,
    things_of,
)
from jsecon.evaluate.metrics import iou
from jsecon.language.shares import finish_votes
from jsecon.query.anchored import query_anchored
from jsecon.query.classes import query_classes
from jsecon.query.masks import ALPHA_THRESHOLD, render_selection
from jsecon.query.retrieval import CONTRAST_THRESHOLD, NEARNESS, RETRIEVAL_THRESHOLD
from jsecon.query.several import query_several
from jsecon.types import LanguageField, Regions

CROPS = tuple(
    Crop(margin, shape, surroundings)
    for margin in (0.0, 0.05, 0.1, 0.3)
    for shape in ("stretched", "square", "padded")
    for surroundings in ("kept", "greyed", "masked")
)
CHOOSING = (("apc_bin", GIVEN), ("apc_bin", DEFAULT), ("bonsai", DEFAULT))
"""what crops and rules are chosen on"""
REPORTED = (("replica_apartment_0", GIVEN), ("replica_apartment_0", DEFAULT))
CLASS_LIST = "class list"
"""of the ways: each region under its best text"""
GRID = np.linspace(-0.2, 1, 121)
"""thresholds among which the best is looked for"""


@dataclasses.dataclass(frozen=True)
class Options(Sources):
    """What the experiment can vary."""

    labeller: str = str(WORDS / "object_labeler.tflite")
    vectors: str = str(WORDS / "minilm_vectors.npz")
    model: str = ""
    """folder of the model that made the vectors, for texts that are not among them"""
    cache: str = str(results.HOME / "results" / "real_words" / "run")
    """folder of what takes long: scenes, votes and the labeller's scores"""
    out: str = str(results.HOME / "results" / "real_words")


def sources_of(options: Options) -> Sources:
    """The options' data alone."""
    return Sources(*(getattr(options, own.name) for own in dataclasses.fields(Sources)))


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene, its regions by one embedder, and texts."""

    scene: WordScene
    crops: np.ndarray
    """(C, E) embeddings of the crops."""
    regions: Regions
    texts: np.ndarray
    """(Q, E)"""
    canonical: np.ndarray
    field: LanguageField


def embedder_of(options: Options, crop: Crop | None = None, weights: str = "probability") -> Conse:
    """ConSE of the options' files."""
    texts = TextVectors(options.vectors, options.model or None)
    return Conse(Labeller(options.labeller), texts, crop=crop or Crop(), weights=weights)


def case_of(options: Options, scene: WordScene, embedder: Conse) -> Case:
    """A scene with the embeddings of `embedder`, as a field that jsecon's queries take."""
    found = class_weights(scores_of(options.cache, scene, embedder, sources_of(options)), embedder.weights)
    crops = conse(found, embedder.class_vectors, top=embedder.top)
    regions = scene.regions(crops)
    count, regions_count = scene.gaussians.count, regions.count
    field = LanguageField(
        gaussians=scene.gaussians,
        codes=np.zeros((count, 1), np.float32),
        votes=finish_votes(jax.tree.map(jnp.asarray, scene.votes), regions),
        regions=regions,
        region_codes=np.zeros((regions_count, 1), np.float32),
        autoencoder=None,
        cameras=scene.cameras,
        canonical=embedder.canonical,
        to_source=np.eye(4),
        embedder=embedder.name,
    )
    return Case(scene, crops, regions, embedder.embed_text(list(scene.texts)), embedder.canonical, field)


Chooser = Callable[[Case], np.ndarray]
"""(Q, N) bool of a case"""


def _by_regions(kind: str, way: str) -> Chooser:
    """A rule of `experiments.words.rules`: scores of regions, and which of them a text takes. It refuses nothing."""

    def choose(case: Case) -> np.ndarray:
        table = rules.scores(case.regions.embeddings, case.texts, case.canonical, case.regions.pixels, kind)
        chosen = {
            "best region": lambda: rules.best_of(table),
            "all near": lambda: rules.near_best(table, NEARNESS),
            CLASS_LIST: lambda: rules.best_text(table),
            f"{CLASS_LIST}, standardised": lambda: rules.best_text(rules.standardised(table)),
        }[way]()
        return rules.selected(case.field.votes, chosen)

    return choose


def _anchored(case: Case) -> np.ndarray:
    return np.stack([np.asarray(query_anchored(case.field, jnp.asarray(text)).mask) for text in case.texts])


def _several(case: Case) -> np.ndarray:
    return np.stack([np.asarray(query_several(case.field, jnp.asarray(text)[None]).mask) for text in case.texts])


def _classes(case: Case) -> np.ndarray:
    label = np.asarray(query_classes(case.field, jnp.asarray(case.texts))[0])
    return label == np.arange(len(case.texts))[:, None]


PRODUCT: dict[str, Chooser] = {
    "jsecon: query_anchored": _anchored,
    "jsecon: query_several": _several,
    "jsecon: query_classes": _classes,
}
"""as the library has them, with its thresholds"""
WAYS = ("best region", "all near", CLASS_LIST, f"{CLASS_LIST}, standardised")
RULES: dict[str, Chooser] = {f"{kind}, {way}": _by_regions(kind, way) for kind in rules.SCORES for way in WAYS}
ROWS = PRODUCT | RULES


def features_of(case: Case, weights: sparse.csr_matrix) -> np.ndarray:
    """(N, E) unit features of the Gaussians by the weights (N, C) of a method; zero where no mask holds one."""
    total = np.asarray(weights @ case.crops, np.float64)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), 0.0).astype(np.float32)


def alone(case: Case, weights: sparse.csr_matrix) -> dict[str, np.ndarray]:
    """reading -> (Q,) IoUs by T2 of each Gaussian compared with the texts alone: at thresholds that are fixed, and at
    those that are best on this very scene."""
    features, truth, asked = features_of(case, weights), case.scene.truth["T2"], case.scene.asked
    cosine = rules.point_scores(features, case.texts, case.canonical, "cosine")
    relevancy = rules.point_scores(features, case.texts, case.canonical, "relevancy")
    known = np.where(np.isfinite(relevancy), relevancy, np.nan)
    smooth = np.stack([smoothed(case.scene.gaussians.means, row) for row in known])
    return {
        f"relevancy, smoothed, {READOUT}": rules.ious(smooth > READOUT, truth, asked),
        "relevancy 0.5": rules.ious(relevancy >= 0.5, truth, asked),
        f"cosine {RETRIEVAL_THRESHOLD}": rules.ious(cosine >= RETRIEVAL_THRESHOLD, truth, asked),
        CLASS_LIST: rules.ious(rules.best_text(cosine), truth, asked),
        f"{CLASS_LIST}, standardised": rules.ious(rules.best_text(rules.standardised(cosine)), truth, asked),
        "cosine, best threshold": rules.best_threshold(cosine, truth, asked, GRID)[1],
        "relevancy, smoothed, best threshold": rules.best_threshold(smooth, truth, asked, GRID)[1],
    }


FIXED = (f"relevancy, smoothed, {READOUT}", "relevancy 0.5", f"cosine {RETRIEVAL_THRESHOLD}")
"""of `alone`: thresholds of others and of the paper"""


def true_regions(scene: WordScene) -> np.ndarray:
    """(Q, R) the regions whose true name is the text."""
    return scene.region_names[None] == scene.asked[:, None]


def true_gaussians(scene: WordScene) -> np.ndarray:
    """(Q, N) by T2."""
    return scene.truth["T2"][None] == scene.asked[:, None]


def rendered(scene: WordScene, chosen: np.ndarray) -> np.ndarray:
    """(Q,) IoU of each text's Gaussians rendered alone with its outlines, mean over the judged views that show it."""
    gaussians, judged = jax.tree.map(jnp.asarray, (scene.gaussians, scene.judged))
    found = np.full(len(scene.asked), np.nan)
    for q, name in enumerate(scene.asked):
        rows = []
        for t in np.flatnonzero((scene.outlines == name).any((1, 2))):
            alpha = np.asarray(render_selection(gaussians, judged[int(t)], jnp.asarray(chosen[q])).alpha)
            counted = scene.outlines[t] >= 0
            rows.append(float(iou((alpha > ALPHA_THRESHOLD) & counted, scene.outlines[t] == name)))
        if rows:
            found[q] = np.mean(rows)
    return found


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


def compare_crops(options: Options, embedders: Callable[[Crop, str], Conse]) -> list[dict]:
    """A row for each of CROPS: its quality on each scene."""
    pictures = {}
    for name, masks in (*CHOOSING[::2], REPORTED[0]):
        scene = load_scene(options.cache, name, masks, sources_of(options))
        frames, things, names = things_of(options.cache, name, masks, sources_of(options))
        place = np.full(len(scene.names) + 2, -1)
        place[scene.asked] = np.arange(len(scene.asked))
        pictures[name] = scene, (frames, things, place[names])
    rows = []
    for crop in CROPS:
        embedder = embedders(crop, "probability")
        own = {
            name: crop_quality(embedder, given, embedder.embed_text(list(scene.texts)))
            for name, (scene, given) in pictures.items()
        }
        rows.append({"crop": dataclasses.asdict(crop), "scenes": own})
    return rows


def lifting_and_rendering(case: Case, chosen: np.ndarray) -> list[dict]:
    """A row for each part of the error: IoUs at the points by each truth, and rendered."""
    scene = case.scene
    given = {
        "representation": true_gaussians(scene),
        "lifting": rules.selected(case.field.votes, true_regions(scene)),
        "recognition": chosen,
    }
    rows = []
    for part, own in given.items():
        at_points = {name: rules.ious(own, truth, scene.asked).tolist() for name, truth in scene.truth.items()}
        rows.append({"part": part, **at_points, "rendered": rendered(scene, own).tolist()})
    return rows


def refusal(case: Case, embedder: Conse) -> dict[str, Any]:
    """How the best region's score tells present names from absent ones: the area under the curve, and what the
    library's thresholds refuse and keep."""
    scene = case.scene
    absent = absent_names(embedder.texts, scene.name, scene.names)
    vectors = embedder.embed_text(list(absent))
    found: dict[str, Any] = {"absent": len(absent)}
    for kind, least in (("cosine", RETRIEVAL_THRESHOLD), ("contrast", CONTRAST_THRESHOLD)):
        how = case.canonical, case.regions.pixels, kind
        there = rules.scores(case.regions.embeddings, case.texts, *how).max(axis=1)
        not_there = rules.scores(case.regions.embeddings, vectors, *how).max(axis=1)
        found[kind] = {
            "auc": rules.auc(there, not_there),
            "kept": float((there >= least).mean()),
            "refused": float((not_there < least).mean()),
        }
    return found


def _mean(values: Any) -> str:
    """A mean with the middle 95 % under resampling."""
    low, high = rules.interval(np.asarray(values))
    return f"{np.mean(values):.3f} ({low:.3f} to {high:.3f})"


def main(options: Options = Options(), tell: Callable[[str], None] = print) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    first = embedder_of(options)

    def embedder(crop: Crop, weights: str) -> Conse:
        return Conse(first.labeller, first.texts, crop=crop or Crop(), weights=weights)

    crops = compare_crops(options, embedder)
    chosen_on = tuple(name for name, _ in CHOOSING[::2])
    quality = [np.mean([row["scenes"][name]["words"] for name in chosen_on]) for row in crops]
    best_crop = Crop(**crops[int(np.argmax(quality))]["crop"])
    metrics: dict[str, Any] = {"crops": crops, "best_crop": dataclasses.asdict(best_crop), "cases": {}}
    text = ["Crops, by outlines: share of all words less similar than the own name / own name first of the scene's.\n"]
    scenes = list(crops[0]["scenes"])
    text += [
        results.table(
            ("margin", "shape", "surroundings", *scenes),
            [
                (
                    *row["crop"].values(),
                    *(f"{row['scenes'][s]['words']:.3f} / {row['scenes'][s]['first']:.2f}" for s in scenes),
                )
                for row in crops
            ],
        )
    ]
    tell("\n".join(text))
    cases: dict[tuple[str, str, str], Case] = {}
    for name, masks in (*CHOOSING, *REPORTED):
        scene = load_scene(options.cache, name, masks, sources_of(options))
        for weights in ("probability", "log-odds"):
            case = case_of(options, scene, embedder(Crop(), weights))
            cases[name, masks, weights] = case
            points = {row: choose(case) for row, choose in ROWS.items()}
            truths = {
                truth: {row: rules.ious(own, values, scene.asked).tolist() for row, own in points.items()}
                for truth, values in scene.truth.items()
            }
            cast = {method: rival_weights(options.cache, scene, method, sources_of(options)) for method in RIVALS}
            rivals = {method: {k: v.tolist() for k, v in alone(case, own).items()} for method, own in cast.items()}
            refused = refusal(case, first)
            metrics["cases"][f"{name}, {masks}, {weights}"] = {"points": truths, "alone": rivals, "refusal": refused}
            tell(f"{name} {masks} {weights} done")
    write(options, metrics, cases, text, tell)
    return metrics


def write(options: Options, metrics: dict, cases: dict, text: list[str], tell: Callable[[str], None]) -> None:
    """The rule that is best where rules are chosen, the parts of the error with it, and all tables."""
    told = {f"{name}, {masks}": (name, masks) for name, masks in (*CHOOSING, *REPORTED)}
    rows, score = [], {}
    for weights in ("probability", "log-odds"):
        for row in ROWS:
            ious = {k: metrics["cases"][f"{k}, {weights}"]["points"]["T2"][row] for k in told}
            score[row, weights] = np.mean([np.mean(ious[f"{n}, {m}"]) for n, m in CHOOSING])
            t1 = metrics["cases"][f"replica_apartment_0, given, {weights}"]["points"]["T1"][row]
            rows.append((row, weights, score[row, weights], *(_mean(v) for v in ious.values()), _mean(t1)))
    best = max((key for key in score if key[0] in RULES), key=lambda key: score[key])
    metrics["best_rule"] = best
    text.append("\nRules, IoU at the points by T2, mean over the texts (95 % under resampling of the texts).\n")
    text.append(results.table(("rule", "weights", "mean where chosen", *told, "replica, given, T1"), rows))
    rows = []
    for method in metrics["cases"]["bonsai, default, probability"]["alone"]:
        for reading in metrics["cases"]["bonsai, default, probability"]["alone"][method]:
            for weights in ("probability", "log-odds"):
                own = [_mean(metrics["cases"][f"{k}, {weights}"]["alone"][method][reading]) for k in told]
                rows.append((method, reading, weights, *own))
    text.append("\nEach Gaussian alone, IoU at the points by T2.\n")
    text.append(results.table(("method", "reading", "weights", *told), rows))
    metrics["parts"], rows = {}, []
    for k, (name, masks) in told.items():
        case = cases[name, masks, best[1]]
        metrics["parts"][k] = lifting_and_rendering(case, RULES[best[0]](case))
        for own in metrics["parts"][k]:
            drawn = [v for v in own["rendered"] if np.isfinite(v)]
            rows.append((k, own["part"], _mean(own["T2"]), _mean(own["T1"]) if "T1" in own else "", _mean(drawn)))
        tell(f"{k} rendered")
    text.append(f"\nThe error in three parts; recognition by the rule that is best where rules are chosen: {best}.\n")
    text.append(results.table(("scene", "part", "T2", "T1", "rendered"), rows))
    rows = []
    for k in told:
        for weights in ("probability", "log-odds"):
            own = metrics["cases"][f"{k}, {weights}"]["refusal"]
            for kind in ("cosine", "contrast"):
                figures = (own[kind][key] for key in ("auc", "kept", "refused"))
                rows.append((k, weights, kind, own["absent"], *figures))
    text.append("\nPresent against absent names, by the best region's score, with the library's thresholds.\n")
    text.append(results.table(("scene", "weights", "score", "absent", "AUC", "kept", "refused"), rows))
    text.append("\n" + "\n".join(acceptance(metrics)))
    results.save(Path(options.out), options, metrics, "\n".join(text))
    tell("\n".join(text))


def acceptance(metrics: dict) -> list[str]:
    """What the library must reach, a line each."""
    parts, (rule, weights) = metrics["parts"], metrics["best_rule"]
    part = lambda k, name: float(np.mean(next(row for row in parts[k] if row["part"] == name)["T2"]))
    given, default = "replica_apartment_0, given", "replica_apartment_0, default"
    fixed = {
        f"{method}, {reading}": float(np.mean(own[reading]))
        for method, own in metrics["cases"][f"{given}, {weights}"]["alone"].items()
        for reading in FIXED
    }
    best = max(fixed, key=fixed.__getitem__)
    real = part(given, "recognition")
    return [
        f"(a) replica, given masks, true names, T2: {part(given, 'lifting'):.3f} (0.75)",
        f"(b) the same, real words, {rule}, {weights}: {real:.3f} (0.30); "
        f"above {best}: {real - fixed[best]:.3f} (0.10)",
        f"(c) default masks, true names: {part(default, 'lifting'):.3f} (0.42); real words: "
        f"{part(default, 'recognition'):.3f} (0.18)",
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for option in dataclasses.fields(Options):
        parser.add_argument(f"--{option.name.replace('_', '-')}", default=option.default)
    main(Options(**vars(parser.parse_args())))
