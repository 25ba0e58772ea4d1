"""Where objects are and how large they are: the boxes and points that catalogues, relations and measures read.

This module has the one definition of a box. Along an axis it ends where all but BOX_TAIL of the Gaussians end, each to
one standard deviation. Host code.
"""

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jsecon.errors import require, require_shape
from jsecon.numerics import axes_across
from jsecon.types import Array, Gaussians, Leaf, record

BOX_TAIL = 0.02
"""Share of the Gaussians at each end of an axis that a box leaves out as strays."""
_POINTS = 256
"""Points of each object."""
_YAW_STEPS = 18
"""Directions, evenly spaced over a right angle, that an upright box tries."""
_EVERY_THIRD = np.array([sum(1 << 3 * bit for bit in range(10) if number >> bit & 1) for number in range(1 << 10)])
"""Numbers of ten bits with two zeros before each of their bits."""


@record
class ObjectShapes:
    """K objects in one world and its unit. A pytree of float64 NumPy arrays.

    Subtract a common origin before the coordinates become float32: those of a map projection lose their last metres.
    """

    center: Leaf
    """(K, 3) middle of the oriented box."""
    axes: Leaf
    """(K, 3, 3) unit columns, right-handed: axes of the box. With an up axis the third is that axis, and the first is
    the longer of the two horizontal ones. Without one they are the principal axes of the points, the longest first."""
    half_size: Leaf
    """(K, 3) half of the length of the oriented box along each of its axes."""
    low: Leaf
    """(K, 3) lower corner of the box along the axes of the world."""
    high: Leaf
    """(K, 3) upper corner of that box."""
    points: Leaf
    """(K, 256, 3) centres of Gaussians in the oriented box, spread evenly over them, for distances between surfaces. An
    object with fewer repeats them."""
    count: Leaf
    """(K,) int number of Gaussians."""

    def __getitem__(self, index) -> "ObjectShapes":
        """The objects at `index`."""
        return jax.tree.map(lambda column: column[index], self)

    def __len__(self) -> int:
        """K."""
        return self.center.shape[0]


def object_shapes(
    means: Float[Array, "n 3"],
    labels: Int[Array, " n"],
    up: Float[Array, " 3"] | None = None,
    *,
    spreads: Float[Array, "n 3 3"] | None = None,
) -> ObjectShapes:
    """Measures objects.

    Args:
      means: (N, 3) centres of Gaussians.
      labels: (N,) object of each Gaussian, 0 .. K-1, or -1 for no object. Every object has a Gaussian.
      up: (3,) up axis; boxes stand upright along it, turned so that their footprint is smallest. None takes the
        principal axes of each object.
      spreads: (N, 3, 3) `gaussian_spreads` of the Gaussians; None takes them as points.

    Returns:
      The shapes, in the world of the means. Equal inputs give equal bits.

    Raises:
      ValueError: Shapes disagree, an object has no Gaussian, or `up` has no direction.
    """
    means = np.asarray(means, np.float64)
    labels = np.asarray(labels)
    require_shape("labels", labels, (len(means),), "Give one label per Gaussian.")
    count = np.bincount(labels[labels >= 0])
    remedy = "Number the objects without gaps."
    missing = np.flatnonzero(count == 0).tolist()
    require(not missing, "object_shapes", f"no Gaussian of {missing}", "one", remedy)
    turns = None if up is None else _upright_turns(np.asarray(up, np.float64))
    order = np.argsort(labels, kind="stable")[np.sum(labels < 0) :]
    shapes = []
    for rows in np.split(order, np.cumsum(count)[:-1]) if len(count) else ():
        covariances = np.zeros((len(rows), 3, 3)) if spreads is None else np.asarray(spreads, np.float64)[rows]
        shapes.append(_measure(means[rows], covariances, turns))
    sizes = ((3,), (3, 3), (3,), (3,), (3,), (_POINTS, 3))
    columns = [np.stack(column) for column in zip(*shapes)] if shapes else [np.zeros((0, *size)) for size in sizes]
    center, axes, half_size, low, high, spaced = columns
    return ObjectShapes(center, axes, half_size, low, high, spaced, count)


