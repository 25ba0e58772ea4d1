"""A view's splats front to back in bands, out of columns of Gaussians that need not fit into memory. Host code.

The columns (NumPy's, so memory maps too) are read in blocks of rows. A block that cannot touch the view is passed over
by its bounds, the rest is projected and only what is visible is kept. Bands follow each other in depth: whoever
composites one after the other and carries the transmittance along (`walk`) gets the sum over all Gaussians.
"""

import functools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.errors import require
from jsecon.numerics import FRUSTUM_MARGIN, MIN_ALPHA
from jsecon.splat.project import Projection, check_shapes, project
from jsecon.splat.strips import BLOCK
from jsecon.splat.tiles import TILE, pair_counts, tile_grid
from jsecon.types import Array, Camera, Gaussians

ROWS = 1 << 18
"""Gaussians of a block: 11 MiB of the columns that geometry needs"""
BAND = 1 << 18
"""splats of a band, and (block, Gaussian) pairs; more cost memory, fewer cost starts of programs"""
MOST_HELD = 1 << 23
"""splats of a view that are held and put in order at once, 56 bytes each; the nearest are"""
_GEOMETRY = ("means", "log_scales", "quaternions", "opacity_logits")


class Bounds(NamedTuple):
    """What the blocks of a scene cover; Gaussians with NaN count for nothing."""

    rows: int
    """Gaussians in a block; the last may have fewer."""
    lower: Float[np.ndarray, "b 3"]
    """least centre, world."""
    upper: Float[np.ndarray, "b 3"]
    """largest centre, world."""
    widest: Float[np.ndarray, " b"]
    """largest standard deviation, world units."""


class Band(NamedTuple):
    """Splats of one view, nearer than those of the next band; equal depths in index order."""

    ids: Int[np.ndarray, " m"]
    """(M,) int64 which Gaussians they are, in order of depth."""
    splats: Projection
    """of S >= M rows, the same S for all bands; those behind the M-th are not visible."""


class _Held(NamedTuple):
    """Visible splats in index order."""

    ids: np.ndarray
    table: np.ndarray
    """(M, 9) as `_table_of_block` has it."""
    pairs: np.ndarray


def block_bounds(gaussians: Gaussians, rows: int = ROWS) -> Bounds:
    """The bounds of all blocks, in one pass over means and sizes. They exclude much where neighbours in the file are
    neighbours in space."""
    lower, upper, widest = [], [], []
    for first in range(0, gaussians.means.shape[0], rows):
        means, sizes = (np.asarray(a[first : first + rows]) for a in (gaussians.means, gaussians.log_scales))
        lower.append(np.fmin.reduce(means, axis=0))
        upper.append(np.fmax.reduce(means, axis=0))
        widest.append(np.exp(np.minimum(np.fmax.reduce(sizes.reshape(-1)).astype(np.float64), 60.0)))
    as_float = lambda part, shape: np.asarray(part, np.float64).reshape(shape)
    return Bounds(rows, as_float(lower, (-1, 3)), as_float(upper, (-1, 3)), as_float(widest, (-1,)))


