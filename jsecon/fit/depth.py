"""Points from depth frames: back-projection, then one point per voxel. Host code (NumPy)."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError, require
from jsecon.types import Array, Capture


class DepthPoints(NamedTuple):
    """Point cloud after voxel subsampling, and which pixels fell into each voxel."""

    points: np.ndarray
    """(P, 3) float32 mean of the voxel's samples, world."""
    colors: np.ndarray
    """(P, 3) uint8 mean colour of the voxel's samples."""
    voxel: float
    """edge of a voxel, world units."""
    sample_pixels: np.ndarray
    """(S, 3) int32 frame, row, column of each sample."""
    sample_points: np.ndarray
    """(S,) int32 the point that the sample belongs to."""


def back_project_frame(capture: Capture, frame: int, stride: int):
    """Back-projects the known depths of one frame, of every `stride`-th pixel in each direction.

    Returns:
      World points (S, 3) float64, their colours (S, 3) uint8 and pixels (S, 2) row, column.
    """
    camera = capture.cameras[frame]
    if capture.depths is None:
        raise InputError("capture", "no depth frames", "RGB-D frames", "Use sparse points, or triangulate points.")
    depth = np.asarray(capture.depths[frame], np.float64)[::stride, ::stride]
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[rows, columns]
    rows, columns = rows * stride, columns * stride
    x = (columns + 0.5 - float(camera.cx)) / float(camera.fx) * z
    y = (rows + 0.5 - float(camera.cy)) / float(camera.fy) * z
    pose = np.asarray(camera.world_to_camera, np.float64)
    world = (np.stack([x, y, z], axis=1) - pose[:3, 3]) @ pose[:3, :3]
    return world, np.asarray(capture.frames[frame])[rows, columns], np.stack([rows, columns], axis=1)


def _voxel_ids(points: np.ndarray, voxel: float) -> np.ndarray:
    """(S,) voxel of each point, numbered 0 .. P-1 without gaps."""
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    size, expected = cells.max(axis=0) + 1, f"large enough for the extent {np.ptp(points, axis=0)}"
    require(math.prod(map(float, size)) < 2**62, "voxel", voxel, expected, "Choose a larger voxel.")
    return np.unique(np.ravel_multi_index(tuple(cells.T), tuple(size)), return_inverse=True)[1]


def _voxel_for(points: Float[Array, "s 3"], max_points: int) -> float:
    """Finds the smallest voxel edge (to 2 %) that leaves at most `max_points` voxels of the points (S, 3) occupied."""
    points = np.asarray(points, np.float64)
    high = float(np.max(np.ptp(points, axis=0))) * 1.001 + 1e-9
    low = high / 2**20
    while high / low > 1.02:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if _voxel_ids(points, middle).max() >= max_points else (low, middle)
    return high


def points_from_depth(
    capture: Capture, *, voxel: float = 0.0, max_points: int | None = None, stride: int = 1
) -> DepthPoints:
    """Back-projects the known depths of the training frames and averages them in voxels.

    Args:
      capture: Capture with depth; without one, an InputError says what to do.
      voxel: Edge of a voxel, world units.
      max_points: Maximum number of points. If `voxel` is 0 or gives more, the smallest edge that gives so few is used.
      stride: Uses every so many pixels in each direction.
    """
    require(voxel > 0 or max_points is not None, "voxel", voxel, "above 0", "Give it, or max_points.")
    chosen = np.flatnonzero(~np.asarray(capture.held_out))
    parts = [back_project_frame(capture, int(t), stride) for t in chosen]
    if not any(len(world) for world, _, _ in parts):
        raise InputError("capture", "no pixel with a known depth", "depths above 0", "Check their encoding and unit.")
    points, colors, pixels = (np.concatenate(columns) for columns in zip(*parts))
    frame = np.repeat(chosen, [len(world) for world, _, _ in parts])
    if max_points is not None and (not voxel or _voxel_ids(points, voxel).max() >= max_points):
        voxel = _voxel_for(points, max_points)
    ids = _voxel_ids(points, voxel)
    counts = np.bincount(ids)
    mean, color = (np.stack([np.bincount(ids, a) for a in v.T], axis=1) / counts[:, None] for v in (points, colors))
    return DepthPoints(
        mean.astype(np.float32),
        np.rint(color).astype(np.uint8),
        float(voxel),
        np.column_stack([frame, pixels]).astype(np.int32),
        ids.astype(np.int32),
    )
