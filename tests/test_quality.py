"""Held-out figures, and the frames that a scene does not explain."""

import dataclasses

import numpy as np

from jsecon.fit.quality import is_weak, measure_quality
from jsecon.fit.start import gaussians_from_points
from jsecon.types import Camera, Capture


def test_weak_frames_are_far_below_the_others():
    rng = np.random.default_rng(0)
    psnr = 25 + rng.normal(0, 0.5, 40)
    assert not is_weak(psnr).any()
    psnr[[3, 17]] = 15, 19
    np.testing.assert_array_equal(np.flatnonzero(is_weak(psnr)), [3, 17])


def test_a_capture_of_spread_quality_has_none():
    assert not is_weak(np.linspace(15, 35, 30)).any()
    assert not is_weak(np.array([20.0])).any()
    assert is_weak(np.zeros(0)).shape == (0,)


def test_large_frames_are_compared_at_the_size_asked():
    """A grey capture seen by no Gaussian: PSNR is that of the frames' own colours, whichever size."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 256, (2, 6, 8, 3), np.uint8)
    large = np.repeat(np.repeat(coarse, 4, axis=1), 4, axis=2)
    count, nothing = 2, (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    lens = [np.full(count, v, np.float32) for v in (30, 30, 16, 12)]
    cameras = Camera(np.tile(np.eye(4, dtype=np.float32), (count, 1, 1)), *lens, width=32, height=24)
    capture = Capture(large, cameras, *nothing, np.ones(count, bool), None, np.eye(4), ("a", "b"))
    behind = np.array([[0, 0, -5.0]], np.float32)
    scene = gaussians_from_points(behind, np.zeros((1, 3), np.uint8))
    expected = -10 * np.log10(((coarse / 255.0) ** 2).mean(axis=(1, 2, 3)))
    for long_side in (None, 8, 100):
        found = measure_quality(scene, capture, long_side=long_side)
        np.testing.assert_allclose(found.psnr, expected, atol=1e-4)
    assert not np.allclose(measure_quality(scene, capture, long_side=8).ssim, found.ssim)


def test_pixels_that_are_ignored_do_not_count():
    """What is under the mask has no influence, and the mean is over the rest; a frame without any other is left out."""
    rng = np.random.default_rng(2)
    frames = rng.integers(0, 256, (3, 24, 32, 3), np.uint8)
    lens = [np.full(3, v, np.float32) for v in (30, 30, 16, 12)]
    cameras = Camera(np.tile(np.eye(4, dtype=np.float32), (3, 1, 1)), *lens, width=32, height=24)
    ignored = rng.random((3, 24, 32)) < 0.3
    ignored[2] = True
    points = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    names = "a", "b", "c"
    capture = Capture(frames, cameras, *points, np.ones(3, bool), None, np.eye(4), names, ignored=ignored)
    scene = gaussians_from_points(np.array([[0, 0, -5.0]], np.float32), np.zeros((1, 3), np.uint8))
    result = measure_quality(scene, capture)
    for t in range(2):
        squares = (frames[t][~ignored[t]] / 255.0) ** 2
        np.testing.assert_allclose(result.psnr[t], -10 * np.log10(squares.mean()), atol=1e-4)
    np.testing.assert_array_equal(result.frames, [0, 1])
    other = np.where(ignored[..., None], 255 - frames, frames)
    again = measure_quality(scene, dataclasses.replace(capture, frames=other))
    np.testing.assert_array_equal(again.psnr, result.psnr)
    np.testing.assert_array_equal(again.ssim, result.ssim)
