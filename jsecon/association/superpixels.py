"""Atoms: superpixels of a frame, cut along its edges and its proposals, and the votes of Gaussians on them."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, UInt8
from scipy import sparse

from jsecon.field.view_votes import Sparse, view_votes
from jsecon.types import Camera, Gaussians
from jsecon.vision.region_graph import relabel_sequential
from jsecon.vision.surfaces import fill_nearest

MIN_ATOM_PX = 12
"""Least size in px; smaller pieces are slivers along an edge."""


def superpixels(
    frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"], *, count: int
) -> Int32[np.ndarray, "h w"]:
    """Segments a frame into superpixels (SLICO, Achanta et al. 2012) that are cut along the outlines of masks.

    Args:
      frame: (H, W, 3) uint8 RGB.
      masks: (M, H, W) bool.
      count: Approximate number of superpixels before the cut.

    Returns:
      (H, W) int32 labels 0 .. A-1; pieces below MIN_ATOM_PX pixels join the nearest other piece.
    """
    lab = cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2LAB)
    size = max(round(float(np.sqrt(frame.shape[0] * frame.shape[1] / count))), 4)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLICO, size)
    slic.iterate(6)
    pieces = np.asarray(slic.getLabels(), np.int64)
    for eight in np.packbits(masks, axis=0):
        pieces = relabel_sequential(pieces * 256 + eight)
    large = np.bincount(pieces.reshape(-1))[pieces] >= MIN_ATOM_PX
    if large.any() and not large.all():
        pieces = fill_nearest(pieces, large)
    return relabel_sequential(pieces).astype(np.int32)


def superpixel_coverage(
    atoms: Int32[np.ndarray, "h w"], masks: Bool[np.ndarray, "m h w"], count: int
) -> Float32[np.ndarray, "m a"]:
    """Computes how far atoms lie in masks.

    Args:
      atoms: (H, W) int32 atoms 0 .. A-1.
      masks: (M, H, W) bool.
      count: A.

    Returns:
      (M, A) float32 share of the pixels of each atom that lie in each mask.
    """
    area = np.bincount(atoms.reshape(-1), minlength=count)
    inside = [np.bincount(atoms[mask], minlength=count) for mask in masks]
    return (np.asarray(inside, np.float32).reshape(len(masks), count) / np.maximum(area, 1)).astype(np.float32)


def sum_entries(entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]], shape: tuple[int, int]) -> Sparse:
    """Builds a sparse matrix; repeated entries are added up.

    Args:
      entries: Parts of values, rows and columns.
      shape: Shape of the matrix.

    Returns:
      Sparse matrix.
    """
    values, rows, columns = (np.concatenate(parts) for parts in zip(*entries))
    return sparse.csr_matrix((values, (rows, columns)), shape=shape)


def one_hot(labels: Int[np.ndarray, " a"], count: int) -> Sparse:
    """Encodes labels.

    Args:
      labels: (A,) labels, -1 for no region.
      count: C, number of labels.

    Returns:
      Sparse matrix (A, C) of float32 ones.
    """
    rows = np.flatnonzero(labels >= 0)
    return sparse.csr_matrix((np.ones(len(rows), np.float32), (rows, labels[rows])), shape=(len(labels), count))


def superpixel_votes(
    gaussians: Gaussians,
    camera: Camera,
    atoms: Int32[np.ndarray, "h w"],
    *,
    negligible: float = 0.005,
    centre: float = 0.0,
) -> Sparse:
    """Adds up the rendering weights alpha T of each Gaussian on each atom of one view. Host code.

    Args:
      gaussians: Scene of N Gaussians.
      camera: Camera of the view.
      atoms: (H, W) int32 atoms 0 .. A-1.
      negligible: Share of the total of a Gaussian up to which entries are removed.
      centre: In [0, 1], weight of a Gaussian's centre against its footprint, see `region_votes`.

    Returns:
      Sparse matrix (N, A).
    """
    votes = view_votes(gaussians, camera, atoms, int(atoms.max()) + 1, centre=centre).weights[:, :-1]
    total = np.repeat(np.asarray(votes.sum(1)).ravel(), np.diff(votes.indptr))
    votes.data[votes.data <= negligible * total] = 0.0
    votes.eliminate_zeros()
    return votes
