"""The anchored query (the paper's): text -> the region that answers it -> the Gaussians that carry that region.

The gap between a text's and an image's embedding is crossed once, among R regions, where only the order matters; the
Gaussians are then compared with a region of their own kind, so that almost any threshold does.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.errors import require
from jsecon.query.one_step import Codes, Number, as_codes, similarities
from jsecon.query.pieces import PIECE_NEARNESS, is_piece
from jsecon.query.pixel import region_at, region_shares_at
from jsecon.query.retrieval import answers, threshold_of
from jsecon.query.shares import gather_votes
from jsecon.query.units import UnitCodes
from jsecon.types import Array, LanguageField, Selection

__all__ = [
    "ALIKE_THRESHOLD",
    "CODE_THRESHOLD",
    "LEAD_THRESHOLD",
    "SHARE_THRESHOLD",
    "query_anchored",
    "query_region",
    "region_at",
    "region_shares_at",
]

CODE_THRESHOLD = 0.9
"""on the cosine of codes: codes that were distilled from one region lie within a few degrees (0.9 is 26)"""
SHARE_THRESHOLD = 0.5
"""on the share of votes: in the views that show the region, more of what is seen of the Gaussian lies inside it"""
LEAD_THRESHOLD = 0.5
"""on the lead: the region is the strongest, and most of what is seen of the Gaussian has a label"""


ALIKE_THRESHOLD = 0.95
"""on the cosine of two regions' embeddings: above it they are one thing seen twice, such as a track that broke. In demo
rooms pieces of one object lie above 0.94 and different objects below 0.8; without it a text that hits upon a piece seen
in two frames selects nothing (held-out mIoU 0.65 and 0.68 instead of 0.86 and 0.84, seeds 0 and 1)."""


class _Parts(NamedTuple):
    """What a query reads of a field; the rest need not pass into the compiled function."""

    embeddings: Array
    region_codes: Array
    codes: Codes
    regions: Array
    weights: Array
    labelled: Array
    total: Array
    views: Array
    shown: Array | None


def query_anchored(
    field: LanguageField,
    text_embedding: Float[Array, " e"],
    *,
    retrieval_threshold: Number | None = None,
    similarity_threshold: Number | None = None,
    by: str = "votes",
    retrieval: str = "contrast",
    alike_threshold: Number | None = ALIKE_THRESHOLD,
    piece_nearness: Number | None = PIECE_NEARNESS,
    unlabelled_weight: Number | None = None,
    codes: UnitCodes | None = None,
) -> Selection:
    """The Gaussians of the region that answers a text's embedding (E,) best.

    Retrieval: the region with the largest similarity, `retrieval`: "contrast", what sets the text apart from the
    canonical phrases against what sets the region apart from the scene (`contrasts` has the formula), or "cosine", the
    plain one (the paper). Where the largest is below `retrieval_threshold` (default 0.12 for contrast, 0.2 for cosine)
    nothing is selected, and Selection.region is -1; Selection.score is how much it was. Membership, `by`:
    "votes": the region's share of the weight with which the Gaussian was seen in the views that show the region
        (`Votes.shown`, from `with_shown`), an estimate of the probability that a pixel of it belongs to the region;
        default threshold 0.5. Votes that do not know which views show what are compared with the weight of all views;
        so are all where `unlabelled_weight` is given, which in [0, 1] says how much the weight on unlabelled pixels
        counts as evidence against (1: in full, as where it is None).
    "lead": the region's part of the votes of the two that matter, itself and the strongest other one, or the labelled
        part of all weight where that is less; default threshold 0.5. Where masks are cut, merged and lost, a region
        may be the strongest without ever having most of the votes.
    "code": cosine of the Gaussian's code with the region's (the paper); default threshold 0.9. `codes`, the result of
        `unit_codes(field.codes)`, spares many queries of one field the lengths of its codes.
    `alike_threshold`, not for "code": regions whose embedding has at least this cosine with the anchor's are the same
        thing as the text sees it (a track that broke, a twin), and their votes are added; None for the anchor alone.
        "code" needs no such rule, as regions that are alike have codes that are.
    `piece_nearness`, not for "code": where the votes know which regions overlap (`with_overlap`), those that overlap
        the anchor and answer the text nearly as well are pieces of the same thing (`is_piece` has the rule), and their
        votes are added too; None for none.
    Gaussians never seen, without a code, or with numbers that are not finite are never selected, nor regions without
    an embedding. Pure: jit it or vmap it over texts, with the field closed over. Raises ValueError on a text of
    another size.
    """
    size = field.regions.embeddings.shape[1]
    require(
        text_embedding.shape == (size,),
        "query_anchored",
        got=f"text {text_embedding.shape}",
        expected=f"({size},)",
        remedy=f"Embed the text with the field's embedder{f', {field.embedder}' if field.embedder else ''}.",
    )
    require(
        by in _THRESHOLDS,
        "query_anchored",
        got=f"by={by!r}",
        expected="'code', 'votes' or 'lead'",
        remedy="'votes' is the default.",
    )
    least = threshold_of(retrieval, retrieval_threshold, "query_anchored")
    if field.regions.count == 0:
        return _nothing(field)
    given = (field.regions.embeddings, text_embedding, field.canonical, field.regions.pixels)
    overlap = None if piece_nearness is None or by == "code" else field.votes.overlap
    overlap = None if overlap is None else jnp.asarray(overlap)
    region, score, pieces = _retrieve(*map(jnp.asarray, given), overlap, least, piece_nearness, retrieval)
    threshold = _THRESHOLDS[by] if similarity_threshold is None else similarity_threshold
    return _members(_parts(field, codes), region, pieces, score, threshold, alike_threshold, unlabelled_weight, by)


def query_region(
    field: LanguageField,
    region: int | Int[Array, ""],
    *,
    similarity_threshold: Number | None = None,
    by: str = "votes",
    alike_threshold: Number | None = None,
    unlabelled_weight: Number | None = None,
) -> Selection:
    """The Gaussians of region `region`, as found by `region_at`: `query_anchored` without the text; score 1.

    Regions that are alike are not joined unless asked for: who points at one of two red chairs means that one.

    Nothing for region -1 (or any other id that the field does not have): Selection.region is then -1 and its score 0.
    """
    require(
        by in _THRESHOLDS,
        "query_region",
        got=f"by={by!r}",
        expected="'code', 'votes' or 'lead'",
        remedy="'votes' is the default.",
    )
    if field.regions.count == 0:
        return _nothing(field)
    threshold = _THRESHOLDS[by] if similarity_threshold is None else similarity_threshold
    valid = (region >= 0) & (jnp.asarray(region) < field.regions.count)
    return _members(
        _parts(field),
        jnp.where(valid, region, -1),
        None,
        valid.astype(field.codes.dtype),
        threshold,
        alike_threshold,
        unlabelled_weight,
        by,
    )


_THRESHOLDS = {"code": CODE_THRESHOLD, "votes": SHARE_THRESHOLD, "lead": LEAD_THRESHOLD}


def _parts(field: LanguageField, codes: UnitCodes | None = None) -> _Parts:
    votes = field.votes
    return _Parts(
        *(
            as_codes(a)
            for a in (
                field.regions.embeddings,
                field.region_codes,
                field.codes if codes is None else codes,
                votes.regions,
                votes.weights,
                votes.labelled,
                votes.total,
                votes.views,
            )
        ),
        None if votes.shown is None else as_codes(votes.shown),
    )


def _nothing(field: LanguageField) -> Selection:
    n, dtype = field.codes.shape[0], jnp.asarray(field.codes).dtype
    return Selection(jnp.zeros(n, bool), jnp.zeros(n, dtype), jnp.asarray(-1, jnp.int32), jnp.zeros((), dtype))


def _retrieve_body(
    embeddings, text, canonical, pixels, overlap, least, nearness, retrieval
) -> tuple[Array, Array, Array | None]:
    """The region, -1 where none reaches `least`, its similarity, and (R,) its pieces where `overlap` is known."""
    similarity, known = answers(embeddings, text, canonical, pixels, retrieval)
    similarity = jnp.where(known, similarity, -jnp.inf)
    anchor = jnp.argmax(similarity)
    region = jnp.where(similarity[anchor] >= least, anchor, -1)
    own = jnp.arange(similarity.shape[0]) == anchor
    pieces = None if overlap is None else is_piece(similarity, known, own, overlap, nearness=nearness)
    return region, jnp.where(known[anchor], similarity[anchor], 0.0), pieces


def _members_body(parts, region, pieces, score, threshold, alike_threshold, unlabelled_weight, by) -> Selection:
    anchor = jnp.maximum(region, 0)
    count = parts.embeddings.shape[0]
    chosen = jnp.arange(count) == anchor
    if pieces is not None:
        chosen |= pieces
    if alike_threshold is not None and by != "code":
        alike, known = similarities(parts.embeddings, parts.embeddings[anchor])
        chosen |= known & (alike >= alike_threshold)
    seen = parts.views > 0
    if by != "code":
        shown = parts.shown if by == "votes" and unlabelled_weight is None else None
        weight, rival, seen_weight = gather_votes(parts.regions, parts.weights, chosen, shown)
        if seen_weight is None:
            part = 1.0 if unlabelled_weight is None else unlabelled_weight
            seen_weight = parts.labelled + part * jnp.maximum(parts.total - parts.labelled, 0.0)
        known = seen & (seen_weight > 0) & jnp.isfinite(seen_weight) & jnp.isfinite(weight)
        similarity = jnp.clip(weight / jnp.where(known, seen_weight, 1.0), 0.0, 1.0)
        if by == "lead":
            labelled = jnp.clip(parts.labelled / jnp.where(known, seen_weight, 1.0), 0.0, 1.0)
            # The ratio to the larger of the two cannot overflow.
            larger = jnp.maximum(jnp.maximum(weight, rival), jnp.finfo(weight.dtype).tiny)
            lead = (weight / larger) / jnp.maximum(weight / larger + rival / larger, 1.0)
            known = known & jnp.isfinite(rival)
            similarity = jnp.minimum(lead, labelled)
    else:
        similarity, known = similarities(parts.codes, parts.region_codes[anchor])
        known = known & seen
    similarity = jnp.where(known & (region >= 0), similarity, 0.0)
    mask = known & (region >= 0) & (similarity >= threshold)
    return Selection(mask, similarity, jnp.asarray(region, jnp.int32), score)


# Apart, so that fields of any number of Gaussians share the one, and a text and a pixel the other.
_retrieve = jax.jit(_retrieve_body, static_argnames="retrieval")
_members = jax.jit(_members_body, static_argnames="by")
