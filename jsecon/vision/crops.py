"""Masked crops of a frame, as LangSplat hands them to CLIP (REFERENCE B.3)."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from jsecon.errors import require


def masked_crop(
    frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], size: int
) -> UInt8[np.ndarray, "size size 3"]:
    """One region of a frame (H, W, 3), black outside of `mask` (H, W), in the middle of a black square of `size` px.

    The crop is SAM's box with LangSplat's rule for its extent, largest minus smallest coordinate: the last row and
    column are lost, unless the region has no other. Resized bilinearly. Raises ValueError for an empty mask or other
    shapes.
    """
    require(
        mask.shape == frame.shape[:2] and bool(mask.any()),
        "mask",
        got=f"{mask.shape}, {int(mask.sum())} pixels",
        expected=f"{frame.shape[:2]}, at least one pixel",
        remedy="Leave out empty masks.",
    )
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    height, width = max(int(rows[-1] - rows[0]), 1), max(int(columns[-1] - columns[0]), 1)
    box = slice(rows[0], rows[0] + height), slice(columns[0], columns[0] + width)
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    square = np.zeros((side, side, 3), np.uint8)
    square[top : top + height, left : left + width] = frame[box] * mask[box][..., None]
    return np.asarray(cv2.resize(square, (size, size)), np.uint8)
