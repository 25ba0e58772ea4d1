"""What a fit does when."""

import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.fit.schedule import LearningRates, Schedule, rates_at
from jsecon.types import Camera, Gaussians


def test_sizes_follow_each_other():
    schedule = Schedule(sizes=((0.25, 0.2), (0.5, 0.5), (1.0, 1.0)))
    assert [schedule.size(done) for done in (0.0, 0.19, 0.2, 0.49, 0.5, 1.0)] == [0.25, 0.25, 0.5, 0.5, 1.0, 1.0]


def test_the_number_of_gaussians_rises_evenly_and_stops():
    schedule = Schedule(max_gaussians=300, growth_start=0.1, growth_end=0.6)
    assert [schedule.count(done, 100) for done in (0.05, 0.1, 0.35, 0.6, 0.61)] == [None, 100, 200, 300, None]
    assert schedule.count(0.3, 400) is None


def test_degrees_open_one_after_another():
    schedule = Schedule(degree_interval=0.1)
    assert [schedule.degree(done) for done in (0.0, 0.09, 0.11, 0.35)] == [0, 0, 1, 3]


@pytest.mark.parametrize("wrong", [{"sizes": ((0.5, 0.5),)}, {"sizes": ((0.0, 1.0),)}, {"growth_end": 0.01}])
def test_wrong_schedules_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Schedule(**wrong)


def test_rates_decay_log_linearly_and_frozen_positions_stay():
    shape = Gaussians(*(np.zeros((2, *rest), np.float32) for rest in ((3,), (3,), (4,), (), (9, 3))))
    rates = LearningRates(means=1e-2, means_last=1e-4, colors=1.0, rest_last=0.25)
    half = rates_at(jnp.float32(0.5), rates, shape, jnp.float32(3.0), jnp.int32(1))
    assert float(half.means) == pytest.approx(3e-3, rel=1e-5)
    assert float(half.log_scales) == pytest.approx(1e-2, rel=1e-5)
    np.testing.assert_allclose(half.sh[0, :, 0], [0.5] + 3 * [0.025] + 5 * [0.0], rtol=1e-5)
    frozen = rates_at(jnp.float32(0.5), LearningRates(means=0.0), shape, jnp.float32(3.0), jnp.int32(1))
    assert float(frozen.means) == 0


def test_smaller_frames_are_means_seen_by_cameras_as_much_smaller():
    frames = np.random.default_rng(0).integers(0, 256, (2, 24, 32, 3)).astype(np.uint8)
    cameras = Camera(np.tile(np.eye(4), (2, 1, 1)), *(np.full(2, v) for v in (30.0, 31.0, 16.0, 12.0)), 32, 24)
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
