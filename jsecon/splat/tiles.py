"""Which Gaussians touch which tile of the image, front to back.

Pairs are first made of Gaussians and blocks of BLOCK x BLOCK tiles, several times fewer than pairs of tiles, and put
in order by one packed single-key sort of (block, depth). Each sorted pair then gets one bit for every tile of its block
that the Gaussian's ellipse reaches, and the tiles' lists are read off the bits (bits.py): a stable distribution needs
no second sort, and the ellipses leave a fifth fewer pairs than boxes (garden).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from jsecon.errors import require
from jsecon.splat.bits import WORD, compact_tile_lists, loop_in_chunks, tile_bits
from jsecon.splat.project import Projection
from jsecon.splat.strips import BLOCK, FULL_IMAGE, Strip, tile_rows
from jsecon.types import Array, Leaf, record, static

TILE = 8
"""tile edge, px; speed only"""
_TILES = BLOCK * BLOCK
PAIRS = 8192
"""pairs at a time: what they need fits the second cache, and what is not there takes no time"""
# Slack of the ellipse test, px: far above the rounding of a float32 exponent at the rim, far below a pixel.
_SLACK_PX = 0.02


@record
class TileLists:
    """For each tile, row by row, the Gaussians that reach a pixel of it, by depth (equal depths in index order).

    Over several devices each holds the lists of its strip, one strip after another along every axis.
    """

    gaussians: Leaf
    """(16 capacity,) int32 Gaussian ids; each tile's list is one run of it."""
    starts: Leaf
    """(tiles,) int32 where each tile's list begins."""
    lengths: Leaf
    """(tiles,) int32 how long it is."""
    overflow: Leaf
    """(strips,) int32 (block, Gaussian) pairs that did not fit: those of the Gaussians with the highest indices."""
    tile: int = static()
    """tile edge, px."""


def tile_grid(width: int, height: int, tile: int) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-width // tile), -(-height // tile)


def _rectangles(projection: Projection, width: int, height: int, edge: int, strip: Strip):
    """Inclusive-exclusive ranges (x0, x1, y0, y1) of the strip's blocks of `edge` px that each splat's box touches;
    empty where invisible."""
    across, down = tile_grid(width, height, edge)
    ranges = []
    for axis, limit in ((0, across), (1, down)):
        centre, extent = lax.stop_gradient(projection.means_px[:, axis]), projection.extents[:, axis]
        low = jnp.where(projection.visible, (centre - extent) / edge, 0.0)
        high = jnp.where(projection.visible, (centre + extent) / edge, 0.0)
        # Clipped as floats first: a box may reach beyond what int32 holds.
        ranges.append(jnp.floor(jnp.clip(low, 0, limit)).astype(jnp.int32))
        ranges.append(jnp.ceil(jnp.clip(high, 0, limit)).astype(jnp.int32))
    x0, x1, y0, y1 = ranges
    return x0, x1, strip.first_row(y0), strip.first_row(y1)


def pair_counts(
    projection: Projection, width: int, height: int, *, tile: int = TILE, strip: Strip = FULL_IMAGE
) -> Int[Array, " n"]:
    """(N,) int32 number of the strip's blocks of BLOCK x BLOCK tiles that each splat's box touches."""
    x0, x1, y0, y1 = _rectangles(projection, width, height, BLOCK * tile, strip)
    return (x1 - x0) * (y1 - y0)


def depth_order(depths: Float[Array, " n"]) -> Int[Array, " n"]:
    """Indices that sort positive depths, ties in index order.

    Positive float32 sort like their bits, so depth and index pack into one 64-bit key: XLA's CPU sort of one key is
    about five times faster than its sort of a key and a value. Float64 depths fall back to a stable argsort.
    """
    if depths.dtype != jnp.float32:
        return jnp.argsort(depths, stable=True).astype(jnp.int32)
    bits = lax.bitcast_convert_type(depths, jnp.uint32)
    return _sort_packed((bits, 32), (lax.iota(jnp.uint32, depths.shape[0]), 32))[1]


def _sort_packed(*fields: tuple[Array, int]) -> list[Array]:
    """Sorts by the fields, each an array of non-negative integers and its number of bits, 64 together at most, the
    first the most significant; returns them sorted, as int32. 64-bit only inside, by context."""
    with jax.enable_x64(True):
        wide = [lax.convert_element_type(values, jnp.uint64) for values, _ in fields]
        key = wide[0]
        for values, (_, bits) in zip(wide[1:], fields[1:], strict=True):
            key = lax.shift_left(key, lax.full_like(key, bits)) | values
        key = lax.sort(key, is_stable=False)
        out = []
        for _, bits in reversed(fields):
            out.append(lax.convert_element_type(key & lax.full_like(key, (1 << bits) - 1), jnp.int32))
            key = lax.shift_right_logical(key, lax.full_like(key, min(bits, 63)))
    return out[::-1]


