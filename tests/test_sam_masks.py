"""What happens to SAM's masks once they are predicted, each step against a plain twin."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy import ndimage

from jsecon.networks.sam import (
    Crop,
    box_nms,
    box_of,
    crops_of,
    cut_by_crop,
    langsplat_nms,
    point_grid,
    remove_small_regions,
    shared_areas,
    stability,
)


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


@pytest.mark.parametrize(("box", "cut"), [
    ((25, 100, 125, 200), False),  # well inside, to the frame's left
    ((5, 100, 60, 200), False),  # at an edge that is the frame's own
    ((120, 100, 185, 200), True),  # 15 px from the crop's right edge
    ((120, 100, 179, 200), False),
    ((30, 250, 100, 285), True),
])  # fmt: skip
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
    clean, changed = remove_small_regions(mask, least)
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
    np.testing.assert_array_equal(langsplat_nms(masks, scores), by_definition(masks, scores))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 80))
def test_shared_areas_are_exact(seed, count):
    masks = blobs(np.random.default_rng(seed), count)
    flat = masks.reshape(count, 24 * 30).astype(np.int64)
    np.testing.assert_array_equal(shared_areas(masks), flat @ flat.T)


def test_empty_masks_are_dropped_and_no_masks_stay_none():
    masks = np.zeros((2, 4, 5), bool)
    masks[1, 1:3, 1:3] = True
    assert langsplat_nms(masks, np.asarray([0.9, 0.8])).tolist() == [1]
    assert langsplat_nms(masks[:0], np.zeros(0)).tolist() == []
    with pytest.raises(ValueError, match="One score per mask"):
        langsplat_nms(masks, np.zeros(3))


def test_the_grid_has_the_centres_of_its_cells_and_x_runs_fastest():
    np.testing.assert_allclose(point_grid(2), [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    assert point_grid(32).shape == (1024, 2)
    np.testing.assert_allclose(point_grid(32)[:2, 0], [1 / 64, 3 / 64])
    with pytest.raises(ValueError, match="at least 1"):
        point_grid(0)


def test_crops_are_those_of_the_automatic_mask_generator():
    """1500 x 1000, by hand: overlap int(512/1500 * 1000 * 2/2) = 341; lengths are half of 341 + 1500 and 341 + 1000."""
    assert crops_of(1000, 1500, 1, 512 / 1500) == [
        Crop(0, 0, 1500, 1000, 0),
        Crop(0, 0, 921, 671, 1),
        Crop(0, 330, 921, 1000, 1),
        Crop(580, 0, 1500, 671, 1),
        Crop(580, 330, 1500, 1000, 1),
    ]
    assert crops_of(1000, 1500, 0, 512 / 1500) == [Crop(0, 0, 1500, 1000, 0)]


@settings(max_examples=50, deadline=None)
@given(st.integers(8, 300), st.integers(8, 300), st.integers(0, 2))
def test_the_crops_of_each_layer_cover_the_frame(height, width, layers):
    crops = crops_of(height, width, layers, 512 / 1500)
    assert len(crops) == sum(4**k for k in range(layers + 1))
    for layer in range(layers + 1):
        seen = np.zeros((height, width), bool)
        for crop in crops:
            if crop.layer == layer:
                assert 0 <= crop.left < crop.right <= width
                assert 0 <= crop.top < crop.bottom <= height
                assert crop.area == (crop.right - crop.left) * (crop.bottom - crop.top)
                seen[crop.top : crop.bottom, crop.left : crop.right] = True
        assert seen.all()
