"""Masks as runs of pixels."""

import numpy as np
from hypothesis import given, settings, strategies as st
from scipy import sparse

from jsecon.association.run_lengths import encode_masks, encode_rows, memoized_masks


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.sampled_from([0.0, 0.1, 0.5, 0.95, 1.0]))
def test_masks_come_back(seed, count, share):
    masks = np.random.default_rng(seed).random((count, 5, 7)) < share
    runs = encode_masks(masks)
    np.testing.assert_array_equal(runs.masks(5, 7), masks)
    np.testing.assert_array_equal(runs.rows().toarray(), masks.reshape(count, 35))
    assert (runs.stops > runs.starts).all()
    changes = np.diff(np.pad(masks.reshape(count, 35), ((0, 0), (1, 1))).astype(int)) == 1
    np.testing.assert_array_equal(runs.counts, changes.sum(1))
    again = encode_rows(runs.rows())
    for name in ("starts", "stops", "counts"):
        np.testing.assert_array_equal(getattr(again, name), getattr(runs, name))
    both = runs.concatenate(encode_masks(~masks))
    np.testing.assert_array_equal(both.masks(5, 7), np.concatenate([masks, ~masks]))


def test_a_mask_that_ends_where_the_next_begins_is_not_run_together():
    rows = sparse.csr_matrix(np.array([[0, 0, 0, 1, 1, 0], [0, 0, 0, 0, 0, 1], [1, 1, 0, 0, 0, 0]], bool))
    runs = encode_rows(rows)
    np.testing.assert_array_equal(runs.counts, [1, 1, 1])
    np.testing.assert_array_equal(runs.starts, [3, 5, 0])
    np.testing.assert_array_equal(runs.stops, [5, 6, 2])


def test_a_frame_is_asked_once():
    calls, masks = [], np.random.default_rng(0).random((2, 3, 4, 6)) < 0.5
    masks_of = memoized_masks(lambda t: calls.append(t) or masks[t])
    for t in (1, 0, 1, 1):
        np.testing.assert_array_equal(masks_of(t), masks[t])
    assert calls == [1, 0]
