"""Queries that compare Gaussians with the text itself.

`query_one_step` uses the cosine of codes (the paper's baseline). `query_canonical` uses LERF's relevancy, the text's
softmax share against each of a few canonical phrases.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.field.similarity import Number, similarities
from jsecon.types import Array, Selection

TEMPERATURE = 10.0
"""LERF's and LangSplat's factor on the cosines; not CLIP's own 100"""


def query_one_step(codes: Float[Array, "n d"], text_code: Float[Array, " d_text"], threshold: Number) -> Selection:
    """Selects the Gaussians whose code has a cosine of at least `threshold` with the text's code. Pure.

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
    return _one_step(codes, text_code, threshold)


@jax.jit
def _one_step(codes: Array, text_code: Array, threshold: Number) -> Selection:
    similarity, known = similarities(codes, text_code)
    return _selection(similarity, known, threshold)


def query_canonical(
    features: Float[Array, "n d"],
    text: Float[Array, " d_text"],
    canonical: Float[Array, "c d_canonical"],
    threshold: Number,
) -> Selection:
    """Selects the Gaussians whose relevancy to the text is at least `threshold`. Pure.

    The relevancy is the smallest, over the phrases c, of softmax(10 [cos(f, text), cos(f, c)])[0] (Kerr et al. 2023,
    LERF), in (0, 1); above 0.5 the text is closer than every phrase.

    Args:
      features: (N, d) embeddings or codes; zero or non-finite ones have relevancy 0 and are never selected.
      text: (d,) in the same space.
      canonical: (C, d) phrases in the same space, C >= 1.
      threshold: Smallest relevancy.

    Returns:
      The selection; `score` is the best relevancy.

    Raises:
      ValueError: Shapes disagree.
    """
    size = features.shape[1]
    fit = text.shape[0] == size and canonical.shape[1] == size and canonical.shape[0] >= 1
    shapes, expected = f"text {text.shape}, canonical {canonical.shape}", f"({size},) and (C >= 1, {size})"
    require(fit, "query_canonical", shapes, expected, "Embed or encode text and canonical phrases as the features are.")
    return _canonical(features, text, canonical, threshold)


@jax.jit
def _canonical(features: Array, text: Array, canonical: Array, threshold: Number) -> Selection:
    return _selection(*relevancies(features, text, canonical), threshold)


def relevancies(
    features: Float[Array, "n d"], text: Float[Array, " d"], canonical: Float[Array, "c d"]
) -> tuple[Array, Array]:
    """Computes LERF's relevancy, see `query_canonical`. Pure.

    Args:
      features: (N, d) embeddings or codes.
      text: (d,) in the same space.
      canonical: (C, d) phrases in the same space.

    Returns:
      Relevancy (N,) in (0, 1), and whether it is known (N,); 0 if not.
    """
    positive, known = similarities(features, text)
    # One phrase at a time: the sums stay multiply-and-sum, and no (N, C) array of products is made.
    negative, known_too = jax.lax.map(lambda phrase: similarities(features, phrase), canonical)
    known = known & jnp.all(known_too, axis=0)
    # The softmax of two is a sigmoid of their difference, and it is smallest against the closest phrase.
    share = jax.nn.sigmoid(TEMPERATURE * (positive - jnp.max(negative, axis=0)))
    return jnp.where(known, share, 0.0), known


def _selection(similarity: Array, known: Array, threshold: Number) -> Selection:
    """The known Gaussians whose similarity reaches the threshold; the score is the best of all, or 0."""
    mask, no_region = known & (similarity >= threshold), jnp.asarray(-1, jnp.int32)
    best = jnp.where(jnp.any(known), jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf), 0.0)
    return Selection(mask, similarity, no_region, best)
