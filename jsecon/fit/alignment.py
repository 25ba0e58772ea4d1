"""Aligns the cameras of RGB-D frames to each other directly, before anything is fitted.

Where another frame sees a point of a frame, the point must lie on the surface measured there (point to plane; Chen and
Medioni 1992) and look the same up to a gain (direct odometry; Steinbrucker et al. 2011). Gauss-Newton steps with
Cauchy weights move all cameras at once until both hold, on small frames first. Measured depth is metric, so no bend
that neighbouring cameras share is left, as it is by colour alone.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from jsecon.fit.resize import shrink_cameras
from jsecon.fit.step import cameras_extent
from jsecon.types import Camera, Capture

LEVELS = ((80, 8), (160, 6), (240, 4))
"""longer side of the frames, px, and Gauss-Newton steps at most at that size"""
POINTS = 400
"""maximum number of points of a frame that its partners are compared at"""
PARTNERS = 8
"""maximum number of frames that a frame is compared with"""
OVERLAP = 0.3
"""share of a frame's points that a partner must see"""
NEAR = 0.1
"""relative difference in depth up to which a point may lie on the surface that a partner measured"""
FLAT = 0.02
"""relative deviation (RMS) of the depth from a plane, over a window, up to which it counts as one surface"""
WINDOW = 5
"""px, side of the window in which the surface is a plane"""
LEAST_KNOWN = 0.4
"""share of the window whose depth must be known"""
PRIOR = 0.05
"""radians, and shares of the cameras' extent: damps what the frames leave open"""
WON = 0.75
"""share to which the median difference in colour must fall, or the poses stay as they are. It falls to 0.22 in a
made-up room with poses off by 1 cm and 0.5 degrees, to 0.81 on apc_bin and 0.86 on replica_apartment_0, to 1 in an
exact room, to 0.95 where the depth is that of soft Gaussians, which frames do not share (800 points a frame). It was
set after these were seen"""
_FEW = 50
"""points in common below which two frames are not compared"""
_GRID = np.mgrid[:6, :6]


class _Level(NamedTuple):
    """T frames at one size, and S points of each."""

    cameras: Camera
    grey: np.ndarray
    """(T, H, W)"""
    slopes: np.ndarray
    """(T, H, W, 2) of grey, along x and y"""
    planes: np.ndarray
    """(T, H, W, 3) n of the surface's plane n x = 1, in the camera's axes; zero where there is no surface, or the pixel
    is ignored or saturated"""
    points: np.ndarray
    """(T, S, 3) in the camera's axes"""
    shades: np.ndarray
    """(T, S) grey of the points"""
    counted: np.ndarray
    """(T, S) bool: a point, and no filler"""


class _Differences(NamedTuple):
    """Of the points of E pairs' first frames, as the second ones see them; (E, S)."""

    colour: np.ndarray
    plane: np.ndarray
    normals: np.ndarray
    turns: np.ndarray
    """(E, 3, 3)"""
    moved: np.ndarray
    """(E, S, 3) the points in the second camera's axes"""
    pixels: np.ndarray
    """(E, S, 2)"""
    seen: np.ndarray


def align_cameras(
    capture: Capture, moving: Bool[np.ndarray, " t"], fixed: Bool[np.ndarray, " t"] | None = None
) -> Float[np.ndarray, "t 4 4"] | None:
    """Aligns cameras by colour and measured depth.

    Args:
      capture: RGB-D frames. Pixels that are ignored, saturated or without depth have no part.
      moving: Frames whose poses are sought.
      fixed: Frames that each of these is aligned to; None aligns those `moving` to each other.

    Returns:
      World-to-camera poses of all frames, or None where the frames do not agree clearly better with them (WON). Where
      frames are aligned to each other, they may have moved together.
    """
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    chosen = np.flatnonzero(moving | (moving if fixed is None else fixed))
    moves = np.asarray(moving)[chosen]
    others = moves if fixed is None else np.asarray(fixed)[chosen]
    extent = max(cameras_extent(capture.cameras[chosen]), 1e-6)
    level, own, pairs = None, poses[chosen], None
    for side, steps in LEVELS:
        if level is not None and level.cameras.width == capture.cameras.width:
            break
        level = _level(capture, chosen, side)
        pairs = _pairs(level, own, moves, others) if pairs is None else pairs
        if not len(pairs):
            return None
        for _ in range(steps):
            own, turned = _step(level, own, pairs, moves, extent)
            if turned * side < 0.01:
                break
    assert level is not None
    assert pairs is not None
    before, after = (_disagreement(level, these, pairs) for these in (poses[chosen], own))
    if not after < WON * before:
        return None
    found = poses.copy()
    found[chosen] = own
    return found


