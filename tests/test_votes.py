"""Votes against the float64 twin's weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon import plan_view
from jsecon.association.superpixels import superpixel_votes
from jsecon.field.votes import region_votes, votes_memory
from jsecon.splat.reference import weights_reference

REGIONS = 11


@pytest.fixture(scope="module")
def labels(cameras):
    """Four label images: blocks, one of them noise (many regions in a tile), one with nothing labelled."""
    rng = np.random.default_rng(5)
    blocks = rng.integers(-1, REGIONS, (4, 5, 6)).repeat(8, 1).repeat(8, 2).astype(np.int32)
    blocks[1] = rng.integers(-1, REGIONS, (40, 48))
    blocks[3] = -1
    return blocks


@pytest.fixture(scope="module")
def expected(scene, cameras, labels):
    """(N, R) votes, (T, N) totals, (N,) peak, (N,) views by brute force in float64."""
    votes, total = np.zeros((scene.count, REGIONS)), np.zeros((4, scene.count))
    peak, views = np.zeros(scene.count), np.zeros(scene.count, int)
    for t in range(4):
        weights = weights_reference(scene, cameras[t]).reshape(-1, scene.count)
        for r in range(REGIONS):
            votes[:, r] += weights[labels[t].reshape(-1) == r].sum(0)
        total[t] = weights.sum(0)
        peak = np.maximum(peak, weights.max(0))
        views += weights.sum(0) > 0
    return votes, total, peak, views


@pytest.fixture(scope="module")
def cast(scene, cameras, labels):
    return region_votes(scene, cameras, labels, REGIONS, top=REGIONS, by_view=True)


def test_equals_the_oracles_weights(cast, expected):
    votes, total, peak, views = expected
    assert int(cast.overflow) == 0
    # float32, and alphas that fall on the other side of the 1/255 cut on single pixels
    np.testing.assert_allclose(cast.dense(), votes, rtol=2e-4, atol=0.02)
    assert np.linalg.norm(cast.dense() - votes) <= 1e-4 * np.linalg.norm(votes)
    np.testing.assert_allclose(cast.by_view, total, rtol=2e-4, atol=0.02)
    np.testing.assert_allclose(cast.total, total.sum(0), rtol=2e-4, atol=0.02)
    np.testing.assert_allclose(cast.max_pixel_weight, peak, atol=1e-4)
    np.testing.assert_array_equal(cast.views, views)


@pytest.mark.parametrize("share", [0.4, pytest.param(1.0, marks=pytest.mark.long)])
def test_at_the_centre_they_are_the_weights_of_that_pixel(scene, cameras, labels, cast, share):
    found = region_votes(scene, cameras, labels, REGIONS, top=REGIONS, by_view=True, centre=share)
    votes, total = np.zeros((scene.count, REGIONS)), np.zeros((4, scene.count))
    for t in range(4):
        weights, splats = weights_reference(scene, cameras[t]), np.asarray(plan_view(scene, cameras[t]).splats)
        height, width, _ = weights.shape
        for n, (x, y) in enumerate(np.floor(splats[:, :2]).astype(int)):
            if splats[n, 5] > 0 and 0 <= x < width and 0 <= y < height:
                total[t, n] = weights[y, x, n]
                if labels[t, y, x] >= 0:
                    votes[n, labels[t, y, x]] += weights[y, x, n]
    mixed = (1 - share) * np.asarray(cast.dense()) + share * votes
    np.testing.assert_allclose(found.dense(), mixed, rtol=2e-4, atol=0.01)
    np.testing.assert_allclose(found.by_view, (1 - share) * cast.by_view + share * total, rtol=2e-4, atol=0.01)
    assert votes.max() > 0.1


@pytest.mark.parametrize("t", [1, *(pytest.param(t, marks=pytest.mark.long) for t in (0, 2))])
def test_votes_on_atoms_are_those_of_the_view(scene, cameras, labels, expected, t):
    """Also where a tile shows more atoms than one walk counts (the noise of view 1)."""
    camera, atoms = cameras[t], labels[t] + 1
    got = superpixel_votes(scene, camera, atoms, negligible=0.0).toarray()
    same = region_votes(scene, cameras[t : t + 1], atoms[None], REGIONS + 1, top=REGIONS + 1)
    np.testing.assert_allclose(got, same.dense(), rtol=1e-5, atol=1e-6)
    few = superpixel_votes(scene, camera, atoms, negligible=0.3).toarray()
    np.testing.assert_array_equal(few, np.where(got > 0.3 * got.sum(1, keepdims=True), got, 0.0))
    middle = superpixel_votes(scene, camera, atoms, negligible=0.0, centre=1.0).toarray()
    at_centre = region_votes(scene, cameras[t : t + 1], atoms[None], REGIONS + 1, top=REGIONS + 1, centre=1.0)
    np.testing.assert_allclose(middle, at_centre.dense(), rtol=1e-5, atol=1e-6)
    assert (middle > 0).sum(1).max() == 1


def test_strongest_first_and_what_is_cut_is_counted(cast, scene, cameras, labels):
    few = region_votes(scene, cameras, labels, REGIONS, top=2)
    assert few.regions.shape == (scene.count, 2)
    assert few.by_view is None
    np.testing.assert_allclose(few.weights, cast.weights[:, :2], rtol=1e-6)
    np.testing.assert_allclose(few.weight_beyond_top_k, cast.weights[:, 2:].sum(-1), rtol=1e-4, atol=1e-4)
    assert bool((cast.weights[:, :-1] >= cast.weights[:, 1:]).all())
    np.testing.assert_array_equal(cast.regions >= 0, cast.weights > 0)


def test_what_they_take_is_told_beforehand(monkeypatch):
    count, regions, dense = 1000, 50, 4 * 1000 * 50
    for devices, lanes in ((1, 1), (2, 2), (6, 4), (16, 8)):
        local = jax.local_devices()[:1] * devices
        monkeypatch.setattr(jax, "devices", lambda local=local: local)
        assert votes_memory(count, 100, regions) == (4 * 100 + 56) * count + (lanes + 1) * dense
    # a block of 1 GiB in each of two lanes, and one of their sum
    assert votes_memory(1 << 22, 100, 100) == (4 * 100 + 56) * (1 << 22) + 3 * (1 << 30)


def test_regions_in_blocks_are_the_same_votes(monkeypatch, cast, scene, cameras, labels):
    from jsecon.field import votes as module

    monkeypatch.setattr(module, "DENSE_BYTES", 4 * 4 * scene.count)  # four regions a pass
    blocks = region_votes(scene, cameras, labels, REGIONS, top=REGIONS)
    np.testing.assert_allclose(blocks.dense(), cast.dense(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(blocks.labelled, cast.labelled, rtol=1e-5)
    np.testing.assert_allclose(blocks.total, cast.total, rtol=1e-6)


def test_what_nobody_sees_has_no_votes_and_views_are_counted(scene, cameras, labels):
    hidden = jax.tree.map(np.copy, scene)
    hidden.means[0] = [0, -1e4, 0]  # far above every view
    seen = []
    cast = region_votes(hidden, cameras, labels, REGIONS, progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (4, 4)
    assert sorted(seen) == seen
    assert int(cast.views[0]) == 0
    assert float(cast.total[0]) == 0
    assert bool((cast.regions[0] == -1).all())


def test_no_regions_at_all(scene, cameras):
    cast = region_votes(scene, cameras, np.full((4, 40, 48), -1, np.int32), 0)
    assert cast.dense().shape == (scene.count, 0)
    assert bool((cast.regions == -1).all())
    assert float(cast.total.sum()) > 0


def test_shapes_that_disagree_raise(scene, cameras, camera, labels):
    with pytest.raises(ValueError, match="leading axis"):
        region_votes(scene, camera, labels, REGIONS)
    with pytest.raises(ValueError, match="labels"):
        region_votes(scene, cameras, labels[:2], REGIONS)


def test_votes_are_the_transpose_of_rendering(cast, scene, cameras, labels):
    """<W f, onehot> = <f, W^T onehot> for any f: here with f = 1 a region's votes are its rendered weight."""
    assert abs(float(cast.labelled.sum()) - float(jnp.sum(cast.dense()))) < 1e-2
