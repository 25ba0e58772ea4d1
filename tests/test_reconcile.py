"""The rounds in which masks and Gaussians come to agree, against plain loops."""

import numpy as np
from hypothesis import given, settings, strategies as st
from scipy import sparse

from experiments.reconcile import agree


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


def test_a_mask_under_another_id_is_outvoted_and_right_ones_stay():
    """Two objects of ten Gaussians in five views, mask 2t + k of object k; the last view has them swapped."""
    votes = np.zeros((20, 10))
    for t in range(5):
        votes[:10, 2 * t], votes[10:, 2 * t + 1] = 1, 1
    ids = np.array([0, 1] * 4 + [1, 0])
    np.testing.assert_array_equal(agree(sparse.csr_matrix(votes), ids), [0, 1] * 5)
    np.testing.assert_array_equal(agree(sparse.csr_matrix(votes), np.array([0, 1] * 5)), [0, 1] * 5)
    np.testing.assert_array_equal(agree(sparse.csr_matrix(0 * votes), ids), ids)
