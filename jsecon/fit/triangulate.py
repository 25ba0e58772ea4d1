"""Triangulates sparse points for a capture with poses but without points, from SIFT matches. Host code (OpenCV).

With known poses a match needs no robust estimation: its point must reproject within a few pixels in both views, in
front of both cameras, with enough parallax (Hartley and Zisserman, ch. 12). Features that matches connect over several
views become one point, that of the match with the largest parallax.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy import sparse  # loads csgraph on its first use

from jsecon.errors import InputError
from jsecon.types import Camera, Capture, Progress

MIN_POINTS = 50
"""Least number of points for a scene: with fewer the views do not overlap or have no texture."""


class Features(NamedTuple):
    """SIFT features of a frame."""

    rays: np.ndarray  # (F, 2) x / z and y / z in camera axes
    descriptors: np.ndarray  # (F, 128) float32, RootSIFT
    colors: np.ndarray  # (F, 3) uint8


def detect_features(frame: np.ndarray, camera: Camera) -> Features:
    """Detects the features of a frame (h, w, 3) uint8."""
    # OpenCV's default contrast threshold is 0.04; lower gives more points.
    sift = cv2.SIFT.create(nfeatures=6000, contrastThreshold=0.015)  # type: ignore[attr-defined]
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), None)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3), np.uint8))
    xy = np.array([k.pt for k in keypoints], np.float64)
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))  # Arandjelovic 2012
    height, width = frame.shape[:2]
    column, row = np.clip(np.rint(xy).astype(int), 0, [width - 1, height - 1]).T
    # OpenCV's pixel centres are integers.
    rays = (xy + 0.5 - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return Features(rays, descriptors.astype(np.float32), frame[row, column])


def _view_pairs(poses: np.ndarray) -> list[tuple[int, int]]:
    """Pairs each view with the six from other places that are nearest in place (in median spacings) and direction."""
    rotation = poses[:, :3, :3]
    centres = -np.einsum("tji,tj->ti", rotation, poses[:, :3, 3])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    apart = distance[distance > 0]
    spread = float(np.median(apart)) if apart.size else 1.0
    angle = np.arccos(np.clip(rotation[:, 2] @ rotation[:, 2].T, -1, 1))
    cost = distance / spread + angle + 1e9 * (distance < 1e-6 * spread)  # views of a panorama have no parallax
    nearest = np.argsort(cost, axis=1, kind="stable")[:, : min(6, len(rotation) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i in range(len(rotation)) for j in nearest[i]})


def match_features(a: Features, b: Features) -> np.ndarray:
    """Returns (M, 2) indices of mutual nearest descriptors that pass Lowe's ratio."""
    if len(a.rays) < 2 or len(b.rays) < 2:
        return np.zeros((0, 2), int)
    similarity = a.descriptors @ b.descriptors.T
    forward, backward = similarity.argmax(axis=1), similarity.argmax(axis=0)
    rows = np.arange(len(forward))
    best = similarity[rows, forward]
    similarity[rows, forward] = -1
    # Unit vectors: squared distance is 2 - 2 cos, so Lowe's ratio of distances, 0.85, compares these.
    keep = (backward[forward] == rows) & (1 - best < 0.85**2 * (1 - similarity.max(axis=1)))
    return np.stack([rows[keep], forward[keep]], axis=1)


def _triangulate_matches(pose_a, pose_b, rays_a, rays_b, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangulates the matches of two views.

    Args:
      pose_a: (4, 4) world to camera of the first view.
      pose_b: (4, 4) world to camera of the second view.
      rays_a: (M, 2) x / z and y / z in the first view.
      rays_b: (M, 2) x / z and y / z in the second view.
      focal: Focal length, px.

    Returns:
      Points (M, 3), world, and their parallax (M,) in radians; negative for those that do not fit the
      views: behind a camera, more than 2 px off, or with a parallax below 2 degrees.
    """
    homogeneous = cv2.triangulatePoints(pose_a[:3], pose_b[:3], rays_a.T, rays_b.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
        fits, directions = np.isfinite(points).all(axis=1), []
        for pose, rays in ((pose_a, rays_a), (pose_b, rays_b)):
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            error = focal * np.linalg.norm(seen[:, :2] / seen[:, 2:] - rays, axis=1)
            fits &= (seen[:, 2] > 0) & (error < 2)
            directions.append(seen @ pose[:3, :3] / np.linalg.norm(seen, axis=1, keepdims=True))
        parallax = np.arccos(np.clip((directions[0] * directions[1]).sum(axis=1), -1, 1))
    return points, np.where(fits & (parallax > np.deg2rad(2)), parallax, -1.0)


def triangulated_points(capture: Capture, *, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Triangulates sparse points from the training frames. Deterministic.

    Args:
      capture: Frames and poses.
      progress: Called with the number of frames and pairs done and of all.

    Returns:
      Points (P, 3) float32, world, and their colours (P, 3) uint8; an InputError for fewer than MIN_POINTS.
    """
    used = np.flatnonzero(~np.asarray(capture.held_out))
    cameras = capture.cameras[used]
    poses = np.asarray(cameras.world_to_camera, np.float64)
    pairs = _view_pairs(poses)
    total = len(used) + len(pairs)
    report = progress or (lambda done, total: None)
    features = []
    for n, t in enumerate(used):
        features.append(detect_features(np.ascontiguousarray(capture.frames[t]), cameras[n]))
        report(n + 1, total)
    first = np.cumsum([0, *(len(f.rays) for f in features)])
    edges, points, parallax = [np.zeros((0, 2), int)], [np.zeros((0, 3))], [np.zeros(0)]
    for n, (i, j) in enumerate(pairs):
        matches = match_features(features[i], features[j])
        if len(matches):
            rays = features[i].rays[matches[:, 0]], features[j].rays[matches[:, 1]]
            of_pair, angle = _triangulate_matches(poses[i], poses[j], *rays, float(cameras.fx[i]))
            edges.append(matches[angle > 0] + first[[i, j]])
            points.append(of_pair[angle > 0])
            parallax.append(angle[angle > 0])
        report(len(used) + n + 1, total)
    edge, point, angle = (np.concatenate(parts) for parts in (edges, points, parallax))
    graph = sparse.coo_array((np.ones(len(edge), bool), tuple(edge.T)), shape=(first[-1], first[-1]))
    tracks: Any = sparse.csgraph.connected_components(graph, directed=False)[1]
    track = tracks[edge[:, 0]]
    widest = np.lexsort((-angle, track))
    widest = widest[np.unique(track[widest], return_index=True)[1]]
    if len(widest) < MIN_POINTS:
        problem = f"feature matching gives {len(widest)} points from {len(used)} views"
        remedy = "Use views that overlap and have texture, with correct poses, or pass points or --gaussians."
        raise InputError("capture", problem, f"at least {MIN_POINTS}", remedy)
    ends: Any = edge[widest]
    colors = np.concatenate([f.colors for f in features])[ends]
    return point[widest].astype(np.float32), np.rint(colors.mean(axis=1)).astype(np.uint8)
