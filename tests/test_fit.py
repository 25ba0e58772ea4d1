"""The fit: it converges, goes on where it stopped, grows, and never leaves a Gaussian out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cameras_of, capture_of, gaussians_at, look_at

from jsecon import InputError, render, render_rgb
from jsecon.fit import step as one_step
from jsecon.fit.growth import drop_free_rows
from jsecon.fit.optimise import Schedule, _init_fit_state, _view_order, fit_gaussians
from jsecon.fit.quality import measure_quality
from jsecon.fit.step import LearningRates

KEY = jax.random.key(0)
RATES = LearningRates(means=1e-3, means_last=1e-4, log_scales=0.02, colors=0.02, quaternions=0.01)
VIEWS, STEPS = 5, 40
COUNT = 41
"""Gaussians: no multiple of the devices among which their rows are divided"""
MOST = 60
"""Gaussians of the fits that grow, which share their program"""
SCHEDULE = Schedule(max_gaussians=0)
FITTED = {"steps": STEPS, "key": KEY, "schedule": SCHEDULE, "rates": RATES, "chunk": 10}
"""options of the fit that several tests look at"""
WHOLE = Schedule(sizes=((1.0, 1.0),), max_gaussians=0)


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(0)
    means, sizes = rng.uniform(-0.7, 0.7, (COUNT, 3)), rng.uniform(0.1, 0.25, (COUNT, 3))
    turns, logit = rng.normal(size=(COUNT, 4)), rng.uniform(0, 3, COUNT)
    return gaussians_at(means, sizes, turns=turns, logit=logit, sh=rng.uniform(-1.5, 1.5, (COUNT, 1, 3)))


@pytest.fixture(scope="module")
def capture(truth):
    """Photographs of `truth`, 8 bits, the last of the five held out."""
    poses = [look_at((2.2 * np.sin(a), -0.6, -2.2 * np.cos(a))) for a in np.linspace(-0.8, 0.8, VIEWS)]
    cameras = cameras_of(poses, (30, 30, 16, 12), 32, 24)
    images = [render_rgb(truth, jax.tree.map(jnp.asarray, cameras[t])).features for t in range(VIEWS)]
    return capture_of([np.rint(np.clip(image, 0, 1) * 255) for image in images], cameras, np.arange(VIEWS) == 2)


@pytest.fixture(scope="module")
def start(truth):
    rng = np.random.default_rng(1)
    return dataclasses.replace(
        truth,
        means=truth.means + 0.03 * rng.normal(size=truth.means.shape).astype(np.float32),
        log_scales=np.full_like(truth.log_scales, np.log(0.12)),
        quaternions=np.eye(4, dtype=np.float32)[np.zeros(COUNT, int)],
        opacity_logits=np.zeros(COUNT, np.float32),
        sh=np.concatenate([0.5 * truth.sh, np.zeros((COUNT, 3, 3), np.float32)], axis=1),
    )


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_a_fit_brings_the_held_out_view_closer_and_goes_on_from_a_checkpoint_to_the_same_result(capture, start, truth):
    states, seen = [], []
    gaussians, losses = fit_gaussians(capture, start=start, on_checkpoint=states.append, **FITTED)
    before, after = measure_quality(start, capture).psnr, measure_quality(gaussians, capture).psnr
    assert after[0] > before[0] + 4
    assert losses[-8:].mean() < 0.5 * losses[:8].mean()
    assert measure_quality(truth, capture).psnr[0] > 50  # the photographs are 8-bit copies of it
    stopped = jax.tree.map(np.asarray, states[1])
    assert stopped.losses.shape == (20,)
    other = dataclasses.replace(capture, frames=capture.frames.copy())
    other.frames[2] = 255 - other.frames[2]  # held out, so nobody looks at it
    again, others = fit_gaussians(other, start=stopped, progress=lambda *at: seen.append(at), **FITTED)
    assert same(again, gaussians)
    np.testing.assert_array_equal(others, losses)
    assert seen == [(30, 40), (40, 40)]


def test_overflowing_chunks_are_taken_again_with_more_room(capture, start, monkeypatch):
    given = {"steps": 20, "key": KEY, "start": start, "schedule": WHOLE, "rates": RATES, "chunk": 10}
    twin, _ = fit_gaussians(capture, **given)
    widened, enough = [], one_step.enough_capacity

    def counted(capacity, overflow):
        widened.append((capacity, enough(capacity, overflow)))
        return max(usual, widened[-1][1])  # whose program is the twin's

    usual = one_step.default_capacity(start.count, capture.cameras.width, capture.cameras.height, strips=1)
    monkeypatch.setattr(one_step, "default_capacity", lambda count, width, height, strips: 32)
    monkeypatch.setattr(one_step, "enough_capacity", counted)
    gaussians, losses = fit_gaussians(capture, **given)
    assert widened[0][0] == 32 < widened[0][1]
    assert np.isfinite(losses).all()
    for a, b in zip(jax.tree.leaves(gaussians), jax.tree.leaves(twin), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_growing_fit_gains_gaussians_where_the_picture_is_wrong_and_resumes_to_the_same(capture, start):
    """Half of the scene's Gaussians are missing: those that are there are told to multiply."""
    few = jax.tree.map(lambda a: a[:20], start)
    schedule = dataclasses.replace(WHOLE, max_gaussians=MOST)
    given, states = {"steps": STEPS, "key": KEY, "schedule": schedule, "rates": RATES, "chunk": 5}, []
    gaussians, _ = fit_gaussians(capture, start=few, on_checkpoint=states.append, **given)
    counts = [drop_free_rows(state.train.gaussians).count for state in states]
    assert counts == sorted(counts)
    assert 50 <= gaussians.count <= MOST
    assert measure_quality(gaussians, capture).psnr > measure_quality(few, capture).psnr + 2
    again, _ = fit_gaussians(capture, start=jax.tree.map(np.asarray, states[3]), **given)
    assert same(again, gaussians)


