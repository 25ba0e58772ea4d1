"""Coordinates of a capture, on the host: rigid poses, and a world of ordinary numbers.

Float32 has 24 bits: of a map projection's coordinates (5e6 m) they leave half a metre. Later steps have constants in
world units made for metres, such as the near plane, which would cut off a scene in kilometres.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded

MAX_RIGID_ERROR = 1e-3
"""largest entry of R R^T - I that counts as rounding in a text file; the rotation is then made exact"""
JUMP = 10.0
"""median steps between neighbouring frames' cameras from which a step is reported. A reconstruction of 125 photographs
with five errors had steps of 11 to 20 there; when right, its largest was 2.2, and that of a walk with one cut 9.9."""
MAX_OFFSET = 100.0
"""distance of the cameras from the origin, in sizes of the scene, above which coordinates become relative to a point"""
MIN_DEPTH, MAX_DEPTH = 0.1, 100.0
"""distance of the nearest things from the cameras, world units, within which the units are kept"""
MAX_SPREAD = 1000.0
"""spread of the cameras, world units, up to which the units are kept if only the cameras are known"""
MIN_SIZE, ROUNDING = 1e-6, 1e-12
"""spread of cameras, also relative to their distance from the origin, that counts as rounding: they stand in one place,
which gives no size"""
UNIT_STEP = 1000.0
"""units change by a power of this, as from millimetres to metres: a scene comes out the same from each unit"""
_MAX_VIEWS, _MAX_POINTS = 64, 20000
"""cameras and points that are used, evenly spaced among all"""
_NEAR_QUANTILE = 0.1
"""of the depths in a view: the near things"""
_VIEW_CONE = 1.0
"""largest |x| / z and |y| / z of a point that counts as in view"""


def make_rigid(pose: Float[np.ndarray, "4 4"], where: object, name: str) -> Float[np.ndarray, "4 4"]:
    """Makes the rotation of a pose exactly orthonormal.

    Args:
      pose: (4, 4) pose, rigid but for rounding.
      where: Name of its file for errors.
      name: Name of its frame for errors.

    Returns:
      The rigid pose, float64.

    Raises:
      InputError: It is not finite, or scales, shears or mirrors.
    """
    pose = np.asarray(pose, np.float64)
    remedy = "Estimate the poses again, or take this frame out of the capture."
    if not is_finite_and_bounded(pose):
        raise InputError(where, f"the pose of {name} has NaN, infinite or absurd numbers", remedy=remedy)
    rotation = pose[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > MAX_RIGID_ERROR or np.linalg.det(rotation) < 0 or not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        measured = f"R R^T is off by {error:.2g}, determinant {np.linalg.det(rotation):.3g}"
        expected = "a rotation and a translation, without scale, shear or mirror"
        raise InputError(where, f"the pose of {name} is not rigid ({measured})", expected, remedy)
    left, _, right = np.linalg.svd(rotation)
    result = pose.copy()
    result[:3, :3] = left @ right
    return result


def camera_jumps(poses: Float[np.ndarray, "t 4 4"], names: Sequence[str]) -> list[str]:
    """Reports places where neighbouring cameras lie more than JUMP median steps apart.

    Args:
      poses: T world-to-camera poses, in the order of the walk.
      names: T frame names.

    Returns:
      One note, or an empty list.
    """
    centres = _centres(poses)
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    median = float(np.median(steps)) if len(steps) else 0.0
    far = np.flatnonzero(steps > JUMP * median)
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
    """Finds the similarity (shift and scale, no rotation) from a capture's world to one of ordinary numbers.

    That is near the origin, and of the size of metres; for most captures it is the identity. A scene that is moved, or
    scaled by a power of 1000, comes out in the same world up to a shift of its own size.

    Args:
      poses: T world-to-camera poses, float64.
      points: P sparse points, float64; P may be 0.
      depths: Depth maps of a few of the views, world units, 0 where unknown; used where there are no points.

    Returns:
      The (4, 4) float64 similarity, and notes on what it changes.
    """
    centres = _centres(poses)
    middle = np.median(centres, axis=0)
    spread = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    near = _near_depth(poses, np.asarray(points, np.float64), depths)
    size = max(near or 0.0, spread)
    if near is None and size < max(MIN_SIZE, ROUNDING * np.abs(middle).max()):  # cameras in one place
        size = 1.0
        near = size
    origin, notes = np.zeros(3), []
    if np.abs(middle).max() > MAX_OFFSET * size:
        step = 10.0 ** np.ceil(np.log10(size))
        origin = np.round(middle / step) * step
        place = ", ".join(f"{number:.10g}" for number in origin)
        notes.append(f"The coordinates are large. jsecon works relative to ({place}) and adds it to what it writes.")
    factor = UNIT_STEP ** _power(size if near is None else near, MAX_SPREAD if near is None else MAX_DEPTH)
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
    """Moves world-to-camera poses into another world; the cameras see the same.

    Args:
      poses: (..., 4, 4) poses.
      world: (4, 4) similarity without rotation, as of `normalizing_transform`.

    Returns:
      (..., 4, 4) poses in the world that `world` leads to.
    """
    if np.array_equal(world, np.eye(4)):
        return poses
    factor = world[0, 0]
    origin = -world[:3, 3] / factor
    moved = np.array(poses, np.float64)
    moved[..., :3, 3] = factor * (poses[..., :3, 3] + poses[..., :3, :3] @ origin)
    return moved


def _power(size: float, most: float) -> int:
    """Power of UNIT_STEP that brings `size` into [MIN_DEPTH, most)."""
    if MIN_DEPTH <= size < most:
        return 0
    low = int(np.ceil(np.log(MIN_DEPTH / size) / np.log(UNIT_STEP) - 1e-9))
    return low if size < MIN_DEPTH else int(np.floor(np.log(most / size) / np.log(UNIT_STEP) - 1e-9))


def _near_depth(poses: np.ndarray, points: np.ndarray, depths: Sequence[np.ndarray]) -> float | None:
    """Distance of the near things from the cameras, in the median view; None if neither points nor depths are known."""
    if len(points):
        chosen = points[_evenly(len(points), _MAX_POINTS)]
        depths = []
        for pose in poses[_evenly(len(poses), _MAX_VIEWS)]:
            x, y, z = pose[:3, :3] @ chosen.T + pose[:3, 3:]
            depths.append(z[(z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= _VIEW_CONE * z)])
    else:
        depths = [depth[depth > 0] for depth in depths]
    near = [np.quantile(depth, _NEAR_QUANTILE) for depth in depths if len(depth)]
    return float(np.median(near)) if near else None


def _evenly(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
