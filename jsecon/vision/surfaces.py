"""Surfaces of a frame from depth: the position and the normal of each pixel, smoothed over many views. Host code.

A single depth frame is too noisy, or quantised too coarsely, for normals. The joint cloud of all frames is not: each of
its points gets the normal of its neighbourhood, and each pixel the normal of the nearest point.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Shaped
from scipy.spatial import KDTree

from jsecon.types import Camera


def smooth_depth(depth: Float32[np.ndarray, "h w"]) -> np.ndarray:
    """Removes noise from rendered z-depth and keeps its jumps: a median, then bilateral filters of its logarithm.

    Args:
      depth: (H, W), 0 = unknown.

    Returns:
      (H, W) with unknown pixels filled from the nearest known one; unchanged if all are unknown.
    """
    known = np.asarray(depth > 0)
    if not known.any():
        return depth
    logarithm = cv2.medianBlur(log_depth(depth)[..., 0], 5)
    for _ in range(3):
        logarithm = cv2.bilateralFilter(logarithm, 9, 0.06, 4)  # steps up to 6 % are noise
    return np.exp(logarithm)


def log_depth(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 1"]:
    """Computes the logarithm of z-depth.

    Args:
      depth: (H, W), 0 = unknown.

    Returns:
      (H, W, 1) float32; unknown pixels are filled from the nearest known one, with 0 if there is none.
    """
    known = np.asarray(depth > 0)
    depth = fill_nearest(depth, known) if known.any() else np.ones_like(depth)
    return np.log(np.maximum(depth, 1e-12))[..., None].astype(np.float32)


def fill_nearest(values: Shaped[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """Fills unknown pixels from the nearest known one.

    Args:
      values: (H, W).
      known: (H, W) bool, true somewhere.

    Returns:
      (H, W) values.
    """
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, np.int64)
    table = np.zeros(int(nearest.max()) + 1, values.dtype)
    table[nearest[known]] = values[known]
    return table[nearest]


NEIGHBOURS = 24
"""Number of points that the normal of a point is fitted to."""
_ROUNDS = 4
_SHARPNESS = 0.1
"""Scale of 1 - cosine: neighbours whose normals differ more do not smooth each other."""


class Surface(NamedTuple):
    """Surfaces of a frame."""

    points: np.ndarray
    """(H, W, 3) float32 in camera axes, world units."""
    normals: np.ndarray
    """(H, W, 3) float32 unit, towards the camera."""

    def off_plane(self, axis: int, near: Int[np.ndarray, " n"], far: Int[np.ndarray, " n"]) -> Float[np.ndarray, "_ _"]:
        """Computes the distance of pixels from each other's planes, 0 along any plane however steeply it is seen.

        Args:
          axis: Image axis of the indices.
          near: Indices of the first pixels.
          far: Indices of the second pixels.

        Returns:
          The smaller of both distances, as a share of the smaller z.
        """
        a, b = np.take(self.points, near, axis), np.take(self.points, far, axis)
        off = [np.abs(np.einsum("...k,...k", b - a, np.take(self.normals, which, axis))) for which in (near, far)]
        return np.minimum(*off) / np.maximum(np.minimum(a[..., 2], b[..., 2]), 1e-6)


def cloud_normals(points: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
    """Estimates the normals of a point cloud.

    A normal is the direction of least spread of the nearest points. Rounds of averaging weigh neighbours by agreement,
    which keeps creases sharp (a bilateral filter).

    Args:
      points: (P, 3) surface points, P >= 3.

    Returns:
      (P, 3) unit normals of either sign.
    """
    points = np.asarray(points, np.float64)
    near = np.asarray(KDTree(points).query(points, k=min(NEIGHBOURS, len(points)), workers=-1)[1])
    normals = np.empty_like(points)
    for part in np.array_split(np.arange(len(points)), len(points) // 65536 + 1):
        spread = points[near[part]] - points[near[part]].mean(1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("pki,pkj->pij", spread, spread))[1][:, :, 0]
    for _ in range(_ROUNDS):
        cosines = np.einsum("pki,pi->pk", normals[near], normals)
        weights = np.sign(cosines) * np.exp((np.abs(cosines) - 1.0) / _SHARPNESS)
        normals = np.einsum("pk,pki->pi", weights, normals[near])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


def surfaces_from_depth(
    depths: Float[np.ndarray, "t h w"], cameras: Camera, points: Float[np.ndarray, "p 3"]
) -> Callable[[int], Surface | None]:
    """Makes a function from the index of a frame to its surface.

    Args:
      depths: (T, H, W) z-depth, 0 = unknown; smoothed and filled by `smooth_depth`.
      cameras: Batch of T cameras.
      points: (P, 3) points of all frames together, world, thinned (a few centimetres apart in a room).

    Returns:
      The function; it returns None for a frame without depth.
    """
    tree, normals = KDTree(points), cloud_normals(points)
    poses = np.asarray(cameras.world_to_camera, np.float64)

    def surface_of(t: int) -> Surface | None:
        if not (depths[t] > 0).any():
            return None
        rotation, camera = poses[t, :3, :3], cameras[t]
        here = _camera_points(smooth_depth(np.asarray(depths[t], np.float32)), camera)
        # Normals change slowly: every second pixel in each direction is enough.
        sampled = here[::2, ::2].reshape(-1, 3)
        normal = normals[tree.query((sampled - poses[t, :3, 3]) @ rotation, workers=-1)[1]] @ rotation.T
        normal = normal.reshape(*here[::2, ::2].shape).repeat(2, 0).repeat(2, 1)[: here.shape[0], : here.shape[1]]
        away = np.einsum("hwk,hwk->hw", normal, here) > 0
        return Surface(here.astype(np.float32), np.where(away[..., None], -normal, normal).astype(np.float32))

    return surface_of


def _camera_points(depth: Float32[np.ndarray, "h w"], camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Back-projects z-depth (H, W) to points (H, W, 3) in camera axes; pixel centres lie at halves."""
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    x = (columns - float(camera.cx)) / float(camera.fx)
    y = (rows - float(camera.cy)) / float(camera.fy)
    return np.stack([x, y, np.ones_like(x)], -1) * depth[..., None].astype(np.float64)
