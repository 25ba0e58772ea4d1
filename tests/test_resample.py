"""Resizing: against Pillow's pixels, and against a slow twin."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.vision.resample import resample

IMAGE = np.array([[0, 37, 74, 111, 148], [185, 222, 3, 40, 77], [114, 151, 188, 225, 6], [43, 80, 117, 154, 191]])

# Image.fromarray(IMAGE.astype(uint8)).resize((width, height), ...) of Pillow 12.0.0; 11.3.0 and 10.4.0 give the same.
PILLOW = {
    ("bilinear", 3, 7): [
        [55, 76, 81, 53, 79, 106, 127],
        [150, 171, 161, 96, 122, 94, 42],
        [64, 85, 112, 138, 164, 158, 136],
    ],
    ("bicubic", 3, 7): [
        [49, 73, 79, 46, 69, 108, 137],
        [156, 186, 173, 96, 128, 91, 30],
        [54, 74, 108, 145, 177, 167, 141],
    ],
    ("bilinear", 6, 2): [[37, 111], [95, 82], [152, 67], [151, 129], [116, 149], [80, 154]],
    ("bicubic", 6, 2): [[24, 121], [90, 77], [164, 52], [160, 128], [112, 156], [70, 160]],
}


def twin(line, length, kernel):
    """One line of float64 pixels, the definition written as sums."""
    scale = len(line) / length
    stretch = max(scale, 1.0)
    result = []
    for n in range(length):
        weights = np.array([kernel((k + 0.5 - (n + 0.5) * scale) / stretch) for k in range(len(line))])
        result.append((weights * line).sum() / weights.sum())
    return np.array(result)


def triangle(x):
    return max(0.0, 1 - abs(x))


def cubic(x):
    x = abs(x)
    if x < 1:
        return 1.5 * x**3 - 2.5 * x**2 + 1
    return -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2 if x < 2 else 0.0


@pytest.mark.parametrize(("kernel", "rows", "columns"), PILLOW)
def test_bytes_are_pillows(kernel, rows, columns):
    found = resample(IMAGE.astype(np.uint8), (rows, columns), kernel=kernel)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, PILLOW[kernel, rows, columns])


@settings(max_examples=15, deadline=None)
@given(st.tuples(*[st.integers(1, 23)] * 4), st.sampled_from(["bilinear", "bicubic"]))
def test_floats_equal_the_slow_twin(sizes, kernel):
    height, width, rows, columns = sizes
    image = np.random.default_rng(0).normal(size=(height, width, 2)).astype(np.float32)
    weight = {"bilinear": triangle, "bicubic": cubic}[kernel]
    wanted = np.apply_along_axis(twin, 1, image.astype(np.float64), columns, weight)
    wanted = np.apply_along_axis(twin, 0, wanted, rows, weight)
    np.testing.assert_allclose(resample(image, (rows, columns), kernel=kernel), wanted, atol=2e-5)


def test_a_flat_image_stays_flat_and_its_own_size_is_kept():
    flat = np.full((7, 9, 3), 201, np.uint8)
    assert (resample(flat, (64, 5), kernel="bicubic") == 201).all()
    image = np.random.default_rng(1).integers(0, 256, (7, 9), dtype=np.uint8)
    np.testing.assert_array_equal(resample(image, (7, 9)), image)


@pytest.mark.parametrize("image", [np.zeros((3, 3), np.int64), np.zeros(3, np.uint8), np.zeros((0, 3), np.uint8)])
def test_another_type_or_rank_is_refused(image):
    with pytest.raises(ValueError, match="Convert it first"):
        resample(image, (2, 2))
