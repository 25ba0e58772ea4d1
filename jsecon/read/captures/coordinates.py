"""Coordinates of a capture, on the host: rigid poses, and a world of ordinary numbers.

Float32 has 24 bits: of a map projection's coordinates (5e6 m) they leave half a metre. Later steps have constants in
world units made for metres, such as the near plane, which would cut off a scene in kilometres.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded

_UNIT_STEP = 1000.0
"""units change by a power of this, as from millimetres to metres: a scene comes out the same from each unit"""
_MIN_DEPTH, _MAX_DEPTH = 0.1, 100.0
"""distance of the nearest things from the cameras, world units, within which the units are kept"""
_MAX_SPREAD = 1000.0
"""spread of the cameras, world units, up to which the units are kept if only the cameras are known"""


def make_rigid(pose: Float[np.ndarray, "4 4"], where: object, name: str) -> Float[np.ndarray, "4 4"]:
    """Makes the rotation of a (4, 4) pose exactly orthonormal; `where` and `name` are its file and frame for errors."""
    pose = np.asarray(pose, np.float64)
    remedy = "Estimate the poses again, or take this frame out of the capture."
    if not is_finite_and_bounded(pose):
        raise InputError(where, f"the pose of {name} has NaN, infinite or absurd numbers", remedy=remedy)
    rotation = pose[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > 1e-3 or np.linalg.det(rotation) < 0 or not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        measured = f"R R^T is off by {error:.2g}, determinant {np.linalg.det(rotation):.3g}"
        expected = "a rotation and a translation, without scale, shear or mirror"
        raise InputError(where, f"the pose of {name} is not rigid ({measured})", expected, remedy)
    left, _, right = np.linalg.svd(rotation)
    result = pose.copy()
    result[:3, :3] = left @ right
    return result


def camera_jumps(poses: Float[np.ndarray, "t 4 4"], names: Sequence[str]) -> list[str]:
    """Reports places where neighbouring world-to-camera poses lie more than ten median steps apart: a note, or none.

    A reconstruction of 125 photographs with five errors had steps of 11 to 20 there; when right, its largest was 2.2,
    and that of a walk with one cut 9.9.
    """
    centres = _centres(poses)
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    median = float(np.median(steps)) if len(steps) else 0.0
    far = np.flatnonzero(steps > 10 * median)
    if median == 0 or not len(far):
        return []
    places = ", ".join(f"{names[t]} to {names[t + 1]}" for t in far[:5]) + (" ..." if len(far) > 5 else "")
    return [
        f"The camera jumps in {len(far)} places, by up to {steps.max() / median:.0f} of its usual steps ({places}). "
        "If the frames are one walk, poses there are wrong: check them before you trust the fit."
    ]


def _centres(poses: np.ndarray) -> np.ndarray:
    """(T, 3) camera centres of world-to-camera poses."""
    return -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])


def normalizing_transform(
    poses: Float[np.ndarray, "t 4 4"], points: Float[np.ndarray, "p 3"], depths: Sequence[Float[np.ndarray, "h w"]] = ()
) -> tuple[Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """Finds the similarity (shift and scale, no rotation) from a capture's world to one of ordinary numbers, and notes.

    That is near the origin, and of the size of metres; for most captures it is the identity. A scene that is moved, or
    scaled by a power of 1000, comes out in the same world up to a shift of its own size. Depth maps of a few views, in
    world units with 0 where unknown, stand in for missing points.
    """
    centres = _centres(poses)
    middle = np.median(centres, axis=0)
    spread = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    near = _near_depth(poses, np.asarray(points, np.float64), depths)
    size = max(near or 0.0, spread)
    if near is None and size < max(1e-6, 1e-12 * np.abs(middle).max()):  # rounding: the cameras stand in one place
        size = 1.0
        near = size
    origin, notes = np.zeros(3), []
    if np.abs(middle).max() > 100 * size:
        step = 10.0 ** np.ceil(np.log10(size))
        origin = np.round(middle / step) * step
        place = ", ".join(f"{number:.10g}" for number in origin)
        notes.append(f"The coordinates are large. jsecon works relative to ({place}) and adds it to what it writes.")
    factor = _UNIT_STEP ** _power(size if near is None else near, _MAX_SPREAD if near is None else _MAX_DEPTH)
    if factor != 1:
        notes.append(
            f"The units are far from metres: the near things are {size if near is None else near:.3g} away. "
            f"jsecon works at {factor:g} times the size and writes the units of the files."
        )
    result = np.diag([factor, factor, factor, 1.0])
    result[:3, 3] = -factor * origin
    return result, tuple(notes)


def transform_poses(
    poses: Float[np.ndarray, "... 4 4"], world: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "... 4 4"]:
    """Moves world-to-camera poses by a similarity of the world, without rotation: the cameras see the same."""
    if np.array_equal(world, np.eye(4)):
        return poses
    factor = world[0, 0]
    origin = -world[:3, 3] / factor
    moved = np.array(poses, np.float64)
    moved[..., :3, 3] = factor * (poses[..., :3, 3] + poses[..., :3, :3] @ origin)
    return moved


def _power(size: float, limit: float) -> int:
    """Power of _UNIT_STEP that brings `size` into [_MIN_DEPTH, limit)."""
    if _MIN_DEPTH <= size < limit:
        return 0
    low = int(np.ceil(np.log(_MIN_DEPTH / size) / np.log(_UNIT_STEP) - 1e-9))
    return low if size < _MIN_DEPTH else int(np.floor(np.log(limit / size) / np.log(_UNIT_STEP) - 1e-9))


def _near_depth(poses: np.ndarray, points: np.ndarray, depths: Sequence[np.ndarray]) -> float | None:
    """Distance of the near things from the cameras, in the median view; None if neither points nor depths are known."""
    if len(points):
        chosen = points[_evenly(len(points), 20000)]
        depths = []
        for pose in poses[_evenly(len(poses), 64)]:
            x, y, z = pose[:3, :3] @ chosen.T + pose[:3, 3:]
            depths.append(z[(z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= z)])
    else:
        depths = [depth[depth > 0] for depth in depths]
    near = [np.quantile(depth, 0.1) for depth in depths if len(depth)]
    return float(np.median(near)) if near else None


def _evenly(count: int, limit: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))
