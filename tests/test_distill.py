"""Reductions of votes against NumPy float64, and the paper's L1 path against its definition written densely."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY
from jax.test_util import check_grads
from reference import weights_reference
from small_field import REGIONS, labels_of, true_regions, unit_rows, votes_of

from jsecon import distill_l1, distill_votes, plan_capacity, plan_view
from jsecon.paper.distill import rendered_l1

KEY = jax.random.key(0)


def random_votes(rng, count, top, num_regions):
    regions = np.stack([rng.permutation(num_regions)[:top] for _ in range(count)])
    weights = -np.sort(-rng.exponential(size=(count, top)) * 10.0 ** rng.uniform(-4, 4, (count, 1)), axis=1)
    gone = rng.random((count, 1)) < 0.1
    empty = gone | (np.arange(top) >= rng.integers(1, top + 1, (count, 1)))
    return votes_of(np.where(empty, -1, regions), np.where(empty, 0, weights), num_regions)


def exact(votes, codes, reduce):
    """The reductions as one would write them for one Gaussian, float64."""
    codes, result = np.asarray(codes, np.float64), []
    for ids, weights in zip(votes.regions, np.asarray(votes.weights, np.float64)):
        ids, weights = ids[ids >= 0], weights[ids >= 0]
        if not len(ids):
            result.append(np.zeros(codes.shape[1]))
            continue
        values, strongest = codes[ids], codes[ids[np.argmax(weights)]]
        if reduce == "mean":
            code = (weights[:, None] * values).sum(0) / weights.sum()
        elif reduce == "mode":
            code = strongest
        else:
            code = np.empty(codes.shape[1])
            for axis in range(codes.shape[1]):
                order = np.argsort(values[:, axis], kind="stable")
                summed = np.cumsum(weights[order])
                low = values[order, axis][np.searchsorted(summed, summed[-1] / 2 * (1 - 1e-9))]
                high = values[order, axis][np.searchsorted(summed, summed[-1] / 2 * (1 + 1e-9))]
                code[axis] = np.clip(strongest[axis], low, high)
        result.append(code / np.linalg.norm(code))
    return np.array(result)


@pytest.mark.parametrize("count", [9_000, MANY])
@pytest.mark.parametrize("reduce", ["mean", "median", "mode"])
def test_reductions_equal_float64(reduce, count):
    rng = np.random.default_rng(0)
    few, tables, rows = random_votes(rng, 1000, 6, 20), unit_rows(rng, 40, 4).reshape(2, 20, 4), np.arange(count) % 1000
    votes = jax.tree.map(lambda a: a[rows] if np.ndim(a) else a, few)
    got = jax.jit(jax.vmap(lambda table, votes: distill_votes(votes, table, reduce), (0, None)))(tables, votes)
    for found, table in zip(got, tables):
        np.testing.assert_allclose(found, exact(few, table, reduce)[rows], atol=3e-5)
    np.testing.assert_allclose(distill_votes(votes, tables[0], reduce), got[0], atol=1e-6)


@pytest.mark.parametrize("reduce", ["mean", "median", "mode"])
def test_extremes(reduce):
    codes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0], [np.nan, 0, 0]], np.float32)
    regions = [[0, 1], [0, 1], [-1, -1], [2, 0], [0, 2], [0, 1], [3, 0], [0, 1]]
    weights = [[3e30, 1e30], [3e-30, 1e-30], [0, 0], [3, 1], [3, 1], [np.nan, 1], [3, 1], [np.inf, 1]]
    got = np.asarray(distill_votes(votes_of(regions, weights, 4), codes, reduce))
    first = exact(votes_of([[0, 1]], [[3, 1]], 4), np.nan_to_num(codes), reduce)[0]
    np.testing.assert_allclose(got[[0, 1]], [first, first], atol=1e-6)
    assert (got[[2, 3, 5, 7]] == 0).all()  # no votes, a region without a code, votes that are not finite
    np.testing.assert_allclose(got[4], [1, 0, 0], atol=1e-6)
    assert not np.isfinite(got[6]).all() or (got[6] == 0).all()  # a NaN code never passes for a code


def test_ties_what_is_mostly_unlabelled_no_regions_and_wrong_tables():
    codes = np.eye(3, dtype=np.float32)
    tied = votes_of([[2, 0, -1]], [[3.0, 3.0, 0]], 3)
    np.testing.assert_allclose(distill_votes(tied, codes, "median"), [[0, 0, 1]], atol=1e-6)  # the first, whole
    votes = dataclasses.replace(votes_of([[0, 1]] * 3, [[2.0, 1.0]] * 3, 2), total=jnp.asarray([3.0, 6.0, 7.0]))
    np.testing.assert_array_equal(distill_votes(votes, codes[:2, :2]), [[1, 0], [1, 0], [0, 0]])
    nothing = votes_of(np.zeros((7, 0)), np.zeros((7, 0)), 0)
    np.testing.assert_array_equal(distill_votes(nothing, codes[:0]), np.zeros((7, 3)))
    with pytest.raises(ValueError, match="expected 'mean' or"):
        distill_votes(votes, codes[:2], "sum")
    with pytest.raises(ValueError, match=r"got \(3, 3\)"):
        distill_votes(votes, codes)


@pytest.fixture(scope="module")
def task(scene, cameras):
    """Gaussians, cameras, labels of five regions, their codes, members, capacity."""
    scene, cameras = jax.tree.map(jnp.asarray, (scene, cameras))
    members = true_regions(scene)
    labels = jnp.asarray(labels_of(scene, cameras, members))
    codes = jnp.asarray(unit_rows(np.random.default_rng(1), REGIONS, 3))
    return scene, cameras, labels, codes, members, plan_capacity(scene, cameras)


def test_steps_equal_the_definition_in_float64(task):
    """Loss and four Adam steps, PyTorch's formula, from a dense matrix of weights; each step takes another view."""
    scene, cameras, labels, codes, _, _ = task
    weights = np.stack([weights_reference(scene, camera).reshape(-1, scene.count) for camera in cameras])
    flat = np.asarray(labels).reshape(4, -1)
    start = 0.1 * unit_rows(np.random.default_rng(2), scene.count, 3)
    got, history = distill_l1(scene, cameras, labels, codes, steps=4, key=KEY, init=start)
    truth, taken = np.asarray(codes, np.float64), []
    features, first, second = start.astype(np.float64), 0.0, 0.0
    for step, loss in enumerate(np.asarray(history), start=1):
        length = np.linalg.norm(features, axis=1, keepdims=True)
        masks = (flat >= 0)[..., None]
        errors = weights @ (features / (length + 1e-9)) - truth[np.maximum(flat, 0)]
        losses = np.abs(errors * masks).mean(axis=(1, 2))
        view = int(np.abs(losses - loss).argmin())
        assert loss == pytest.approx(losses[view], rel=1e-5)
        taken.append(view)
        error, mask = errors[view], masks[view]
        on_units = weights[view].T @ (np.sign(error) * mask) / error.size
        unit = features / length
        gradient = (on_units - unit * (unit * on_units).sum(1, keepdims=True)) / length
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        features = features - 0.0025 * (first / (1 - 0.9**step)) / (np.sqrt(second / (1 - 0.999**step)) + 1e-15)
    expected = features / np.linalg.norm(features, axis=1, keepdims=True)
    assert sorted(taken) == [0, 1, 2, 3]
    # a Gaussian with a gradient near zero may take its +-0.0025 step either way
    assert np.quantile(np.abs(np.asarray(got) - expected).max(axis=1), 0.95) < 1e-4


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_the_gradient_of_the_rendered_l1_is_that_of_finite_differences(task, scale):
    scene, cameras, labels, codes, _, capacity = task
    with jax.enable_x64(True):
        scene, camera, codes = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (scene, cameras[1], codes))
        plan = plan_view(scene, camera, capacity=capacity)
        start = scale * jnp.asarray(unit_rows(np.random.default_rng(3), scene.count, 3), jnp.float64)

        def loss(features):
            return rendered_l1(features, plan, jnp.asarray(labels[1]), codes)[0]

        check_grads(jax.jit(loss), (start,), order=1, modes=["rev"], eps=1e-7 * scale, rtol=1e-4)


def test_unseen_gaussians_get_no_code_and_unlabelled_pixels_count_in_the_denominator_alone(task):
    scene, cameras, labels, codes, _, _ = task
    behind = dataclasses.replace(scene, means=scene.means.at[0].set(jnp.asarray([0.0, 50.0, 0.0])))
    options = {"steps": 3, "key": KEY}
    got, _ = distill_l1(behind, cameras, labels, codes, **options)
    assert (np.asarray(got[0]) == 0).all()
    _, history = distill_l1(scene, cameras, jnp.full_like(labels, -1), codes, **options)
    assert (np.asarray(history) == 0).all()


def test_shapes_that_disagree_are_told(task):
    scene, cameras, labels, codes, _, _ = task
    for wrong, match in (
        ({"labels": labels[:2]}, "labels"),
        ({"labels": labels[:, :3]}, "labels"),
        ({"region_codes": codes[:0]}, "labels below 0"),
        ({"init": jnp.zeros((3, 3))}, "init"),
        ({"steps": 0}, "0 steps"),
    ):
        given = {"labels": labels, "region_codes": codes, "steps": 1} | wrong
        with pytest.raises(ValueError, match=match):
            distill_l1(scene, cameras, key=KEY, **given)
