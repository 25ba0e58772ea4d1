"""Dense points for a capture with poses and no depth: stereo between neighbouring views; and random points.

Each frame is paired with the views that see the same sparse points under some degrees of parallax. A pair is rectified
(both pictures turned about their own centres until rows are epipolar lines), matched by semi-global matching with a
left-right check (Hirschmueller 2008), and gives the frame a depth map. A depth stays where two of its maps, so three
views, agree on it, and where it agrees with what another frame's maps came to at the place where it projects to. All
frames' points are then merged in voxels whose edge grows with the distance.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from scipy.spatial import KDTree

from jsecon.errors import InputError, require
from jsecon.fit.triangulate import MIN_POINTS, triangulated_points
from jsecon.types import Camera, Capture

NEIGHBOURS, PARALLAX_DEG = 4, 5.0
"""views that a frame is matched with; the parallax that is best (less is inexact, more is hard to match)"""
AGREEMENT, AGREEING = 0.02, 2
"""relative difference up to which two depths agree, and how many maps have to"""
MAX_SIDE = 640
"""px: larger frames are shrunk by a whole factor first, as the time grows with the cube of their size"""
MIN_SAMPLES, ALONE = 3, 3.0
"""pixels that a voxel's point is the mean of, of all frames, at least; edges of its voxel within which a point has
three others. What fails either stands alone in the air, and as a Gaussian as wide as the gap it fogs whole views."""
MAX_DISPARITIES, BLOCK, STEP_COST, JUMP_COST = 256, 3, 4 * 9, 16 * 9
"""steps of the search, px; side of the matching's window, px; its costs of a step of one and of more, in grey values
summed over the window: half of what is usual, so that objects do not grow into the blank walls behind them"""
NEAR, FAR = 0.8, 1.5
"""depths are searched from `NEAR` times the nearest sparse points in view to `FAR` times the farthest"""
FARTHEST = 8.0
"""of random points from what the cameras look at, in units of the farthest camera's distance"""


class _Views(NamedTuple):
    """The frames that are not held out, no side longer than MAX_SIDE."""

    frames: list[np.ndarray]  # (H, W, 3) uint8
    poses: np.ndarray  # (T, 4, 4) float64
    intrinsics: np.ndarray  # (T, 3, 3) float64, px

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.frames[0].shape[:2]
        return width, height

    @property
    def centres(self) -> np.ndarray:
        return -np.einsum("tji,tj->ti", self.poses[:, :3, :3], self.poses[:, :3, 3])


def _views(capture: Capture) -> _Views:
    used = np.flatnonzero(~np.asarray(capture.held_out))
    cameras: Camera = capture.cameras[used]
    factor = int(np.ceil(max(cameras.width, cameras.height) / MAX_SIDE))
    height, width = cameras.height // factor, cameras.width // factor
    crop = [np.asarray(capture.frames[t])[: height * factor, : width * factor] for t in used]
    intrinsics = np.tile(np.eye(3), (len(used), 1, 1))
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = np.asarray(cameras.fx) / factor, np.asarray(cameras.fy) / factor
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = np.asarray(cameras.cx) / factor, np.asarray(cameras.cy) / factor
    frames = [cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in crop]
    return _Views(frames, np.asarray(cameras.world_to_camera, np.float64), intrinsics)


def _project(views: _Views, points: np.ndarray):
    """Pixels (T, P, 2) of world points, their depths (T, P), and whether they lie inside each picture (T, P)."""
    rays = np.einsum("tab,pb->tpa", views.intrinsics @ views.poses[:, :3, :3], points)
    rays += np.einsum("tab,tb->ta", views.intrinsics, views.poses[:, :3, 3])[:, None]
    depths = rays[..., 2]
    pixels = rays[..., :2] / np.where(depths > 1e-9, depths, np.inf)[..., None]
    inside = (depths > 1e-9) & (pixels > 0).all(axis=-1) & (pixels < views.size).all(axis=-1)
    return pixels, depths, inside