def _level(capture: Capture, chosen: Int[np.ndarray, " c"], side: int) -> _Level:
    """The chosen frames with a longer side of at most `side` px."""
    whole = capture.cameras[chosen]
    cameras = shrink_cameras(whole, side)
    shape = len(chosen), cameras.height, cameras.width
    grey, slopes, planes = (np.zeros((*shape, *own), np.float32) for own in ((), (2,), (3,)))
    points, shades = np.ones((len(chosen), POINTS, 3)), np.zeros((len(chosen), POINTS))
    counted = np.zeros((len(chosen), POINTS), bool)
    shrink = lambda a: cv2.resize(np.asarray(a, np.float32), shape[:0:-1], interpolation=cv2.INTER_AREA)
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
        picked = draw.permutation(len(row))[:POINTS]
        row, column, n = row[picked], column[picked], len(picked)
        x, y = (column + 0.5 - float(camera.cx)) / float(camera.fx), (row + 0.5 - float(camera.cy)) / float(camera.fy)
        rays = np.stack([x, y, np.ones(n)], axis=-1)
        points[k, :n] = rays / (rays * planes[k, row, column]).sum(-1, keepdims=True)
        shades[k, :n], counted[k, :n] = grey[k, row, column], True
    return _Level(cameras, grey, slopes, planes, points, shades, counted)


def _planes(depth: Float[np.ndarray, "h w"], camera: Camera) -> Float[np.ndarray, "_ _ 3"]:
    """The plane n x = 1 of the surface around each pixel of the camera, by least squares: 1 / z is linear in pixels.
    Zero where the window's depths are of no one plane, or too few of them are known."""
    width, height = camera.width, camera.height
    down, across = depth.shape[0] / height, depth.shape[1] / width
    # A depth is taken as it is, at its own ray: between two of them there may be none.
    rows = np.minimum(((np.arange(height) + 0.5) * down).astype(int), depth.shape[0] - 1)
    columns = np.minimum(((np.arange(width) + 0.5) * across).astype(int), depth.shape[1] - 1)
    z = depth[np.ix_(rows, columns)]
    known = np.isfinite(z) & (z > 0)
    inverse = np.where(known, 1 / np.where(known, z, 1), 0)
    at_u = ((columns + 0.5) / across)[None, :] - (np.arange(width) + 0.5)[None, :]
    at_v = ((rows + 0.5) / down)[:, None] - (np.arange(height) + 0.5)[:, None]
    # Pixels as seen from the first one, so that sums of squares keep their digits in float64.
    u, v = np.broadcast_arrays(np.arange(width)[None, :] + at_u, np.arange(height)[:, None] + at_v)
    one = known.astype(np.float64)
    mean = lambda a: cv2.boxFilter(a * one, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)
    share = mean(one)
    safe = np.maximum(share, 1e-9)
    m_u, m_v, m_d = mean(u) / safe, mean(v) / safe, mean(inverse) / safe
    uu, uv, vv = mean(u * u) / safe - m_u**2, mean(u * v) / safe - m_u * m_v, mean(v * v) / safe - m_v**2
    ud, vd, dd = mean(u * inverse) / safe - m_u * m_d, mean(v * inverse) / safe - m_v * m_d, mean(inverse**2) / safe
    apart = uu * vv - uv * uv
    sound = (share >= LEAST_KNOWN) & known & (apart > 0.05)
    apart = np.where(sound, apart, 1)
    a, b = (ud * vv - vd * uv) / apart, (vd * uu - ud * uv) / apart
    rest = np.maximum(dd - m_d**2 - a * ud - b * vd, 0)
    c = m_d - a * m_u - b * m_v
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    planes = np.stack([a * fx, b * fy, a * (cx - 0.5) + b * (cy - 0.5) + c], axis=-1)
    here = a * np.arange(width)[None, :] + b * np.arange(height)[:, None] + c
    sound &= (rest <= (FLAT * m_d) ** 2) & (here > 0.5 * m_d)
    return np.where(sound[..., None], planes, 0)


