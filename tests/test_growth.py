"""Growth of a fit: halves keep what the whole was, and rows stay in place; its rates, and smaller frames."""

import jax
import numpy as np
import pytest
from conftest import cameras_of
from scipy.spatial.transform import Rotation

from jsecon.fit.growth import MIN_OPACITY, _in_use, _split_in_two, grow, pad_with_free_rows
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.splat.capacity import round_capacity


@pytest.fixture
def whole(scene):
    return jax.tree.map(lambda column: column[:30].copy(), scene)


def covariance(gaussians):
    rotation = Rotation.from_quat(gaussians.quaternions, scalar_first=True).as_matrix()
    return np.einsum("nij,nj,nkj->nik", rotation, np.exp(2 * gaussians.log_scales), rotation)


def test_halves_have_the_mean_the_covariance_and_the_alpha_at_the_centre_of_the_whole(whole):
    one, other = _split_in_two(whole)
    np.testing.assert_allclose((one.means + other.means) / 2, whole.means, atol=1e-6)
    offset = (one.means - whole.means)[:, :, None]
    both = covariance(one) + offset @ offset.transpose(0, 2, 1)
    np.testing.assert_allclose(both, covariance(whole), rtol=1e-4, atol=1e-6)
    alpha_one, alpha_other, alpha = (1 / (1 + np.exp(-g.opacity_logits)) for g in (one, other, whole))
    near = np.exp(-((0.6 / 0.8) ** 2) / 2)
    at_centre = 1 - (1 - near * alpha_one) * (1 - near * alpha_other)
    free = alpha_one < alpha - 1e-6  # where it would have to be more opaque than the whole, it is as opaque
    np.testing.assert_allclose(at_centre[free], alpha[free], rtol=1e-4)
    assert free.sum() > 5
    assert (alpha_one <= alpha + 1e-6).all()


@pytest.mark.parametrize("target", [36, 80, 2000])
def test_grown_scenes_have_as_many_as_wanted_and_their_moments_begin_anew(whole, target):
    whole = pad_with_free_rows(whole, 32)
    moments = jax.tree.map(np.ones_like, whole), jax.tree.map(np.ones_like, whole)
    votes = np.where(np.arange(32) < 30, 1.0 + np.arange(32), 7.0).astype(np.float32)
    after, (first, second) = grow(whole, moments, votes, target, 2000, [0, 1])
    added = min(target - 30, 10)  # at most 0.3 of those there are, and one
    assert _in_use(after).sum() == 30 + added
    assert after.count == round_capacity(64)  # both, as few rows as there can be
    fresh = ~first.opacity_logits.astype(bool) & _in_use(after)
    assert fresh.sum() == 2 * added
    assert not second.means[fresh].any()
    assert second.means[_in_use(after) & ~fresh].all()
    untouched = _in_use(after) & ~fresh & (np.arange(after.count) < 30)
    np.testing.assert_array_equal(after.means[untouched], whole.means[: after.count][untouched[:32]])


def test_faint_gaussians_make_room_and_nothing_is_added_where_nothing_is_wrong(whole):
    whole.opacity_logits[:5] = np.log(MIN_OPACITY / 2)
    after, _ = grow(whole, (whole, whole), np.ones(30, np.float32), 30, 30, [0])
    assert after.count == 30
    assert _in_use(after).all()
    whole = pad_with_free_rows(whole, 64)
    after, _ = grow(whole, (whole, whole), np.zeros(64, np.float32), 60, 60, [0])
    jax.tree.map(np.testing.assert_array_equal, after, whole)


def test_smaller_frames_are_means_seen_by_cameras_as_much_smaller():
    frames = np.random.default_rng(0).integers(0, 256, (2, 24, 32, 3)).astype(np.uint8)
    cameras = cameras_of([np.eye(4)] * 2, (30.0, 31.0, 16.0, 12.0), 32, 24)
    half = scale_cameras(cameras, 0.5)
    assert (half.width, half.height) == (16, 12)
    small = resize_frame(frames[1], half)
    np.testing.assert_allclose(small, frames[1].reshape(12, 2, 16, 2, 3).mean(axis=(1, 3)), atol=0.51)
    np.testing.assert_allclose([half.fx[0], half.fy[0], half.cx[0], half.cy[0]], [15, 15.5, 8, 6])
    odd = scale_cameras(cameras, 0.3)
    assert (odd.width, odd.height) == (10, 7)
    assert resize_frame(frames[0], odd).shape == (7, 10, 3)
    np.testing.assert_allclose(odd.cx / odd.width, cameras.cx / 32)  # the same part of the image
    assert np.shares_memory(resize_frame(frames[0], scale_cameras(cameras, 1.0)), frames)
