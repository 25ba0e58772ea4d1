"""Which of the weight that a Gaussian was seen with counts as evidence about a region: that of the views which show the
region. A view in which the tracker lost it, or in which nothing was proposed, says nothing against it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax

from jsecon.errors import require
from jsecon.numerics import cosine_matrix
from jsecon.query.anchored import ALIKE_THRESHOLD
from jsecon.types import Array, Regions, Votes

_BLOCK = 1 << 15
"""Gaussians at a time: what is dense in the regions stays small"""


def with_shown(votes: Votes, regions: Regions, *, alike_threshold: float = ALIKE_THRESHOLD) -> Votes:
    """`votes` with `shown` (N, K), for each vote the weight with which the views that show its region see the Gaussian,
    and without `by_view`, of which it is made.

    Regions whose embeddings have a cosine of at least `alike_threshold` are shown together, as the anchored query joins
    them. The object posterior of B3-Seg (IDEAS D): weight inside over inside and outside, over the views that contain
    the object. Pure. Raises ValueError where the votes were cast without `by_view`, or over other views than `regions`
    knows.
    """
    require(
        votes.by_view is not None,
        "with_shown",
        got="votes without the weight of each view",
        expected="by_view (T, N)",
        remedy="Cast them with region_votes(..., by_view=True).",
    )
    require(
        votes.by_view.shape[0] == regions.pixels.shape[1] and votes.num_regions == regions.count,
        "with_shown",
        got=f"{votes.num_regions} regions and {votes.by_view.shape[0]} views voted, of {regions.pixels.shape}",
        expected="the pixels (R, T) of the same regions in the same views",
        remedy="Give the regions that were made from the labels that voted.",
    )
    known = jnp.any(regions.embeddings != 0, axis=1)
    alike = cosine_matrix(regions.embeddings, regions.embeddings) >= alike_threshold
    alike = (alike & known[:, None] & known[None]) | jnp.eye(regions.count, dtype=bool)
    shows = (alike.astype(jnp.float32) @ (jnp.asarray(regions.pixels) > 0).astype(jnp.float32)) > 0
    return _with_shown(votes, shows, min(_BLOCK, max(votes.regions.shape[0], 1)))


@functools.partial(jax.jit, static_argnums=2)
def _with_shown(votes: Votes, shows: Array, block: int) -> Votes:
    by_view, regions = jnp.asarray(votes.by_view), jnp.asarray(votes.regions)
    count = regions.shape[0]

    def one_block(i, shown):
        first = jnp.minimum(i * block, count - block)  # the last block overlaps the one before it
        seen = lax.dynamic_slice_in_dim(by_view, first, block, axis=1)
        wanted = lax.dynamic_slice_in_dim(regions, first, block, axis=0)
        of_regions = jnp.einsum("tn,rt->nr", seen, shows.astype(seen.dtype))
        rows = jnp.take_along_axis(of_regions, jnp.maximum(wanted, 0), axis=1)
        return lax.dynamic_update_slice_in_dim(shown, jnp.where(wanted >= 0, rows, 0.0), first, axis=0)

    shown = jnp.zeros(regions.shape, by_view.dtype)
    if count and shows.shape[0]:
        shown = lax.fori_loop(0, -(-count // block), one_block, shown)
    return dataclasses.replace(votes, by_view=None, shown=shown)
