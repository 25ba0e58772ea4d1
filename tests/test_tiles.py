"""Tile lists against a readable loop; capacities; the packed sort."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.splat.project import project
from jsecon.splat.tiles import depth_order, pair_counts, plan_capacity, round_capacity, tile_lists


@pytest.mark.parametrize("tile", [8, 16])
def test_every_tile_lists_what_touches_it_front_to_back(scene, camera, tile):
    splats = project(scene, camera)
    lists = tile_lists(splats, 48, 40, capacity=4096, tile=tile)
    assert int(lists.overflow) == 0
    means, extents, depths = (np.asarray(a) for a in (splats.means_px, splats.extents, splats.depths))
    across, down = -(-48 // tile), -(-40 // tile)
    for ty in range(down):
        for tx in range(across):
            k = ty * across + tx
            got = np.asarray(lists.gaussians[lists.starts[k] : lists.starts[k + 1]])
            low, high = np.array([tx, ty]) * tile, np.array([tx + 1, ty + 1]) * tile
            touching = np.asarray(splats.visible) & ((means + extents > low) & (means - extents < high)).all(1)
            assert set(got) == set(np.flatnonzero(touching))
            assert (np.diff(depths[got]) >= 0).all()
    assert int(pair_counts(splats, 48, 40, tile=tile).sum()) == int(lists.starts[-1])


def test_equal_depths_keep_index_order():
    depths = jnp.asarray(np.random.default_rng(0).integers(1, 50, 40000).astype(np.float32))
    np.testing.assert_array_equal(jax.jit(depth_order)(depths), np.argsort(np.asarray(depths), kind="stable"))
    assert depth_order(depths).dtype == jnp.int32


def test_what_does_not_fit_is_counted(scene, camera):
    splats = project(scene, camera)
    pairs = int(pair_counts(splats, 48, 40).sum())
    lists = tile_lists(splats, 48, 40, capacity=100)
    assert int(lists.overflow) == pairs - 100
    assert int(lists.starts[-1]) == 100


def test_a_plan_fits_every_view_and_leaves_room(scene, cameras):
    capacity = plan_capacity(scene, cameras, margin=1.0)
    most = max(int(pair_counts(project(scene, cameras[t]), 48, 40).sum()) for t in range(4))
    assert most <= capacity
    assert plan_capacity(scene, cameras[0]) <= plan_capacity(scene, cameras, margin=2.0)
    assert round_capacity(0) == 1024
    assert all(p <= round_capacity(p) <= 1.126 * p for p in (1025, 5000, 70001, 3_000_000))
