"""The frame of a scene: its centre, its size, and which way is up, from the Gaussians alone or from its cameras.

Host functions on NumPy arrays. All choices are relative to the scene's own size and to the order of its Gaussians, so
that a scene that is turned, scaled or shifted gets the same frame, turned, scaled and shifted with it.
"""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jsecon.errors import InputError
from jsecon.types import Camera, Gaussians, LanguageField

SAMPLES = 6000
"""points that stand for the scene's surface, drawn by opacity times area"""
VISIBLE_OPACITY = 0.1
"""opacity from which a Gaussian counts as surface"""
TRIM = 0.02
"""share of the surface that lies outside the robust bounds on each side of an axis: floaters and far background"""
WIDEST = 0.1
"""largest standard deviation of a surface Gaussian, in units of the scene's diagonal: wider ones are sky or fog"""
TRIPLES = 2000
"""planes that are tried, each through three points"""
PLANE_TOLERANCE = 0.01
"""distance of a plane's points from it, in units of the scene's diagonal"""
RIVAL = 0.5
"""share of the largest plane's surface from which another plane may be the ground"""
SURE_SHARE = 0.1
"""share of the surface in the ground plane from which its direction is trusted"""
ONE_SIDED = 0.85
"""share of the remaining surface on one side of a plane from which it may be the ground"""
MARGIN = 2.0
"""ratio of another such plane's score to that of the ground from which the choice is trusted"""
NEIGHBOURS = 32
"""points that tell which way the surface around a point faces"""
DISTINCT = np.cos(np.radians(20))
"""cosine below which two planes have different normals"""
PARALLEL = 0.01
"""share of the cameras' x axes off their common line up to which they tell the up axis only up to their tilt"""
SAME_WAY = 0.7
"""cosine of the ground's normal with the cameras' up axis from which it is the same way up"""


@dataclasses.dataclass(frozen=True)
class SceneFrame:
    """The robust box of a scene, one axis of which is up.

    Attributes:
      axes: (3, 3) orthonormal rows: two horizontal axes along the box's sides, then up; world.
      centre: (3,) centre of the box, world.
      half: (3,) half extents along the axes, world units.
      sure: Whether the up axis is trusted.
      evidence: What the up axis was taken from, in words.
    """

    axes: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    sure: bool
    evidence: str

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal, world units."""
        return 2 * float(np.linalg.norm(self.half))

    def to_world(self, local: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Maps points in the box into the world.

        Args:
          local: (..., 3), -1 to 1 along each axis.

        Returns:
          (..., 3) points, world.
        """
        return (np.asarray(local) * self.half) @ self.axes + self.centre


def surface_points(gaussians: Gaussians) -> Float[np.ndarray, "p 3"]:
    """Draws points of the scene's surface: centres of Gaussians, by opacity times area.

    Args:
      gaussians: Scene of N Gaussians.

    Returns:
      (P, 3) float64 points, at most `SAMPLES`, the same ones however the scene is turned.

    Raises:
      InputError: The scene has no visible surface.
    """
    means = np.asarray(gaussians.means, np.float64)
    scales = np.sort(np.exp(np.asarray(gaussians.log_scales, np.float64)), axis=1)
    opacity = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits, np.float64)))
    finite = np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(opacity)
    visible = finite & (opacity >= VISIBLE_OPACITY)
    if visible.sum() < 4:
        remedy = "Open it in a viewer to check it. A scene needs visible Gaussians, and more than a few."
        raise InputError("scene", f"{int(visible.sum())} of its {len(means)} Gaussians are visible", "", remedy)
    low, high = np.quantile(means[visible], [TRIM, 1 - TRIM], axis=0)
    size = float(np.linalg.norm(high - low))
    if not size > 0:
        raise InputError("scene", "all of its Gaussians lie in one place", "", "Check how it was exported.")
    visible &= scales[:, 2] <= WIDEST * size
    chosen = np.flatnonzero(visible)
    if len(chosen) < 4:
        raise InputError("scene", "its Gaussians are as wide as itself", "", "Check the scales of the file.")
    weights = opacity[chosen] * scales[chosen, 1] * scales[chosen, 2]
    weights = np.minimum(weights, np.quantile(weights, 0.99))
    rng = np.random.default_rng(0)
    drawn = rng.choice(chosen, min(SAMPLES, 4 * len(chosen)), p=weights / weights.sum())
    return means[drawn]


