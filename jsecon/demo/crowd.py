"""The demo's own room, harder than `make_room`'s: what makes kinds of query differ stands on one table.

Things with a lid and handles of another colour, two of a kind under one text, colours that lie near each other, one
thing upon another, a beam that no view shows whole, clutter that no text asks for, a chequered cloth.
"""

from __future__ import annotations

import numpy as np

from jsecon.demo.room import Room, around, radius_of, scatter, stand
from jsecon.demo.shapes import SHAPES, Body
from jsecon.demo.solids import box, place

TWICE = "red"
"""the colour of the two of a kind"""
PLATE, UPON = "white", "orange"
"""what stands on what"""
BEAM, ARCH = "turquoise", "brown"
"""what no view shows whole, and what it lies under"""
THINGS = {
    "dark green": ((18, 92, 42), ("bottle", "vase")),
    "green": ((46, 156, 66), ("pot",)),
    "light green": ((150, 222, 140), ("cup", "bowl")),
    "dark blue": ((24, 44, 140), ("vase", "mug")),
    "light blue": ((132, 192, 240), ("kettle",)),
    TWICE: ((208, 28, 38), ("mug", "cup")),
    PLATE: ((236, 236, 236), ("plate",)),
    UPON: ((247, 130, 18), ("ball",)),
    "dark orange": ((206, 98, 14), ("bowl", "box", "vase")),
    "light brown": ((158, 112, 72), ("teddy", "box")),
    "purple": ((124, 48, 158), ("bottle", "vase")),
}
"""colour -> sRGB and the shapes it may have"""
CLUTTER = ((96, 96, 98), (150, 140, 120), (112, 114, 60), (70, 60, 56), (206, 150, 140), (120, 150, 160))
"""sRGB of the small things without a name"""


def crowded_room(seed: int) -> Room:
    """The room; a function of the seed."""
    draw = np.random.default_rng([seed, 11])
    colours = [*THINGS, TWICE]
    shapes = {colour: str(draw.choice(shapes)) for colour, (_, shapes) in THINGS.items()}
    bodies = [SHAPES[shapes[colour]](draw) for colour in colours] + [_bit(draw) for _ in CLUTTER]
    radii = [radius_of(body) for body in bodies]
    long, turn = draw.uniform(0.62, 0.72), draw.uniform(-0.35, 0.35)
    middle = draw.uniform(-0.12, 0.12, 2)
    along = np.array([np.cos(turn), np.sin(turn)])
    taken = [(middle + step * along, 0.07) for step in np.linspace(-long / 2, long / 2, 8)] + [(middle, 0.11)]
    standing = [k for k in range(len(bodies)) if k != colours.index(UPON)]
    spots = dict(zip(standing, scatter(draw, [radii[k] for k in standing], taken, gap=0.01)))
    spots[colours.index(UPON)] = np.array([*spots[colours.index(PLATE)], 0.008])
    objects = []
    for k, body in enumerate(bodies):
        colour = colours[k] if k < len(colours) else ""
        srgb = THINGS[colour][0] if colour else CLUTTER[k - len(colours)]
        objects.append(stand(draw, k, colour, shapes.get(colour, ""), srgb, body, radii[k], spots[k]))
    beam, arch = (BEAM, "beam", (54, 190, 182), _beam(long)), (ARCH, "arch", (122, 72, 38), _arch())
    for colour, shape, srgb, body in (beam, arch):
        objects.append(stand(draw, len(objects), colour, shape, srgb, body, radius_of(body), middle, turn))
    return around(draw, tuple(objects), seed, cloth=True)


def _bit(draw: np.random.Generator) -> Body:
    return [(box(*draw.uniform(0.03, 0.06, 3)), None, 1.0)]


def _beam(long: float) -> Body:
    return [(box(long, 0.06, 0.05), None, 1.0)]


def _arch() -> Body:
    return [(box(0.06, 0.2, 0.15), place(box(0.1, 0.1, 0.11), (0, 0, -0.01)), 1.0)]
