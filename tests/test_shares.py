import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.query.shares import gather_votes


def weight_inside(regions, weights, chosen):
    return gather_votes(regions, weights, chosen).weight


def exact(regions, weights, chosen):
    inside = (regions >= 0) & (regions < len(chosen)) & np.append(chosen, False)[np.clip(regions, 0, len(chosen))]
    return np.where(inside, weights.astype(np.float64), 0.0).sum(-1)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 256, 257, 1000])
def test_equals_a_lookup_of_every_vote(count):
    rng = np.random.default_rng(count)
    regions = rng.integers(-1, count + 2, (500, 5)).astype(np.int32)
    weights = rng.random((500, 5)).astype(np.float32)
    chosen = rng.random((3, count)) < 0.3
    got = jax.jit(jax.vmap(weight_inside, in_axes=(None, None, 0)))(regions, weights, chosen)
    for row, one in zip(got, chosen):
        np.testing.assert_allclose(row, exact(regions, weights, one), rtol=1e-6)
        np.testing.assert_allclose(weight_inside(*map(jnp.asarray, (regions, weights, one))), row, rtol=1e-6)


@pytest.mark.parametrize("count", [16385, 32769, 40000, 100000])
def test_many_gaussians(count):
    rng = np.random.default_rng(0)
    regions = rng.integers(-1, 40, (count, 2)).astype(np.int32)
    weights = rng.random((count, 2)).astype(np.float32)
    chosen = rng.random(40) < 0.5
    np.testing.assert_allclose(jax.jit(weight_inside)(regions, weights, chosen), exact(regions, weights, chosen), 1e-6)


def test_extremes():
    regions = np.asarray([[0, 1], [1, 0], [-1, 5], [1, 1]], np.int32)
    weights = np.asarray([[1e30, np.nan], [np.inf, 2.0], [3.0, 4.0], [1e-30, 0.0]], np.float32)
    got = np.asarray(weight_inside(*map(jnp.asarray, (regions, weights, np.asarray([True, False])))))
    np.testing.assert_array_equal(got, np.float32([1e30, 2.0, 0.0, 0.0]))  # what is not chosen does not spread
    assert (np.asarray(weight_inside(jnp.zeros((3, 0), jnp.int32), jnp.zeros((3, 0)), jnp.ones(2, bool))) == 0).all()


@pytest.mark.parametrize("count", [1, 32, 257, 1000])
def test_the_rival_is_the_strongest_region_not_chosen(count):
    rng = np.random.default_rng(count)
    regions = rng.integers(-1, count + 2, (500, 5)).astype(np.int32)
    weights = rng.random((500, 5)).astype(np.float32)
    chosen = rng.random(count) < 0.3
    outside = (regions >= 0) & (regions < count) & ~chosen[np.clip(regions, 0, count - 1)]
    weight, rival, _ = gather_votes(*map(jnp.asarray, (regions, weights, chosen)))
    np.testing.assert_allclose(weight, exact(regions, weights, chosen), rtol=1e-6)
    np.testing.assert_array_equal(rival, np.where(outside, weights, 0).max(1))
