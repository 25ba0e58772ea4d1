"""Every way to read every method: text rules and ways of choosing Gaussians that are no method's own idea.

A feature of each Gaussian is compared with a text by the cosine, by LERF's relevancy, or by one of jsecon's rules, the
centred cosine and "contrast". The similarity is cut at VALA's threshold, or handed to the ascent of the expected IoU.
Every row answers every text, as the protocols ask.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.baselines import lifting
from experiments.baselines.evidence import Evidence
from experiments.tables.answers import Answers
from experiments.tables.setting import Setting
from experiments.tables.silhouette import SILHOUETTE_WEIGHTS, fit_silhouette
from jsecon.errors import require
from jsecon.numerics import cosine_matrix, normalize
from jsecon.paper.queries import _relevancies
from jsecon.types import Selection

RULES = ("cosine", "relevancy", "centred", "contrast")
"""of comparing a feature with a text"""
CHOOSERS = {"threshold": None} | {name.replace("_", " "): weights for name, weights in SILHOUETTE_WEIGHTS.items()}
"""a threshold, or the ascent of the expected IoU with these weights of its two levels of alpha"""
SHARP = ", sharp"
"""behind a chooser: the ascent is given the similarities as sharp shares (`as_share`)"""
SHARPENED = tuple((rule, f"{name} silhouette{SHARP}") for rule in RULES[1:] for name in ("strict", "lenient"))
"""readings by sharp shares"""


def scores(
    setting: Setting, features: Float[np.ndarray, "n e"], rule: str, evidence: Evidence | None = None
) -> Float[np.ndarray, "q n"]:
    """Similarity of each Gaussian with each text by a rule; NaN where its feature is unknown.

    The last two rules are jsecon's for regions. The centred cosine subtracts the mean of the masks of the `evidence`
    (default: the setting's), weighted by their pixels. "contrast" subtracts the mean of the unrelated words from the
    text.
    """
    features, texts = jnp.asarray(features), jnp.asarray(setting.texts)
    known = np.asarray(jnp.any(features != 0, axis=1))
    if rule == "cosine":
        found = np.asarray(cosine_matrix(texts, features))
    elif rule == "contrast":
        require(
            setting.unrelated_words is not None,
            "contrast",
            "a setting without unrelated words",
            "a twin",
            "Use the centred cosine.",
        )
        words = normalize(jnp.asarray(setting.unrelated_words))
        found = np.asarray(cosine_matrix(normalize(texts) - words.mean(0), features))
    elif rule == "relevancy":
        found = np.stack(
            [np.asarray(_relevancies(features, t, jnp.asarray(setting.canonical_phrases))[0]) for t in texts]
        )
    else:
        evidence = setting.evidence if evidence is None else evidence
        masks = np.asarray(evidence.masks)
        pixels = np.bincount(masks[masks >= 0], minlength=len(evidence.embeddings))
        units = np.asarray(normalize(jnp.asarray(evidence.embeddings)))
        mean = (pixels[:, None] * units).sum(0) / pixels.sum()
        apart = normalize(normalize(features) - jnp.asarray(mean, jnp.float32))
        cone = normalize(jnp.asarray(setting.canonical_phrases).mean(0))
        across = normalize(texts) - (normalize(texts) @ cone)[:, None] * cone
        found = np.asarray(cosine_matrix(across, apart))
    return np.where(known, found, np.nan)


def as_share(
    similarity: Float[np.ndarray, " n"], cut: float = lifting.READOUT, *, sharp: bool = False
) -> Float[np.ndarray, " n"]:
    """A similarity as a share, 1/2 at the threshold `cut`: linear from 0 to there, and from there to 1. What is far
    below the threshold then counts as a little of the thing; `sharp`, twice as steep, it does not."""
    if sharp:
        return np.clip(0.5 + (similarity - cut) / (1 - cut), 0, 1).astype(np.float32)
    share = np.where(similarity <= cut, 0.5 * similarity / cut, 0.5 + 0.5 * (similarity - cut) / (1 - cut))
    return np.clip(share, 0, 1).astype(np.float32)


def chosen_by(setting: Setting, chooser: str, found: Selection, share: Float[np.ndarray, " n"]) -> Selection:
    """`found`, its Gaussians chosen anew by `share` (N,) of each; a threshold has chosen already."""
    weights = CHOOSERS[chooser.removesuffix(SHARP)]
    if weights is None:
        return found
    mask = fit_silhouette(setting.evidence.gaussians, setting.evidence.cameras, share, weights=weights)
    return dataclasses.replace(found, mask=jnp.asarray(mask))


def read(setting: Setting, features: Sequence[Float[np.ndarray, "n e"]], rule: str, chooser: str) -> Answers:
    """A method's features of each level of masks, or of one, asked by a rule: a text takes the level that answers it
    best, as LangSplat does. Classes are the best text's."""
    means, levels = setting.evidence.gaussians.means, setting.levels
    tables = np.stack([scores(setting, own, rule, levels[n]) for n, own in enumerate(features)])
    filled = np.where(np.isfinite(tables), tables, -np.inf)
    level = filled.max(2).argmax(0)

    def select(k: int) -> Selection:
        score, best = tables[level[k], k], float(filled[:, k].max())
        similarity = lifting.smoothed(means, score)
        place, mask = jnp.asarray(-1, jnp.int32), jnp.asarray(similarity > lifting.READOUT)
        best = jnp.asarray(best if np.isfinite(best) else 0.0, jnp.float32)
        share = as_share(similarity, sharp=chooser.endswith(SHARP))
        return chosen_by(setting, chooser, Selection(mask, jnp.asarray(similarity), place, best), share)

    most = filled.max(0)
    labels = np.where(np.isfinite(most).any(0), np.argmax(most, axis=0), -1)
    return Answers(select, lambda: labels)
