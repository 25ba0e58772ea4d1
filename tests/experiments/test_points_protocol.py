"""Means over the classes that occur: against a confusion matrix; nothing dropped; denominators."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from experiments.protocols.points import evaluate_points, point_class_means
from jsecon.errors import InputError


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 7))
def test_against_a_confusion_matrix(seed, count, classes):
    rng = np.random.default_rng(seed)
    truth, found = rng.integers(-1, classes, (2, count))
    if (truth < 0).all():
        truth[0] = 0
    rows, told = evaluate_points(found, truth, [f"class {k}" for k in range(classes)])
    table = np.zeros((classes + 1, classes + 1))
    for t, f in zip(truth, found, strict=True):
        table[t, f] += 1  # -1 is the last row and column
    present = np.flatnonzero(table[:-1].sum(1))
    both = table[present, present]
    recall = both / table[present].sum(1)
    union = table[present].sum(1) + table[:-1, present].sum(0) - both
    assert [row.query for row in rows] == [f"class {k}" for k in present]
    assert told["miou"] == pytest.approx((both / union).mean())
    assert told["macc"] == pytest.approx(recall.mean())
    assert (told["miou"], told["macc"]) == pytest.approx(point_class_means(found, truth))
    assert told["missing"] == table[:-1, -1].sum()


def test_faint_points_and_denominators():
    truth, found = np.array([0, 0, 1, 1, 2, -1]), np.array([0, -1, 1, 0, 2, 2])
    opacities = np.array([0.9, 0.9, 0.9, 0.9, 0.05, 0.9])
    rows, told = evaluate_points(found, truth, "abc", opacities=opacities, expected_classes=2)
    assert [(row.query, row.points) for row in rows] == [("a", 2), ("b", 2)]
    assert (told["points"], told["faint"], told["missing"]) == (4, 1, 1)
    assert told["miou"] == pytest.approx((1 / 3 + 1 / 2) / 2)
    with pytest.raises(InputError, match="2 classes among 4 counted points"):
        evaluate_points(found, truth, "abc", opacities=opacities, expected_classes=3)
    with pytest.raises(InputError, match="at least one"):
        evaluate_points(found, np.full(6, -1), "abc")
    with pytest.raises(ValueError, match="classes up to 2"):
        evaluate_points(found, truth, "ab")
