"""The canonical query: LERF's relevancy, the text's softmax share against each of a few canonical phrases."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require
from jsecon.query.one_step import Codes, Number, as_codes, best, similarities
from jsecon.types import Array, Selection

TEMPERATURE = 10.0
"""LERF's and LangSplat's factor on the cosines; not CLIP's own 100"""


def query_canonical(
    features: Codes,
    text: Float[Array, " d_text"],
    canonical: Float[Array, "c d_canonical"],
    threshold: Number,
) -> Selection:
    """The Gaussians whose relevancy to the text is at least `threshold`.

    features (N, d), text (d,) and canonical phrases (C, d), C >= 1, in one space: embeddings, or codes of the same
    coder. Relevancy is the least, over the phrases c, of softmax(10 [cos(f, text), cos(f, c)])[0] (Kerr et al. 2023,
    LERF; REFERENCE C.2), in (0, 1); above 0.5 the text is closer than every phrase. Unknown features (zero, or not
    finite) have relevancy 0 and are never selected. Phrases that are zero or not finite make every relevancy unknown.
    Raises ValueError on shapes that disagree.
    """
    size = features.shape[1]
    require(
        text.shape[0] == size and canonical.shape[1] == size and canonical.shape[0] >= 1,
        "query_canonical",
        got=f"text {text.shape}, canonical {canonical.shape}",
        expected=f"({size},) and (C >= 1, {size})",
        remedy="Embed or encode text and canonical phrases as the features are.",
    )
    return _canonical(as_codes(features), jnp.asarray(text), jnp.asarray(canonical), threshold)


@jax.jit
def _canonical(features: Codes, text: Array, canonical: Array, threshold: Number) -> Selection:
    relevancy, known = relevancies(features, text, canonical)
    return Selection(known & (relevancy >= threshold), relevancy, jnp.asarray(-1, jnp.int32), best(relevancy, known))


def relevancies(features: Codes, text: Float[Array, " d"], canonical: Float[Array, "c d"]) -> tuple[Array, Array]:
    """LERF's relevancy (N,), and where it means something (N,); 0 elsewhere."""
    positive, known = similarities(features, text)
    # One phrase at a time: the sums stay multiply-and-sum, and no (N, C) array of products is made.
    negative, known_too = jax.lax.map(lambda phrase: similarities(features, phrase), canonical)
    known = known & jnp.all(known_too, axis=0)
    # The softmax of two is a sigmoid of their difference, and its least is against the closest phrase.
    share = jax.nn.sigmoid(TEMPERATURE * (positive - jnp.max(negative, axis=0)))
    return jnp.where(known, share, 0.0), known
