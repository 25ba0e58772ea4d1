"""All rows of the fair tables, "method: reading": every method as published, and by the readings of `tables.readings`.

What a method trains is trained once a setting and read often. Baselines whose papers give constants for other data than
LERF have a row for each.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.baselines import lifting
from experiments.baselines.gaussian_grouping import query_gaussian_grouping
from experiments.tables.answers import Answers, Method, Steps, by_selection
from experiments.tables.methods import (
    METHODS,
    by_features,
    by_leaves,
    gaussian_grouping_of,
    langsplat_of,
    opengaussian_of,
)
from experiments.tables.neighbours import nearest_neighbours
from experiments.tables.ours import ask_field, field_of, paper_field
from experiments.tables.readings import CHOOSERS, RULES, SHARP, SHARPENED, as_share, chosen_by, read, scores
from experiments.tables.setting import Setting
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.query.outliers import remove_outliers
from jsecon.query.rules import RETRIEVALS
from jsecon.types import Selection

NO_REFUSAL = -1.0
"""below every similarity"""
WAYS = {"votes": "", "all": ", all"}
"""of asking jsecon's regions: the one that answers best with its pieces, all that answer"""
OURS = {"ours, tracks": "tracks", "ours, consensus": "consensus"}
CENTRES: dict[str, dict[str, float]] = {
    "": {},
    ", centre 0.5": {"centre": 0.5},
    ", centre": {"centre": 1.0},
    ", centre, agreement 0.5": {"centre": 1.0, "agreement": 0.5},
    ", centre, agreement 0.6": {"centre": 1.0, "agreement": 0.6},
}
"""how much the pixel of a Gaussian's centre counts, where points are judged, and how far views must then agree"""
EVENED: dict[str, dict[str, Any]] = {
    ", evened": {"even": True},
    ", centre": {"centre": 1.0},
    ", half centre, evened": {"centre": 0.5, "even": True},
    ", centre, evened": {"centre": 1.0, "even": True},
}
"""where silhouettes are judged: the same, and shares evened out over neighbours"""
GATES: dict[str, dict[str, float]] = {
    "": {},
    "ScanNet's gate, ": {"mass": 0.9, "least": 0.01},
    "no quantile, ": {"quantile": 0.0},
}
"""VALA's constants: those of LERF, those of ScanNet, and without the quantile that points of one size hardly pass"""
CODEBOOKS: dict[str, dict[str, Any]] = {
    "": {},
    "16 roots, ": {"roots": 16},
    "ScanNet's codebook, ": {"leaves": 5, "position_weight": 1.0},
}
"""OpenGaussian's constants: those of LERF, fewer roots, as rooms of a dozen things want, and those of ScanNet"""
CODE_THRESHOLDS = (0.9, 0.95, 0.98)
"""of the paper's path on the cosine of 3-d codes: as published, and above"""
NEARLY = (0.9, 1.0)
"""Gaussian Grouping: the first view's masks that are nearly as similar as the best, or that one alone"""
TRAINED = ("LangSplat-m", "Gaussian Grouping-m", "OpenGaussian", "the paper's path")
"""methods that train, each for tens of seconds a setting"""
_ASCENTS = (
    ("centred", "silhouette"),
    ("centred", "strict silhouette"),
    ("centred", "lenient silhouette"),
    ("relevancy", "lenient silhouette"),
    ("centred", f"strict silhouette{SHARP}"),
    ("centred", f"lenient silhouette{SHARP}"),
)
"""readings by the expected IoU that trained features have, beside a threshold by every rule"""
_PROBABILITY = 0.3
"""of Gaussian Grouping's ids, from which a Gaussian is selected"""


def reading(key: Any, features: Callable[[Setting, Steps], Any], rule: str, chooser: str) -> Method:
    """The row of features, of each level or of one, that are made once a setting, by `key`."""
    return lambda setting, steps: read(
        setting, setting.shared.get(key, lambda: features(setting, steps)), rule, chooser
    )


def own(
    association: str,
    retrieval: str,
    chooser: str,
    way: str = "votes",
    even: bool = False,
    **regions: float,
) -> Method:
    """jsecon's row of an association's regions, which `regions` are the options of; `way` as for `ask_field`;
    `even`: shares are evened out over neighbours before they are cut."""

    def row(setting: Setting, steps: Steps) -> Answers:
        field = field_of(setting, by=association, **regions)
        options = {"retrieval": retrieval, "min_score": NO_REFUSAL, "pieces": True}
        answers = ask_field(setting, field, way, clean=chooser == "threshold" and not even, **options)
        answers = _evened(setting, answers, clean=chooser == "threshold") if even else answers
        return _chosen(setting, answers, chooser, None)

    return row


def _evened(setting: Setting, answers: Answers, *, clean: bool) -> Answers:
    means = np.asarray(setting.evidence.gaussians.means)
    near = jnp.asarray(setting.shared.get("neighbours", lambda: nearest_neighbours(means)))

    def select(k: int) -> Selection | None:
        found = answers.select(k)
        if found is None:
            return None
        share = jnp.asarray(found.similarity, jnp.float32)
        share = 0.5 * (share + jnp.mean(share[near], axis=1))
        mask = np.asarray(share >= SHARE_THRESHOLD)
        mask = remove_outliers(means, mask, keep="largest") if clean else mask
        return dataclasses.replace(found, mask=jnp.asarray(mask), similarity=share)

    return dataclasses.replace(answers, select=select)