def test_the_votes_are_the_weights_on_the_errors(capture, start):
    """Against their definition: the gradient of sum(w e) as a feature's, one view."""
    states = []
    voting = dataclasses.replace(WHOLE, max_gaussians=MOST)
    fit_gaussians(capture, steps=1, key=KEY, start=start, schedule=voting, on_checkpoint=states.append)
    view = np.array([0, 1, 3, 4])[_view_order(KEY, 4, 0, 1)[0]]
    camera, target = capture.cameras[view], capture.frames[view] / np.float32(255)
    error = np.abs(np.asarray(render_rgb(start, camera).features) - target).mean(-1)

    def one(features):
        return jnp.sum(render(start, camera, features).features[..., 0] * error)

    expected = jax.grad(one)(jnp.ones((start.count, 1)))[:, 0]
    np.testing.assert_allclose(states[0].train.votes[: start.count], expected, rtol=1e-3, atol=1e-4)


@pytest.mark.long
def test_a_fit_of_seconds_ends_about_then_and_says_how_far_it_is(capture, start):
    seen = []
    given = {"key": KEY, "start": start, "schedule": WHOLE, "chunk": 5}
    _, losses = fit_gaussians(capture, seconds=1.0, progress=lambda *done: seen.append(done), **given)
    assert len(losses) > 5
    assert seen[-1] == (1, 1)


def test_first_step_is_adams_sign_step_at_the_stated_rates(capture, start):
    """Adam's first update is rate * sign(gradient), whatever the gradient's size: this pins each group's rate."""
    stated = {"means": 1.6e-4, "log_scales": 5e-3, "quaternions": 1e-3, "opacity_logits": 5e-2}
    rates = LearningRates(**stated, colors=2.5e-3, rest_last=1.0)
    centres = np.asarray(capture.cameras.centres)[[0, 1, 3, 4]]
    extent = 1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max()  # as INRIA's
    after, _ = fit_gaussians(capture, steps=1, key=KEY, start=start, rates=rates, schedule=WHOLE)
    moved = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - b).max(), after, start)
    for name, rate in stated.items():
        assert float(getattr(moved, name)) == pytest.approx(rate * (extent if name == "means" else 1), rel=1e-2)
    assert np.abs(after.sh[:, 0] - start.sh[:, 0]).max() == pytest.approx(2.5e-3, rel=1e-2)
    assert not np.asarray(after.sh[:, 1:]).any()  # degree 1 waits for its turn
    half = dataclasses.replace(_init_fit_state(start), done=np.asarray(0.5), losses=np.ones(1, np.float32))
    opened, _ = fit_gaussians(capture, steps=2, key=KEY, start=half, rates=rates, schedule=WHOLE)
    second = (0.1 / (1 - 0.9**2)) / np.sqrt(0.001 / (1 - 0.999**2))  # Adam's second step from moments of zero
    assert np.abs(opened.sh[:, 1:]).max() == pytest.approx(second * 2.5e-3 / 20, rel=1e-2)


def test_wrong_fits_are_refused(capture, start):
    for limits in ({}, {"steps": 1, "seconds": 1.0}, {"steps": 0}, {"seconds": np.nan}, {"seconds": np.inf}):
        with pytest.raises(ValueError, match="steps, seconds: got"):
            fit_gaussians(capture, key=KEY, start=start, **limits)
    with pytest.raises(InputError, match="held out"):
        fit_gaussians(dataclasses.replace(capture, held_out=np.ones(VIEWS, bool)), steps=1, key=KEY, start=start)
    astray = dataclasses.replace(start, means=np.full_like(start.means, np.nan))
    with pytest.raises(InputError, match="not finite"):
        fit_gaussians(capture, **FITTED | {"steps": 1, "start": astray})


@pytest.mark.parametrize("kind", [
    "one view", "black images", "all behind the cameras", "nothing but rotation",
])  # fmt: skip
def test_odd_captures_are_fitted_without_a_number_that_is_none(capture, start, kind):
    poses = np.array(capture.cameras.world_to_camera)
    poses[:, :3, 3] = -np.einsum("tij,j->ti", poses[:, :3, :3], np.array([0, 0, -2.5]))  # one centre for all
    changes = {
        "one view": {"held_out": np.arange(VIEWS) != 1},
        "black images": {"frames": np.zeros_like(capture.frames)},
        "nothing but rotation": {"cameras": dataclasses.replace(capture.cameras, world_to_camera=poses)},
    }
    capture = dataclasses.replace(capture, **changes.get(kind, {}))
    if kind == "all behind the cameras":
        start = dataclasses.replace(start, means=start.means + np.float32([0, 0, -50]))
    schedule = dataclasses.replace(WHOLE, max_gaussians=MOST)
    options = {"steps": 20, "key": KEY, "start": start, "schedule": schedule, "rates": RATES, "chunk": 5}
    gaussians, losses = fit_gaussians(capture, **options)
    assert all(np.isfinite(leaf).all() for leaf in (losses, *jax.tree.leaves(gaussians)))
    if kind in ("one view", "nothing but rotation"):
        assert losses[-4:].mean() < losses[:4].mean()
    if kind == "all behind the cameras":  # nobody sees them: nothing to learn, nothing to add
        np.testing.assert_array_equal(gaussians.means, start.means)
