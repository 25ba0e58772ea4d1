"""Where objects stand to each other: soft predicates on boxes and points, and orders. Pure functions of NumPy arrays.

A predicate takes shapes of objects (`ObjectShapes`, upright boxes) whose leading axes broadcast, and returns scores
in [0, 1]; from SATISFIED on the relation holds. `pair_scores` and `between_scores` take all pairs and triples. All
distances are relative to the objects' sizes: a scene that is scaled, shifted, or turned about the up axis together with
its viewpoint has the same scores. Subtract a common origin before coordinates become float32.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jsecon.query.object_shapes import ObjectShapes
from jsecon.types import Array, Camera, record

SATISFIED = 0.5
"""Score from which a relation holds."""
_OVER = 0.4
"""Share of the smaller footprint that lies within the other's from which objects are above each other."""


@record
class Viewpoint:
    """From where directions are seen, and which way is up."""

    eye: Array
    """(3,) world."""
    forward: Array
    """(3,) horizontal unit vector of the viewing direction."""
    up: Array
    """(3,) unit."""


def viewpoint(camera: Camera, up: Float[Array, " 3"]) -> Viewpoint:
    """Makes the viewpoint of a camera. One that looks straight up or down has its upper edge as forward."""
    axes = camera.world_to_camera[:3, :3]
    forward, upper = _level(axes[2], up), _level(-axes[1], up)
    tilted = _length(forward) < 0.2
    forward = np.where(tilted, upper * np.sign(-_dot(axes[2], up)), forward)
    return Viewpoint(camera.centres, forward / np.maximum(_length(forward), 1e-9), up)


