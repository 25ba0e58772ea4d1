"""Safe maths over the whole float range: right where reasonable, finite everywhere, in value and in gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from jax.test_util import check_grads

from jsecon.numerics import all_finite, cosine, cosine_matrix, normalize, safe_norm, sigmoid

vectors = hnp.arrays(np.float32, (3,), elements=st.floats(-(2.0**126), 2.0**126, width=32))


@pytest.mark.as_shipped
@settings(deadline=None, max_examples=60)
@given(vectors)
def test_length_and_direction_over_the_float_range(x):
    length = np.linalg.norm(x.astype(np.float64))
    np.testing.assert_allclose(float(safe_norm(x)), length, rtol=1e-5, atol=2e-38)  # subnormal numbers count as zero
    unit = np.asarray(normalize(x), np.float64)
    if length > 1e-37:
        np.testing.assert_allclose(unit, x.astype(np.float64) / length, atol=1e-6)
        assert abs(np.linalg.norm(unit) - 1) < 1e-5
    assert np.isfinite(unit).all()


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1.0, 1e6, 1e30, 1e37])
def test_cosine_does_not_depend_on_length(scale):
    x, y = np.float32([[1, 2, 3]]), np.float32([[-1, 0.5, 2]])
    expected = float((x * y).sum() / np.linalg.norm(x) / np.linalg.norm(y))
    assert abs(float(cosine(jnp.float32(scale) * x, y)[0]) - expected) < 1e-6
    assert abs(float(cosine_matrix(jnp.float32(scale) * x, y)[0, 0]) - expected) < 1e-6


def test_zero_has_cosine_zero_and_gradient_zero():
    zero, other = jnp.zeros(3), jnp.asarray([1.0, 2.0, 3.0])
    assert float(cosine(zero, other)) == 0
    for function in (safe_norm, lambda x: normalize(x).sum(), lambda x: cosine(x, other)):
        np.testing.assert_array_equal(jax.jit(jax.grad(function))(zero), 0)


@pytest.mark.as_shipped
def test_infinite_and_nan_are_not_hidden():
    assert bool(jnp.isnan(normalize(jnp.asarray([jnp.nan, 1.0]))).all())
    assert bool(jnp.isnan(normalize(jnp.asarray([jnp.inf, 1.0]))).all())
    assert float(safe_norm(jnp.asarray([jnp.inf, 1.0]))) == np.inf
    assert not bool(all_finite(jnp.ones(3), jnp.asarray([jnp.nan])))
    assert bool(all_finite(jnp.ones(3)))


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_gradients_equal_central_differences(x64, scale):
    x = scale * jnp.asarray([0.3, -1.2, 2.0], jnp.float64)
    w = jnp.asarray([1.0, -2.0, 0.5], jnp.float64)
    for function in (safe_norm, lambda x: (normalize(x) * w).sum(), lambda x: cosine(x, w)):
        check_grads(jax.jit(function), (x,), order=1, modes=["rev"], rtol=1e-6, atol=0, eps=1e-6 * scale)


@pytest.mark.as_shipped
def test_sigmoid_and_its_derivative_over_the_float_range():
    x = np.float32([-np.inf, -1e4, -80, -30, -5, -1e-30, 0, 1, 5, 10, 17, 30, 80, 1e4, np.inf])
    value, slope = jax.vmap(jax.value_and_grad(sigmoid))(x)
    half = np.exp(-np.abs(x.astype(np.float64)))
    np.testing.assert_allclose(value, np.where(x < 0, half, 1.0) / (1 + half), rtol=2e-6, atol=1e-37)
    np.testing.assert_allclose(slope, half / (1 + half) ** 2, rtol=2e-6, atol=1e-37)


@pytest.mark.as_shipped
@pytest.mark.parametrize("count", [40000, *(pytest.param(n, marks=pytest.mark.long) for n in (16385, 32769, 100000))])
def test_at_the_sizes_where_jax_39103_strikes(count):
    rng = np.random.default_rng(count)
    x, y = rng.normal(size=(count, 3)).astype(np.float32), rng.normal(size=(2, 3)).astype(np.float32)
    x64, y64 = x.astype(np.float64), y.astype(np.float64)
    expected = (x64 / np.linalg.norm(x64, axis=1, keepdims=True)) @ (y64 / np.linalg.norm(y64, axis=1, keepdims=True)).T
    np.testing.assert_allclose(jax.jit(cosine_matrix)(x, y), expected, atol=2e-6)
    np.testing.assert_allclose(jax.jit(lambda x: cosine_matrix(x, y).max(1))(x), expected.max(1), atol=2e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda x: cosine(x[None], y).max()))(x), expected.max(1), atol=2e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(safe_norm))(x), np.linalg.norm(x64, axis=1), rtol=1e-6)
