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

from jsecon.errors import InputError
from jsecon.types import Camera, Gaussians, LanguageField
from jsecon.views.upright import TRIM, find_up

SAMPLES = 20_000
"""points that stand for the scene's surface, drawn by opacity times area"""
VISIBLE_OPACITY = 0.1
"""opacity from which a Gaussian counts as surface"""
WIDEST = 0.1
"""largest standard deviation of a surface Gaussian, in units of the scene's diagonal: wider ones are sky or fog"""
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

    Args:
      points: (P, 3) points of the surface (`surface_points`).
      up: (3,) the up axis where it is known; None finds it (`find_up`).

    Returns:
      The frame.

    Raises:
      InputError: `up` has no direction.
    """
    if up is None:
        up, sure, evidence = find_up(points)
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
        own = np.asarray(field.source_from_scene, np.float64)[:3, :3].T @ _direction(up)
        return own / np.linalg.norm(own)
    axis = scene_up(field.cameras)
    right = np.asarray(field.cameras.world_to_camera, np.float64)[:, 0, :3]
    if np.linalg.eigvalsh(right.T @ right / len(right))[1] < PARALLEL:
        with contextlib.suppress(InputError):  # a scene without a surface has no ground
            ground = scene_frame(surface_points(field.gaussians))
            if ground.sure and ground.axes[2] @ axis >= SAME_WAY:
                return ground.axes[2]
    return axis