@np.errstate(all="ignore")  # a bound that is not finite excludes nothing
def may_touch(bounds: Bounds, camera: Camera, near: float) -> Bool[np.ndarray, " b"]:
    """(B,) which blocks may hold a Gaussian that `project` calls visible; never False for one that does.

    Where a block lies wholly in front of the near plane, its corners bound the rays x/z and y/z, and the nearest corner
    the size of a splat: variance <= (f s / z)^2 (1 + (x/z)^2) + blur, s the largest deviation and x/z that of the
    clamped ray. The slack covers the rounding of float32.
    """
    pose = np.asarray(camera.world_to_camera, np.float64)
    corner = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
    corners = np.where(corner[None] == 1, bounds.upper[:, None], bounds.lower[:, None])
    local = corners @ pose[:3, :3].T + pose[:3, 3]
    slack = 1e-5 * (np.abs(corners).max((1, 2)) + np.abs(pose[:3, 3]).max())
    nearest, farthest = local[..., 2].min(1) - slack, local[..., 2].max(1) + slack
    out = farthest < near
    reach = np.sqrt(-2 * np.log(MIN_ALPHA))
    lens = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    for axis, (focal, centre, size) in enumerate(lens):
        focal, centre = float(focal), float(centre)
        ray = local[..., axis] / local[..., 2]
        clamped = max(centre, size - centre) / focal + (FRUSTUM_MARGIN - 1) * 0.5 * size / focal
        widest = focal * bounds.widest / nearest * np.hypot(1.0, clamped)
        margin = (
            (reach * np.sqrt(widest**2 + 0.3)) * (1 + 1e-4) + 1 + focal * slack / nearest * (1 + np.abs(ray).max(1))
        )
        pixel = focal * ray + centre
        aside = (pixel.max(1) + margin < 0) | (pixel.min(1) - margin > size)
        out |= (nearest > max(near, 0.0)) & aside
    return ~out


@functools.partial(jax.jit, static_argnums=2)
def _table_of_block(gaussians: Gaussians, camera: Camera, near: float) -> tuple[Array, Array, Array]:
    """(n, 9) centre x, y, whitening l11, l21, l22, opacity, extents x, y, depth; (n,) pairs; (n,) visible."""
    splats = project(gaussians, camera, near=near)
    columns = splats.means_px, splats.whitening, splats.opacities[:, None], splats.extents, splats.depths[:, None]
    return jnp.concatenate(columns, axis=1), pair_counts(splats, camera.width, camera.height), splats.visible


def bands(
    gaussians: Gaussians,
    bounds: Bounds,
    camera: Camera,
    is_open: Callable[[], Bool[np.ndarray, "down across"]],
    *,
    near: float,
    size: int = BAND,
    most_held: int = MOST_HELD,
) -> Iterator[Band]:
    """The bands of one view, of at most `size` splats and `size` pairs each.

    is_open: which tiles have a pixel that has not stopped, as of the bands given so far. What touches none of them is
    left out, and when none is open the bands end. `most_held`: visible splats in memory at once; where there are more,
    the nearest come first and the columns are read again for those behind. Raises ValueError on shapes that disagree,
    and above 2^32 Gaussians.
    """
    check_shapes(gaussians, camera)
    require(gaussians.count < 1 << 32, "bands", gaussians.count, "fewer than 2^32 Gaussians", "Split the scene.")
    across, down = tile_grid(camera.width, camera.height, BLOCK * TILE)
    require(size >= across * down, "bands", size, f"a size of {across * down}: all blocks of the image", "Raise it.")
    blocks, behind = np.flatnonzero(may_touch(bounds, camera, near)).tolist(), None
    while is_open().any():
        held, left_out = _nearest(gaussians, bounds.rows, blocks, camera, near, behind, most_held)
        # One key sorts five times faster than it is argsorted; its lower half tells the place, which follows the index.
        place = np.sort(_keys(held._replace(ids=np.arange(len(held.ids))))) & np.uint64(0xFFFFFFFF)
        yield from _cut(held, place.astype(np.int64), is_open, size)
        if not left_out:
            return
        behind = _keys(held).max()


def _keys(held: _Held) -> np.ndarray:
    """(M,) uint64 that sort by depth, then by index: positive float32 sort like their bits."""
    bits = np.ascontiguousarray(held.table[:, 8]).view(np.uint32).astype(np.uint64)
    return bits << np.uint64(32) | held.ids.astype(np.uint64)


def _nearest(
    gaussians: Gaussians,
    rows: int,
    blocks: list[int],
    camera: Camera,
    near: float,
    behind: np.uint64 | None,
    most: int,
) -> tuple[_Held, bool]:
    """Of the visible splats behind the key `behind` the `most` nearest, and whether there are more."""
    nothing = _Held(np.zeros(0, np.int64), np.zeros((0, 9), np.float32), np.zeros(0, np.int32))
    parts, count, left_out = [nothing], 0, False
    for block in blocks:
        part = _visible(gaussians, block * rows, min(rows, gaussians.count), camera, near)
        if behind is not None:
            part = _Held(*(a[_keys(part) > behind] for a in part))
        parts.append(part)
        count += len(part.ids)
        if count > 2 * most or (block == blocks[-1] and count > most):
            held = _joined(parts)
            keys = _keys(held)
            kept = keys <= np.partition(keys, most - 1)[most - 1]
            parts, count, left_out = [_Held(*(a[kept] for a in held))], most, True
    return _joined(parts), left_out