def scene_frame(points: Float[np.ndarray, "p 3"], up: np.ndarray | None = None) -> SceneFrame:
    """Finds the robust box of a scene and its up axis.

    The ground is a large plane with nearly all of the scene on one side, which is up. Of several such planes (floor,
    ceiling, walls) it is the one with the smallest product of two lengths: the scene's height above it, and the median
    height of what lies in none of them. Without such a plane, up is the direction that fewest surfaces face, as walls
    do not; it is then not trusted.

    Args:
      points: (P, 3) points of the surface (`surface_points`).
      up: (3,) the up axis where it is known.

    Returns:
      The frame.

    Raises:
      InputError: `up` has no direction.
    """
    if up is None:
        up, sure, evidence = _ground_normal(points)
    else:
        up, sure, evidence = _direction(up), True, "given"
    up = up / np.linalg.norm(up)
    side = np.eye(3)[np.argmin(np.abs(up))]
    first = np.cross(up, side)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    flat = np.stack([points @ first, points @ second], axis=1)
    middle = np.median(flat, axis=0)
    size = np.abs(flat - middle).max()
    inner = np.all(np.abs(flat - middle) <= np.quantile(np.abs(flat - middle), 1 - TRIM, axis=0), axis=1)
    (_, _, degrees) = cv2.minAreaRect(((flat[inner] - middle) / size).astype(np.float32))
    turn = np.radians(degrees)
    axes = np.stack([np.cos(turn) * first + np.sin(turn) * second, np.cos(turn) * second - np.sin(turn) * first, up])
    local = points @ axes.T
    low, high = np.quantile(local, [TRIM, 1 - TRIM], axis=0)
    half = np.maximum((high - low) / 2, 1e-3 * np.linalg.norm(high - low))
    return SceneFrame(axes, ((low + high) / 2) @ axes, half, sure, evidence)


def _ground_normal(points: np.ndarray) -> tuple[np.ndarray, bool, str]:
    """Returns the normal of the ground, or what walls tell of it; whether it is trusted, and on what evidence."""
    low, high = np.quantile(points, [TRIM, 1 - TRIM], axis=0)
    tolerance = PLANE_TOLERANCE * float(np.linalg.norm(high - low))
    normals, offsets, shares = _planes(points, tolerance)
    grounds: list[tuple[np.ndarray, np.ndarray, float]] = []  # normal, heights of the points, share of the rest above
    for index in np.argsort(-shares):
        if shares[index] < RIVAL * shares.max():
            break
        normal, offset = _refined(points, normals[index], float(offsets[index]), tolerance)
        heights = points @ normal - offset
        rest = heights[np.abs(heights) > tolerance]
        above = float((rest > 0).mean()) if len(rest) else 1.0
        if above < 0.5:
            normal, heights, above = -normal, -heights, 1 - above
        if above >= ONE_SIDED and all(normal @ other < DISTINCT for other, _, _ in grounds):
            grounds.append((normal, heights, above))
    if not grounds:
        return _along_walls(points), False, "walls: fewest surfaces face it, as no plane has the scene on one side"
    outside = np.all([np.abs(heights) > tolerance for _, heights, _ in grounds], axis=0)
    things = outside if outside.any() else slice(None)
    spans = [np.subtract(*np.quantile(heights, [1 - TRIM, TRIM])) for _, heights, _ in grounds]
    scores = [span * np.median(np.abs(heights[things])) for span, (_, heights, _) in zip(spans, grounds)]
    best = int(np.argmin(scores))
    normal, heights, above = grounds[best]
    share = float((np.abs(heights) <= tolerance).mean())
    clear = outside.any() and (np.delete(scores, best) >= MARGIN * scores[best]).all()
    evidence = f"a plane with {share:.0%} of the surface, and {above:.0%} of the rest above it"
    evidence += f", of {len(grounds)} such planes the one nearest to the things" if len(grounds) > 1 else ""
    return normal, bool(share >= SURE_SHARE and clear), evidence


