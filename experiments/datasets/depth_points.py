"""Depths that other views confirm, and the labels of back-projected points."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jsecon.fit.start import points_from_depth
from jsecon.splat.points import back_project
from jsecon.types import Array, Capture


class SampledPoints(NamedTuple):
    """The points of `points_from_depth`, and the pixels that each comes from."""

    points: np.ndarray
    """(P, 3) float32"""
    colors: np.ndarray
    """(P, 3) uint8"""
    pixels: np.ndarray
    """(S, 3) frame, row, column of each sample"""
    point_of: np.ndarray
    """(S,) its point"""


def sampled_points(capture: Capture, *, voxel: float, stride: int) -> SampledPoints:
    """The back-projected depths of the training frames, one point per voxel."""
    cloud, chosen = (
        points_from_depth(capture, voxel=voxel, stride=stride),
        np.flatnonzero(~np.asarray(capture.held_out)),
    )
    worlds, pixels = zip(*(_back_project_frame(capture, int(t), stride) for t in chosen))
    frame = np.repeat(chosen, [len(world) for world in worlds])
    pixels = np.column_stack([frame, np.concatenate(pixels)])
    samples = np.concatenate(worlds)
    cells = np.floor((samples - samples.min(axis=0)) / voxel).astype(np.int64)
    return SampledPoints(cloud.points, cloud.colors, pixels, np.unique(cells, axis=0, return_inverse=True)[1])


def _back_project_frame(capture: Capture, frame: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """World points (S, 3) of the known depths of a frame, and their pixels (S, 2) row, column."""
    depth = np.asarray(capture.depths[frame], np.float64)[::stride, ::stride]
    known = np.isfinite(depth) & (depth > 0)
    pixels = np.argwhere(known) * stride
    return back_project(capture.cameras[frame], pixels, depth[known]), pixels


def confirmed_depths(capture: Capture, *, tolerance: float, min_views: int) -> Float[np.ndarray, "t h w"]:
    """The depths without those that the other views do not confirm: sensor noise, and pixels that mix two surfaces.

    A depth stays where at least `min_views` other views measure the same point, to within `tolerance` (relative to
    their depth), and no more views look past it than do; everything else becomes 0, unknown. Only frames that are not
    held out are filtered and compared.
    """
    depths = np.array(capture.depths, np.float32)
    chosen = np.flatnonzero(~np.asarray(capture.held_out))
    height, width = depths.shape[1:]
    filtered = depths.copy()
    for t in chosen:
        world, pixels = _back_project_frame(capture, int(t), 1)
        same, past = np.zeros(len(world), np.int32), np.zeros(len(world), np.int32)
        for other in chosen[chosen != t]:
            camera = capture.cameras[int(other)]
            pose = np.asarray(camera.world_to_camera, np.float64)
            seen = world @ pose[:3, :3].T + pose[:3, 3]
            z = np.where(seen[:, 2] > 0, seen[:, 2], 1.0)
            x = float(camera.fx) * seen[:, 0] / z + float(camera.cx)
            y = float(camera.fy) * seen[:, 1] / z + float(camera.cy)
            inside = np.flatnonzero((seen[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            measured = depths[other, y[inside].astype(int), x[inside].astype(int)]
            off = np.where(measured > 0, (measured - z[inside]) / np.maximum(measured, 1e-9), np.nan)
            same[inside] += np.abs(off) <= tolerance
            past[inside] += off > tolerance
        bad = pixels[(same < min_views) | (past > same)]
        filtered[t, bad[:, 0], bad[:, 1]] = 0
    return filtered


def labels_of_points(points: SampledPoints, labels: Int[Array, "t h w"], num_labels: int) -> Int[np.ndarray, " p"]:
    """(P,) int32 the label that most of each point's pixels carry; -1 where none is labelled. Ties go to the
    smaller."""
    frame, row, column = points.pixels.T
    sample = np.asarray(labels)[frame, row, column].astype(np.int64)
    known = sample >= 0
    key = points.point_of[known].astype(np.int64) * num_labels + sample[known]
    pairs, counts = np.unique(key, return_counts=True)
    result = np.full(len(points.points), -1, np.int32)
    # Ascending by count, and within a count descending by label: the last assignment to a point is its winner.
    order = np.lexsort((-pairs, counts))
    result[pairs[order] // num_labels] = pairs[order] % num_labels
    return result
