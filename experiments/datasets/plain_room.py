"""The made-up room of the twins: one object of each colour on a bare table, a function of the seed."""

from __future__ import annotations

from collections import Counter

import numpy as np

from experiments.rooms.room import Room, build_room, footprint_radius, place_object, scatter_circles
from experiments.rooms.shapes import SHAPES, box, ellipsoid, frustum, place, rotation
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
"""sRGB of each colour name. The first four are two hues in two lightnesses each."""

_SHAPES_BY_COLOUR = {
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
"""Shapes that an object of each colour can have; repeated shapes are more likely."""


def make_room(seed: int, *, num_objects: int = 12) -> Room:
    """Builds a room with one object of each of the first colours of PALETTE on a bare table.

    Args:
      seed: Seed of the room.
      num_objects: Number of objects, 2 to 12. They do not touch each other.

    Returns:
      The room.

    Raises:
      ValueError: `num_objects` is out of range.
    """
    fits = 2 <= num_objects <= len(PALETTE)
    require(fits, "num_objects", num_objects, f"2 to {len(PALETTE)}", "There is one object per colour name.")
    draw = np.random.default_rng([seed, 2])
    colours = list(PALETTE)[:num_objects]
    shapes = _draw_shapes(draw, colours)
    bodies = [PLAIN_SHAPES[shape](draw) for shape in shapes]
    radii = [footprint_radius(body) for body in bodies]
    spots = scatter_circles(draw, radii)
    rows = zip(colours, shapes, map(PALETTE.__getitem__, colours), bodies, spots)
    objects = tuple(place_object(draw, k, *row) for k, row in enumerate(rows))
    return build_room(draw, objects, seed)


def _draw_shapes(draw, colours):
    """Draws a shape for each colour. Some shapes occur twice or three times, none more often."""
    while True:
        shapes = [str(draw.choice(_SHAPES_BY_COLOUR[colour])) for colour in colours]
        counts = sorted(Counter(shapes).values(), reverse=True)
        alike = sum(count >= 2 for count in counts)
        if counts[0] <= 3 and min(3, len(colours) // 4) <= alike <= 3:
            return shapes


def _book(draw):
    w, d, h = draw.uniform(0.21, 0.25), draw.uniform(0.15, 0.18), draw.uniform(0.045, 0.065)
    cover = 0.008
    return [
        (box(w, d, cover), None, 1.0),
        (place(box(w, d, cover), (0, 0, h - cover)), None, 1.0),
        (place(box(cover, d, h - 2 * cover), (-w / 2 + cover / 2, 0, cover)), None, 1.0),
        (place(box(w - 2 * cover, d - 0.014, h - 2 * cover), (0, 0, cover)), None, 1.35),
    ]


def _cone(draw):
    r, h = draw.uniform(0.075, 0.085), draw.uniform(0.2, 0.24)
    side = 2.3 * r
    return [(box(side, side, 0.014), None, 0.85), (place(frustum(r, 0.014, h), (0, 0, 0.014)), None, 1.0)]


def _duck(draw):
    s = draw.uniform(0.95, 1.15)
    return [
        (place(ellipsoid(0.095 * s, 0.066 * s, 0.062 * s, above=-0.055 * s), (0, 0, 0.055 * s)), None, 1.0),
        (place(ellipsoid(0.05 * s, 0.048 * s, 0.05 * s), (0.055 * s, 0, 0.142 * s)), None, 1.0),
        (place(ellipsoid(0.032 * s, 0.024 * s, 0.011 * s), (0.105 * s, 0, 0.136 * s)), None, 0.55),
        (place(ellipsoid(0.045 * s, 0.026 * s, 0.02 * s), (-0.09 * s, 0, 0.085 * s), rotation(pitch=0.6)), None, 1.0),
    ]


def _pig(draw):
    s = draw.uniform(0.95, 1.15)
    leg = frustum(0.017 * s, 0.019 * s, 0.05 * s)
    legs = [(place(leg, (x * s, y * s, 0)), None, 1.0) for x in (-0.05, 0.05) for y in (-0.032, 0.032)]
    ear = frustum(0.018 * s, 0.002 * s, 0.032 * s)
    ears = [(place(ear, (0.085 * s, y * s, 0.15 * s), rotation(roll=-8 * y)), None, 0.85) for y in (-0.03, 0.03)]
    snout = place(frustum(0.024 * s, 0.021 * s, 0.026 * s), (0.125 * s, 0, 0.108 * s), rotation(pitch=np.pi / 2))
    return [
        (place(ellipsoid(0.095 * s, 0.066 * s, 0.064 * s), (0, 0, 0.095 * s)), None, 1.0),
        (place(ellipsoid(0.052 * s, 0.05 * s, 0.05 * s), (0.085 * s, 0, 0.115 * s)), None, 1.0),
        (snout, None, 0.8),
        *legs,
        *ears,
    ]


def _lamp(draw):
    r, h = draw.uniform(0.09, 0.1), draw.uniform(0.12, 0.14)
    return [
        (frustum(0.075, 0.06, 0.022), None, 1.0),
        (place(frustum(0.016, 0.016, h), (0, 0, 0.02)), None, 1.0),
        (place(frustum(r, r * 0.55, 0.11), (0, 0, h)), None, 1.0),
    ]


def _toy_car(draw):
    s = draw.uniform(0.95, 1.1)
    wheel, turn = frustum(0.027 * s, 0.027 * s, 0.02 * s), rotation(roll=np.pi / 2)
    places = [(x * s, (y + 0.01) * s, 0.027 * s) for x in (-0.06, 0.06) for y in (-0.052, 0.052)]
    return [
        (place(box(0.2 * s, 0.1 * s, 0.05 * s), (0, 0, 0.025 * s)), None, 1.0),
        (place(box(0.1 * s, 0.086 * s, 0.045 * s), (-0.01 * s, 0, 0.075 * s)), None, 1.0),
        *((place(wheel, at, turn), None, 0.5) for at in places),
    ]


PLAIN_SHAPES = SHAPES | {"book": _book, "cone": _cone, "duck": _duck, "pig": _pig, "lamp": _lamp, "toy car": _toy_car}
"""Functions that draw the parts of a shape from a random source."""
