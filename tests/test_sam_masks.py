"""What happens to SAM's masks once they are predicted, each step against a plain twin."""

import numpy as np
from hypothesis import given, settings, strategies as st

from jsecon.networks.sam import _box_nms, _langsplat_nms


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
