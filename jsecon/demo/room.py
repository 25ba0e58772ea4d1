"""What the demo room holds: which objects, of which shapes and colours, with which textures, stand where.

Everything follows from the seed. World: metres, z up, the origin in the middle of the table's top.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence

import numpy as np

from jsecon.demo.shapes import SHAPES, Body, reach
from jsecon.demo.solids import Solid, box, place, rotation
from jsecon.errors import require

PALETTE = {
    "dark green": (18, 92, 42),
    "light green": (142, 222, 132),
    "dark blue": (24, 44, 140),
    "light blue": (132, 192, 240),
    "red": (208, 28, 38),
    "orange": (247, 130, 18),
    "yellow": (250, 216, 32),
    "purple": (124, 48, 158),
    "pink": (250, 148, 186),
    "brown": (118, 70, 34),
    "white": (236, 236, 236),
    "black": (30, 29, 32),
}
"""sRGB of each colour name; the first four are the two pairs of one hue and two lightnesses"""

_SUITABLE = {
    "dark green": ("bottle", "bottle", "book", "ball", "mug"),
    "light green": ("cup", "ball", "mug", "box", "bowl"),
    "dark blue": ("book", "mug", "ball", "box", "vase"),
    "light blue": ("box", "cup", "mug", "ball", "toy car"),
    "red": ("mug", "toy car", "ball", "box", "book"),
    "orange": ("ball", "ball", "cone", "bowl", "box"),
    "yellow": ("duck", "duck", "ball", "cup", "box"),
    "purple": ("vase", "ball", "box", "mug", "bowl"),
    "pink": ("pig", "pig", "cone", "ball", "cup"),
    "brown": ("teddy", "teddy", "bowl", "box", "bottle"),
    "white": ("plate", "bowl", "vase", "mug"),
    "black": ("lamp", "lamp", "toy car", "box"),
}

TABLE_HALF = (0.68, 0.56)
TABLE_HEIGHT = 0.74
TABLE_THICKNESS = 0.045
TABLE_WOOD = (155, 146, 132)
GAP = 0.025
"""least free space between two objects' footprints, and to the table's edge, m"""


@dataclasses.dataclass(frozen=True)
class Texture:
    """A pattern that makes an albedo lighter and darker: albedo * (1 + depth * s(p)), s in [-1, 1]."""

    kind: str
    """"checks", "stripes", "marble", "wood" or "plain"."""
    scale: float
    """period, m."""
    depth: float
    """amplitude, 0 to 1."""
    phase: np.ndarray
    """(3,) shift, m."""


@dataclasses.dataclass(frozen=True)
class Part:
    """One solid (less a hollow) of an object, in the world."""

    solid: Solid
    hollow: Solid | None
    owner: int
    """index of its object; -1 = furniture."""
    albedo: np.ndarray
    """(3,) linear RGB."""


@dataclasses.dataclass(frozen=True)
class RoomObject:
    """One named object."""

    name: str
    """colour + shape: "dark green bottle"; unique in `make_room`'s rooms; "" for what no text asks for."""
    colour: str
    shape: str
    centre: np.ndarray
    """(3,) where it touches the table, world."""
    axes: np.ndarray
    """(3, 3) columns are its axes in the world."""
    radius: float
    """of a circle around its footprint, m."""
    texture: Texture
    parts: tuple[Part, ...]


@dataclasses.dataclass(frozen=True)
class Room:
    """A room, its furniture and its objects."""

    objects: tuple[RoomObject, ...]
    furniture: tuple[Part, ...]
    """the table's top first, then its legs."""
    half: np.ndarray
    """(2,) half the room's width and depth, m; walls at +-half."""
    ceiling: float
    """z of the ceiling; the floor is at -TABLE_HEIGHT."""
    light: np.ndarray
    """(3,) centre of the square lamp under the ceiling."""
    light_half: float
    """half the lamp's side, m."""
    seed: int
    cloth: bool = False
    """whether a chequered cloth lies on the table."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(item.name for item in self.objects)

    @property
    def parts(self) -> tuple[Part, ...]:
        """All parts, the furniture's first."""
        return self.furniture + tuple(part for item in self.objects for part in item.parts)


