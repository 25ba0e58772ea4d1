import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from mask_overlaps import iou_matrix

from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.region_graph import merge_regions


def desk(seed=0):
    """A lit, shadowed and slightly noisy picture of five flat-coloured things on wood, and their masks."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:120, :160].astype(np.float32)
    albedo = np.full((120, 160, 3), (178, 150, 110), np.float32)
    albedo *= (1 + 0.05 * np.sin(rows / 3 + np.sin(columns / 17)))[..., None]
    things = {(205, 32, 36): (30, 35, 18), (20, 84, 40): (35, 85, 16), (142, 214, 142): (40, 125, 17),
              (36, 84, 196): (85, 50, 20), (240, 238, 236): (85, 115, 18)}  # fmt: skip
    masks = []
    light = 0.75 + 0.3 * columns / 160
    for y, x, _ in things.values():
        shadow = np.exp(-(((rows - y - 12) ** 2 + (columns - x - 14) ** 2) / (2 * 13.0**2)))
        light = light * (1 - 0.35 * shadow)
    for colour, (y, x, radius) in things.items():
        mask = (rows - y) ** 2 + (columns - x) ** 2 < radius**2
        albedo[mask] = colour
        height = np.sqrt(np.clip(1 - ((rows - y) ** 2 + (columns - x) ** 2) / radius**2, 0, 1))
        light = np.where(mask, 0.7 + 0.35 * height - 0.2 * (columns - x) / radius, light)
        masks.append(mask)
    picture = 255 * ((albedo / 255) ** 2.2 * light[..., None]).clip(0, 1) ** (1 / 2.2)
    picture = cv2.GaussianBlur(picture, (3, 3), 0.6) + rng.normal(0, 3, picture.shape)
    return picture.clip(0, 255).astype(np.uint8), np.stack(masks)


def best_ious(truth, masks):
    return iou_matrix(truth.reshape(len(truth), -1), masks.reshape(len(masks), -1)).max(1)


@pytest.mark.parametrize(("seed", "gain"), [(0, 1.0), (1, 1.0), (2, 1.0), (1, 0.05), (1, 20.0)])
def test_each_thing_is_one_region_in_spite_of_shading_shadow_noise_and_exposure(seed, gain):
    frame, things = desk(seed)
    linear = (frame / 255.0) ** 2.2
    frame = (255 * (gain * linear / (1 + (gain - 1) * linear)) ** (1 / 2.2)).round().astype(np.uint8)
    masks = ClassicalSegmenter(layers=(1.0,))(frame, 0)
    assert (best_ious(things, masks) > 0.85).all()
    assert len(masks) <= 12
    assert (masks.sum(0) <= 1).all()  # a partition, but for specks
    table = ~things.any(0)
    assert best_ious(table[None], masks)[0] > 0.9


def test_a_finer_layer_has_what_hardly_differs_from_what_it_lies_on():
    frame = np.full((120, 160, 3), 120, np.uint8)
    frame[40:60, 60:90] = 146  # nine units of lightness above the rest
    patch = (frame[..., 0] > 130)[None]
    both, coarse = (ClassicalSegmenter(layers=layers)(frame, 0) for layers in ((1.0, 0.5), (1.0,)))
    assert len(coarse) == 1
    np.testing.assert_array_equal(both[:1], coarse)
    assert best_ious(patch, both[1:])[0] > 0.85
    assert (both[1:].sum(0) <= 1).all()


def test_the_same_frame_gives_the_same_masks_and_its_mirror_image_nearly_the_mirrored():
    frame, things = desk()
    segmenter = ClassicalSegmenter()
    best, coarse = ClassicalSegmenter(max_regions=5)(frame, 0), ClassicalSegmenter(layers=(1.0,))(frame, 0)
    assert len(best) == 5 * len(segmenter.layers)
    np.testing.assert_array_equal(best[:5], coarse[:5])
    assert (best.sum((1, 2)) >= segmenter.min_area * frame[..., 0].size).all()
    np.testing.assert_array_equal(segmenter(frame, 0), segmenter(frame, 7))
    mirrored = segmenter(np.ascontiguousarray(frame[:, ::-1]), 0)
    assert (best_ious(things[:, :, ::-1], mirrored) > 0.85).all()
    for wrong in (np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3), np.float32)):
        with pytest.raises(ValueError, match="frame"):
            segmenter(wrong, 0)


@pytest.mark.parametrize("frame", [
    np.zeros((40, 50, 3), np.uint8), np.full((40, 50, 3), 255, np.uint8), np.zeros((8, 8, 3), np.uint8),
    np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8),
])  # fmt: skip
def test_flat_tiny_and_noisy_frames(frame):
    for labels in ClassicalSegmenter().partitions(frame, 0):
        assert labels.shape == frame.shape[:2]
        np.testing.assert_array_equal(np.unique(labels), np.arange(labels.max() + 1))
    assert len(ClassicalSegmenter()(frame, 0)) >= (frame.std() < 1)


@pytest.mark.parametrize("path", ["captures/bonsai/images/DSCF5605.JPG", "captures/fox/images/0001.jpg"])
def test_real_photographs_come_apart_into_tens_of_regions(shared, path):
    picture = cv2.imread(str(shared / path))[..., ::-1]
    frame = cv2.resize(picture, (400, 400 * len(picture) // picture.shape[1]), interpolation=cv2.INTER_AREA)
    masks = ClassicalSegmenter()(frame, 0)
    assert 8 <= len(masks) <= 128
    assert masks.any(0).mean() > 0.9
    assert masks.mean((1, 2)).max() < 0.6


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_merging_leaves_connected_regions_whatever_the_superpixels_are_called(seed):
    rng = np.random.default_rng(seed)
    picture = cv2.resize(rng.uniform(0, 60, (4, 5, 3)).astype(np.float32), (30, 24), interpolation=cv2.INTER_NEAREST)
    features = picture + rng.normal(0, 1, picture.shape).astype(np.float32)
    rows, columns = np.mgrid[:24, :30] // 3
    cells = 10 * rows + columns
    results = []
    for name in (np.arange(cells.max() + 1), rng.permutation(cells.max() + 1)):
        named = name[cells].astype(np.int32)
        merged = merge_regions(named, features, None, distance=10.0, min_area=8.0)
        for region in range(merged.max() + 1):
            assert cv2.connectedComponents((merged == region).astype(np.uint8), connectivity=8)[0] == 2
        for cell in range(named.max() + 1):
            assert len(np.unique(merged[named == cell])) == 1  # cells are never cut
        results.append(merged)
    pairs = np.unique(np.stack([r.ravel() for r in results]), axis=1)
    assert pairs.shape[1] == results[0].max() + 1 == results[1].max() + 1  # the same partition
