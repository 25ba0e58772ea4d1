"""One embedding a region: the mean of its views' embeddings, weighted by its pixels in each view (paper: phi_bar)."""

from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Int, UInt8

from jsecon.errors import require
from jsecon.types import Regions


def region_embeddings(
    frames: UInt8[np.ndarray, "t h w 3"],
    labels: Int[np.ndarray, "t _ _"],
    embed: Callable[[np.ndarray, np.ndarray], np.ndarray],
    *,
    weighting: Literal["pixels", "uniform"] = "pixels",
    num_regions: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Regions:
    """Embeddings of the regions of a labelled sequence.

    frames (T, H, W, 3) uint8; labels (T, H, W) integers, -1 = none; `embed` is Embedder.embed_regions: (H, W, 3) and
    masks (M, H, W) -> (M, E) unit. phi_bar_r = sum_t omega_t phi_rt with omega_t = pixels of r in t / pixels of r in
    all views ("pixels"), or 1 / number of views of r ("uniform"); then scaled to unit length, since only cosines are
    used afterwards. A view whose embedding is zero (nothing to embed) does not count; a region without any view is
    zero.

    Returns Regions with R = `num_regions`, or the largest label + 1. Raises ValueError for shapes that disagree, a
    label beyond R, or an unknown weighting.
    """
    require(
        labels.shape == frames.shape[:3],
        "labels",
        got=labels.shape,
        expected=str(frames.shape[:3]),
        remedy="Give one label image a frame, of the frame's own size.",
    )
    require(
        weighting in ("pixels", "uniform"),
        "weighting",
        got=weighting,
        expected="'pixels' or 'uniform'",
        remedy="Use 'pixels', as the paper does.",
    )
    highest = int(labels.max(initial=-1))
    count = highest + 1 if num_regions is None else num_regions
    require(
        highest < count,
        "num_regions",
        got=f"label {highest} with num_regions={count}",
        expected="labels below num_regions",
        remedy="Raise num_regions, or leave it out.",
    )
    pixels = np.zeros((count, len(frames)), np.int32)
    total: np.ndarray | None = None
    for t, (frame, image) in enumerate(zip(frames, labels)):
        pixels[:, t] = np.bincount(image[image >= 0].reshape(-1), minlength=count)[:count]
        seen = np.flatnonzero(pixels[:, t])
        if len(seen):
            found = np.asarray(embed(frame, image[None] == seen[:, None, None]), np.float64)
            require(
                found.ndim == 2 and len(found) == len(seen),
                "embed",
                got=found.shape,
                expected=f"({len(seen)}, E)",
                remedy="An embedder returns one row a mask.",
            )
            total = np.zeros((count, found.shape[1])) if total is None else total
            weight = pixels[seen, t].astype(np.float64) if weighting == "pixels" else np.ones(len(seen))
            total[seen] += weight[:, None] * found
        if progress is not None:
            progress(t + 1, len(frames))
    if total is None:  # nothing is labelled: the embedder alone knows E
        total = np.zeros((count, np.asarray(embed(frames[0], np.zeros((1, *frames.shape[1:3]), bool))).shape[1]))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit = np.where(length > 0, total / np.where(length > 0, length, 1.0), 0.0)
    return Regions(embeddings=unit.astype(np.float32), pixels=pixels)