def _joined(parts: list[_Held]) -> _Held:
    return _Held(*(np.concatenate(columns) for columns in zip(*parts)))


def _visible(gaussians: Gaussians, first: int, rows: int, camera: Camera, near: float) -> _Held:
    """The visible splats of a block."""
    columns = {name: np.asarray(getattr(gaussians, name)[first : first + rows], np.float32) for name in _GEOMETRY}
    fill = rows - len(columns["means"])
    if fill:  # so that all blocks share one program; an opacity of 0 is not visible
        columns = {name: np.concatenate([a, np.zeros((fill, *a.shape[1:]), a.dtype)]) for name, a in columns.items()}
        columns["opacity_logits"][rows - fill :] = -np.inf
    table, pairs, visible = _table_of_block(Gaussians(**columns, sh=np.zeros((rows, 0, 3), np.float32)), camera, near)
    places = np.flatnonzero(np.asarray(visible))
    return _Held(places + first, np.asarray(table)[places], np.asarray(pairs)[places])


def _cut(held: _Held, place: np.ndarray, is_open: Callable[[], np.ndarray], size: int) -> Iterator[Band]:
    """Bands of the splats held, whose order of depth is `place` (M,)."""
    first, count = 0, len(place)
    while first < count and (tiles := is_open()).any():
        before = np.pad(np.cumsum(np.cumsum(tiles, 0, np.int64), 1), ((1, 0), (1, 0)))
        taken, room, pairs = [place[:0]], size, 0
        while first < count and room:
            some = place[first : first + size]
            fits = np.flatnonzero(_touches(held.table[some], before))
            ends = pairs + np.cumsum(held.pairs[some[fits]], dtype=np.int64)
            fit = min(room, int(np.searchsorted(ends, size, side="right")))
            taken.append(some[fits[:fit]])
            room, pairs = room - fit, int(ends[fit - 1]) if fit else pairs
            if fit < len(fits):
                first += int(fits[fit])
                break
            first += len(some)
        places = np.concatenate(taken)
        if len(places):
            yield _band(held.ids[places], held.table[places], size)


def _touches(table: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(M,) whether a splat's box touches a tile that counts, by the sums `before` (down + 1, across + 1)."""
    ends = []
    for axis, limit in ((0, before.shape[1] - 1), (1, before.shape[0] - 1)):
        centre, extent = table[:, axis], table[:, 6 + axis]
        ends.append(np.floor(np.clip((centre - extent) / TILE, 0, limit)).astype(np.int32))
        ends.append(np.ceil(np.clip((centre + extent) / TILE, 0, limit)).astype(np.int32))
    x0, x1, y0, y1 = ends
    return before[y1, x1] - before[y0, x1] - before[y1, x0] + before[y0, x0] > 0


def _band(ids: np.ndarray, table: np.ndarray, size: int) -> Band:
    rows = np.zeros((size, 9), np.float32)
    rows[: len(ids)] = table
    visible = np.arange(size) < len(ids)
    return Band(ids, Projection(rows[:, :2], rows[:, 2:5], rows[:, 5], rows[:, 8], rows[:, 6:8], visible))


def band_size(count: int, width: int, height: int) -> int:
    """Splats and pairs of a band for a scene of `count` Gaussians: few for a small one, and room for one splat that
    covers every block of the image."""
    across, down = tile_grid(width, height, BLOCK * TILE)
    few = max(4096, 1 << max(2 * count - 1, 1).bit_length())
    return max(min(BAND, few), 1 << (across * down - 1).bit_length())
