"""query_canonical against LERF's definition, written as the softmax it is, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.query.canonical import query_canonical


def exact_relevancy(features, text, canonical):
    unit = [np.asarray(a, np.float64) for a in (features, text, canonical)]
    features, text, canonical = (a / np.linalg.norm(a, axis=-1, keepdims=True) for a in unit)
    shares = []
    for phrase in canonical:
        logits = 10 * np.stack([features @ text, features @ phrase])
        powers = np.exp(logits - logits.max(axis=0))
        shares.append(powers[0] / powers.sum(axis=0))
    return np.min(shares, axis=0)


@pytest.mark.parametrize("count", [16_385, 40_000, 100_000])
def test_relevancy_equals_the_softmax_in_float64(count):
    rng = np.random.default_rng(count)
    features, texts, canonical = (rng.normal(size=s).astype(np.float32) for s in ((count, 8), (2, 8), (4, 8)))
    got = jax.jit(jax.vmap(lambda text: query_canonical(jnp.asarray(features), text, jnp.asarray(canonical), 0.5)))(
        texts
    )
    for row, text in enumerate(texts):
        expected = exact_relevancy(features, text, canonical)
        np.testing.assert_allclose(got.similarity[row], expected, atol=3e-6)
        clear = np.abs(expected - 0.5) > 1e-5
        assert (np.asarray(got.mask[row]) == (expected >= 0.5))[clear].all()
    alone = query_canonical(features, texts[1], canonical, 0.5)
    np.testing.assert_allclose(alone.similarity, got.similarity[1], atol=1e-6)


def test_above_a_half_means_closer_than_every_phrase():
    features = jnp.asarray([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    got = query_canonical(features, jnp.asarray([1.0, 0.2, 0]), jnp.asarray([[0, 1.0, 0], [0, 0, 1.0]]), 0.5)
    assert got.mask.tolist() == [True, False, False]


def test_unknown_features_are_never_selected_and_broken_phrases_select_nothing():
    features = jnp.asarray([[0, 0, 0], [jnp.nan, 1, 0], [1e30, 0, 0], [1e-30, 0, 0]], jnp.float32)
    text, phrases = jnp.asarray([1.0, 0, 0]), jnp.asarray([[0, 1.0, 0]])
    assert query_canonical(features, text, phrases, 0.0).mask.tolist() == [False, False, True, True]
    for broken in (jnp.zeros((1, 3)), jnp.full((1, 3), jnp.nan)):
        assert not query_canonical(features, text, broken, 0.0).mask.any()
    assert not query_canonical(features, jnp.zeros(3), phrases, 0.0).mask.any()


def test_no_phrases_or_other_sizes_are_told():
    with pytest.raises(ValueError, match="C >= 1"):
        query_canonical(jnp.eye(3), jnp.ones(3), jnp.zeros((0, 3)), 0.5)
    with pytest.raises(ValueError, match="text"):
        query_canonical(jnp.eye(3), jnp.ones(2), jnp.ones((1, 3)), 0.5)