def _along_walls(points: np.ndarray) -> np.ndarray:
    """Returns the direction that fewest surfaces face, on the side of the sparser half of the points."""
    unique = np.unique(points, axis=0)
    near = unique[KDTree(unique).query(unique, min(NEIGHBOURS, len(unique)))[1]]
    centred = near - near.mean(1, keepdims=True)
    spread, axes = np.linalg.eigh(centred.mT @ centred)
    flatness = (spread[:, 1] - spread[:, 0]) / spread[:, 2]
    normals = axes[:, :, 0]
    up = np.linalg.eigh((flatness[:, None] * normals).T @ normals)[1][:, 0]
    low, middle, high = np.quantile(points @ up, [TRIM, 0.5, 1 - TRIM])
    return up if 2 * middle <= low + high else -up


def _planes(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns planes through random triples of points: normals, offsets, and the share of points near each."""
    rng = np.random.default_rng(1)
    triples = points[rng.integers(len(points), size=(TRIPLES, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    proper = lengths > 0
    normals = normals[proper] / lengths[proper, None]
    offsets = (triples[proper, 0] * normals).sum(1)
    sample = points[:: max(len(points) // 2000, 1)]
    near = np.abs(sample @ normals.T - offsets) <= tolerance
    return normals, offsets, near.mean(0)


def _refined(points: np.ndarray, normal: np.ndarray, offset: float, tolerance: float) -> tuple[np.ndarray, float]:
    """Fits a plane to the points near it, by principal components."""
    near = points[np.abs(points @ normal - offset) <= tolerance]
    middle = near.mean(0)
    fitted = np.linalg.svd(near - middle, full_matrices=False)[2][2]
    fitted *= np.sign(fitted @ normal) or 1.0
    return fitted, float(middle @ fitted)


def _direction(up: Any) -> np.ndarray:
    """Returns a given up axis as a vector (3,) of any length."""
    up = np.asarray(up, np.float64)
    if up.shape != (3,) or not np.isfinite(up).all() or not np.linalg.norm(up) > 0:
        raise InputError("--up", f"{up.tolist()} is no direction", "", "Give three numbers, for example 0 0 1.")
    return up


def scene_up(cameras: Camera) -> Float[np.ndarray, " 3"]:
    """Finds the up axis of a scene from its cameras, which people and planners hold level.

    It is the direction that is most nearly perpendicular to the x axes of all cameras, on the side of their upper
    edges. If all cameras have nearly the same x axis, it is the mean direction of their upper edges.

    Args:
      cameras: T cameras, T >= 1.

    Returns:
      (3,) float64 unit vector, world.
    """
    pose = np.asarray(cameras.world_to_camera, np.float64)
    right = pose[:, 0, :3]
    mean_up = -pose[:, 1, :3].mean(0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0] * (np.sign(vectors[:, 0] @ mean_up) or 1.0)
    if values[1] < PARALLEL and np.linalg.norm(mean_up) > 0:
        up = mean_up
    return up / np.linalg.norm(up)


def field_up(field: LanguageField, up: Sequence[Any] | np.ndarray | None = None) -> Float[np.ndarray, " 3"]:
    """Finds the up axis of a field: that of its cameras; of cameras that all look one way, the ground's if it is sure.

    Args:
      field: The field.
      up: (3,) the up axis in the capture's world where it is known.

    Returns:
      (3,) float64 unit vector in the field's world.

    Raises:
      InputError: `up` has no direction.
    """
    if up is not None:
        own = np.asarray(field.to_source, np.float64)[:3, :3].T @ _direction(up)
        return own / np.linalg.norm(own)
    axis = scene_up(field.cameras)
    right = np.asarray(field.cameras.world_to_camera, np.float64)[:, 0, :3]
    if np.linalg.eigvalsh(right.T @ right / len(right))[1] < PARALLEL:
        with contextlib.suppress(InputError):  # a scene without a surface has no ground
            ground = scene_frame(surface_points(field.gaussians))
            if ground.sure and ground.axes[2] @ axis >= SAME_WAY:
                return ground.axes[2]
    return axis