def _sorted_pairs(blocks: Array, owner: Array, depths: Array, number: int) -> tuple[Array, Array]:
    """(blocks, owner) sorted by block (0 .. number), then by the owner's depth, then by its index.

    Block, depth and index in one key where they fit 64 bits (the sign of a depth in view is known); else the depths
    are sorted first, and their ranks take the place of both.
    """
    for_block, for_index = number.bit_length(), max((depths.shape[0] - 1).bit_length(), 1)
    if depths.dtype == jnp.float32 and for_block + 31 + for_index <= 64:
        bits = lax.bitcast_convert_type(depths, jnp.uint32)[owner]
        blocks, _, owner = _sort_packed((blocks, for_block), (bits, 31), (owner, for_index))
        return blocks, owner
    return _sorted_pairs_by_rank(blocks, owner, depths)


def _sorted_pairs_by_rank(blocks: Array, owner: Array, depths: Array) -> tuple[Array, Array]:
    order = depth_order(depths)
    ranks = jnp.zeros_like(order).at[order].set(lax.iota(jnp.int32, order.shape[0]), unique_indices=True)
    blocks, rank = _sort_packed((blocks, 32), (ranks[owner], 32))
    return blocks, order[rank]


def tile_lists(
    projection: Projection, width: int, height: int, *, capacity: int, tile: int = TILE, strip: Strip = FULL_IMAGE
) -> TileLists:
    """One strip's lists of up to `capacity` (block, Gaussian) pairs; what does not fit is counted in `overflow`."""
    most = (2**31 - 1) // _TILES - WORD  # whose tiles int32 can count
    require(0 < capacity <= most, "capacity", capacity, f"1 to {most} pairs", "Render so large an image in parts.")
    capacity = round_up_to_words(capacity)
    chunk = min(PAIRS, capacity)
    room = -(-capacity // chunk) * chunk
    edge = BLOCK * tile
    rows = tile_rows(height, tile, strip.count)
    across, down = tile_grid(width, rows * tile, edge)
    number = across * down
    x0, x1, y0, y1 = _rectangles(projection, width, height, edge, strip)
    # Pairs are laid out Gaussian after Gaussian; `owner` says whose pair the k-th is. int32 cumulative sums would wrap
    # past 2^31 pairs, so the sum saturates: beyond the capacity its exact value is needed only for the overflow.
    areas = (x1 - x0) * (y1 - y0)
    ends = _saturating_cumsum(areas)
    starts, total = ends - areas, jnp.minimum(ends[-1], capacity)
    marks = jnp.zeros(room + 1, jnp.int32).at[jnp.minimum(starts, room)].add(1, mode="promise_in_bounds")
    boxes = jnp.stack([starts, x0, y0, jnp.maximum(x1 - x0, 1)], axis=-1)

    def lay_out(first: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        before, blocks, owners = carry
        owner = before + lax.cumsum(lax.dynamic_slice(marks, (first,), (chunk,)))
        pair, box = first + lax.iota(jnp.int32, chunk), boxes[owner]
        within = pair - box[:, 0]
        block = (box[:, 2] + within // box[:, 3]) * across + box[:, 1] + within % box[:, 3]
        block = jnp.where(pair < total, block, number)
        put = lambda whole, part: lax.dynamic_update_slice(whole, part, (first,))
        return owner[-1], put(blocks, block), put(owners, owner)

    nothing = jnp.full(room, number, jnp.int32), jnp.zeros(room, jnp.int32)
    _, blocks, owner = loop_in_chunks(total, chunk, lay_out, (jnp.int32(-1), *nothing))
    nowhere = jnp.asarray(1.0, projection.depths.dtype)
    depths = lax.stop_gradient(jnp.where(projection.visible, jnp.maximum(projection.depths, 0), nowhere))
    blocks, owner = _sorted_pairs(blocks, owner, depths, number)

    ellipses = [projection.means_px, projection.whitening, projection.opacities[:, None]]
    ellipses = lax.stop_gradient(jnp.concatenate(ellipses, axis=1))
    reach = functools.partial(_reached_tiles, ellipses, across=across, number=number, tile=tile, strip=strip)
    members, before = tile_bits(reach, owner, blocks, _TILES, total, chunk)
    gaussians = compact_tile_lists(members, before, owner, total, chunk)

    # A tile's list runs from its block's first pair to the next block's.
    first = jnp.searchsorted(blocks, lax.iota(jnp.int32, number + 1)).astype(jnp.int32)
    word = jnp.minimum(first // WORD, members.shape[0] - 1)
    earlier = (first - word * WORD).astype(jnp.uint32)[:, None]
    mask = jnp.where(earlier >= WORD, jnp.uint32(0xFFFFFFFF), (jnp.uint32(1) << (earlier & (WORD - 1))) - 1)
    bounds = before[word] + lax.population_count(members[word] & mask).astype(jnp.int32)
    tiles_across = -(-width // tile)

    # Only the last strips have rows below the image.
    inside = (strip.tile_row(np.arange(rows)) * tile < height)[:, None]

    def row_by_row(of_blocks: Array) -> Array:
        square = of_blocks.reshape(down, across, BLOCK, BLOCK).transpose(0, 2, 1, 3)
        square = square.reshape(down * BLOCK, across * BLOCK)[:rows, :tiles_across]
        return jnp.where(inside, square, 0).reshape(-1)

    overflow = jnp.maximum(ends[-1:] - capacity, 0)
    return TileLists(gaussians, row_by_row(bounds[:-1]), row_by_row(bounds[1:] - bounds[:-1]), overflow, tile)


def _reached_tiles(
    ellipses: Array, owner: Array, blocks: Array, *, across: int, number: int, tile: int, strip: Strip
) -> Array:
    """(pairs,) uint32: bit (row * BLOCK + column) is set where the ellipse alpha >= 1/255 reaches the rectangle between
    that tile's pixel centres; 0 for the block `number`. `ellipses` (N, 6) are centre, whitening and opacity.

    Exact up to a slack that only adds tiles: within a row of tiles the ellipse is convex, so the interval of x that it
    covers ends where its rim is widest, or at the row's edge if that lies beyond. Comparisons are written so that a NaN
    counts as reached.
    """
    x, y, l11, l21, l22, opacity = jnp.moveaxis(ellipses[owner], 1, 0)
    radius2 = 2 * jnp.log(jnp.maximum(opacity * 255, 1.0)) * (1 + 1e-4) + 1e-4
    radius, slope = jnp.sqrt(radius2), l21 / l11
    highest = radius / l22
    widest = -l21 * highest / jnp.sqrt(l22 * l22 + l21 * l21)  # dy where the rim is farthest right
    left = (blocks % across * (BLOCK * tile)).astype(x.dtype) - x
    top = (strip.block_row(blocks // across) * (BLOCK * tile)).astype(y.dtype) - y
    slack = _SLACK_PX + 1e-5 * jnp.abs(slope * highest)
    bits = jnp.zeros(blocks.shape, jnp.uint32)
    for row in range(BLOCK):
        low, high = top + (row * tile + 0.5 - _SLACK_PX), top + ((row + 1) * tile - 0.5 + _SLACK_PX)
        missed = jnp.abs(jnp.clip(0.0, low, high)) > highest
        rims = []
        for side in (-1, 1):
            dy = jnp.clip(jnp.clip(side * widest, low, high), -highest, highest)
            v = l22 * dy
            rims.append(side * jnp.sqrt(jnp.maximum(radius2 - v * v, 0.0)) / l11 - slope * dy)
        for column in range(BLOCK):
            beside = left + ((column + 1) * tile - 0.5) + slack < rims[0]
            beside |= left + (column * tile + 0.5) - slack > rims[1]
            bits |= jnp.where(missed | beside, jnp.uint32(0), jnp.uint32(1 << (row * BLOCK + column)))
    return jnp.where(blocks < number, bits, jnp.uint32(0))


def _saturating_cumsum(areas: Array) -> Array:
    """int32 cumulative sum that stays at its largest value instead of wrapping."""
    largest = jnp.iinfo(jnp.int32).max
    exact = jnp.cumsum(areas.astype(jnp.int32))
    approximate = jnp.cumsum(areas.astype(jnp.float32))
    wrapped = lax.cummax((approximate > 0.99 * largest).astype(jnp.int32)) > 0
    return jnp.where(wrapped, largest, exact)


def round_up_to_words(pairs: int) -> int:
    """Pairs rounded up to whole words of bits."""
    return -(-pairs // WORD) * WORD
