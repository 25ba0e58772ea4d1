"""Metrics against counting by hand, and their manners at the edges: missing counts as 0, strict means strict."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.evaluate.metrics import accuracy_at, iou, localization_accuracy, mean_iou


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
def test_iou_equals_sets(seed, share_a, share_b):
    rng = np.random.default_rng(seed)
    a, b = rng.random((12, 9)) < share_a, rng.random((12, 9)) < share_b
    set_a, set_b = set(map(tuple, np.argwhere(a))), set(map(tuple, np.argwhere(b)))
    expected = len(set_a & set_b) / len(set_a | set_b) if set_a | set_b else 1.0
    found = jax.jit(jax.vmap(iou))(jnp.stack([a, b]), jnp.stack([b, b]))
    np.testing.assert_allclose(found, [expected, 1.0], atol=1e-6)
    assert float(iou(a, b)) == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match="one shape"):
        iou(a, b.T)


def test_a_missing_prediction_counts_as_nothing_found():
    assert mean_iou([1.0, None, 0.5, float("nan")]) == pytest.approx(0.375)
    assert accuracy_at([1.0, None, 0.5, float("nan")], 0.25) == 0.5
    boxes = np.array([[0, 0, 10, 10.0]])
    assert localization_accuracy([(5, 5), None], [boxes, boxes]) == 0.5
    assert accuracy_at([0.25, 0.2500001], 0.25) == 0.5  # strict
    none = mean_iou([]), accuracy_at([]), localization_accuracy([], [])
    assert np.isnan(none).all()


def test_localisation_counts_edges_and_any_box():
    boxes = np.array([[0, 0, 4, 4], [10, 10, 12, 14.0]])
    points = [(4, 4), (4.5, 4), (12, 14), (11, 9.9), (0, 0)]
    assert localization_accuracy(points, [boxes] * 5) == pytest.approx(3 / 5)
    assert localization_accuracy([(0, 0)], [np.zeros((0, 4))]) == 0
    with pytest.raises(ValueError, match="zip"):
        localization_accuracy([(0, 0)], [])
