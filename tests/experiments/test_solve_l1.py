"""The L1 solver against float64, in plain and in stiff cases: all of one shape, so that one program serves them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import unit_rows

from experiments.codes.solve_l1 import LOYALTY, solve_l1
from jsecon.splat.reference import render_reference
from jsecon.types import Camera

COUNT, REGIONS, SIZE = 128, 4, 3
CODES = unit_rows(np.random.default_rng(1), REGIONS, SIZE)


@pytest.fixture(scope="module")
def world(scene, cameras):
    """128 Gaussians, the second half of them where no camera looks; two views of 24x20."""
    away = scene.means + np.array([0, 80, 0], np.float32)
    both = jax.tree.map(lambda a: np.concatenate([a, a]), scene)
    both = dataclasses.replace(both, means=np.concatenate([scene.means, away]))
    pinhole = (np.full(2, v, np.float32) for v in (22.0, 21.0, 12.5, 9.5))
    two = Camera(np.asarray(cameras.world_to_camera)[:2], *pinhole, 24, 20)
    return both, two


def labels_at(seed=0):
    """Blocks of regions, and some pixels without."""
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(-1, REGIONS, (2, 5, 6)), np.ones((1, 4, 4))).astype(np.int16)


def case(name, world):
    gaussians, cameras = world
    labels = labels_at()
    if name == "duplicated":
        double = lambda a: np.concatenate([np.asarray(a)[:64]] * 2)
        gaussians = jax.tree.map(double, gaussians)
    elif name == "eight orders of magnitude, one pixel":
        # Sheets hide what is behind them down to T = 1.5e-4; there, faint specks a fraction of a pixel wide.
        axis = np.asarray(cameras.world_to_camera[0], np.float64)
        inverse = np.linalg.inv(axis)
        depth = np.linspace(1.0, 3.0, COUNT)
        local = np.zeros((COUNT, 4))
        local[:, 2], local[:, 3] = depth, 1
        local[3:, 0] = np.random.default_rng(3).uniform(-0.4, 0.4, COUNT - 3) * depth[3:]
        sizes = np.where(np.arange(COUNT) < 3, 20.0, 1e-3)
        opacity = np.concatenate([[0.99, 0.9, 0.85], np.full(COUNT - 3, 0.0045)])
        gaussians = dataclasses.replace(
            gaussians,
            means=(local @ inverse.T)[:, :3].astype(np.float32),
            log_scales=np.log(np.repeat(sizes[:, None], 3, 1)).astype(np.float32),
            opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        )
        labels[1] = -1
    elif name == "one view only":
        labels[1] = -1
    elif name == "views that contradict each other":
        labels = np.stack([labels[0], np.where(labels[1] >= 0, REGIONS - 1 - labels[0] % REGIONS, -1)]).astype(np.int16)
    return gaussians, cameras, labels


CASES = (
    "plain",
    "duplicated",
    "eight orders of magnitude, one pixel",
    "one view only",
    "views that contradict each other",
)


def exact(gaussians, cameras, labels, start, loyalty, steps=4000):
    """(objective function, its minimum, weights (N,)) in float64 by the plain primal-dual method on dense weights."""
    rows, targets = [], []
    for t in range(2):
        onehot = np.eye(COUNT)
        drawn = render_reference(gaussians, jax.tree.map(lambda a, t=t: np.asarray(a)[t], cameras), onehot)
        image = np.asarray(drawn[0] if isinstance(drawn, tuple) else drawn.features, np.float64)
        mask = labels[t] >= 0
        rows.append(image[mask])
        targets.append(CODES[labels[t][mask]])
    weights, target = np.concatenate(rows), np.concatenate(targets).astype(np.float64)
    total, anchor = weights.sum(0), np.asarray(start, np.float64)
    held = loyalty * total[:, None]
    ball = lambda f: f / np.maximum(np.linalg.norm(f, axis=1, keepdims=True), 1)
    value = lambda f: np.abs(weights @ f - target).sum() + 0.5 * (held * (f - anchor) ** 2).sum()
    tau = np.where(total > 0, 1 / np.where(total > 0, total, 1), 0)[:, None] / 3
    codes = lead = anchor
    dual = np.zeros_like(target)
    for _ in range(steps):
        dual = np.clip(dual + 3 * (weights @ lead - target), -1, 1)
        moved = ball((codes - tau * (weights.T @ dual) + tau * held * anchor) / (1 + tau * held))
        lead, codes = 2 * moved - codes, moved
    pull = weights.T @ dual
    best = ball(anchor - pull * np.where(held > 0, 1 / np.where(held > 0, held, 1), 0))
    bound = (pull * best).sum() + 0.5 * (held * (best - anchor) ** 2).sum() - (dual * target).sum()
    return value, (bound, value(codes)), total


@pytest.mark.parametrize("name", CASES)
def test_stiff_cases_reach_the_float64_minimum_or_say_that_they_did_not(world, name):
    gaussians, cameras, labels = case(name, world)
    start = unit_rows(np.random.default_rng(7), COUNT, SIZE)
    if name == "duplicated":
        start[64:] = start[:64]
    found = solve_l1(gaussians, cameras, labels, CODES, start, sweeps=400, tolerance=5e-4, capacity=4096)
    codes = np.asarray(found.codes)
    value, (bound, least), total = exact(gaussians, cameras, labels, start, LOYALTY)
    assert bool(found.converged), float(found.gap)
    assert least - bound < 1e-3 * least  # the reference is itself close enough to judge by
    np.testing.assert_allclose(codes[total == 0], start[total == 0], atol=1e-6)
    assert float(found.loss) * labels.size * SIZE <= value(start)
    # The rendered part alone, before unit length, cannot exceed what the certified objective allows.
    assert float(found.loss) * labels.size * SIZE <= least * (1 + 1e-3)
    if "eight" in name:
        lit = total[total > 0]
        assert lit.max() / lit.min() > 1e8
        assert np.isfinite(codes).all()


def test_too_few_sweeps_are_said_and_a_wrong_call_is_refused(world):
    gaussians, cameras = world
    labels, start = jnp.asarray(labels_at()), unit_rows(np.random.default_rng(7), COUNT, SIZE)
    short = solve_l1(gaussians, cameras, labels, CODES, start, sweeps=1, tolerance=1e-6, capacity=4096)
    assert not bool(short.converged)
    assert int(short.sweeps) == 4
    assert float(short.gap) > 1e-6
    traced = jax.eval_shape(lambda s: solve_l1(gaussians, cameras, labels, CODES, s, capacity=4096), start)
    assert traced.codes.shape == start.shape
    for wrong in ({"labels": labels[:1]}, {"start": start[:5]}, {"loyalty": 0.0}, {"sweeps": 0}):
        given = {"labels": labels, "start": start} | wrong
        with pytest.raises(ValueError, match="solve_l1"):
            solve_l1(gaussians, cameras, given.pop("labels"), CODES, given.pop("start"), **given)


def test_a_strong_loyalty_keeps_the_start(world):
    gaussians, cameras = world
    start = unit_rows(np.random.default_rng(7), COUNT, SIZE)
    found = solve_l1(gaussians, cameras, jnp.asarray(labels_at()), CODES, start, loyalty=1e4, sweeps=1, capacity=4096)
    np.testing.assert_allclose(found.codes, start, atol=1e-3)


def test_regions_without_code_and_missing_labels_ask_for_nothing(world):
    gaussians, cameras = world
    start = unit_rows(np.random.default_rng(7), COUNT, SIZE)
    nothing = solve_l1(gaussians, cameras, jnp.asarray(labels_at()), 0 * CODES, start, sweeps=1, capacity=4096)
    np.testing.assert_allclose(nothing.codes, start, atol=1e-6)
    assert float(nothing.loss) == 0
    assert bool(nothing.converged)
