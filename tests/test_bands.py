"""A view's splats in bands: all that is visible, in order, whatever the blocks that the columns are read in."""

import dataclasses

import jax
import numpy as np
import pytest
from conftest import look_at

from jsecon.splat import bands as module
from jsecon.splat.bands import band_size, bands, block_bounds, may_touch
from jsecon.splat.project import project
from jsecon.splat.tiles import pair_counts
from jsecon.types import Camera, Gaussians


def cloud(count, seed=0, spread=3.0):
    """Gaussians along a curve that fills space more or less, so that blocks are small."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-spread, spread, (count, 3))
    means = means[np.lexsort(np.floor(means).T)]
    sizes = rng.uniform(-5, -1, (count, 3))
    quaternions, logits = rng.normal(size=(count, 4)), rng.uniform(-7, 5, count)
    columns = (means, sizes, quaternions, logits, np.zeros((count, 1, 3)))
    return Gaussians(*(a.astype(np.float32) for a in columns))


def seen_from(centre, target, width=64, height=48, focal=50.0):
    return Camera(look_at(centre, target), *np.float32([focal, focal, width / 2 + 3, height / 2 - 2]), width, height)


CAMERAS = [
    seen_from((0, -1, -8), (0, 0, 0)),
    seen_from((0.3, -0.2, 0.1), (1, 0, 0)),  # inside
    seen_from((0, -1, -8), (0, -3, -20)),  # turned away
    seen_from((40, 0, 0), (0, 10, 0), focal=900.0),  # narrow
    seen_from((0, -1, -8), (0, 0, 0), focal=4.0),  # very wide
]


@pytest.mark.parametrize("n", range(len(CAMERAS)))
@pytest.mark.parametrize("near", [0.01, 4.0])
def test_no_block_with_a_visible_gaussian_is_passed_over(n, near):
    for seed, spread in ((0, 3.0), (1, 0.2), (2, 300.0)):
        scene, camera = cloud(3000, seed, spread), CAMERAS[n]
        visible = np.asarray(project(scene, camera, near=near).visible)
        touching = may_touch(block_bounds(scene, 16), camera, near)
        assert not visible.reshape(-1)[~np.repeat(touching, 16)[: len(visible)]].any()


def test_blocks_aside_and_behind_are_passed_over():
    bounds = block_bounds(cloud(3000), 16)
    assert not may_touch(bounds, CAMERAS[2], 0.01).any()
    assert 0 < may_touch(bounds, CAMERAS[1], 0.01).mean() < 0.8
    assert may_touch(bounds, CAMERAS[3], 0.01).mean() < 0.2


def test_bad_numbers_hide_nothing_of_the_others():
    scene = cloud(64)
    scene.means[3], scene.log_scales[5], scene.means[40] = np.nan, np.nan, np.inf
    camera = CAMERAS[0]
    touching = may_touch(block_bounds(scene, 16), camera, 0.01)
    assert touching[np.flatnonzero(np.asarray(project(scene, camera).visible)) // 16].all()
    assert may_touch(block_bounds(jax.tree.map(lambda a: a * np.float32(np.nan), scene), 16), camera, 0.01).all()


def every_tile(camera):
    return lambda: np.ones((-(-camera.height // 8), -(-camera.width // 8)), bool)


@pytest.mark.parametrize(("rows", "size", "held"), [(16, 64, 1 << 20), (4096, 4096, 1 << 20), (100, 8, 70), (7, 16, 1)])
def test_all_that_is_visible_in_order_of_depth_then_index(rows, size, held):
    scene, camera = cloud(500), CAMERAS[0]
    scene.means[100:200] = scene.means[300:400]  # equal depths
    splats = project(scene, camera)
    visible = np.flatnonzero(np.asarray(splats.visible))
    wanted = visible[np.lexsort((visible, np.asarray(splats.depths)[visible]))]
    found = list(
        bands(scene, block_bounds(scene, rows), camera, every_tile(camera), near=0.01, size=size, most_held=held)
    )
    np.testing.assert_array_equal(np.concatenate([band.ids for band in found]), wanted)
    pairs = np.asarray(pair_counts(splats, camera.width, camera.height))
    for band in found:
        assert len(band.ids) <= size
        assert pairs[band.ids].sum() <= size
        assert band.splats.visible.sum() == len(band.ids)
        for name in ("means_px", "whitening", "opacities", "depths", "extents"):  # programs round differently
            own, other = (np.asarray(getattr(s, name)) for s in (band.splats, splats))
            np.testing.assert_allclose(own[: len(band.ids)], other[band.ids], rtol=1e-4, atol=1e-5)


def test_what_touches_no_open_tile_is_left_out_and_none_open_ends():
    scene, camera = cloud(500), CAMERAS[0]
    splats = project(scene, camera)
    x, reach = np.asarray(splats.means_px)[:, 0], np.asarray(splats.extents)[:, 0]
    left = every_tile(camera)()
    left[:, 2:] = False
    found = list(bands(scene, block_bounds(scene, 50), camera, lambda: left, near=0.01, size=64))
    wanted = np.flatnonzero(np.asarray(splats.visible) & (x - reach < 16))
    np.testing.assert_array_equal(np.sort(np.concatenate([band.ids for band in found])), wanted)
    assert not list(bands(scene, block_bounds(scene, 50), camera, lambda: left & False, near=0.01, size=64))


def test_tiles_that_close_on_the_way_end_the_bands():
    scene, camera = cloud(500), CAMERAS[0]
    tiles, count = every_tile(camera)(), 0
    for band in bands(scene, block_bounds(scene, 50), camera, lambda: tiles, near=0.01, size=16, most_held=64):
        count += len(band.ids)
        tiles[:] = False
    assert 0 < count <= 16


def test_memory_maps_and_no_gaussians(tmp_path):
    scene, camera = cloud(300), CAMERAS[0]
    for own in dataclasses.fields(scene):
        np.save(tmp_path / f"{own.name}.npy", getattr(scene, own.name))
    mapped = Gaussians(*(np.load(tmp_path / f"{own.name}.npy", mmap_mode="r") for own in dataclasses.fields(scene)))
    for a, b in zip(
        *(bands(g, block_bounds(g, 64), camera, every_tile(camera), near=0.01, size=64) for g in (scene, mapped)),
        strict=True,
    ):
        np.testing.assert_array_equal(a.ids, b.ids)
    none = jax.tree.map(lambda a: a[:0], scene)
    assert not list(bands(none, block_bounds(none), camera, every_tile(camera), near=0.01, size=64))


def test_a_band_too_small_for_a_splat_over_the_whole_image():
    scene, camera = cloud(10), CAMERAS[0]
    with pytest.raises(ValueError, match="all blocks of the image"):
        next(bands(scene, block_bounds(scene), camera, every_tile(camera), near=0.01, size=3))
    assert band_size(10, 64, 48) == 4096
    assert band_size(10**8, 64, 48) == module.BAND
    assert band_size(10**8, 64_000, 48_000) >= 2000 * 1500
