"""Questions whose answer is several regions: all the chairs; the mug, but not its handle."""

import re

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import InputError, require
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.query.anchored import NOTHING, RegionMatch, select_gaussians
from jsecon.query.match import (
    KIND_THRESHOLD,
    PIECE_THRESHOLD,
    QUANTILE,
    RETRIEVALS,
    Refusal,
    measured,
    regions_of_text,
    require_retrieval,
    unrelated_similarities,
    words_of,
)
from jsecon.query.similarity import Number
from jsecon.types import Array, LanguageField, Selection
from jsecon.vision.protocols import Logits

ROUNDING = 1e-5
"""similarities that differ by no more are equal: one text, wanted and unwanted, answers to neither"""
_QUOTES = "\"'“”"
_QUOTED = re.compile(r"""(?<!\S)(?:"[^"]+"|'.+?'|“[^”]+”)(?!\S)""", re.DOTALL)
"""a text in quotes: an apostrophe within a word is none"""
_JOINED = re.compile(r"\s+(?:(but\s+not)|or)(?=\s)", re.IGNORECASE)
"""what stands between the texts of a question"""


def query_several(
    field: LanguageField,
    wanted: Float[Array, "q e"],
    unwanted: Float[Array, "u e"] | None = None,
    *,
    several: bool = True,
    kind_threshold: Number = KIND_THRESHOLD,
    piece_threshold: Number = PIECE_THRESHOLD,
    retrieval: str = RETRIEVALS[0],
    quantile: Number = QUANTILE,
    retrieval_threshold: Number | None = None,
    similarity_threshold: Number = SHARE_THRESHOLD,
    logits: Logits | None = None,
) -> Selection:
    """The Gaussians of all regions that answer any of the wanted texts (Q, E) and none of the unwanted (U, E).

    A region answers a text by the rule of `regions_of_text`, on the similarities that `retrieval` names; `quantile`,
    `retrieval_threshold` and `logits` refuse a text as in `query_anchored`. One that answers a wanted and an unwanted
    text belongs to the one that it is more similar to, so that "mug but not handle" keeps the mug where the handle was
    never told apart. Membership is by votes, as in `query_anchored`: the share of the chosen regions is at least
    `similarity_threshold`. Selection.region is the best of the chosen, -1 where there is none; Selection.score its
    similarity. Pure: jit it or vmap it over texts. Raises ValueError on texts of another size.
    """
    how = {
        "kind_threshold": kind_threshold,
        "piece_threshold": piece_threshold,
        "retrieval": retrieval,
        "logits": logits,
    }
    how |= {"quantile": quantile, "retrieval_threshold": retrieval_threshold}
    found = found_of_several(field, wanted, unwanted, several=several, **how)
    return select_gaussians(field, found, similarity_threshold)


def found_of_several(
    field: LanguageField,
    wanted: Float[Array, "q e"],
    unwanted: Float[Array, "u e"] | None = None,
    *,
    several: bool = True,
    kind_threshold: Number = KIND_THRESHOLD,
    piece_threshold: Number = PIECE_THRESHOLD,
    retrieval: str = RETRIEVALS[0],
    quantile: Number = QUANTILE,
    retrieval_threshold: Number | None = None,
    logits: Logits | None = None,
) -> RegionMatch:
    """The regions of a field that answer any of the wanted texts and none of the unwanted, by the rules of
    `query_several`, whose errors it raises."""
    size = field.regions.embeddings.shape[1]
    unwanted = jnp.zeros((0, size)) if unwanted is None else jnp.asarray(unwanted)
    fit = wanted.shape[1] == size and unwanted.shape[1] == size and wanted.shape[0] >= 1
    found, expected = f"wanted {wanted.shape}, unwanted {unwanted.shape}", f"(Q >= 1, {size}) and (U, {size})"
    require(fit, "query_several", found, expected, "Embed the texts with the field's embedder.")
    require_retrieval("query_several", retrieval)
    if field.regions.count == 0:
        return NOTHING
    known = field.regions.embeddings, field.canonical, field.regions.pixels, field.votes.overlap
    given = jax.tree.map(jnp.asarray, (*known, wanted, unwanted))
    refusal, (words, retrieval) = Refusal(retrieval_threshold, quantile, logits), words_of(field, retrieval)
    return _retrieve(*given, words, refusal, kind_threshold, piece_threshold, several, retrieval)


def _retrieve_body(
    embeddings, canonical, pixels, overlap, wanted, unwanted, words, refusal, kind_threshold, pieces, several, retrieval
) -> RegionMatch:
    count, dtype = embeddings.shape[0], embeddings.dtype
    similar = None if words is None else unrelated_similarities(embeddings, words, canonical, pixels, retrieval)

    def answering(texts):
        chosen, closeness = jnp.zeros(count, bool), jnp.full(count, -jnp.inf, dtype)
        quantile = confidence = jnp.asarray(jnp.nan)
        for text in texts:
            found = measured(embeddings, text, canonical, pixels, words, similar, refusal, retrieval)
            rule = {"several": several, "kind_threshold": kind_threshold, "piece_threshold": pieces}
            rule |= {"standing": found.standing, "accepted": found.accepted}
            own = regions_of_text(embeddings, found.similarity, found.known, overlap, **rule)
            chosen, closeness = chosen | own, jnp.maximum(closeness, jnp.where(own, found.similarity, -jnp.inf))
            quantile = jnp.fmax(quantile, found.quantile)
            confidence = jnp.fmax(confidence, found.confidence)
        return chosen, closeness, quantile, confidence

    chosen, closeness, quantile, confidence = answering(wanted)
    refused, against, *_ = answering(unwanted)
    chosen &= ~(refused & (against >= closeness - ROUNDING))
    best, found = jnp.argmax(jnp.where(chosen, closeness, -jnp.inf)), jnp.any(chosen)
    score = jnp.where(found, closeness[best], 0.0)
    return RegionMatch(chosen, jnp.where(found, best, -1), score, quantile, confidence)


_retrieve = jax.jit(_retrieve_body, static_argnames=("several", "retrieval"))


def parts_of_question(question: str) -> tuple[list[str], list[str]]:
    """(wanted, unwanted) texts of a question such as `"red mug" or "bowl" but not "handle"`.

    Quotes may be left out. They are removed, and "or" and "but not" between a pair of them belong to the text: "tea or
    coffee" in quotes is one text. Raises InputError where a part is empty, or is not UTF-8.
    """
    if re.search("[\ud800-\udfff]", question):
        remedy = "Type it in a terminal, or send it from a program, that uses UTF-8."
        raise InputError("", f"the text {question!r} is not UTF-8", remedy=remedy)
    question = question.strip()
    quoted = [found.span() for found in _QUOTED.finditer(question)]
    parts, unwanted, start = ([], []), 0, 0
    for word in _JOINED.finditer(question):
        if not any(first < word.start() < last for first, last in quoted):
            parts[unwanted].append(question[start : word.start()])
            unwanted, start = max(unwanted, int(word[1] is not None)), word.end()
    parts[unwanted].append(question[start:])
    wanted, refused = ([part.strip().strip(_QUOTES).strip() for part in side] for side in parts)
    if not all(wanted + refused) or re.match(r"but not\b", question, re.IGNORECASE):
        remedy = 'For example: "red mug" or "bowl" but not "handle"'
        raise InputError(f"query {question!r}", "a part without words", 'texts joined by "or" and "but not"', remedy)
    return wanted, refused
