"""Poses and exposures put right within a fit: the maths, recovery of what is known, and captures that are hard."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cameras_of, capture_of, look_at
from scipy.linalg import expm
from test_fit import COUNT, same, truth as truth  # a fixture

from jsecon import render
from jsecon.fit.corrections import CorrectionRates, Corrections, se3_exp
from jsecon.fit.optimise import Schedule, fit_gaussians
from jsecon.fit.quality import measure_quality
from jsecon.fit.step import LearningRates, _TrainingViews, _view_loss, apply_exposure, corrected_camera
from jsecon.poses import refine
from jsecon.poses.refine import refine_capture

KEY, VIEWS = jax.random.key(0), 6
FROZEN = LearningRates(means=0.0, means_last=0.0, log_scales=0.0, quaternions=0.0, opacity_logits=0.0, colors=0.0)
WHOLE = Schedule(sizes=((1.0, 1.0),), max_gaussians=0)
GIVEN = {"key": KEY, "schedule": WHOLE, "chunk": 10}


@pytest.fixture(autouse=True)
def _quick(monkeypatch, truth):
    """A program less to compile, a third of the steps that align a held-out frame, and a start for few views."""
    monkeypatch.setattr(refine, "FINE_SIZE", 1.0)
    monkeypatch.setattr(refine, "ALIGN_VISITS", 40)
    monkeypatch.setattr(refine, "starting_gaussians", lambda capture, **_: (truth, ""))


@pytest.fixture(scope="module")
def capture(truth):
    """`truth` with depth, the third frame held out; no pixel is ignored, so that all fits share programs with the one
    that ignores some."""
    poses = [look_at((2.2 * np.sin(a), -0.6, -2.2 * np.cos(a))) for a in np.linspace(-0.8, 0.8, VIEWS)]
    cameras = cameras_of(poses, (30, 30, 16, 12), 32, 24)
    colours = np.maximum(0.5 + 0.28209479 * truth.sh[:, 0], 0)
    views = [render(truth, jax.tree.map(jnp.asarray, cameras[t]), colours, depth=True) for t in range(VIEWS)]
    frames = np.stack([np.rint(np.clip(view.features, 0, 1) * 255).astype(np.uint8) for view in views])
    depths = np.stack([np.where(view.alpha > 0.5, view.depth, 0) for view in views]).astype(np.float32)
    return capture_of(frames, cameras, np.arange(VIEWS) == 2, depths, ignored=np.zeros(frames.shape[:3], bool))


def rough(capture, *, twists, gains):
    """The capture as told wrongly."""
    poses = np.stack([hat_exp(-t) @ pose for t, pose in zip(twists, capture.cameras.world_to_camera)])
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses.astype(np.float32))
    frames = np.clip(np.rint(capture.frames * np.asarray(gains)[:, None, None, None]), 0, 255).astype(np.uint8)
    return dataclasses.replace(capture, cameras=cameras, frames=frames)


def hat_exp(twist):
    """scipy's exponential of a twist."""
    x, y, z, a, b, c = np.asarray(twist, np.float64)
    return expm(np.array([[0, -z, y, a], [z, 0, -x, b], [-y, x, 0, c], [0, 0, 0, 0]]))


def errors(seed=4):
    """Twists and gains of a rough capture."""
    rng = np.random.default_rng(seed)
    twists = np.concatenate([0.009 * rng.normal(size=(VIEWS, 3)), 0.02 * rng.normal(size=(VIEWS, 3))], axis=1)
    return {"twists": twists, "gains": rng.uniform(0.8, 1.0, VIEWS)}


def test_exponential_is_scipys(x64):
    rng = np.random.default_rng(1)
    one = jax.jit(se3_exp)
    for angle in (0.0, 1e-30, 1e-9, 1e-4, 0.5, 1.0, 3.0):
        twist = rng.normal(size=6)
        twist[:3] *= angle / np.linalg.norm(twist[:3])
        np.testing.assert_allclose(one(twist), hat_exp(twist), rtol=1e-12, atol=1e-12)
        single = one(twist.astype(np.float32))
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, hat_exp(twist.astype(np.float32)), rtol=1e-5, atol=2e-6)


