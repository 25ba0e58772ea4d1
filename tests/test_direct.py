"""Queries on codes: query_one_step against NumPy and at the ends of the floats; query_canonical against LERF's
definition, written as the softmax it is, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY

from jsecon import query_canonical, query_one_step


def exact_cosines(codes, code):
    codes, code = np.asarray(codes, np.float64), np.asarray(code, np.float64)
    return codes @ code / np.linalg.norm(codes, axis=1) / np.linalg.norm(code)


@pytest.mark.parametrize("count", [300, MANY])
def test_cosines_are_those_of_float64(count):
    rng = np.random.default_rng(0)
    codes, texts = (rng.normal(size=(rows, 3)).astype(np.float32) for rows in (count, 2))
    found = jax.jit(jax.vmap(lambda text: query_one_step(codes, text, 0.5)))(texts)
    expected = np.stack([exact_cosines(codes, text) for text in texts])
    np.testing.assert_allclose(found.similarity, expected, atol=1e-6)
    np.testing.assert_allclose(found.score, expected.max(axis=1), atol=1e-6)
    clear = np.abs(expected - 0.5) > 1e-5
    assert (np.asarray(found.mask) == (expected >= 0.5))[clear].all()


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12, 1e30, 3e38])
def test_only_directions_count(scale):
    codes = jnp.asarray(np.array([[1, 0, 0], [0.6, 0.8, 0], [-1, 0, 0]]) * scale, jnp.float32)
    got = query_one_step(codes, jnp.asarray([1.0, 0, 0]), 0.5)
    np.testing.assert_allclose(got.similarity, [1, 0.6, -1], rtol=1e-6)
    assert got.mask.tolist() == [True, True, False]
    text = jnp.asarray([min(scale, 1e37), 0, 0], jnp.float32)
    assert query_one_step(jnp.eye(3), text, 0.5).mask.tolist() == [True, False, False]


@pytest.mark.parametrize("threshold", [-1.0, 0.0, 0.5])
def test_what_is_unknown_is_never_selected(threshold):
    inf, nan = np.inf, np.nan
    codes = jnp.asarray([[0, 0, 0], [nan, 1, 0], [inf, 1, 0], [1, 0, 0]], jnp.float32)
    got = query_one_step(codes, jnp.asarray([1.0, 0, 0]), threshold)
    assert got.mask.tolist() == [False, False, False, True]
    np.testing.assert_array_equal(got.similarity[:3], 0)
    assert float(got.score) == 1
    assert int(got.region) == -1
    for text in ([0, 0, 0], [nan, 0, 0], [inf, 0, 0]):
        nothing = query_one_step(codes, jnp.asarray(text, jnp.float32), threshold)
        assert not nothing.mask.any()
        assert float(nothing.score) == 0


def test_nan_threshold_and_no_gaussians_select_nothing_and_sizes_that_disagree_are_told():
    assert not query_one_step(jnp.eye(3), jnp.ones(3), np.nan).mask.any()
    assert float(query_one_step(jnp.zeros((0, 3)), jnp.ones(3), 0.5).score) == 0
    with pytest.raises(ValueError, match=r"got \(4,\), expected \(3,\)"):
        query_one_step(jnp.eye(3), jnp.ones(4), 0.5)
    with pytest.raises(ValueError, match="C >= 1"):
        query_canonical(jnp.eye(3), jnp.ones(3), jnp.zeros((0, 3)), 0.5)
    with pytest.raises(ValueError, match="text"):
        query_canonical(jnp.eye(3), jnp.ones(2), jnp.ones((1, 3)), 0.5)


def exact_relevancy(features, text, canonical):
    unit = [np.asarray(a, np.float64) for a in (features, text, canonical)]
    features, text, canonical = (a / np.linalg.norm(a, axis=-1, keepdims=True) for a in unit)
    shares = []
    for phrase in canonical:
        logits = 10 * np.stack([features @ text, features @ phrase])
        powers = np.exp(logits - logits.max(axis=0))
        shares.append(powers[0] / powers.sum(axis=0))
    return np.min(shares, axis=0)


@pytest.mark.parametrize("count", [300, MANY])
def test_relevancy_equals_the_softmax_in_float64(count):
    rng = np.random.default_rng(0)
    features, texts, canonical = (rng.normal(size=(rows, 8)).astype(np.float32) for rows in (count, 2, 4))
    got = jax.jit(jax.vmap(lambda text: query_canonical(features, text, canonical, 0.5)))(texts)
    for row, text in enumerate(texts):
        expected = exact_relevancy(features, text, canonical)
        np.testing.assert_allclose(got.similarity[row], expected, atol=3e-6)
        clear = np.abs(expected - 0.5) > 1e-5
        assert (np.asarray(got.mask[row]) == (expected >= 0.5))[clear].all()
    alone = query_canonical(features, texts[1], canonical, 0.5)
    np.testing.assert_allclose(alone.similarity, got.similarity[1], atol=1e-6)


def test_unknown_features_are_never_selected_and_broken_phrases_select_nothing():
    features = jnp.asarray([[0, 0, 0], [jnp.nan, 1, 0], [1e30, 0, 0], [1e-30, 0, 0]], jnp.float32)
    text, phrases = jnp.asarray([1.0, 0, 0]), jnp.asarray([[0, 1.0, 0]])
    assert query_canonical(features, text, phrases, 0.0).mask.tolist() == [False, False, True, True]
    for broken in (jnp.zeros((1, 3)), jnp.full((1, 3), jnp.nan)):
        assert not query_canonical(features, text, broken, 0.0).mask.any()
    assert not query_canonical(features, jnp.zeros(3), phrases, 0.0).mask.any()
