"""Contents of made-up rooms: objects with shapes, colours and textures, the table and the walls.

`crowded_room` is the room of the demo, a function of its seed. World: metres, z up, origin in the middle of the table's
top.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from experiments.rooms.shapes import SHAPES, Body, Solid, box, place, rotation

TABLE_HALF = (0.68, 0.56)
"""Half the width and depth of the table top, m."""
TABLE_HEIGHT = 0.74
"""Height of the table top above the floor, m."""
TABLE_THICKNESS = 0.045
"""Thickness of the table top, m."""
TABLE_WOOD = (155, 146, 132)
"""sRGB of the table."""
OBJECT_GAP_M = 0.025
"""Least distance between the footprints of two objects, and to the edge of the table, m."""
_LAMP_SIDE = 6
"""The lamp is a grid of this many points a side."""


@dataclasses.dataclass(frozen=True)
class Texture:
    """A pattern that modulates an albedo: albedo * (1 + depth * s(p)), s in [-1, 1]."""

    kind: str
    """"checks", "stripes", "marble", "wood" or "plain"."""
    scale: float
    """Period, m."""
    depth: float
    """Amplitude, 0 to 1."""
    phase: np.ndarray
    """(3,) Shift, m."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One solid of an object, optionally less a hollow, in world coordinates."""

    solid: Solid
    hollow: Solid | None
    owner: int
    """Index of the object; -1 for furniture."""
    albedo: np.ndarray
    """(3,) Linear RGB."""


@dataclasses.dataclass(frozen=True)
class RoomObject:
    """One named object."""

    name: str
    """Colour and shape, such as "dark green bottle". Empty for clutter."""
    colour: str
    shape: str
    centre: np.ndarray
    """(3,) Point on the table under the object, world."""
    axes: np.ndarray
    """(3, 3) Columns are the axes of the object in the world."""
    radius: float
    """Radius of a circle around the footprint, m."""
    texture: Texture
    parts: tuple[Part, ...]


