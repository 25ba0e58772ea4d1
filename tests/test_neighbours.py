"""Similarities evened out over neighbours: against a slow twin, with equal places and places that are no numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.query.smoothing import nearest_neighbours, smooth_over_neighbours


def test_the_nearest_are_the_nearest_but_oneself():
    means = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    away = np.linalg.norm(means[:, None] - means[None], axis=-1) + 99 * np.eye(60)
    found = nearest_neighbours(means, count=7)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(np.sort(found, 1), np.sort(np.argsort(away, axis=1)[:, :7], 1))


def test_many_in_one_place_and_places_that_are_no_numbers():
    means = np.zeros((40, 3), np.float32)
    means[30:] = np.arange(30)[:, None].repeat(3, 1).reshape(10, 9)[:, :3]
    means[5], means[6, 1] = np.nan, np.inf
    found = nearest_neighbours(means, count=4)
    assert (found != np.arange(40)[:, None])[np.isfinite(means).all(1)].all()
    assert not np.isin(found, (5, 6))[np.isfinite(means).all(1)].any()
    np.testing.assert_array_equal(found[5], 5)
    for few in (0, 1, 2, 3):
        assert nearest_neighbours(means[:few], count=4).shape == (few, max(min(4, few - 1), 1))
    with pytest.raises(ValueError, match="at least 1"):
        nearest_neighbours(means, count=0)


def test_evened_is_half_of_ones_own():
    draw = np.random.default_rng(1)
    similarity, near = draw.random(50, np.float32), draw.integers(0, 50, (50, 6)).astype(np.int32)
    slow = [0.5 * similarity[n] + 0.5 * np.mean([similarity[m] for m in near[n]]) for n in range(50)]
    np.testing.assert_allclose(smooth_over_neighbours(similarity, near), slow, rtol=1e-6)
    several = draw.random((3, 50)).astype(np.float32)
    by_vmap = jax.vmap(smooth_over_neighbours, in_axes=(0, None))(several, near)
    np.testing.assert_allclose(by_vmap, np.stack([smooth_over_neighbours(row, near) for row in several]), rtol=1e-6)
    with jax.disable_jit():
        np.testing.assert_allclose(smooth_over_neighbours(jnp.asarray(similarity), near), slow, rtol=1e-6)
    gradient = jax.grad(lambda s: (smooth_over_neighbours(s, near) ** 2).sum())(jnp.asarray(similarity))
    step = np.zeros(50, np.float32)
    step[7] = 1e-2
    ends = [
        float((np.asarray(smooth_over_neighbours(similarity + k * step, near), np.float64) ** 2).sum()) for k in (1, -1)
    ]
    assert float(gradient[7]) == pytest.approx((ends[0] - ends[1]) / 2e-2, rel=1e-2)