def _partners(views: _Views, points: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """For each view, those that see most of the points that it sees, each weighted by how good its parallax is."""
    rays = points[None] - views.centres[:, None]
    rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
    partners = []
    for t in range(len(rays)):
        ratio = np.arccos(np.clip(np.einsum("vpa,pa->vp", rays, rays[t]), -1, 1)) / np.deg2rad(PARALLAX_DEG)
        worth = (np.minimum(ratio, 1 / np.maximum(ratio, 1e-9)) * (inside & inside[t])).sum(axis=1)
        worth[t] = 0
        best = np.argsort(-worth, kind="stable")[:NEIGHBOURS]
        partners.append(best[worth[best] > 0])
    return partners


def _stereo(views: _Views, i: int, j: int, near: float, far: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Inverse depth (H, W) of frame i by matching it with frame j, 0 where unknown, and the pixels that a change of it
    by 1 moves the match; None where the pair cannot be rectified, because one camera stands before the other."""
    (width, height), focal = views.size, views.intrinsics[i, 0, 0]
    baseline = views.centres[j] - views.centres[i]
    length = float(np.linalg.norm(baseline))
    x = baseline / max(length, 1e-12)
    z = views.poses[i, 2, :3] + views.poses[j, 2, :3]
    z = z - (z @ x) * x
    if length <= 0 or np.linalg.norm(z) < 1:  # more than 60 degrees between the baseline and the image planes
        return None
    z = z / np.linalg.norm(z)
    common = np.stack([x, np.cross(z, x), z])
    turns = [common @ views.poses[v, :3, :3].T @ np.linalg.inv(views.intrinsics[v]) for v in (i, j)]
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]]) @ turns[0].T
    if (corners[:, 2] < 0.2).any():
        return None
    corners = focal * corners[:, :2] / corners[:, 2:]
    low = corners.min(axis=0)
    size = np.ceil(corners.max(axis=0) - low).astype(int)
    first = int(focal * length / far)
    count = int(np.clip(16 * np.ceil((focal * length / near - first) / 16), 16, MAX_DISPARITIES))
    if max(size) > 3 * max(width, height) or first > size[0]:
        return None
    to_common = np.array([[focal, 0, -low[0]], [0, focal, -low[1]], [0, 0, 1]])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centres are integers
    turned = []
    for view, turn in zip((i, j), turns):
        picture = cv2.cvtColor(views.frames[view], cv2.COLOR_RGB2GRAY)
        homography = np.linalg.inv(half) @ to_common @ turn @ half
        # The matching leaves out the columns at the left whose matches could lie outside: they are put in front.
        pad = np.array([[1, 0, first + count], [0, 1, 0], [0, 0, 1]])
        # What lies outside a picture repeats its border: black there would make the border a thing to match.
        whole = (int(size[0]) + first + count, int(size[1]))
        turned.append(cv2.warpPerspective(picture, pad @ homography, whole, borderMode=cv2.BORDER_REPLICATE))
    matcher = cv2.StereoSGBM.create(
        first, count, BLOCK, STEP_COST, JUMP_COST, 1, 31, 10, 0, 0, cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    disparity = matcher.compute(*turned)[:, first + count :].astype(np.float32) / 16
    row, column = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    ray = np.stack([column, row, np.ones_like(row)], axis=-1) @ turns[0].T.astype(np.float32)
    x, y = np.moveaxis((focal * ray[..., :2] / ray[..., 2:] - low - 0.5).astype(np.float32), -1, 0)
    own = cv2.remap(disparity, x, y, cv2.INTER_NEAREST, borderValue=(-1.0,))
    # disparity = focal length / depth along the common axis; the frame's own depth is that over the ray's part of it.
    sensitivity = (focal * length / ray[..., 2]).astype(np.float32)
    return np.where(own >= max(first, 0.5), own, 0) / sensitivity, sensitivity


def _agreed(maps: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """(H, W) inverse depth: the mean, weighted by precision, of the largest set of maps that agree; 0 where too few."""
    inverse, precision = np.stack([m[0] for m in maps]), np.stack([m[1] for m in maps]) ** 2
    most, result = np.full(inverse.shape[1:], AGREEING - 0.5, np.float32), np.zeros(inverse.shape[1:], np.float32)
    for one in inverse:
        agree = (inverse > 0) & (np.abs(inverse - one) < AGREEMENT * one)
        weight, votes = agree * precision, agree.sum(axis=0)
        mean = (weight * inverse).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-30)
        most, result = np.where(votes > most, votes, most), np.where(votes > most, mean, result)
    return result


def _points(views: _Views, maps: list[np.ndarray], partners: list[np.ndarray], t: int, step: int) -> np.ndarray:
    """(S, 7) points, colours and sizes of a pixel there, world units: every `step`-th pixel of frame t whose inverse
    depth is known and agrees with the map of one of its partners."""
    row, column = np.nonzero(maps[t][::step, ::step])
    row, column = row * step, column * step
    depth = 1 / maps[t][row, column].astype(np.float64)
    pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
    local = depth[:, None] * (pixel @ np.linalg.inv(views.intrinsics[t]).T)
    world = (local - views.poses[t, :3, 3]) @ views.poses[t, :3, :3]
    confirmed = np.zeros(len(row), bool)
    others = _Views(views.frames, views.poses[partners[t]], views.intrinsics[partners[t]])
    for j, at, own, inside in zip(partners[t], *_project(others, world)):
        x, y = np.where(inside[:, None], at, 0).astype(int).T
        confirmed |= inside & (np.abs(maps[j][y, x] * own - 1) < AGREEMENT)
    samples = np.column_stack([world, views.frames[t][row, column], depth / views.intrinsics[t, 0, 0]])
    return samples[confirmed]


def _merged(samples: np.ndarray, max_points: int) -> np.ndarray:
    """(P, 6) mean points and colours of at most `max_points` voxels with MIN_SAMPLES of the samples (S, 7).

    A voxel's edge is a number of pixels, of the power of two below the size of a pixel at the point: near things keep
    more points. It is the smallest number from 1/2 that leaves so few voxels and 2 MIN_SAMPLES samples in the mean one.
    """
    max_points = max(1, min(max_points, len(samples) // (2 * MIN_SAMPLES)))
    level = np.floor(np.log2(samples[:, 6])).astype(np.int64)
    offset, grid = samples[:, :3] - np.median(samples[:, :3], axis=0), np.exp2(level)[:, None]
    level = np.clip(level - level.min(), 0, 63)

    def voxels(edge: float):
        cells = np.clip(np.floor(offset / (edge * grid)), -(2.0**18), 2.0**18 - 1).astype(np.int64) + 2**18
        ids = ((level * 2**19 + cells[:, 0]) * 2**19 + cells[:, 1]) * 2**19 + cells[:, 2]
        return np.unique(ids, return_inverse=True, return_counts=True)[1:]

    def too_many(edge: float) -> bool:
        return len(voxels(edge)[1]) > max_points

    low = high = 0.5
    while too_many(high):
        low, high = high, 2 * high
    while high / low > 1.02:
        middle = np.sqrt(low * high)
        low, high = (middle, high) if too_many(middle) else (low, middle)
    ids, count = voxels(high)
    mean = np.stack([np.bincount(ids, a) / count for a in (*samples[:, :6].T, grid[:, 0])], axis=1)
    mean = mean[count >= MIN_SAMPLES]
    if len(mean) < 4:
        return mean[:0, :6]
    third = KDTree(mean[:, :3]).query(mean[:, :3], k=4, workers=-1)[0][:, 3]
    return mean[third < ALONE * high * mean[:, 6], :6]


def dense_points(
    capture: Capture, *, max_points: int, progress: Callable[[int, int], None] | None = None
) -> tuple[Float32[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """At most `max_points` points (world) on surfaces that three views agree on, and the mean colour of the pixels that
    each was made of. Held-out frames are not looked at. Deterministic.

    The capture's sparse points say which views belong together and which depths to search; where it has none, they are
    triangulated. Surfaces without texture stay empty, and so do views that move straight ahead (their pairs cannot be
    rectified). Raises InputError where fewer than three views are left or fewer than MIN_POINTS points found.
    """
    require(max_points >= MIN_POINTS, "max_points", max_points, f"at least {MIN_POINTS}", "100000 is usual.")
    views = _views(capture)
    total, report = len(views.frames), progress or (lambda done, total: None)
    if total < AGREEING + 1:
        remedy = "Hold out fewer frames, or start from sparse points."
        raise InputError("capture", f"{total} frames to match", f"at least {AGREEING + 1}", remedy)
    few = len(capture.points) < MIN_POINTS
    sparse = np.asarray(triangulated_points(capture)[0] if few else capture.points, np.float64)
    some = sparse[np.linspace(0, len(sparse) - 1, min(2000, len(sparse))).astype(int)]
    _, depths, inside = _project(views, some)
    partners = _partners(views, some, inside)
    width, height = views.size
    step = max(1, int(np.sqrt(total * width * height / (20 * max_points))))  # enough to average, not all
    known = []
    for t in range(total):
        pairs = []
        if len(partners[t]) >= AGREEING:
            near, far = np.quantile(depths[t][inside[t]], [0.01, 0.99])
            pairs = [_stereo(views, t, int(j), NEAR * near, FAR * far) for j in partners[t]]
        maps = [pair for pair in pairs if pair is not None]
        known.append(_agreed(maps) if len(maps) >= AGREEING else np.zeros((height, width), np.float32))
        report(t + 1, total)
    samples = np.concatenate([_points(views, known, partners, t, step) for t in range(total)])
    merged = _merged(samples, max_points) if len(samples) else samples
    if len(merged) >= MIN_POINTS:
        return merged[:, :3].astype(np.float32), np.rint(merged[:, 3:6]).astype(np.uint8)
    remedy = "The views must overlap sideways and have texture, and the poses be theirs; or start from sparse points."
    raise InputError("capture", f"{len(merged)} points that three views agree on", f"at least {MIN_POINTS}", remedy)


def random_points(capture: Capture, count: int) -> tuple[Float32[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """`count` points drawn at random where two or more of the frames see, with the mean colour of the pixels they fall
    on: for a capture that gives no better start. The same every time.

    Evenly in mip-NeRF 360's contracted space (arXiv 2111.12077, eq. 10), whose unit ball stands about the point nearest
    to all cameras' axes and reaches as far as the farthest camera, and which ends at FARTHEST of that: what stands
    behind the cameras is in the background of others. Held-out frames are not looked at. Raises InputError where less
    than a thousandth of the space is seen by two.
    """
    require(count > 0, "count", count, "positive", "100000 is usual.")
    views, draw = _views(capture), np.random.default_rng(0)
    # The sum of (1 - a a^T)(x - c) over the axes a and centres c is 0 at the nearest point x.
    across = np.eye(3) - np.einsum("ta,tb->tab", views.poses[:, 2, :3], views.poses[:, 2, :3])
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("tab,tb->a", across, views.centres), rcond=None)[0]
    reach = np.linalg.norm(views.centres - focus, axis=1).max(initial=0)
    points, colors, kept, tried, batch = [], [], 0, 0, 20_000
    while kept < count and (tried < 10 * batch or kept > tried / 1000):
        direction, most = draw.normal(size=(batch, 3)), 2 - 1 / FARTHEST
        contracted = most * draw.uniform(0, 1, (batch, 1)) ** (1 / 3)
        away = np.where(contracted < 1, contracted, 1 / (2 - contracted))
        drawn = focus + reach * away * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        pixels, _, inside = _project(views, drawn)
        pixels = np.where(inside[..., None], pixels, 0).astype(int)
        seen = inside.sum(axis=0)
        shades = (own[p[:, 1], p[:, 0]] * i[:, None] for own, p, i in zip(views.frames, pixels, inside))
        mean = sum(shades, np.zeros((batch, 3))) / np.maximum(seen, 1)[:, None]
        points.append(drawn[seen >= 2])
        colors.append(mean[seen >= 2])
        kept, tried = kept + len(points[-1]), tried + batch
    if kept < count:
        found = f"{kept} of {tried} random points in the view of two or more of {len(views.frames)} frames"
        remedy = "Check the poses and their axes (world-to-camera, OpenCV)."
        raise InputError("capture", found, "views that overlap", remedy)
    points, colors = np.concatenate(points)[:count], np.concatenate(colors)[:count]
    return points.astype(np.float32), np.rint(colors).astype(np.uint8)
