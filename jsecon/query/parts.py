"""Which parts of what a text found answer it: where masks took a thing and its neighbour for one, a text tells them
apart.

Regions hold what most views put into one mask. Where most views are wrong alike, a region is two things, or a thing and
its shadow; but in the other views the masks tell them apart, and so do their embeddings. So each small part of the
scene has an embedding of its own, the mean over all masks that hold it. This is what training-free methods give each
Gaussian (Occam's LGS, arXiv 2412.01807); here it divides what the regions found, and answers where no region holds the
thing: one that few views have a mask of may have gone to its neighbour whole.
"""

import dataclasses
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.numerics import normalize
from jsecon.query.match import (
    KIND_THRESHOLD,
    PIECE_THRESHOLD,
    QUANTILE,
    Refusal,
    contrasts,
    fixed_threshold,
    presence,
    quantile_among,
    unrelated_similarities,
    words_of,
)
from jsecon.query.outliers import MIN_SAMPLES, dbscan, default_eps
from jsecon.query.similarity import Number
from jsecon.types import Array, LanguageField, Parts, Selection
from jsecon.vision.protocols import Logits

SPACINGS = 3.0
"""of a selection's own points, between which it falls apart: less than for outliers, as things that stand side by side
are to be told apart"""
NOT_OF_IT = 0.25
"""of a Gaussian whose region answers and whose part does not: the similarity that says so, at most"""
THING = 0.6
"""how near to a text the parts come of a thing that no region holds"""
HELD = 0.7
"""a region holds what a text names where its contrast is at least so much of that of the parts that answer best. Chosen
with THING on twins of nine scenes, seeds 0 to 2, at medium and high noise: regions that show the thing have 0.81 of it
and more, others 0.51 and less where the thing's parts are told apart (9 of 468 texts)"""
UPPER = 0.75
"""quantile of a cluster's parts that says how near it is: parts at its rim are mixed with what is behind"""


@jax.jit
def part_nearness(parts: Parts, text: Float[Array, " e"], canonical: Float[Array, "c e"]) -> Float[Array, " n"]:
    """How near each Gaussian's part comes to a text (E,), (N,): 0 as near as the middle one, 1 as the nearest.

        z_p = (s_p - m) / (max s - m),  s the contrast with the text (`contrasts`), m its median

    over parts that lie in masks; 0 for Gaussians of no such part, and for all where all parts are equally near.
    """
    similarity, known = contrasts(parts.embeddings, text, canonical, parts.weight[:, None])
    middle = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    reach = jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf) - middle
    near = jnp.where(known & (reach > 0), (similarity - middle) / jnp.where(reach > 0, reach, 1.0), 0.0)
    near = jnp.concatenate([near, jnp.zeros(1, near.dtype)])
    return near[parts.part]  # of -1: the last


def query_parts(field: LanguageField, selection: Selection, wanted: Float[Array, "q e"]) -> Selection:
    """`selection`, what `query_several` found for the wanted texts (Q, E), without parts that answer none of them
    (`answering_parts`); their similarity becomes NOT_OF_IT at most. Raises ValueError where the field has no parts."""
    remedy = "Run with --parts, or ask without."
    require(field.parts is not None, "query_parts", "a field without parts", "its parts", remedy)
    near = jnp.max(jnp.stack([part_nearness(field.parts, text, field.canonical) for text in wanted]), axis=0)
    mask = jnp.asarray(answering_parts(selection.mask, near, field.gaussians.means))
    dropped = jnp.asarray(selection.mask) & ~mask
    similarity = jnp.where(dropped, jnp.minimum(selection.similarity, NOT_OF_IT), selection.similarity)
    return dataclasses.replace(selection, mask=mask, similarity=similarity)


class InParts(NamedTuple):
    """A thing that no region holds."""

    selection: Selection
    there: float | None
    """probability that the text is true of it; None without `Logits`."""


