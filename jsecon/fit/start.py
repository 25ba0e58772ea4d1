"""Initial scene of a fit, from points of the capture. Host code (NumPy).

Depth frames are back-projected, and become one point per voxel.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from jsecon.errors import InputError, require
from jsecon.fit.triangulate import MIN_POINTS, triangulated_points
from jsecon.splat.points import back_project, gaussians_from_points, voxel_means
from jsecon.types import Capture, Gaussians, Progress

FEW_POINTS = 300
"""Sparse points of a capture for a megapixel of its frames, below which points of matches join them: structure from
motion of panoramas keeps few."""
ENOUGH_POINTS = 1000, 10_000
"""Points for a megapixel, and in all, up to which pixels at the depth of their neighbours join those. A made-up room of
bare walls without points has 30.4 dB after 400 steps, 22.8 without these."""
NEIGHBOURS = 5
"""Known points nearest to a pixel, the median of whose depths it takes."""


class _DepthPoints(NamedTuple):
    """Point cloud after voxel subsampling."""

    points: np.ndarray
    """(P, 3) float32 mean of the voxel's samples, world."""
    colors: np.ndarray
    """(P, 3) uint8 mean colour of the voxel's samples."""
    voxel: float
    """edge of a voxel, world units."""


def points_from_depth(
    capture: Capture, *, voxel: float = 0.0, max_points: int | None = None, stride: int = 1
) -> _DepthPoints:
    """Back-projects the known depths of the training frames and averages them in voxels.

    Args:
      capture: Capture with depth; without one, an InputError says what to do.
      voxel: Edge of a voxel, world units.
      max_points: Maximum number of points. If `voxel` is 0 or gives more, the smallest edge that gives so few is used.
      stride: Uses every so many pixels in each direction.
    """
    require(voxel > 0 or max_points is not None, "voxel", voxel, "above 0", "Give it, or max_points.")
    if capture.depths is None:
        raise InputError("capture", "no depth frames", "RGB-D frames", "Use sparse points, or triangulate points.")
    parts = []
    for t in np.flatnonzero(~np.asarray(capture.held_out)).tolist():
        depth = np.asarray(capture.depths[t], np.float64)[::stride, ::stride]
        known = np.isfinite(depth) & (depth > 0)
        pixels = np.argwhere(known) * stride
        world = back_project(capture.cameras[t], pixels, depth[known])
        parts.append((world, np.asarray(capture.frames[t])[*pixels.T]))
    if not any(len(world) for world, _ in parts):
        raise InputError("capture", "no pixel with a known depth", "depths above 0", "Check their encoding and unit.")
    points, colors = (np.concatenate(columns) for columns in zip(*parts))
    means, colors, voxel = voxel_means(points, colors, max_points, voxel)
    return _DepthPoints(means.astype(np.float32), colors, voxel)


def _points_between(capture: Capture, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Makes points of pixels of the training frames, drawn at random, at the depth of the known points nearest to them.

    Surfaces without texture have no points of their own, but often the depth of what lies around them.

    Returns:
      At most `count` points (P, 3) float32 and their colours (P, 3) uint8: none of frames that show too few points, and
      none of ignored pixels.
    """
    rng, train = np.random.default_rng(0), np.flatnonzero(~np.asarray(capture.held_out))
    height, width = np.shape(capture.frames)[1:3]
    found = [(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))]
    for t, number in zip(train, np.bincount(np.arange(count) % len(train), minlength=len(train))):
        camera, pose = capture.cameras[int(t)], np.asarray(capture.cameras.world_to_camera[t], np.float64)
        focal, centre = np.array([camera.fx, camera.fy], np.float64), np.array([camera.cx, camera.cy], np.float64)
        seen = points @ pose[:3, :3].T + pose[:3, 3]
        seen = seen[seen[:, 2] > 0]
        at = seen[:, :2] / seen[:, 2:] * focal + centre
        near = (np.abs(at / (width, height) - 0.5) < 1).all(1)  # half of a frame around it, too
        pixels = rng.integers(0, (height, width), (number, 2))
        if capture.ignored is not None:
            pixels = pixels[~np.asarray(capture.ignored[t])[*pixels.T]]
        if near.sum() < NEIGHBOURS:
            continue
        nearest = KDTree(at[near]).query(pixels[:, ::-1] + 0.5, NEIGHBOURS)[1]
        world = back_project(camera, pixels, np.median(seen[near, 2][nearest], axis=1))
        found.append((world.astype(np.float32), np.asarray(capture.frames[t])[*pixels.T]))
    world, colors = (np.concatenate(columns) for columns in zip(*found))
    return world, colors


def starting_gaussians(
    capture: Capture,
    *,
    sh_degree: int = 0,
    max_points: int = 100_000,
    progress: Progress | None = None,
) -> tuple[Gaussians, str]:
    """Makes the Gaussians that a fit of `capture` starts from, and a clause on where they come from.

    Points come from depth frames where there are any, else from the capture's sparse points. Where these are few,
    others are triangulated from the training frames, and put between all of these (`_points_between`).

    The scale (in units of the distance to the neighbours) is smaller and the opacity larger than INRIA's 1 and 0.1.
    Measured with the same number of steps: the demo room (seed 0, 400 steps) has 32.6 dB held out with opacity 0.8 and
    scale 0.6, 31.0 dB with 0.1 and 1, and half the error of the rendered depth; fox (216x384, 500 steps) 25.8 and
    25.4 dB.

    Args:
      capture: Frames, poses, and depth or sparse points.
      sh_degree: Degree of the spherical harmonics, 0 to 3.
      max_points: Maximum number of points from depth frames.
      progress: Called with the number of frames and pairs triangulated and of all.
    """
    count, megapixels = len(capture.points), np.prod(np.shape(capture.frames)[:3]) / 1e6
    if capture.depths is not None:
        cloud = points_from_depth(capture, max_points=max_points, stride=2)
        gaussians = gaussians_from_points(
            cloud.points, cloud.colors, opacity=0.9, scale=0.5, max_scale=2 * cloud.voxel, sh_degree=sh_degree
        )
        origin = f"{len(cloud.points)} points from the depth frames, one per voxel of {cloud.voxel:.3g} world units"
        return gaussians, origin
    points, colors, origin = capture.points, capture.point_colors, f"{count} sparse points of the capture"
    if count < max(MIN_POINTS, FEW_POINTS * megapixels):
        few = f"only {count} points" if count else "no points"
        try:
            found = triangulated_points(capture, progress=progress)
            points, colors = (np.concatenate(pair) for pair in zip((points, colors), found))
            origin = (
                f"the capture has {few}: {len(found[0])} points triangulated from feature matches between its views"
            )
        except InputError:  # no more can be had
            if count < MIN_POINTS:
                raise
        enough = min(round(ENOUGH_POINTS[0] * megapixels), ENOUGH_POINTS[1])
        more = _points_between(capture, np.asarray(points), max(0, enough - len(points)))
        points, colors = (np.concatenate(pair) for pair in zip((points, colors), more))
        origin += f"; {len(more[0])} put between them" if len(more[0]) else ""
    return gaussians_from_points(points, colors, opacity=0.7, scale=0.6, sh_degree=sh_degree), origin
