"""Every way to read every method: text rules and ways of choosing Gaussians that are no method's own idea.

A feature of each Gaussian can be held against a text by the cosine, by LERF's relevancy, or by jsecon's contrast; the
similarity that follows can be cut at VALA's threshold, or be handed to the ascent of the expected IoU. No row may
answer "nothing": the protocols have no such answer.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.rivals import lifting
from experiments.tables.answers import Answers, Method, Steps
from experiments.tables.methods import METHODS
from experiments.tables.ours import ask_field, field_of
from experiments.tables.setting import Setting
from jsecon.numerics import cosine_matrix, normalize
from jsecon.query.direct import relevancies
from jsecon.query.silhouette import WEIGHTS, silhouette_members
from jsecon.types import Selection

RULES = ("cosine", "relevancy", "contrast")
CHOOSERS = {"threshold": None, "silhouette": WEIGHTS, "lenient silhouette": (0.0, 1.0)}
"""a threshold, or the ascent of the expected IoU with these weights of its two levels of alpha: of both, or of 10/255
alone"""
NO_REFUSAL = -1.0
"""below every similarity"""
WAYS = {"votes": "", "all": ", all", "parts": ", parts"}
"""of asking jsecon's regions: the one that answers best with its pieces, all that answer, of them the parts that do"""


def scores(setting: Setting, features: Float[np.ndarray, "n e"], rule: str) -> Float[np.ndarray, "q n"]:
    """How far each Gaussian answers each text by a rule; NaN where its feature is unknown.

    The contrast is jsecon's of regions, asked of Gaussians: the mean that is taken out of them is that of the frames'
    masks, weighted by their pixels.
    """
    features, texts = jnp.asarray(features), jnp.asarray(setting.texts)
    known = np.asarray(jnp.any(features != 0, axis=1))
    if rule == "cosine":
        found = np.asarray(cosine_matrix(texts, features))
    elif rule == "relevancy":
        found = np.stack([np.asarray(relevancies(features, t, jnp.asarray(setting.canonical))[0]) for t in texts])
    else:
        evidence = setting.evidence
        masks = np.asarray(evidence.masks)
        pixels = np.bincount(masks[masks >= 0], minlength=len(evidence.embeddings))
        units = np.asarray(normalize(jnp.asarray(evidence.embeddings)))
        mean = (pixels[:, None] * units).sum(0) / pixels.sum()
        apart = normalize(normalize(features) - jnp.asarray(mean, jnp.float32))
        cone = normalize(jnp.asarray(setting.canonical).mean(0))
        across = normalize(texts) - (normalize(texts) @ cone)[:, None] * cone
        found = np.asarray(cosine_matrix(across, apart))
    return np.where(known, found, np.nan)


def as_share(similarity: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """A similarity as a share: linear from 0 to 1/2 at the readout's threshold, and from there to 1."""
    cut = lifting.READOUT
    share = np.where(similarity <= cut, 0.5 * similarity / cut, 0.5 + 0.5 * (similarity - cut) / (1 - cut))
    return share.astype(np.float32)


def read(setting: Setting, features: Float[np.ndarray, "n e"], rule: str, chooser: str) -> Answers:
    """A method's features, asked by a rule; classes are the best text's."""
    gaussians, cameras = setting.evidence.gaussians, setting.evidence.cameras
    table = scores(setting, features, rule)

    def select(k: int) -> Selection:
        similarity = lifting.smoothed(gaussians.means, table[k])
        mask = similarity > lifting.READOUT
        weights = CHOOSERS[chooser]
        if weights:
            mask = silhouette_members(gaussians, cameras, as_share(similarity), weights=weights)
        best = float(np.nanmax(table[k])) if np.isfinite(table[k]).any() else 0.0
        place = jnp.asarray(-1, jnp.int32)
        return Selection(jnp.asarray(mask), jnp.asarray(similarity), place, jnp.asarray(best, jnp.float32))

    unknown = ~np.isfinite(table).any(0)
    labels = np.where(unknown, -1, np.argmax(np.where(np.isfinite(table), table, -np.inf), axis=0))
    return Answers(select, lambda: labels)


def reading(train: Callable[[Setting, Steps], Float[np.ndarray, "n e"]], rule: str, chooser: str) -> Method:
    """The row of features that `train` makes, once a setting."""
    return lambda setting, steps: read(setting, setting.shared.get(train, lambda: train(setting, steps)), rule, chooser)


def own(association: str, retrieval: str, chooser: str, centre: float = 0.0, way: str = "votes") -> Method:
    """jsecon's row of an association's regions; `way` as for `ask_field`."""

    def row(setting: Setting, steps: Steps) -> Answers:
        field = field_of(setting, by=association, centre=centre)
        options = {"retrieval": retrieval, "retrieval_threshold": NO_REFUSAL, "pieces": True}
        weights = CHOOSERS[chooser]
        answers = ask_field(setting, field, way, clean=weights is None, **options)
        if weights is None:
            return answers

        def select(k: int) -> Selection | None:
            found = answers.select(k)
            if found is None:
                return None
            share = np.asarray(found.similarity, np.float32)
            mask = silhouette_members(setting.evidence.gaussians, setting.evidence.cameras, share, weights=weights)
            return dataclasses.replace(found, mask=mask)

        return dataclasses.replace(answers, select=select)

    return row


def _occam(setting: Setting, steps: Steps) -> np.ndarray:
    return lifting.train_occam(setting.evidence).features


def _vala(setting: Setting, steps: Steps) -> np.ndarray:
    return lifting.train_vala(setting.evidence).features


def _backprojection(setting: Setting, steps: Steps) -> np.ndarray:
    return lifting.train_backprojection(setting.evidence).features


FEATURES = {"Occam's LGS": _occam, "weighted back-projection": _backprojection, "VALA": _vala}
OURS = {"ours, tracks": "tracks", "ours, outspoken views": "outspoken", "ours, consensus": "consensus"}


CENTRES = (0.0, 0.5, 0.8, 1.0)


def rows_of(points: bool) -> dict[str, Method]:
    """All rows, by name, "method: reading". Where `points` are judged, not silhouettes, there is nothing to choose for
    a text, as each point gets a class; ours then differ by how much the centre's pixel counts."""
    found: dict[str, Method] = {}
    choosers = ["threshold"] if points else list(CHOOSERS)
    for name, train in FEATURES.items():
        found[f"{name}: as published"] = METHODS[name]
        for rule in RULES:
            for chooser in choosers:
                found[f"{name}: {rule}, {chooser}"] = reading(train, rule, chooser)
    for name, association in OURS.items():
        for rule in ("cosine", "contrast"):
            for chooser in choosers:
                for centre in CENTRES if points and rule == "contrast" else (0.0,):
                    told = f", centre {centre:g}" if centre else ""
                    found[f"{name}: {rule}, {chooser}{told}"] = own(association, rule, chooser, centre)
                if association == "consensus" and rule == "contrast" and not points:
                    for way in ("all", "parts"):
                        found[f"{name}: {rule}, {chooser}{WAYS[way]}"] = own(association, rule, chooser, way=way)
    return found
