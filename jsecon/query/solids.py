"""Solids of objects, for robots and simulators: the convex hull, and the best of a box, a cylinder and a sphere.

They enclose the surface that views show: a Gaussian's own extent tells little, as it lies within a surface or reaches
beyond it. A primitive has the volume of the hull, but for the box, which is the hull's own in the axes of
`object_shapes`. The one whose surface lies nearest to that of the hull is taken. Host code.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from jsecon.field.evidence import MAX_WHOLE
from jsecon.parallel import map_views
from jsecon.query.object_shapes import ObjectShapes
from jsecon.splat.plan import plan_view, render_plan
from jsecon.splat.points import back_project
from jsecon.splat.visible import visible_part
from jsecon.types import Camera, Gaussians

SHARE = 0.6
"""Share of a pixel from which it shows the surface of an object. In three made-up rooms hulls then have 0.98 of the
true volumes (median), and 0.72 of them lie within a tenth; with half of a pixel 1.01 and 0.67."""
STRAY = 0.2
"""Share of the half sides of an object's box: what lies farther out is a floater. Cuts nothing in made-up rooms."""
_OBJECTS = 16
"""Objects that are rendered at once."""


class _Solid(NamedTuple):
    """The solids of one object, in the world of its shape."""

    vertices: Float[np.ndarray, "v 3"]
    """(V, 3) corners of the hull."""
    triangles: Int[np.ndarray, "f 3"]
    """(F, 3) its faces, counter-clockwise as seen from outside."""
    volume: float
    """Its volume."""
    primitive: str
    """"box", "cylinder" or "sphere"."""
    size: tuple[float, ...]
    """Three sides of a box; radius and height of a cylinder; radius of a sphere."""
    axes: Float[np.ndarray, "3 3"]
    """(3, 3) right-handed unit columns: axes of the primitive, a cylinder's along the third."""
    center: Float[np.ndarray, " 3"]
    """Middle of the primitive."""


def object_surfaces(
    gaussians: Gaussians, cameras: Camera, labels: Int[np.ndarray, " n"]
) -> list[Float[np.ndarray, "s 3"]]:
    """Finds what T views show of the surfaces of objects, labelled 0 .. K-1 or -1: a point of each pixel, world.

    Its depth is that of the object's own Gaussians in the pixel, so that outlines have no part of what lies behind.
    """
    whole = gaussians.count <= MAX_WHOLE

    def view(t: int) -> list[tuple[int, np.ndarray]]:
        camera, part_labels, part = jax.tree.map(np.asarray, cameras[t]), labels, gaussians
        if not whole:
            rows, part = visible_part(gaussians, camera)
            part_labels = np.pad(labels[rows], (0, part.count - len(rows)), constant_values=-1)
        plan, pose, found = plan_view(part, camera), np.asarray(camera.world_to_camera), []
        z = np.asarray(part.means) @ pose[2, :3] + pose[2, 3]
        objects = np.unique(part_labels[part_labels >= 0])
        for first in range(0, len(objects), _OBJECTS):
            some = objects[first : first + _OBJECTS]
            is_own = part_labels[:, None] == np.pad(some, (0, _OBJECTS - len(some)), constant_values=-2)
            features = np.concatenate([is_own, is_own * z[:, None]], axis=1).astype(np.float32)
            image = np.asarray(render_plan(plan, jnp.asarray(features)).features)
            for n, number in enumerate(some.tolist()):
                pixels = np.argwhere(image[..., n] >= SHARE)
                share, depth = image[*pixels.T][:, [n, n + _OBJECTS]].T
                found.append((number, back_project(camera, pixels, depth / share)))
        return found

    points = [[np.zeros((0, 3))] for _ in range(int(labels.max(initial=-1)) + 1)]
    for found in map_views(len(cameras), view):
        for number, surface in found:
            points[number].append(surface)
    return [np.concatenate(parts) for parts in points]


def object_solid(points: Float[np.ndarray, "s 3"], shape: ObjectShapes) -> _Solid:
    """Measures one object from points of its surface, all within its solids, and from its shape.

    Points farther than STRAY beyond the box of the shape are left out. An object of which no view shows enough gets
    that box.
    """
    half = np.maximum(shape.half_size, 1e-3 * shape.half_size.max())  # a flat hull has no volume
    local = (points - shape.center) @ shape.axes
    try:
        hull = ConvexHull(local[(np.abs(local) <= (1 + STRAY) * half).all(1)])
    except (QhullError, ValueError):  # flat, or of fewer than four points
        hull = ConvexHull(half * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3))
    low, high = hull.min_bound, hull.max_bound
    middle, half = (low + high) / 2, (high - low) / 2
    kept, places = np.unique(hull.simplices, return_inverse=True)
    vertices, triangles = hull.points[kept] - middle, places.reshape(-1, 3)
    first, second, third = vertices[triangles].transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    inwards = (normals * hull.equations[:, :3]).sum(1) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    name, size, axis = _primitive(vertices, triangles, np.linalg.norm(normals, axis=1), float(hull.volume), half)
    axes, center = np.roll(shape.axes, 2 - axis, axis=1), shape.axes @ middle + shape.center
    return _Solid(vertices @ shape.axes.T + center, triangles, float(hull.volume), name, size, axes, center)


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
