"""LangSplat's suppression of masks by masks (REFERENCE B.2), as one matrix product.

The definition compares every pair of masks pixel by pixel. Here the frame is first cut into atoms, the sets of pixels
that lie in exactly the same masks; the areas that any two masks share are then (membership * pixels of each atom) @
membership, a product over atoms instead of pixels, and exact.
"""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64

from jsecon.errors import require


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
    require(
        len(scores) == len(masks), "scores", got=len(scores), expected=str(len(masks)), remedy="Give one score a mask."
    )
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
    labels, membership = atoms_of_masks(masks)
    pixels = np.bincount(labels.reshape(-1), minlength=len(membership))
    # Sums of whole numbers below 2^24 are exact in float32.
    exact = np.float32 if labels.size < 1 << 24 else np.float64
    rows = membership.astype(exact)
    return ((rows * pixels.astype(exact)[:, None]).T @ rows).astype(np.float64)


def atoms_of_masks(masks: Bool[np.ndarray, "m h w"]) -> tuple[Int[np.ndarray, "h w"], Bool[np.ndarray, "a m"]]:
    """The frame's atoms: labels (H, W), 0 .. A-1, and membership (A, M), whether an atom lies in a mask.

    Built mask by mask: an atom that a mask cuts is split in two, one that it covers is marked. Atom 0 may be empty.
    """
    count, height, width = masks.shape
    labels = np.zeros(height * width, np.int32)
    pixels = np.asarray([height * width])
    membership = np.zeros((64, count), bool)
    for m in range(count):
        inside = np.flatnonzero(masks[m].reshape(-1))
        own = labels[inside]
        covered = np.bincount(own, minlength=len(pixels))
        cut = np.flatnonzero((covered > 0) & (covered < pixels))
        first = len(pixels)
        while first + len(cut) > len(membership):
            membership = np.concatenate([membership, np.zeros_like(membership)])
        membership[first : first + len(cut)] = membership[cut]
        table = np.arange(first, dtype=np.int32)
        table[cut] = np.arange(first, first + len(cut))
        labels[inside] = table[own]
        membership[table[covered > 0], m] = True
        pixels = np.concatenate([pixels - np.where(covered < pixels, covered, 0), covered[cut]])
    return labels.reshape(height, width), membership[: len(pixels)]
