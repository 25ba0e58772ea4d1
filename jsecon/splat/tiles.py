"""Tile lists: the Gaussians that reach each tile of the image, front to back.

Pairs are first made of Gaussians and blocks of BLOCK x BLOCK tiles, several times fewer than pairs of tiles, and sorted
by one packed key (block, depth). Each sorted pair then gets one bit for every tile of its block that the ellipse of the
Gaussian reaches, and the lists are compacted from the bits: this is stable without a second sort, and ellipses give a
fifth fewer pairs than boxes (garden).

A scatter of every bit to its place would take most of the time (garden: 38 of 52 ms on one core). Instead every slot of
the output searches its bit, which needs vector arithmetic and a few nearby loads (6 ms). Pairs come in words of 32. The
bits of one word for one tile are a segment, whose set bits fill consecutive slots.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Int, UInt

from jsecon.errors import require
from jsecon.splat.fusion import compute_once
from jsecon.splat.project import Projection
from jsecon.splat.strips import BLOCK, FULL_IMAGE, Strip, tile_rows
from jsecon.types import Array, Leaf, record, static

TILE = 8
"""Edge of a tile, px; affects only speed."""
_SLACK_PX = 0.02
"""Slack of the ellipse test: far above the rounding of a float32 exponent at the rim, far below a pixel."""
WORD = 32
"""Number of pairs in a word of bits."""
_CHUNK_SLOTS = 32768
"""Number of output slots per chunk: their arrays fit the second-level cache."""


@record
class TileLists:
    """Gaussians that reach a pixel of each tile, by depth (equal depths in index order); tiles row by row.

    Over several devices, each holds the lists of its strip; strips are joined along every axis.
    """

    gaussians: Leaf
    """(16 capacity,) int32 Gaussian ids; the list of each tile is one run of it."""
    starts: Leaf
    """(tiles,) int32 start of each list."""
    lengths: Leaf
    """(tiles,) int32 length of each list."""
    overflow: Leaf
    """(strips,) int32 pairs beyond the capacity: those of the Gaussians with the highest indices."""
    tile: int = static()
    """Edge of a tile, px."""


def tile_grid(width: int, height: int, tile: int) -> tuple[int, int]:
    """Counts the tiles of an image across and down."""
    return -(-width // tile), -(-height // tile)


def _rectangles(projection: Projection, width: int, height: int, edge: int, strip: Strip):
    """Computes the half-open range (x0, x1, y0, y1) of the strip's blocks of `edge` px that each splat touches."""
    across, down = tile_grid(width, height, edge)
    ranges = []
    for axis, limit in ((0, across), (1, down)):
        centre, extent = lax.stop_gradient(projection.means_px[:, axis]), projection.extents[:, axis]
        low = jnp.where(projection.visible, (centre - extent) / edge, 0.0)
        high = jnp.where(projection.visible, (centre + extent) / edge, 0.0)
        # Clipped as floats first: a box may reach beyond what int32 holds.
        ranges.append(jnp.floor(jnp.clip(low, 0, limit)).astype(jnp.int32))
        ranges.append(jnp.ceil(jnp.clip(high, 0, limit)).astype(jnp.int32))
    x0, x1, *rows = ranges
    return x0, x1, *((row - strip.index + strip.count - 1) // strip.count for row in rows)


def pair_counts(projection: Projection, width: int, height: int, *, strip: Strip = FULL_IMAGE) -> Int[Array, " n"]:
    """Counts the blocks of BLOCK x BLOCK tiles of a strip that each splat touches, (N,) int32."""
    x0, x1, y0, y1 = _rectangles(projection, width, height, BLOCK * TILE, strip)
    return (x1 - x0) * (y1 - y0)


def _sorted_pairs(blocks: Array, owner: Array, depths: Array, number: int) -> tuple[Array, Array]:
    """(blocks, owner) sorted by block (0 .. number), then by depth and index of the owner.

    Positive float32 sort like their bits, so block, depth and index pack into one key if they fit 64 bits: XLA's CPU
    sort of one key is about five times faster than its sort of several. 64-bit types are enabled only inside.
    """
    for_block, for_index = number.bit_length(), max((depths.shape[0] - 1).bit_length(), 1)
    if depths.dtype != jnp.float32 or for_block + 31 + for_index > 64:
        keys: Any = blocks, depths[owner], owner
        blocks, _, owner = lax.sort(keys, num_keys=3, is_stable=False)
        return blocks, owner
    bits = lax.bitcast_convert_type(depths, jnp.uint32)[owner]
    with jax.enable_x64(True):
        words = [lax.convert_element_type(values, jnp.uint64) for values in (blocks, bits, owner)]
        key = words[0]
        for values, size in zip(words[1:], (31, for_index)):
            key = lax.shift_left(key, lax.full_like(key, size)) | values
        key = lax.sort(key, is_stable=False)
        owner = lax.convert_element_type(key & lax.full_like(key, (1 << for_index) - 1), jnp.int32)
        blocks = lax.shift_right_logical(key, lax.full_like(key, 31 + for_index))
        return lax.convert_element_type(blocks, jnp.int32), owner


def tile_lists(
    projection: Projection, width: int, height: int, *, capacity: int, tile: int = TILE, strip: Strip = FULL_IMAGE
) -> TileLists:
    """Makes the tile lists of one strip.

    Args:
      projection: N splats.
      width: Width of the image, px.
      height: Height of the image, px.
      capacity: Maximum number of (block, Gaussian) pairs; more are counted in `overflow`.
      tile: Edge of a tile, px.
      strip: The strip.
    """
    most = (2**31 - 1) // BLOCK**2 - WORD  # so that int32 can count their tiles
    require(0 < capacity <= most, "capacity", capacity, f"1 to {most} pairs", "Render such a large image in parts.")
    capacity = -(-capacity // WORD) * WORD
    chunk = min(8192, capacity)  # pairs whose arrays fit the second-level cache; empty chunks take no time
    room = -(-capacity // chunk) * chunk
    edge = BLOCK * tile
    rows = tile_rows(height, tile, strip.count)
    across, down = tile_grid(width, rows * tile, edge)
    number = across * down
    if not projection.depths.shape[0]:
        empty = jnp.zeros(rows * -(-width // tile), jnp.int32)
        return TileLists(empty[:0], empty, empty, jnp.zeros(1, jnp.int32), tile)
    x0, x1, y0, y1 = _rectangles(projection, width, height, edge, strip)
    # Pairs are laid out Gaussian after Gaussian; `owner` is the Gaussian of each. The cumulative sum saturates instead
    # of wrapping at 2^31 pairs: beyond the capacity its exact value affects only the overflow.
    areas = (x1 - x0) * (y1 - y0)
    ends = jnp.cumsum(areas, dtype=jnp.int32)
    if len(areas) * number >= 2**31:
        with jax.enable_x64(True):
            area_sums = lax.cumsum(lax.convert_element_type(areas, jnp.int64))
            ends = lax.convert_element_type(lax.min(area_sums, lax.full_like(area_sums, 2**31 - 1)), jnp.int32)
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

        def put(array, part):
            return lax.dynamic_update_slice(array, part, (first,))

        return owner[-1], put(blocks, block), put(owners, owner)

    no_pairs = jnp.full(room, number, jnp.int32), jnp.zeros(room, jnp.int32)
    _, blocks, owner = _loop_in_chunks(total, chunk, lay_out, (jnp.int32(-1), *no_pairs))
    default = jnp.asarray(1.0, projection.depths.dtype)
    depths = lax.stop_gradient(jnp.where(projection.visible, jnp.maximum(projection.depths, 0), default))
    blocks, owner = _sorted_pairs(blocks, owner, depths, number)

    ellipses = [projection.means_px, projection.whitening, projection.opacities[:, None]]
    ellipses = lax.stop_gradient(jnp.concatenate(ellipses, axis=1))
    reach = functools.partial(_reached_tiles, ellipses, across=across, number=number, tile=tile, strip=strip)
    members, before = _tile_bits(reach, owner, blocks, BLOCK**2, total, chunk)
    gaussians = _compact_tile_lists(members, before, owner, total, chunk)

    # The list of a tile runs from the first pair of its block to the first pair of the next block.
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
    """Computes for each pair which pixel blocks of the tile the ellipse reaches, as bits (pairs,) uint32.

    Bit (row * BLOCK + column) is set if the ellipse alpha >= 1/255 reaches the rectangle between the pixel centres of
    that tile; 0 for the block `number`. `ellipses` (N, 6) are centre, whitening and opacity.

    Exact up to a slack that only adds tiles: the ellipse is convex, so within a row of tiles its interval of x ends at
    its widest point, or at the edge of the row if that point lies beyond. A NaN counts as reached.
    """
    x, y, l11, l21, l22, opacity = jnp.moveaxis(ellipses[owner], 1, 0)
    radius2 = 2 * jnp.log(jnp.maximum(opacity * 255, 1.0)) * (1 + 1e-4) + 1e-4
    radius, slope = jnp.sqrt(radius2), l21 / l11
    highest = radius / l22
    widest = -l21 * highest / jnp.sqrt(l22 * l22 + l21 * l21)  # dy of its rightmost point
    left = (blocks % across * (BLOCK * tile)).astype(x.dtype) - x
    top = ((blocks // across * strip.count + strip.index) * (BLOCK * tile)).astype(y.dtype) - y
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


def _loop_in_chunks(total: Array, size: int, step: Callable[[Array, Any], Any], carry: Any) -> Any:
    """Runs `carry = step(first, carry)` for first = 0, size, 2 size, ... below `total`, and returns the last carry."""

    def advance(state):
        return (state[0] + size, step(*state))

    return lax.while_loop(lambda state: state[0] < total, advance, (jnp.int32(0), carry))[1]


def _transpose_words(reached: UInt[Array, " pairs"], tiles: int) -> UInt[Array, "words t"]:
    """(pairs / 32, tiles) words whose bit k is the bit of the tile in pair k."""
    words = reached.reshape(-1, WORD)
    bits = ((words[:, :, None] >> lax.iota(jnp.uint32, tiles)) & 1) << lax.iota(jnp.uint32, WORD)[:, None]
    return lax.reduce(bits, jnp.uint32(0), lax.bitwise_or, (1,))


def _tile_bits(
    reach: Callable[[Array, Array], Array], owner: Array, blocks: Array, tiles: int, total: Array, chunk: int
) -> tuple[UInt[Array, "words t"], Int[Array, "words t"]]:
    """Computes the bits of all segments, and the number of set bits before each.

    Args:
      reach: Maps owners and blocks of a chunk of pairs to their bits, uint32.
      owner: (pairs,) Gaussian of each pair, in whole chunks.
      blocks: (pairs,) block of each pair.
      tiles: Number of tiles of a block.
      total: Number of pairs in use.
      chunk: Number of pairs per chunk.

    Returns:
      (words, tiles) bits, and (words, tiles) the number of set bits before, counted tile after tile and word after word
      within a tile.
    """

    def part(a, first):
        return lax.dynamic_slice(a, (first,), (chunk,))

    def step(first: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        so_far, members, before = carry
        reached = compute_once(first < total, reach, part(owner, first), part(blocks, first))
        bits = _transpose_words(reached, tiles)
        ends = so_far + lax.cumsum(lax.population_count(bits).astype(jnp.int32))

        def put(array, part):
            return lax.dynamic_update_slice_in_dim(array, part, first // WORD, 0)

        return ends[-1], put(members, bits), put(before, ends - lax.population_count(bits).astype(jnp.int32))

    words = owner.shape[0] // WORD
    zeros = jnp.zeros(tiles, jnp.int32), jnp.zeros((words, tiles), jnp.uint32), jnp.zeros((words, tiles), jnp.int32)
    of_tile, members, before = _loop_in_chunks(total, chunk, step, zeros)
    # Unused words come after all others of their tile.
    filled = (lax.iota(jnp.int32, words) * WORD < total)[:, None]
    return members, jnp.where(filled, before, of_tile) + (lax.cumsum(of_tile) - of_tile)


def _compact_tile_lists(
    members: UInt[Array, "words t"],
    before: Int[Array, "words t"],
    owner: Int[Array, " pairs"],
    total: Array,
    chunk: int,
) -> Array:
    """Lists the owners of the set bits in the order of `before`, (32 words tiles,) int32; arbitrary after the last.

    Args:
      members: Bits of `_tile_bits`.
      before: Number of set bits before each word.
      owner: Gaussian of each pair.
      total: Number of pairs in use.
      chunk: Number of pairs per chunk.
    """
    words, tiles = members.shape
    slots, chunk = -(-WORD * words * tiles // _CHUNK_SLOTS) * _CHUNK_SLOTS, chunk // WORD
    # The non-empty segments without gaps: bits, first slot, first pair; and one bit for each slot where one begins.
    out_of_range = words * tiles, slots // WORD
    counts = (members > 0).sum(0, dtype=jnp.int32)

    def gather(first: Array, carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Array, Array, Array]:
        so_far, table, begins = carry
        bits, starts = (lax.dynamic_slice_in_dim(a, first, chunk) for a in (members, before))
        filled = bits > 0
        ends = so_far + lax.cumsum(filled.astype(jnp.int32))
        pairs = jnp.broadcast_to((first + lax.iota(jnp.int32, chunk))[:, None] * WORD, bits.shape)
        rows = jnp.stack([lax.bitcast_convert_type(bits, jnp.int32), starts, pairs], -1)
        table = table.at[jnp.where(filled, ends - 1, out_of_range[0])].set(rows, mode="promise_in_bounds")
        mark = jnp.uint32(1) << (starts % WORD).astype(jnp.uint32)
        place = jnp.where(filled, starts // WORD, out_of_range[1])
        return ends[-1], table, begins.at[place].add(mark, mode="promise_in_bounds")

    zeros = jnp.zeros((out_of_range[0] + 1, 3), jnp.int32), jnp.zeros(out_of_range[1] + 1, jnp.uint32)
    _, table, begins = _loop_in_chunks(-(-total // WORD), chunk, gather, (lax.cumsum(counts) - counts, *zeros))
    columns = [table[:, i] for i in range(3)]
    until = (jnp.uint32(2) << lax.iota(jnp.uint32, WORD)) - 1

    def segment_of(begins: Array, begun: Array) -> Array:
        return (begun[:, None] + lax.population_count(begins[:, None] & until).astype(jnp.int32) - 1).reshape(-1)

    def pair_of(first: Array, bits: Array, start: Array, pair: Array) -> Array:
        """The pair of set bit number slot - start, by bisection of the word."""
        bits, k = lax.bitcast_convert_type(bits, jnp.uint32), first + lax.iota(jnp.int32, _CHUNK_SLOTS) - start
        half = WORD // 2
        while half:
            lower = lax.population_count(bits & jnp.uint32((1 << half) - 1)).astype(jnp.int32)
            above = k >= lower
            k, pair = jnp.where(above, k - lower, k), jnp.where(above, pair + half, pair)
            bits = jnp.where(above, bits >> half, bits)
            half //= 2
        return jnp.minimum(pair, owner.shape[0] - 1)

    last = before[-1, -1] + lax.population_count(members[-1, -1]).astype(jnp.int32)

    def fill(first: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        begun, out = carry
        begin_bits = lax.dynamic_slice(begins, (first // WORD,), (_CHUNK_SLOTS // WORD,))
        begun = begun + lax.cumsum(lax.population_count(begin_bits).astype(jnp.int32))
        always = first < last
        segment = compute_once(
            always, segment_of, begin_bits, begun - lax.population_count(begin_bits).astype(jnp.int32)
        )
        pairs = compute_once(always, pair_of, first, *compute_once(always, lambda s: [c[s] for c in columns], segment))
        return begun[-1], lax.dynamic_update_slice(out, owner[pairs], (first,))

    out = _loop_in_chunks(last, _CHUNK_SLOTS, fill, (jnp.int32(0), jnp.zeros(slots, jnp.int32)))[1]
    return out[: WORD * words * tiles]