def _chosen(setting: Setting, answers: Answers, chooser: str, cut: float | None) -> Answers:
    """Answers whose Gaussians are chosen anew, from similarities cut at `cut`, or that are shares (None)."""

    def select(k: int) -> Selection | None:
        found = answers.select(k)
        if found is None or chooser == "threshold":
            return found
        similarity = np.asarray(found.similarity, np.float32)
        share = similarity if cut is None else as_share(similarity, cut, sharp=chooser.endswith(SHARP))
        return chosen_by(setting, chooser, found, share)

    return dataclasses.replace(answers, select=select)


def _langsplat_row(rule: str, chooser: str) -> Method:
    def row(setting: Setting, steps: Steps) -> Answers:
        def train():
            return [langsplat_of(setting, setting.evidence, steps).features()]

        features = setting.shared.get("LangSplat-m", train)
        return read(setting, features, rule, chooser) if rule else by_features(setting, features[0], relevancy=False)

    return row


def _opengaussian_row(codebook: str, rule: str, chooser: str) -> Method:
    def row(setting: Setting, steps: Steps) -> Answers:
        model = opengaussian_of(setting, steps, **CODEBOOKS[codebook])
        if not rule:
            return by_leaves(setting, model)
        return read(setting, [np.asarray(model.leaf_features)[np.asarray(model.leaf_of)]], rule, chooser)

    return row


def _grouping_row(nearly: float, rule: str, chooser: str) -> Method:
    """Gaussian Grouping, the first view's masks found by a rule; by its own ("") they may be none."""

    def row(setting: Setting, steps: Steps) -> Answers:
        model = setting.shared.get("Gaussian Grouping-m", lambda: gaussian_grouping_of(setting, steps))
        evidence, canonical = setting.evidence, jnp.asarray(setting.canonical_phrases)
        first = np.asarray(evidence.embeddings)[np.asarray(evidence.frame) == 0]
        table = scores(setting, first, rule) if rule and len(first) else None

        def ask(k: int) -> Selection:
            text, similarity = jnp.asarray(setting.texts[k]), None if table is None else table[k]
            return query_gaussian_grouping(model, evidence, text, canonical, nearly=nearly, similarity=similarity)

        return by_selection(setting, _chosen(setting, by_selection(setting, ask), chooser, _PROBABILITY).select)

    return row


def _paper_row(retrieval: str, threshold: float, chooser: str) -> Method:
    def row(setting: Setting, steps: Steps) -> Answers:
        field = paper_field(setting, steps)
        options = {"retrieval": retrieval, "threshold": threshold, "min_score": NO_REFUSAL}
        answers = ask_field(setting, field, "code", clean=chooser == "threshold", **options)
        return by_selection(setting, _chosen(setting, answers, chooser, threshold).select)

    return row


def _lifted(train: Callable[..., lifting.Lifted], **how: float) -> Callable[[Setting, Steps], Any]:
    return lambda setting, steps: [train(evidence, **how).features for evidence in setting.levels]


def rows_of(points: bool) -> dict[str, Method]:
    """All rows, by name, "method: reading". Where `points` are judged, not silhouettes, there is nothing to choose for
    a text, as each point gets a class; ours then differ by how much the centre's pixel counts."""
    choosers = ("threshold",) if points else tuple(CHOOSERS)
    every = tuple((rule, chooser) for rule in RULES for chooser in choosers)
    few = tuple((rule, "threshold") for rule in RULES) + (() if points else _ASCENTS)
    lifted = {
        "Occam's LGS": {"": _lifted(lifting.train_occam)},
        "weighted back-projection": {"": _lifted(lifting.train_backprojection)},
        "VALA": {gate: _lifted(lifting.train_vala, **GATES[gate]) for gate in (GATES if points else ("",))},
    }
    found: dict[str, Method] = {}
    for name, ways in lifted.items():
        found[f"{name}: as published"] = METHODS[name]
        for way, features in ways.items():
            for rule, chooser in every + (() if points else SHARPENED):
                found[f"{name}: {way}{rule}, {chooser}"] = reading((name, way), features, rule, chooser)
    for name, association in OURS.items():
        for rule in RETRIEVALS:
            for chooser in choosers:
                for told, options in CENTRES.items() if points and rule != "cosine" else (("", {}),):
                    if association == "consensus" or "agreement" not in options:
                        found[f"{name}: {rule}, {chooser}{told}"] = own(association, rule, chooser, **options)
                if association == "consensus" and rule != "cosine" and not points:
                    found[f"{name}: {rule}, {chooser}{WAYS['all']}"] = own(association, rule, chooser, way="all")
                    for told, options in EVENED.items():
                        found[f"{name}: {rule}, {chooser}{told}"] = own(association, rule, chooser, **options)
    for rule, chooser in (("", "threshold"), *few):
        told = f"{rule}, {chooser}" if rule else "as published"
        found[f"LangSplat-m: {told}"] = _langsplat_row(rule, chooser)
        for codebook in CODEBOOKS if points else tuple(CODEBOOKS)[:2]:
            found[f"OpenGaussian: {codebook}{told}"] = _opengaussian_row(codebook, rule, chooser)
    ascents = () if points else ("strict silhouette", "lenient silhouette", f"strict silhouette{SHARP}")
    for nearly in NEARLY:
        found[f"Gaussian Grouping-m: {'one mask' if nearly == 1 else 'as published'}"] = _grouping_row(
            nearly, "", "threshold"
        )
        for chooser in ("threshold", *ascents):
            found[f"Gaussian Grouping-m: centred, {chooser}{', one mask' if nearly == 1 else ''}"] = _grouping_row(
                nearly, "centred", chooser
            )
    found["the paper's path: as published"] = METHODS["the paper's path"]
    for threshold in CODE_THRESHOLDS:
        for rule in RETRIEVALS:
            for chooser in ("threshold", *ascents):
                found[f"the paper's path: {rule}, {chooser} {threshold:g}"] = _paper_row(rule, threshold, chooser)
    return found
