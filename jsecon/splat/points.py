"""Points of pixels, points thinned by voxels, and Gaussians made from points. Host code (NumPy)."""

import math

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree

from jsecon.errors import require
from jsecon.process import cores
from jsecon.splat.sh import C0
from jsecon.types import Array, Camera, Gaussians

_MIN_SQUARED_DISTANCE = 1e-7
"""Least squared distance to the neighbours, world units^2 (INRIA): duplicate points get a scale too."""


def back_project(camera: Camera, pixels: np.ndarray, depth: np.ndarray | float) -> np.ndarray:
    """World points (S, 3) float64 of pixels (S, 2) row, column of one camera, at depths (S,)."""
    rows, columns = pixels.T
    x = (columns + 0.5 - float(camera.cx)) / float(camera.fx) * depth
    y = (rows + 0.5 - float(camera.cy)) / float(camera.fy) * depth
    pose = np.asarray(camera.world_to_camera, np.float64)
    return (np.stack([x, y, np.broadcast_to(depth, x.shape)], axis=1) - pose[:3, 3]) @ pose[:3, :3]


def _voxel_keys(points: np.ndarray, voxel: float) -> np.ndarray:
    """(S,) a number for the voxel of each point."""
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    size, expected = cells.max(axis=0) + 1, f"large enough for the extent {np.ptp(points, axis=0)}"
    require(math.prod(map(float, size)) < 2**62, "voxel", voxel, expected, "Choose a larger voxel.")
    return np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(size)))


def _voxel_for(points: Float[Array, "s 3"], max_points: int) -> float:
    """Finds the smallest voxel edge (to 2 %) that leaves at most `max_points` voxels of the points (S, 3) occupied."""
    points = np.asarray(points, np.float64)
    sample = points[:: max(len(points) // (5 * max_points), 1)]  # which lies in nearly as many voxels
    high = float(np.max(np.ptp(points, axis=0))) * 1.001 + 1e-9
    low = high / 2**20
    while high / low > 1.02:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if len(np.unique(_voxel_keys(sample, middle))) > max_points else (low, middle)
    while len(sample) < len(points) and len(np.unique(_voxel_keys(points, high))) > max_points:
        high *= 1.02
    return high


def voxel_means(
    points: Float[np.ndarray, "s 3"], colors: UInt8[np.ndarray, "s 3"], max_points: int | None, voxel: float = 0.0
) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"], float]:
    """Averages points and their colours in voxels of an edge, or of the smallest that leaves at most `max_points`.

    Also returns the edge.
    """
    if max_points is not None and (not voxel or len(np.unique(_voxel_keys(points, voxel))) > max_points):
        voxel = _voxel_for(points, max_points)
    ids = np.unique(_voxel_keys(points, voxel), return_inverse=True)[1]
    counts = np.bincount(ids)[:, None]
    means, mean_colors = (
        np.stack([np.bincount(ids, a) for a in column.T], axis=1) / counts for column in (points, colors)
    )
    return means, np.rint(mean_colors).astype(np.uint8), float(voxel)


def _neighbour_distances(points: Float[Array, "p 3"]) -> Float[np.ndarray, " p"]:
    """Computes the RMS distance to the three nearest neighbours (simple-knn of graphdeco-inria), fewer if there are.

    A single point gets the minimum.
    """
    points = np.asarray(points, np.float64)
    count = len(points)
    others = min(3, count - 1)
    if others < 1:
        return np.full(count, math.sqrt(_MIN_SQUARED_DISTANCE))
    distances, _ = KDTree(points).query(points, k=others + 1, workers=cores())
    return np.sqrt(np.maximum(np.mean(distances[:, 1:] ** 2, axis=1), _MIN_SQUARED_DISTANCE))


def gaussians_from_points(
    points: Float[Array, "p 3"],
    colors: UInt8[Array, "p 3"],
    *,
    opacity: float = 0.1,
    scale: float = 1.0,
    max_scale: float | None = None,
    sh_degree: int = 0,
) -> Gaussians:
    """Makes one round Gaussian per point (Kerbl et al. 2023, section 5.1).

    Args:
      points: (P, 3) centres, world units.
      colors: (P, 3) uint8 RGB, the same from all directions.
      opacity: Opacity of all Gaussians, in (0, 1).
      scale: Standard deviation in units of `_neighbour_distances`.
      max_scale: Largest standard deviation, world units.
      sh_degree: Degree of the spherical harmonics, 0 to 3.
    """
    points, colors = np.asarray(points), np.asarray(colors)
    require(len(points) > 0, "points", 0, "at least one", "Triangulate points from the frames (fit.triangulate).")
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    require(not bad, "points", f"{bad} with a coordinate that is not finite", "finite coordinates", "Drop them first.")
    deviations = scale * _neighbour_distances(points)
    if max_scale is not None:
        deviations = np.minimum(deviations, max_scale)
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colors.astype(np.float64) / 255.0 - 0.5) / C0
    return Gaussians(
        means=points.astype(np.float32),
        log_scales=np.repeat(np.log(deviations)[:, None], 3, axis=1).astype(np.float32),
        quaternions=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1)),
        opacity_logits=np.full(count, math.log(opacity / (1 - opacity)), np.float32),
        sh=sh,
    )


def nearest_gaussians(points: Float[np.ndarray, "p 3"], gaussians: Gaussians) -> Int[np.ndarray, " p"]:
    """Finds the Gaussian that each point belongs to: the nearest, or -1 beyond three times its size, or the median."""
    sizes = np.exp(np.asarray(gaussians.log_scales, np.float64).max(axis=1))
    reach, known = 3 * np.maximum(sizes, np.median(sizes)), np.all(np.isfinite(points), axis=1)
    tree = KDTree(np.asarray(gaussians.means))
    distances, nearest = tree.query(np.where(known[:, None], points, 0), workers=cores())
    return np.where(known & (distances <= reach[nearest]), nearest, -1)
