"""The shapes of the demo room's objects, each put together from a few convex solids.

A shape takes a random source and gives [(solid, hollow or None, tone)]: tone scales the named colour (1.4 lighter, 0.5
darker). An object stands on z = 0 around the z axis of its own frame; lengths in metres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from jsecon.demo.solids import Solid, box, contains, cut, ellipsoid, frustum, place, rotation

Body: TypeAlias = Sequence[tuple[Solid, Solid | None, float]]
"""solids, what is hollow of each, and its tone"""


def reach(solid: Solid) -> float:
    """Radius about the z axis that holds the solid, m: from a grid over its bounding sphere, up to a cell too large."""
    steps, cell = np.linspace(-1, 1, 25, dtype=np.float32), solid.bound[3] / 12
    grid = np.stack(np.meshgrid(steps, steps, steps)).reshape(3, -1)
    points = solid.bound[:3, None] + solid.bound[3] * grid
    points = points[:, contains(solid, points, margin=float(cell))]
    return float(np.hypot(points[0], points[1]).max())


def _ball(draw):
    r = draw.uniform(0.072, 0.1)
    return [(place(ellipsoid(r, r, r), (0, 0, r)), None, 1.0)]


def _box(draw):
    return [(box(draw.uniform(0.13, 0.19), draw.uniform(0.11, 0.15), draw.uniform(0.09, 0.15)), None, 1.0)]


def _book(draw):
    w, d, h = draw.uniform(0.21, 0.25), draw.uniform(0.15, 0.18), draw.uniform(0.045, 0.065)
    cover = 0.008
    return [
        (box(w, d, cover), None, 1.0),
        (place(box(w, d, cover), (0, 0, h - cover)), None, 1.0),
        (place(box(cover, d, h - 2 * cover), (-w / 2 + cover / 2, 0, cover)), None, 1.0),
        (place(box(w - 2 * cover, d - 0.014, h - 2 * cover), (0, 0, cover)), None, 1.35),
    ]


def _vessel(bottom, top, height, wall):
    """Outer and hollow of an open cup whose wall and floor are `wall` thick; the hollow comes out above the rim."""
    slope = (top - bottom) / height
    over = 0.01
    inner = frustum(bottom - wall + slope * wall, top - wall + slope * over, height - wall + over)
    return frustum(bottom, top, height), place(inner, (0, 0, wall))


def _mug(draw):
    r, h = draw.uniform(0.058, 0.072), draw.uniform(0.12, 0.15)
    outer, hollow = _vessel(r, r, h, 0.008)
    return [(outer, hollow, 1.0), (*_handle(draw.uniform(0.042, 0.048), r, h * 0.52, 0.0), 1.0)]


def _handle(ring, away, up, turned):
    """A ring standing upright `away` from the axis, on the side of `turned`; its half towards the axis is cut away."""
    eye, turn = 0.016, rotation(yaw=turned) @ rotation(roll=np.pi / 2) @ rotation(yaw=np.pi)
    half = cut(_about_middle(frustum(ring, ring, 0.022), 0.011), (1.0, 0.0, 0.0), 0.004)
    hole = _about_middle(frustum(ring - eye, ring - eye, 0.06), 0.03)
    at = (away * np.cos(turned), away * np.sin(turned), up)
    return place(half, at, turn), place(hole, at, turn)


def _pot(draw):
    r, h = draw.uniform(0.085, 0.1), draw.uniform(0.1, 0.12)
    handles = [(*_handle(0.034, r, 0.75 * h, turned), 0.12) for turned in (0.0, np.pi)]
    lid = place(ellipsoid(r * 1.04, r * 1.04, 0.035, above=0.0), (0, 0, h))
    return [(frustum(r, r, h), None, 1.0), (lid, None, 0.55), (place(_knob(), (0, 0, h + 0.045)), None, 0.12), *handles]


def _kettle(draw):
    r, h = draw.uniform(0.08, 0.09), draw.uniform(0.13, 0.15)
    spout = place(frustum(0.024, 0.013, 0.075), (-0.75 * r, 0, 0.45 * h), rotation(pitch=-0.8))
    lid = place(frustum(r * 0.72, r * 0.5, 0.02), (0, 0, h))
    return [
        (frustum(r, r * 0.7, h), None, 1.0),
        (spout, None, 1.0),
        (lid, None, 0.5),
        (place(_knob(), (0, 0, h + 0.03)), None, 0.12),
        (*_handle(0.05, 0.8 * r, 0.55 * h, 0.0), 0.12),
    ]


def _knob():
    return ellipsoid(0.016, 0.016, 0.014)


def _about_middle(solid: Solid, down: float) -> Solid:
    """The solid with its own frame's origin moved up by `down`, so that planes and turns are about its middle."""
    planes = solid.planes.copy()
    planes[:, 3] -= planes[:, 2] * np.float32(down)
    q = solid.quadric.copy()
    q[4] = q[4] + 2 * q[3] * down + q[2] * down**2
    q[3] = q[3] + q[2] * down
    bound = solid.bound - np.array([0, 0, down, 0], np.float32)
    return dataclasses.replace(solid, planes=planes, quadric=q, bound=bound)


