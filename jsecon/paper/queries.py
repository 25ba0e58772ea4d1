"""Queries on codes: one-step, canonical, and the second step of the paper's GT-anchored one. Pure functions.

With l_i the code of Gaussian i, l_r that of region r, tau the embedding of a text and E the encoder:

    one-step     cos(l_i, E(tau)) >= threshold
    canonical    min_c softmax(10 [cos(f_i, tau), cos(f_i, c)])_1 >= threshold, over LERF's phrases c
    anchored     r = argmax_r cos(phi_bar_r, tau), then cos(l_i, l_r) >= threshold

One-step compares a Gaussian with the text itself, across the gap between texts and images, so no threshold suits all
texts. The anchored query crosses the gap once, among R regions, where only the order matters; codes distilled from one
region lie close together, so any high threshold does. Its first step is `query/answer.match_regions`.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.field.similarity import Number, similarities
from jsecon.types import Array, LanguageField, Selection

TEMPERATURE = 10.0
"""LERF's and LangSplat's factor on the cosines; not CLIP's own 100"""
CODE_THRESHOLD = 0.9
"""Smallest cosine with the region's code: codes of one region lie within a few degrees (0.9 is 26)."""


@jax.jit
def query_one_step(codes: Float[Array, "n d"], text_code: Float[Array, " d_text"], threshold: Number) -> Selection:
    """Selects the Gaussians whose code has a cosine of at least `threshold` with the text's code.

    Args:
      codes: (N, d) of any length. A zero code (unknown) or one that is not finite has similarity 0 and is never
        selected.
      text_code: (d,) of any length.
      threshold: Smallest cosine.

    Returns:
      The selection; `score` is the best similarity.

    Raises:
      ValueError: Shapes disagree.
    """
    require_shape("query_one_step", text_code, (codes.shape[1],), "Encode the text with the field's autoencoder.")
    similarity, known = similarities(codes, text_code)
    return _selection(similarity, known, threshold)


@jax.jit
def query_canonical(
    features: Float[Array, "n d"],
    text: Float[Array, " d_text"],
    canonical: Float[Array, "c d_canonical"],
    threshold: Number,
) -> Selection:
    """Selects the Gaussians whose relevancy to the text is at least `threshold` (Kerr et al. 2023, LERF).

    Args:
      features: (N, d) embeddings or codes; zero or non-finite ones have relevancy 0 and are never selected.
      text: (d,) in the same space.
      canonical: (C, d) phrases in the same space, C >= 1.
      threshold: Smallest relevancy, in (0, 1); above 0.5 the text is closer than every phrase.

    Returns:
      The selection; `score` is the best relevancy.

    Raises:
      ValueError: Shapes disagree.
    """
    size = features.shape[1]
    fit = text.shape[0] == size and canonical.shape[1] == size and canonical.shape[0] >= 1
    shapes, expected = f"text {text.shape}, canonical {canonical.shape}", f"({size},) and (C >= 1, {size})"
    require(fit, "query_canonical", shapes, expected, "Embed or encode text and canonical phrases as the features are.")
    return _selection(*_relevancies(features, text, canonical), threshold)


def _relevancies(
    features: Float[Array, "n d"], text: Float[Array, " d"], canonical: Float[Array, "c d"]
) -> tuple[Array, Array]:
    """Computes LERF's relevancy (N,) of a text, see `query_canonical`, and whether it is known (N,); 0 if not."""
    positive, known = similarities(features, text)
    # One phrase at a time: the sums stay multiply-and-sum, and no (N, C) array of products is made.
    negative, known_too = jax.lax.map(lambda phrase: similarities(features, phrase), canonical)
    known = known & jnp.all(known_too, axis=0)
    # The softmax of two is a sigmoid of their difference, and it is smallest against the closest phrase.
    share = jax.nn.sigmoid(TEMPERATURE * (positive - jnp.max(negative, axis=0)))
    return jnp.where(known, share, 0.0), known


def select_by_code(field: LanguageField, match: tuple, threshold: Number = CODE_THRESHOLD) -> Selection:
    """Selects the Gaussians whose code is close to that of the best region of a `query.match.RegionMatch`."""
    codes: Any = field.codes
    require(codes is not None, "field.codes", None, "codes", "Make the field with jsecon run --paper.")
    _, region, *scores = match
    near = _select_near_region(jnp.asarray(codes.gaussians), jnp.asarray(codes.regions), region, threshold)
    return Selection(near.mask, near.similarity, region, *scores)


@jax.jit
def _select_near_region(
    codes: Float[Array, "n d"], region_codes: Float[Array, "r d"], region: Array, threshold: Number
) -> Selection:
    """Selects the Gaussians whose code is close to that of a region: the second step. Region -1 selects none."""
    if not len(region_codes):
        region_codes = jnp.zeros((1, codes.shape[1]), codes.dtype)
    similarity, known = similarities(codes, region_codes[jnp.maximum(region, 0)])
    near = _selection(similarity, known, threshold)
    found = region >= 0
    return Selection(near.mask & found, jnp.where(found, near.similarity, 0.0), region, near.score)


def _selection(similarity: Array, known: Array, threshold: Number) -> Selection:
    """The known Gaussians whose similarity reaches the threshold; the score is the best of all, or 0."""
    mask, no_region = known & (similarity >= threshold), jnp.asarray(-1, jnp.int32)
    best = jnp.where(jnp.any(known), jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf), 0.0)
    return Selection(mask, similarity, no_region, best)
