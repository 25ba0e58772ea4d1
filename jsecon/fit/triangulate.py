"""Triangulates sparse points for a capture with poses but without points, from SIFT matches. Host code (NumPy).

With known poses a match needs no robust estimation: it must lie on its epipolar line, and a track of matches must
reproject within a few pixels from a point in front of every camera with enough parallax (Hartley and Zisserman, ch.
12).
"""

from typing import NamedTuple

import cv2
import numpy as np

from jsecon.errors import InputError
from jsecon.types import Capture, Progress

MIN_POINTS = 50
"""Least number of points for a scene: with fewer the views do not overlap or have no texture."""
NEIGHBOURS = 6
"""Number of views that each view is matched with."""
MAX_FEATURES = 6000
"""Maximum number of features per view."""
CONTRAST = 0.015
"""Contrast threshold of SIFT; OpenCV's default is 0.04, lower gives more points."""
RATIO = 0.85
"""Lowe's ratio of the distances to the nearest and the second nearest descriptor."""
MAX_ERROR_PX = 2.0
"""Largest distance to the epipolar line and largest reprojection error."""
MIN_ANGLE_DEG = 2.0
"""Least parallax."""


class _Features(NamedTuple):
    pixels: np.ndarray  # (F, 2) x, y in jsecon's convention (upper left corner of the image at 0, 0)
    descriptors: np.ndarray  # (F, 128) float32, RootSIFT
    colors: np.ndarray  # (F, 3) uint8


def _detect(frame: np.ndarray) -> _Features:
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, contrastThreshold=CONTRAST)  # type: ignore[attr-defined]
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), None)
    if not keypoints:
        return _Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3), np.uint8))
    xy = np.array([k.pt for k in keypoints], np.float64)
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))  # Arandjelovic 2012
    height, width = frame.shape[:2]
    column, row = np.clip(np.rint(xy).astype(int), 0, [width - 1, height - 1]).T
    # OpenCV's pixel centres are integers.
    return _Features(xy + 0.5, descriptors.astype(np.float32), frame[row, column])


def view_pairs(world_to_camera: np.ndarray, neighbours: int) -> list[tuple[int, int]]:
    """Pairs each view with the views nearest in place (in units of the median spacing) and direction.

    Args:
      world_to_camera: (T, 4, 4) poses.
      neighbours: Number of views that each view is paired with.

    Returns:
      Sorted pairs (i, j), i < j, without repetition.
    """
    rotation = world_to_camera[:, :3, :3]
    centres = -np.einsum("tji,tj->ti", rotation, world_to_camera[:, :3, 3])
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    apart = distance[distance > 0]
    spread = float(np.median(apart)) if apart.size else 1.0
    angle = np.arccos(np.clip(rotation[:, 2] @ rotation[:, 2].T, -1, 1))
    cost = distance / spread + angle + 1e9 * np.eye(len(rotation))
    nearest = np.argsort(cost, axis=1, kind="stable")[:, : min(neighbours, len(rotation) - 1)]
    return sorted({(min(i, int(j)), max(i, int(j))) for i in range(len(rotation)) for j in nearest[i]})


def _fundamental(world_to_camera, intrinsics, i: int, j: int) -> np.ndarray:
    """(3, 3) F with x_j^T F x_i = 0 in pixels (Hartley and Zisserman, eq. 9.1 for known poses)."""
    relative = world_to_camera[j] @ np.linalg.inv(world_to_camera[i])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.inv(intrinsics[j]).T @ cross @ relative[:3, :3] @ np.linalg.inv(intrinsics[i])


def _match(a: _Features, b: _Features, fundamental: np.ndarray) -> np.ndarray:
    """(M, 2) indices of mutual nearest descriptors that pass Lowe's ratio and lie on each other's epipolar lines."""
    if len(a.pixels) < 2 or len(b.pixels) < 2:
        return np.zeros((0, 2), int)
    similarity = a.descriptors @ b.descriptors.T
    forward, backward = similarity.argmax(axis=1), similarity.argmax(axis=0)
    rows = np.arange(len(forward))
    best = similarity[rows, forward]
    similarity[rows, forward] = -1
    second = similarity.max(axis=1)
    # Unit vectors: squared distance is 2 - 2 cos, so the ratio of distances compares these.
    keep = (backward[forward] == rows) & (1 - best < RATIO**2 * (1 - second))
    pairs = np.stack([rows[keep], forward[keep]], axis=1)
    x_i = np.concatenate([a.pixels[pairs[:, 0]], np.ones((len(pairs), 1))], axis=1)
    x_j = np.concatenate([b.pixels[pairs[:, 1]], np.ones((len(pairs), 1))], axis=1)
    line_j, line_i = x_i @ fundamental.T, x_j @ fundamental
    off = np.abs((x_j * line_j).sum(axis=1))
    distance = np.maximum(off / np.linalg.norm(line_j[:, :2], axis=1), off / np.linalg.norm(line_i[:, :2], axis=1))
    return pairs[distance < MAX_ERROR_PX]


