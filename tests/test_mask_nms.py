"""LangSplat's suppression of masks by masks: the same kept set as its definition, pair by pair."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.vision.mask_nms import atoms_of_masks, langsplat_nms, shared_areas


def by_definition(masks, scores, iou_threshold=0.8, score_threshold=0.7, inner_threshold=0.5):
    """REFERENCE B.2, two loops over the masks in order of score and two triangles of a matrix."""
    order = np.argsort(-scores, kind="stable")
    count = len(order)
    iou, inner = np.zeros((count, count)), np.zeros((count, count))
    for i in range(count):
        for j in range(i, count):
            a, b = masks[order[i]], masks[order[j]]
            common = (a & b).sum()
            iou[i, j] = common / (a | b).sum()
            of_a, of_b = common / a.sum(), common / b.sum()
            if of_a < 0.5 and of_b >= 0.85:
                inner[i, j] = 1 - of_b * of_a
            if of_a >= 0.85 and of_b < 0.5:
                inner[j, i] = 1 - of_b * of_a
    kept = np.triu(iou, 1).max(0) <= iou_threshold
    kept &= scores[order] > score_threshold
    kept &= np.triu(inner, 1).max(0) <= 1 - inner_threshold
    kept &= np.tril(inner, 1).max(0) <= 1 - inner_threshold
    return order[kept]


def blobs(rng, count, height=24, width=30):
    """Boxes of all sizes, so that many are alike, inside of one another, or apart."""
    masks = np.zeros((count, height, width), bool)
    for mask in masks:
        y, x = rng.integers(0, height - 1), rng.integers(0, width - 1)
        mask[y : y + rng.integers(1, height), x : x + rng.integers(1, width)] = True
        mask &= rng.random(mask.shape) < rng.choice([1.0, 0.95, 0.6])
        mask[y, x] = True
    return masks


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_the_kept_set_is_that_of_the_definition(seed, count):
    rng = np.random.default_rng(seed)
    masks, scores = blobs(rng, count), rng.choice([0.6, 0.7, 0.75, 0.8, 0.9, 0.99], count)
    masks[rng.integers(0, count)] = masks[0]
    np.testing.assert_array_equal(langsplat_nms(masks, scores), by_definition(masks, scores))
    loose = {"iou_threshold": 0.5, "score_threshold": 0.0, "inner_threshold": 0.2}
    np.testing.assert_array_equal(langsplat_nms(masks, scores, **loose), by_definition(masks, scores, **loose))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 80))
def test_shared_areas_and_atoms_are_exact(seed, count):
    masks = blobs(np.random.default_rng(seed), count)
    flat = masks.reshape(count, 24 * 30).astype(np.int64)
    np.testing.assert_array_equal(shared_areas(masks), flat @ flat.T)
    labels, membership = atoms_of_masks(masks)
    np.testing.assert_array_equal(membership[labels].transpose(2, 0, 1), masks)
    assert len(np.unique(membership[np.unique(labels)], axis=0)) == len(np.unique(labels))


def test_empty_masks_are_dropped_and_no_masks_stay_none():
    masks = np.zeros((2, 4, 5), bool)
    masks[1, 1:3, 1:3] = True
    assert langsplat_nms(masks, np.asarray([0.9, 0.8])).tolist() == [1]
    assert langsplat_nms(masks[:0], np.zeros(0)).tolist() == []
    with pytest.raises(ValueError, match="one score a mask"):
        langsplat_nms(masks, np.zeros(3))
