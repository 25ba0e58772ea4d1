"""The world of a capture, of ordinary numbers: near the origin and of the size of metres.

Float32 has 24 bits: a map projection's coordinates (5e6 m) leave half a metre of them. And what is fixed in world units
further on (the near plane) is made for metres: it cuts off a scene in kilometres.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

FAR = 100.0
"""sizes of the scene that its cameras lie from the origin, from where on coordinates are made relative to a point"""
NEAREST, FARTHEST = 0.1, 100.0
"""distance of the near things from the cameras, world units, within which the units are kept"""
WIDEST = 1000.0
"""spread of the cameras, world units, up to which the units are kept where only the cameras are known"""
LEAST_SIZE, ROUNDING = 1e-6, 1e-12
"""spread of cameras, also in units of their distance from the origin, that is taken for rounding: they stand in one
place, which tells no size"""
STEP = 1000.0
"""the units are changed by a power of this, as from millimetres to metres: a scene comes out the same from each unit"""
_VIEWS, _POINTS = 64, 20000
"""cameras and points that are looked at, evenly spaced among all"""
_QUANTILE = 0.1
"""of the depths in a view: the near things"""
_CONE = 1.0
"""largest |x| / z and |y| / z of a point that counts as in view"""


def normalizing_transform(
    poses: Float[np.ndarray, "t 4 4"],
    points: Float[np.ndarray, "p 3"],
    depths: Sequence[Float[np.ndarray, "h w"]] = (),
) -> tuple[Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """The similarity (shift and scale, no rotation) from a capture's world to one of ordinary numbers.

    It is the identity for ordinary captures. A scene that is moved, or scaled by a power of 1000, comes out in the same
    world up to a shift of its own size.

    Args:
      poses: T world-to-camera poses, float64.
      points: P sparse points, float64; P may be 0.
      depths: Depth maps of a few of the views, world units, 0 where unknown; used where there are no points.

    Returns:
      The (4, 4) float64 similarity, and notes on what it changes.
    """
    centres = -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    middle = np.median(centres, axis=0)
    spread = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    near = _near_depth(poses, np.asarray(points, np.float64), depths)
    size = max(near or 0.0, spread)
    if near is None and size < max(LEAST_SIZE, ROUNDING * np.abs(middle).max()):  # cameras in one place
        size = 1.0
        near = size
    origin, notes = np.zeros(3), []
    if np.abs(middle).max() > FAR * size:
        step = 10.0 ** np.ceil(np.log10(size))
        origin = np.round(middle / step) * step
        place = ", ".join(f"{number:.10g}" for number in origin)
        notes.append(f"The coordinates are large. jsecon works relative to ({place}) and adds it to what it writes.")
    factor = STEP ** _power(size if near is None else near, WIDEST if near is None else FARTHEST)
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
    """World-to-camera poses in the world that `normalizing_transform` leads to; the cameras see the same."""
    if np.array_equal(world, np.eye(4)):
        return poses
    factor = world[0, 0]
    origin = -world[:3, 3] / factor
    moved = np.array(poses, np.float64)
    moved[..., :3, 3] = factor * (poses[..., :3, 3] + poses[..., :3, :3] @ origin)
    return moved


def _power(size: float, most: float) -> int:
    """Of STEP, that brings `size` into [NEAREST, most): 0 where it lies there."""
    if NEAREST <= size < most:
        return 0
    low = int(np.ceil(np.log(NEAREST / size) / np.log(STEP) - 1e-9))
    return low if size < NEAREST else int(np.floor(np.log(most / size) / np.log(STEP) - 1e-9))


def _near_depth(poses: np.ndarray, points: np.ndarray, depths: Sequence[np.ndarray]) -> float | None:
    """How far the near things are from the cameras, in the median view; None where nothing tells."""
    if len(points):
        chosen = points[_evenly(len(points), _POINTS)]
        depths = []
        for pose in poses[_evenly(len(poses), _VIEWS)]:
            x, y, z = pose[:3, :3] @ chosen.T + pose[:3, 3:]
            depths.append(z[(z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= _CONE * z)])
    else:
        depths = [depth[depth > 0] for depth in depths]
    near = [np.quantile(depth, _QUANTILE) for depth in depths if len(depth)]
    return float(np.median(near)) if near else None


def _evenly(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
