"""Which way is up in a scene, from points of its surface alone. Host functions on NumPy arrays.

Both directions of every plane's normal are candidates. Each gets a score, a sum of log-odds, from what gravity does:

- things rest on a plane or on the lowest level, and do not hang in the air;
- the scene rests on a wide base, not on an edge;
- most of what lies in no plane is low;
- where three things or more end at one level, as the legs of a table do, that level is below;
- a wide plane above the scene is a ceiling, and then there is a wide one below.

All of it follows a scene that is turned, scaled or shifted.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy import sparse  # loads csgraph on its first use
from scipy.spatial import KDTree

from jsecon.numerics import axes_across

TRIM = 0.02
"""share of the surface that lies outside the robust bounds on each side of an axis: floaters and far background"""
_PLANE_TOLERANCE = 0.01
"""distance of a plane's points from it, in units of the scene's size"""
_MIN_SHARE = 0.04
"""share of the points in a plane"""
_LEVEL = 0.985
"""cosine of a plane's normal with a direction from which the plane is level"""
_DISTINCT = np.cos(np.radians(20))
"""cosine below which two directions differ"""
_RESTS, _HANGS = 1.1, -1.95
"""log-odds of a direction for a thing that rests on something, and for one that hangs in the air, if 0.9 of the things
rest along the true direction and 0.3 along another"""
_BASE = 0.2
"""share of the scene's footprint that a base covers which carries it"""
_FEET = 3
"""number of things that end at one level where no plane is, from which they are legs"""
_SURE = 2.5
"""difference of the best two scores from which the direction is trusted, if at least half of the things rest; twice as
much where there are fewer than _FEET things"""


class _Plane(NamedTuple):
    normal: np.ndarray
    offset: float
    points: np.ndarray
    """(M, 3) points near it"""


class _Candidate(NamedTuple):
    """A direction, and what speaks for it."""

    up: np.ndarray
    score: float
    legs: bool
    """whether things end at one level where no plane is"""
    resting: int
    share: float
    """of the things that rest, by the roots of their sizes"""
    carries: bool
    """whether the scene has a base in this direction"""


def find_up(points: np.ndarray) -> tuple[np.ndarray, bool, str]:
    """Finds the up axis of a scene from points (P, 3) of its surface.

    Returns a unit vector (3,), whether it is trusted, and what it was taken from, in words.

    Where too little rests, as in a fitted room with floaters, it is the normal of a large plane with nearly all of the
    scene above it. Without such a plane it is the direction that fewest surfaces face, as walls do not; it is then not
    trusted.
    """
    size = 2 * float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 1 - TRIM))
    tolerance = _PLANE_TOLERANCE * size
    planes = _planes(points, tolerance)
    outside = np.all([np.abs(points @ plane.normal - plane.offset) > 1.5 * tolerance for plane in planes], axis=0)
    loose = points[outside] if planes and outside.any() else points
    distinct = np.unique(points, axis=0)
    spacing = float(np.median(KDTree(distinct).query(distinct[::3], min(4, len(distinct)))[0][:, -1]))
    min_points = max(12.0, 0.004 * len(distinct))  # less is what sticks out of a wall
    things = _things(loose, max(2 * tolerance, 3 * spacing), min_points) if planes else []
    normals = [sign * plane.normal for plane in planes for sign in (1, -1)]
    candidates = [_judge(normal, points, planes, loose, things, size, spacing) for normal in normals]
    scores = []
    for candidate in candidates:
        legs_point_up = any(other.legs and other.up @ candidate.up < -_DISTINCT for other in candidates)
        scores.append(candidate.score - 2.0 * legs_point_up if candidate.carries else -np.inf)
    order = np.argsort(scores)[::-1]
    best = candidates[order[0]] if len(order) and np.isfinite(scores[order[0]]) else None
    others = [score for score, each in zip(scores, candidates) if best is not None and each.up @ best.up < _DISTINCT]
    margin = 0.0 if best is None else scores[order[0]] - max(others, default=-np.inf)
    # Pieces of walls and floaters of a fitted room rest on nothing.
    if best is None or (scores[order[0]] < 0.5 and margin < _SURE):
        ground = _ground_normal(points, planes, loose, tolerance)
        if ground is None:
            return _along_walls(points), False, "walls: fewest surfaces face it, as no plane carries the scene"
        return ground, False, "a plane with nearly all of the scene above it, and low things"
    count = len(things)
    sure = count and best.share >= 0.5 and margin >= (_SURE if count >= _FEET else 2 * _SURE)
    evidence = f"{best.resting} of {count} thing{'s' * (count != 1)} that rest{'s' * (count == 1)} on what is below"
    evidence = evidence if count else "the base on which the scene is widest and lowest"
    return _exact(best.up, planes, points, tolerance), bool(sure), evidence


