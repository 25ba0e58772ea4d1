"""query_one_step against NumPy float64, where jax was silently wrong (STYLE trap 1), and at the ends of the floats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.query.canonical import query_canonical
from jsecon.query.one_step import query_one_step, similarities
from jsecon.query.units import unit_codes


def exact_cosines(codes, code):
    codes, code = np.asarray(codes, np.float64), np.asarray(code, np.float64)
    return codes @ code / np.linalg.norm(codes, axis=1) / np.linalg.norm(code)


@pytest.mark.parametrize("count", [16_385, 32_769, 40_000, 100_000])
def test_cosines_equal_float64_under_jit_and_vmap(count):
    rng = np.random.default_rng(count)
    codes = rng.normal(size=(count, 3)).astype(np.float32)
    texts = rng.normal(size=(2, 3)).astype(np.float32)
    expected = np.stack([exact_cosines(codes, text) for text in texts])
    eager = query_one_step(codes, texts[0], 0.5)
    np.testing.assert_allclose(eager.similarity, expected[0], atol=1e-6)
    batched = jax.jit(jax.vmap(lambda text: query_one_step(jnp.asarray(codes), text, 0.5)))(texts)
    np.testing.assert_allclose(batched.similarity, expected, atol=1e-6)
    clear = np.abs(expected - 0.5) > 1e-5
    assert (np.asarray(batched.mask) == (expected >= 0.5))[clear].all()
    per_gaussian = jax.jit(jax.vmap(lambda code: similarities(code[None], texts[0])[0][0]))(codes)
    np.testing.assert_allclose(per_gaussian, expected[0], atol=1e-6)
    np.testing.assert_allclose(batched.score, expected.max(axis=1), atol=1e-6)


def test_wide_features_equal_float64():
    rng = np.random.default_rng(0)
    features, text = rng.normal(size=(2_000, 512)).astype(np.float32), rng.normal(size=512).astype(np.float32)
    np.testing.assert_allclose(query_one_step(features, text, 0.1).similarity, exact_cosines(features, text), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12, 1e30, 3e38])
def test_only_directions_count(scale):
    codes = jnp.asarray(np.array([[1, 0, 0], [0.6, 0.8, 0], [-1, 0, 0]]) * scale, jnp.float32)
    got = query_one_step(codes, jnp.asarray([1.0, 0, 0]), 0.5)
    np.testing.assert_allclose(got.similarity, [1, 0.6, -1], rtol=1e-6)
    assert got.mask.tolist() == [True, True, False]
    scale = min(scale, 1e37)
    assert query_one_step(jnp.eye(3), jnp.asarray([scale, 0, 0], jnp.float32), 0.5).mask.tolist() == [
        True,
        False,
        False,
    ]


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


def test_nan_threshold_and_no_gaussians_select_nothing():
    assert not query_one_step(jnp.eye(3), jnp.ones(3), np.nan).mask.any()
    empty = query_one_step(jnp.zeros((0, 3)), jnp.ones(3), 0.5)
    assert empty.mask.shape == (0,)
    assert float(empty.score) == 0


def test_sizes_that_disagree_are_told():
    with pytest.raises(ValueError, match=r"text code of size 4.*expected 3"):
        query_one_step(jnp.eye(3), jnp.ones(4), 0.5)


@pytest.mark.parametrize(("count", "size"), [(16_385, 3), (40_000, 3), (16_385, 40), (32_769, 40), (40_000, 40)])
def test_unit_codes_answer_as_codes_do_under_jit_and_vmap(count, size):
    rng = np.random.default_rng(size)
    codes, texts = (rng.normal(size=(n, size)).astype(np.float32) for n in (count, 2))
    codes[:3] = [[0] * size, [np.nan] * size, [1e30] * size]
    units = unit_codes(codes)
    many = jax.jit(jax.vmap(lambda text: query_one_step(units, text, 0.1)))(texts)
    for index, text in enumerate(texts):
        alone, plain = query_one_step(units, text, 0.1), query_one_step(codes, text, 0.1)
        expected = exact_cosines(codes[2:], text)
        for got in (alone, plain, jax.tree.map(lambda a, index=index: a[index], many)):
            np.testing.assert_allclose(got.similarity[2:], expected, atol=1e-6)
            assert not np.asarray(got.mask)[:2].any()
    assert float(query_one_step(units, texts[0], -1.0).mask[:2].sum()) == 0
    relevancy = query_canonical(units, texts[0], texts, 0.5).similarity
    np.testing.assert_allclose(relevancy, query_canonical(codes, texts[0], texts, 0.5).similarity, atol=1e-6)
