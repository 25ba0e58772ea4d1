"""Strips of an image: dealt out and joined again, and listed as the whole is."""

import functools

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.splat.capacity import plan_capacity
from jsecon.splat.project import project
from jsecon.splat.strips import BLOCK, FULL_IMAGE, Strip, join_strips, split_into_strips, tile_rows
from jsecon.splat.tiles import pair_counts, tile_grid, tile_lists


@functools.partial(jax.jit, static_argnums=(1, 2))
def there_and_back(image, tile, count):
    strips = split_into_strips(image, tile, count)
    return strips, join_strips(strips, tile, len(image))


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 300), st.integers(1, 4), st.sampled_from([4, 8]))
def test_what_is_split_is_joined_again(height, count, tile):
    image = np.random.default_rng(height).normal(size=(height, 3, 2)).astype(np.float32)
    strips, again = there_and_back(image, tile, count)
    assert strips.shape == (count, tile_rows(height, tile, count) * tile, 3, 2)
    np.testing.assert_array_equal(again, image)


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 5), st.integers(0, 40), st.integers(0, 40))
def test_every_row_of_blocks_is_in_one_strip(count, first, more):
    rows = []
    for k in range(count):
        strip = Strip(k, count)
        own = np.arange(*strip.first_row(np.array([first, first + more])))
        rows += strip.block_row(own).tolist()
        tiles = np.arange(own.size * BLOCK) + (own[0] * BLOCK if own.size else 0)
        assert strip.tile_row(tiles).tolist() == [b * BLOCK + i for b in strip.block_row(own) for i in range(BLOCK)]
    assert sorted(rows) == list(range(first, first + more))


@pytest.mark.parametrize("count", [2, 3])
def test_strips_hold_the_lists_of_the_whole(scene, camera, count):
    splats = project(scene, camera)

    def every(splats, strip):
        return (
            tile_lists(splats, 48, 40, capacity=1024, strip=strip),
            pair_counts(splats, 48, 40, strip=strip).sum(),
        )

    whole, pairs = jax.tree.map(np.asarray, jax.jit(lambda splats: every(splats, FULL_IMAGE))(splats))
    across, down = tile_grid(48, 40, 8)
    lists_of = jax.jit(lambda splats, index: every(splats, Strip(index, count)))
    seen = 0
    for k in range(count):
        strip, (lists, own_pairs) = Strip(k, count), jax.tree.map(np.asarray, lists_of(splats, k))
        assert own_pairs <= pairs
        for own in range(lists.starts.shape[0]):
            row, column = int(strip.tile_row(np.array([own // across]))[0]), own % across
            begin, length = lists.starts[own], lists.lengths[own]
            if row >= down:
                assert length == 0
                continue
            home = row * across + column
            expected = whole.gaussians[whole.starts[home] : whole.starts[home] + whole.lengths[home]]
            np.testing.assert_array_equal(lists.gaussians[begin : begin + length], expected)
            seen += 1
    assert seen == across * down


def test_a_capacity_fits_every_strip(scene, camera):
    counted = jax.jit(
        lambda k, n: pair_counts(project(scene, camera), 48, 40, strip=Strip(k, n)).sum(), static_argnums=1
    )
    for devices in (1, 2, 3):
        each = plan_capacity(scene, camera, margin=1.0, devices=devices) // devices
        for k in range(devices):
            assert int(counted(k, devices)) <= each
