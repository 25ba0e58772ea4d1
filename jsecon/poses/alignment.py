"""Direct alignment of the cameras of RGB-D frames to each other, before any fit. Host code (NumPy).

A point of one frame that another frame sees must lie on the surface measured there (point to plane; Chen and Medioni
1992) and have the same colour up to a gain (direct odometry; Steinbrucker et al. 2011). Gauss-Newton steps with Cauchy
weights move all cameras at once, on small frames first. Measured depth is metric, which removes bends that neighbouring
cameras share; colour alone does not.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from jsecon.fit.resize import shrink_cameras
from jsecon.fit.step import cameras_extent
from jsecon.types import Camera, Capture

MAX_POINTS = 400
"""Maximum number of points per frame."""
MAX_PARTNERS = 8
"""Maximum number of frames that a frame is compared with."""
PRIOR = 0.05
"""Standard deviation of the prior of a step, radians and shares of the cameras' extent: damps what the frames leave
open."""


class _Level(NamedTuple):
    """T frames at one size, with S points each."""

    cameras: Camera
    grey: np.ndarray
    """(T, H, W)"""
    slopes: np.ndarray
    """(T, H, W, 2) gradient of grey along x and y."""
    planes: np.ndarray
    """(T, H, W, 3) normal n of the surface's plane n x = 1 in camera axes; zero if there is no plane, or the pixel is
    ignored or saturated."""
    points: np.ndarray
    """(T, S, 3) points in camera axes."""
    point_grey: np.ndarray
    """(T, S) grey of the points."""
    valid: np.ndarray
    """(T, S) bool: a point, not padding."""


class _Residuals(NamedTuple):
    """Residuals of E pairs of frames: the S points of the first frame as the second frame sees them."""

    colour: np.ndarray
    """(E, S) difference in grey."""
    distance: np.ndarray
    """(E, S) distance from the plane, world units."""
    normals: np.ndarray
    """(E, S, 3) unit normals of the planes."""
    rotations: np.ndarray
    """(E, 3, 3) rotation from the first to the second camera."""
    moved: np.ndarray
    """(E, S, 3) the points in the axes of the second camera."""
    pixels: np.ndarray
    """(E, S, 2) their columns and rows there, px."""
    seen: np.ndarray
    """(E, S) bool: points that are compared."""


def align_cameras(
    capture: Capture, moving: Bool[np.ndarray, " t"], fixed: Bool[np.ndarray, " t"] | None = None
) -> Float[np.ndarray, "t 4 4"] | None:
    """Aligns cameras by colour and measured depth.

    Args:
      capture: RGB-D frames. Pixels that are ignored, saturated or without depth do not count.
      moving: (T,) bool frames to align.
      fixed: (T,) bool frames that they are aligned to; None aligns them to each other.

    Returns:
      (T, 4, 4) world-to-camera poses of all frames, or None if the frames do not agree clearly better with them. Frames
      aligned to each other may have moved together.
    """
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    chosen = np.flatnonzero(moving | (moving if fixed is None else fixed))
    moves = np.asarray(moving)[chosen]
    others = moves if fixed is None else np.asarray(fixed)[chosen]
    extent = max(cameras_extent(capture.cameras[chosen]), 1e-6)
    level, aligned, pairs = None, poses[chosen], None
    # Longer side of the frames in px, and maximum number of Gauss-Newton steps at that size.
    for side, steps in ((80, 8), (160, 6), (240, 4)):
        if level is not None and level.cameras.width == capture.cameras.width:
            break
        level = _level(capture, chosen, side)
        pairs = _pairs(level, aligned, moves, others) if pairs is None else pairs
        if not len(pairs):
            return None
        for _ in range(steps):
            aligned, rotation = _step(level, aligned, pairs, moves, extent)
            if rotation * side < 0.01:
                break
    assert level is not None
    assert pairs is not None
    before, after = (_median_difference(level, candidate, pairs) for candidate in (poses[chosen], aligned))
    # The difference falls to 0.22 in a made-up room with poses off by 1 cm and 0.5 degrees, to 0.81 on apc_bin, to 0.86
    # on replica_apartment_0, to 1 in an exact room, and to 0.95 with the depth of soft Gaussians, which frames do not
    # share (800 points per frame).
    if not after < 0.9 * before:
        return None
    result = poses.copy()
    result[chosen] = aligned
    return result


def _level(capture: Capture, chosen: Int[np.ndarray, " c"], side: int) -> _Level:
    """The chosen frames with a longer side of at most `side` px."""
    cameras = shrink_cameras(capture.cameras[chosen], side)
    shape = len(chosen), cameras.height, cameras.width
    grey, slopes, planes = (np.zeros((*shape, *channels), np.float32) for channels in ((), (2,), (3,)))
    points = np.ones((len(chosen), MAX_POINTS, 3))
    point_grey = np.zeros((len(chosen), MAX_POINTS))
    valid = np.zeros((len(chosen), MAX_POINTS), bool)

    def shrink(a):
        return cv2.resize(np.asarray(a, np.float32), shape[:0:-1], interpolation=cv2.INTER_AREA)

    draw = np.random.default_rng(0)
    assert capture.depths is not None
    for k, t in enumerate(chosen):
        frame, camera = np.asarray(capture.frames[t]), cameras[k]
        blocked = (frame == 255).any(axis=-1)
        if capture.ignored is not None:
            blocked |= np.asarray(capture.ignored[t])
        grey[k] = shrink(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)) / 255
        slopes[k, ..., 1], slopes[k, ..., 0] = np.gradient(grey[k])
        planes[k] = _planes(np.asarray(capture.depths[t], np.float64), camera)
        planes[k][shrink(blocked) > 0] = 0
        row, column = np.nonzero(planes[k].any(axis=-1))
        picked = draw.permutation(len(row))[:MAX_POINTS]
        row, column, n = row[picked], column[picked], len(picked)
        x, y = (column + 0.5 - float(camera.cx)) / float(camera.fx), (row + 0.5 - float(camera.cy)) / float(camera.fy)
        rays = np.stack([x, y, np.ones(n)], axis=-1)
        points[k, :n] = rays / (rays * planes[k, row, column]).sum(-1, keepdims=True)
        point_grey[k, :n], valid[k, :n] = grey[k, row, column], True
    return _Level(cameras, grey, slopes, planes, points, point_grey, valid)


def _planes(depth: Float[np.ndarray, "h w"], camera: Camera) -> Float[np.ndarray, "_ _ 3"]:
    """Fits a plane n x = 1 to the surface in 5 x 5 px around each pixel (1 / z is linear in pixels).

    Without a plane n is 0: where less than 40 % of the window is known, or its depth deviates by an RMS of 2 %.
    """
    width, height = camera.width, camera.height
    down, across = depth.shape[0] / height, depth.shape[1] / width
    # Nearest depth, at its exact ray: between two depths there may be no surface.
    rows = np.minimum(((np.arange(height) + 0.5) * down).astype(int), depth.shape[0] - 1)
    columns = np.minimum(((np.arange(width) + 0.5) * across).astype(int), depth.shape[1] - 1)
    z = depth[np.ix_(rows, columns)]
    known = np.isfinite(z) & (z > 0)
    inverse = np.where(known, 1 / np.where(known, z, 1), 0)
    at_u = ((columns + 0.5) / across)[None, :] - (np.arange(width) + 0.5)[None, :]
    at_v = ((rows + 0.5) / down)[:, None] - (np.arange(height) + 0.5)[:, None]
    # Relative to the first pixel, so that sums of squares keep their digits in float64.
    u, v = np.broadcast_arrays(np.arange(width)[None, :] + at_u, np.arange(height)[:, None] + at_v)
    weight = known.astype(np.float64)

    def mean(a):
        return cv2.boxFilter(a * weight, -1, (5, 5), borderType=cv2.BORDER_CONSTANT)

    share = mean(weight)
    safe = np.maximum(share, 1e-9)
    m_u, m_v, m_d = mean(u) / safe, mean(v) / safe, mean(inverse) / safe
    uu, uv, vv = mean(u * u) / safe - m_u**2, mean(u * v) / safe - m_u * m_v, mean(v * v) / safe - m_v**2
    ud, vd, dd = mean(u * inverse) / safe - m_u * m_d, mean(v * inverse) / safe - m_v * m_d, mean(inverse**2) / safe
    determinant = uu * vv - uv * uv
    is_plane = (share >= 0.4) & known & (determinant > 0.05)
    determinant = np.where(is_plane, determinant, 1)
    a, b = (ud * vv - vd * uv) / determinant, (vd * uu - ud * uv) / determinant
    residual = np.maximum(dd - m_d**2 - a * ud - b * vd, 0)
    c = m_d - a * m_u - b * m_v
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    planes = np.stack([a * fx, b * fy, a * (cx - 0.5) + b * (cy - 0.5) + c], axis=-1)
    plane_depth = a * np.arange(width)[None, :] + b * np.arange(height)[:, None] + c
    is_plane &= (residual <= (0.02 * m_d) ** 2) & (plane_depth > 0.5 * m_d)
    return np.where(is_plane[..., None], planes, 0)


def _residuals(level: _Level, poses: np.ndarray, pairs: np.ndarray, every: int = 1) -> _Residuals:
    """Residuals of every `every`-th point of the first frame of each pair in the second."""
    (a, b), cameras, subset = pairs.T, level.cameras, slice(None, None, every)
    motions = poses[b] @ np.linalg.inv(poses[a])
    moved = np.einsum("eij,esj->esi", motions[:, :3, :3], level.points[a, subset]) + motions[:, None, :3, 3]
    fx, fy, cx, cy = (
        np.asarray(value, np.float64)[b][:, None] for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)
    )
    z = np.where(moved[..., 2] > 0, moved[..., 2], 1.0)
    u, v = fx * moved[..., 0] / z + cx, fy * moved[..., 1] / z + cy
    inside = (u > 1) & (v > 1) & (u < cameras.width - 1) & (v < cameras.height - 1) & (moved[..., 2] > 0)
    u, v = np.where(inside, u, 1.0), np.where(inside, v, 1.0)
    at = b[:, None]
    planes = level.planes[at, v.astype(int), u.astype(int)].astype(np.float64)
    length = np.maximum(np.linalg.norm(planes, axis=-1), 1e-20)
    height = (moved * planes).sum(-1) - 1
    # A point is not compared with a surface whose depth differs by a tenth: another one hides it.
    seen = inside & level.valid[a, subset] & planes.any(axis=-1) & (np.abs(height) < 0.1)
    seen &= seen.sum(axis=1, keepdims=True) >= 50 / every  # fewer common points do not compare two frames
    grey, point_grey = _bilinear(level.grey, at, u, v), level.point_grey[a, subset]
    gains = (grey * seen).sum(axis=1) / np.maximum((point_grey * seen).sum(axis=1), 1e-9)
    colour = grey - gains[:, None] * point_grey
    normals = planes / length[..., None]
    return _Residuals(colour, height / length, normals, motions[:, :3, :3], moved, np.stack([u, v], axis=-1), seen)


def _median_difference(level: _Level, poses: np.ndarray, pairs: np.ndarray) -> float:
    """Median difference in grey; infinite if no frame sees a point of another."""
    residuals = _residuals(level, poses, pairs)
    return float(np.median(np.abs(residuals.colour[residuals.seen]))) if residuals.seen.any() else np.inf


def _pairs(level: _Level, poses: np.ndarray, moves: np.ndarray, others: np.ndarray) -> Int[np.ndarray, "e 2"]:
    """Pairs of frames that overlap, both ways round: each moving frame with up to MAX_PARTNERS others."""
    pairs, other = set(), np.flatnonzero(others)
    for a in np.flatnonzero(moves):
        candidates = np.stack([np.full(len(other), a), other], axis=1)[other != a]
        seen = _residuals(level, poses, candidates, every=8).seen.sum(axis=1)
        share = seen / max(int(level.valid[a, ::8].sum()), 1)
        best = candidates[np.argsort(-share, kind="stable")][: int((share >= 0.3).sum()), 1]  # less overlaps too little
        # Half of the partners overlap most, which fixes the pose best; the others close loops.
        half = MAX_PARTNERS // 2
        rest = np.unique(np.linspace(half, len(best) - 1, MAX_PARTNERS - half).astype(int)) if len(best) > half else []
        for b in (*best[:half], *best[np.asarray(rest, int)]):
            pairs |= {(int(a), int(b)), (int(b), int(a))}
    return np.array(sorted(pairs), int).reshape(-1, 2)


def _step(
    level: _Level, poses: np.ndarray, pairs: np.ndarray, moves: np.ndarray, extent: float
) -> tuple[np.ndarray, float]:
    """Poses after one Gauss-Newton step, and its largest rotation in radians."""
    residuals, (a, b), count = _residuals(level, poses, pairs), pairs.T, len(poses)
    if not residuals.seen.any():
        return poses, 0.0
    q, seen = residuals.moved, residuals.seen
    u, v = np.moveaxis(residuals.pixels, -1, 0)
    slope_u, slope_v = (_bilinear(level.slopes[..., axis], b[:, None], u, v) for axis in (0, 1))
    fx, fy = (np.asarray(value, np.float64)[b][:, None] for value in (level.cameras.fx, level.cameras.fy))
    z = np.where(seen, q[..., 2], 1.0)
    du, dv = slope_u * fx / z, slope_v * fy / z
    along = np.stack([du, dv, -(du * q[..., 0] + dv * q[..., 1]) / z], axis=-1)
    diagonal, off_diagonal = np.zeros((count, 6, 6)), np.zeros((len(pairs), 6, 6))
    right_side = np.zeros((count, 6))

    def dot(x, y):
        return np.matmul(x.swapaxes(1, 2), y)

    # Twists along the axes of each camera: q' = q + w x q + v, and p' = p - w x p - v.
    for residual, slope in ((residuals.colour, along), (residuals.distance, residuals.normals)):
        scale = 1.4826 * float(np.median(np.abs(residual[seen]))) + 1e-9
        weight = (seen / (1 + (residual / (2 * scale)) ** 2) / scale**2)[..., None]
        back = np.einsum("eji,esj->esi", residuals.rotations, slope)
        of_a = -np.concatenate([np.cross(level.points[a], back), back], axis=-1)
        of_b = np.concatenate([np.cross(q, slope), slope], axis=-1)
        np.add.at(diagonal, a, dot(weight * of_a, of_a))
        np.add.at(diagonal, b, dot(weight * of_b, of_b))
        off_diagonal += dot(weight * of_a, of_b)
        np.add.at(right_side, a, -(weight * of_a * residual[..., None]).sum(1))
        np.add.at(right_side, b, -(weight * of_b * residual[..., None]).sum(1))
    diagonal += np.diag(1 / np.repeat([PRIOR, PRIOR * extent], 3) ** 2)
    place, both, n = np.cumsum(moves) - 1, moves[a] & moves[b], int(moves.sum())
    rows = np.concatenate([place[a][both], place[b][both], np.arange(n)])
    columns = np.concatenate([place[b][both], place[a][both], np.arange(n)])
    blocks = np.concatenate([off_diagonal[both], off_diagonal[both].swapaxes(1, 2), diagonal[moves]])
    i, j = (
        np.broadcast_to(6 * at[:, None, None] + index, blocks.shape)
        for at, index in zip((rows, columns), np.mgrid[:6, :6])
    )
    matrix = csc_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=(6 * n, 6 * n))
    twists = np.zeros((count, 6))
    twists[moves] = np.reshape(np.asarray(spsolve(matrix, right_side[moves].ravel())), (-1, 6))
    motions = np.tile(np.eye(4), (count, 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    motions[:, :3, 3] = twists[:, 3:]
    return motions @ poses, float(np.abs(twists[:, :3]).max())


def _bilinear(images: np.ndarray, at: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values of the images (T, H, W) with indices `at` at pixels (u, v); the first pixel centre is (0.5, 0.5)."""
    return map_coordinates(images, np.broadcast_arrays(at, v - 0.5, u - 0.5), np.float64, order=1, mode="nearest")