def _cup(draw):
    top, h = draw.uniform(0.066, 0.08), draw.uniform(0.13, 0.16)
    outer, hollow = _vessel(top * 0.72, top, h, 0.007)
    return [(outer, hollow, 1.0)]


def _bowl(draw):
    r, h = draw.uniform(0.1, 0.12), draw.uniform(0.075, 0.095)
    foot = 0.012
    shell = place(ellipsoid(r, r, h, below=0.0), (0, 0, h + foot * 0.5))
    # The inner ellipsoid is cut above the outer's rim, or a film would close the bowl.
    inner = place(ellipsoid(r - 0.009, r - 0.009, h - 0.009, below=0.02), (0, 0, h + foot * 0.5))
    return [(shell, inner, 1.0), (frustum(r * 0.5, r * 0.42, foot), None, 1.0)]


def _plate(draw):
    r = draw.uniform(0.12, 0.135)
    outer, hollow = _vessel(r * 0.66, r, 0.028, 0.008)
    return [(outer, hollow, 1.0)]


def _bottle(draw):
    r, h = draw.uniform(0.048, 0.058), draw.uniform(0.14, 0.17)
    neck, shoulder, long = r * 0.38, 0.045, 0.06
    return [
        (frustum(r, r, h), None, 1.0),
        (place(frustum(r, neck, shoulder), (0, 0, h)), None, 1.0),
        (place(frustum(neck, neck, long), (0, 0, h + shoulder)), None, 1.0),
        (place(frustum(neck * 1.25, neck * 1.25, 0.022), (0, 0, h + shoulder + long)), None, 0.8),
    ]


def _vase(draw):
    r, h = draw.uniform(0.068, 0.08), draw.uniform(0.085, 0.1)
    body = place(ellipsoid(r, r, h, above=-h * 0.92, below=h * 0.86), (0, 0, h * 0.92))
    at, base = h * 1.74, r * 0.5
    outer, hollow = _vessel(base, base * 1.5, 0.06, 0.007)
    return [(body, None, 1.0), (place(outer, (0, 0, at)), place(hollow, (0, 0, at)), 1.0)]


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


def _teddy(draw):
    s = draw.uniform(0.95, 1.1)
    limbs = []  # feet, arms, ears
    for side in (-1, 1):
        for centre, radii, tone in [
            ((0.055, 0.042, 0.026), (0.045, 0.026, 0.026), 1.0),
            ((0.03, 0.062, 0.1), (0.036, 0.02, 0.022), 1.0),
            ((0.0, 0.042, 0.222), (0.012, 0.021, 0.021), 0.9),
        ]:
            at = (s * centre[0], side * s * centre[1], s * centre[2])
            limbs.append((place(ellipsoid(*(s * v for v in radii)), at), None, tone))
    return [
        (place(ellipsoid(0.058 * s, 0.062 * s, 0.072 * s, above=-0.07 * s), (0, 0, 0.07 * s)), None, 1.0),
        (place(ellipsoid(0.048 * s, 0.054 * s, 0.05 * s), (0.006 * s, 0, 0.178 * s)), None, 1.0),
        (place(ellipsoid(0.024 * s, 0.026 * s, 0.02 * s), (0.05 * s, 0, 0.168 * s)), None, 1.4),
        *limbs,
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


SHAPES = {
    "ball": _ball,
    "box": _box,
    "book": _book,
    "mug": _mug,
    "pot": _pot,
    "kettle": _kettle,
    "cup": _cup,
    "bowl": _bowl,
    "plate": _plate,
    "bottle": _bottle,
    "vase": _vase,
    "cone": _cone,
    "duck": _duck,
    "pig": _pig,
    "teddy": _teddy,
    "lamp": _lamp,
    "toy car": _toy_car,
}
