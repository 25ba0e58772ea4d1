"""The parts of a scene that match a text where no region does.

A region holds what most views put into one mask. An object that few views have a mask of may be swallowed by its
neighbour's region. Each small part of the scene has an embedding of its own, the mean over all masks that hold it, as
training-free methods give one to each Gaussian (Occam's LGS, arXiv 2412.01807); a cluster of parts that matches the
text clearly better than the best region answers in its place.
"""

import functools
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.numerics import normalize
from jsecon.query.match import (
    RULES,
    presence,
    quantile_among,
    reference_similarities,
    reference_words,
    region_similarities,
)
from jsecon.query.outliers import MIN_SAMPLES, dbscan, default_eps
from jsecon.query.rules import QueryRules
from jsecon.types import Array, LanguageField, Parts, Selection

SPACINGS = 3.0
"""DBSCAN's eps in point spacings of the selection; less than for outliers, so that neighbouring objects part."""
REJECTED_SIMILARITY = 0.25
"""Largest similarity of a Gaussian whose part matches but lies outside the chosen cluster."""
PART_THRESHOLD = 0.6
"""Part score from which a part may belong to the object."""
MIN_REGION_RATIO = 0.7
"""A region answers if its similarity is at least this share of that of the best parts. Chosen with PART_THRESHOLD on
twins of nine scenes, seeds 0 to 2, medium and high noise: regions that show the object have 0.81 and more of it, others
0.51 and less where the object's parts differ from their surroundings (9 of 468 texts)."""
UPPER = 0.75
"""Quantile of a cluster's part scores that ranks it; parts at its rim are mixed with what lies behind."""


class PartsAnswer(NamedTuple):
    """An object that no region holds."""

    selection: Selection
    """Its Gaussians. `region` is -1, `score` the similarity of its parts."""
    presence_prob: float | None
    """Probability that the text is true of it; None without `Logits`."""


def part_scores(
    parts: Parts, text: Float[Array, " e"], reference: Float[Array, "w e"] | None, *, retrieval: str = RULES.retrieval
) -> Float[Array, " n"]:
    """Scores each Gaussian by its part: 0 as similar to the text as the median part, 1 as the most similar one. Pure.

    Args:
      parts: P parts of N Gaussians.
      text: (E,) embedding of the text.
      reference: (W, E) unrelated words, or None.
      retrieval: "apart" or "cosine", see `QueryRules`.

    Returns:
      (N,) scores; 0 for Gaussians without a part, and for all if all parts are equally similar.
    """
    similarity, known = region_similarities(parts.embeddings, text, reference, retrieval)
    middle = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    reach = jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf) - middle
    scores = jnp.where(known & (reach > 0), (similarity - middle) / jnp.where(reach > 0, reach, 1.0), 0.0)
    return jnp.concatenate([scores, jnp.zeros(1, scores.dtype)])[parts.part]  # part -1: the last


_part_scores = jax.jit(part_scores, static_argnames="retrieval")


