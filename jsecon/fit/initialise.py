"""Where Gaussians start: on sparse points, on back-projected depth, or on points triangulated from the frames
themselves."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree

from jsecon.errors import InputError, require
from jsecon.splat.sh import sh_from_rgb
from jsecon.types import Array, Capture, Gaussians

MIN_SQUARED_DISTANCE = 1e-7
"""floor under a squared neighbour distance, world units^2 (INRIA): duplicate points still get a scale"""


class DepthPoints(NamedTuple):
    """Back-projected depth after voxel subsampling: one point a voxel, and which pixels fell into it."""

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


def neighbour_distances(points: Float[Array, "p 3"], neighbours: int = 3) -> Float[np.ndarray, " p"]:
    """Root of the mean squared distance to the nearest other points, world units (REFERENCE A.5).

    With fewer than `neighbours` other points, the mean is over those there are; a lone point gets the floor.
    """
    points = np.asarray(points, np.float64)
    count = len(points)
    others = min(neighbours, count - 1)
    if others < 1:
        return np.full(count, math.sqrt(MIN_SQUARED_DISTANCE))
    distances, _ = cKDTree(points).query(points, k=others + 1, workers=-1)
    return np.sqrt(np.maximum(np.mean(distances[:, 1:] ** 2, axis=1), MIN_SQUARED_DISTANCE))


def gaussians_from_points(
    points: Float[Array, "p 3"],
    colors: UInt8[Array, "p 3"],
    *,
    opacity: float = 0.1,
    scale: float = 1.0,
    max_scale: float | None = None,
    sh_degree: int = 0,
    neighbours: int = 3,
) -> Gaussians:
    """One round Gaussian a point (Kerbl et al. 2023, section 5.1; REFERENCE A.5).

    The standard deviation is `scale` times `neighbour_distances`, at most `max_scale` world units; the colour is the
    point's in every direction; the rotation is the identity. Raises ValueError where there is no point, a coordinate
    is not finite, or an option is outside its range.
    """
    points, colors = np.asarray(points), np.asarray(colors)
    require(
        len(points) > 0,
        "points",
        got="none",
        expected="at least one point",
        remedy="Give points, or triangulate them from the frames (jsecon.fit.triangulate).",
    )
    require(
        bool(np.isfinite(points).all()),
        "points",
        got="a coordinate that is not finite",
        expected="finite coordinates",
        remedy="Drop such points first.",
    )
    require(0 < opacity < 1, "opacity", got=opacity, expected="between 0 and 1", remedy="0.1 is usual, 0.9 on depth.")
    require(scale > 0, "scale", got=scale, expected="positive", remedy="1 is usual.")
    require(sh_degree in (0, 1, 2, 3), "sh_degree", got=sh_degree, expected="0 to 3", remedy="0 is colour alone.")
    deviations = scale * neighbour_distances(points, neighbours)
    if max_scale is not None:
        deviations = np.minimum(deviations, max_scale)
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, :1] = sh_from_rgb(colors.astype(np.float64) / 255.0)
    return Gaussians(
        means=points.astype(np.float32),
        log_scales=np.repeat(np.log(deviations)[:, None], 3, axis=1).astype(np.float32),
        quaternions=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1)),
        opacity_logits=np.full(count, math.log(opacity / (1 - opacity)), np.float32),
        sh=sh,
    )


def _require_depths(capture: Capture) -> None:
    if capture.depths is None:
        raise InputError(
            "capture",
            found="no depth frames",
            expected="RGB-D frames",
            remedy="Start from sparse points (gaussians_from_points) or triangulate them.",
        )


def _back_projected(capture: Capture, frame: int, stride: int):
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
        got=voxel,
        expected=f"large enough for the extent {np.ptp(points, axis=0)}",
        remedy="Choose a larger voxel.",
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
        got=(voxel, max_points),
        expected="exactly one of the two",
        remedy="Give voxel in world units, or max_points.",
    )
    _require_depths(capture)
    chosen = np.flatnonzero(~np.asarray(capture.held_out)) if frames is None else np.asarray(frames)
    parts = [_back_projected(capture, int(t), stride) for t in chosen]
    points = np.concatenate([p for p, _, _ in parts]) if parts else np.zeros((0, 3))
    if not len(points):
        raise InputError(
            "capture",
            found="no pixel with a known depth",
            expected="depths above 0",
            remedy="Check the depth frames' encoding and unit.",
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


def confirmed_depths(
    capture: Capture,
    *,
    tolerance: float,
    min_views: int = 2,
    frames: Int[np.ndarray, " f"] | None = None,
) -> Float[np.ndarray, "t h w"]:
    """The depths without those that the other views do not bear out: sensor noise, and pixels that mix two surfaces.

    A depth stays where at least `min_views` other views measure the same point, to within `tolerance` (relative to
    their depth), and no more views look past it than do; everything else becomes 0, unknown. Only `frames` are filtered
    and asked (by default those that are not held out); the depths of the others are returned as they are. Raises
    InputError where the capture has no depth.
    """
    _require_depths(capture)
    depths = np.array(capture.depths, np.float32)
    chosen = np.flatnonzero(~np.asarray(capture.held_out)) if frames is None else np.asarray(frames)
    height, width = depths.shape[1:]
    filtered = depths.copy()
    for t in chosen:
        world, _, pixels = _back_projected(capture, int(t), 1)
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


def labels_of_points(points: DepthPoints, labels: Int[Array, "t h w"], num_labels: int) -> Int[np.ndarray, " p"]:
    """(P,) int32 the label that most of each point's pixels carry; -1 where none is labelled. Ties go to the
    smaller."""
    frame, row, column = points.sample_pixels.T
    sample = np.asarray(labels)[frame, row, column].astype(np.int64)
    known = sample >= 0
    key = points.sample_points[known].astype(np.int64) * num_labels + sample[known]
    pairs, counts = np.unique(key, return_counts=True)
    result = np.full(len(points.points), -1, np.int32)
    # Ascending by count, and within a count descending by label: the last assignment to a point is its winner.
    order = np.lexsort((-pairs, counts))
    result[pairs[order] // num_labels] = pairs[order] % num_labels
    return result
