"""Lists read off bits: from one bit for each (pair, tile of its block) to each tile's run of Gaussians.

A scatter of every bit to its place took most of the time that lists take (garden: 38 of 52 ms on one core); here every
slot of the output finds its bit, which costs vector arithmetic and a few loads near each other (6 ms). Pairs come in
words of 32; the bits of one word for one tile are a segment, whose set bits fill neighbouring slots.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int, UInt

from jsecon.splat.fusion import materialize
from jsecon.types import Array

WORD = 32
"""pairs in a word"""
_SLOTS = 32768
# slots at a time: what they need fits the second cache


def loop_in_chunks(total: Array, size: int, step: Callable[[Array, Any], Any], carry: Any) -> Any:
    """`carry = step(first, carry)` for first = 0, size, 2 size and so on below `total`."""
    onward = lambda state: (state[0] + size, step(*state))
    return lax.while_loop(lambda state: state[0] < total, onward, (jnp.int32(0), carry))[1]


def transpose_words(reached: UInt[Array, " pairs"], tiles: int) -> UInt[Array, "words t"]:
    """(pairs / 32, tiles): bit k tells whether pair k of the word has the tile's bit."""
    words = reached.reshape(-1, WORD)
    bits = ((words[:, :, None] >> lax.iota(jnp.uint32, tiles)) & 1) << lax.iota(jnp.uint32, WORD)[:, None]
    return lax.reduce(bits, jnp.uint32(0), lax.bitwise_or, (1,))


def tile_bits(
    reach: Callable[[Array, Array], Array], owner: Array, blocks: Array, tiles: int, total: Array, chunk: int
) -> tuple[UInt[Array, "words t"], Int[Array, "words t"]]:
    """The bits of all segments, `reach(owner, blocks)` transposed, and the set bits before each: tile after tile, and
    word after word within a tile. Pairs from `total` on have none; all come in whole chunks of pairs."""
    part = lambda a, first: lax.dynamic_slice(a, (first,), (chunk,))

    def step(first: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        so_far, members, before = carry
        reached = materialize(first < total, reach, part(owner, first), part(blocks, first))
        own = transpose_words(reached, tiles)
        ends = so_far + lax.cumsum(lax.population_count(own).astype(jnp.int32))
        put = lambda whole, part: lax.dynamic_update_slice_in_dim(whole, part, first // WORD, 0)
        return ends[-1], put(members, own), put(before, ends - lax.population_count(own).astype(jnp.int32))

    words = owner.shape[0] // WORD
    nothing = jnp.zeros(tiles, jnp.int32), jnp.zeros((words, tiles), jnp.uint32), jnp.zeros((words, tiles), jnp.int32)
    of_tile, members, before = loop_in_chunks(total, chunk, step, nothing)
    # Words that no pair fills count as after all others of their tile.
    filled = (lax.iota(jnp.int32, words) * WORD < total)[:, None]
    return members, jnp.where(filled, before, of_tile) + (lax.cumsum(of_tile) - of_tile)


def compact_tile_lists(
    members: UInt[Array, "words t"],
    before: Int[Array, "words t"],
    owner: Int[Array, " pairs"],
    total: Array,
    chunk: int,
) -> Array:
    """(32 words t,) int32 the owners of the set bits, in the order of `before`, and anything after the last. Pairs from
    `total` on have no bits."""
    words, tiles = members.shape
    slots, chunk = -(-WORD * words * tiles // _SLOTS) * _SLOTS, chunk // WORD
    # The filled segments without gaps: bits, first slot, first pair; and one bit for each slot where one begins.
    nowhere = words * tiles, slots // WORD
    counts = (members > 0).sum(0, dtype=jnp.int32)

    def gather(first: Array, carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Array, Array, Array]:
        so_far, table, begins = carry
        own, starts = (lax.dynamic_slice_in_dim(a, first, chunk) for a in (members, before))
        filled = own > 0
        ends = so_far + lax.cumsum(filled.astype(jnp.int32))
        pairs = jnp.broadcast_to((first + lax.iota(jnp.int32, chunk))[:, None] * WORD, own.shape)
        rows = jnp.stack([lax.bitcast_convert_type(own, jnp.int32), starts, pairs], -1)
        table = table.at[jnp.where(filled, ends - 1, nowhere[0])].set(rows, mode="promise_in_bounds")
        mark = jnp.uint32(1) << (starts % WORD).astype(jnp.uint32)
        place = jnp.where(filled, starts // WORD, nowhere[1])
        return ends[-1], table, begins.at[place].add(mark, mode="promise_in_bounds")

    nothing = jnp.zeros((nowhere[0] + 1, 3), jnp.int32), jnp.zeros(nowhere[1] + 1, jnp.uint32)
    _, table, begins = loop_in_chunks(-(-total // WORD), chunk, gather, (lax.cumsum(counts) - counts, *nothing))
    columns = [table[:, i] for i in range(3)]
    until = (jnp.uint32(2) << lax.iota(jnp.uint32, WORD)) - 1

    def segment_of(begins: Array, begun: Array) -> Array:
        return (begun[:, None] + lax.population_count(begins[:, None] & until).astype(jnp.int32) - 1).reshape(-1)

    def pair_of(first: Array, bits: Array, start: Array, pair: Array) -> Array:
        """The pair of the (slot - start)-th set bit, by halving the word."""
        bits, k = lax.bitcast_convert_type(bits, jnp.uint32), first + lax.iota(jnp.int32, _SLOTS) - start
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
        own = lax.dynamic_slice(begins, (first // WORD,), (_SLOTS // WORD,))
        begun = begun + lax.cumsum(lax.population_count(own).astype(jnp.int32))
        always = first < last
        segment = materialize(always, segment_of, own, begun - lax.population_count(own).astype(jnp.int32))
        pairs = materialize(always, pair_of, first, *materialize(always, lambda s: [c[s] for c in columns], segment))
        return begun[-1], lax.dynamic_update_slice(out, owner[pairs], (first,))

    out = loop_in_chunks(last, _SLOTS, fill, (jnp.int32(0), jnp.zeros(slots, jnp.int32)))[1]
    return out[: WORD * words * tiles]
