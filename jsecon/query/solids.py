"""Solids of objects, for robots and simulators: the convex hull, and the best of a box, a cylinder and a sphere.

They enclose the surface that views show: a Gaussian's own extent tells little, as it lies within a surface or reaches
beyond it. A primitive has the volume of the hull, but for the box, which is the hull's own in the axes of
`object_shapes`. The one whose surface lies nearest to that of the hull is taken. Host code.
"""

from typing import Any

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


def object_surfaces(
    gaussians: Gaussians, cameras: Camera, labels: Int[np.ndarray, " n"]
) -> list[Float[np.ndarray, "s 3"]]:
    """Finds what T views show of the surfaces of objects, labelled 0 .. K-1 or -1: a point of each pixel, world.

    Its depth is that of the object's own Gaussians in the pixel, so that outlines have no part of what lies behind.
    """
    whole, count = gaussians.count <= MAX_WHOLE, int(labels.max(initial=-1)) + 1

    def view(t: int) -> list[np.ndarray]:
        camera, part_labels, part = jax.tree.map(np.asarray, cameras[t]), labels, gaussians
        if not whole:
            rows, part = visible_part(gaussians, camera)
            part_labels = np.pad(labels[rows], (0, part.count - len(rows)), constant_values=-1)
        plan, pose, found = plan_view(part, camera), np.asarray(camera.world_to_camera), []
        z = np.asarray(part.means) @ pose[2, :3] + pose[2, 3]
        for first in range(0, count, _OBJECTS):
            is_own = part_labels[:, None] == np.arange(first, first + _OBJECTS)
            features = np.concatenate([is_own, is_own * z[:, None]], axis=1).astype(np.float32)
            image = np.asarray(render_plan(plan, jnp.asarray(features)).features)
            for n in range(min(_OBJECTS, count - first)):
                pixels = np.argwhere(image[..., n] >= SHARE)
                share, depth = image[*pixels.T][:, [n, n + _OBJECTS]].T
                found.append(back_project(camera, pixels, depth / share))
        return found

    views = map_views(len(cameras), view)
    return [np.concatenate([np.zeros((0, 3)), *(surfaces[n] for surfaces in views)]) for n in range(count)]


def object_solid(points: Float[np.ndarray, "s 3"], shape: ObjectShapes) -> dict[str, dict[str, Any]]:
    """Measures one object from points of its surface, all within its solids, and from its shape, in their world.

    Points farther than STRAY beyond the box of the shape are left out. An object of which no view shows enough gets
    that box.

    Returns:
      "hull": its "vertices" (V, 3), "triangles" (F, 3), counter-clockwise as seen from outside, and "volume";
      "primitive": its "type" ("box", "cylinder" or "sphere"), "size" (three sides; radius and height; radius), "axes"
      (3, 3), right-handed unit columns of which a cylinder lies along the third, and "center", its middle.
    """
    half = np.maximum(shape.half_size, 1e-3 * shape.half_size.max())  # a flat hull has no volume
    local = (points - shape.center) @ shape.axes
    try:
        hull = ConvexHull(local[(np.abs(local) <= (1 + STRAY) * half).all(1)])
    except (QhullError, ValueError):  # flat, or of fewer than four points
        hull = ConvexHull(half * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3))
    middle, half = (hull.min_bound + hull.max_bound) / 2, (hull.max_bound - hull.min_bound) / 2
    kept, places = np.unique(hull.simplices, return_inverse=True)
    vertices, triangles = hull.points[kept] - middle, places.reshape(-1, 3)
    inwards = np.linalg.det(vertices[triangles] - vertices.mean(axis=0)) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    kind, size, axis = _primitive(vertices[triangles], float(hull.volume), half)
    axes, center = np.roll(shape.axes, 2 - axis, axis=1), shape.axes @ middle + shape.center
    solid = {"vertices": vertices @ shape.axes.T + center, "triangles": triangles, "volume": float(hull.volume)}
    return {"hull": solid, "primitive": {"type": kind, "size": size, "axes": axes, "center": center}}


def _primitive(triangles: np.ndarray, volume: float, half: np.ndarray) -> tuple[str, np.ndarray, int]:
    """Returns type, size and axis of the primitive whose surface is nearest to that of a hull, (F, 3, 3) in its axes.

    `half` has half of the sides of the hull's box.
    """
    draw, count = np.random.default_rng(0), 2000  # points of the surface by which primitives are compared
    areas = np.linalg.norm(np.cross(*np.diff(triangles, axis=1).transpose(1, 0, 2)), axis=1)
    faces = triangles[draw.choice(len(areas), count, p=areas / areas.sum())]
    points = np.einsum("mk,mkd->md", draw.dirichlet(np.ones(3), count), faces)
    radius, distance = np.cbrt(0.75 * volume / np.pi), np.linalg.norm(points, axis=1, keepdims=True)
    # Of each candidate also how far the points lie beyond each pair of its sides.
    found = [("box", 2 * half, 2, np.abs(points) - half), ("sphere", np.array([radius]), 2, distance - radius)]
    for axis in range(3):
        across = np.sqrt(volume / (2 * np.pi * half[axis]))
        around = np.linalg.norm(np.delete(points, axis, axis=1), axis=1) - across
        beyond = np.stack([around, np.abs(points[:, axis]) - half[axis]], axis=1)
        found.append(("cylinder", np.array([across, 2 * half[axis]]), axis, beyond))
    return min(found, key=lambda candidate: _distance(candidate[3]))[:3]


def _distance(beyond: np.ndarray) -> float:
    """Mean distance of points to a surface, of how far they lie beyond each of its pairs of sides (M, S)."""
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return float((outside - np.minimum(beyond.max(1), 0)).mean())
