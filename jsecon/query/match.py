"""Which regions of a field match a text. Pure functions: jit them, or vmap them over texts.

In a space such as CLIP's all texts lie in one narrow cone and all images in another, so the cosine of a text and an
image is mostly that of the cones. What a text has in common with all texts is therefore subtracted before it is
compared: the mean of unrelated words (`LanguageField.unrelated_words`). Those words also say how similar a text must be
to the scene: it is refused unless it beats most of them (`QueryRules.quantile`).
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Bool, Float, Int, Shaped

from jsecon.errors import require
from jsecon.field.regions import ALIKE_THRESHOLD, mean_residuals
from jsecon.field.similarity import Number, similarities
from jsecon.numerics import cosine_matrix, normalize
from jsecon.programs import stored_jit
from jsecon.query.confidence import answer_confidence
from jsecon.query.rules import (
    EVIDENCE_FULL_PX,
    EVIDENCE_PRIOR_VIEWS,
    MIN_PIECE_OVERLAP,
    PIECE_THRESHOLD,
    REFERENCE_CUT,
    QueryRules,
)
from jsecon.types import Array, LanguageField, Regions
from jsecon.vision.protocols import Logits

ROUNDING = 1e-5
"""Similarities that differ by no more count as equal: a text that is both included and excluded matches nothing."""
RULES = QueryRules()
"""The defaults."""
ONE_REGION = QueryRules(alike_threshold=None, piece_threshold=None)
"""A region alone: who points at one of two red chairs means that one."""
_ANCHOR_BONUS = 4.0
"""Puts anchors before the regions that join them; similarities span 2."""


class RegionMatch(NamedTuple):
    """The regions of a field, R of them, that match a query."""

    chosen: Bool[Array, " r"]
    """Regions that match."""
    region: Int[Array, ""]
    """The best of them; -1 if there is none."""
    score: Float[Array, ""]
    """Similarity of the best region, whether it is chosen or not; 0 without regions."""
    quantile: Float[Array, ""] | np.ndarray = np.asarray(np.nan, np.float32)
    """Share of unrelated words that match the scene less than the text does; NaN without such words."""
    confidence: Float[Array, ""] | np.ndarray = np.asarray(np.nan, np.float32)
    """Probability that the best region shows what the text names (`answer_confidence`); NaN without such words."""


export.register_namedtuple_serialization(RegionMatch, serialized_name="jsecon.RegionMatch")  # for `stored_jit`
NO_REGIONS = RegionMatch(np.zeros(0, bool), np.asarray(-1, np.int32), np.asarray(0.0, np.float32))
"""The match of a field without regions."""


class TextScores(NamedTuple):
    """How well R regions match one text."""

    similarity: Float[Array, " r"]
    """Cosine, in [-1, 1]; 0 where it is not known."""
    known: Bool[Array, " r"]
    """Regions with an embedding, if the text has one."""
    anchor: Int[Array, ""]
    """The best region: largest similarity times evidence."""
    accepted: Bool[Array, ""]
    """Whether the rules let the scene answer the text."""
    quantile: Float[Array, ""]
    """As in `RegionMatch`."""
    confidence: Float[Array, ""]
    """As in `RegionMatch`."""


def match_regions(
    field: LanguageField,
    queries: Float[Array, "q e"],
    rules: QueryRules = RULES,
    *,
    excluded: Float[Array, "u e"] | None = None,
) -> RegionMatch:
    """Finds the regions that match any of the queries and none of the excluded texts. Pure.

    A text matches the region with the largest similarity s times `evidence`, the anchor, unless the rules refuse it.
    With m the median similarity and b the largest, other regions join the anchor that have

        s >= m + kind_threshold (b - m)      with `all_of_kind`: another object of the same kind
        s >= m + piece_threshold (b - m)     and an overlap of MIN_PIECE_OVERLAP with one of those: a piece of an object
        cos(d, d_anchor) >= alike_threshold  with d the embedding minus the mean: the same object seen twice

    A region that matches a query and an excluded text belongs to the one that it is more similar to, so "mug but not
    handle" keeps a mug whose handle has no region.

    Args:
      field: Field of R regions with embeddings of E numbers.
      queries: (Q, E) embeddings of the texts, Q >= 1.
      rules: How texts match.
      excluded: (U, E) embeddings of texts whose regions are left out; None is an empty list.

    Returns:
      The match.

    Raises:
      ValueError: An embedding has another size.
    """
    size = field.regions.embeddings.shape[1]
    excluded = jnp.zeros((0, size)) if excluded is None else excluded
    fit = all(texts.ndim == 2 and texts.shape[1] == size for texts in (queries, excluded)) and len(queries) >= 1
    remedy = f"Embed the text with the field's embedder{f', {field.embedder}' if field.embedder else ''}."
    shapes = f"queries {queries.shape}, excluded {excluded.shape}"
    require(fit, "match_regions", shapes, f"(Q >= 1, {size}) and (U, {size})", remedy)
    if field.regions.count == 0:
        return NO_REGIONS
    arrays = field.regions.embeddings, field.regions.pixel_counts, field.votes.overlap, queries, excluded
    return _match(*jax.tree.map(jnp.asarray, arrays), reference_words(field), rules)


@stored_jit
def _match(embeddings, pixels, overlap, queries, excluded, reference, rules: QueryRules) -> RegionMatch:
    reference_scores = None if reference is None else reference_similarities(embeddings, reference, rules.retrieval)

    def best_of(texts):
        def of_text(text):
            scores = score_text(embeddings, text, pixels, reference, reference_scores, rules)
            return scores, _answering_regions(embeddings, scores, overlap, rules)

        scores, chosen = jax.vmap(of_text)(texts)
        return scores, chosen.any(0), jnp.max(jnp.where(chosen, scores.similarity, -jnp.inf), axis=0)

    scores, chosen, closeness = best_of(queries)
    if len(excluded):
        _, rejected, against = best_of(excluded)
        chosen &= ~(rejected & (against >= closeness - ROUNDING))
    count = len(embeddings)
    is_anchor = jnp.any((jnp.arange(count) == scores.anchor[:, None]) & scores.accepted[:, None], axis=0)
    best = jnp.argmax(jnp.where(chosen, closeness + _ANCHOR_BONUS * is_anchor, -jnp.inf))
    matches = jnp.any(chosen)

    def of_anchor(rows):
        return jnp.take_along_axis(rows, scores.anchor[:, None], axis=1)[:, 0]

    known = of_anchor(scores.known)
    nearest = jnp.max(jnp.where(known, of_anchor(scores.similarity), -jnp.inf))
    nearest = jnp.where(jnp.any(known), nearest, 0.0)
    return RegionMatch(
        jnp.asarray(chosen),
        jnp.where(matches, best, -1).astype(jnp.int32),
        jnp.where(matches, closeness[best], nearest),
        jnp.nanmax(jnp.where(known, scores.quantile, jnp.nan)),
        jnp.nanmax(jnp.where(known, scores.confidence, jnp.nan)),
    )


def match_region(field: LanguageField, region: int | Int[Array, ""], rules: QueryRules = ONE_REGION) -> RegionMatch:
    """Matches one region in place of a text.

    Args:
      field: Field of R regions.
      region: Id of the region.
      rules: Which regions join it, its embedding in place of a text's; by default only that region.

    Returns:
      The match, with score 1. For a region that the field does not have, such as -1, its region is -1 and its score 0.
    """
    if field.regions.count == 0:
        return NO_REGIONS
    return match_embedding(jnp.asarray(field.regions.embeddings), field.votes.overlap, jnp.asarray(region), rules)


@jax.jit
def match_embedding(
    embeddings: Float[Array, "r e"], overlap: Float[Array, "r r"] | None, region: Int[Array, ""], rules: QueryRules
) -> RegionMatch:
    """Matches one region in place of a text, as `match_region` does. Pure.

    Args:
      embeddings: (R, E) of the regions, R >= 1.
      overlap: (R, R) `Votes.overlap`, or None.
      region: Id of the region.
      rules: Which regions join it.

    Returns:
      The match.
    """
    valid = (region >= 0) & (region < embeddings.shape[0])
    chosen = jnp.arange(embeddings.shape[0]) == region
    if rules.piece_threshold is not None and overlap is not None:
        cosines, known = similarities(embeddings, embeddings[jnp.maximum(region, 0)])
        chosen |= is_piece(cosines, known, chosen, overlap, threshold=rules.piece_threshold)
    if rules.alike_threshold is not None:
        chosen |= _is_alike(embeddings, jnp.maximum(region, 0), rules.alike_threshold)
    return RegionMatch(chosen & valid, jnp.where(valid, region, -1).astype(jnp.int32), valid.astype(embeddings.dtype))


def join_pieces(regions: Sequence[Any] | np.ndarray, overlap: np.ndarray | None) -> list[tuple[int, ...]]:
    """Groups regions that overlap, directly or by way of others: the pieces of one object. Host code.

    Args:
      regions: Ids of regions.
      overlap: (R, R) overlap of all regions (`Votes.overlap`); None makes each region a group.

    Returns:
      The groups, each sorted.
    """
    groups: list[set[int]] = []
    for region in map(int, regions):
        near = [g for g in groups if overlap is not None and (overlap[region, list(g)] >= MIN_PIECE_OVERLAP).any()]
        groups = [g for g in groups if g not in near] + [set().union({region}, *near)]
    return sorted(tuple(sorted(group)) for group in groups)


def reference_words(field: LanguageField) -> Array | None:
    """Reads the unrelated words of a field.

    Args:
      field: The field.

    Returns:
      (W, E) embeddings, or None if it has none.
    """
    words = field.unrelated_words
    return jnp.asarray(words) if words is not None and len(words) else None


def _text_direction(
    text: Float[Array, "*batch e"], reference: Float[Array, "w e"] | None, retrieval: str
) -> Float[Array, "*batch e"]:
    """Returns unit texts (..., E), by "apart" minus the mean of the W unit unrelated words if there are such words."""
    unit = normalize(text)
    if retrieval == "cosine" or reference is None:
        return unit
    return unit - jnp.mean(normalize(reference.astype(text.dtype)), axis=0)


def region_similarities(
    embeddings: Float[Array, "r e"],
    text: Float[Array, " e"],
    reference: Float[Array, "w e"] | None,
    retrieval: str,
) -> tuple[Float[Array, " r"], Bool[Array, " r"]]:
    """Compares regions with a text. Pure.

    Args:
      embeddings: (R, E) of the regions.
      text: (E,) embedding of the text.
      reference: (W, E) unrelated words, or None.
      retrieval: "apart" subtracts the mean of the unrelated words from the text; "cosine" does not.

    Returns:
      Cosines (R,), and whether they are known (R,); 0 if not.
    """
    return similarities(embeddings, _text_direction(text, reference, retrieval))


def reference_similarities(
    embeddings: Float[Array, "r e"], reference: Float[Array, "w e"], retrieval: str
) -> Float[Array, "w r"]:
    """Compares regions with unrelated words, as `region_similarities` does with a text. Pure.

    Args:
      embeddings: (R, E) of the regions.
      reference: (W, E) unrelated words.
      retrieval: "apart" or "cosine".

    Returns:
      (W, R) cosines, NaN if unknown.
    """
    words = reference.astype(embeddings.dtype)
    words = _text_direction(words, words, retrieval)
    # As one product of matrices: W queries of their own would walk all regions W times.
    known = jnp.any(words != 0, axis=1)[:, None] & jnp.any(embeddings != 0, axis=1)
    return jnp.where(known, cosine_matrix(words, embeddings), jnp.nan)


def quantile_among(
    best: Float[Array, ""], text: Float[Array, " e"], reference: Float[Array, "w e"], scores: Float[Array, "w r"]
) -> Float[Array, ""]:
    """Ranks a text among unrelated words by how similar they are to the scene. Pure.

    The REFERENCE_CUT share of the words that is nearest to the text is left out.

    Args:
      best: () largest similarity of the text with any region.
      text: (E,) embedding of the text.
      reference: (W, E) unrelated words.
      scores: (W, R) their `reference_similarities`.

    Returns:
      () share of the words with a smaller largest similarity; 1 if no word is left.
    """
    largest = jnp.max(jnp.where(jnp.isfinite(scores), scores, -jnp.inf), axis=1)
    units = normalize(reference.astype(text.dtype))
    mean = jnp.mean(units, axis=0)
    near = cosine_matrix((normalize(text) - mean)[None], units - mean)[0]
    largest = largest[jnp.argsort(-near)[int(REFERENCE_CUT * len(reference)) :]]
    known = jnp.isfinite(largest)
    below = jnp.sum(known & (largest < best), dtype=text.dtype)
    return jnp.where(jnp.any(known), below / jnp.maximum(jnp.sum(known), 1), 1.0)


def presence(embeddings: Float[Array, "r e"], text: Float[Array, " e"], logits: Logits) -> Float[Array, " r"]:
    """Computes the probability that a text is true of each region: sigmoid(scale cos + bias). Pure.

    Args:
      embeddings: (R, E) of the regions.
      text: (E,) embedding of the text.
      logits: Scale and bias of the embedder, which was trained with this sigmoid.

    Returns:
      (R,) probabilities; 0 if either has no direction.
    """
    cosines, known = similarities(embeddings, text)
    return jnp.where(known, jax.nn.sigmoid(logits.scale * cosines + logits.bias), 0.0)


def best_presence(
    regions: Regions, texts: Float[Array, "q e"], region: Int[Array, ""], logits: Logits | None
) -> float | None:
    """Computes the largest `presence` of several texts in a region.

    Args:
      regions: R regions.
      texts: (Q, E) embeddings.
      region: Id of the region; -1 takes the best of all.
      logits: Scale and bias of the embedder, or None.

    Returns:
      A probability; None without `logits` or regions.
    """
    if logits is None or regions.count == 0:
        return None
    each = jnp.stack([presence(jnp.asarray(regions.embeddings), text, logits) for text in texts]).max(axis=0)
    return float(each[region] if int(region) >= 0 else each.max())


@functools.partial(jax.jit, inline=True)
def evidence(pixels: Shaped[Array, "r t"]) -> Float[Array, " r"]:
    """Computes how much stands behind the embedding of each region. Pure.

        v / (v + EVIDENCE_PRIOR_VIEWS) over its largest value,  v = sum_t min(pixels_t / EVIDENCE_FULL_PX, 1)

    A sliver that few views show has one colour, so its embedding is purer than that of the object that it belongs to.

    Args:
      pixels: (R, T) number of pixels of each region in each view.

    Returns:
      (R,) in (0, 1]; 1 everywhere if no pixels are known.
    """
    views = jnp.sum(jnp.minimum(jnp.asarray(pixels) / EVIDENCE_FULL_PX, 1.0), axis=-1)
    weight = views / (views + EVIDENCE_PRIOR_VIEWS)
    largest = jnp.max(weight, initial=0.0)
    return jnp.where(largest > 0, weight / jnp.where(largest > 0, largest, 1.0), 1.0)


def score_text(
    embeddings: Float[Array, "r e"],
    text: Float[Array, " e"],
    pixels: Shaped[Array, "r t"],
    reference: Float[Array, "w e"] | None,
    reference_scores: Float[Array, "w r"] | None,
    rules: QueryRules,
) -> TextScores:
    """Compares one text with all regions. Pure.

    Args:
      embeddings: (R, E) of the regions.
      text: (E,) embedding of the text.
      pixels: (R, T) number of pixels of each region in each view.
      reference: (W, E) unrelated words, or None.
      reference_scores: (W, R) their `reference_similarities`, or None.
      rules: How texts match.

    Returns:
      The scores.
    """
    similarity, known = region_similarities(embeddings, text, reference, rules.retrieval)
    weighted = similarity
    if rules.retrieval != "cosine" and reference is not None:  # the plain cosine is the paper's, without evidence
        weighted = jnp.where(similarity > 0, similarity * evidence(pixels).astype(similarity.dtype), similarity)
    anchor = jnp.argmax(jnp.where(known, weighted, -jnp.inf))
    quantile = confidence = jnp.asarray(jnp.nan, similarity.dtype)
    if reference is not None and reference_scores is not None:
        best = jnp.max(jnp.where(known, similarity, -jnp.inf))
        quantile = quantile_among(best, text, reference, reference_scores)
        weight = evidence(pixels).astype(similarity.dtype)
        confidence = answer_confidence(similarity, known, weight, reference_scores)
    if rules.retrieval_threshold is None and reference is not None:
        accepted = quantile >= rules.quantile
    else:
        judged = similarity if rules.logits is None else presence(embeddings, text, rules.logits)
        accepted = judged[anchor] >= rules.fixed_threshold
    return TextScores(similarity, known, anchor, accepted, quantile, confidence)


def _answering_regions(
    embeddings: Float[Array, "r e"],
    scores: TextScores,
    overlap: Float[Array, "r r"] | None,
    rules: QueryRules,
) -> Bool[Array, " r"]:
    """Finds which of R regions match one text, by the rule of `match_regions`."""
    chosen = jnp.arange(embeddings.shape[0]) == scores.anchor
    if rules.all_of_kind:
        chosen |= _reaches(scores.similarity, scores.known, rules.kind_threshold)
    if overlap is not None and rules.piece_threshold is not None:
        chosen |= is_piece(scores.similarity, scores.known, chosen, overlap, threshold=rules.piece_threshold)
    if rules.alike_threshold is not None:
        chosen |= _is_alike(embeddings, scores.anchor, rules.alike_threshold)
    return chosen & scores.known & scores.accepted


def _is_alike(
    embeddings: Float[Array, "r e"], region: Int[Array, ""], threshold: Number = ALIKE_THRESHOLD
) -> Bool[Array, " r"]:
    """Finds regions that are the same object as `region`: what sets both apart from the mean region is as similar."""
    residuals, known = mean_residuals(embeddings)
    cosines, comparable = similarities(residuals, residuals[region])
    return known & comparable & (cosines >= threshold)


def _reaches(similarity: Float[Array, " r"], known: Bool[Array, " r"], relative_score: Number) -> Bool[Array, " r"]:
    """Finds regions with a similarity of at least m + `relative_score` (b - m), m the median and b > m the largest."""
    middle = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    best = jnp.max(jnp.where(known, similarity, -jnp.inf))
    return known & (similarity >= middle + relative_score * (best - middle)) & (best > middle)


def is_piece(
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    chosen: Bool[Array, " r"],
    overlap: Float[Array, "r r"],
    *,
    threshold: Number = PIECE_THRESHOLD,
    min_overlap: Number = MIN_PIECE_OVERLAP,
) -> Bool[Array, " r"]:
    """Finds the regions that are pieces of the objects that chosen regions show. Pure.

    They overlap one of these. A second object of the kind is as similar, but has its own Gaussians.

    Args:
      similarity: (R,) similarities with the text.
      known: (R,) whether they mean something.
      chosen: (R,) the chosen regions.
      overlap: (R, R) `Votes.overlap`.
      threshold: Smallest relative score, 0 at the median region and 1 at the best.
      min_overlap: Smallest overlap.

    Returns:
      (R,) bool; False for all if all regions are equally similar.
    """
    overlaps = jnp.max(jnp.where(chosen[:, None], overlap, 0.0), axis=0) >= min_overlap
    return _reaches(similarity, known, threshold) & overlaps
