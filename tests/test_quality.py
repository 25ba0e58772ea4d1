"""Held-out figures, and the frames that a scene does not explain."""

import numpy as np

from jsecon.fit.quality import weak


def test_weak_frames_are_far_below_the_others():
    rng = np.random.default_rng(0)
    psnr = 25 + rng.normal(0, 0.5, 40)
    assert not weak(psnr).any()
    psnr[[3, 17]] = 15, 19
    np.testing.assert_array_equal(np.flatnonzero(weak(psnr)), [3, 17])


def test_a_capture_of_spread_quality_has_none():
    assert not weak(np.linspace(15, 35, 30)).any()
    assert not weak(np.array([20.0])).any()
    assert weak(np.zeros(0)).shape == (0,)
