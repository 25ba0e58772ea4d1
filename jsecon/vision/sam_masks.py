"""What SAM's automatic mask generator does with masks once they are predicted (REFERENCE B.1): their stability, boxes,
suppression of boxes by boxes, and small holes and islands. All on NumPy arrays."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from jsecon.vision.sam_prompts import Crop

EDGE = 20.0
"""px: a box this near to a crop's edge was probably cut off by it"""


def stability(logits: Float[np.ndarray, "h w"], offset: float) -> float:
    """IoU of the mask with a threshold of +offset and that with -offset; 0 where the wider one is empty."""
    wide = int(np.count_nonzero(logits > -offset))
    return int(np.count_nonzero(logits > offset)) / wide if wide else 0.0


def box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) px of a mask, its outermost pixels; zeros where it is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])) if len(rows) else (0, 0, 0, 0)


def cut_by_crop(box: tuple[int, int, int, int], crop: Crop, width: int, height: int) -> bool:
    """Whether a box in frame px lies within EDGE of an edge of its crop that is no edge of the frame."""
    pairs = zip(box, (crop.left, crop.top, crop.right, crop.bottom), (0, 0, width, height))
    return any(abs(side - own) <= EDGE and abs(side - frame) > EDGE for side, own, frame in pairs)


def box_nms(
    boxes: Float[np.ndarray, "m 4"], scores: Float[np.ndarray, " m"], threshold: float
) -> Int64[np.ndarray, " k"]:
    """Indices (K,) of the boxes (M, 4) left when each, best score first, drops all later ones of a higher IoU.

    Of equal scores the earlier goes first. Areas are those of the coordinates as they stand: (right - left) * (bottom -
    top); a box without area overlaps none.
    """
    order = np.argsort(-scores, kind="stable")
    boxes = boxes[order].astype(np.float64)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    alive = np.ones(len(boxes), bool)
    kept = []
    for i in range(len(boxes)):
        if alive[i]:
            kept.append(order[i])
            later = boxes[i + 1 :]
            sides = np.minimum(boxes[i, 2:], later[:, 2:]) - np.maximum(boxes[i, :2], later[:, :2])
            common = np.prod(np.maximum(sides, 0.0), axis=1)
            alive[i + 1 :] &= common <= threshold * (area[i] + area[i + 1 :] - common)
    return np.asarray(kept, np.int64)


def tidied(mask: Bool[np.ndarray, "h w"], least: int) -> tuple[Bool[np.ndarray, "h w"], bool]:
    """The mask without holes, then without islands, of fewer than `least` pixels (8-connected), and whether it changed.

    If every island is small, the largest stays.
    """
    holes, areas = _components(~mask)
    small = np.flatnonzero(areas < least)
    filled = mask | np.isin(holes, small + 1) if len(small) else mask
    islands, areas = _components(filled)
    kept = np.flatnonzero(areas >= least)
    if len(areas) and not len(kept):
        kept = areas.argmax()[None]
    clean = np.isin(islands, kept + 1) if len(kept) < len(areas) else filled
    return clean, bool(len(small)) or len(kept) < len(areas)


def _components(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, Float64[np.ndarray, " n"]]:
    """Labels (H, W), 0 = outside, 1.. = the N components, and their areas."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), 8)
    return labels, stats[1:, cv2.CC_STAT_AREA].astype(np.float64)
