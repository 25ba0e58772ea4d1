"""From a text to the regions that answer it: what sets the text apart from other texts against what sets a region apart
from the other regions; and which regions are the same thing, of the same kind, or pieces of it.

In a space such as CLIP's all texts lie in one narrow cone and all images in another. A cosine between the two is mostly
that of the cones, and where a region's embedding is noisy it is decided by how far the noise points along them. Both
are the same for every text and every region of a scene, so that both can be taken out.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Shaped

from jsecon.errors import require_one_of
from jsecon.language.regions import ALIKE_THRESHOLD, mean_residuals
from jsecon.numerics import cosine_matrix, normalize
from jsecon.query.confidence import answer_confidence
from jsecon.query.similarity import Number, similarities
from jsecon.types import Array, LanguageField, Regions
from jsecon.vision.protocols import Logits

RETRIEVALS = ("apart", "contrast", "cosine")
"""how a text finds its region: by what sets it apart from unrelated words, by `contrasts`, or by the plain cosine (the
paper)"""
CONTRAST_THRESHOLD = 0.12
"""on the contrast: below it nothing in the scene answers the text. A low one: with simulated CLIP it refuses 63 to 82 %
of the texts of what is not there and 0 to 6 % of the others; 0.15 refuses 86 to 97 % and 0 to 14 %; no cosine does so
(experiments/retired.md)"""
RETRIEVAL_THRESHOLD = 0.2
"""The paper's "low threshold to filter invalid prompts" on the cosine, which it does not state. In CLIP ViT-B/16 an
image has a cosine of about 0.25 to 0.35 with a text that fits and 0.1 to 0.2 with one that does not; spaces without
CLIP's gap are far above for texts that fit."""
QUANTILE = 0.82
"""Least share of unrelated words (`LanguageField.reference`) that a text must be more similar to the scene than. It is
the least that refuses 0.8 of the texts of what is not there with simulated CLIP at medium noise. Refused of these, and
kept of the others: there 0.81 and 0.95, with errors that views share 0.78 and 0.49; on real words (ConSE, 15 classes of
replica_apartment_0) 0.96 and 0.93, with jsecon's own masks 0.95 and 0.73."""
RELATED = 0.1
"""of the unrelated words, the nearest to a text are left out: what is like a thing of the scene is often there too"""
PRESENCE_THRESHOLD = 0.01
"""on the probability that a text is true of a region (`presence`), where the embedder has one. It is a probability at
the odds of the training, one true pair in a batch of 32,768 (SigLIP, arXiv 2303.15343): there 0.01 says that the pair
is 300 times likelier true than at random. Half would refuse what is there: the example of
google/siglip2-base-patch16-224 gives its true text 0.106. Not measured here: no trained weights could be had."""
KIND_THRESHOLD = 0.75
"""all of a kind: how far a region's similarity has come from that of the middle region to that of the best"""
PIECE_THRESHOLD = 0.5
"""a piece: nearer to the best than to the middle region"""
LOOKS, LOOK_PX = 2.0, 400.0
"""of a region, see `evidence`; a crop of 20 x 20 pixels shows an image encoder little"""
MIN_PIECE_OVERLAP = 0.1
"""the least soft IoU of two regions' Gaussians where the two are pieces of one thing. In twins of two scenes (simulated
vision, little to much noise) 106 of the 115 pieces that are near enough reach it, and 4 of 58 other regions"""


def scene_residuals(
    embeddings: Float[Array, "r e"], pixels: Shaped[Array, "r t"]
) -> tuple[Float[Array, "r e"], Bool[Array, " r"]]:
    """What sets each of R regions apart from the scene (R, E), and which regions have an embedding (R,); 0 elsewhere.

        e_r - n / (n + 1) sum_q p_q e_q / sum_q p_q

    with unit embeddings e of the n regions that have one, and p their pixels in all views (R, T) (where there are none,
    regions count alike). The factor keeps a region from being all that it is measured against: a single region keeps
    its own direction. Large regions, which make up most of the mean, lie nearest to it.
    """
    units = normalize(embeddings)
    known = jnp.all(jnp.isfinite(units), axis=-1) & jnp.any(units != 0, axis=-1)
    units = jnp.where(known[:, None], units, 0.0)
    weight = jnp.where(known, jnp.sum(pixels, axis=-1, dtype=units.dtype), 0.0)
    weight = jnp.where(jnp.sum(weight) > 0, weight, known)
    count, total = jnp.sum(known, dtype=units.dtype), jnp.sum(weight)
    mean = jnp.sum(weight[:, None] * units, axis=0) / jnp.where(total > 0, total, 1.0)
    return jnp.where(known[:, None], units - count / (count + 1) * mean, 0.0), known


