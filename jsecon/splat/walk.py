"""The walk down a batch of tiles' lists: Gaussians in chunks, front to back, until nothing is left to be seen.

A batch is of tiles with lists of like length. Arrays of a walk are (tiles, ..., pixels): a tile's pixels lie innermost
and fill the vectors; what belongs to a Gaussian is a number that a whole row of pixels shares.

What XLA's CPU backend makes of this decides the speed; all of it measured on garden (benchmarks/results.md):
- A scan over single Gaussians starts four kernels for each and reads its slices unvectorised; a chunk at a time, the
  recurrence written out inside one kernel, took a third of that.
- Fusion recomputes cheap arithmetic for every reader, and a chunk's exponentials written as a polynomial are cheap to
  it. Only a conditional whose outcome it can't know makes it store them once: `materialize`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.fusion import materialize
from jsecon.splat.strips import FULL_IMAGE, Strip
from jsecon.splat.tiles import TileLists, tile_grid
from jsecon.types import Array

BATCH = 64
"""tiles walked side by side, at most; speed only"""
BATCH_BACKWARD = 32
"""the same for gradients, which keep more arrays of a chunk at once"""


class Batches(NamedTuple):
    """Tiles sorted by list length, in batches of B; the last is filled up with empty tiles."""

    tiles: Array
    """(batches, B) tile ids; `number` = an empty tile outside the image."""
    starts: Array
    """(number + 1,) where a tile's list begins."""
    lengths: Array
    """(number + 1,) its length."""
    across: int
    number: int
    tile: int
    strip: Strip

    def corners(self, tiles: Array, dtype) -> tuple[Array, Array]:
        """x and y of the tiles' upper left corners in the image, px."""
        x, y = tiles % self.across, self.strip.tile_row(tiles // self.across)
        return (x * self.tile).astype(dtype), (y * self.tile).astype(dtype)


def make_batches(lists: TileLists, width: int, strip: Strip = FULL_IMAGE, most: int | None = None) -> Batches:
    """The batches of one strip's lists, the longest first, of at most `most` tiles (default BATCH).

    A batch walks as far as its longest list: where tiles are few their lists differ more, and batches are smaller.
    """
    number = lists.lengths.shape[0]
    batch = min(most or BATCH, max(16, 1 << (max(number // 12, 1).bit_length() - 1)))
    order = jnp.argsort(-lists.lengths).astype(jnp.int32)
    order = jnp.concatenate([order, jnp.full(-number % batch, number, jnp.int32)])
    empty = jnp.zeros(1, jnp.int32)
    starts, lengths = (jnp.concatenate([a, empty]) for a in (lists.starts, lists.lengths))
    return Batches(order.reshape(-1, batch), starts, lengths, -(-width // lists.tile), number, lists.tile, strip)


def to_image(batched: Float[Array, "k b d p"], batches: Batches, width: int) -> Float[Array, "h w d"]:
    """(batches, B, D, pixels) -> (rows, W, D), all rows of the strip's tiles."""
    down, tile, channels = batches.number // batches.across, batches.tile, batched.shape[2]
    slots = batches.tiles.reshape(-1)
    place = jnp.zeros(batches.number + 1, jnp.int32).at[slots].set(lax.iota(jnp.int32, slots.shape[0]))[:-1]
    tiles = batched.reshape(slots.shape[0], channels, tile, tile)[place]
    image = tiles.reshape(down, batches.across, channels, tile, tile).transpose(0, 3, 1, 4, 2)
    return image.reshape(down * tile, batches.across * tile, channels)[:, :width]


def to_tiles(image: Array, tile: int) -> Array:
    """(H, W, ...) -> (tiles + 1, tile * tile, ...), zero outside the image; the last tile is the empty one."""
    height, width, *rest = image.shape
    across, down = tile_grid(width, height, tile)
    padding = [(0, down * tile - height), (0, across * tile - width)] + [(0, 0)] * len(rest)
    tiles = jnp.pad(image, padding).reshape(down, tile, across, tile, *rest)
    tiles = jnp.moveaxis(tiles, 2, 1).reshape(across * down, tile * tile, *rest)
    return jnp.concatenate([tiles, jnp.zeros_like(tiles[:1])])


CHUNK = 16
"""Gaussians of each list at a time; speed only"""
_GROUP = 4
"""recurrences over a chunk run within and over groups of this many"""
ATTRIBUTES = 6
"""columns of splats (N, 6): centre x, y (px), l11, l21, l22 (1/px, times sqrt(1/2)), opacity; see plan.py"""

# 2^f on [-1/2, 1/2] to a relative error of 7.5e-8 (minimax, by iterated reweighting), highest power first.
_EXP2 = (
    1.3276472064403862e-3,
    9.675541407375587e-3,
    5.550713273907222e-2,
    2.4022119722496582e-1,
    6.931469670641166e-1,
    1.000000071654955,
)


class Chunk(NamedTuple):
    """CHUNK Gaussians of each tile of a batch."""

    ids: Array
    """(B, CHUNK) Gaussian ids; past a list's end anything, with alpha 0."""
    places: Array
    """(B, CHUNK) where the lists hold them; past a list's end beyond all lists."""
    columns: Array
    """(B, CHUNK, K) the columns of the table that were asked for."""
    attributes: Array
    """(B, CHUNK, 6) the columns of splats."""
    alpha: Array
    """(B, CHUNK, pixels), 0 below the cut."""
    always: Array
    """() bool, true: for `materialize`."""


def make_table(splats: Float[Array, "n 6"], *columns: Array) -> Float[Array, "n k"]:
    """What a walk gathers for each Gaussian: its splat, the binary logarithm of its opacity, and `columns` (N, ...)."""
    opacity = splats[:, 5:]
    binary = jnp.where(opacity > 0, jnp.log2(jnp.where(opacity > 0, opacity, 1.0)), -jnp.inf)
    return jnp.concatenate([splats, binary, *columns], axis=1)


def _exp2(e: Array) -> Array:
    """2^e where -64 < e < 64, anything elsewhere; float64 takes the library's."""
    if e.dtype != jnp.float32:
        return jnp.exp2(e)
    whole = lax.round(e, lax.RoundingMethod.TO_NEAREST_EVEN)
    fraction = e - whole
    power = jnp.float32(_EXP2[0])
    for coefficient in _EXP2[1:]:
        power = power * fraction + jnp.float32(coefficient)
    # 1.5 * 2^23 + n holds the integer n in its low bits; added to the exponent's bits it multiplies by 2^n.
    shift = lax.bitcast_convert_type(whole + jnp.float32(12582912.0), jnp.int32) << 23
    return lax.bitcast_convert_type(lax.bitcast_convert_type(power, jnp.int32) + shift, jnp.float32)


def pixel_centres(tile: int, dtype) -> tuple[Array, Array]:
    """x and y (pixels,) of a tile's pixels from its upper left corner."""
    local = (np.arange(tile) + 0.5).astype(dtype)
    return np.tile(local, tile), np.repeat(local, tile)


def _alphas(coefficients: Array, tile: int) -> Array:
    """(B, CHUNK, pixels) from l11, l21, c1, l22, c2, e (B, CHUNK, 6): with x, y from the tile's corner,
    u = l11 x + l21 y + c1, v = l22 y + c2, alpha = 2^(e - u^2 - v^2)."""
    l11, l21, c1, l22, c2, e = (coefficients[..., i, None] for i in range(6))
    x, y = pixel_centres(tile, coefficients.dtype)
    u, v = l11 * x + (l21 * y + c1), l22 * y + c2
    exponent = e - u * u - v * v
    cut = np.log2(MIN_ALPHA).astype(exponent.dtype)
    return jnp.where(exponent >= cut, jnp.minimum(_exp2(exponent), MAX_ALPHA), 0.0)


def _coefficients(rows: Array, corner_x: Array, corner_y: Array, exponent: Array) -> Array:
    """(B, CHUNK, 6) for `_alphas`, of splats in the columns of `rows` (B, CHUNK, >= 5)."""
    scale = np.sqrt(1 / np.log(2)).astype(rows.dtype)  # from natural to binary exponents
    x, y = rows[..., 0] - corner_x, rows[..., 1] - corner_y
    l11, l21, l22 = (rows[..., i] * scale for i in (2, 3, 4))
    return jnp.stack([l11, l21, -(l11 * x + l21 * y), l22, -(l22 * y), exponent], axis=-1)


def pixel_alphas(splats: Float[Array, "p 6"], corners: tuple[Array, Array], tile: int) -> Float[Array, "p pixels"]:
    """alpha of P splats in each pixel of a tile of their own, whose upper left corners are `corners` (P,), (P,) px."""
    exponent = make_table(splats)[:, ATTRIBUTES]
    return _alphas(_coefficients(splats, *corners, exponent)[:, None], tile)[:, 0]


def cumulative(combine: Callable, start: Array, values: Array) -> tuple[Array, Array]:
    """Along the second axis of `values` (B, CHUNK, pixels): `start` (B, pixels) combined with all values before
    each, and with all.

    Written out in groups, so that each value is read a handful of times rather than CHUNK times by a fused kernel.
    """
    groups = values.reshape(values.shape[0], -1, _GROUP, values.shape[-1])
    whole = functools.reduce(combine, [groups[:, :, k] for k in range(_GROUP)])
    starts = [start]
    for g in range(groups.shape[1]):
        starts.append(combine(starts[-1], whole[:, g]))
    before = [jnp.stack(starts[:-1], axis=1)]
    for k in range(_GROUP - 1):
        before.append(combine(before[-1], groups[:, :, k]))
    return jnp.stack(before, axis=2).reshape(values.shape), starts[-1]


def blend_weights(transmittance: Array, alpha: Array) -> tuple[Array, Array]:
    """alpha T of a chunk (B, CHUNK, pixels), and the transmittance behind it (B, pixels).

    The transmittance is the plain product of 1 - alpha: it only falls, so a pixel has stopped before the first
    Gaussian that would take it to MIN_TRANSMITTANCE exactly where the product is still above.
    """
    before, after = cumulative(jnp.multiply, transmittance, 1 - alpha)
    weight = before * alpha
    return jnp.where(before - weight > MIN_TRANSMITTANCE, weight, 0.0), after


def walk(
    table: Array,
    lists: TileLists,
    batches: Batches,
    tiles: Array,
    body: Callable,
    state: Any,
    left: Array | None = None,
) -> tuple[Any, Array]:
    """Applies `transmittance, state = body(transmittance, state, chunk)` chunk by chunk down the lists of one batch of
    `tiles` (B,), until the longest has ended or every pixel has stopped.

    Returns the last state, and (B,) int32 how far down its list each tile had a pixel that had not stopped: nothing
    behind is seen. transmittance (B, pixels) starts at 1, or at what earlier lists `left`. `table` is `make_table`'s.
    """
    start, length = batches.starts[tiles, None], batches.lengths[tiles, None]
    corner_x, corner_y = (corner[:, None] for corner in batches.corners(tiles, table.dtype))
    longest = length.max()

    def unfinished(carry):
        first, transmittance, _, _ = carry
        return (first < longest) & (transmittance.max() > MIN_TRANSMITTANCE)

    def step(carry):
        first, transmittance, seen, state = carry
        index = first + lax.iota(jnp.int32, CHUNK)
        ids = lists.gaussians[jnp.minimum(start + index, lists.gaussians.shape[0] - 1)]
        rows = table[ids]
        exponent = jnp.where(index < length, rows[..., ATTRIBUTES], -jnp.inf)
        coefficients = _coefficients(rows, corner_x, corner_y, exponent)
        always = first < longest
        alpha = materialize(always, functools.partial(_alphas, tile=batches.tile), coefficients)
        places = jnp.where(index < length, start + index, lists.gaussians.shape[0])
        chunk = Chunk(ids, places, rows[..., ATTRIBUTES + 1 :], rows[..., :ATTRIBUTES], alpha, always)
        seen = jnp.where(transmittance.max(1) > MIN_TRANSMITTANCE, first + CHUNK, seen)
        transmittance, state = body(transmittance, state, chunk)
        return first + CHUNK, transmittance, seen, state

    pixels = jnp.ones((tiles.shape[0], batches.tile**2), table.dtype) if left is None else left
    _, _, seen, state = lax.while_loop(unfinished, step, (jnp.int32(0), pixels, jnp.zeros_like(tiles), state))
    return state, jnp.minimum(seen, length[:, 0])
