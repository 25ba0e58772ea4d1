"""Where objects stand to each other: soft predicates on boxes and points, and orders. Pure functions: jit or vmap them.

Each predicate takes shapes of single objects (`ObjectShapes` without the leading axis, upright boxes) and returns a
score in [0, 1]; from SATISFIED on the relation holds. `pair_scores` and `between_scores` take all pairs and triples.
All distances are relative to the objects' sizes: a scene that is scaled, shifted, or turned about the up axis together
with its viewpoint has the same scores. Subtract a common origin before coordinates become float32.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.query.object_shapes import ObjectShapes
from jsecon.types import Array, Camera, record

SATISFIED = 0.5
"""score from which a relation holds"""
APART = 0.35
"""distance of two middles along a direction, in units at which the two just part, from which one lies in it"""
SIDEWAYS = 2.5
"""gap across a direction, in units of the distance along it, up to which an object lies in it: a cone of 68 degrees"""
NEXT, NEAR, FAR = 0.6, 1.1, 2.0
"""gaps between surfaces up to which objects are next to each other and near, and from which they are far, in units of
the geometric mean of their sizes"""
TOUCH = 0.12
"""the same for touching, in units of the smaller size"""
CONTACT = 0.15
"""tolerance of a contact in height, in units of the height and width of the upper object together"""
INSIDE = 0.3
"""share of an object's points in the box of another from which it is in it: most of a ball sticks out of a bowl"""
OVER = 0.4
"""share of the smaller footprint that lies within the other's from which objects are above each other"""
LEVEL = 0.3
"""share of the smaller height that two objects have in common from which they stand on one level"""
BETWEEN = 0.5
"""distance from the line between two objects, in units of half its length and the object's half size together"""
REACH = 1.4
"""factor by which a footprint grows to take in the other object's surface around it, since it hides that below"""
PAIRS = ("left of", "right of", "in front of", "behind", "above", "below", "on", "under", "in", "next to", "near")
PAIRS += ("far from", "touching")
"""relations of `pair_scores`"""
ORDERS = ("largest", "smallest", "tallest", "shortest", "highest", "lowest", "leftmost", "rightmost")
ORDERS += ("nearest", "farthest")
"""orders of `order_values`"""


@record
class Viewpoint:
    """From where directions are seen, and which way is up."""

    eye: Array
    """(3,) world."""
    forward: Array
    """(3,) horizontal unit vector of the viewing direction."""
    up: Array
    """(3,) unit."""

    @property
    def right(self) -> Array:
        """(3,) horizontal unit vector to the right."""
        return jnp.cross(self.forward, self.up)


def viewpoint(camera: Camera, up: Float[Array, " 3"]) -> Viewpoint:
    """Makes the viewpoint of a camera. One that looks straight up or down sees as forward where its upper edge points.

    Args:
      camera: A single camera.
      up: Unit up axis, world.

    Returns:
      The viewpoint, float32.
    """
    axes = jnp.asarray(camera.world_to_camera)[:3, :3]
    forward, upper = _level(axes[2], up), _level(-axes[1], up)
    tilted = jnp.linalg.norm(forward) < 0.2
    forward = jnp.where(tilted, upper * jnp.sign(-(axes[2] @ up)), forward)
    forward = forward / jnp.maximum(jnp.linalg.norm(forward), 1e-9)
    return Viewpoint(jnp.asarray(camera.centres), forward, jnp.asarray(up))


def _level(vector: Array, up: Array) -> Array:
    """The horizontal part of a vector."""
    return vector - (vector @ up) * up


def size_of(shape: ObjectShapes) -> Float[Array, "..."]:
    """Mean of the three sides of a box, world units."""
    return 2.0 * jnp.mean(shape.half_size, axis=-1)


def _rise(x: Array, steepness: float = 10.0) -> Array:
    """A soft step, 0.5 at x = 0."""
    return jax.nn.sigmoid(steepness * x)


