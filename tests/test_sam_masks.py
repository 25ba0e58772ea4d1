"""What happens to SAM's masks once they are predicted, each step against a plain twin."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy import ndimage

from jsecon.vision.sam_masks import box_nms, box_of, cut_by_crop, stability, tidied
from jsecon.vision.sam_prompts import Crop


def test_stability_is_the_iou_of_two_thresholds():
    logits = np.asarray([[-2.0, -0.5, 0.5, 2.0, 3.0]])
    assert stability(logits, 1.0) == 2 / 4
    assert stability(logits, 0.0) == 1.0
    assert stability(logits - 9, 1.0) == 0.0


def test_a_box_holds_the_outermost_pixels():
    mask = np.zeros((6, 9), bool)
    assert box_of(mask) == (0, 0, 0, 0)
    mask[2, 3] = mask[4, 7] = True
    assert box_of(mask) == (3, 2, 7, 4)


@pytest.mark.parametrize(
    ("box", "cut"),
    [
        ((25, 100, 125, 200), False),  # well inside, to the frame's left
        ((5, 100, 60, 200), False),  # at an edge that is the frame's own
        ((120, 100, 185, 200), True),  # 15 px from the crop's right edge
        ((120, 100, 179, 200), False),
        ((30, 250, 100, 285), True),
    ],
)
def test_a_box_near_a_crops_own_edge_is_cut(box, cut):
    assert cut_by_crop(box, Crop(0, 0, 200, 300, 1), 400, 600) is cut
    assert not cut_by_crop(box, Crop(0, 0, 200, 300, 0), 200, 300)


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
    assert box_nms(boxes, scores, threshold).tolist() == kept


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
    clean, changed = tidied(mask, least)
    # Where every island is small one of the largest stays: of several alike, any.
    chosen = [area == largest and clean[islands == label].all() for label, area in enumerate(areas, 1)]
    stays = 1 + chosen.index(True) if any(chosen) else 0
    for label, area in enumerate(areas, 1):
        if area < least and (largest >= least or label != stays):
            expected[islands == label] = False
    np.testing.assert_array_equal(clean, expected)
    assert changed >= (expected != mask).any()
    assert clean.any() == expected.any()