def phrase_residuals(texts: Float[Array, "*batch e"], canonical: Float[Array, "c e"]) -> Float[Array, "*batch e"]:
    """What sets unit texts (..., E) apart from the canonical phrases (C, E): t - (t . c) c, c the direction of their
    mean; 0 for a text along it."""
    phrases = normalize(canonical)
    sound = jnp.all(jnp.isfinite(phrases), axis=-1, keepdims=True)
    cone = normalize(jnp.sum(jnp.where(sound, phrases, 0.0), axis=0))
    unit = normalize(texts)
    across = unit - jnp.sum(unit * cone, axis=-1, keepdims=True) * cone
    # What rounding leaves of a text along the cone is no direction.
    rest = 8 * jnp.finfo(across.dtype).eps
    left = jnp.sum(across * across, axis=-1, keepdims=True) > rest**2
    return jnp.where(left, across, jnp.where(jnp.isfinite(unit), 0.0, jnp.nan))


def contrasts(
    embeddings: Float[Array, "r e"],
    text: Float[Array, " e"],
    canonical: Float[Array, "c e"],
    pixels: Shaped[Array, "r t"],
) -> tuple[Float[Array, " r"], Bool[Array, " r"]]:
    """How far R regions answer a text (E,), in [-1, 1], and where that means something (R,); 0 elsewhere.

        cos(e_r - n / (n + 1) sum_q p_q e_q / sum_q p_q,  t - (t . c) c)

    with the first as in `scene_residuals`, t the unit text and c the direction of the mean canonical phrase (C, E),
    each of unit length; phrases that are zero or not finite are left out, and without any c is zero. Removing what two
    sets of embeddings have in common before they are compared is an old remedy for hubs and for the modality gap;
    experiments/retired.md measures it here against the cosine and LERF's relevancy. A text along c is like no region.
    """
    apart, known = scene_residuals(embeddings, pixels)
    found, measured = similarities(apart, phrase_residuals(text, canonical))
    known &= measured
    return jnp.where(known, found, 0.0), known


def direction(
    text: Float[Array, "*batch e"], canonical: Float[Array, "c e"], words: Float[Array, "w e"] | None, retrieval: str
) -> Float[Array, "*batch e"]:
    """What of texts (..., E) is held against regions. Of the kind "apart" t - mean_w t_w, with t and the W unrelated
    words t_w of unit length: all texts of a space have much in common, and some have more of it than others."""
    if retrieval == "apart":
        assert words is not None
        return normalize(text) - jnp.mean(normalize(words.astype(text.dtype)), axis=0)
    return phrase_residuals(text, canonical) if retrieval == "contrast" else normalize(text)


def unrelated_similarities(
    embeddings: Float[Array, "r e"],
    words: Float[Array, "w e"],
    canonical: Float[Array, "c e"],
    pixels: Shaped[Array, "r t"],
    retrieval: str,
) -> Float[Array, "w r"]:
    """The similarity of each of W unrelated words with each region (W, R), as `answers` has that of a text; NaN where
    it means nothing."""
    words = words.astype(embeddings.dtype)
    rows = scene_residuals(embeddings, pixels)[0] if retrieval == "contrast" else embeddings
    words = direction(words, canonical, words, retrieval)
    # As one product of matrices: W queries of their own would walk all regions W times.
    known = jnp.any(words != 0, axis=1)[:, None] & jnp.any(rows != 0, axis=1)
    return jnp.where(known, cosine_matrix(words, rows), jnp.nan)


def quantile_among(
    best: Float[Array, ""], text: Float[Array, " e"], words: Float[Array, "w e"], similar: Float[Array, "w r"]
) -> Float[Array, ""]:
    """The share of W unrelated words (W, E) whose largest similarity with any region, of `similar` (W, R), is below the
    text's `best`. The RELATED share of them that is nearest to the text is left out; 1 where none is left that is
    similar to anything."""
    scores = jnp.max(jnp.where(jnp.isfinite(similar), similar, -jnp.inf), axis=1)
    units = normalize(words.astype(text.dtype))
    mean = jnp.mean(units, axis=0)
    near = cosine_matrix((normalize(text) - mean)[None], units - mean)[0]
    order = jnp.argsort(-near)[int(RELATED * len(words)) :]
    scores = scores[order]
    known = jnp.isfinite(scores)
    below = jnp.sum(known & (scores < best), dtype=text.dtype)
    return jnp.where(jnp.any(known), below / jnp.maximum(jnp.sum(known), 1), 1.0)


def presence(embeddings: Float[Array, "r e"], text: Float[Array, " e"], logits: Logits) -> Float[Array, " r"]:
    """P(a text (E,) is true of a region) of R regions' embeddings (R, E), by the sigmoid that the embedder was trained
    with: sigmoid(scale cos(e_r, t) + bias). 0 where either is no direction."""
    cosines, known = similarities(embeddings, text)
    return jnp.where(known, jax.nn.sigmoid(logits.scale * cosines + logits.bias), 0.0)