def _within(x: Array, power: float = 2.0) -> Array:
    """Falls from 1 at x = 0 over 0.5 at x = 1 to 0."""
    return 1.0 / (1.0 + jnp.maximum(x, 0.0) ** power)


def _heights(shape: ObjectShapes) -> tuple[Array, Array, Array]:
    """Bottom, top and height of an upright box along its third axis."""
    middle = shape.center @ shape.axes[:, 2]
    return middle - shape.half_size[2], middle + shape.half_size[2], 2.0 * shape.half_size[2]


def _along(points: Array, axis: Array) -> Array:
    """Coordinates of points (..., 3) along an axis (3,).

    As a sum of products: a matrix times a vector, reduced under vmap, can be silently wrong (jax issue 39103).
    """
    return jnp.sum(points * axis, axis=-1)


def _local_points(points: Array, shape: ObjectShapes) -> Array:
    """Distances of points (P, 3) from the middle of a box along its axes, (P, 3)."""
    return jnp.abs(jnp.sum((points - shape.center)[:, :, None] * shape.axes, axis=1))


def _inside(points: Array, shape: ObjectShapes, grow: float = 1.0) -> tuple[Bool[Array, " p"], Bool[Array, " p"]]:
    """Which points (P, 3) lie within the footprint of an upright box grown by a factor, and which in the box."""
    local = _local_points(points, shape)
    footprint = jnp.all(local[:, :2] <= grow * shape.half_size[:2], axis=1)
    return footprint, footprint & (local[:, 2] <= shape.half_size[2])


