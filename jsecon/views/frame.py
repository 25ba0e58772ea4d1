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
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jsecon.errors import InputError
from jsecon.numerics import axes_across
from jsecon.types import Camera, Gaussians, LanguageField, UpAxis
from jsecon.views.upright import TRIM, find_up

_DIRECTIONS = 1500
"""directions that `_up_of_cameras` judges, 5 degrees apart"""
_ROLL_BINS = 45
_ROLL_SPREAD = 2 * np.pi / _ROLL_BINS
"""radians, of the rolls of cameras that are held alike"""
_LINK = 0.35
"""distance, in radii of the inner scene, from which points are not connected to it"""
_FAR = 3.0
"""radii from the centre beyond which surroundings lie"""
_FAR_SHARE, _FAR_MASS = 0.01, 0.05
"""surroundings are at least this share of the Gaussians, and at most this share of number times density"""
_QUARTERS = np.radians([0.0, 90.0, 180.0, 270.0])


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


def inner_scene(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Tells which Gaussians belong to the scene and not to its far surroundings, such as a sky or distant houses.

    The inner scene starts as the ball with most number times density per radius, and grows over what is dense and near
    it. What is left are surroundings if they are far and sparse, and what is sparse near the scene then goes with them.
    Otherwise all Gaussians belong to the scene.
    """
    means = np.asarray(gaussians.means, np.float64)
    visible = np.isfinite(means).all(1) & (np.asarray(gaussians.opacity_logits, np.float64) >= np.log(0.1 / 0.9))
    everything = np.ones(len(means), bool)
    if visible.sum() < 16:
        return everything
    points = means[visible]
    sample = np.linspace(0, len(points) - 1, min(len(points), 4000))  # its spacing is the same for any number
    points = points[np.unique(sample.astype(int))]
    spacing = KDTree(points).query(points, 9)[0][:, -1]
    spacing = np.maximum(spacing, np.quantile(spacing, 0.05))
    if not spacing.min() > 0:
        return everything
    mass = (spacing.min() / spacing) ** 2
    order = points.argsort(axis=0)
    middle = [np.searchsorted(running, running[-1] / 2) for running in mass[order].cumsum(axis=0).T]
    centre = np.take_along_axis(points, order, axis=0)[middle, np.arange(3)]
    distance = np.linalg.norm(points - centre, axis=1)
    outwards = distance.argsort()
    held = mass[outwards].cumsum()
    per_radius = np.where(held >= held[-1] / 2, held / np.maximum(distance[outwards], spacing.min()), 0)
    radius = distance[outwards[per_radius.argmax()]]
    inside, count = distance <= radius, 0
    while count < inside.sum():
        count = inside.sum()
        reach = KDTree(points[inside]).query(points, distance_upper_bound=_LINK * radius)[0]
        inside |= (np.isfinite(reach) | (distance <= _FAR * radius)) & (spacing <= _LINK * radius)
        radius = max(radius, np.quantile(distance[inside], 1 - TRIM))
    far = distance > _FAR * radius
    if far.mean() < _FAR_SHARE or mass[far].sum() > _FAR_MASS * mass.sum():
        return everything
    reach = KDTree(points[inside]).query(np.nan_to_num(means), distance_upper_bound=_LINK * radius)[0]
    return np.isfinite(reach)


def surface_points(gaussians: Gaussians) -> Float[np.ndarray, "p 3"]:
    """Draws up to 20,000 points of a scene's surface: centres of Gaussians, by opacity times area.

    They are the same ones however the scene is turned, and its surroundings have none (`inner_scene`). InputError is
    raised if the scene has no visible surface.
    """
    means = np.asarray(gaussians.means, np.float64)
    scales = np.sort(np.exp(np.asarray(gaussians.log_scales, np.float64)), axis=1)
    opacity = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits, np.float64)))
    finite = np.isfinite(means).all(1) & np.isfinite(scales).all(1) & np.isfinite(opacity)
    visible = finite & (opacity >= 0.1)
    if visible.sum() < 4:
        remedy = "Open it in a viewer to check it. A scene needs visible Gaussians, and more than a few."
        raise InputError("scene", f"{int(visible.sum())} of its {len(means)} Gaussians are visible", "", remedy)
    visible &= inner_scene(gaussians)
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
        up, sure, evidence = np.asarray(up, np.float64), True, "given"
    up = up / np.linalg.norm(up)
    first, second = axes_across(up)
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


def _up_of_cameras(cameras: Camera) -> UpAxis:
    """Finds the up axis of a scene from its cameras, whatever their roll.

    People hold cameras level or turned by a quarter, all alike or some of them, turn around more than they look up and
    down, and look down more than up. Each direction is judged by that. The best one is then made exact: it is across
    the x axes of the cameras without their roll, or the mean of their upper edges if they all look one way.

    It is sure if the cameras are level or turned by quarters, many of them level, and no other direction fits as well;
    and if they do not look up in the mean, as those that are turned by 180 degrees would.
    """
    pose = np.asarray(cameras.world_to_camera, np.float64)
    pose = pose[np.linspace(0, len(pose) - 1, min(len(pose), 64)).astype(int), :3, :3]
    right, down, ahead = pose.transpose(1, 0, 2)
    steps = np.arange(_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * steps / _DIRECTIONS, steps * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)

    scores, shared = _judge_cameras(directions, right, down, ahead)
    best = int(scores.argmax())
    others = np.abs(directions @ directions[best]) < np.cos(np.radians(30))
    up, roll = directions[best], shared[best]
    offsets = np.append(_QUARTERS, roll if np.cos(4 * roll) < np.cos(np.radians(40)) else 0.0)  # else it is a quarter
    for _ in range(3):
        rolls = _rolls(up[None], right, down)[0]
        nearest = offsets[np.cos(rolls[:, None] - offsets).argmax(1)]
        kept = np.cos(rolls - nearest) >= np.cos(np.radians(20))
        if not kept.any():
            break
        cosine, sine = np.cos(nearest[kept, None]), np.sin(nearest[kept, None])
        level = cosine * right[kept] + sine * down[kept]
        edge = (sine * right[kept] - cosine * down[kept]).mean(0)
        values, vectors = np.linalg.eigh(level.T @ level / len(level))
        across = vectors[:, 0] * (np.sign(vectors[:, 0] @ edge) or 1.0)
        up = edge if values[1] < 0.01 and np.linalg.norm(edge) > 1e-6 else across
        up = up / np.linalg.norm(up)
    ends, _ = _judge_cameras(np.stack([up, -up]), right, down, ahead)
    up = up if ends[0] >= ends[1] else -up
    from_quarters = np.cos(_rolls(up[None], right, down)[0][:, None] - _QUARTERS) >= np.cos(np.radians(20))  # (T, 4)
    is_clear = from_quarters.any(1).mean() >= 0.85 and scores[best] - scores[others].max() >= 0.8
    is_clear &= (ahead @ up).mean() <= 0.05  # else they may stand on their heads instead of looking up
    level = from_quarters[:, 0].mean()
    evidence = "the cameras, which are level" if level >= 0.85 else "the cameras, with their roll taken out"
    return UpAxis(tuple(up.tolist()), evidence, bool(is_clear and level >= 0.4))


def _judge_cameras(
    directions: np.ndarray, right: np.ndarray, down: np.ndarray, ahead: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Judges directions (D, 3): how usual the cameras' rolls and pitches are if it is up, and their commonest roll.

    `right`, `down` and `ahead` are the axes (T, 3) of the cameras.
    """
    rolls, pitches = _rolls(directions, right, down), directions @ ahead.T
    shared = _commonest_roll(rolls)
    usual = _usual_roll(rolls, _ROLL_SPREAD)
    likely = np.log(0.5 * _peak(rolls - shared[:, None], _ROLL_SPREAD) + usual + 0.02).mean(1)
    prior = np.log(_usual_roll(shared, 1.5 * _ROLL_SPREAD) + 1e-3) - 0.5 * ((pitches.mean(1) + 0.3) / 0.45) ** 2
    return likely - np.log(pitches.std(1) + 0.1) + prior / len(right), shared


def _rolls(directions: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(D, T) angle of each direction in the image plane of each camera, from its upper edge."""
    return np.arctan2(directions @ right.T, -directions @ down.T)


def _peak(angles: np.ndarray, width: float) -> np.ndarray:
    """A bell of height 1 around an angle of 0, that repeats."""
    return np.exp((np.cos(angles) - 1) / width**2)


def _usual_roll(rolls: np.ndarray, width: float) -> np.ndarray:
    """How usual a roll is: level, then a quarter turn, then upside down."""
    shares = (0.4, 0.2, 0.05, 0.2)
    return sum((share * _peak(rolls - quarter, width) for share, quarter in zip(shares, _QUARTERS)), np.zeros(()))


def _commonest_roll(rolls: np.ndarray) -> np.ndarray:
    """(D,) roll near which most of the T rolls (D, T) are."""
    bins = np.round(rolls / _ROLL_SPREAD).astype(int) % _ROLL_BINS
    counts = np.stack([(bins == bin).sum(1) for bin in range(_ROLL_BINS)], axis=1)
    centre = (counts + 0.7 * (np.roll(counts, 1, 1) + np.roll(counts, -1, 1))).argmax(1) * _ROLL_SPREAD
    offset = rolls - centre[:, None]
    near = np.cos(offset) >= np.cos(2 * _ROLL_SPREAD)
    return centre + np.arctan2((near * np.sin(offset)).sum(1), (near * np.cos(offset)).sum(1))


def find_up_axis(gaussians: Gaussians, cameras: Camera) -> UpAxis:
    """Finds the up axis of a scene: from what rests on what if that is sure, else from the cameras.

    It is not sure where cameras that are surely level tell otherwise. Where the cameras only tell an axis, not which
    end of it is up, the scene does.
    """
    from_cameras = _up_of_cameras(cameras)
    axis = np.array(from_cameras.axis)
    with contextlib.suppress(InputError):  # a scene without a surface
        up, sure, evidence = find_up(surface_points(gaussians))
        if sure:
            agree = not from_cameras.sure or up @ axis >= 0.9
            return UpAxis(tuple(up.tolist()), f"the scene, {evidence}", bool(agree))
        if not from_cameras.sure and up @ axis < -0.9:
            return UpAxis(tuple((-axis).tolist()), f"{from_cameras.evidence}, and the scene", False)
    return from_cameras


def field_up(field: LanguageField, up: Sequence[Any] | np.ndarray | None = None) -> UpAxis:
    """Finds the up axis of a field in its world: the one in its file, else `find_up_axis`.

    Args:
      field: The field.
      up: (3,) the up axis in the capture's world where it is known.
    """
    if up is None:
        return field.up or find_up_axis(field.gaussians, field.cameras)
    turned = np.asarray(field.source_from_scene, np.float64)[:3, :3].T @ np.asarray(up, np.float64)
    return UpAxis(tuple((turned / np.linalg.norm(turned)).tolist()), "what was given")
