"""Solids of objects, for robots and simulators: the convex hull, and the best of a box, a cylinder and a sphere.

A primitive has the volume of the hull, but for the box, which is that of `object_shapes`. The one whose surface lies
nearest to that of the hull is taken. Host code.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from jsecon.query.object_shapes import ObjectShapes

DEVIATIONS = 2.0
"""Standard deviations of its Gaussians to which a solid reaches. In three made-up rooms hulls then have 0.97 to 1.03 of
the true volumes (median), and to one deviation 0.85 to 0.91."""


class _Solid(NamedTuple):
    """The solids of one object, in the world of its shape."""

    vertices: Float[np.ndarray, "v 3"]
    """(V, 3) corners of the hull."""
    triangles: Int[np.ndarray, "f 3"]
    """(F, 3) its faces, counter-clockwise as seen from outside."""
    volume: float
    """Its volume."""
    primitive: str
    """"box", "cylinder" or "sphere", in the middle of the object's box."""
    size: tuple[float, ...]
    """Three sides of a box; radius and height of a cylinder; radius of a sphere."""
    axes: Float[np.ndarray, "3 3"]
    """(3, 3) right-handed unit columns: axes of the primitive, a cylinder's along the third."""


def object_solid(means: Float[np.ndarray, "n 3"], spreads: Float[np.ndarray, "n 3 3"], shape: ObjectShapes) -> _Solid:
    """Measures one object from centres and `gaussian_spreads` of its Gaussians, and from its shape.

    The hull reaches DEVIATIONS beyond the centres in the object's box, but not out of it.
    """
    half = np.maximum(shape.half_size, 1e-3 * shape.half_size.max())  # a flat hull has no volume
    inside = (np.abs((means - shape.center) @ shape.axes) <= half * (1 + 1e-9)).all(1)
    means, reach = means[inside], DEVIATIONS * spreads[inside]
    ends = np.concatenate([means + side * reach[:, :, axis] for axis in range(3) for side in (-1, 1)])
    local = np.clip((ends - shape.center) @ shape.axes, -half, half)
    corners = half * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    try:
        hull = ConvexHull(local)
    except (QhullError, ValueError):  # flat, or of fewer than four points
        hull = ConvexHull(corners)
    kept, places = np.unique(hull.simplices, return_inverse=True)
    vertices, triangles = hull.points[kept], places.reshape(-1, 3)
    first, second, third = vertices[triangles].transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    inwards = (normals * hull.equations[:, :3]).sum(1) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    name, size, axis = _primitive(vertices, triangles, np.linalg.norm(normals, axis=1), float(hull.volume), half)
    axes = np.roll(shape.axes, 2 - axis, axis=1)
    return _Solid(vertices @ shape.axes.T + shape.center, triangles, float(hull.volume), name, size, axes)


def _primitive(
    vertices: np.ndarray, triangles: np.ndarray, areas: np.ndarray, volume: float, half: np.ndarray
) -> tuple[str, tuple[float, ...], int]:
    """Returns name, size and axis of the primitive whose surface is nearest to that of a hull in its box's axes."""
    draw, count = np.random.default_rng(0), 2000  # points of the surface by which primitives are compared
    faces = vertices[triangles[draw.choice(len(areas), count, p=areas / areas.sum())]]
    points = np.einsum("mk,mkd->md", draw.dirichlet(np.ones(3), count), faces)
    radius = np.cbrt(0.75 * volume / np.pi)
    found: list[tuple[float, str, tuple[float, ...], int]] = [
        (_distance(np.abs(points) - half), "box", tuple((2 * half).tolist()), 2),
        (float(np.abs(np.linalg.norm(points, axis=1) - radius).mean()), "sphere", (float(radius),), 2),
    ]
    for axis in range(3):
        across = np.sqrt(volume / (2 * np.pi * half[axis]))
        around = np.linalg.norm(np.delete(points, axis, axis=1), axis=1) - across
        beyond = np.stack([around, np.abs(points[:, axis]) - half[axis]], axis=1)
        found.append((_distance(beyond), "cylinder", (float(across), 2 * float(half[axis])), axis))
    return min(found)[1:]


def _distance(beyond: np.ndarray) -> float:
    """Mean distance of points to a surface, of how far they lie beyond each of its pairs of sides (M, S)."""
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return float((outside - np.minimum(beyond.max(1), 0)).mean())
