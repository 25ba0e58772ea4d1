"""Lists read off bits: from one bit for each (pair, tile of its block) to each tile's run of Gaussians.

A scatter of every bit to its place took most of the time that lists take (garden: 38 of 52 ms on one core); here every
slot of the output finds its bit, which costs vector arithmetic and a few loads near each other (6 ms). Pairs come in
words of 32; the bits of one word for one tile are a segment, whose set bits fill neighbouring slots.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Int, UInt

from jsecon.splat.stored import stored
from jsecon.types import Array

WORD = 32
"""pairs in a word"""
_SLOTS = 32768
# slots at a time: what they need fits the second cache


def transpose_words(reached: UInt[Array, " pairs"], tiles: int) -> UInt[Array, "words t"]:
    """(pairs / 32, tiles): bit k tells whether pair k of the word has the tile's bit."""
    words = reached.reshape(-1, WORD)
    bits = ((words[:, :, None] >> lax.iota(jnp.uint32, tiles)) & 1) << lax.iota(jnp.uint32, WORD)[:, None]
    return lax.reduce(bits, jnp.uint32(0), lax.bitwise_or, (1,))


def set_before(members: UInt[Array, "words t"]) -> Int[Array, "words t"]:
    """Set bits in all segments before each: tile after tile, and word after word within a tile."""
    counts = lax.population_count(members).astype(jnp.int32)
    return jnp.cumsum(counts.T.reshape(-1)).reshape(counts.T.shape).T - counts


def read_off(members: UInt[Array, "words t"], before: Int[Array, "words t"], owner: Int[Array, " pairs"]) -> Array:
    """(32 words t,) int32 the owners of the set bits, in the order of `set_before`; anything after the last."""
    words, tiles = members.shape
    bits, starts = members.T.reshape(-1), before.T.reshape(-1)
    total = starts[-1] + lax.population_count(bits[-1]).astype(jnp.int32)
    segments, slots = bits.shape[0], -(-WORD * words * tiles // _SLOTS) * _SLOTS
    filled = bits > 0
    # The filled segments without gaps: bits, first slot, first pair.
    place = jnp.where(filled, jnp.cumsum(filled.astype(jnp.int32)) - 1, segments)
    rows = [lax.bitcast_convert_type(bits, jnp.int32), starts, lax.iota(jnp.int32, segments) % words * WORD]
    table = jnp.zeros((segments + 1, 3), jnp.int32).at[place].set(jnp.stack(rows, -1), mode="promise_in_bounds")
    columns = [table[:, i] for i in range(3)]
    # One bit for each slot where a segment begins, and how many begin before each 32 slots.
    nowhere = slots // WORD
    mark = jnp.uint32(1) << (starts % WORD).astype(jnp.uint32)
    begins = (
        jnp.zeros(nowhere + 1, jnp.uint32)
        .at[jnp.where(filled, starts // WORD, nowhere)]
        .add(mark, mode="promise_in_bounds")[:-1]
    )
    begun = lax.population_count(begins).astype(jnp.int32)
    begun = jnp.cumsum(begun) - begun
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

    def step(carry):
        first, out = carry
        part = lambda a: lax.dynamic_slice(a, (first // WORD,), (_SLOTS // WORD,))
        always = first < total
        segment = stored(always, segment_of, part(begins), part(begun))
        pairs = stored(always, pair_of, first, *stored(always, lambda s: [c[s] for c in columns], segment))
        return first + _SLOTS, lax.dynamic_update_slice(out, owner[pairs], (first,))

    out = lax.while_loop(lambda carry: carry[0] < total, step, (jnp.int32(0), jnp.zeros(slots, jnp.int32)))[1]
    return out[: WORD * words * tiles]
