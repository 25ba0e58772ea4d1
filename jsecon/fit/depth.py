"""Points from depth frames: back-projection, then one point per voxel. Host code (NumPy)."""

from typing import NamedTuple

import numpy as np

from jsecon.errors import InputError, require
from jsecon.splat.points import voxel_for, voxel_ids, voxel_means
from jsecon.types import Capture


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
    if max_points is not None and (not voxel or voxel_ids(points, voxel).max() >= max_points):
        voxel = voxel_for(points, max_points)
    ids = voxel_ids(points, voxel)
    mean, color = voxel_means(ids, points, colors)
    return DepthPoints(
        mean.astype(np.float32),
        np.rint(color).astype(np.uint8),
        float(voxel),
        np.column_stack([frame, pixels]).astype(np.int32),
        ids.astype(np.int32),
    )