def linear(srgb) -> np.ndarray:
    """sRGB in 0..255 to linear RGB in 0..1 (IEC 61966-2-1)."""
    c = np.asarray(srgb, np.float32) / np.float32(255)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def make_room(seed: int, *, num_objects: int = 12) -> Room:
    """A room with `num_objects` (2 to 12) named objects on its table, none touching another; a function of the seed.

    Raises ValueError where `num_objects` is out of range.
    """
    fits = 2 <= num_objects <= len(PALETTE)
    require(fits, "num_objects", num_objects, f"2 to {len(PALETTE)}", "There is one object per colour name.")
    draw = np.random.default_rng([seed, 2])
    colours = list(PALETTE)[:num_objects]
    shapes = _draw_shapes(draw, colours)
    bodies = [SHAPES[shape](draw) for shape in shapes]
    radii = [radius_of(body) for body in bodies]
    spots = scatter(draw, radii)
    rows = zip(colours, shapes, map(PALETTE.__getitem__, colours), bodies, radii, spots)
    objects = tuple(stand(draw, k, *row) for k, row in enumerate(rows))
    return around(draw, objects, seed)


def around(draw: np.random.Generator, objects: tuple[RoomObject, ...], seed: int, *, cloth: bool = False) -> Room:
    """The room that the objects' table stands in."""
    half = np.array([draw.uniform(2.25, 2.5), draw.uniform(2.1, 2.35)], np.float32)
    aside, turn = draw.uniform(0.8, 1.1), draw.uniform(0, 2 * np.pi)
    light = np.array([aside * np.cos(turn), aside * np.sin(turn), 1.85], np.float32)
    return Room(objects, _table(), half, 1.9, light, 0.3, seed, cloth)


def _draw_shapes(draw, colours):
    """A shape for each colour: several objects alike in shape, no shape more than three times."""
    while True:
        shapes = [str(draw.choice(_SUITABLE[colour])) for colour in colours]
        counts = sorted(Counter(shapes).values(), reverse=True)
        alike = sum(count >= 2 for count in counts)
        if counts[0] <= 3 and min(3, len(colours) // 4) <= alike <= 3:
            return shapes


def radius_of(body: Body) -> float:
    """Of a circle around a shape's footprint, m."""
    return max(reach(solid) for solid, _, _ in body)


def scatter(
    draw: np.random.Generator,
    radii: Sequence[float],
    taken: Sequence[tuple[np.ndarray, float]] = (),
    *,
    gap: float = GAP,
) -> np.ndarray:
    """(K, 2) float32 places on the table, footprints `gap` apart, and from the circles `taken` (centre, radius): the
    largest first, anew when one finds no room."""
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


def stand(
    draw: np.random.Generator,
    index: int,
    colour: str,
    shape: str,
    srgb: tuple[int, int, int],
    body: Body,
    radius: float,
    spot: Sequence[float] | np.ndarray,
    yaw: float | None = None,
) -> RoomObject:
    """The object `index` of a room at `spot`, x y of the table or x y z, turned by `yaw` (default: anyhow)."""
    axes = rotation(yaw=draw.uniform(0, 2 * np.pi) if yaw is None else yaw)
    centre = np.array([*spot, 0.0][:3], np.float32)
    albedo = linear(srgb) * np.float32(draw.uniform(0.94, 1.0))
    # Stripes across many small parts would hide what the object is.
    kinds = ["plain", "marble"] if len(body) > 4 else ["plain", "stripes", "checks", "marble", "marble"]
    kind, scale, depth = str(draw.choice(kinds)), draw.uniform(0.03, 0.05), draw.uniform(0.12, 0.2)
    texture = Texture(kind, scale, depth, draw.uniform(-0.1, 0.1, 3).astype(np.float32))

    def part(solid, hollow, tone):
        inner = None if hollow is None else place(hollow, centre, axes)
        return Part(place(solid, centre, axes), inner, index, np.minimum(albedo * np.float32(tone), 0.95))

    parts = tuple(part(*row) for row in body)
    return RoomObject(f"{colour} {shape}".strip(), colour, shape, centre, axes, float(radius), texture, parts)


def _table():
    wood = linear(TABLE_WOOD)
    (x, y), t = TABLE_HALF, TABLE_THICKNESS
    parts = [Part(place(box(2 * x, 2 * y, t), (0, 0, -t)), None, -1, wood)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = place(box(0.06, 0.06, TABLE_HEIGHT - t), (sx * (x - 0.06), sy * (y - 0.06), -TABLE_HEIGHT))
            parts.append(Part(leg, None, -1, wood))
    return tuple(parts)
