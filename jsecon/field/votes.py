"""Votes: the weight that each region casts on each Gaussian, W^T onto one-hot labels, in one pass over the views.

With the geometry frozen, rendering is linear in the features (image = W f, W the alpha T weights), and the masklet
targets take only R values. The N x R votes therefore hold all that distillation needs.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int, Shaped

from jsecon.errors import require, require_shape
from jsecon.numerics import FULL_PRECISION, NEAR, is_traced, require_labels
from jsecon.parallel import accumulate_over_views, concurrent_lanes
from jsecon.splat.capacity import default_capacity, enough_capacity
from jsecon.splat.fusion import compute_once
from jsecon.splat.plan import ViewPlan, plan_view
from jsecon.splat.scan import blend_weights, make_batches, make_table, scan_tiles, to_tiles
from jsecon.types import Array, Camera, Gaussians, Progress, Votes

# A tile of 8x8 pixels seldom shows more regions than this; where one does, the view is walked again for the rest.
_SLOTS = 4
_NOBODY = -2  # a slot that no label equals
_BARE_BYTES = 4 * 14
"""of a Gaussian with one band of colour"""
DENSE_BYTES = 1 << 30
"""the dense N x R block that is accumulated at once; more regions take more passes over the views"""


def region_votes(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Shaped[Array, "t h w"],
    num_regions: int,
    *,
    top: int = 8,
    by_view: bool = False,
    centre: float = 0.0,
    capacity: int | None = None,
    near: float = NEAR,
    progress: Progress | None = None,
) -> Votes:
    """Adds up the weight that each region casts on each Gaussian over all views.

    Host code: the views are spread over jax's local devices, and over processes that all make the same call
    (`jax.distributed`). The result has the same bits on any number of devices. Called inside a trace it is
    `scan_region_votes`.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T cameras.
      labels: (T, H, W) integers below `num_regions`; -1 where a pixel belongs to no region.
      num_regions: R.
      top: Number of strongest regions that each Gaussian keeps; `Votes.weight_beyond_top_k` counts the rest.
      by_view: Whether to keep each view's total too (`Votes.by_view`, 4 T N bytes), as `add_visible_weight` needs it.
      centre: In [0, 1]. A weight away from the pixel that holds the Gaussian's centre counts 1 - `centre`: at 1 a
        Gaussian is what its centre is, at 0 what its whole footprint is.
      capacity: Number of (block, Gaussian) pairs of a view, see `render`. By default votes of views that overflow are
        cast again with enough.
      near: Near plane, world units.
      progress: Called as progress(done, total), in views.

    Returns:
      Votes of the N Gaussians. `overflow` is 0 if they are exact.

    Raises:
      ValueError: Shapes disagree, or labels are no integers or too large.
    """
    if is_traced((gaussians, cameras, labels)):
        options = {"top": top, "by_view": by_view, "centre": centre, "capacity": capacity, "near": near}
        return scan_region_votes(gaussians, cameras, labels, num_regions, **options)
    _require_views(cameras, labels, num_regions)
    kept, labelled, state = _none_kept(np, gaussians), None, {}
    options = {"by_view": by_view, "centre": centre, "capacity": capacity, "near": near, "progress": progress}
    for first, state in _dense_votes(gaussians, cameras, labels, num_regions, **options):
        kept, weight = _keep_strongest(kept, state.pop("votes"), first, min(top, max(num_regions, 1)))
        labelled = weight if labelled is None else labelled + weight
    return _as_votes(kept, labelled, state, state["by_view"], num_regions)


def scan_region_votes(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Shaped[Array, "t h w"],
    num_regions: int,
    *,
    top: int = 8,
    by_view: bool = False,
    centre: float = 0.0,
    capacity: int | None = None,
    near: float = NEAR,
) -> Votes:
    """Casts the votes of `region_votes` as a pure function: it scans the views on one device, under jit and vmap.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T cameras.
      labels: (T, H, W) integers, -1 where a pixel belongs to no region; inside a trace R and more count as -1.
      num_regions: R.
      top: Number of strongest regions that each Gaussian keeps.
      by_view: Whether to keep each view's total too.
      centre: In [0, 1]. A weight away from the pixel that holds the Gaussian's centre counts 1 - `centre`.
      capacity: Number of (block, Gaussian) pairs of a view, see `render`. Pairs beyond it are left out and counted in
        `overflow`.
      near: Near plane, world units.

    Returns:
      Votes of the N Gaussians.

    Raises:
      ValueError: Shapes disagree, or labels are no integers.
    """
    _require_views(cameras, labels, num_regions)
    static = _default_capacity(gaussians, cameras) if capacity is None else capacity, by_view, centre
    kept, labelled, totals, state = _none_kept(jnp, gaussians), None, None, {}
    for block in _region_blocks(gaussians.count, num_regions):
        regions = np.array([block.start, min(block.stop, num_regions)], np.int32)
        common = _without_colour(gaussians), regions, jnp.asarray(near, gaussians.means.dtype)

        def one_view(state, view, common=common):
            return _add_view(state, common, _plan_view(common, view, *static), *static)

        start = _empty(jnp, gaussians.count, len(block), gaussians.means.dtype)
        state, totals = lax.scan(one_view, start, (cameras, labels))
        kept, weight = _keep_strongest(kept, state.pop("votes"), block.start, min(top, max(num_regions, 1)))
        labelled = weight if labelled is None else labelled + weight
    return _as_votes(kept, labelled, state, totals if by_view else None, num_regions)


def _dense_votes(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Shaped[Array, "t h w"],
    num_regions: int,
    *,
    by_view: bool = False,
    centre: float = 0.0,
    capacity: int | None = None,
    near: float = NEAR,
    progress: Progress | None = None,
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yields the votes in blocks of regions; arguments as for `region_votes`. Host code.

    That is the first region of a block; and {"votes" (N, block), "total", "peak", "views" (N,), "overflow", "by_view"
    (T, N) or None}.
    """
    # One program serves every near plane, which `place_cameras` chooses by the scene's size.
    scene, near_plane = _without_colour(gaussians), np.asarray(near, gaussians.means.dtype)
    size = _default_capacity(gaussians, cameras) if capacity is None else capacity
    blocks = _region_blocks(gaussians.count, num_regions)
    for b, block in enumerate(blocks):
        common = scene, np.array([block.start, block.stop], np.int32), near_plane
        start = _empty(np, gaussians.count, len(block), gaussians.means.dtype)
        report = None if progress is None else functools.partial(_report_block, progress, b, len(blocks))
        while True:
            options = {"prepare": _plan_view, "static": (size, by_view, centre), "progress": report}
            state, totals = accumulate_over_views(_add_view, start, _merge, common, (cameras, labels), **options)
            missing = np.asarray(state["missing"])
            if capacity is not None or not missing:
                break
            size = enough_capacity(size, missing[None])
        state["by_view"] = totals if by_view else None
        yield block.start, state  # whoever takes the votes out of it frees them before the next block


