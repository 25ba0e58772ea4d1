"""What belongs together: which regions answer a question with the best one, and which show one object.

A tracker may break an object into two regions, a mask may cut it into pieces, and a text may mean all objects of a
class. `regions_with` has the rule. Relative scores are 0 at the median region and 1 at the best:

    same class   its relative score reaches `same_class_score`: another object of that class (only on request)
    fragment     its relative score reaches `fragment_score`, and it overlaps one of those in its Gaussians: another
                 piece of the object. A second object of the class is as similar, but has Gaussians of its own
    duplicate    cos(d, d_best) >= `duplicate_cosine`, d the embedding minus the mean: the same object seen twice

An object that few views have a mask of may be swallowed by its neighbour's region. Each small part of the scene has an
embedding of its own, the mean over all masks that hold it, as training-free methods give one to each Gaussian (Occam's
LGS, arXiv 2412.01807). `parts_fallback` finds the parts that match a text clearly better than the best region does.
"""

import functools
from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.errors import require
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.field.regions import mean_residuals
from jsecon.field.similarity import Number, similarities
from jsecon.numerics import normalize
from jsecon.query.outliers import best_cluster
from jsecon.query.rules import ABSENT, QueryRules
from jsecon.query.scores import (
    presence_prob,
    region_similarities,
    standing_among_words,
    unrelated_words,
    word_similarities,
)
from jsecon.types import Array, LanguageField, Parts, Selection

MIN_FRAGMENT_OVERLAP = 0.1
"""Smallest soft IoU of the Gaussians of two fragments. In twins of two scenes 106 of 115 pieces reach it, and 4 of 58
other regions."""
PART_SCORE = 0.6
"""Relative score from which a part may belong to the object."""
MIN_REGION_RATIO = 0.7
"""A region answers if its similarity is at least this share of that of the best parts. Chosen with PART_SCORE on twins
of nine scenes, seeds 0 to 2, medium and high noise: regions that show the object have 0.81 and more of it, others 0.51
and less where the object's parts differ from their surroundings (9 of 468 texts)."""


def regions_with(
    best: Int[Array, ""],
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    embeddings: Float[Array, "r e"],
    overlap: Float[Array, "r r"] | None,
    rules: QueryRules,
) -> Bool[Array, " r"]:
    """Finds the regions that answer with the best one, by the rule of this module. Pure.

    `similarity` is that of each region with the question, where `known` it means something. Without `Votes.overlap` no
    fragments are joined.
    """
    chosen = jnp.arange(embeddings.shape[0]) == best
    if rules.all_of_class:
        chosen |= _reaches(similarity, known, rules.same_class_score)
    if rules.fragment_score is not None and overlap is not None:
        overlaps = jnp.max(jnp.where(chosen[:, None], overlap, 0.0), axis=0) >= MIN_FRAGMENT_OVERLAP
        chosen |= overlaps & _reaches(similarity, known, rules.fragment_score)
    if rules.duplicate_cosine is not None:
        residuals, usable = mean_residuals(embeddings)
        cosines, comparable = similarities(residuals, residuals[best])
        chosen |= usable & comparable & (cosines >= rules.duplicate_cosine)
    return chosen


def _reaches(similarity: Float[Array, " r"], known: Bool[Array, " r"], relative_score: Number) -> Bool[Array, " r"]:
    """Finds regions with a similarity of at least m + `relative_score` (b - m), m the median and b > m the largest."""
    median = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    largest = jnp.max(jnp.where(known, similarity, -jnp.inf))
    return known & (similarity >= median + relative_score * (largest - median)) & (largest > median)


def join_fragments(regions: Sequence[int] | np.ndarray, overlap: np.ndarray | None) -> list[tuple[int, ...]]:
    """Groups regions that overlap, directly or by way of others: the fragments of one object. Host code.

    The groups are sorted. None in place of `Votes.overlap` makes each region a group.
    """
    groups: list[set[int]] = []
    for region in map(int, regions):
        near = [g for g in groups if overlap is not None and (overlap[region, list(g)] >= MIN_FRAGMENT_OVERLAP).any()]
        groups = [g for g in groups if g not in near] + [set().union({region}, *near)]
    return sorted(tuple(sorted(group)) for group in groups)


