"""The demo room's light: a square lamp with soft shadows, and a sky that corners and contacts see less of."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float32

from jsecon.demo.room import Part, Room
from jsecon.demo.solids import blocks

SKY, LAMP = 0.84, 0.48
"""radiance of a white surface under the whole sky, and facing the whole lamp; together a colour keeps its lightness"""
_LAMP_SIDE = 6
"""the lamp is a grid of 6 x 6 points"""
LIFT = np.float32(1e-3)
"""shadow rays start this far off their surface, m"""


def lamp_points(room: Room) -> Float32[np.ndarray, "3 m"]:
    """The points of the lamp that shadow rays go to, world."""
    ticks = ((np.arange(_LAMP_SIDE) + 0.5) / _LAMP_SIDE * 2 - 1) * room.light_half
    x, y = np.meshgrid(ticks, ticks)
    return (room.light[:, None] + np.stack([x.ravel(), y.ravel(), 0 * x.ravel()])).astype(np.float32)


def lamp_visibility(
    room: Room, points: Float[np.ndarray, "3 n"], *, lamps: Float[np.ndarray, "3 m"], skip_furniture: bool = False
) -> Float[np.ndarray, " n"]:
    """The share of the lamp's points that each point sees, 0 to 1."""
    if not points.shape[1]:
        return np.ones(0, np.float32)
    count = lamps.shape[1]
    blocked = np.zeros((count, points.shape[1]), bool)
    for part in _shading_parts(room, points, skip_furniture):
        near = np.flatnonzero(_may_shade(room, part.solid.bound, points))
        if len(near):
            origin = np.tile(points[:, near], count)
            target = np.repeat(lamps, len(near), 1)
            blocked[:, near] |= blocks(part.solid, part.hollow, origin, target - origin).reshape(count, -1)
    return 1 - blocked.mean(0, dtype=np.float32)


def _shading_parts(room: Room, points: np.ndarray, skip_furniture: bool) -> Iterator[Part]:
    """The parts that may shade any of the points: those near the cone from a sphere around them to the lamp."""
    middle = 0.5 * (points.min(1) + points.max(1))
    spread = np.sqrt(((points - middle[:, None]) ** 2).sum(0).max())
    for part in room.parts:
        if part.owner < 0 and skip_furniture:
            continue
        wider = part.solid.bound + np.array([0, 0, 0, spread], np.float32)
        if _may_shade(room, wider, middle[:, None])[0]:
            yield part


def _may_shade(room, bound, points):
    """Whether the bounding sphere may reach into the cone from a point to the lamp; never wrongly False."""
    to_lamp, to_bound = room.light[:, None] - points, bound[:3, None] - points
    length2 = (to_lamp * to_lamp).sum(0)
    along = np.clip((to_lamp * to_bound).sum(0) / length2, 0, 1)
    off = to_bound - along * to_lamp
    # The cone is widest, within the sphere, at the sphere's far side.
    far = np.minimum(along + 1.5 * bound[3] / np.sqrt(length2), 1)
    reach = bound[3] + far * np.float32(room.light_half * np.sqrt(2))
    return (off * off).sum(0) < reach * reach


def direct(room: Room, points: Float[np.ndarray, "3 n"], normal: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """Cosine between the normal and the way to the lamp's middle, 0 where the surface is turned away."""
    to_lamp = room.light[:, None] - points
    return np.maximum((normal * to_lamp).sum(0) / np.sqrt((to_lamp * to_lamp).sum(0)), 0)


def contact(room: Room, points: Float[np.ndarray, "3 n"], normal: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """The share of the sky that the objects leave to a point, each of their parts taken as a sphere in its bound."""
    left = np.ones(points.shape[1], np.float32)
    for part in room.parts:
        if part.owner < 0:
            continue
        to = part.solid.bound[:3, None] - points
        distance = np.sqrt((to * to).sum(0))
        radius = np.minimum(0.8 * part.solid.bound[3], 0.95 * distance)
        cosine = np.clip((normal * to).sum(0) / np.maximum(distance, 1e-6), 0, 1)
        left *= 1 - 0.6 * cosine * (radius / np.maximum(distance, 1e-6)) ** 2
    return left