def _dot(a: Array, b: Array) -> Any:
    """Products of vectors (..., 3), which broadcast."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _length(vector: Array) -> Any:
    """Lengths of vectors (..., 3)."""
    return np.sqrt(_dot(vector, vector))


def _level(vector: Array, up: Array) -> Array:
    """The horizontal part of vectors (..., 3)."""
    return vector - _dot(vector, up)[..., None] * up


def _size(shape: ObjectShapes) -> Float[Array, "*batch"]:
    """Measures objects: the mean of the three sides of each box."""
    return 2.0 * shape.half_size.mean(-1)


def _rise(x: Array, steepness: float = 10.0) -> Array:
    """A soft step, 0.5 at x = 0: the logistic function."""
    return 0.5 + 0.5 * np.tanh(0.5 * steepness * x)


def _within(x: Array, power: float = 2.0) -> Array:
    """Falls from 1 at x = 0 over 0.5 at x = 1 to 0."""
    return 1.0 / (1.0 + np.maximum(x, 0.0) ** power)


def _over(x: Array, size: Array) -> Array:
    """Quotient of x and a size, which may be 0."""
    return x / np.maximum(size, 1e-12)


def _heights(shape: ObjectShapes) -> tuple[Array, Array, Array]:
    """Bottom, top and height of an upright box along its third axis."""
    middle, half = _dot(shape.center, shape.axes[..., 2]), shape.half_size[..., 2]
    return middle - half, middle + half, 2.0 * half


def _local_points(points: Array, shape: ObjectShapes) -> tuple[Array, Array, Array]:
    """Distances of points (..., P, 3) from the middle of a box along each of its axes, (..., P)."""
    offset = points - shape.center[..., None, :]
    x, y, z = (abs(_dot(offset, shape.axes[..., None, :, k])) for k in range(3))
    return x, y, z


def _inside(
    points: Array, shape: ObjectShapes, grow: float = 1.0
) -> tuple[Bool[Array, "*batch p"], Bool[Array, "*batch p"]]:
    """Which points (..., P, 3) lie within the footprint of an upright box grown by a factor, and which in the box."""
    x, y, z = _local_points(points, shape)
    half = shape.half_size[..., None, :]
    footprint = (x <= grow * half[..., 0]) & (y <= grow * half[..., 1])
    return footprint, footprint & (z <= half[..., 2])


def _gap(a: ObjectShapes, b: ObjectShapes) -> Float[Array, "*batch"]:
    """Measures the free distance between the surfaces of two objects.

    It is the smallest distance of the points of one to the box of the other, of both ways the larger: a box may hold
    free space, as that of an arch does. Points of a large object may lie farther apart than a small one is wide, which
    is taken off. 0 if the surfaces touch.
    """

    def to_box(own: ObjectShapes, other: ObjectShapes) -> Array:
        local = _local_points(own.points, other)
        beyond = (np.maximum(distance - other.half_size[..., None, k], 0.0) for k, distance in enumerate(local))
        x, y, z = (own.half_size[..., k] for k in range(3))
        spacing = np.sqrt(8.0 * (x * y + y * z + z * x) / own.points.shape[-2])
        missed = np.maximum(spacing - 0.25 * _size(other), 0.0)
        dx, dy, dz = beyond
        return np.sqrt((dx * dx + dy * dy + dz * dz).min(-1)) - missed

    return np.maximum(np.maximum(to_box(a, b), to_box(b, a)), 0.0)


def _sight(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> tuple[Array, Array]:
    """Horizontal unit vectors forward and right, along the line of sight to the middle of two objects.

    So left and right agree with the image of the camera. Where the eye is as near as the objects are apart, or nearly
    above them, they are those of the viewpoint.
    """
    to = 0.5 * (a.center + b.center) - view.eye
    across = _level(to, view.up)
    distance = _length(across)
    apart = _length(_level(a.center - b.center, view.up))
    usual = distance > np.maximum(0.5 * apart, 0.25 * abs(_dot(to, view.up)))
    forward = np.where(usual[..., None], across / np.where(usual, distance, 1.0)[..., None], view.forward)
    return forward, np.cross(forward, view.up)


def _towards(a: ObjectShapes, b: ObjectShapes, view: Viewpoint, *, sideways: bool) -> Float[Array, "*batch"]:
    """Whether a is left of b as the viewpoint sees it (`sideways`), or nearer to the viewpoint and not far aside."""
    forward, right = _sight(a, b, view)
    along, across = (-right, forward) if sideways else (-forward, right)

    def interval(shape: ObjectShapes, axis: Array) -> tuple[Array, Array]:
        places = _dot(shape.points, axis[..., None, :])
        return 0.5 * (places.max(-1) + places.min(-1)), 0.5 * (places.max(-1) - places.min(-1))

    (middle_a, half_a), (middle_b, half_b) = interval(a, along), interval(b, along)
    (side_a, wide_a), (side_b, wide_b) = interval(a, across), interval(b, across)
    shift = middle_a - middle_b
    beside = abs(side_a - side_b) - wide_a - wide_b
    # From 0.35 of the shift at which they just part, within a cone of 68 degrees: 2.5 times as far aside as along.
    return _rise(_over(shift, half_a + half_b) - 0.35) * _within(_over(beside, 2.5 * shift))


def _overlap(a: ObjectShapes, b: ObjectShapes) -> Array:
    """Share of the points of one object within the footprint of the other, of both ways the larger.

    Of two that cross, as an arch and a beam beneath it, each has few points there; the middle of one counts instead.
    """
    shared = np.maximum(_inside(a.points, b)[0].mean(-1), _inside(b.points, a)[0].mean(-1))
    crossed = np.maximum(_centred(a, b), _centred(b, a))
    return np.maximum(shared, _OVER * (1.0 + crossed))


def _centred(a: ObjectShapes, b: ObjectShapes) -> Array:
    """How deep the middle of a lies in the footprint of b: 1 in its middle, 0 at its edge, at least -1."""
    x, y, _ = _local_points(a.center[..., None, :], b)
    depth = 1.0 - np.maximum(_over(x[..., 0], b.half_size[..., 0]), _over(y[..., 0], b.half_size[..., 1]))
    return np.maximum(depth, -1.0)


def _local(a: ObjectShapes, b: ObjectShapes, share: float, otherwise: Array) -> Array:
    """Quantile of the heights of the points of a within the grown footprint of b; `otherwise` where there are none.

    So the seat of a chair, not its back, is what a cushion lies on, and the top of a table, not its feet, what is above
    a box. The heights are taken as evenly spread around their mean: a sort would take most of the time.
    """
    close, _ = _inside(a.points, b, 1.4)  # with the surface around it, since b hides that below
    heights = _dot(a.points, a.axes[..., None, :, 2])
    number = np.maximum(close.sum(-1), 1)
    mean = np.where(close, heights, 0.0).sum(-1) / number
    variance = np.where(close, (heights - mean[..., None]) ** 2, 0.0).sum(-1) / number
    spread = np.sqrt(12.0 * np.maximum(variance, 1e-30))
    return np.where(close.any(-1), mean + (share - 0.5) * spread, otherwise)


def _tolerance(shape: ObjectShapes) -> Array:
    """Tolerance of a contact in height, world units: 0.15 of the height and width together."""
    x, y, z = (shape.half_size[..., k] for k in range(3))
    return 0.15 * 2.0 * (z + 0.5 * (x + y))


def _above(a: ObjectShapes, b: ObjectShapes) -> Float[Array, "*batch"]:
    """Whether a is over b, touching or not: footprints overlap, and a begins where b ends there. b is then under a."""
    bottom, _, _ = _heights(a)
    _, top, _ = _heights(b)
    free = _local(a, b, 0.1, bottom) - _local(b, a, 0.9, top)
    return _rise(_overlap(a, b) - _OVER) * _rise(_over(free, _tolerance(a)) + 1.0, 4.0)


def _in_box(a: ObjectShapes, b: ObjectShapes) -> Float[Array, "*batch"]:
    """Whether a is in b: enough of its points lie in the box of b, which is no smaller across and reaches below it."""
    share = _inside(a.points, b)[1].mean(-1)
    bottom, top, height = _heights(a)
    deep = 0.5 * (bottom + top) - _local(b, a, 0.25, _heights(b)[0])
    smaller = _over(b.half_size[..., :2].prod(-1), a.half_size[..., :2].prod(-1))
    # 0.3 of the points are enough: most of a ball sticks out of a bowl.
    return _rise(share - 0.3) * _rise(_over(deep, height)) * _rise(smaller - 0.7)


def _on(a: ObjectShapes, b: ObjectShapes) -> Float[Array, "*batch"]:
    """Whether a rests on b: most of it is over the footprint of b, it touches the surface there, and is not in b."""
    bottom, _, height = _heights(a)
    _, top, _ = _heights(b)
    held = _inside(a.points, b, 1.1)[0].mean(-1)
    surface = _local(b, a, 0.75, top)
    contact = _within(_over(bottom - surface, _tolerance(a)), 4.0)
    return _rise(held - 0.5) * contact * _rise(0.4 - _over(surface - bottom, height)) * (1.0 - _in_box(a, b))


def _next_to(a: ObjectShapes, b: ObjectShapes) -> Float[Array, "*batch"]:
    """Whether the objects are close to each other on one level, neither over the other.

    They have at least 0.3 of the smaller height in common.
    """
    (low_a, high_a, tall_a), (low_b, high_b, tall_b) = _heights(a), _heights(b)
    common = _over(np.minimum(high_a, high_b) - np.maximum(low_a, low_b), np.minimum(tall_a, tall_b))
    return _within(_relative_gap(a, b) / 0.6) * _rise(common - 0.3) * _rise(_OVER - _overlap(a, b))


def _relative_gap(a: ObjectShapes, b: ObjectShapes) -> Array:
    """The gap in units of the geometric mean of the sizes."""
    return _over(_gap(a, b), np.sqrt(_size(a) * _size(b)))


def _volume(shape: ObjectShapes) -> Array:
    """Side of a cube with the volume of a box."""
    return (2.0 * shape.half_size).prod(-1) ** (1 / 3)


def _exceeds(x: Array, y: Array, size: Array) -> Array:
    """Whether x is larger than y, of objects of a size: from 0.05 of it on."""
    return _rise(_over(x - y, size) - 0.05)


def _higher(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> Array:
    """Whether the middle of a is above that of b, wherever they stand."""
    return _exceeds(_dot(a.center, view.up), _dot(b.center, view.up), 0.5 * (_heights(a)[2] + _heights(b)[2]))


_PREDICATES = {
    "left of": lambda a, b, view: _towards(a, b, view, sideways=True),
    "right of": lambda a, b, view: _towards(b, a, view, sideways=True),
    "in front of": lambda a, b, view: _towards(a, b, view, sideways=False),
    "behind": lambda a, b, view: _towards(b, a, view, sideways=False),
    "above": lambda a, b, _: _above(a, b),
    "below": lambda a, b, _: _above(b, a),
    "on": lambda a, b, _: _on(a, b),
    "under": lambda a, b, _: _above(b, a),
    "in": lambda a, b, _: _in_box(a, b),
    "next to": lambda a, b, _: _next_to(a, b),
    "larger than": lambda a, b, _: _exceeds(_volume(a), _volume(b), _volume(b)),
    "smaller than": lambda a, b, _: _exceeds(_volume(b), _volume(a), _volume(a)),
    "taller than": lambda a, b, _: _exceeds(_heights(a)[2], _heights(b)[2], _heights(b)[2]),
    "shorter than": lambda a, b, _: _exceeds(_heights(b)[2], _heights(a)[2], _heights(a)[2]),
    "higher than": lambda a, b, view: _higher(a, b, view),
    "lower than": lambda a, b, view: _higher(b, a, view),
    # Gaps between surfaces in units of the objects' sizes: near falls as the gap grows, far rises with it.
    "near": lambda a, b, _: _within(_relative_gap(a, b) / 1.1),
    "nearest to": lambda a, b, _: _gap(a, b),
    "farthest from": lambda a, b, _: _gap(a, b),
    "far from": lambda a, b, _: 1.0 - _within(_relative_gap(a, b) / 2.0),
    "touching": lambda a, b, _: _within(_over(_gap(a, b), 0.12 * np.minimum(_size(a), _size(b)))),
}


def pair_scores(
    relation: str, a: ObjectShapes, b: ObjectShapes, view: Viewpoint, length: float = 0.0
) -> Float[Array, "k l"]:
    """Scores "object of a RELATION object of b" for all pairs; of "nearest to" and "farthest from" it is the gap.

    "within" and "at least" compare the gap with a length, in units of the shapes' world.
    """
    if relation in ("within", "at least"):
        near = _within(_over(_gap(a[:, None], b[None]), np.asarray(length)), 8.0)
        return near if relation == "within" else 1.0 - near
    return _PREDICATES[relation](a[:, None], b[None], view)


def between_scores(a: ObjectShapes, b: ObjectShapes, c: ObjectShapes) -> Float[Array, "k l m"]:
    """Scores "object of a between object of b and object of c" for all triples; from SATISFIED on it holds.

    The middle of a projects between those of b and c, and lies off their line by at most half of half their distance
    and half its size together.
    """
    a, b, c = a[:, None, None], b[None, :, None], c[None, None]
    line, offset = c.center - b.center, a.center - b.center
    length = np.maximum(_length(line), 1e-12)
    along = _dot(offset, line) / length**2
    off = _length(offset - along[..., None] * line)
    reach = 0.5 * 0.5 * (length + _size(a))
    return _rise(along - 0.1, 20.0) * _rise(0.9 - along, 20.0) * _within(_over(off, reach), 4.0)


def order_values(shapes: ObjectShapes, view: Viewpoint) -> dict[str, Float[Array, " k"]]:
    """Computes the values by which objects are ordered, for each order of the grammar; the first has the smallest.

    "largest" compares the volumes of boxes, "leftmost" the directions from the viewpoint, "nearest" the distances.
    """
    volume = _volume(shapes)
    height = 2.0 * shapes.half_size[:, 2]
    level = _dot(shapes.center, view.up)
    away = shapes.center - view.eye
    bearing = np.arctan2(_dot(away, np.cross(view.forward, view.up)), _dot(away, view.forward))
    distance = _length(away)
    pairs = {"smallest": volume, "shortest": height, "lowest": level, "leftmost": bearing, "nearest": distance}
    opposite = dict(zip(pairs, ("largest", "tallest", "highest", "rightmost", "farthest")))
    return pairs | {opposite[name]: -value for name, value in pairs.items()}
