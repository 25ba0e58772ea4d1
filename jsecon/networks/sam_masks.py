"""The filters of SAM's masks: stability, repetitions by box, small holes and islands, LangSplat's suppression.

The steps are those of facebookresearch/segment-anything (automatic_mask_generator.py) and of minghanqin/LangSplat
(preprocess.py). Host functions on NumPy arrays.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy import sparse

from jsecon.errors import require


def stability(logits: Float[np.ndarray, "h w"], offset: float) -> float:
    """Returns the IoU of the masks of logits at +offset and -offset; 0 if the wider one is empty."""
    wide_area = int(np.count_nonzero(logits > -offset))
    return int(np.count_nonzero(logits > offset)) / wide_area if wide_area else 0.0


def box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """Finds the outermost pixels (left, top, right, bottom) of a mask, all within it; zeros if it is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])) if len(rows) else (0, 0, 0, 0)


def box_nms(
    boxes: Float[np.ndarray, "m 4"], scores: Float[np.ndarray, " m"], threshold: float
) -> Int64[np.ndarray, " k"]:
    """Returns the indices of the boxes that have no higher IoU than `threshold` with a better one, best score first.

    Areas are (right - left) * (bottom - top) of the coordinates as they are; a box without area overlaps no other. Of
    equal scores the earlier goes first.
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


def remove_small_regions(mask: Bool[np.ndarray, "h w"], least: int) -> tuple[Bool[np.ndarray, "h w"], bool]:
    """Fills the holes of a mask below `least` px, then removes such islands (8-connected).

    Returns the mask, and whether it changed. If every island is small, the largest stays.
    """
    holes, areas = _components(~mask)
    small = np.flatnonzero(areas < least)
    filled = mask | np.isin(holes, small + 1) if len(small) else mask
    islands, areas = _components(filled)
    kept = np.flatnonzero(areas >= least)
    if len(areas) and not len(kept):
        kept = np.array([areas.argmax()])
    clean = np.isin(islands, kept + 1) if len(kept) < len(areas) else filled
    return clean, bool(len(small)) or len(kept) < len(areas)


def _components(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, Float64[np.ndarray, " n"]]:
    """Labels (H, W), 0 outside, 1.. for the N components, and their areas."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return labels, stats[1:, cv2.CC_STAT_AREA].astype(np.float64)


def langsplat_nms(masks: Bool[np.ndarray, "m h w"], scores: Float[np.ndarray, " _"]) -> Int64[np.ndarray, " k"]:
    """Returns the indices of the masks that LangSplat's suppression keeps, best score first.

    A mask is kept if its score (stability times predicted IoU) is above 0.7, no better mask has an IoU above 0.8 with
    it, and it lies inside of no other: at least 0.85 of it in a mask of which that is less than half, with (share of
    it) * (share of the other) below 0.5. A mask that is itself dropped still suppresses. Of equal scores the earlier
    counts as better. Empty masks are dropped.
    """
    require(len(scores) == len(masks), "scores", len(scores), str(len(masks)), "One score per mask.")
    order = np.argsort(-scores, kind="stable")
    rows = sparse.csr_matrix(masks[order].reshape(len(masks), masks.shape[1] * masks.shape[2])).astype(np.int32)
    shared = (rows @ rows.T).toarray().astype(np.float64)  # px that any two masks share
    area = np.diagonal(shared)
    union = area[:, None] + area[None, :] - shared
    overlap = np.triu(shared / np.maximum(union, 1.0), k=1)
    share = shared / np.maximum(area[:, None], 1.0)  # [i, j]: share of mask i that lies in mask j
    inside = (share.T >= 0.85) & (share < 0.5)  # [i, j]: j lies in i, and is less than half of it
    inner = np.where(inside, 1.0 - share * share.T, 0.0)
    kept = (
        (overlap.max(0, initial=0.0) <= 0.8) & (scores[order] > 0.7) & (inner.max(0, initial=0.0) <= 0.5) & (area > 0)
    )
    return order[kept]
