"""Masks that carry a wrong id are put right by the other views; ids that are right stay."""

import dataclasses

import numpy as np
import pytest
from balls import ring_of_balls
from hypothesis import given, settings, strategies as st
from scipy import sparse

from jsecon.language.reconcile import agree, reconcile_labels
from jsecon.splat.tiles import plan_capacity

VIEWS = 8


@pytest.fixture(scope="module")
def world():
    gaussians, cameras, _, labels, _ = ring_of_balls()
    labels = labels[::3].copy()
    for image in labels:  # slivers of a ball behind another lie under its blur
        for ball in (1, 2, 3):
            if (image == ball).sum() < 40:
                image[image == ball] = -1
    return gaussians, cameras[np.arange(0, 24, 3)], labels


def test_right_labels_stay(world):
    gaussians, cameras, labels = world
    np.testing.assert_array_equal(reconcile_labels(gaussians, cameras, labels), labels)
    holes = np.where((labels == 0) | (np.arange(VIEWS)[:, None, None] == 3), -1, labels)
    np.testing.assert_array_equal(reconcile_labels(gaussians, cameras, holes), holes)


def test_a_swap_and_a_new_id_are_undone(world):
    gaussians, cameras, labels = world
    wrong = labels.copy()
    wrong[7][labels[7] == 1], wrong[7][labels[7] == 2] = 2, 1
    wrong[1][labels[1] == 3] = 7
    told = []
    found = reconcile_labels(gaussians, cameras, wrong, progress=lambda *step: told.append(step))
    np.testing.assert_array_equal(found, labels)
    assert told == [(t + 1, VIEWS) for t in range(VIEWS)]
    np.testing.assert_array_equal(reconcile_labels(gaussians, cameras, wrong, rounds=0), wrong)


def test_two_places_under_one_id_stay_one(world):
    gaussians, cameras, labels = world
    twins = np.where(labels == 2, 1, labels)
    np.testing.assert_array_equal(reconcile_labels(gaussians, cameras, twins), twins)


def test_nothing_labelled_and_wrong_shapes(world):
    gaussians, cameras, labels = world
    nothing = np.full_like(labels, -1)
    np.testing.assert_array_equal(reconcile_labels(gaussians, cameras, nothing), nothing)
    with pytest.raises(ValueError, match="labels"):
        reconcile_labels(gaussians, cameras, labels[:2])
    with pytest.raises(ValueError, match="rounds"):
        reconcile_labels(gaussians, cameras, labels, rounds=-1)
    with pytest.raises(ValueError, match="capacity"):
        reconcile_labels(gaussians, cameras, labels, capacity=64)
    unseen = dataclasses.replace(gaussians, means=gaussians.means + np.float32(100))
    capacity = plan_capacity(gaussians, cameras, margin=1.0)  # the other tests', so that nothing is compiled anew
    np.testing.assert_array_equal(reconcile_labels(unseen, cameras, labels, capacity=capacity), labels)


def one_round(votes, ids):
    """As one would write it for one Gaussian and one mask at a time."""
    regions, sides = ids.max() + 1, np.zeros((len(votes), ids.max() + 1))
    for n, row in enumerate(votes):
        cast = np.array([row[ids == r].sum() for r in range(regions)])
        if cast.any():
            sides[n, cast.argmax()] = 1
    result = ids.copy()
    for m in range(len(ids)):
        weight = votes[:, m] @ sides
        if weight.max() > weight[ids[m]]:
            result[m] = weight.argmax()
    return result


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_rounds_equal_the_plain_loops(seed, rounds):
    rng = np.random.default_rng(seed)
    votes = rng.integers(1, 9, (30, 12)) * (rng.random((30, 12)) < 0.3).astype(float)
    ids = rng.integers(0, 5, 12)
    expected = ids
    for _ in range(rounds):
        expected = one_round(votes, expected)
    np.testing.assert_array_equal(agree(sparse.csr_matrix(votes), ids, rounds=rounds), expected)