def parts_fallback(
    field: LanguageField, text: Float[Array, " e"], region_score: Float[Array, ""] | float, rules: QueryRules
) -> Selection | None:
    """Selects the parts that match a text which no region matches; None if a region does, or no parts do. Host code.

    The parts whose relative score reaches PART_SCORE are clustered. The cluster with the best upper scores is pooled
    into one embedding. It answers if the best region has less than MIN_REGION_RATIO of its similarity with the text,
    and the rules do not judge it absent, measured against the parts that match unrelated words best.

    Args:
      field: Field with parts.
      text: Embedding of the text.
      region_score: Similarity of the best region with the text.
      rules: `min_share` is on the relative score of parts, on a scale that is 0.5 at PART_SCORE.

    Returns:
      The selection; its region is -1.
    """
    require(field.parts is not None, "parts_fallback", "a field without parts", "its parts", "Run with --parts.")
    parts, text, words = cast(Parts, field.parts), jnp.asarray(text), unrelated_words(field)
    scores = np.asarray(part_scores(parts, text, words, retrieval=rules.retrieval))
    on_scale, of_scores = np.array([0.0, SHARE_THRESHOLD, 1.0]), np.array([0.0, PART_SCORE, 1.0])
    least = float(np.interp(rules.min_share, on_scale, of_scores))
    mask = best_cluster(scores >= least, scores, field.gaussians.means)
    similarity = np.interp(scores, of_scores, on_scale).astype(np.float32)
    # Parts that match but lie outside of the chosen cluster are shown as unlike the text.
    similarity = np.where(mask | (scores < least), similarity, np.minimum(similarity, 0.25))
    part = np.asarray(parts.part)

    def count(rows):
        return np.bincount(rows[rows >= 0], minlength=len(parts.weight)).astype(np.float32)

    inside = count(part[mask]) / np.maximum(count(part), 1.0)
    pooled, similar, standing = _pooled(parts.embeddings, parts.weight, inside, text, words, retrieval=rules.retrieval)
    presence = None if rules.logits is None else presence_prob(pooled[None], text, rules.logits)[0]
    state = rules.judge(standing, similar, presence)
    if not mask.any() or float(region_score) >= MIN_REGION_RATIO * float(similar) or int(state) == ABSENT:
        return None
    region, rank = jnp.asarray(-1, jnp.int32), jnp.asarray(jnp.nan) if standing is None else standing[0]
    return Selection(jnp.asarray(mask), jnp.asarray(similarity), region, similar, rank, presence, state)


@functools.partial(jax.jit, static_argnames="retrieval")
def part_scores(
    parts: Parts, text: Float[Array, " e"], words: Float[Array, "w e"] | None, *, retrieval: str
) -> Float[Array, " n"]:
    """Computes the relative score of the part of each Gaussian: 0 of the median part, 1 of the most similar one. Pure.

    It is 0 for Gaussians without a part, and for all if all parts are equally similar.
    """
    similarity, known = region_similarities(parts.embeddings, text, words, retrieval)
    median = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    reach = jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf) - median
    scores = jnp.where(known & (reach > 0), (similarity - median) / jnp.where(reach > 0, reach, 1.0), 0.0)
    return jnp.concatenate([scores, jnp.zeros(1, scores.dtype)])[parts.part]  # part -1: the last


@functools.partial(jax.jit, static_argnames="retrieval")
def _pooled(
    embeddings: Array, weight: Array, inside: Array, text: Array, words: Array | None, *, retrieval: str
) -> tuple[Array, Array, tuple[Array, Array] | None]:
    """Embedding (E,) of P parts, of each the share `inside` (P,), its similarity, and its standing among the words."""
    pooled = normalize(jnp.sum((weight * inside)[:, None] * embeddings, axis=0))
    similar = region_similarities(pooled[None], text, words, retrieval)[0][0]
    if words is None:
        return pooled, similar, None
    of_parts, known = region_similarities(embeddings, text, words, retrieval)
    share = known / jnp.maximum(jnp.sum(known), 1)
    reach = similar, similar - jnp.sum(share * of_parts)
    return (
        pooled,
        similar,
        standing_among_words(
            reach, text, words, word_similarities(embeddings, words, retrieval), known.astype(text.dtype)
        ),
    )