def _report_block(progress: Progress, block: int, blocks: int, done: int, total: int) -> None:
    """Reports the views of one of several blocks of regions."""
    progress(block * total + done, blocks * total)


def _region_blocks(count: int, regions: int) -> list[range]:
    """The region ids of each block, at least one, all of one length: the last may reach beyond the regions."""
    size = _block_size(count, regions)
    return [range(first, first + size) for first in range(0, max(regions, 1), size)]


def _block_size(count: int, regions: int) -> int:
    """Number of regions of a block."""
    return max(1, min(max(regions, 1), DENSE_BYTES // max(4 * count, 1)))


def _require_views(cameras: Camera, labels: Array, num_regions: int) -> None:
    """Raises ValueError for labels that are not of these cameras and regions."""
    poses = cameras.world_to_camera
    require_shape("cameras.world_to_camera", poses, ("T", 4, 4), "Add a leading axis to all arrays of a single camera.")
    expected = len(poses), cameras.height, cameras.width
    require_shape("labels", labels, expected, "Give one label image per view, of the camera's size.")
    require(num_regions >= 0, "num_regions", num_regions, ">= 0", "Count the regions.")
    require_labels(labels, num_regions)


def _default_capacity(gaussians: Gaussians, cameras: Camera) -> int:
    return default_capacity(gaussians.count, cameras.width, cameras.height)


def _without_colour(gaussians: Gaussians) -> Gaussians:
    """Colour has no part in the votes."""
    return dataclasses.replace(gaussians, sh=np.zeros((gaussians.count, 1, 3), gaussians.means.dtype))


def _none_kept(xp: Any, gaussians: Gaussians) -> tuple[Array, Array]:
    """Region ids and weights (N, 0) before any block; of NumPy on the host, which compiles nothing."""
    return xp.full((gaussians.count, 0), -1, np.int32), xp.zeros((gaussians.count, 0), gaussians.means.dtype)


def _as_votes(kept: tuple[Array, Array], labelled: Any, state: Any, by_view: Any, num_regions: int) -> Votes:
    total, peak, views, overflow = (state[name] for name in ("total", "peak", "views", "overflow"))
    return Votes(kept[0], kept[1], labelled, total, peak, views, overflow, num_regions, by_view)


def votes_memory(count: int, views: int, regions: int) -> int:
    """Estimates the memory of `region_votes` with `by_view`, beside its inputs.

    These are the views' totals, a copy of the Gaussians with one band of colour, and a dense block for each lane that
    is worked on and for their sum.

    Args:
      count: N, number of Gaussians.
      views: T.
      regions: R.

    Returns:
      Number of bytes.
    """
    dense = 4 * count * _block_size(count, regions)
    return (4 * views + _BARE_BYTES) * count + (concurrent_lanes(views, dense) + 1) * dense


def _empty(xp: Any, count: int, regions: int, dtype) -> dict[str, Array]:
    return {
        "votes": xp.zeros((count, regions), dtype),
        "total": xp.zeros(count, dtype),
        "peak": xp.zeros(count, dtype),
        "views": xp.zeros(count, np.int32),
        "overflow": xp.zeros((), np.int32),
        "missing": xp.zeros((), np.int32),  # the largest overflow of a view
    }


@functools.partial(jax.jit, donate_argnums=0)
def _merge(a: dict[str, Array], b: dict[str, Array]) -> dict[str, Array]:
    return {key: jnp.maximum(a[key], b[key]) if key in ("peak", "missing") else a[key] + b[key] for key in a}


@functools.partial(jax.jit, static_argnums=(3,))
def _keep_strongest(
    kept: tuple[Array, Array], votes: Array, first: int | Array, top: int
) -> tuple[tuple[Array, Array], Array]:
    """Merges a dense block of votes into the strongest ones kept so far; and (N,) the block's weight."""
    weights, ids = lax.top_k(votes, min(top, votes.shape[1]))
    weights, ids = jnp.concatenate([kept[1], weights], 1), jnp.concatenate([kept[0], first + ids], 1)
    weights, place = lax.top_k(weights, min(top, weights.shape[1]))
    return (jnp.where(weights > 0, jnp.take_along_axis(ids, place, axis=1), -1), weights), votes.sum(-1)


def _plan_view(
    common: tuple[Gaussians, Array, Array], view: tuple[Camera, Array], capacity: int, *_: Any
) -> tuple[ViewPlan, Array]:
    """The plan of a view, and its labels. Pure."""
    return plan_view(common[0], view[0], capacity=capacity, near=common[2]), view[1]


def _add_view(
    state: dict[str, Array],
    common: tuple[Gaussians, Array, Array],
    view: tuple[ViewPlan, Array],
    capacity: int,
    by_view: bool,
    centre: float,
) -> tuple[dict[str, Array], Array | None]:
    """Adds one view's votes to the dense accumulators; and (N,) the weight that the view sees, where it is wanted.

    `common`: the scene, the first region of the block and the one after its last, and the near plane. Pure.
    """
    (_, (first, after), _), (plan, labels) = common, view
    labels = jnp.asarray(labels, jnp.int32)
    labels = jnp.where((labels >= first) & (labels < after), labels - first, -1)
    splats, lists = plan.splats, plan.lists
    batches = make_batches(lists, plan.width)
    tiles = to_tiles(labels + 1, lists.tile) - 1
    distinct = distinct_labels(tiles, _SLOTS)
    dtype = splats.dtype
    in_image = to_tiles(jnp.ones(labels.shape, dtype), lists.tile)
    table = make_table(splats)

    def one_batch(carry, ids_of_tiles):
        local, names, covered = tiles[ids_of_tiles], distinct[ids_of_tiles], in_image[ids_of_tiles]
        corners = batches.corners(ids_of_tiles, dtype)
        # how many slots this batch needs: empty slots are -2 or -1 (pixels without label)
        needed = (names >= 0).sum(1).max()

        def one_pass(carry):
            done, votes, total, peak = carry
            slots = lax.dynamic_slice_in_dim(names, done, _SLOTS, axis=1)
            is_slot = jnp.where(slots[:, None, :] >= 0, local[:, :, None] == slots[:, None, :], False).astype(dtype)
            first_pass = done == 0

            def body(transmittance, inner, chunk):
                votes, total, peak = inner
                weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
                weight = weight * covered[:, None]
                if centre:
                    weight = weight * (1 - centre + centre * at_centre(chunk.attributes, corners, lists.tile))
                cast = jnp.einsum("bcp,bps->bcs", weight, is_slot, precision=FULL_PRECISION)
                target = jnp.where(slots >= 0, slots, votes.shape[1])  # out of range: dropped
                votes = votes.at[chunk.ids[:, :, None], target[:, None]].add(cast, mode="drop")
                total = total.at[chunk.ids].add(jnp.where(first_pass, weight.sum(-1), 0.0))
                peak = peak.at[chunk.ids].max(weight.max(-1))
                return transmittance, (votes, total, peak)

            inner, _ = scan_tiles(table, lists, batches, ids_of_tiles, body, (votes, total, peak))
            return done + _SLOTS, *inner

        carry = lax.while_loop(lambda c: (c[0] == 0) | (c[0] < needed), one_pass, (jnp.int32(0), *carry))
        return carry[1:], None

    fresh = jnp.zeros_like(state["total"])
    (votes, total, peak), _ = lax.scan(one_batch, (state["votes"], fresh, state["peak"]), batches.tiles)
    return {
        "votes": votes,
        "total": state["total"] + total,
        "peak": peak,
        "views": state["views"] + (total > 0).astype(jnp.int32),
        "overflow": state["overflow"] + plan.overflow,
        "missing": jnp.maximum(state["missing"], plan.overflow),
    }, total if by_view else None


def at_centre(splats: Float[Array, "b c 6"], corners: tuple[Array, Array], tile: int) -> Float[Array, "b c pixels"]:
    """Marks the pixel of a tile that holds the centre of a splat.

    Args:
      splats: (B, C, 6) as in `ViewPlan`, C of each tile.
      corners: x and y (B,) of the upper left corners of the tiles, px.
      tile: Edge of a tile, px.

    Returns:
      (B, C, tile * tile), 1 at that pixel, 0 elsewhere.
    """
    x, y = (jnp.floor(splats[..., k] - corners[k][:, None]) for k in range(2))
    inside = (x >= 0) & (x < tile) & (y >= 0) & (y < tile)
    pixel = jnp.where(inside, y * tile + x, -1).astype(jnp.int32)
    return (pixel[..., None] == lax.iota(jnp.int32, tile * tile)).astype(splats.dtype)


def distinct_labels(tiles: Int[Array, "n p"], slots: int) -> Int[Array, "n q"]:
    """Finds the distinct labels of each tile.

    Args:
      tiles: (N, P) labels of the pixels, -1 for no region.
      slots: Number of additional columns.

    Returns:
      (N, P + slots) labels, ascending from the left, negative after the last.
    """
    ordered = jnp.sort(tiles, axis=1)
    first = jnp.ones_like(ordered[:, :1], bool)
    new = jnp.concatenate([first, ordered[:, 1:] != ordered[:, :-1]], axis=1) & (ordered >= 0)
    place = jnp.where(new, jnp.cumsum(new, axis=1) - 1, tiles.shape[1] + slots)
    table = jnp.full((tiles.shape[0], tiles.shape[1] + slots), _NOBODY, tiles.dtype)
    return table.at[jnp.arange(tiles.shape[0])[:, None], place].set(ordered, mode="drop")
