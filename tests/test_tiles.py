"""Tile lists against a readable loop; capacities; the packed sort."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.splat.capacity import plan_capacity, round_capacity
from jsecon.splat.project import project
from jsecon.splat.reference import project_reference
from jsecon.splat.tiles import (
    _sorted_pairs,
    _sorted_pairs_by_rank,
    depth_order,
    pair_counts,
    tile_grid,
    tile_lists,
)
from jsecon.types import Gaussians


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


@pytest.mark.parametrize("tile", [4, 8])
def test_every_tile_lists_what_reaches_it_front_to_back(scene, cameras, tile):
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
        assert spare < 0.06 * expected.sum()


@jax.jit
def counted(scene, camera):
    return pair_counts(project(scene, camera), camera.width, camera.height).sum()


def needles(count: int, seed: int) -> Gaussians:
    """Aspect 1000 in every orientation, larger than the scene."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        np.log(np.tile(np.float32([2.0, 0.002, 0.002]), (count, 1))),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(-5, 5, count).astype(np.float32),
        np.zeros((count, 4, 3), np.float32),
    )


def test_no_tile_of_a_needle_is_missed(cameras):
    scene = needles(64, 0)  # as many as the other tests have: one compilation
    for t in range(4):
        _, lists = listed(scene, cameras[t], 8)
        for k, touched in enumerate(reaches(scene, cameras[t], 8)):
            got = lists.gaussians[lists.starts[k] : lists.starts[k] + lists.lengths[k]]
            assert set(np.flatnonzero(touched)) <= set(got)


def test_both_sorts_of_pairs_agree():
    rng = np.random.default_rng(0)
    blocks, owner = rng.integers(0, 40, 50_000).astype(np.int32), rng.permutation(50_000).astype(np.int32)
    depths = rng.integers(1, 500, 50_000).astype(np.float32)
    expected = np.lexsort((owner, depths[owner], blocks))
    for got in (
        jax.jit(lambda: _sorted_pairs(blocks, jnp.asarray(owner), jnp.asarray(depths), 40))(),
        jax.jit(lambda: _sorted_pairs_by_rank(blocks, jnp.asarray(owner), jnp.asarray(depths)))(),
    ):
        np.testing.assert_array_equal(got[0], blocks[expected])
        np.testing.assert_array_equal(got[1], owner[expected])


def test_equal_depths_keep_index_order():
    depths = jnp.asarray(np.random.default_rng(0).integers(1, 50, 40000).astype(np.float32))
    np.testing.assert_array_equal(jax.jit(depth_order)(depths), np.argsort(np.asarray(depths), kind="stable"))
    assert depth_order(depths).dtype == jnp.int32


def test_what_does_not_fit_is_counted(scene, camera):
    lists = jax.jit(lambda camera: tile_lists(project(scene, camera), 48, 40, capacity=64))(camera)
    assert int(lists.overflow.sum()) == counted(scene, camera) - 64


def test_a_plan_fits_every_view_and_leaves_room(scene, cameras):
    capacity = plan_capacity(scene, cameras, margin=1.0)
    most = max(counted(scene, cameras[t]) for t in range(4))
    assert most <= capacity
    assert plan_capacity(scene, cameras[0]) <= plan_capacity(scene, cameras, margin=2.0)
    assert round_capacity(0) == round_capacity(4096) == 4096
    assert [round_capacity(p) for p in (4097, 8192, 8193, 16384)] == [8192, 8192, 16384, 16384]
    assert all(p <= round_capacity(p) <= 1.126 * p for p in (16385, 70001, 3_000_000))
    sizes = [round_capacity(p) for p in range(0, 70_000, 37)]
    assert sizes == sorted(sizes)
