"""The anchored query (the paper's): text -> the region that answers it -> the Gaussians that carry that region.

The gap between a text's and an image's embedding is crossed once, among R regions, where only the order matters; the
Gaussians are then compared with a region of their own kind, so that almost any threshold does.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.errors import require_one_of, require_shape
from jsecon.language.codes import CODE_THRESHOLD
from jsecon.language.membership import SHARE_THRESHOLD, share_of, vote_blocks
from jsecon.language.regions import ALIKE_THRESHOLD
from jsecon.query.match import (
    PIECE_THRESHOLD,
    QUANTILE,
    RETRIEVALS,
    Refusal,
    is_alike,
    is_piece,
    measured,
    regions_of_text,
    require_retrieval,
    unrelated_similarities,
    words_of,
)
from jsecon.query.similarity import Number, UnitCodes, as_codes, similarities
from jsecon.types import Array, LanguageField, Selection
from jsecon.vision.protocols import Logits

THRESHOLDS = {"votes": SHARE_THRESHOLD, "code": CODE_THRESHOLD}


class RegionMatch(NamedTuple):
    """What a question found among R regions."""

    chosen: Bool[Array, " r"]
    """the regions that answer it."""
    region: Int[Array, ""]
    """the best of them, -1 where there is none."""
    score: Float[Array, ""]
    """similarity of the best region, chosen or not; 0 where nothing is known."""
    quantile: Float[Array, ""] | np.ndarray = np.asarray(np.nan, np.float32)
    """share of unrelated words that are less similar to their best region; NaN where there are no such words."""
    confidence: Float[Array, ""] | np.ndarray = np.asarray(np.nan, np.float32)
    """probability that the best region shows what the text names (`answer_confidence`); NaN without such words."""


NOTHING = RegionMatch(np.zeros(0, bool), np.asarray(-1, np.int32), np.asarray(0.0, np.float32))
"""of a field without regions"""


def query_anchored(
    field: LanguageField,
    text_embedding: Float[Array, " e"],
    *,
    quantile: Number = QUANTILE,
    retrieval_threshold: Number | None = None,
    similarity_threshold: Number | None = None,
    by: str = "votes",
    retrieval: str = RETRIEVALS[0],
    alike_threshold: Number | None = ALIKE_THRESHOLD,
    piece_threshold: Number | None = PIECE_THRESHOLD,
    codes: UnitCodes | None = None,
    logits: Logits | None = None,
) -> Selection:
    """The Gaussians of the region that answers a text's embedding (E,) best.

    Retrieval: the region with the largest similarity, times what stands behind its embedding (`evidence`).
    `retrieval`: "apart", the cosine with what sets the text apart from the unrelated words `field.reference`
    (`direction`); "contrast", what sets the text apart from the canonical phrases against what sets the region apart
    from the scene (`contrasts`), as "apart" is of a field without such words; "cosine", the plain one, without evidence
    (the paper). Selection.score is how much it is, Selection.quantile the share of unrelated words that are less
    similar to the scene (`quantile_among`). Nothing is selected, and Selection.region is -1, where that is below
    `quantile`: of texts that name nothing in the scene about 1 - quantile are answered. `retrieval_threshold` is a
    threshold on the similarity in its place (the paper's; with the embedder's `logits` on the probability that the text
    is true of that region, `presence`), and of a field without such words the only one: 0.12 for contrast, 0.2 for
    cosine, 0.01 for a probability. Membership, `by`:
    "votes": the share of the region and of those that are the same thing as the text sees it, an estimate of the
        probability that a pixel of the Gaussian belongs to them (`share_of`); default threshold 0.5. The same thing
        are regions alike, by `alike_threshold`, and pieces, by `piece_threshold` where the votes know which regions
        overlap (`regions_of_text` has the rule); None for none.
    "code": cosine of the Gaussian's code with the region's (the paper); default threshold 0.9. It joins no regions, as
        those that are alike have codes that are. `codes`, the result of `unit_codes(field.codes)`, spares many queries
        of one field the lengths of its codes.
    Gaussians never seen, without a code, or with numbers that are not finite are never selected, nor regions without
    an embedding. Pure: jit it or vmap it over texts, with the field closed over. Raises ValueError on a text of
    another size.
    """
    require_one_of("query_anchored", by, THRESHOLDS, "'votes' is the default.")
    require_retrieval("query_anchored", retrieval)
    how = {"alike_threshold": alike_threshold, "piece_threshold": piece_threshold, "logits": logits}
    how |= {"quantile": quantile, "retrieval_threshold": retrieval_threshold}
    found = found_of(field, text_embedding, retrieval=retrieval, **how)
    return select_gaussians(field, found, similarity_threshold, by=by, codes=codes)


def found_of(
    field: LanguageField,
    text_embedding: Float[Array, " e"],
    *,
    quantile: Number = QUANTILE,
    retrieval_threshold: Number | None = None,
    retrieval: str = RETRIEVALS[0],
    alike_threshold: Number | None = ALIKE_THRESHOLD,
    piece_threshold: Number | None = PIECE_THRESHOLD,
    logits: Logits | None = None,
) -> RegionMatch:
    """The regions of a field that answer a text's embedding (E,), by the rules of `query_anchored`, whose errors it
    raises."""
    size = field.regions.embeddings.shape[1]
    remedy = f"Embed the text with the field's embedder{f', {field.embedder}' if field.embedder else ''}."
    require_shape("text_embedding", text_embedding, (size,), remedy)
    require_retrieval("found_of", retrieval)
    if field.regions.count == 0:
        return NOTHING
    given = field.regions.embeddings, text_embedding, field.canonical, field.regions.pixels, field.votes.overlap
    refusal = Refusal(retrieval_threshold, quantile, logits)
    words, retrieval = words_of(field, retrieval)
    return _retrieve(*jax.tree.map(jnp.asarray, given), words, refusal, alike_threshold, piece_threshold, retrieval)


def query_region(
    field: LanguageField,
    region: int | Int[Array, ""],
    *,
    similarity_threshold: Number | None = None,
    by: str = "votes",
    alike_threshold: Number | None = None,
    piece_threshold: Number | None = None,
) -> Selection:
    """The Gaussians of region `region`, as found by `region_at`: `query_anchored` without the text; score 1.

    Regions that are alike are not joined unless asked for: who points at one of two red chairs means that one. Nor are
    pieces (`regions_of_text`), with the region's own embedding in place of a text's.

    Nothing for region -1 (or any other id that the field does not have): Selection.region is then -1 and its score 0.
    """
    require_one_of("query_region", by, THRESHOLDS, "'votes' is the default.")
    found = found_region(field, region, alike_threshold=alike_threshold, piece_threshold=piece_threshold)
    return select_gaussians(field, found, similarity_threshold, by=by)


def found_region(
    field: LanguageField,
    region: int | Int[Array, ""],
    *,
    alike_threshold: Number | None = None,
    piece_threshold: Number | None = None,
) -> RegionMatch:
    """Region `region` and what is joined to it, by the rules of `query_region`."""
    if field.regions.count == 0:
        return NOTHING
    known = jnp.asarray(field.regions.embeddings), field.votes.overlap
    return _found_region(*known, jnp.asarray(region), alike_threshold, piece_threshold)


def select_gaussians(
    field: LanguageField,
    found: RegionMatch,
    threshold: Number | None,
    *,
    by: str = "votes",
    codes: UnitCodes | None = None,
) -> Selection:
    """The Gaussians of the regions found: "votes", of all that were chosen, or "code", of the best of them."""
    if field.regions.count == 0:
        return _nothing(field)
    threshold = THRESHOLDS[by] if threshold is None else threshold
    if isinstance(field.votes.regions, np.memmap) and codes is None:
        parts = [jax.tree.map(np.asarray, part) for part in select_by_block(field, [found], threshold, by=by)]
        mask, similarity = (np.concatenate([getattr(p[0], name) for p in parts]) for name in ("mask", "similarity"))
        return Selection(
            mask,
            similarity,
            found.region.astype(jnp.int32),
            found.score,
            jnp.asarray(found.quantile),
            jnp.asarray(found.confidence),
        )
    if by == "votes":
        return _by_share(jax.tree.map(jnp.asarray, field.votes), found, threshold)
    seen, table = jnp.asarray(field.votes.views) > 0, jnp.asarray(field.region_codes)
    return _by_code(as_codes(field.codes if codes is None else codes), table, seen, found, threshold)


def select_by_block(
    field: LanguageField, several: Sequence[RegionMatch], threshold: Number | None, *, by: str = "votes"
) -> Iterator[list[Selection]]:
    """`members` of one question after the other, for each block of Gaussians: the columns are read once."""
    threshold = THRESHOLDS[by] if threshold is None else threshold
    table = jnp.asarray(field.region_codes)
    first = 0
    for votes in vote_blocks(field.votes):
        rows = slice(first, first := first + len(votes.views))
        if by == "votes":
            yield [_by_share(votes, found, threshold) for found in several]
            continue
        codes = jnp.asarray(field.codes[rows])
        yield [_by_code(codes, table, votes.views > 0, found, threshold) for found in several]


def _nothing(field: LanguageField) -> Selection:
    """The answer of a field without regions."""
    count, dtype = field.codes.shape[0], jnp.asarray(field.codes).dtype
    return Selection(jnp.zeros(count, bool), jnp.zeros(count, dtype), jnp.asarray(-1, jnp.int32), jnp.zeros((), dtype))


# Apart from the choice of Gaussians, so that fields of any size share the one, and a text and a pixel the other.
def _retrieve_body(
    embeddings, text, canonical, pixels, overlap, words, refusal, alike, nearness, retrieval
) -> RegionMatch:
    similar = None if words is None else unrelated_similarities(embeddings, words, canonical, pixels, retrieval)
    found = measured(embeddings, text, canonical, pixels, words, similar, refusal, retrieval)
    rule = {"standing": found.standing, "accepted": found.accepted}
    rule |= {"alike_threshold": alike, "piece_threshold": nearness}
    chosen = regions_of_text(embeddings, found.similarity, found.known, overlap, several=False, **rule)
    best, known = found.anchor, found.known[found.anchor]
    score, quantile = jnp.where(known, found.similarity[best], 0.0), jnp.where(known, found.quantile, jnp.nan)
    return RegionMatch(chosen, jnp.where(chosen[best], best, -1), score, quantile, found.confidence)


_retrieve = jax.jit(_retrieve_body, static_argnames="retrieval")


@jax.jit
def _found_region(
    embeddings: Array, overlap: Array | None, region: Array, alike_threshold: Number | None, nearness: Number | None
) -> RegionMatch:
    valid = (region >= 0) & (region < embeddings.shape[0])
    chosen = jnp.arange(embeddings.shape[0]) == region
    if nearness is not None and overlap is not None:
        cosines, known = similarities(embeddings, embeddings[jnp.maximum(region, 0)])
        chosen |= is_piece(cosines, known, chosen, overlap, nearness=nearness)
    if alike_threshold is not None:
        chosen |= is_alike(embeddings, jnp.maximum(region, 0), alike_threshold)
    return RegionMatch(chosen & valid, jnp.where(valid, region, -1), valid.astype(embeddings.dtype))


@jax.jit
def _by_share(votes, found: RegionMatch, threshold: Number) -> Selection:
    share, known = share_of(votes, found.chosen)
    mask = known & (share >= threshold) & (found.region >= 0)
    return Selection(mask, share, found.region.astype(jnp.int32), found.score, found.quantile, found.confidence)


@jax.jit
def _by_code(codes, region_codes, seen, found: RegionMatch, threshold: Number) -> Selection:
    similarity, known = similarities(codes, region_codes[jnp.maximum(found.region, 0)])
    known &= seen & (found.region >= 0)
    mask = known & (similarity >= threshold)
    similarity = jnp.where(known, similarity, 0.0)
    return Selection(mask, similarity, found.region.astype(jnp.int32), found.score, found.quantile, found.confidence)
