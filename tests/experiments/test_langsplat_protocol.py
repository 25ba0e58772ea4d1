"""LangSplat's 2D protocol against an independent reading of its description, loop by loop; denominators; empty maps."""

import numpy as np
import pytest

from experiments.protocols.langsplat_2d import decide, evaluate_langsplat_2d, majority, pixel_relevancy
from jsecon.data.lerf_labels import LabelledFrame
from jsecon.errors import InputError


def read_again(maps, threshold):
    """LangSplat's eval/evaluate_iou_loc.py in plain NumPy: windows cut out of a padded image, votes counted pixel by
    pixel."""
    levels, height, width = maps.shape
    mean = np.zeros_like(maps)
    for level, image in enumerate(maps):
        padded = np.pad(image, ((15, 14), (15, 14)), mode="reflect")
        for i in range(height):
            for j in range(width):
                mean[level, i, j] = padded[i : i + 30, j : j + 30].sum() / 900
    mixed = (maps + mean) / 2
    level = max(range(levels), key=lambda k: mixed[k].max())
    image = mixed[level]
    image = (image - image.min()) / (image.max() - image.min() + 1e-9)
    on = np.clip(image * 2 - 1, 0, 1) > threshold
    voted = np.zeros_like(on)
    for i in range(height):
        for j in range(width):
            square = on[max(0, i - 3) : min(i + 4, height - 1), max(0, j - 3) : min(j + 4, width - 1)]
            voted[i, j] = np.bincount(square.reshape(-1).astype(int), minlength=2).argmax()
    best = mean[max(range(levels), key=lambda k: mean[k].max())]
    return voted, level, best > best.max() - 1e-6


def random_maps(rng, height, width):
    """Relevancy-like: blobs of several sizes over noise, three levels."""
    y, x = np.mgrid[:height, :width]
    maps = 0.5 + 0.05 * rng.normal(size=(3, height, width))
    for image in maps:
        for _ in range(rng.integers(1, 4)):
            size, centre = rng.uniform(2, 12), rng.uniform(0, [height, width])
            image += rng.uniform(0.1, 0.4) * np.exp(-((y - centre[0]) ** 2 + (x - centre[1]) ** 2) / (2 * size**2))
    return maps


def test_same_decisions_on_200_random_maps():
    rng = np.random.default_rng(0)
    sizes = set()
    for _ in range(200):
        height, width = rng.integers(28, 34, 2)
        maps, threshold = random_maps(rng, height, width), rng.choice([0.3, 0.4, 0.5])
        mask, level, peak = read_again(maps, threshold)
        found = decide(maps, threshold=threshold)
        assert found.level == level
        np.testing.assert_array_equal(found.mask, mask)
        np.testing.assert_array_equal(found.peak, peak)
        sizes.add((level, bool(mask.any())))
    assert {level for level, _ in sizes} == {0, 1, 2}


def test_votes_leave_out_the_last_row_and_column():
    mask = np.zeros((20, 20), bool)
    mask[-1] = mask[:, -1] = True
    assert not majority(mask).any()
    assert majority(np.ones((20, 20), bool)).all()
    half = np.zeros((20, 20), bool)
    half[:, :10] = True
    np.testing.assert_array_equal(majority(half)[5], np.arange(20) < 10)


def test_relevancy_is_the_least_over_the_phrases():
    rng = np.random.default_rng(1)
    features, text, canonical = rng.normal(size=(5, 6, 8)), rng.normal(size=8), rng.normal(size=(4, 8))
    features[0, 0] = 0
    found = pixel_relevancy(features, text, canonical)
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        positive, negative = unit(features) @ unit(text), unit(features) @ unit(canonical).T
    expected = 1 / (1 + np.exp(-10 * (positive - negative.max(-1))))
    np.testing.assert_allclose(found.reshape(-1)[1:], expected.reshape(-1)[1:], rtol=1e-4)
    assert found[0, 0] == 0.5


def test_pixels_where_nothing_was_rendered_do_not_widen_the_range():
    """A text a little nearer to its object than to the rest is found, whatever hole is in the image."""
    text, canonical = np.array([1.0, 0, 0]), np.array([[0.0, 1, 0]])
    features = np.tile(np.array([0.695, 0.719, 0.0]), (90, 100, 1))
    features[20:70, 30:80] = [0.719, 0.695, 0.0]
    whole = decide(pixel_relevancy(features, text, canonical)[None]).mask
    features[80:, 90:] = 0
    holed = decide(pixel_relevancy(features, text, canonical)[None]).mask
    assert whole[25:65, 35:75].all()
    assert not whole[:10].any()
    assert not whole[80:].any()
    np.testing.assert_array_equal(holed[:70], whole[:70])


def test_pairs_are_counted_whatever_is_missing():
    mask = np.zeros((90, 100), bool)
    mask[20:70, 30:80] = True
    box = np.array([[30, 20, 79, 69]], np.float32)
    nothing = np.zeros((90, 100), bool)
    frame = LabelledFrame("f", 100, 90, {"a": (mask, box), "b": (mask, box), "empty": (nothing, np.zeros((0, 4)))})
    maps = {"a": np.where(mask, 0.9, 0.1)[None], "b": None, "empty": np.where(mask, 0.9, 0.1)[None]}
    rows, told = evaluate_langsplat_2d([frame], lambda _, query: maps[query], expected_pairs=3)
    assert [row.iou > 0.8 for row in rows] == [True, False, False]
    assert [row.located for row in rows] == [True, False, False]
    assert (told["pairs"], told["missing"]) == (3, 1)
    assert told["miou"] == pytest.approx(rows[0].iou / 3)
    assert told["loc_acc"] == pytest.approx(1 / 3)
    with pytest.raises(InputError, match=r"3 \(frame, query\) pairs, expected 56"):
        evaluate_langsplat_2d([frame], lambda *_: None, expected_pairs=56)
