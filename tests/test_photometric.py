"""Losses against slow readable twins and finite differences; and the figures of held-out frames."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cameras_of, capture_of
from jax.test_util import check_grads

from jsecon.fit.photometric import photometric_loss, psnr
from jsecon.fit.quality import measure_quality, ssim_map
from jsecon.pipeline.scene_stages import is_weak
from jsecon.splat.points import gaussians_from_points


def images(shape=(13, 17, 3), seed=0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    return np.clip(target + 0.1 * rng.standard_normal(shape), 0, 1).astype(dtype), target.astype(dtype)


def window():
    weights = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    return np.outer(weights, weights) / np.outer(weights, weights).sum()


def blur_twin(image):
    """The definition: an 11 x 11 weighted sum at every pixel, zeros outside."""
    padded = np.pad(image.astype(np.float64), [(5, 5), (5, 5), (0, 0)])
    result = np.zeros(image.shape)
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            result[i, j] = np.einsum("ab,abc->c", window(), padded[i : i + 11, j : j + 11])
    return result


def ssim_twin(x, y):
    x, y = x.astype(np.float64), y.astype(np.float64)
    mx, my = blur_twin(x), blur_twin(y)
    vx, vy, cov = blur_twin(x * x) - mx**2, blur_twin(y * y) - my**2, blur_twin(x * y) - mx * my
    return (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))


def test_ssim_and_loss_equal_their_definitions_one_image_at_a_time_and_together():
    image, target = images()
    expected = ssim_twin(image, target)
    np.testing.assert_allclose(ssim_map(image, target), expected, atol=2e-4)
    absolute = np.abs(image.astype(np.float64) - target).mean()
    mixture = 0.8 * absolute + 0.2 * (1 - expected.mean())
    assert float(photometric_loss(image, target)) == pytest.approx(mixture, abs=1e-5)
    batch = np.stack([images(seed=s)[0] for s in range(3)])
    together = jax.jit(jax.vmap(photometric_loss, in_axes=(0, None)))(batch, target)
    np.testing.assert_allclose(together, [photometric_loss(b, target) for b in batch], rtol=1e-5)
    with pytest.raises(ValueError, match="target"):
        photometric_loss(image, target[:, 1:])
    with jax.enable_x64(True):
        image, target = images(dtype=np.float64)
        np.testing.assert_allclose(ssim_map(image, target), ssim_twin(image, target), atol=1e-12)
        image, target = (jnp.asarray(a) for a in images((7, 6, 2), dtype=np.float64))
        loss = jax.jit(lambda image: photometric_loss(image, target))
        check_grads(loss, (image,), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_flat_images_have_finite_values_and_gradients(value):
    flat = jnp.full((13, 17, 3), value)
    loss, gradient = jax.value_and_grad(photometric_loss)(flat, flat)
    assert float(loss) == pytest.approx(0, abs=1e-5)
    assert bool(jnp.isfinite(gradient).all())
    assert float(psnr(flat, flat)) == np.inf
    assert float(psnr(flat + 0.1, flat)) == pytest.approx(20, abs=1e-4)


@pytest.mark.parametrize("shape", [(23, 17, 3), (12, 31, 3)])
def test_over_a_mesh_the_loss_and_its_gradient_are_the_same(shape):
    """Odd rows, rows that a device has none of, and halos that reach past the image."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:2]), ("devices",), axis_types=(jax.sharding.AxisType.Auto,))
    image, target = images(shape)
    value, gradient = jax.value_and_grad(photometric_loss)(image, target)
    shared = jax.jit(jax.value_and_grad(lambda x: photometric_loss(x, target, mesh)))(image)
    assert float(shared[0]) == pytest.approx(float(value), rel=1e-6)
    np.testing.assert_allclose(shared[1], gradient, atol=2e-7)


TYPICAL = 25 + np.random.default_rng(0).normal(0, 0.5, 40)


@pytest.mark.parametrize(("figures", "weak"), [
    (TYPICAL, []), ([15, 19, *TYPICAL], [0, 1]), (np.linspace(15, 35, 30), []), ([20.0], []), ([], []),
    ([25.0, 25.5, 24.5, 25.2, 12.0, np.nan], [4]), ([25.0, 25.5, 24.5, 25.2, 12.0, np.inf], [4]), ([np.nan] * 2, []),
])  # fmt: skip
def test_weak_frames_are_far_below_the_others(figures, weak):
    np.testing.assert_array_equal(np.flatnonzero(is_weak(np.asarray(figures, np.float64))), weak)


BEHIND = gaussians_from_points(np.array([[0, 0, -5.0]], np.float32), np.zeros((1, 3), np.uint8))
"""a scene that no camera sees"""


def held_out_capture(frames, **more):
    """Frames of 32x24, all held out."""
    cameras = cameras_of([np.eye(4)] * len(frames), (30, 30, 16, 12), 32, 24)
    return capture_of(frames, cameras, np.ones(len(frames), bool), **more)


def test_large_frames_are_compared_at_the_size_asked():
    """A grey capture seen by no Gaussian: PSNR is that of the frames' own colours, whichever size."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 256, (2, 6, 8, 3), np.uint8)
    large = np.repeat(np.repeat(coarse, 4, axis=1), 4, axis=2)
    capture = held_out_capture(large)
    expected = -10 * np.log10(((coarse / 255.0) ** 2).mean(axis=(1, 2, 3)))
    for long_side in (None, 8, 100):
        found = measure_quality(BEHIND, capture, long_side=long_side)
        np.testing.assert_allclose(found.psnr, expected, atol=1e-4)
    assert not np.allclose(measure_quality(BEHIND, capture, long_side=8).ssim, found.ssim)


def test_pixels_that_are_ignored_do_not_count():
    """What is under the mask has no influence, and the mean is over the rest; a frame without any other is left out."""
    rng = np.random.default_rng(2)
    frames = rng.integers(0, 256, (3, 24, 32, 3), np.uint8)
    ignored = rng.random((3, 24, 32)) < 0.3
    ignored[2] = True
    capture = held_out_capture(frames, ignored=ignored)
    result = measure_quality(BEHIND, capture)
    for t in range(2):
        squares = (frames[t][~ignored[t]] / 255.0) ** 2
        np.testing.assert_allclose(result.psnr[t], -10 * np.log10(squares.mean()), atol=1e-4)
    np.testing.assert_array_equal(result.frames, [0, 1])
    nearly = ignored.copy()
    nearly[1] = True
    nearly[1, 5, 5] = False  # one pixel measures nothing
    few = measure_quality(BEHIND, dataclasses.replace(capture, ignored=nearly))
    np.testing.assert_array_equal(few.frames, [0])
    other = np.where(ignored[..., None], 255 - frames, frames)
    again = measure_quality(BEHIND, dataclasses.replace(capture, frames=other))
    np.testing.assert_array_equal(again.ssim, result.ssim)
