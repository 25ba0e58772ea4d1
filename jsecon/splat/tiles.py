"""Which Gaussians touch which tile of the image, front to back: one packed single-key sort of (tile, depth rank)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from jsecon.splat.project import Projection, project
from jsecon.types import Array, Camera, Gaussians, Leaf

TILE = 8
"""tile edge, px; speed only"""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TileLists:
    """For each tile, row by row, the Gaussians whose box touches it, by depth (equal depths in index order)."""

    gaussians: Leaf
    """(capacity,) int32 Gaussian ids, tile after tile; what lies past starts[-1] means nothing."""
    starts: Leaf
    """(tiles + 1,) int32 where each tile's list begins."""
    overflow: Leaf
    """() int32 pairs that did not fit: the farthest Gaussians of the view."""
    tile: int = dataclasses.field(metadata={"static": True})
    """tile edge, px."""


def grid(width: int, height: int, tile: int) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-width // tile), -(-height // tile)


def _rectangles(projection: Projection, width: int, height: int, tile: int):
    """Inclusive-exclusive tile ranges (x0, x1, y0, y1) of each splat's box; empty where invisible."""
    across, down = grid(width, height, tile)
    means, extents = lax.stop_gradient(projection.means_px), projection.extents
    low = jnp.where(projection.visible[:, None], (means - extents) / tile, 0.0)
    high = jnp.where(projection.visible[:, None], (means + extents) / tile, 0.0)
    # Clipped as floats first: a box may reach beyond what int32 holds.
    x0, y0 = (jnp.floor(jnp.clip(low[:, i], 0, limit)).astype(jnp.int32) for i, limit in ((0, across), (1, down)))
    x1, y1 = (jnp.ceil(jnp.clip(high[:, i], 0, limit)).astype(jnp.int32) for i, limit in ((0, across), (1, down)))
    return x0, x1, y0, y1


def pair_counts(projection: Projection, width: int, height: int, *, tile: int = TILE) -> Int[Array, " n"]:
    """(N,) int32 number of tiles that each splat's box touches."""
    x0, x1, y0, y1 = _rectangles(projection, width, height, tile)
    return (x1 - x0) * (y1 - y0)


def depth_order(depths: Float[Array, " n"]) -> Int[Array, " n"]:
    """Indices that sort positive depths, ties in index order.

    Positive float32 sort like their bits, so depth and index pack into one 64-bit key: XLA's CPU sort of one key is
    about five times faster than its sort of a key and a value. Float64 depths fall back to a stable argsort.
    """
    if depths.dtype != jnp.float32:
        return jnp.argsort(depths, stable=True).astype(jnp.int32)
    bits = lax.bitcast_convert_type(depths, jnp.uint32)
    index = lax.iota(jnp.uint32, depths.shape[0])
    return _sort_packed(bits, index)


def _sort_packed(high: Array, low: Array) -> Array:
    """Sorts by (high, low), both uint32, and returns the sorted low as int32. 64-bit only inside, by context."""
    return _sort_packed_both(high, low)[1]


def _sort_packed_both(high: Array, low: Array) -> tuple[Array, Array]:
    with jax.enable_x64(True):
        wide = [lax.convert_element_type(a, jnp.uint64) for a in (high, low)]
        key = lax.sort(lax.bitwise_or(lax.shift_left(wide[0], lax.full_like(wide[0], 32)), wide[1]), is_stable=False)
        upper = lax.convert_element_type(lax.shift_right_logical(key, lax.full_like(key, 32)), jnp.int32)
        lower = lax.convert_element_type(lax.bitwise_and(key, lax.full_like(key, 0xFFFFFFFF)), jnp.int32)
    return upper, lower


def tile_lists(projection: Projection, width: int, height: int, *, capacity: int, tile: int = TILE) -> TileLists:
    """Lists of up to `capacity` (tile, Gaussian) pairs in all; what does not fit is counted in `overflow`."""
    across, down = grid(width, height, tile)
    x0, x1, y0, y1 = _rectangles(projection, width, height, tile)
    count = projection.depths.shape[0]
    nowhere = jnp.asarray(jnp.inf, projection.depths.dtype)
    order = depth_order(lax.stop_gradient(jnp.where(projection.visible, projection.depths, nowhere)))
    # Pairs are laid out Gaussian after Gaussian, nearest first; `owner` says whose pair the k-th is. int32 cumulative
    # sums would wrap past 2^31 pairs, so the sum saturates: beyond the capacity its exact value is needed only here.
    areas = ((x1 - x0) * (y1 - y0))[order]
    ends = _saturating_cumsum(areas)
    starts = ends - areas
    rank = jnp.zeros(capacity + 1, jnp.int32).at[jnp.minimum(starts, capacity)].add(1, mode="promise_in_bounds")
    owner = jnp.minimum(jnp.cumsum(rank[:capacity]) - 1, count - 1)
    rows = jnp.stack([starts, x0[order], y0[order], (x1 - x0)[order]], axis=-1)[owner]
    within = lax.iota(jnp.int32, capacity) - rows[:, 0]
    across_box = jnp.maximum(rows[:, 3], 1)
    tiles = (rows[:, 2] + within // across_box) * across + rows[:, 1] + within % across_box
    filled = lax.iota(jnp.int32, capacity) < ends[-1]
    tiles = jnp.where(filled, tiles, across * down).astype(jnp.uint32)
    sorted_tiles, sorted_ranks = _sort_packed_both(tiles, owner.astype(jnp.uint32))
    boundaries = jnp.searchsorted(sorted_tiles, lax.iota(jnp.int32, across * down + 1)).astype(jnp.int32)
    return TileLists(order[sorted_ranks], boundaries, jnp.maximum(ends[-1] - capacity, 0), tile)


def _saturating_cumsum(areas: Array) -> Array:
    """int32 cumulative sum that stays at its largest value instead of wrapping."""
    largest = jnp.iinfo(jnp.int32).max
    exact = jnp.cumsum(areas.astype(jnp.int32))
    approximate = jnp.cumsum(areas.astype(jnp.float32))
    wrapped = lax.cummax((approximate > 0.99 * largest).astype(jnp.int32)) > 0
    return jnp.where(wrapped, largest, exact)


@jax.jit
def _pairs_in_view(gaussians: Gaussians, camera: Camera) -> Array:
    counts = pair_counts(project(gaussians, camera), camera.width, camera.height)
    return counts.astype(jnp.float32).sum()


def plan_capacity(gaussians: Gaussians, cameras: Camera, *, margin: float = 1.25) -> int:
    """The number of (tile, Gaussian) pairs to allow for, so that no view of `cameras` (one, or a batch) overflows.

    Host code: needs concrete arrays. Rounded up to an eighth of a power of two, so that captures of like size share
    one compilation. `margin` leaves room for Gaussians that still move.
    """
    views = cameras if cameras.world_to_camera.ndim == 3 else jax.tree.map(lambda a: jnp.asarray(a)[None], cameras)
    pairs = max(
        (float(_pairs_in_view(gaussians, views[t])) for t in range(views.world_to_camera.shape[0])), default=0.0
    )
    return round_capacity(int(np.ceil(pairs * margin)))


def round_capacity(pairs: int) -> int:
    """`pairs` rounded up to an eighth of a power of two, at least 1024."""
    pairs = max(pairs, 1024)
    step = 2 ** max(pairs.bit_length() - 4, 0)
    return -(-pairs // step) * step