def best_presence(
    regions: Regions, texts: Float[Array, "q e"], region: Int[Array, ""], logits: Logits | None
) -> float | None:
    """The largest `presence` of any of Q texts in `region`, of -1 in any region; None without `logits`. Host code."""
    if logits is None or regions.count == 0:
        return None
    found = jnp.stack([presence(jnp.asarray(regions.embeddings), text, logits) for text in texts]).max(axis=0)
    return float(found[region] if int(region) >= 0 else found.max())


def evidence(pixels: Shaped[Array, "r t"]) -> Float[Array, " r"]:
    """How much stands behind each of R regions' embeddings, in (0, 1], from its pixels in T views.

        n_r / (n_r + LOOKS) over its largest value,  n_r = sum_t min(pixels_rt / LOOK_PX, 1)

    A sliver that few views show is of one colour, so that its embedding is purer than that of the thing that it is a
    sliver of: what it says is worth less. 1 everywhere where no pixels are known.
    """
    looks = jnp.sum(jnp.minimum(jnp.asarray(pixels) / LOOK_PX, 1.0), axis=-1)
    behind = looks / (looks + LOOKS)
    most = jnp.max(behind, initial=0.0)
    return jnp.where(most > 0, behind / jnp.where(most > 0, most, 1.0), 1.0)


def answers(
    embeddings: Float[Array, "r e"],
    text: Float[Array, " e"],
    canonical: Float[Array, "c e"],
    words: Float[Array, "w e"] | None,
    pixels: Shaped[Array, "r t"],
    retrieval: str,
) -> tuple[Float[Array, " r"], Bool[Array, " r"]]:
    """How far R regions answer a text (E,), in [-1, 1], and where that means something (R,), by `retrieval`, one of
    RETRIEVALS: `contrasts`, or the cosines of the regions with the text's `direction`."""
    if retrieval == "contrast":
        return contrasts(embeddings, text, canonical, pixels)
    return similarities(embeddings, direction(text, canonical, words, retrieval))


def require_retrieval(where: str, retrieval: str) -> None:
    """Raises ValueError, naming the function `where`, unless `retrieval` is one of RETRIEVALS."""
    require_one_of(where, retrieval, RETRIEVALS, f"{RETRIEVALS[0]!r} is the default.")


class Measured(NamedTuple):
    """How far R regions answer a text, and whether any does."""

    similarity: Float[Array, " r"]
    known: Bool[Array, " r"]
    """where the similarity means something."""
    standing: Float[Array, " r"] | None
    """`evidence`; None for the plain cosine."""
    anchor: Int[Array, ""]
    """the best region (`anchor_of`)."""
    accepted: Bool[Array, ""]
    """whether the scene answers the text."""
    quantile: Float[Array, ""]
    """`quantile_among` of the largest similarity; NaN without unrelated words."""
    confidence: Float[Array, ""]
    """`answer_confidence`; NaN without unrelated words."""


class Refusal(NamedTuple):
    """What a text is refused by; of the two the `threshold` where it is given, or where a field has no unrelated words
    that of the kind of retrieval."""

    threshold: Number | None = None
    """on the similarity, with `logits` on the probability."""
    quantile: Number = QUANTILE
    """on `quantile_among`."""
    logits: Logits | None = None


def measured(
    embeddings: Float[Array, "r e"],
    text: Float[Array, " e"],
    canonical: Float[Array, "c e"],
    pixels: Shaped[Array, "r t"],
    words: Float[Array, "w e"] | None,
    similar: Float[Array, "w r"] | None,
    refusal: Refusal,
    retrieval: str,
) -> Measured:
    """R regions held against a text; `words` (W, E) and `similar`, their `unrelated_similarities`, are None where a
    field has no such words."""
    similarity, known = answers(embeddings, text, canonical, words, pixels, retrieval)
    standing = None if retrieval == "cosine" else evidence(pixels).astype(similarity.dtype)
    anchor = anchor_of(similarity, known, standing)
    quantile = confidence = jnp.asarray(jnp.nan, similarity.dtype)
    if words is not None and similar is not None:
        best = jnp.max(jnp.where(known, similarity, -jnp.inf))
        quantile = quantile_among(best, text, words, similar)
        confidence = answer_confidence(similarity, known, evidence(pixels).astype(similarity.dtype), similar)
    if refusal.threshold is None and words is not None:
        accepted = quantile >= refusal.quantile
    else:
        on = similarity if refusal.logits is None else presence(embeddings, text, refusal.logits)
        accepted = on[anchor] >= fixed_threshold(refusal, retrieval)
    return Measured(similarity, known, standing, anchor, accepted, quantile, confidence)


