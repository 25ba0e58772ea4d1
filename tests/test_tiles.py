"""Tile lists against a readable loop, read off bits against a loop over every bit, and of strips as of the whole image;
capacities; the packed sort."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import gaussians_at
from reference import project_reference

from jsecon import Gaussians, project
from jsecon.splat.capacity import plan_capacity, round_capacity
from jsecon.splat.strips import FULL_IMAGE, Strip
from jsecon.splat.tiles import (
    WORD,
    _compact_tile_lists,
    _sorted_pairs,
    _tile_bits,
    pair_counts,
    tile_grid,
    tile_lists,
)


def reaches(scene, camera, tile: int) -> np.ndarray:
    """(tiles, N) bool: alpha >= 1/255 at some pixel centre of the tile, in float64, by brute force."""
    splats = project_reference(scene, camera)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    across, down = tile_grid(camera.width, camera.height, tile)
    home = (y // tile * across + x // tile).astype(int)
    out = np.zeros((across * down, scene.count), bool)
    for n in np.flatnonzero(splats["in_front"]):
        offset = np.stack([x, y], -1) - splats["means_px"][n]
        distance = (offset @ np.linalg.inv(splats["covariances"][n]) * offset).sum(-1)
        out[home[splats["opacities"][n] * np.exp(-0.5 * distance) >= 1 / 255], n] = True
    return out


@functools.partial(jax.jit, static_argnums=2)
def _listed(scene, camera, tile: int):
    splats = project(scene, camera)
    return splats, tile_lists(splats, camera.width, camera.height, capacity=1024, tile=tile)


def listed(scene, camera, tile: int):
    """Projection and lists of a view as NumPy arrays: slices of jax's would compile anew for each length."""
    return jax.tree.map(np.asarray, _listed(scene, camera, tile))


def needles(count: int, seed: int) -> Gaussians:
    """Aspect 1000 in every orientation, larger than the scene."""
    rng = np.random.default_rng(seed)
    means, turns = rng.uniform(-1, 1, (count, 3)), rng.normal(size=(count, 4))
    return gaussians_at(means, (2, 0.002, 0.002), turns=turns, logit=rng.uniform(-5, 5, count), sh=np.zeros((4, 3)))


@pytest.mark.parametrize(("kind", "tile"), [("blobs", 4), ("blobs", 8), ("needles", 8)])
def test_every_tile_lists_what_reaches_it_front_to_back(scene, cameras, kind, tile):
    scene = needles(64, 0) if kind == "needles" else scene  # of one size: one compilation
    for t in range(4):
        splats, lists = listed(scene, cameras[t], tile)
        assert int(lists.overflow.sum()) == 0
        depths, expected = splats.depths, reaches(scene, cameras[t], tile)
        assert expected.shape[0] == lists.starts.shape[0]
        spare = 0
        for k, touched in enumerate(expected):
            got = lists.gaussians[lists.starts[k] : lists.starts[k] + lists.lengths[k]]
            assert len(set(got)) == len(got)
            assert (np.diff(depths[got]) >= 0).all()
            assert set(np.flatnonzero(touched)) <= set(got)
            spare += len(got) - touched.sum()
        # Tight: what a list holds in vain is an ellipse that passes between pixel centres.
        assert spare < 0.06 * expected.sum() or kind == "needles"


@jax.jit
def counted(scene, camera):
    return pair_counts(project(scene, camera), camera.width, camera.height).sum()


@pytest.mark.parametrize("devices", [1, 3])
def test_a_planned_capacity_fits_every_view_and_every_strip(scene, cameras, devices):
    counted = jax.jit(lambda camera, k: pair_counts(project(scene, camera), 48, 40, strip=Strip(k, devices)).sum())
    each = plan_capacity(scene, cameras, margin=1.0, devices=devices) // devices
    assert max(int(counted(cameras[t], k)) for t in range(4) for k in range(devices)) <= each
    assert [round_capacity(p) for p in (0, 4096, 4097, 8192, 8193)] == [4096, 4096, 8192, 8192, 16384]
    assert all(p <= round_capacity(p) <= 1.126 * p for p in (16385, 70001, 3_000_000))


def test_both_sorts_of_pairs_agree():
    rng = np.random.default_rng(0)
    blocks, owner = rng.integers(0, 40, 50_000).astype(np.int32), rng.permutation(50_000).astype(np.int32)
    depths = rng.integers(1, 500, 50_000).astype(np.float32)
    expected = np.lexsort((owner, depths[owner], blocks))
    for number in (40, 1 << 20):  # the second is too large for a single key
        got = jax.jit(lambda number=number: _sorted_pairs(blocks, jnp.asarray(owner), jnp.asarray(depths), number))()
        np.testing.assert_array_equal(got[0], blocks[expected])
        np.testing.assert_array_equal(got[1], owner[expected])


def test_what_does_not_fit_is_counted(scene, camera):
    lists = jax.jit(lambda camera: tile_lists(project(scene, camera), 48, 40, capacity=64))(camera)
    assert int(lists.overflow.sum()) == counted(scene, camera) - 64


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
        members, before = _tile_bits(lambda owner, reached: reached, owner, reached, 16, total, WORD)
        return members, before, _compact_tile_lists(members, before, owner, total, WORD)

    members, before, got = lists(jnp.asarray(reached), jnp.asarray(owner), jnp.int32(total))
    expected = np.concatenate([owner[bits[:, tile]] for tile in range(16)])
    np.testing.assert_array_equal(got[: len(expected)], expected)
    assert got.shape == (16 * words * WORD,)
    counted = np.concatenate([[0], bits.T.reshape(16, words, WORD).sum(2).reshape(-1).cumsum()[:-1]])
    np.testing.assert_array_equal(np.asarray(before).T.reshape(-1), counted)
    assert int(np.bitwise_count(np.asarray(members)).sum()) == bits.sum()


@pytest.mark.parametrize("count", [2, 3])
def test_strips_hold_the_lists_of_the_whole(scene, camera, count):
    splats = project(scene, camera)

    def every(splats, strip):
        return (tile_lists(splats, 48, 40, capacity=1024, strip=strip), pair_counts(splats, 48, 40, strip=strip).sum())

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