def parts_fallback(
    field: LanguageField,
    text: Float[Array, " e"],
    score: Float[Array, ""] | float,
    rules: QueryRules = RULES,
    *,
    similarity_threshold: float | None = None,
) -> PartsAnswer | None:
    """Finds the parts that match a text which no region matches. Host code.

    The parts that reach PART_THRESHOLD are clustered; the cluster with the best upper scores is pooled into one
    embedding. It answers if the best region has less than MIN_REGION_RATIO of its similarity with the text, and the
    rules do not refuse it, measured against the parts that match unrelated words best.

    Args:
      field: Field with parts.
      text: (E,) embedding of the text.
      score: `RegionMatch.score` of the text.
      rules: How texts match, as for `match_regions`.
      similarity_threshold: Smallest similarity of a selected Gaussian, the part score on a scale that is 0.5 at
        PART_THRESHOLD; None takes 0.5.

    Returns:
      The answer, or None if a region matches, or no parts do.

    Raises:
      ValueError: The field has no parts.
    """
    require(field.parts is not None, "parts_fallback", "a field without parts", "its parts", "Run with --parts.")
    parts, text = cast(Parts, field.parts), jnp.asarray(text)
    reference = reference_words(field)
    from_scores, to_similarity = np.array([0.0, PART_THRESHOLD, 1.0]), np.array([0.0, SHARE_THRESHOLD, 1.0])
    scores = np.asarray(_part_scores(parts, text, reference, retrieval=rules.retrieval))
    least = PART_THRESHOLD
    if similarity_threshold is not None:
        least = float(np.interp(similarity_threshold, to_similarity, from_scores))
    mask = best_cluster(scores >= least, scores, field.gaussians.means)
    similarity = np.interp(scores, from_scores, to_similarity).astype(np.float32)
    similarity = np.where(mask | (scores < least), similarity, np.minimum(similarity, REJECTED_SIMILARITY))
    part = np.asarray(parts.part)

    def count(rows):
        return np.bincount(rows[rows >= 0], minlength=len(parts.weight)).astype(np.float32)

    inside = count(part[mask]) / np.maximum(count(part), 1.0)
    pooled, quantile = _pooled(parts.embeddings, parts.weight, inside, text, reference, retrieval=rules.retrieval)
    similar = float(region_similarities(pooled[None], text, reference, rules.retrieval)[0][0])
    presence_prob = None if rules.logits is None else float(presence(pooled[None], text, rules.logits)[0])
    if rules.retrieval_threshold is None and reference is not None:
        accepted = float(quantile) >= float(rules.quantile)
    else:
        accepted = (similar if presence_prob is None else presence_prob) >= float(rules.fixed_threshold)
    if not mask.any() or float(score) >= MIN_REGION_RATIO * similar or not accepted:
        return None
    region, similar = jnp.asarray(-1, jnp.int32), jnp.asarray(similar, jnp.float32)
    return PartsAnswer(Selection(jnp.asarray(mask), jnp.asarray(similarity), region, similar, quantile), presence_prob)


@functools.partial(jax.jit, static_argnames="retrieval")
def _pooled(
    embeddings: Array, weight: Array, inside: Array, text: Array, reference: Array | None, *, retrieval: str
) -> tuple[Array, Array]:
    """Embedding (E,) of P parts, of each the share `inside` (P,), and its `quantile_among` unrelated words."""
    pooled = normalize(jnp.sum((weight * inside)[:, None] * embeddings, axis=0))
    if reference is None:
        return pooled, jnp.asarray(jnp.nan)
    similar = region_similarities(pooled[None], text, reference, retrieval)[0][0]
    words = reference_similarities(embeddings, reference, retrieval)
    return pooled, quantile_among(similar, text, reference, words)


def best_cluster(
    mask: Bool[np.ndarray, " n"], scores: Float[np.ndarray, " n"], means: Float[Array, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Finds the cluster of Gaussians whose upper quantile of scores is best. Host code.

    DBSCAN on their centres with SPACINGS; clusters with less than a tenth of the largest's Gaussians do not compete.

    Args:
      mask: (N,) the Gaussians to cluster.
      scores: (N,) `part_scores`.
      means: (N, 3) centres, world units.

    Returns:
      (N,) bool; all Gaussians of the mask if there are too few to cluster.
    """
    mask = mask & np.isfinite(np.asarray(means)).all(axis=1)
    chosen = np.flatnonzero(mask)
    if len(chosen) < MIN_SAMPLES:
        return mask
    points = np.asarray(means)[chosen].astype(np.float64)
    cluster = dbscan(points, default_eps(points, spacings=SPACINGS), MIN_SAMPLES)
    if cluster.max() < 0:
        return mask
    sizes = np.bincount(cluster[cluster >= 0])
    upper = np.array([np.quantile(scores[chosen][cluster == c], UPPER) for c in range(len(sizes))])
    stays = upper >= upper[sizes >= 0.1 * sizes.max()].max()
    result = np.zeros_like(mask)
    result[chosen[(cluster >= 0) & stays[cluster]]] = True
    return result
