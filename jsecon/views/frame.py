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


@dataclasses.dataclass(frozen=True)
class SceneFrame:
    """The robust box of a scene, one axis of which is up."""

    axes: np.ndarray
    """(3, 3) orthonormal rows: two horizontal axes along the box's sides, then up; world."""
    centre: np.ndarray
    """(3,) centre of the box, world."""
    half: np.ndarray
    """(3,) half extents along the axes, world units."""
    sure: bool
    """Whether the up axis is trusted."""
    evidence: str
    """What the up axis was taken from, in words."""

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal, world units."""
        return 2 * float(np.linalg.norm(self.half))


def surface_points(gaussians: Gaussians) -> Float[np.ndarray, "p 3"]:
    """Draws up to 20,000 points of a scene's surface: centres of Gaussians, by opacity times area.

    They are the same ones however the scene is turned. InputError is raised if the scene has no visible surface.
    """
    means = np.asarray(gaussians.means, np.float64)
    scales = np.sort(np.exp(np.asarray(gaussians.log_scales, np.float64)), axis=1)
    opacity = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits, np.float64)))
    finite = np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(opacity)
    visible = finite & (opacity >= 0.1)
    if visible.sum() < 4:
        remedy = "Open it in a viewer to check it. A scene needs visible Gaussians, and more than a few."
        raise InputError("scene", f"{int(visible.sum())} of its {len(means)} Gaussians are visible", "", remedy)
    low, high = np.quantile(means[visible], [TRIM, 1 - TRIM], axis=0)
    size = float(np.linalg.norm(high - low))
    if not size > 0:
        raise InputError("scene", "all of its Gaussians lie in one place", "", "Check how it was exported.")
    visible &= scales[:, 2] <= 0.1 * size  # wider ones are sky or fog
    chosen = np.flatnonzero(visible)
    if len(chosen) < 4:
        raise InputError("scene", "its Gaussians are as wide as itself", "", "Check the scales of the file.")
    weights = opacity[chosen] * scales[chosen, 1] * scales[chosen, 2]
    weights = np.minimum(weights, np.quantile(weights, 0.99))
    rng = np.random.default_rng(0)
    drawn = rng.choice(chosen, min(20_000, 4 * len(chosen)), p=weights / weights.sum())
    return means[drawn]


def scene_frame(points: Float[np.ndarray, "p 3"], up: np.ndarray | None = None) -> SceneFrame:
    """Finds the robust box of a scene and its up axis.

    Args:
      points: Points of the surface (`surface_points`).
      up: (3,) the up axis where it is known, of any length; None finds it (`find_up`).
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
    """Finds the up axis (unit, world) of a scene from its cameras, which people and planners hold level.

    It is the direction that is most nearly perpendicular to the x axes of all cameras, on the side of their upper
    edges. If all cameras have nearly the same x axis, it is the mean direction of their upper edges, unless these
    cancel.
    """
    up = _perpendicular_up(cameras)[0]
    return up / np.linalg.norm(up)


def _perpendicular_up(cameras: Camera) -> tuple[np.ndarray, bool]:
    """Returns the direction of `scene_up`, and whether all cameras have nearly the same x axis."""
    pose = np.asarray(cameras.world_to_camera, np.float64)
    right = pose[:, 0, :3]
    mean_up = -pose[:, 1, :3].mean(0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0] * (np.sign(vectors[:, 0] @ mean_up) or 1.0)
    is_parallel = bool(values[1] < 0.01)  # the x axes tell the up axis only up to the cameras' tilt
    return mean_up if is_parallel and np.linalg.norm(mean_up) > 1e-6 else up, is_parallel


def field_up(field: LanguageField, up: Sequence[Any] | np.ndarray | None = None) -> Float[np.ndarray, " 3"]:
    """Finds the up axis of a field (unit, the field's world).

    It is that of its cameras, or of cameras that all look one way the ground's if it is sure.

    Args:
      field: The field.
      up: (3,) the up axis in the capture's world where it is known.
    """
    if up is not None:
        turned = np.asarray(field.source_from_scene, np.float64)[:3, :3].T @ _direction(up)
        return turned / np.linalg.norm(turned)
    axis, is_parallel = _perpendicular_up(field.cameras)
    axis = axis / np.linalg.norm(axis)
    if is_parallel:
        with contextlib.suppress(InputError):  # a scene without a surface has no ground
            ground = scene_frame(surface_points(field.gaussians))
            if ground.sure and ground.axes[2] @ axis >= 0.7:  # the same way up
                return ground.axes[2]
    return axis
