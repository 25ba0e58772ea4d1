"""OpenGaussian's selections: most similar text, best leaf with its siblings, stragglers removed."""

import jax.numpy as jnp
import numpy as np
import pytest
from small_field import unit_rows

from experiments.protocols.opengaussian import most_similar_text, select_leaf, select_text, without_stragglers


def test_each_gaussian_has_one_text_or_none():
    rng = np.random.default_rng(0)
    features, texts = 3 * unit_rows(rng, 500, 16), unit_rows(rng, 5, 16)
    features[:3] = 0
    features[3, 2] = np.nan
    labels, cosines = most_similar_text(jnp.asarray(features), jnp.asarray(texts))
    assert (labels[:4] == -1).all()
    exact = features[4:].astype(np.float64) @ texts.T.astype(np.float64)
    np.testing.assert_array_equal(labels[4:], exact.argmax(1))
    masks = np.stack([np.asarray(select_text(labels, cosines, q).mask) for q in range(5)])
    np.testing.assert_array_equal(masks.sum(0), np.asarray(labels) >= 0)
    with pytest.raises(ValueError, match="one space"):
        most_similar_text(jnp.asarray(features), jnp.asarray(texts[:, :3]))


def test_the_best_leaf_takes_near_siblings_along():
    features = np.zeros((8, 3), np.float32)
    features[[1, 2, 5, 6]] = [[1, 0.1, 0], [1, 0.3, 0], [1, 0.4, 0], [0, 0, 1]]
    codes = np.zeros((8, 2), np.float32)
    codes[2] = 0.5, 0.5  # near to leaf 1
    leaf_of = np.array([0, 1, 1, 2, 5, 6, -1])
    text = np.array([1, 0, 0], np.float32)
    found = select_leaf(features, codes, leaf_of, text, siblings=4)
    np.testing.assert_array_equal(found.mask, [0, 1, 1, 1, 0, 0, 0])  # 5 is no sibling, 6 too far away
    assert int(found.region) == 1
    codes[2] = 2.0
    np.testing.assert_array_equal(select_leaf(features, codes, leaf_of, text, siblings=4).mask, [0, 1, 1, 0, 0, 0, 0])
    nothing = select_leaf(np.zeros_like(features), codes, leaf_of, text, siblings=4)
    assert not np.asarray(nothing.mask).any()
    assert int(nothing.region) == -1


def test_stragglers_and_giants_go():
    rng = np.random.default_rng(1)
    means = np.concatenate([rng.normal(0, 0.1, (200, 3)), [[5, 5, 5]]])
    scales = np.full((201, 3), np.log(0.01))
    scales[7, 1] = np.log(0.2)
    kept = without_stragglers(means, scales, np.ones(201, bool))
    assert not kept[200]
    assert not kept[7]
    assert kept.sum() > 150
    few = np.arange(201) < 50
    np.testing.assert_array_equal(without_stragglers(means, scales, few), few)