def fixed_threshold(refusal: Refusal, retrieval: str) -> Number:
    """The threshold that is given, or that of the kind of retrieval; with logits that on the probability."""
    if refusal.threshold is not None:
        return refusal.threshold
    if refusal.logits is not None:
        return PRESENCE_THRESHOLD
    return RETRIEVAL_THRESHOLD if retrieval == "cosine" else CONTRAST_THRESHOLD


def words_of(field: LanguageField, retrieval: str) -> tuple[Array | None, str]:
    """The embeddings (W, E) of a field's unrelated words, None where it has none, and the kind of retrieval: without
    words that is the contrast where "apart" is asked for."""
    if field.reference is None or not len(field.reference):
        return None, "contrast" if retrieval == "apart" else retrieval
    return jnp.asarray(field.reference), retrieval


def regions_of_text(
    embeddings: Float[Array, "r e"],
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    overlap: Float[Array, "r r"] | None = None,
    *,
    several: bool = True,
    kind_threshold: Number = KIND_THRESHOLD,
    alike_threshold: Number | None = ALIKE_THRESHOLD,
    piece_threshold: Number | None = PIECE_THRESHOLD,
    standing: Float[Array, " r"] | None = None,
    accepted: Bool[Array, ""] | bool = True,
) -> Bool[Array, " r"]:
    """Which of R regions answer a text, from the similarity s_r of each with it (R,), where that is known (R,).

    a is the region with the largest s_r, times `standing` (R,) where that is given (`evidence`). None where the text is
    not `accepted` (`measured`). Else a and every r with one of, b the region with the largest s_r itself,

        s_r >= m + kind_threshold (s_b - m)        with `several`: of the same kind (`is_near`)
        s_r >= m + piece_threshold (s_b - m), o_rc >= MIN_PIECE_OVERLAP     c = a or of its kind: a piece (`is_piece`)
        cos(d_r, d_a) >= alike_threshold           the same thing seen twice (`is_alike`)

    with m the median of the known s, o the soft IoU of two regions' Gaussians, `overlap` (R, R), and d what sets an
    embedding (R, E) apart from the others. No pieces where `overlap` or `piece_threshold` is None, none alike where
    `alike_threshold` is.
    """
    anchor = anchor_of(similarity, known, standing)
    chosen = jnp.arange(embeddings.shape[0]) == anchor
    if several:
        chosen |= is_near(similarity, known, kind_threshold)
    if overlap is not None and piece_threshold is not None:
        chosen |= is_piece(similarity, known, chosen, overlap, nearness=piece_threshold)
    if alike_threshold is not None:
        chosen |= is_alike(embeddings, anchor, alike_threshold)
    return chosen & known & accepted


def anchor_of(
    similarity: Float[Array, " r"], known: Bool[Array, " r"], standing: Float[Array, " r"] | None = None
) -> Int[Array, ""]:
    """The region that answers best, by similarity times standing; where none is positive by similarity alone."""
    weighed = similarity if standing is None else jnp.where(similarity > 0, similarity * standing, similarity)
    return jnp.argmax(jnp.where(known, weighed, -jnp.inf))


def is_alike(
    embeddings: Float[Array, "r e"], region: Int[Array, ""], threshold: Number = ALIKE_THRESHOLD
) -> Bool[Array, " r"]:
    """Which of R regions differ from the others as `region` does: what sets both apart (`mean_residuals`) has a cosine
    of at least `threshold`."""
    apart, known = mean_residuals(embeddings)
    cosines, measured = similarities(apart, apart[region])
    return known & measured & (cosines >= threshold)


def is_near(similarity: Float[Array, " r"], known: Bool[Array, " r"], nearness: Number) -> Bool[Array, " r"]:
    """Which of R regions are about as similar to a text as the best one is, by the rule of `regions_of_text`; none
    where all are equally similar: only the place between the typical region and the best means something."""
    middle = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    best = jnp.max(jnp.where(known, similarity, -jnp.inf))
    return known & (similarity >= middle + nearness * (best - middle)) & (best > middle)


def is_piece(
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    chosen: Bool[Array, " r"],
    overlap: Float[Array, "r r"],
    *,
    nearness: Number = PIECE_THRESHOLD,
    least: Number = MIN_PIECE_OVERLAP,
) -> Bool[Array, " r"]:
    """Which of R regions are pieces of the things that the `chosen` regions (R,) are of, as a text sees them: near to
    it (`is_near`), and o_rc >= `least` for some chosen c, o the overlap (R, R) of `with_overlap`. A second thing of the
    kind is as near to the text, but has Gaussians of its own.
    """
    near = is_near(similarity, known, nearness)
    return near & (jnp.max(jnp.where(chosen[:, None], overlap, 0.0), axis=0) >= least)
