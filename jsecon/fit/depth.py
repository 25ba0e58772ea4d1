"""Points from depth frames: back-projected, and subsampled to one a voxel."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, require
from jsecon.types import Array, Capture


class DepthPoints(NamedTuple):
    """Back-projected depth after voxel subsampling: one point per voxel, and which pixels fell into it."""

    points: np.ndarray
    """(P, 3) float32 mean of the voxel's samples, world."""
    colors: np.ndarray
    """(P, 3) uint8 mean colour of the voxel's samples."""
    counts: np.ndarray
    """(P,) int32 samples in the voxel."""
    voxel: float
    """edge of a voxel, world units."""
    sample_pixels: np.ndarray
    """(S, 3) int32 frame, row, column of each sample."""
    sample_points: np.ndarray
    """(S,) int32 the point that the sample belongs to."""


def require_depths(capture: Capture) -> None:
    if capture.depths is None:
        raise InputError(
            "capture",
            "no depth frames",
            "RGB-D frames",
            "Start from sparse points (gaussians_from_points) or triangulate them.",
        )


def back_projected(capture: Capture, frame: int, stride: int):
    """World points (S, 3), colours (S, 3) and pixels (S, 2) of the frame's known depths, every `stride` pixels."""
    camera = capture.cameras[frame]
    assert capture.depths is not None
    depth = np.asarray(capture.depths[frame], np.float64)[::stride, ::stride]
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[rows, columns]
    rows, columns = rows * stride, columns * stride
    x = (columns + 0.5 - float(camera.cx)) / float(camera.fx) * z
    y = (rows + 0.5 - float(camera.cy)) / float(camera.fy) * z
    pose = np.asarray(camera.world_to_camera, np.float64)
    world = (np.stack([x, y, z], axis=1) - pose[:3, 3]) @ pose[:3, :3]
    return world, np.asarray(capture.frames[frame])[rows, columns], np.stack([rows, columns], axis=1)


def _voxel_ids(points: np.ndarray, voxel: float) -> tuple[np.ndarray, int]:
    """(S,) id of each point's voxel in 0..P-1, and P."""
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    size = cells.max(axis=0) + 1
    require(
        float(size[0]) * float(size[1]) * float(size[2]) < 2**62,
        "voxel",
        voxel,
        f"large enough for the extent {np.ptp(points, axis=0)}",
        "Choose a larger voxel.",
    )
    keys = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    unique, ids = np.unique(keys, return_inverse=True)
    return ids.reshape(-1), len(unique)


def voxel_for(points: Float[Array, "s 3"], max_points: int) -> float:
    """The smallest voxel edge (to 2 %) that leaves at most `max_points` occupied voxels."""
    points = np.asarray(points, np.float64)
    high = float(np.max(np.ptp(points, axis=0))) * 1.001 + 1e-9
    low = high / 2**20
    while high / low > 1.02:
        middle = math.sqrt(low * high)
        if _voxel_ids(points, middle)[1] > max_points:
            low = middle
        else:
            high = middle
    return high


def points_from_depth(
    capture: Capture,
    *,
    voxel: float | None = None,
    max_points: int | None = None,
    stride: int = 1,
    frames: Int[np.ndarray, " f"] | None = None,
) -> DepthPoints:
    """Back-projects the known depths and keeps the mean of each occupied voxel.

    Give the voxel's edge in world units, or `max_points` and the edge is found. Held-out
    frames are left out unless `frames` names them. `stride` takes every so many pixels in each direction. Raises
    InputError where the capture has no depth, ValueError where neither or both of `voxel` and `max_points` are given.
    """
    require(
        (voxel is None) != (max_points is None),
        "voxel, max_points",
        (voxel, max_points),
        "exactly one of the two",
        "Give voxel in world units, or max_points.",
    )
    require_depths(capture)
    chosen = np.flatnonzero(~np.asarray(capture.held_out)) if frames is None else np.asarray(frames)
    parts = [back_projected(capture, int(t), stride) for t in chosen]
    points = np.concatenate([p for p, _, _ in parts]) if parts else np.zeros((0, 3))
    if not len(points):
        raise InputError(
            "capture", "no pixel with a known depth", "depths above 0", "Check the depth frames' encoding and unit."
        )
    colors = np.concatenate([c for _, c, _ in parts])
    pixels = np.concatenate(
        [np.concatenate([np.full((len(p), 1), t), p], axis=1) for t, (_, _, p) in zip(chosen, parts, strict=True)]
    )
    if voxel is None:
        assert max_points is not None
        voxel = voxel_for(points, max_points)
    ids, count = _voxel_ids(points, voxel)
    counts = np.bincount(ids, minlength=count)
    mean = np.stack([np.bincount(ids, points[:, a], minlength=count) for a in range(3)], axis=1) / counts[:, None]
    color = np.stack([np.bincount(ids, colors[:, a], minlength=count) for a in range(3)], axis=1) / counts[:, None]
    return DepthPoints(
        mean.astype(np.float32),
        np.rint(color).astype(np.uint8),
        counts.astype(np.int32),
        float(voxel),
        pixels.astype(np.int32),
        ids.astype(np.int32),
    )