@dataclasses.dataclass(frozen=True)
class Room:
    """A room, its furniture and its objects."""

    objects: tuple[RoomObject, ...]
    furniture: tuple[Part, ...]
    """The table top first, then the legs."""
    half: np.ndarray
    """(2,) Half the width and depth of the room, m; walls at +-half."""
    ceiling: float
    """z of the ceiling, m; the floor is at -TABLE_HEIGHT."""
    light: np.ndarray
    """(3,) Centre of the square lamp under the ceiling."""
    light_half: float
    """Half the side of the lamp, m."""
    seed: int
    cloth: bool = False
    """Whether a chequered cloth lies on the table."""

    @property
    def lamp_points(self) -> np.ndarray:
        """(3, M) float32 end points of shadow rays on the lamp, world."""
        ticks = ((np.arange(_LAMP_SIDE) + 0.5) / _LAMP_SIDE * 2 - 1) * self.light_half
        x, y = np.meshgrid(ticks, ticks)
        return (self.light[:, None] + np.stack([x.ravel(), y.ravel(), 0 * x.ravel()])).astype(np.float32)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in order."""
        return tuple(item.name for item in self.objects)

    @property
    def parts(self) -> tuple[Part, ...]:
        """All parts, those of the furniture first."""
        return self.furniture + tuple(part for item in self.objects for part in item.parts)


def srgb_to_linear(srgb) -> np.ndarray:
    """Converts sRGB to linear RGB (IEC 61966-2-1).

    Args:
      srgb: Numbers in 0..255, any shape.

    Returns:
      Numbers in 0..1, float32.
    """
    c = np.asarray(srgb, np.float32) / np.float32(255)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def build_room(draw: np.random.Generator, objects: tuple[RoomObject, ...], seed: int, *, cloth: bool = False) -> Room:
    """Puts walls, a lamp and a table around objects.

    Args:
      draw: Random source of their sizes and places.
      objects: The objects.
      seed: Seed of the room, which also decides its paint.
      cloth: Whether a chequered cloth lies on the table.

    Returns:
      The room.
    """
    half = np.array([draw.uniform(2.25, 2.5), draw.uniform(2.1, 2.35)], np.float32)
    aside, turn = draw.uniform(0.8, 1.1), draw.uniform(0, 2 * np.pi)
    light = np.array([aside * np.cos(turn), aside * np.sin(turn), 1.85], np.float32)
    return Room(objects, _table(), half, 1.9, light, 0.3, seed, cloth)


def footprint_radius(body: Body) -> float:
    """Measures the footprint of a shape.

    Args:
      body: The shape.

    Returns:
      Radius of a circle around it, m.
    """
    return max(solid.radius_about_axis for solid, _, _ in body)


def scatter_circles(
    draw: np.random.Generator,
    radii: Sequence[float],
    taken: Sequence[tuple[np.ndarray, float]] = (),
    *,
    gap: float = OBJECT_GAP_M,
) -> np.ndarray:
    """Draws places for circles on the table, the largest first, and starts again when one does not fit.

    Args:
      draw: Random source.
      radii: K radii of footprints, m.
      taken: Circles (centre, radius) that are kept free, m.
      gap: Least distance between circles, m.

    Returns:
      (K, 2) float32 centres, m.
    """
    half = np.array(TABLE_HALF) - gap
    while True:
        spots: dict[int, np.ndarray] = {}
        for k in np.argsort(radii)[::-1]:
            for spot in draw.uniform(-(half - radii[k]), half - radii[k], (300, 2)):
                others = [*taken, *((other, radii[j]) for j, other in spots.items())]
                if all(np.hypot(*(spot - other)) > radii[k] + r + gap for other, r in others):
                    spots[int(k)] = spot
                    break
            else:
                break
        if len(spots) == len(radii):
            return np.array([spots[k] for k in range(len(radii))], np.float32)


def place_object(
    draw: np.random.Generator,
    index: int,
    colour: str,
    shape: str,
    srgb: tuple[int, int, int],
    body: Body,
    spot: Sequence[float] | np.ndarray,
    yaw: float | None = None,
) -> RoomObject:
    """Makes an object of a room, with a random texture.

    Args:
      draw: Random source.
      index: Index of the object in the room.
      colour: First part of its name.
      shape: Second part of its name.
      srgb: Its colour, 0..255.
      body: Its shape.
      spot: Place under it, x y or x y z, m.
      yaw: Rotation about z, radians; None: random.

    Returns:
      The object.
    """
    axes = rotation(yaw=draw.uniform(0, 2 * np.pi) if yaw is None else yaw)
    centre = np.array([*spot, 0.0][:3], np.float32)
    albedo = srgb_to_linear(srgb) * np.float32(draw.uniform(0.94, 1.0))
    # Stripes across many small parts would hide what the object is.
    kinds = ["plain", "marble"] if len(body) > 4 else ["plain", "stripes", "checks", "marble", "marble"]
    kind, scale, depth = str(draw.choice(kinds)), draw.uniform(0.03, 0.05), draw.uniform(0.12, 0.2)
    texture = Texture(kind, scale, depth, draw.uniform(-0.1, 0.1, 3).astype(np.float32))

    def part(solid, hollow, tone):
        inner = None if hollow is None else place(hollow, centre, axes)
        return Part(place(solid, centre, axes), inner, index, np.minimum(albedo * np.float32(tone), 0.95))

    parts = tuple(part(*row) for row in body)
    return RoomObject(f"{colour} {shape}".strip(), colour, shape, centre, axes, footprint_radius(body), texture, parts)


def _table():
    wood = srgb_to_linear(TABLE_WOOD)
    (x, y), t = TABLE_HALF, TABLE_THICKNESS
    parts = [Part(place(box(2 * x, 2 * y, t), (0, 0, -t)), None, -1, wood)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = place(box(0.06, 0.06, TABLE_HEIGHT - t), (sx * (x - 0.06), sy * (y - 0.06), -TABLE_HEIGHT))
            parts.append(Part(leg, None, -1, wood))
    return tuple(parts)


REPEATED_COLOUR = "red"
"""Colour of two objects that share one name."""
PLATE_COLOUR, ON_PLATE_COLOUR = "white", "orange"
"""Colours of the plate and of the object that stands on it."""
BEAM_COLOUR, ARCH_COLOUR = "turquoise", "brown"
"""Colours of a beam that no view shows whole, and of the arch above it."""
CROWDED_OBJECTS = {
    "dark green": ((18, 92, 42), ("bottle", "vase")),
    "green": ((46, 156, 66), ("pot",)),
    "light green": ((150, 222, 140), ("cup", "bowl")),
    "dark blue": ((24, 44, 140), ("vase", "mug")),
    "light blue": ((132, 192, 240), ("kettle",)),
    REPEATED_COLOUR: ((208, 28, 38), ("mug", "cup")),
    PLATE_COLOUR: ((236, 236, 236), ("plate",)),
    ON_PLATE_COLOUR: ((247, 130, 18), ("ball",)),
    "dark orange": ((206, 98, 14), ("bowl", "box", "vase")),
    "light brown": ((158, 112, 72), ("teddy", "box")),
    "purple": ((124, 48, 158), ("bottle", "vase")),
}
"""sRGB and possible shapes of each colour."""
CLUTTER_COLOURS = ((96, 96, 98), (150, 140, 120), (112, 114, 60), (70, 60, 56), (206, 150, 140), (120, 150, 160))
"""sRGB of small objects without a name."""


def crowded_room(seed: int) -> Room:
    """Builds a room in which kinds of query differ.

    Objects have lids and handles of another colour, two share a name, colours lie near each other, one object stands
    on another, no view shows the whole beam, and clutter lies on a chequered cloth.

    Args:
      seed: Seed of the room.

    Returns:
      The room. Clutter has the name "".
    """
    draw = np.random.default_rng([seed, 11])
    colours = [*CROWDED_OBJECTS, REPEATED_COLOUR]
    shapes = {colour: str(draw.choice(shapes)) for colour, (_, shapes) in CROWDED_OBJECTS.items()}
    bodies = [SHAPES[shapes[colour]](draw) for colour in colours] + [_clutter(draw) for _ in CLUTTER_COLOURS]
    radii = [footprint_radius(body) for body in bodies]
    long, turn = draw.uniform(0.62, 0.72), draw.uniform(-0.35, 0.35)
    middle = draw.uniform(-0.12, 0.12, 2)
    along = np.array([np.cos(turn), np.sin(turn)])
    taken = [(middle + step * along, 0.07) for step in np.linspace(-long / 2, long / 2, 8)] + [(middle, 0.11)]
    on_table = [k for k in range(len(bodies)) if k != colours.index(ON_PLATE_COLOUR)]
    spots = dict(zip(on_table, scatter_circles(draw, [radii[k] for k in on_table], taken, gap=0.01)))
    spots[colours.index(ON_PLATE_COLOUR)] = np.array([*spots[colours.index(PLATE_COLOUR)], 0.008])
    objects = []
    for k, body in enumerate(bodies):
        colour = colours[k] if k < len(colours) else ""
        srgb = CROWDED_OBJECTS[colour][0] if colour else CLUTTER_COLOURS[k - len(colours)]
        objects.append(place_object(draw, k, colour, shapes.get(colour, ""), srgb, body, spots[k]))
    beam, arch = (BEAM_COLOUR, "beam", (54, 190, 182), _beam(long)), (ARCH_COLOUR, "arch", (122, 72, 38), _arch())
    for colour, shape, srgb, body in (beam, arch):
        objects.append(place_object(draw, len(objects), colour, shape, srgb, body, middle, turn))
    return build_room(draw, tuple(objects), seed, cloth=True)


def _clutter(draw: np.random.Generator) -> Body:
    return [(box(*draw.uniform(0.03, 0.06, 3)), None, 1.0)]


def _beam(long: float) -> Body:
    return [(box(long, 0.06, 0.05), None, 1.0)]


def _arch() -> Body:
    return [(box(0.06, 0.2, 0.15), place(box(0.1, 0.1, 0.11), (0, 0, -0.01)), 1.0)]