def gap(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Free distance between the surfaces of two objects, world units; 0 where they touch.

    The smallest distance of the points of one to the box of the other, of both ways the larger: a box may hold free
    space, as that of an arch does. Points of a large object may lie farther apart than a small one is wide, which is
    taken off.
    """

    def to_box(points: Array, own: ObjectShapes, other: ObjectShapes) -> Array:
        beyond = jnp.maximum(_local_points(points, other) - other.half_size, 0.0)
        x, y, z = own.half_size
        spacing = jnp.sqrt(8.0 * (x * y + y * z + z * x) / points.shape[0])
        missed = jnp.maximum(spacing - 0.25 * size_of(other), 0.0)
        return jnp.sqrt(jnp.min(jnp.sum(beyond * beyond, axis=1))) - missed

    return jnp.maximum(jnp.maximum(to_box(a.points, a, b), to_box(b.points, b, a)), 0.0)


def _sight(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> tuple[Array, Array]:
    """Horizontal unit vectors forward and right, along the line of sight to the middle of two objects.

    So left and right agree with the image of the camera. Where the eye is as near as the objects are apart, or nearly
    above them, they are those of the viewpoint.
    """
    to = 0.5 * (a.center + b.center) - view.eye
    across = _level(to, view.up)
    distance = jnp.linalg.norm(across)
    apart = jnp.linalg.norm(_level(a.center - b.center, view.up))
    usual = distance > jnp.maximum(0.5 * apart, 0.25 * jnp.abs(to @ view.up))
    forward = jnp.where(usual, across / jnp.where(usual, distance, 1.0), view.forward)
    return forward, jnp.cross(forward, view.up)


def _towards(a: ObjectShapes, b: ObjectShapes, along: Array, across: Array) -> Array:
    """Whether a lies in the direction `along` from b."""

    def interval(shape: ObjectShapes, axis: Array) -> tuple[Array, Array]:
        places = _along(shape.points, axis)
        return 0.5 * (places.max() + places.min()), 0.5 * (places.max() - places.min())

    (middle_a, half_a), (middle_b, half_b) = interval(a, along), interval(b, along)
    (side_a, wide_a), (side_b, wide_b) = interval(a, across), interval(b, across)
    shift = middle_a - middle_b
    apart = shift / jnp.maximum(half_a + half_b, 1e-12)
    beside = jnp.maximum(jnp.abs(side_a - side_b) - wide_a - wide_b, 0.0)
    return _rise(apart - APART) * _within(beside / (SIDEWAYS * jnp.maximum(shift, 1e-12)))


def left_of(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> Float[Array, ""]:
    """Whether a is left of b as the viewpoint sees it; b is then as much right of a."""
    forward, right = _sight(a, b, view)
    return _towards(a, b, -right, forward)


def in_front_of(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> Float[Array, ""]:
    """Whether a is nearer to the viewpoint than b and not far aside; b is then as much behind a."""
    forward, right = _sight(a, b, view)
    return _towards(a, b, -forward, right)


def _overlap(a: ObjectShapes, b: ObjectShapes) -> Array:
    """Share of the points of one object within the footprint of the other, of both ways the larger."""
    return jnp.maximum(_inside(a.points, b)[0].mean(), _inside(b.points, a)[0].mean())


def _local(a: ObjectShapes, b: ObjectShapes, share: float, otherwise: Array) -> Array:
    """Quantile of the heights of the points of a within the grown footprint of b; `otherwise` where there are none.

    So the seat of a chair, not its back, is what a cushion lies on, and the top of a table, not its feet, what is above
    a box. The heights are taken as evenly spread around their mean: a sort would take most of the time.
    """
    close, _ = _inside(a.points, b, REACH)
    heights = _along(a.points, a.axes[:, 2])
    number = jnp.maximum(close.sum(), 1)
    mean = jnp.sum(jnp.where(close, heights, 0.0)) / number
    variance = jnp.sum(jnp.where(close, (heights - mean) ** 2, 0.0)) / number
    spread = jnp.sqrt(12.0 * jnp.maximum(variance, 1e-30))
    return jnp.where(close.any(), mean + (share - 0.5) * spread, otherwise)


def _tolerance(shape: ObjectShapes) -> Array:
    """Tolerance of a contact in height, world units."""
    return CONTACT * 2.0 * (shape.half_size[2] + 0.5 * (shape.half_size[0] + shape.half_size[1]))


def above(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether a is over b, touching or not: footprints overlap, and a begins where b ends there. b is then under a."""
    bottom, _, _ = _heights(a)
    _, top, _ = _heights(b)
    free = _local(a, b, 0.1, bottom) - _local(b, a, 0.9, top)
    return _rise(_overlap(a, b) - OVER) * _rise(free / jnp.maximum(_tolerance(a), 1e-12) + 1.0, 4.0)


def inside(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether a is in b: enough of its points lie in the box of b, which is no smaller across and reaches below it."""
    share = _inside(a.points, b)[1].mean()
    bottom, top, height = _heights(a)
    deep = 0.5 * (bottom + top) - _local(b, a, 0.25, _heights(b)[0])
    smaller = jnp.prod(b.half_size[:2]) / jnp.maximum(jnp.prod(a.half_size[:2]), 1e-12)
    return _rise(share - INSIDE) * _rise(deep / jnp.maximum(height, 1e-12)) * _rise(smaller - 0.7)


def on(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether a rests on b: most of it is over the footprint of b, it touches the surface there, and is not in b."""
    bottom, _, height = _heights(a)
    _, top, _ = _heights(b)
    held = _inside(a.points, b, 1.1)[0].mean()
    surface = _local(b, a, 0.75, top)
    contact = _within((bottom - surface) / jnp.maximum(_tolerance(a), 1e-12), 4.0)
    sunk = (surface - bottom) / jnp.maximum(height, 1e-12)
    return _rise(held - 0.5) * contact * _rise(0.4 - sunk) * (1.0 - inside(a, b))


def next_to(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether the objects are close to each other on one level, neither over the other."""
    (low_a, high_a, tall_a), (low_b, high_b, tall_b) = _heights(a), _heights(b)
    common = (jnp.minimum(high_a, high_b) - jnp.maximum(low_a, low_b)) / jnp.maximum(jnp.minimum(tall_a, tall_b), 1e-12)
    return _within(_relative_gap(a, b) / NEXT) * _rise(common - LEVEL) * _rise(OVER - _overlap(a, b))


def _relative_gap(a: ObjectShapes, b: ObjectShapes) -> Array:
    """The gap in units of the geometric mean of the sizes."""
    return gap(a, b) / jnp.maximum(jnp.sqrt(size_of(a) * size_of(b)), 1e-12)


def near(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether the gap is at most about the objects' size. It falls as the gap grows."""
    return _within(_relative_gap(a, b) / NEAR)


def far_from(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether the gap is several times the objects' size."""
    return 1.0 - _within(_relative_gap(a, b) / FAR)


def touching(a: ObjectShapes, b: ObjectShapes) -> Float[Array, ""]:
    """Whether the surfaces meet."""
    return _within(gap(a, b) / jnp.maximum(TOUCH * jnp.minimum(size_of(a), size_of(b)), 1e-12))


def between(a: ObjectShapes, b: ObjectShapes, c: ObjectShapes) -> Float[Array, ""]:
    """Whether a lies between b and c: its middle projects between theirs and is not far off the line."""
    line = c.center - b.center
    length = jnp.maximum(jnp.linalg.norm(line), 1e-12)
    along = ((a.center - b.center) @ line) / length**2
    off = jnp.linalg.norm(a.center - b.center - along * line)
    reach = BETWEEN * (0.5 * length + 0.5 * size_of(a))
    return _rise(along - 0.1, 20.0) * _rise(0.9 - along, 20.0) * _within(off / jnp.maximum(reach, 1e-12), 4.0)


def _pair(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> dict[str, Array]:
    """All relations of two objects by name."""
    return {
        "left of": left_of(a, b, view),
        "right of": left_of(b, a, view),
        "in front of": in_front_of(a, b, view),
        "behind": in_front_of(b, a, view),
        "above": above(a, b),
        "below": above(b, a),
        "on": on(a, b),
        "under": above(b, a),
        "in": inside(a, b),
        "next to": next_to(a, b),
        "near": near(a, b),
        "far from": far_from(a, b),
        "touching": touching(a, b),
        "gap": gap(a, b),
    }


@jax.jit
def pair_scores(a: ObjectShapes, b: ObjectShapes, view: Viewpoint) -> dict[str, Float[Array, "k l"]]:
    """Scores every relation of PAIRS between all objects of two sets.

    Args:
      a: K objects.
      b: L objects.
      view: From where directions are seen.

    Returns:
      (K, L) scores of "object of a RELATION object of b" by the name of the relation, and under "gap" the free
      distances in world units.
    """
    return jax.vmap(lambda one: jax.vmap(lambda other: _pair(one, other, view))(b))(a)


@jax.jit
def between_scores(a: ObjectShapes, b: ObjectShapes, c: ObjectShapes) -> Float[Array, "k l m"]:
    """Scores "object of a between object of b and object of c" for all triples."""
    triple = jax.vmap(between, in_axes=(None, None, 0))
    return jax.vmap(jax.vmap(triple, in_axes=(None, 0, None)), in_axes=(0, None, None))(a, b, c)


@jax.jit
def order_values(shapes: ObjectShapes, view: Viewpoint) -> dict[str, Float[Array, " k"]]:
    """Values by which K objects are ordered, the first has the smallest, for each of ORDERS.

    "largest" compares the volumes of boxes, "leftmost" the directions from the viewpoint, "nearest" the distances.
    """
    volume = jnp.prod(2.0 * shapes.half_size, axis=1) ** (1 / 3)
    height = 2.0 * shapes.half_size[:, 2]
    level = _along(shapes.center, view.up)
    away = shapes.center - view.eye
    bearing = jnp.arctan2(_along(away, view.right), _along(away, view.forward))
    distance = jnp.linalg.norm(away, axis=1)
    pairs = {"smallest": volume, "shortest": height, "lowest": level, "leftmost": bearing, "nearest": distance}
    opposite = dict(zip(pairs, ("largest", "tallest", "highest", "rightmost", "farthest")))
    return pairs | {opposite[name]: -value for name, value in pairs.items()}
