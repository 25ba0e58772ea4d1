"""Surfaces of a frame from depth: the position and the normal of each pixel, smoothed over many views. Host code.

A single depth frame is too noisy, or quantised too coarsely, for normals. The joint cloud of all frames is not: each of
its points gets the normal of its neighbourhood, and each pixel the normal of the nearest point.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Shaped
from scipy.spatial import KDTree

from jsecon.types import Camera


def _smooth_depth(depth: Float32[np.ndarray, "h w"]) -> np.ndarray:
    """Removes noise from z-depth and keeps its jumps: a median, then bilateral filters of its logarithm.

    Unknown pixels (0) are filled from the nearest known one; depth that is unknown everywhere stays so.
    """
    known = np.asarray(depth > 0)
    if not known.any():
        return depth
    logarithm = np.log(np.maximum(fill_nearest(depth, known), 1e-12)).astype(np.float32)
    logarithm = cv2.medianBlur(logarithm, 5)
    for _ in range(3):
        logarithm = cv2.bilateralFilter(logarithm, 9, 0.06, 4)  # steps up to 6 % are noise
    return np.exp(logarithm)


def fill_nearest(values: Shaped[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """Fills unknown pixels from the nearest known one; there must be one."""
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, np.int64)
    table = np.zeros(int(nearest.max()) + 1, values.dtype)
    table[nearest[known]] = values[known]
    return table[nearest]


class Surface(NamedTuple):
    """Surfaces of a frame."""

    points: np.ndarray
    """(H, W, 3) float32 in camera axes, world units."""
    normals: np.ndarray
    """(H, W, 3) float32 unit, towards the camera."""


def _cloud_normals(points: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
    """Estimates the normals of a cloud of at least three points, unit vectors of either sign.

    A normal is the direction of least spread of the nearest points. Rounds of averaging weigh neighbours by agreement,
    which keeps creases sharp (a bilateral filter).
    """
    points = np.asarray(points, np.float64)
    near = np.asarray(KDTree(points).query(points, k=min(24, len(points)), workers=-1)[1])
    normals = np.empty_like(points)
    for part in np.array_split(np.arange(len(points)), len(points) // 65536 + 1):
        spread = points[near[part]] - points[near[part]].mean(1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("pki,pkj->pij", spread, spread))[1][:, :, 0]
    for _ in range(4):
        cosines = np.einsum("pki,pi->pk", normals[near], normals)
        weights = np.sign(cosines) * np.exp((np.abs(cosines) - 1.0) / 0.1)
        normals = np.einsum("pk,pki->pi", weights, normals[near])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


def surfaces_from_depth(
    depths: Float[np.ndarray, "t h w"], cameras: Camera, points: Float[np.ndarray, "p 3"]
) -> Callable[[int], Surface | None]:
    """Makes a function from the index of a frame to its surface; None for a frame without depth.

    Args:
      depths: z-depth, 0 = unknown.
      cameras: Batch of T cameras.
      points: Points of all frames together, world, thinned (a few centimetres apart in a room).
    """
    tree, normals = KDTree(points), _cloud_normals(points)
    poses = np.asarray(cameras.world_to_camera, np.float64)

    def surface_of(t: int) -> Surface | None:
        if not (depths[t] > 0).any():
            return None
        rotation, camera = poses[t, :3, :3], cameras[t]
        local_points = _camera_points(_smooth_depth(np.asarray(depths[t], np.float32)), camera)
        # Normals change slowly: every second pixel in each direction is enough.
        sampled = local_points[::2, ::2]
        nearest = tree.query((sampled.reshape(-1, 3) - poses[t, :3, 3]) @ rotation, workers=-1)[1]
        normal = (normals[nearest] @ rotation.T).reshape(sampled.shape).repeat(2, 0).repeat(2, 1)
        normal = normal[: camera.height, : camera.width]
        away = np.einsum("hwk,hwk->hw", normal, local_points) > 0
        return Surface(local_points.astype(np.float32), np.where(away[..., None], -normal, normal).astype(np.float32))

    return surface_of


def _camera_points(depth: Float32[np.ndarray, "h w"], camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Back-projects z-depth (H, W) to points (H, W, 3) in camera axes; pixel centres lie at halves."""
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    x = (columns - float(camera.cx)) / float(camera.fx)
    y = (rows - float(camera.cy)) / float(camera.fy)
    return np.stack([x, y, np.ones_like(x)], -1) * depth[..., None].astype(np.float64)
