"""Scans the lists of a batch of tiles: Gaussians in chunks, front to back, until all pixels are opaque.

A batch holds tiles with lists of similar length. Arrays of a scan are (tiles, ..., pixels): the pixels of a tile are
innermost and fill the vectors; numbers of a Gaussian are shared by a row of pixels.

XLA's CPU backend decides the speed; measured on garden (benchmarks/results.md):
- A scan over single Gaussians starts four kernels for each and reads slices unvectorised. A chunk at a time, with the
  recurrence inside of one kernel, takes a third of that.
- Fusion recomputes cheap arithmetic for every reader, such as the exponentials of a chunk as polynomials:
  `compute_once` prevents it.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.fusion import compute_once
from jsecon.splat.strips import FULL_IMAGE, Strip
from jsecon.splat.tiles import TileLists, tile_grid
from jsecon.types import Array


class Batches(NamedTuple):
    """Tiles sorted by list length, in batches of B; the last is padded with empty tiles."""

    tiles: Array
    """(batches, B) tile ids; `number` = an empty tile outside the image."""
    starts: Array
    """(number + 1,) start of the list of each tile."""
    lengths: Array
    """(number + 1,) its length."""
    across: int
    """Tiles in a row of the strip."""
    number: int
    """Tiles of the strip."""
    tile: int
    """Edge of a tile, px."""
    strip: Strip

    def corners(self, tiles: Array, dtype) -> tuple[Array, Array]:
        """Finds x and y (px) of the upper left corners of tiles in the image."""
        x, y = tiles % self.across, self.strip.tile_row(tiles // self.across)
        return (x * self.tile).astype(dtype), (y * self.tile).astype(dtype)


def make_batches(lists: TileLists, width: int, strip: Strip = FULL_IMAGE, most: int = 64) -> Batches:
    """Groups the tiles of one strip into batches, longest lists first.

    A batch is scanned as far as its longest list. If there are few tiles, their lists differ more and batches are
    smaller. `most` limits the tiles of a batch; it affects only speed.
    """
    number = lists.lengths.shape[0]
    batch = min(most, max(16, 1 << (max(number // 12, 1).bit_length() - 1)))
    order = jnp.argsort(-lists.lengths).astype(jnp.int32)
    order = jnp.concatenate([order, jnp.full(-number % batch, number, jnp.int32)])
    empty = jnp.zeros(1, jnp.int32)
    starts, lengths = (jnp.concatenate([a, empty]) for a in (lists.starts, lists.lengths))
    return Batches(order.reshape(-1, batch), starts, lengths, -(-width // lists.tile), number, lists.tile, strip)


def to_tiles(image: Array, tile: int) -> Array:
    """Divides an image (H, W, ...) into tiles, row by row.

    Returns:
      (tiles + 1, tile * tile, ...), zero outside of the image; the last tile is empty.
    """
    height, width, *rest = image.shape
    across, down = tile_grid(width, height, tile)
    padding = [(0, down * tile - height), (0, across * tile - width)] + [(0, 0)] * len(rest)
    tiles = jnp.pad(image, padding).reshape(down, tile, across, tile, *rest)
    tiles = jnp.moveaxis(tiles, 2, 1).reshape(across * down, tile * tile, *rest)
    return jnp.concatenate([tiles, jnp.zeros_like(tiles[:1])])


CHUNK = 16
"""Number of Gaussians of each list per step; affects only speed."""
_GROUP = 4
"""Recurrences over a chunk run within and over groups of this many."""
ATTRIBUTES = 6
"""Columns of splats (N, 6): centre x, y (px), l11, l21, l22 (1/px, times sqrt(1/2)), opacity; see plan.py"""


class _Chunk(NamedTuple):
    """CHUNK Gaussians of each tile of a batch."""

    ids: Array
    """(B, CHUNK) Gaussian ids; arbitrary beyond the end of a list, with alpha 0."""
    places: Array
    """(B, CHUNK) their positions in the lists; out of range beyond the end of a list."""
    columns: Array
    """(B, CHUNK, K) the additional columns of the table."""
    attributes: Array
    """(B, CHUNK, 6) the columns of splats."""
    alpha: Array
    """(B, CHUNK, pixels), 0 below the cut."""
    always: Array
    """() bool, true: for `compute_once`."""


def make_table(splats: Float[Array, "n 6"], *columns: Array) -> Float[Array, "n k"]:
    """Makes the table that a scan gathers from: splats, the binary logarithms of their opacities, further columns."""
    opacity = splats[:, 5:]
    binary = jnp.where(opacity > 0, jnp.log2(jnp.where(opacity > 0, opacity, 1.0)), -jnp.inf)
    return jnp.concatenate([splats, binary, *columns], axis=1)


def _exp2(e: Array) -> Array:
    """2^e for -64 < e < 64, arbitrary elsewhere; float64 uses the library function."""
    if e.dtype != jnp.float32:
        return jnp.exp2(e)
    whole = lax.round(e, lax.RoundingMethod.TO_NEAREST_EVEN)
    fraction = e - whole
    # Relative error of 7.5e-8 on [-1/2, 1/2] (minimax, by iterated reweighting), highest power first.
    power = jnp.float32(1.3276472064403862e-3)
    for coefficient in (
        9.675541407375587e-3,
        5.550713273907222e-2,
        2.4022119722496582e-1,
        6.931469670641166e-1,
        1.000000071654955,
    ):
        power = power * fraction + jnp.float32(coefficient)
    # 1.5 * 2^23 + n holds the integer n in its low bits; added to the exponent's bits it multiplies by 2^n.
    shift = lax.bitcast_convert_type(whole + jnp.float32(12582912.0), jnp.int32) << 23
    return lax.bitcast_convert_type(lax.bitcast_convert_type(power, jnp.int32) + shift, jnp.float32)


def pixel_centres(tile: int, dtype) -> tuple[Array, Array]:
    """Finds x and y of the centres of the pixels of a tile from its upper left corner, px, row by row; NumPy."""
    local = (np.arange(tile) + 0.5).astype(dtype)
    return np.tile(local, tile), np.repeat(local, tile)


def _alphas(coefficients: Array, tile: int) -> Array:
    """Computes alpha (B, CHUNK, pixels) from l11, l21, c1, l22, c2, e (B, CHUNK, 6).

    With x, y from the tile's corner, u = l11 x + l21 y + c1, v = l22 y + c2 and alpha = 2^(e - u^2 - v^2).
    """
    l11, l21, c1, l22, c2, e = (coefficients[..., i, None] for i in range(6))
    x, y = pixel_centres(tile, coefficients.dtype)
    u, v = l11 * x + (l21 * y + c1), l22 * y + c2
    exponent = e - u * u - v * v
    cut = np.log2(MIN_ALPHA).astype(exponent.dtype)
    return jnp.where(exponent >= cut, jnp.minimum(_exp2(exponent), MAX_ALPHA), 0.0)


def _coefficients(rows: Array, corner_x: Array, corner_y: Array, exponent: Array) -> Array:
    """(B, CHUNK, 6) coefficients for `_alphas` of the splats in `rows` (B, CHUNK, >= 5)."""
    scale = np.sqrt(1 / np.log(2)).astype(rows.dtype)  # from natural to binary exponents
    x, y = rows[..., 0] - corner_x, rows[..., 1] - corner_y
    l11, l21, l22 = (rows[..., i] * scale for i in (2, 3, 4))
    return jnp.stack([l11, l21, -(l11 * x + l21 * y), l22, -(l22 * y), exponent], axis=-1)


def cumulative(combine: Callable, start: Array, values: Array) -> tuple[Array, Array]:
    """Computes an exclusive scan along the second axis with an associative operation.

    It runs in groups, so that a fused kernel reads each value a few times instead of CHUNK times.

    Returns:
      (B, CHUNK, pixels) `start` combined with all earlier values, and (B, pixels) with all values.
    """
    groups = values.reshape(values.shape[0], -1, _GROUP, values.shape[-1])
    totals = functools.reduce(combine, [groups[:, :, k] for k in range(_GROUP)])
    starts = [start]
    for g in range(groups.shape[1]):
        starts.append(combine(starts[-1], totals[:, g]))
    before = [jnp.stack(starts[:-1], axis=1)]
    for k in range(_GROUP - 1):
        before.append(combine(before[-1], groups[:, :, k]))
    return jnp.stack(before, axis=2).reshape(values.shape), starts[-1]


def blend_weights(transmittance: Array, alpha: Array) -> tuple[Array, Array]:
    """Computes the weights alpha T (B, CHUNK, pixels) of a chunk, and the transmittance behind it.

    The transmittance is the plain product of 1 - alpha. It only falls, so a Gaussian has weight exactly if the product
    behind it is still above MIN_TRANSMITTANCE.
    """
    before, after = cumulative(jnp.multiply, transmittance, 1 - alpha)
    weight = before * alpha
    return jnp.where(before - weight > MIN_TRANSMITTANCE, weight, 0.0), after


def scan_tiles(
    table: Array, lists: TileLists, batches: Batches, tiles: Array, body: Callable, state: Any
) -> tuple[Any, Array]:
    """Scans the lists of one batch of tiles, until the longest ends or every pixel is opaque.

    Args:
      table: Result of `make_table`.
      lists: Tile lists.
      batches: Batches of the lists.
      tiles: (B,) tiles of this batch.
      body: `transmittance, state = body(transmittance, state, chunk)`, with transmittance (B, pixels).
      state: Initial state.

    Returns:
      The last state, and (B,) int32 the visible length of each list.
    """
    if not table.shape[0]:  # without Gaussians there is no row to gather
        return state, jnp.zeros_like(tiles)
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
        alpha = compute_once(always, functools.partial(_alphas, tile=batches.tile), coefficients)
        places = jnp.where(index < length, start + index, lists.gaussians.shape[0])
        chunk = _Chunk(ids, places, rows[..., ATTRIBUTES + 1 :], rows[..., :ATTRIBUTES], alpha, always)
        seen = jnp.where(transmittance.max(1) > MIN_TRANSMITTANCE, first + CHUNK, seen)
        transmittance, state = body(transmittance, state, chunk)
        return first + CHUNK, transmittance, seen, state

    pixels = jnp.ones((tiles.shape[0], batches.tile**2), table.dtype)
    _, _, seen, state = lax.while_loop(unfinished, step, (jnp.int32(0), pixels, jnp.zeros_like(tiles), state))
    return state, jnp.minimum(seen, length[:, 0])
