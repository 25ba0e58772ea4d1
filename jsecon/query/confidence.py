"""How probable it is that an answer is right. Pure functions.

A text answers with its best region, and every unrelated word has a best region too. The height of an answer is how far
its region's similarity is above the mean region's. Its ratio to the heights of unrelated words says how far the answer
stands out, in any space of texts and images, and a logistic curve turns it into a probability.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.types import Array

OFFSET, SLOPE = -5.6, 3.5
"""of the logistic curve: an answer that stands out like that of an unrelated word is right in 1 of 9 cases, at 1.6
times its height in half of them. Fitted to answers on simulated rooms where half of the texts name something that is
there, by regions of a tracker and by consensus (experiments/calibration.py). Expected calibration error in other such
rooms: 0.04 (tracks) and 0.07 (consensus); on real words about 0.24 (given masks) and 0.43 (jsecon's own)"""


def answer_confidence(
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    evidence: Float[Array, " r"],
    unrelated: Float[Array, "w r"],
) -> Float[Array, ""]:
    """Estimates the probability that the best region for a text shows what the text names.

        sigmoid(OFFSET + SLOPE h / mean_w h_w),  h = s_a - sum_r e_r s_r / sum_r e_r

    Args:
      similarity: s, similarity of the text with each of R regions.
      known: Where the similarity means something.
      evidence: e, weight of each region (`jsecon.query.match.evidence`); a is the region with the largest s times e.
      unrelated: Similarity of each of W unrelated words with the regions, NaN where it means nothing.

    Returns:
      A probability. It holds for texts of which half name something in the scene, before any is refused. NaN without
      a region or a word.
    """
    weight = jnp.where(known, evidence, 0.0)
    usable = jnp.any(jnp.isfinite(unrelated), axis=1)
    heights = jax.vmap(_height, in_axes=(0, None))(unrelated, weight)
    count = jnp.sum(usable)
    typical = jnp.sum(jnp.where(usable, heights, 0.0)) / jnp.where(count > 0, count, 1)
    ratio = _height(similarity, weight) / jnp.where(typical > 0, typical, jnp.inf)
    return jnp.where(jnp.any(known) & (count > 0), jax.nn.sigmoid(OFFSET + SLOPE * ratio), jnp.nan)


def _height(similarity: Float[Array, " r"], weight: Float[Array, " r"]) -> Float[Array, ""]:
    """How far the best region's similarity is above the weighted mean; regions of no weight do not count."""
    counted = (weight > 0) & jnp.isfinite(similarity)
    similarity = jnp.where(counted, similarity, 0.0)
    weight = jnp.where(counted, weight, 0.0)
    weighted = jnp.where(similarity > 0, similarity * weight, similarity)
    best = similarity[jnp.argmax(jnp.where(counted, weighted, -jnp.inf))]
    total = jnp.sum(weight)
    return best - jnp.sum(weight * similarity) / jnp.where(total > 0, total, 1.0)
