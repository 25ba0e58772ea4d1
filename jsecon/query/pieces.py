"""One thing in pieces: where masks are cut and tracks break, an object is several regions, and a text finds one of
them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from jsecon.query.one_step import Number
from jsecon.types import Array, Votes

PIECE_NEARNESS = 0.5
"""how far a piece's similarity has come from the middle region's to the best one's: it is nearer to the best"""
PIECE_OVERLAP = 0.1
"""the least soft IoU of two regions' Gaussians where the two are pieces of one thing. In twins of two scenes (simulated
vision, little to much noise) 106 of the 115 pieces that are near enough reach it, and 4 of 58 other regions"""


def with_overlap(votes: Votes) -> Votes:
    """`votes` with `overlap` (R, R), the soft IoU of two regions' Gaussians.

        o_rs = sum_n min(p_nr, p_ns) / sum_n max(p_nr, p_ns)

    with p_nr the region's share of the weight with which Gaussian n was seen in the views that show the region (of all
    weight, where the votes do not know), at most 1; 0 for a region without votes. Two pieces that masks cut out of one
    object in different views overlap in its Gaussians; two objects meet only where they touch, and what lies behind all
    of them is far larger than any. Pure.
    """
    arrays = (votes.regions, votes.weights, votes.total, votes.shown)
    overlap = _overlap(*(None if a is None else jnp.asarray(a) for a in arrays), votes.num_regions)
    return dataclasses.replace(votes, overlap=overlap)


@functools.partial(jax.jit, static_argnums=4)
def _overlap(regions: Array, weights: Array, total: Array, shown: Array | None, count: int) -> Array:
    seen = total[:, None] if shown is None else shown
    sound = (regions >= 0) & (regions < count) & (seen > 0) & jnp.isfinite(weights) & jnp.isfinite(seen)
    share = jnp.where(sound, jnp.clip(weights / jnp.where(sound, seen, 1.0), 0.0, 1.0), 0.0)
    place, share = jnp.where(sound, regions, count).T, share.T  # one past the end: dropped
    first, second = jnp.triu_indices(regions.shape[1])

    def add(n, both):
        j, k = first[n], second[n]
        return both.at[place[j], place[k]].add(jnp.minimum(share[j], share[k]), mode="drop")

    both = lax.fori_loop(0, len(first), add, jnp.zeros((count, count), weights.dtype))
    size = jnp.diagonal(both)
    both = jnp.where(jnp.eye(count, dtype=bool), both, both + both.T)
    either = size[:, None] + size - both
    return jnp.where(either > 0, jnp.minimum(both / jnp.where(either > 0, either, 1.0), 1.0), 0.0)


def is_near(similarity: Float[Array, " r"], known: Bool[Array, " r"], nearness: Number) -> Bool[Array, " r"]:
    """Which of R regions have a known (R,) similarity of at least m + nearness (b - m), b the largest and m the median
    over the regions: only the place between the typical region and the best means something. None where b = m."""
    middle = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    best = jnp.max(jnp.where(known, similarity, -jnp.inf))
    return known & (similarity >= middle + nearness * (best - middle)) & (best > middle)


def is_piece(
    similarity: Float[Array, " r"],
    known: Bool[Array, " r"],
    chosen: Bool[Array, " r"],
    overlap: Float[Array, "r r"],
    *,
    nearness: Number = PIECE_NEARNESS,
    least: Number = PIECE_OVERLAP,
) -> Bool[Array, " r"]:
    """Which of R regions are pieces of the things that the `chosen` regions (R,) are of, as a text sees them.

    Those that are near the text (`is_near`, with their similarities (R,), where known (R,)) and overlap a chosen one
    (`with_overlap`) by at least `least`. A second thing of the kind is as near to the text, but has Gaussians of its
    own.
    """
    near = is_near(similarity, known, nearness)
    return near & (jnp.max(jnp.where(chosen[:, None], overlap, 0.0), axis=0) >= least)