def _differences(level: _Level, poses: np.ndarray, pairs: np.ndarray, every: int = 1) -> _Differences:
    """How far the points of each pair's first frame are off as the second one sees them; `every` so many points."""
    (a, b), cameras, some = pairs.T, level.cameras, slice(None, None, every)
    motions = poses[b] @ np.linalg.inv(poses[a])
    moved = np.einsum("eij,esj->esi", motions[:, :3, :3], level.points[a, some]) + motions[:, None, :3, 3]
    fx, fy, cx, cy = (np.asarray(own, np.float64)[b][:, None] for own in _lens(cameras))
    z = np.where(moved[..., 2] > 0, moved[..., 2], 1.0)
    u, v = fx * moved[..., 0] / z + cx, fy * moved[..., 1] / z + cy
    inside = (u > 1) & (v > 1) & (u < cameras.width - 1) & (v < cameras.height - 1) & (moved[..., 2] > 0)
    u, v = np.where(inside, u, 1.0), np.where(inside, v, 1.0)
    at = b[:, None]
    planes = level.planes[at, v.astype(int), u.astype(int)].astype(np.float64)
    length = np.maximum(np.linalg.norm(planes, axis=-1), 1e-20)
    height = (moved * planes).sum(-1) - 1
    seen = inside & level.counted[a, some] & planes.any(axis=-1) & (np.abs(height) < NEAR)
    seen &= seen.sum(axis=1, keepdims=True) >= _FEW / every
    grey, shades = _bilinear(level.grey, at, u, v), level.shades[a, some]
    gains = (grey * seen).sum(axis=1) / np.maximum((shades * seen).sum(axis=1), 1e-9)
    colour = grey - gains[:, None] * shades
    normals = planes / length[..., None]
    return _Differences(colour, height / length, normals, motions[:, :3, :3], moved, np.stack([u, v], axis=-1), seen)


def _lens(cameras: Camera) -> tuple:
    return cameras.fx, cameras.fy, cameras.cx, cameras.cy


def _disagreement(level: _Level, poses: np.ndarray, pairs: np.ndarray) -> float:
    """Median difference in colour; infinite where no frame sees a point of another."""
    found = _differences(level, poses, pairs)
    return float(np.median(np.abs(found.colour[found.seen]))) if found.seen.any() else np.inf


def _pairs(level: _Level, poses: np.ndarray, moves: np.ndarray, others: np.ndarray) -> Int[np.ndarray, "e 2"]:
    """Pairs of frames that see the same, both ways: each one that moves with up to PARTNERS others."""
    pairs, other = set(), np.flatnonzero(others)
    for a in np.flatnonzero(moves):
        tried = np.stack([np.full(len(other), a), other], axis=1)[other != a]
        seen = _differences(level, poses, tried, every=8).seen.sum(axis=1)
        share = seen / max(int(level.counted[a, ::8].sum()), 1)
        best = tried[np.argsort(-share, kind="stable")][: int((share >= OVERLAP).sum()), 1]
        # Those that see most of it fix it best; others close loops.
        half = PARTNERS // 2
        rest = np.unique(np.linspace(half, len(best) - 1, PARTNERS - half).astype(int)) if len(best) > half else []
        for b in (*best[:half], *best[np.asarray(rest, int)]):
            pairs |= {(int(a), int(b)), (int(b), int(a))}
    return np.array(sorted(pairs), int).reshape(-1, 2)


