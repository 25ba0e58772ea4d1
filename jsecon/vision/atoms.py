"""Atoms: small regions of one frame, cut along its edges and its proposals, in which votes and masks are counted."""

from typing import Any, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from scipy import sparse

Sparse: TypeAlias = Any
"""scipy.sparse.csr_matrix, of which type checkers know too little"""
SMALLEST = 12
"""px: smaller pieces are taken for slivers along an edge"""


def image_atoms(
    frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"], *, count: int, smallest: int = SMALLEST
) -> Int32[np.ndarray, "h w"]:
    """About `count` superpixels (SLICO, Achanta et al. 2012) of a frame, cut by the masks' outlines.

    frame (H, W, 3) uint8, masks (M, H, W) bool -> (H, W) int32 labels 0 .. A-1; pieces under `smallest` pixels go to
    the nearest other piece.
    """
    lab = cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2LAB)
    size = max(round(float(np.sqrt(frame.shape[0] * frame.shape[1] / count))), 4)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLICO, size)
    slic.iterate(6)
    pieces = np.asarray(slic.getLabels(), np.int64)
    for mask in masks:
        pieces = np.unique(pieces * 2 + mask, return_inverse=True)[1].reshape(mask.shape)
    areas = np.bincount(pieces.reshape(-1))
    small = areas[pieces] < smallest
    if small.any() and not small.all():
        _, nearest = cv2.distanceTransformWithLabels(
            small.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        nearest = np.asarray(nearest, np.int64)
        table = np.zeros(int(nearest.max()) + 1, np.int64)
        table[nearest[~small]] = pieces[~small]
        pieces = np.where(small, table[nearest], pieces)
    return np.unique(pieces, return_inverse=True)[1].reshape(pieces.shape).astype(np.int32)


def coverage(
    atoms: Int32[np.ndarray, "h w"], masks: Bool[np.ndarray, "m h w"], count: int
) -> Float32[np.ndarray, "m a"]:
    """(M, A) float32 share of each atom's pixels that lie in each mask."""
    area = np.bincount(atoms.reshape(-1), minlength=count)
    inside = [np.bincount(atoms[mask], minlength=count) for mask in masks]
    return (np.asarray(inside, np.float32).reshape(len(masks), count) / np.maximum(area, 1)).astype(np.float32)


def label_shares(atoms: np.ndarray, labels: np.ndarray, rows: int, columns: int) -> Sparse:
    """(A, R) float32 share of each atom's pixels that carry each label."""
    inside = labels >= 0
    weights = 1.0 / np.bincount(atoms.reshape(-1), minlength=rows)[atoms[inside]]
    return sparse.csr_matrix((weights.astype(np.float32), (atoms[inside], labels[inside])), shape=(rows, columns))