def _tracks(edges: np.ndarray, views: np.ndarray) -> list[np.ndarray]:
    """Groups the features that `edges` (M, 2) connect, without groups with two features of one view (`views`)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(edges):
        return []
    graph = coo_array((np.ones(len(edges), bool), tuple(edges.T)), shape=(len(views), len(views)))
    component = connected_components(graph, directed=False)[1]
    order = np.argsort(component, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(component[order])) + 1)
    return [nodes for nodes in groups if 1 < len(nodes) == len(np.unique(views[nodes]))]


def triangulate_tracks(
    world_to_camera: np.ndarray, intrinsics: np.ndarray, views: np.ndarray, pixels: np.ndarray, seen: np.ndarray
):
    """Triangulates tracks: a linear solution, then five Gauss-Newton steps on the reprojection error.

    Args:
      world_to_camera: (T, 4, 4) poses.
      intrinsics: (T, 3, 3) camera matrices, px.
      views: (P, V) view of each observation of a track, padded.
      pixels: (P, V, 2) column and row, px.
      seen: (P, V) bool, false for padding.

    Returns:
      Points (P, 3), largest reprojection errors in px (P,), smallest depths (P,), and largest angles between two rays
      in radians (P,).
    """
    projection = intrinsics @ world_to_camera[:, :3]
    p = projection[views]
    weight = seen.astype(np.float64)[..., None]
    # The linear system A (x, y, z, 1) = 0 (Hartley and Zisserman, 12.2), each row scaled to unit length.
    rows = np.concatenate(
        [pixels[..., :1] * p[:, :, 2] - p[:, :, 0], pixels[..., 1:] * p[:, :, 2] - p[:, :, 1]], axis=1
    )
    rows /= np.maximum(np.linalg.norm(rows[..., :3], axis=-1, keepdims=True), 1e-12)
    rows *= np.concatenate([weight, weight], axis=1)
    normal = np.einsum("pra,prb->pab", rows[..., :3], rows[..., :3]) + 1e-12 * np.eye(3)
    points = np.linalg.solve(normal, -np.einsum("pra,pr->pa", rows[..., :3], rows[..., 3])[..., None])[..., 0]

    def project(points):
        homogeneous = np.einsum("pvab,pb->pva", p[..., :3], points) + p[..., 3]
        depth = np.where(np.abs(homogeneous[..., 2]) < 1e-9, 1e-9, homogeneous[..., 2])
        return homogeneous[..., :2] / depth[..., None], depth

    for _ in range(5):
        projected, depth = project(points)
        residual = (pixels - projected) * weight
        jacobian = (
            (p[:, :, :2, :3] - projected[..., None] * p[:, :, 2:, :3]) / depth[..., None, None] * weight[..., None]
        )
        gram = np.einsum("pvka,pvkb->pab", jacobian, jacobian)
        damping = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-30
        step = np.einsum("pvka,pvk->pa", jacobian, residual)
        points = points + np.linalg.solve(gram + damping * np.eye(3), step[..., None])[..., 0]
    projected, depth = project(points)
    error = np.where(seen, np.linalg.norm(pixels - projected, axis=-1), 0).max(axis=1)
    centres = -np.einsum("tji,tj->ti", world_to_camera[:, :3, :3], world_to_camera[:, :3, 3])
    rays = points[:, None] - centres[views]
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    cosine = np.where(seen[:, :, None] & seen[:, None], np.einsum("pva,pwa->pvw", rays, rays), 1)
    return points, error, np.where(seen, depth, np.inf).min(axis=1), np.arccos(np.clip(cosine.min(axis=(1, 2)), -1, 1))


def triangulated_points(capture: Capture, *, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Triangulates sparse points from the training frames. Deterministic.

    Args:
      capture: Frames and poses.
      progress: Called with the number of frames and pairs done and of all.

    Returns:
      Points (P, 3) float32, world, and their colours (P, 3) uint8.

    Raises:
      InputError: Fewer than MIN_POINTS points: the views do not overlap, or the poses belong to other frames.
    """
    used = np.flatnonzero(~np.asarray(capture.held_out))
    cameras = capture.cameras[used]
    poses = np.asarray(cameras.world_to_camera, np.float64)
    intrinsics = np.tile(np.eye(3), (len(used), 1, 1))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = cameras.fx, cameras.fy
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = cameras.cx, cameras.cy
    pairs = view_pairs(poses, NEIGHBOURS)
    total = len(used) + len(pairs)
    report = progress or (lambda done, total: None)
    features, edges = [], [np.zeros((0, 2), int)]
    for n, t in enumerate(used):
        features.append(_detect(np.ascontiguousarray(capture.frames[t])))
        report(n + 1, total)
    first = np.cumsum([0, *(len(f.pixels) for f in features)])
    for n, (i, j) in enumerate(pairs):
        edges.append(_match(features[i], features[j], _fundamental(poses, intrinsics, i, j)) + first[[i, j]])
        report(len(used) + n + 1, total)
    view = np.repeat(np.arange(len(used)), np.diff(first))
    tracks = _tracks(np.concatenate(edges), view)
    lengths = np.array([len(track) for track in tracks], int)
    nodes = np.concatenate([np.zeros(0, int), *tracks])
    seen = np.arange(lengths.max(initial=1)) < lengths[:, None]
    views, pixels, shade = np.zeros(seen.shape, int), np.zeros((*seen.shape, 2)), np.zeros((*seen.shape, 3))
    views[seen] = view[nodes]
    pixels[seen] = np.concatenate([np.zeros((0, 2)), *(f.pixels for f in features)])[nodes]
    shade[seen] = np.concatenate([np.zeros((0, 3)), *(f.colors for f in features)])[nodes]
    points, error, depth, angle = triangulate_tracks(poses, intrinsics, views, pixels, seen)
    good = (error < MAX_ERROR_PX) & (depth > 0) & (angle > np.deg2rad(MIN_ANGLE_DEG)) & np.isfinite(points).all(axis=1)
    if good.sum() < MIN_POINTS:
        problem = f"feature matching gives {good.sum()} points from {len(used)} views"
        remedy = "Use views that overlap and have texture, with correct poses, or pass points or --gaussians."
        raise InputError("capture", problem, f"at least {MIN_POINTS}", remedy)
    colors = (shade.sum(axis=1) / seen.sum(axis=1, keepdims=True))[good]
    return points[good].astype(np.float32), np.rint(colors).astype(np.uint8)
