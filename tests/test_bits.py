"""Lists read off bits, against a loop over every bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.splat.tiles import WORD, compact_tile_lists, tile_bits


@pytest.mark.parametrize(("words", "density"), [(1, 0.5), (7, 0.0), (7, 1.0), (40, 0.03), (2500, 0.25)])
@pytest.mark.parametrize("filled", [1.0, 0.4])
def test_lists_are_those_of_a_loop(words, density, filled):
    rng = np.random.default_rng(words)
    bits = rng.random((words * WORD, 16)) < density
    bits[rng.random(words * WORD) < 0.2] = False
    total = int(filled * words * WORD)
    bits[total:] = False
    reached = (bits.astype(np.uint32) << np.arange(16, dtype=np.uint32)).sum(1).astype(np.uint32)
    owner = rng.permutation(words * WORD).astype(np.int32)

    @jax.jit
    def lists(reached, owner, total):
        members, before = tile_bits(lambda owner, reached: reached, owner, reached, 16, total, WORD)
        return members, before, compact_tile_lists(members, before, owner, total, WORD)

    members, before, got = lists(jnp.asarray(reached), jnp.asarray(owner), jnp.int32(total))
    expected = np.concatenate([owner[bits[:, tile]] for tile in range(16)])
    np.testing.assert_array_equal(got[: len(expected)], expected)
    assert got.shape == (16 * words * WORD,)
    counted = np.concatenate([[0], bits.T.reshape(16, words, WORD).sum(2).reshape(-1).cumsum()[:-1]])
    np.testing.assert_array_equal(np.asarray(before).T.reshape(-1), counted)
    assert int(np.bitwise_count(np.asarray(members)).sum()) == bits.sum()
