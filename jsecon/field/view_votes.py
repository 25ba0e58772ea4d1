"""Votes of one view as a sparse matrix: sums for each pair of a tile and a Gaussian, without a dense (N, R) array.

Where a Gaussian touches few of many regions this takes one walk, and memory for the pairs alone. One program serves any
number of regions. Host code.
"""

import dataclasses
import functools
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Float32, Int, Shaped
from scipy import sparse

from jsecon.field.votes import at_centre, distinct_labels
from jsecon.numerics import FULL_PRECISION, NEAR
from jsecon.splat.capacity import round_capacity
from jsecon.splat.fusion import compute_once
from jsecon.splat.plan import ViewPlan, plan_view
from jsecon.splat.scan import blend_weights, make_batches, make_table, scan_tiles, to_tiles
from jsecon.types import Array, Camera, Gaussians

Sparse: TypeAlias = Any
"""scipy.sparse.csr_matrix, which type checkers cannot resolve."""
_SLOTS = 8
"""Number of labels of a tile counted by one walk; for the few tiles of 8x8 pixels with more, the view is walked
again."""
MAX_SLOT_BYTES = 1 << 28
"""Bytes of the sums above which the lists are first cut to the pairs in use. Each new length compiles a program."""
PAIRS = 1 << 20
"""Number of pairs whose sums are gathered at once."""


class ViewVotes(NamedTuple):
    """Votes that one view casts on N Gaussians."""

    weights: Sparse
    """(N, R + 1) csr: the rendering weight alpha T of each Gaussian on each region, the last on pixels of no region."""
    peak: Float32[np.ndarray, " n"] | None
    """Its largest weight in a pixel, where that is asked for."""
    overflow: int
    """Pairs beyond the capacity; 0 if the votes are exact."""


def view_votes(
    gaussians: Gaussians,
    camera: Camera,
    labels: Shaped[Array, "h w"],
    num_regions: int,
    *,
    centre: float = 0.0,
    near: float = NEAR,
    capacity: int | None = None,
    with_peak: bool = False,
) -> ViewVotes:
    """Casts the votes of one view.

    Args:
      gaussians: Scene of N Gaussians.
      camera: Camera of the view.
      labels: (H, W) integers below `num_regions`, -1 where a pixel belongs to no region.
      num_regions: R.
      centre: In [0, 1], weight of a Gaussian's centre against its footprint, see `region_votes`.
      near: Near plane, world units.
      capacity: Number of (block, Gaussian) pairs, see `render`; None finds one that suffices.
      with_peak: Whether to find the largest weights too, which takes a third longer.

    Returns:
      The votes.
    """
    plan = plan_view(gaussians, camera, capacity=capacity, near=near)
    lists = plan.lists
    starts, lengths = np.asarray(lists.starts), np.asarray(lists.lengths)
    used = int((starts + lengths).max(initial=0))
    if 4 * _SLOTS * lists.gaussians.shape[0] > MAX_SLOT_BYTES:
        plan = dataclasses.replace(plan, lists=dataclasses.replace(lists, gaussians=_cut(lists.gaussians, used)))
        lists = plan.lists  # the longer one is freed
    ids = np.asarray(lists.gaussians)
    tile_of_pair = np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)
    places = np.arange(len(tile_of_pair)) + np.repeat(starts - (np.cumsum(lengths) - lengths), lengths)
    labels = np.where(np.asarray(labels) < 0, num_regions, labels).astype(np.int32)
    distinct = np.asarray(_distinct_labels(labels, lists.tile))
    peak, entries = np.zeros(gaussians.count, np.float32) if with_peak else None, []
    for first in range(0, max(int((distinct >= 0).sum(1).max()), 1), _SLOTS):
        sums, largest = jax.tree.map(np.asarray, _sums_by_pair(plan, labels, first, centre, with_peak and first == 0))
        for start in range(0, len(places), PAIRS):
            taken = slice(start, start + PAIRS)
            rows, owners = sums[places[taken]], ids[places[taken]]
            if peak is not None and largest is not None:
                np.maximum.at(peak, owners, largest[places[taken]])
            pair, slot = np.nonzero(rows)
            entries.append((rows[pair, slot], owners[pair], distinct[tile_of_pair[taken][pair], first + slot]))
    values, rows, columns = map(np.concatenate, zip(*entries)) if entries else (np.zeros(0, t) for t in "fii")
    weights = sparse.csr_matrix((values, (rows, columns)), shape=(gaussians.count, num_regions + 1))
    return ViewVotes(weights, peak, int(plan.overflow))


def _cut(ids: Array, used: int) -> Int[np.ndarray, " pairs"]:
    """The first `used` ids, filled up to a size that views share."""
    cut = np.zeros(round_capacity(used), np.int32)
    cut[:used] = np.asarray(ids)[:used]
    return cut


@functools.partial(jax.jit, static_argnums=1)
def _distinct_labels(labels: Array, tile: int) -> Array:
    return distinct_labels(to_tiles(labels + 1, tile) - 1, _SLOTS)


@functools.partial(jax.jit, static_argnums=(3, 4))
def _sums_by_pair(
    plan: ViewPlan, labels: Array, first: Array | int, centre: float, with_peak: bool
) -> tuple[Float[Array, "pairs slots"], Float[Array, " pairs"] | None]:
    """Sums the weight of each pair of the tile lists on `_SLOTS` labels of its tile; and its largest in a pixel.

    The labels are the distinct ones `first`, `first` + 1, ...
    """
    splats, lists = plan.splats, plan.lists
    batches = make_batches(lists, plan.width)
    tiles = to_tiles(labels + 1, lists.tile) - 1
    slots = lax.dynamic_slice_in_dim(distinct_labels(tiles, _SLOTS), first, _SLOTS, axis=1)
    table = make_table(splats)

    def one_batch(sums, ids_of_tiles):
        local = tiles[ids_of_tiles]
        is_slot = (local[:, :, None] == slots[ids_of_tiles][:, None, :]).astype(splats.dtype)
        corners = batches.corners(ids_of_tiles, splats.dtype)

        def body(transmittance, sums, chunk):
            weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
            if centre:
                weight = weight * (1 - centre + centre * at_centre(chunk.attributes, corners, lists.tile))
            rows = jnp.einsum("bcp,bps->bcs", weight, is_slot, precision=FULL_PRECISION)
            largest = jnp.where(local[:, None] >= 0, weight, 0.0).max(-1) if with_peak else None
            put = functools.partial(jax.tree.map, lambda all_pairs, a: all_pairs.at[chunk.places].set(a, mode="drop"))
            return transmittance, put(sums, (rows, largest))

        return scan_tiles(table, lists, batches, ids_of_tiles, body, sums)[0], None

    count = lists.gaussians.shape[0]
    empty = jnp.zeros((count, _SLOTS), splats.dtype), jnp.zeros(count, splats.dtype) if with_peak else None
    return lax.scan(one_batch, empty, batches.tiles)[0]