def parts_instead(
    field: LanguageField,
    text: Float[Array, " e"],
    score: Float[Array, ""] | float,
    *,
    quantile: Number = QUANTILE,
    similarity_threshold: float | None = None,
    logits: Logits | None = None,
) -> InParts | None:
    """The parts that answer a text (E,) where no region does, or None where one does or the parts don't either.

    `score` is the contrast s of the region that answers best (`query_anchored`). With z the `part_nearness`, S the
    nearest cluster (`answering_parts`) of the Gaussians of z >= THING, and n_p and n_p(S) how many Gaussians a part p
    has, in all and in S, S is the answer where its own contrast c, that of

        unit(sum_p w_p n_p(S) / n_p e_p),

    has s < HELD c, and is refused by neither `quantile`, against the parts that answer unrelated words best, nor, of a
    field without such words, by the threshold that a region must reach.
    Selection.region is then -1, its score c, its similarity z on a scale that is 0.5 at THING, on which
    `similarity_threshold` (default 0.5) cuts in its place; of what is as near and not in S, NOT_OF_IT at most. Host
    code around compiled parts. Raises ValueError where the field has no parts.
    """
    require(field.parts is not None, "parts_instead", "a field without parts", "its parts", "Run with --parts.")
    parts = cast(Parts, field.parts)
    nearness, share = np.array([0.0, THING, 1.0]), np.array([0.0, SHARE_THRESHOLD, 1.0])
    near = np.asarray(part_nearness(parts, text, field.canonical))
    least = THING if similarity_threshold is None else float(np.interp(similarity_threshold, share, nearness))
    mask = answering_parts(np.ones(len(near), bool), near, field.gaussians.means, least=least, of_kind=np.inf)
    similarity = np.interp(near, nearness, share).astype(np.float32)
    similarity = np.where(mask | (near < least), similarity, np.minimum(similarity, NOT_OF_IT))
    part = np.asarray(parts.part)
    count = lambda own: np.bincount(own[own >= 0], minlength=len(parts.weight)).astype(np.float32)
    inside = count(part[mask]) / np.maximum(count(part), 1.0)
    embedding, contrast = _pooled(parts.embeddings, parts.weight, inside, text, field.canonical)
    there = None if logits is None else float(presence(embedding[None], jnp.asarray(text), logits)[0])
    if (words := words_of(field, "contrast")[0]) is None:
        told, on = jnp.asarray(jnp.nan), contrast if there is None else there
        accepted = on >= fixed_threshold(Refusal(logits=logits), "contrast")
    else:
        told = _quantile(parts.embeddings, parts.weight, contrast, jnp.asarray(text), words, field.canonical)
        accepted = told >= quantile
    if not mask.any() or score >= HELD * contrast or not accepted:
        return None
    region, contrast = jnp.asarray(-1, jnp.int32), jnp.asarray(contrast, jnp.float32)
    return InParts(Selection(jnp.asarray(mask), jnp.asarray(similarity), region, contrast, told), there)


@jax.jit
def _quantile(embeddings: Array, weight: Array, contrast: Array, text: Array, words: Array, canonical: Array) -> Array:
    """The share of unrelated words (W, E) whose best of P parts has less than a text's contrast."""
    similar = unrelated_similarities(embeddings, words, canonical, weight[:, None], "contrast")
    return quantile_among(contrast, text, words, similar)


@jax.jit
def _pooled(embeddings: Array, weight: Array, inside: Array, text: Array, canonical: Array) -> tuple[Array, Array]:
    """Embedding (E,) of P parts, of each the share `inside` (P,), and its contrast with a text among them."""
    embedding = normalize(jnp.sum((weight * inside)[:, None] * embeddings, axis=0))
    every = jnp.concatenate([embeddings, embedding[None]])
    found, _ = contrasts(every, text, canonical, jnp.append(weight, 0.0)[:, None])
    return embedding, found[-1]


def answering_parts(
    mask: Bool[Array, " n"],
    nearness: Float[Array, " n"],
    means: Float[Array, "n 3"],
    *,
    least: float = PIECE_THRESHOLD,
    of_kind: float = KIND_THRESHOLD,
) -> Bool[np.ndarray, " n"]:
    """What of a selection `mask` answers the text by `part_nearness`, with two thresholds: the parts that are at least
    `least` near, in clusters (DBSCAN on the centres, `SPACINGS`) of which the upper quarter is at least `of_kind` near.
    The nearest of the clusters that have a tenth of the largest's Gaussians stays in any case. Host code.
    """
    near, kept = np.asarray(nearness), np.asarray(mask) & np.isfinite(np.asarray(means)).all(axis=1)
    kept &= near >= least
    chosen = np.flatnonzero(kept)
    if len(chosen) < MIN_SAMPLES:
        return kept
    points = np.asarray(means)[chosen].astype(np.float64)
    cluster = dbscan(points, default_eps(points, spacings=SPACINGS), MIN_SAMPLES)
    if cluster.max() < 0:
        return kept
    sizes = np.bincount(cluster[cluster >= 0])
    upper = np.array([np.quantile(near[chosen][cluster == c], UPPER) for c in range(len(sizes))])
    stays = (upper >= of_kind) | (upper >= upper[sizes >= 0.1 * sizes.max()].max())
    result = np.zeros_like(kept)
    result[chosen[(cluster >= 0) & stays[cluster]]] = True
    return result