def _exact(up: np.ndarray, planes: list[_Plane], points: np.ndarray, tolerance: float) -> np.ndarray:
    """Returns the direction again, as all points of its largest level plane tell it."""
    plane = max((plane for plane in planes if abs(plane.normal @ up) > _LEVEL), key=lambda plane: len(plane.points))
    normal, _ = _refined(points, plane.normal, plane.offset, tolerance)
    return normal * np.sign(normal @ up)


def _ground_normal(points: np.ndarray, planes: list[_Plane], loose: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Returns the normal of the plane that the scene is lowest above, if nearly all of it is on one side of any."""
    best, lowest = None, np.inf
    largest = max((len(plane.points) for plane in planes), default=0)
    large = [plane for plane in planes if len(plane.points) >= 0.5 * largest]
    for normal, offset in ((sign * plane.normal, sign * plane.offset) for plane in large for sign in (1, -1)):
        heights = points @ normal - offset
        rest = heights[np.abs(heights) > tolerance]
        if len(rest) and (rest > 0).mean() >= 0.85:
            height = np.subtract(*np.quantile(heights, [1 - TRIM, TRIM])) * np.median(np.abs(loose @ normal - offset))
            best, lowest = (normal, height) if height < lowest else (best, lowest)
    return best


def _judge(
    up: np.ndarray,
    points: np.ndarray,
    planes: list[_Plane],
    loose: np.ndarray,
    things: list[np.ndarray],
    size: float,
    spacing: float,
) -> _Candidate:
    """Judges a direction by what would rest on what."""
    tolerance = _PLANE_TOLERANCE * size
    touch = 1.5 * (tolerance + spacing)
    heights = points @ up
    low, high = np.quantile(heights, [0.005, 1 - TRIM])
    whole = max(_footprint(points[(heights >= low) & (heights <= high)], up), 1e-30)
    base = _footprint(points[heights <= low + 1.5 * tolerance], up) / whole
    level = [plane for plane in planes if abs(plane.normal @ up) > _LEVEL]
    places = [float(np.sign(plane.normal @ up) * plane.offset) for plane in level]
    covered = [_footprint(plane.points, up) / whole for plane in level]
    large = [place for place, share in zip(places, covered) if share >= 0.5]  # floors and ceilings
    has_ceiling = any(place >= high - 3 * tolerance for place in large)
    has_floor = any(place <= low + 3 * tolerance for place in large)
    on_ground = any(abs(place - low) <= 2 * tolerance for place in places)
    trees = [KDTree(plane.points) for plane in level]
    rests, weights, feet = [], [], 0
    for thing in things:
        thing_heights = thing @ up
        bottom = float(np.partition(thing_heights, 4)[4])  # a few strays may lie below
        foot = thing[thing_heights <= bottom + tolerance]
        stands = bottom <= low + touch and base >= _BASE
        feet += stands and not on_ground
        for place, tree in zip(places, trees):
            stands = stands or (abs(bottom - place) <= touch and tree.query(foot)[0].min() <= 2 * touch)
        rests.append(stands)
        weights.append(np.sqrt(len(thing)))
    share = float(np.average(rests, weights=weights)) if things else 0.0
    # What is on one table is not independent: at most six things count.
    score = min(len(things), 6) * (_RESTS * share + _HANGS * (1 - share)) - 1.5 * (has_ceiling and not has_floor)
    score -= np.log(np.median(np.maximum(loose @ up - low, 0)) / max(high - low, 1e-30) + 0.1)
    score -= 0.3 * np.log(max(high - low, 1e-30) / size)
    widest = max([base, *covered])
    score += np.log(max(widest, 1e-3))
    carries = widest >= _BASE
    return _Candidate(up, float(score), feet >= _FEET and widest > 0.4, int(sum(rests)), share, carries)


def _things(points: np.ndarray, reach: float, min_points: float) -> list[np.ndarray]:
    """Returns the points of each thing: `min_points` or more that steps of at most `reach` connect."""
    points = np.unique(points, axis=0)
    distance, near = KDTree(points).query(points, 12)
    linked = np.asarray(distance) <= reach
    ends = np.asarray(near)[linked], np.concatenate([[0], np.cumsum(linked.sum(1))])
    graph = sparse.csr_array((np.ones(len(ends[0])), *ends), shape=(len(points), len(points)))
    count, thing = sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(thing, minlength=count)
    return [points[thing == k] for k in np.flatnonzero(sizes >= min_points)]


def _footprint(points: np.ndarray, up: np.ndarray) -> float:
    """Area of the convex hull of points seen along a direction."""
    if len(points) < 3:
        return 0.0
    flat = points @ axes_across(up).T
    flat -= flat.mean(0)
    size = float(np.abs(flat).max()) or 1.0
    return size**2 * cv2.contourArea(cv2.convexHull((flat / size).astype(np.float32)))


def _planes(points: np.ndarray, tolerance: float) -> list[_Plane]:
    """Finds planes, the largest first; the points of one count for no other."""
    sample = points[:: max(len(points) // 2000, 1)]
    normals, offsets = _trial_planes(sample)
    distance = np.abs(sample @ normals.T - offsets)
    sharp = _is_sharp(distance, tolerance, 1.6)  # roughly: they are not fitted yet
    normals, offsets, near = normals[sharp], offsets[sharp], distance[:, sharp] <= tolerance
    left = np.ones(len(sample), bool)
    counts = near.sum(0)
    planes: list[_Plane] = []
    for _ in range(60 if len(counts) else 0):
        trial = int(counts.argmax())
        if counts[trial] < _MIN_SHARE * len(sample) or len(planes) == 10:
            break
        normal, offset = normals[trial], float(offsets[trial])
        for _ in range(2):
            normal, offset = _refined(sample[left], normal, offset, tolerance)
        distance = np.abs(sample @ normal - offset)
        inside = left & (distance <= tolerance)
        # A plane at a small angle to a larger one cuts through things on it. One that cuts through things is mostly
        # empty.
        is_tilted = any(0.9 < abs(normal @ other.normal) < 0.998 for other in planes)
        is_surface = inside.sum() >= _MIN_SHARE * len(sample) and bool(_is_sharp(distance[left], tolerance, 2.4))
        if is_tilted or not is_surface or _filled(sample[inside], normal) < 0.6:
            counts[trial] = 0
            continue
        near_plane = left & (distance <= 1.5 * tolerance)
        left &= ~near_plane
        counts = counts - near[near_plane].sum(0)
        planes.append(_Plane(normal, offset, points[np.abs(points @ normal - offset) <= tolerance]))
    return planes


def _trial_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns normals and offsets of planes through 2,000 triples of points, half of neighbours: for small planes."""
    draw = np.random.default_rng(1)
    count = len(points)
    first = draw.integers(count, size=2000)
    others = draw.integers(count, size=(2000, 2))
    near = np.asarray(KDTree(points).query(points[first[1::2]], min(100, count))[1])
    picks = draw.integers(near.shape[1], size=(len(near), 2))
    others[1::2] = np.take_along_axis(near, picks, axis=1)
    corners = points[first], points[others[:, 0]], points[others[:, 1]]
    normals = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    lengths = np.linalg.norm(normals, axis=1)
    proper = lengths > 0
    normals = normals[proper] / lengths[proper, None]
    return normals, (corners[0][proper] * normals).sum(1)


def _is_sharp(distance: np.ndarray, tolerance: float, ratio: float) -> Any:
    """Whether the points near a plane, of distances (M, ...), are `ratio` times those in the layer around them.

    At the tolerance or at half of it: the two faces of a board are two layers.
    """
    half, near, around = ((distance <= times * tolerance).sum(0) for times in (0.5, 1, 2))
    return (near >= ratio * (around - near)) | (half >= ratio * (near - half))


def _refined(points: np.ndarray, normal: np.ndarray, offset: float, tolerance: float) -> tuple[np.ndarray, float]:
    """Fits a plane to the points near it, by principal components."""
    near = points[np.abs(points @ normal - offset) <= tolerance]
    if len(near) < 3:
        return normal, offset
    middle = near.mean(0)
    fitted = np.linalg.svd(near - middle, full_matrices=False)[2][2]
    fitted *= np.sign(fitted @ normal) or 1.0
    return fitted, float(middle @ fitted)


def _filled(points: np.ndarray, normal: np.ndarray) -> float:
    """Share of the cells of an 8 x 8 grid over points of a plane that have points."""
    offsets = points - points.mean(0)
    offsets -= (offsets @ normal)[:, None] * normal
    flat = offsets @ np.linalg.eigh(offsets.T @ offsets)[1][:, 1:]
    ends = np.quantile(flat, [TRIM, 1 - TRIM], axis=0)
    cells = np.histogram2d(*flat.T, bins=8, range=ends.T)[0]
    return float((cells > 0).mean())


def _along_walls(points: np.ndarray) -> np.ndarray:
    """Returns the direction that fewest surfaces face, on the side of the sparser half of the points."""
    unique = np.unique(points, axis=0)
    near = unique[KDTree(unique).query(unique, min(32, len(unique)))[1]]
    centred = near - near.mean(1, keepdims=True)
    spread, axes = np.linalg.eigh(centred.mT @ centred)
    flatness = (spread[:, 1] - spread[:, 0]) / spread[:, 2]
    normals = axes[:, :, 0]
    up = np.linalg.eigh((flatness[:, None] * normals).T @ normals)[1][:, 0]
    low, middle, high = np.quantile(points @ up, [TRIM, 0.5, 1 - TRIM])
    return up if 2 * middle <= low + high else -up
