"""Resizing as image models were trained with: separable, and with the kernel widened where an image shrinks.

OpenCV has no such cubic, and its area mode is another kernel; a network sees the difference. Pixels of uint8 images
come out as Pillow's, to the bit (its sums are fixed-point numbers of 22 bits, rounded after each of the two passes, the
horizontal one first); float images as those of PyTorch's `interpolate(antialias=True)`. Both centre a pixel at +0.5
and drop what lies outside.
"""

import functools
import math
from typing import Literal

import numpy as np
from scipy import sparse

from jsecon.errors import require

Kernel = Literal["bilinear", "bicubic"]

_FIXED_POINT = 2.0**22
_REACH = {"bilinear": 1.0, "bicubic": 2.0}
"""of the kernel, in input pixels, where the image does not shrink"""


def resample(image: np.ndarray, size: tuple[int, int], *, kernel: Kernel = "bilinear") -> np.ndarray:
    """image (H, W) or (H, W, C), uint8 or float32 -> the same at `size` (height, width), same dtype.

    Raises ValueError for another dtype or rank, or an empty image or size.
    """
    require(
        image.ndim in (2, 3) and image.dtype in (np.uint8, np.float32) and 0 not in (*image.shape, *size),
        "image",
        got=(image.shape, image.dtype, size),
        expected="(H, W) or (H, W, C), uint8 or float32, and a size above 0",
        remedy="Convert it first.",
    )
    return _along(_along(image, 1, size[1], kernel), 0, size[0], kernel)


def _along(image: np.ndarray, axis: int, length: int, kernel: Kernel) -> np.ndarray:
    if image.shape[axis] == length:
        return image
    matrix = _weights(image.shape[axis], length, kernel, image.dtype == np.uint8)
    moved = np.moveaxis(image, axis, 0)
    flat = moved.reshape(len(moved), -1).astype(matrix.dtype)
    result = matrix @ flat
    if image.dtype == np.uint8:
        result = np.clip(np.floor((result + _FIXED_POINT / 2) / _FIXED_POINT), 0, 255)
    return np.moveaxis(result.astype(image.dtype).reshape(length, *moved.shape[1:]), 0, axis)


@functools.lru_cache(maxsize=32)
def _weights(count: int, length: int, kernel: Kernel, fixed_point: bool) -> sparse.csr_matrix:
    """(length, count) weights, rows of sum 1; multiplied by 2^22 and rounded for `fixed_point`."""
    scale = count / length
    stretch = max(scale, 1.0)
    reach = _REACH[kernel] * stretch
    rows, columns, values = [], [], []
    for row in range(length):
        centre = (row + 0.5) * scale
        first, last = max(int(centre - reach + 0.5), 0), min(int(centre + reach + 0.5), count)
        taps = [_kernel(kernel, (k + 0.5 - centre) / stretch) for k in range(first, last)]
        total = math.fsum(taps)
        rows += [row] * len(taps)
        columns += range(first, last)
        values += [tap / total for tap in taps]
    weights = np.asarray(values)
    if fixed_point:
        weights = np.copysign(np.floor(np.abs(weights) * _FIXED_POINT + 0.5), weights)
    dtype = np.float64 if fixed_point else np.float32  # float64 holds the integer sums exactly
    return sparse.csr_matrix((weights.astype(dtype), (rows, columns)), shape=(length, count))


def _kernel(kernel: Kernel, x: float) -> float:
    """Triangle, or Keys' cubic with a = -1/2."""
    x = abs(x)
    if kernel == "bilinear":
        return max(1.0 - x, 0.0)
    if x < 1:
        return (1.5 * x - 2.5) * x * x + 1
    return ((-0.5 * x + 2.5) * x - 4) * x + 2 if x < 2 else 0.0