def _step(
    level: _Level, poses: np.ndarray, pairs: np.ndarray, moves: np.ndarray, extent: float
) -> tuple[np.ndarray, float]:
    """The poses after one step of Gauss-Newton, and the largest turn by it, radians."""
    found, (a, b), count = _differences(level, poses, pairs), pairs.T, len(poses)
    if not found.seen.any():
        return poses, 0.0
    q, seen = found.moved, found.seen
    slopes = _bilinear(level.slopes, b[:, None], found.pixels[..., 0], found.pixels[..., 1])
    fx, fy = (np.asarray(own, np.float64)[b][:, None] for own in _lens(level.cameras)[:2])
    z = np.where(seen, q[..., 2], 1.0)
    du, dv = slopes[..., 0] * fx / z, slopes[..., 1] * fy / z
    along = np.stack([du, dv, -(du * q[..., 0] + dv * q[..., 1]) / z], axis=-1)
    own, between = np.zeros((count, 6, 6)), np.zeros((len(pairs), 6, 6))
    right = np.zeros((count, 6))
    dot = lambda x, y: np.matmul(x.swapaxes(1, 2), y)
    # Twists of both cameras' own axes: q' = q + w x q + v, and p' = p - w x p - v.
    for residual, slope in ((found.colour, along), (found.plane, found.normals)):
        scale = 1.4826 * float(np.median(np.abs(residual[seen]))) + 1e-9
        weight = (seen / (1 + (residual / (2 * scale)) ** 2) / scale**2)[..., None]
        back = np.einsum("eji,esj->esi", found.turns, slope)
        of_a = -np.concatenate([np.cross(level.points[a], back), back], axis=-1)
        of_b = np.concatenate([np.cross(q, slope), slope], axis=-1)
        np.add.at(own, a, dot(weight * of_a, of_a))
        np.add.at(own, b, dot(weight * of_b, of_b))
        between += dot(weight * of_a, of_b)
        np.add.at(right, a, -(weight * of_a * residual[..., None]).sum(1))
        np.add.at(right, b, -(weight * of_b * residual[..., None]).sum(1))
    own += np.diag(1 / np.repeat([PRIOR, PRIOR * extent], 3) ** 2)
    place, both, n = np.cumsum(moves) - 1, moves[a] & moves[b], int(moves.sum())
    rows = np.concatenate([place[a][both], place[b][both], np.arange(n)])
    columns = np.concatenate([place[b][both], place[a][both], np.arange(n)])
    blocks = np.concatenate([between[both], between[both].swapaxes(1, 2), own[moves]])
    i, j = (np.broadcast_to(6 * at[:, None, None] + grid, blocks.shape) for at, grid in zip((rows, columns), _GRID))
    matrix = csc_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=(6 * n, 6 * n))
    twists = np.zeros((count, 6))
    twists[moves] = np.reshape(np.asarray(spsolve(matrix, right[moves].ravel())), (-1, 6))
    motions = np.tile(np.eye(4), (count, 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    motions[:, :3, 3] = twists[:, 3:]
    return motions @ poses, float(np.abs(twists[:, :3]).max())


def _bilinear(images: np.ndarray, at: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values of the images `at`, (T, H, W, ...), at pixels (u, v); the centre of the first one is at (0.5, 0.5)."""
    height, width = images.shape[1:3]
    x, y = np.clip(u - 0.5, 0, width - 1.001), np.clip(v - 0.5, 0, height - 1.001)
    column, row = x.astype(int), y.astype(int)
    x, y = x - column, y - row
    if images.ndim == 4:
        x, y = x[..., None], y[..., None]
    top = images[at, row, column] * (1 - x) + images[at, row, column + 1] * x
    bottom = images[at, row + 1, column] * (1 - x) + images[at, row + 1, column + 1] * x
    return top * (1 - y) + bottom * y
