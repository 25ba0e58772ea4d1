"""What depth says about a frame's surfaces: where each pixel lies, and the normal there, smooth because many views made
it.

A single depth frame is too noisy, or too coarsely stored, for normals. All frames' points together are not: each point
of the joint cloud gets the normal of its neighbourhood, and each pixel that of the point nearest to where it lies.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Shaped
from scipy.spatial import KDTree

from jsecon.types import Camera


def smooth_depth(depth: Float32[np.ndarray, "h w"], *, noise: float = 0.06, rounds: int = 3) -> np.ndarray:
    """z-depth (H, W), 0 = unknown, as Gaussians render it -> the same without what is noise (relative steps below about
    `noise`), its jumps kept: a median, then bilateral filters on its logarithm. Unknown pixels are filled from the
    nearest known one; all 0 stays so."""
    known = np.asarray(depth > 0)
    if not known.any():
        return depth
    logarithm = cv2.medianBlur(log_depth(depth)[..., 0], 5)
    for _ in range(rounds):
        logarithm = cv2.bilateralFilter(logarithm, 9, noise, 4)
    return np.exp(logarithm)


def log_depth(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 1"]:
    """Natural logarithm of z-depth (H, W), 0 = unknown, filled from the nearest known pixel; 0 where none is known."""
    known = np.asarray(depth > 0)
    depth = fill_nearest(depth, known) if known.any() else np.ones_like(depth)
    return np.log(np.maximum(depth, 1e-12))[..., None].astype(np.float32)


def fill_nearest(values: Shaped[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """values (H, W) with those of the unknown pixels taken from the nearest known one."""
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, np.int64)
    table = np.zeros(int(nearest.max()) + 1, values.dtype)
    table[nearest[known]] = values[known]
    return table[nearest]


NEIGHBOURS = 24
"""points whose plane is a point's own"""
_ROUNDS = 4
_SHARPNESS = 0.1
"""of 1 - cosine: neighbours whose normals differ more do not smooth each other"""


class Surface(NamedTuple):
    """A frame's surfaces."""

    points: np.ndarray
    """(H, W, 3) float32 in the camera's axes, world units."""
    normals: np.ndarray
    """(H, W, 3) float32 unit, towards the camera."""

    def off_plane(self, axis: int, near: Int[np.ndarray, " n"], far: Int[np.ndarray, " n"]) -> Float[np.ndarray, "_ _"]:
        """How far pixels `far` along an axis lie off the plane of the pixels `near` and the other way round, the
        smaller of the two, as a share of the nearer one's z: 0 along any plane, however steeply it is seen."""
        a, b = np.take(self.points, near, axis), np.take(self.points, far, axis)
        off = [np.abs(np.einsum("...k,...k", b - a, np.take(self.normals, which, axis))) for which in (near, far)]
        return np.minimum(*off) / np.maximum(np.minimum(a[..., 2], b[..., 2]), 1e-6)


def cloud_normals(points: Float[np.ndarray, "p 3"], *, neighbours: int = NEIGHBOURS) -> Float64[np.ndarray, "p 3"]:
    """Unit normals (P, 3), of either sign, of a cloud of surface points (P, 3), P >= 3.

    The direction in which the `neighbours` nearest points spread least; then, some rounds over, the mean of the
    neighbours' normals, each weighted by how well it agrees, which leaves creases sharp (a bilateral filter).
    """
    points = np.asarray(points, np.float64)
    near = np.asarray(KDTree(points).query(points, k=min(neighbours, len(points)), workers=-1)[1])
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
    """A function of a frame's index: its surface from depths (T, H, W), 0 = unknown, of `cameras` (a batch of T).

    points (P, 3), world: those of all frames together, thinned (a few centimetres apart in a room). The depth is
    steadied (`smooth_depth`), which also fills what is unknown. None for a frame without any depth.
    """
    tree, normals = KDTree(points), cloud_normals(points)
    poses = np.asarray(cameras.world_to_camera, np.float64)

    def surface_of(t: int) -> Surface | None:
        if not (depths[t] > 0).any():
            return None
        rotation, camera = poses[t, :3, :3], cameras[t]
        here = camera_points(smooth_depth(np.asarray(depths[t], np.float32)), camera)
        # Normals change slowly: every second pixel is asked, in each direction.
        asked = here[::2, ::2].reshape(-1, 3)
        own = normals[tree.query((asked - poses[t, :3, 3]) @ rotation, workers=-1)[1]] @ rotation.T
        own = own.reshape(*here[::2, ::2].shape).repeat(2, 0).repeat(2, 1)[: here.shape[0], : here.shape[1]]
        away = np.einsum("hwk,hwk->hw", own, here) > 0
        return Surface(here.astype(np.float32), np.where(away[..., None], -own, own).astype(np.float32))

    return surface_of


def camera_points(depth: Float32[np.ndarray, "h w"], camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """z-depth (H, W) -> points (H, W, 3) in the camera's axes; pixel centres lie at halves."""
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    x = (columns - float(camera.cx)) / float(camera.fx)
    y = (rows - float(camera.cy)) / float(camera.fy)
    return np.stack([x, y, np.ones_like(x)], -1) * depth[..., None].astype(np.float64)