def test_exponential_is_smooth_everywhere_and_at_rest_nothing_changes(capture, x64):
    slope = jax.jit(jax.jacfwd(se3_exp))
    back = jax.jit(jax.jacrev(se3_exp))
    for twist in (np.zeros(6), np.array([1e-20, 0, 0, 1, 2, 3]), np.array([0.6, -0.6, 0.529, 1, 2, 3]), np.ones(6)):
        by = np.stack([(hat_exp(twist + h) - hat_exp(twist - h)) / 2e-6 for h in 1e-6 * np.eye(6)], axis=-1)
        np.testing.assert_allclose(slope(twist), by, atol=1e-8)
        np.testing.assert_allclose(back(twist), by, atol=1e-8)
    assert same(corrected_camera(capture.cameras[0], jnp.zeros(6, jnp.float32)), capture.cameras[0])
    image = jnp.asarray(capture.frames[0], jnp.float32)
    np.testing.assert_array_equal(apply_exposure(image, jnp.eye(3, 4, dtype=jnp.float32)), image)


def test_gradients_through_the_whole_step_are_central_differences(capture, truth, x64):
    """Photometric loss, depth, pose, exposure and scene, in float64. (What is ignored is a constant to the gradient and
    has its own test.)"""
    rng = np.random.default_rng(2)
    views = _TrainingViews(dataclasses.replace(capture, held_out=np.arange(VIEWS) != 1))

    def double(a):
        return jnp.asarray(a, jnp.float64) if np.asarray(a).dtype == np.float32 else jnp.asarray(a)

    view = jax.tree.map(double, views[0])
    scene = jax.tree.map(lambda a: double(a) + 0.02 * rng.normal(size=a.shape), truth)
    own = Corrections(double(0.02 * rng.normal(size=6)), np.eye(3, 4) + 0.05 * rng.normal(size=(3, 4)))
    nothing, extent = jnp.zeros((COUNT, 1)), jnp.float64(1.7)

    def loss(scene, own):
        return _view_loss(scene, nothing, own, view, extent, 4096)[0]

    both = jax.jit(jax.value_and_grad(loss, (0, 1)))
    gradient = both(scene, own)[1]
    leaves, tree = jax.tree.flatten((scene, own))
    for n, (leaf, slope) in enumerate(zip(leaves, jax.tree.leaves(gradient), strict=True)):
        direction = rng.normal(size=leaf.shape)

        def moved(h):
            return both(*tree.unflatten([*leaves[:n], leaf + h * direction, *leaves[n + 1 :]]))[0]  # noqa: B023

        by = [float(moved(h) - moved(-h)) / (2 * h) for h in (1e-6, 3e-7)]
        exact = float((slope * direction).sum())
        assert min(abs(value - exact) for value in by) <= 1e-5 * abs(exact), (n, by, exact)


def test_what_not_to_fit_has_no_part_in_the_fit(capture, truth):
    ignored = np.zeros(capture.frames.shape[:3], bool)
    ignored[:, 5:15, 8:20] = True
    frames = np.where(ignored[..., None], 255 - capture.frames, capture.frames)
    one, other = (dataclasses.replace(capture, ignored=ignored, frames=f) for f in (capture.frames, frames))
    given = GIVEN | {"start": truth, "steps": 10, "refine": CorrectionRates()}
    (a, losses), (b, again) = (fit_gaussians(c, **given) for c in (one, other))
    assert same(a, b)
    np.testing.assert_array_equal(losses, again)