def _measure(points: np.ndarray, spreads: np.ndarray, turns: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Returns the fields of `ObjectShapes` of one object, without its count."""
    axes = _principal_axes(points) if turns is None else _upright_axes(points, spreads, turns)
    ends = _box_ends(points, spreads, np.concatenate([axes, np.eye(3)], axis=1))
    (low, high), ends = ends[:, 3:], ends[:, :3]
    along = points @ axes
    inside = ((along >= ends[0]) & (along <= ends[1])).all(1)
    kept = points[inside] if inside.any() else points
    return axes @ ends.mean(0), axes, (ends[1] - ends[0]) / 2, low, high, _spaced_points(kept)


def _principal_axes(points: np.ndarray) -> np.ndarray:
    """Returns the right-handed principal axes (3, 3) of points (M, 3) as columns, the longest first."""
    offsets = points - points.mean(0)
    axes = np.linalg.eigh(offsets.T @ offsets)[1][:, ::-1]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes


def _upright_turns(up: np.ndarray) -> np.ndarray:
    """Returns axes (2 _YAW_STEPS + 1, 3) of upright boxes: horizontal ones, the ones across to these, and up."""
    require(bool(np.linalg.norm(up) > 0), "object_shapes", f"up {up.tolist()}", "a direction", "For example 0 0 1.")
    up = up / np.linalg.norm(up)
    first, second = axes_across(up)
    yaw = 0.5 * np.pi * np.arange(_YAW_STEPS)[:, None] / _YAW_STEPS
    turned = [np.cos(yaw) * first + np.sin(yaw) * second, np.cos(yaw) * second - np.sin(yaw) * first]
    return np.concatenate([*turned, up[None]])


def _upright_axes(points: np.ndarray, spreads: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Returns the axes of the upright box with the smallest footprint as columns, the longer horizontal one first."""
    step = -(-len(points) // 400)  # so many points of an object tell its yaw
    low, high = _box_ends(points[::step], spreads[::step], turns[:-1].T)
    sides = (high - low).reshape(2, _YAW_STEPS)
    best = int(np.argmin(sides[0] * sides[1]))
    long, short = turns[best], turns[best + _YAW_STEPS]
    if sides[1, best] > sides[0, best]:
        long, short = short, -long
    return np.stack([long, short, turns[-1]], axis=1)


def _box_ends(points: np.ndarray, spreads: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Returns the ends (2, A) of the Gaussians, to one deviation and without strays, along A columns of `axes`."""
    turned = axes.T @ spreads  # (M, A, 3)
    reach = np.sqrt(np.einsum("mak,mak->am", turned, turned))
    along = axes.T @ points.T
    # What np.quantile computes, whose checks take longer than its work on a few hundred Gaussians.
    place = BOX_TAIL * (len(points) - 1)
    rank = min(int(place), max(len(points) - 2, 0))
    ranks = np.arange(rank, min(rank + 2, len(points)))
    low, high = (np.partition(ends, ranks, axis=1)[:, ranks] for ends in (along - reach, -along - reach))
    part = place - rank
    return np.stack([(1 - part) * ends[:, 0] + part * ends[:, -1] for ends in (low, high)]) * [[1], [-1]]


def _spaced_points(points: np.ndarray) -> np.ndarray:
    """Returns _POINTS of the points, evenly spaced along a curve through all of them (Morton order)."""
    low, high = points.min(0), points.max(0)
    cell = ((points - low) / max((high - low).max(), 1e-300) * 1023).astype(np.int64)
    x, y, z = _EVERY_THIRD[cell].T
    order = np.argsort(4 * x + 2 * y + z, kind="stable")
    return points[order[(np.arange(_POINTS) * len(points)) // _POINTS]]


def gaussian_spreads(gaussians: Gaussians) -> Float[np.ndarray, "n 3 3"]:
    """Computes the axes of Gaussians as columns, each as long as its standard deviation."""
    rotations = Rotation.from_quat(np.asarray(gaussians.quaternions, np.float64), scalar_first=True).as_matrix()
    return rotations * np.exp(np.asarray(gaussians.log_scales, np.float64))[:, None, :]
