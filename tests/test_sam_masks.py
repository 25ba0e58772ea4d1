"""What happens to SAM's masks once they are predicted, each step against a plain twin."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy import ndimage

from jsecon.networks.sam import (
    _box_nms,
    _box_of,
    _langsplat_nms,
    _remove_small_regions,
    _stability,
)


def test_stability_is_the_iou_of_two_thresholds():
    logits = np.asarray([[-2.0, -0.5, 0.5, 2.0, 3.0]])
    assert _stability(logits, 1.0) == 2 / 4
    assert _stability(logits, 0.0) == 1.0
    assert _stability(logits - 9, 1.0) == 0.0


def test_a_box_holds_the_outermost_pixels():
    mask = np.zeros((6, 9), bool)
    assert _box_of(mask) == (0, 0, 0, 0)
    mask[2, 3] = mask[4, 7] = True
    assert _box_of(mask) == (3, 2, 7, 4)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 30), st.sampled_from([0.3, 0.7]))
def test_box_nms_is_greedy(seed, count, threshold):
    rng = np.random.default_rng(seed)
    corner = rng.integers(0, 20, (count, 2))
    boxes = np.concatenate([corner, corner + rng.integers(0, 12, (count, 2))], axis=1).astype(np.float64)
    scores = rng.choice([0.5, 0.7, 0.9], count)

    def iou(a, b):
        width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
        common = max(width, 0) * max(height, 0)
        return common and common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)

    kept = []
    for i in sorted(range(count), key=lambda i: (-scores[i], i)):
        if all(iou(boxes[i], boxes[j]) <= threshold for j in kept):
            kept.append(i)
    assert _box_nms(boxes, scores, threshold).tolist() == kept


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.floats(0.1, 0.9))
@example(291, 6, 0.1875)  # two islands of the same size
def test_small_holes_are_filled_then_small_islands_removed(seed, least, density):
    mask = np.random.default_rng(seed).random((12, 15)) < density
    expected = mask.copy()
    holes, count = ndimage.label(~mask, np.ones((3, 3)))
    for label in range(1, count + 1):
        if (holes == label).sum() < least:
            expected |= holes == label
    islands, count = ndimage.label(expected, np.ones((3, 3)))
    areas = [(islands == label).sum() for label in range(1, count + 1)]
    largest = max(areas, default=0)
    clean, changed = _remove_small_regions(mask, least)
    # Where every island is small one of the largest stays: of several alike, any.
    chosen = [area == largest and clean[islands == label].all() for label, area in enumerate(areas, 1)]
    stays = 1 + chosen.index(True) if any(chosen) else 0
    for label, area in enumerate(areas, 1):
        if area < least and (largest >= least or label != stays):
            expected[islands == label] = False
    np.testing.assert_array_equal(clean, expected)
    assert changed >= (expected != mask).any()
    assert clean.any() == expected.any()


def by_definition(masks, scores, iou_threshold=0.8, score_threshold=0.7, inner_threshold=0.5):
    """LangSplat's mask_nms (preprocess.py), two loops over the masks in order of score and two triangles of a
    matrix."""
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
    np.testing.assert_array_equal(_langsplat_nms(masks, scores), by_definition(masks, scores))


def test_empty_masks_are_dropped_and_no_masks_stay_none():
    masks = np.zeros((2, 4, 5), bool)
    masks[1, 1:3, 1:3] = True
    assert _langsplat_nms(masks, np.asarray([0.9, 0.8])).tolist() == [1]
    assert _langsplat_nms(masks[:0], np.zeros(0)).tolist() == []
    with pytest.raises(ValueError, match="One score per mask"):
        _langsplat_nms(masks, np.zeros(3))