def test_a_known_twist_and_gain_are_found(capture, truth):
    """The scene is known: each frame's correction is its own problem."""
    wrong, states = errors(3), []
    told = rough(capture, **wrong)
    given = GIVEN | {"rates": FROZEN, "refine": CorrectionRates(pose=2e-3), "on_checkpoint": states.append}
    fit_gaussians(told, start=truth, steps=40 * 5, **given)
    found, pixels = jax.tree.map(np.asarray, states[-1].train.corrections.current), []
    put_right = np.stack([hat_exp(twist) for twist in found.twists]) @ told.cameras.world_to_camera
    for poses in (capture.cameras.world_to_camera, put_right):
        x, y, z = np.moveaxis(truth.means @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3], -1, 0)
        pixels.append(30 * np.stack([x / z, y / z]))
    train = ~capture.held_out
    assert not found.twists[2].any()
    assert np.median(np.abs(pixels[1] - pixels[0])[:, train]) < 0.05
    assert np.abs(pixels[1] - pixels[0])[:, train].max() < 0.3
    np.testing.assert_allclose(found.colours[train, :, :3], wrong["gains"][train, None, None] * np.eye(3), atol=0.05)


def test_a_rough_capture_is_corrected_and_its_held_out_frames_have_no_part_in_it(capture, truth):
    told = rough(capture, **errors())
    given = {"key": KEY, "visits": 15, "probes": 2}
    better = refine_capture(told, **given)
    assert "poses refined by" in better.notes[0]
    assert same(better.cameras.fx, told.cameras.fx)
    assert measure_quality(truth, better).psnr[0] > measure_quality(truth, told).psnr[0] + 2.5
    frames = told.frames.copy()
    frames[2] = 255 - frames[2]
    other = refine_capture(dataclasses.replace(told, frames=frames), **given)
    train = ~told.held_out
    assert same(other.cameras[train], better.cameras[train])
    assert same(other.frames[train], better.frames[train])


def test_with_a_limit_exact_captures_and_those_without_depth_stay_as_they_are_bit_by_bit(capture):
    for which in (capture, dataclasses.replace(rough(capture, **errors()), depths=None)):
        kept = refine_capture(which, key=KEY, max_fit_steps=1e9)
        assert "stay as they are" in kept.notes[-1]
        assert same(dataclasses.replace(kept, notes=()), which)


@pytest.mark.parametrize("rate", [pytest.param(0.1, marks=pytest.mark.long), 10.0])
def test_a_frame_ten_times_as_bright_or_dark_leaves_finite_numbers(capture, truth, rate):
    told = rough(capture, twists=np.zeros((VIEWS, 6)), gains=np.where(np.arange(VIEWS) == 3, rate, 1.0))
    depths = np.where(np.arange(32) < 9, np.nan, capture.depths).astype(np.float32)
    better = refine_capture(dataclasses.replace(told, depths=depths), key=KEY, visits=8, probes=1)
    assert np.isfinite(better.cameras.world_to_camera).all()
    found, losses = fit_gaussians(better, start=truth, steps=10, refine=CorrectionRates(), **GIVEN)
    assert all(np.isfinite(leaf).all() for leaf in (losses, *jax.tree.leaves(found)))


def test_depths_and_masks_are_made_smaller_without_mixing(capture):
    slope = np.add.outer(0.03 * np.arange(24), 0.02 * np.arange(32)) + 2
    slope[:, 15:] += 3  # a step within a pixel of the smaller frame
    slope[4, 4] = 0
    ignored = np.zeros(capture.frames.shape[:3], bool)
    ignored[:, 5, 7] = True
    depths = np.tile(slope.astype(np.float32), (VIEWS, 1, 1))
    views = _TrainingViews(dataclasses.replace(capture, ignored=ignored, depths=depths), 0.5)
    depth = views[0].depth
    assert depth.shape == views[0].ignored.shape == views[0].frame.shape[:2] == (12, 16)
    mean = slope.reshape(12, 2, 16, 2).mean(axis=(1, 3))
    unknown = np.zeros((12, 16), bool)
    unknown[:, 7] = unknown[2, 2] = True
    np.testing.assert_allclose(depth, np.where(unknown, 0, mean), rtol=1e-6)
    assert views[0].ignored.sum() == 1
    assert views[0] is views[0]  # made smaller once, and not at every step
