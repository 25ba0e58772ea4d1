"""What SAM's automatic mask generator does with masks once they are predicted (facebookresearch/segment-anything,
automatic_mask_generator.py): their stability, boxes, suppression of boxes by boxes, and small holes and islands. All on
NumPy arrays.

LangSplat's suppression of masks by masks (minghanqin/LangSplat, preprocess.py) compares every pair of them pixel by
pixel. Here the areas that they share are one product of sparse matrices, whose cost per pixel is the square of the
masks on it instead of the square of all.

What SAM's automatic mask generator asks: a grid of points, over the frame and over crops of it.
"""

import itertools
import math
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy import sparse

from jsecon.errors import require


class Crop(NamedTuple):
    """A part of the frame, px, half open."""

    left: int
    top: int
    right: int
    bottom: int
    layer: int
    """0: the whole frame; k: one of 4^k."""

    @property
    def area(self) -> int:
        """px^2."""
        return (self.right - self.left) * (self.bottom - self.top)


def point_grid(side: int) -> Float32[np.ndarray, "p 2"]:
    """(side^2, 2) points (x, y) in 0..1, the centres of side x side cells, x fastest."""
    require(side >= 1, "side", side, "at least 1", "SAM's own is 32.")
    line = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2).astype(np.float32)


def crops_of(height: int, width: int, layers: int, overlap: float) -> list[Crop]:
    """The whole frame, then 2^k x 2^k crops of it for each layer k up to `layers`, column by column.

    Neighbours overlap by `overlap` of the frame's shorter side, times 2 / 2^k.
    """
    crops = [Crop(0, 0, width, height, 0)]
    for layer in range(1, layers + 1):
        number = 2**layer
        common = int(overlap * min(height, width) * 2 / number)
        long = [math.ceil((common * (number - 1) + length) / number) for length in (width, height)]
        starts = [[(size - common) * i for i in range(number)] for size in long]
        for left, top in itertools.product(*starts):
            crops.append(Crop(left, top, min(left + long[0], width), min(top + long[1], height), layer))
    return crops


def langsplat_nms(
    masks: Bool[np.ndarray, "m h w"],
    scores: Float[np.ndarray, " _"],
    *,
    iou_threshold: float = 0.8,
    score_threshold: float = 0.7,
    inner_threshold: float = 0.5,
) -> Int64[np.ndarray, " k"]:
    """Indices (K,) of the masks (M, H, W) that are kept, best score (stability times predicted IoU) first.

    A mask is kept if its score is above `score_threshold`, its IoU with every mask of a better score is at most
    `iou_threshold`, and it lies inside of no other: at least 0.85 of it within a mask of which that is less than half,
    with 1 - (share of it) * (share of the other) above 1 - `inner_threshold`. A mask that is itself dropped still
    suppresses. Of equal scores the earlier counts as better. Empty masks are dropped. Raises ValueError where the
    numbers of masks and scores differ.
    """
    require(len(scores) == len(masks), "scores", len(scores), str(len(masks)), "One score per mask.")
    order = np.argsort(-scores, kind="stable")
    shared = shared_areas(masks[order])
    area = np.diagonal(shared)
    union = area[:, None] + area[None, :] - shared
    overlap = np.triu(shared / np.maximum(union, 1.0), k=1)
    share = shared / np.maximum(area[:, None], 1.0)  # [i, j]: share of mask i that lies in mask j
    inside = (share.T >= 0.85) & (share < 0.5)  # [i, j]: j lies in i, and is less than half of it
    inner = np.where(inside, 1.0 - share * share.T, 0.0)
    kept = (
        (overlap.max(0, initial=0.0) <= iou_threshold)
        & (scores[order] > score_threshold)
        & (inner.max(0, initial=0.0) <= 1.0 - inner_threshold)
        & (area > 0)
    )
    return order[kept]


def shared_areas(masks: Bool[np.ndarray, "m h w"]) -> Float64[np.ndarray, "m m"]:
    """(M, M) pixels that any two masks (M, H, W) share; the diagonal holds their own areas."""
    flat = masks.reshape(len(masks), masks.shape[1] * masks.shape[2])
    columns = np.flatnonzero(flat) % max(flat.shape[1], 1)
    ends = np.concatenate([[0], np.cumsum(np.count_nonzero(flat, axis=1))])
    rows = sparse.csr_matrix((np.ones(len(columns), np.int32), columns, ends), shape=flat.shape)
    return (rows @ rows.T).toarray().astype(np.float64)


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
        kept = np.array([areas.argmax()])
    clean = np.isin(islands, kept + 1) if len(kept) < len(areas) else filled
    return clean, bool(len(small)) or len(kept) < len(areas)


def _components(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, Float64[np.ndarray, " n"]]:
    """Labels (H, W), 0 = outside, 1.. = the N components, and their areas."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return labels, stats[1:, cv2.CC_STAT_AREA].astype(np.float64)
