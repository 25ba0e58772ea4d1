"""Questions whose answer is several regions: all the chairs; the mug, but not its handle."""

import re

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.errors import InputError, require
from jsecon.query.anchored import ALIKE_THRESHOLD, SHARE_THRESHOLD
from jsecon.query.one_step import Number, similarities
from jsecon.query.pieces import is_near, is_piece
from jsecon.query.retrieval import answers, threshold_of
from jsecon.query.shares import gather_votes
from jsecon.types import Array, LanguageField, Selection

NEARNESS = 0.8
"""a region answers a text with the best one where its similarity has come at least so far from that of the middle
region to that of the best"""

ROUNDING = 1e-5
"""similarities that differ by no more are equal: one text, wanted and unwanted, answers to neither"""


def regions_of_text(
    embeddings: Float[Array, "r e"],
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    overlap: Float[Array, "r r"] | None = None,
    *,
    retrieval_threshold: Number,
    several: bool = True,
    nearness: Number = NEARNESS,
    alike_threshold: Number = ALIKE_THRESHOLD,
) -> Bool[Array, " r"]:
    """Which of R regions answer a text that each has a similarity with (R,), where that is known (R,).

    The rule: the region with the largest similarity, if that is at least `retrieval_threshold`; with it all regions
    alike (cosine of the embeddings (R, E) at least `alike_threshold`: one thing seen twice). With `several` also every
    region near the text (`is_near`, with `nearness`). Where it is known how far the regions overlap (R, R), with all of
    these their pieces (`is_piece`).
    """
    scored = jnp.where(known, similarity, -jnp.inf)
    anchor = jnp.argmax(scored)
    best = scored[anchor]
    alike, known_alike = similarities(embeddings, embeddings[anchor])
    chosen = (jnp.arange(embeddings.shape[0]) == anchor) | (known_alike & (alike >= alike_threshold))
    if several:
        chosen |= is_near(similarity, known, nearness)
    if overlap is not None:
        chosen |= is_piece(similarity, known, chosen, overlap)
    return chosen & known & (best >= retrieval_threshold)


def query_several(
    field: LanguageField,
    wanted: Float[Array, "q e"],
    unwanted: Float[Array, "u e"] | None = None,
    *,
    several: bool = True,
    nearness: Number = NEARNESS,
    retrieval: str = "contrast",
    retrieval_threshold: Number | None = None,
    similarity_threshold: Number = SHARE_THRESHOLD,
) -> Selection:
    """The Gaussians of all regions that answer any of the wanted texts (Q, E) and none of the unwanted (U, E).

    A region answers a text by the rule of `regions_of_text`, on the similarities that `retrieval` names, as in
    `query_anchored`. One that answers a wanted and an unwanted text belongs to the one that it is more similar to, so
    that "mug but not handle" keeps the mug where the handle was never told apart. Membership is by votes, as in
    `query_anchored`: of the weight with which a Gaussian was seen in the views that show a chosen region, at least
    `similarity_threshold` lies on the chosen ones. Selection.region is the best of the chosen, -1 where there is none;
    Selection.score its similarity. Pure: jit it or vmap it over texts. Raises
    ValueError on texts of another size.
    """
    size = field.regions.embeddings.shape[1]
    unwanted = jnp.zeros((0, size)) if unwanted is None else jnp.asarray(unwanted)
    require(
        wanted.shape[1] == size and unwanted.shape[1] == size and wanted.shape[0] >= 1,
        "query_several",
        got=f"wanted {wanted.shape}, unwanted {unwanted.shape}",
        expected=f"(Q >= 1, {size}) and (U, {size})",
        remedy="Embed the texts with the field's embedder.",
    )
    votes, known = field.votes, (field.regions.embeddings, field.regions.pixels, field.canonical)
    return _several(
        *(jnp.asarray(a) for a in (*known, votes.regions, votes.weights, votes.total, votes.views)),
        *(None if a is None else jnp.asarray(a) for a in (votes.shown, votes.overlap)),
        jnp.asarray(wanted),
        unwanted,
        several,
        nearness,
        threshold_of(retrieval, retrieval_threshold, "query_several"),
        similarity_threshold,
        retrieval,
    )


def _several_body(
    embeddings,
    pixels,
    canonical,
    regions,
    weights,
    total,
    views,
    shown,
    overlap,
    wanted,
    unwanted,
    several,
    nearness,
    least,
    threshold,
    retrieval,
) -> Selection:
    count = embeddings.shape[0]
    if count == 0:
        nothing = jnp.zeros(regions.shape[0], weights.dtype)
        return Selection(nothing > 0, nothing, jnp.int32(-1), jnp.zeros((), weights.dtype))

    def answering(texts):
        chosen, closeness = jnp.zeros(count, bool), jnp.full(count, -jnp.inf, embeddings.dtype)
        for text in texts:
            similarity, known = answers(embeddings, text, canonical, pixels, retrieval)
            own = regions_of_text(
                embeddings, similarity, known, overlap, retrieval_threshold=least, several=several, nearness=nearness
            )
            chosen, closeness = chosen | own, jnp.maximum(closeness, jnp.where(own, similarity, -jnp.inf))
        return chosen, closeness

    chosen, closeness = answering(wanted)
    refused, against = answering(unwanted)
    chosen &= ~(refused & (against >= closeness - ROUNDING))
    weight, _, seen = gather_votes(regions, weights, chosen, shown)
    seen = total if seen is None else seen
    known = (views > 0) & (seen > 0) & jnp.isfinite(seen) & jnp.isfinite(weight) & jnp.any(chosen)
    share = jnp.where(known, jnp.clip(weight / jnp.where(known, seen, 1.0), 0.0, 1.0), 0.0)
    best = jnp.argmax(jnp.where(chosen, closeness, -jnp.inf))
    found = jnp.any(chosen)
    return Selection(
        known & (share >= threshold),
        share,
        jnp.where(found, best, -1).astype(jnp.int32),
        jnp.where(found, closeness[best], 0.0),
    )


_several = jax.jit(_several_body, static_argnames=("several", "retrieval"))


def parts_of_question(question: str) -> tuple[list[str], list[str]]:
    """(wanted, unwanted) texts of a question such as `"red mug" or "bowl" but not "handle"`; quotes may be left out.

    Raises InputError where a part is empty.
    """
    first, *rest = re.split(r"\s+but not\s+", question.strip(), flags=re.IGNORECASE)
    sides = [re.split(r"\s+or\s+", side, flags=re.IGNORECASE) for side in (first, *rest)]
    sides = [[part.strip().strip("\"'").strip() for part in side] for side in sides]
    if not all(part for side in sides for part in side) or re.fullmatch(r"but not\b.*", question.strip().lower()):
        raise InputError(
            question,
            found="a part without words",
            expected='texts joined by "or" and "but not"',
            remedy='For example: "red mug" or "bowl" but not "handle"',
        )
    return sides[0], [part for side in sides[1:] for part in side]
