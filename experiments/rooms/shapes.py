"""Solids of the made-up room and the objects that are assembled from them.

A solid is {p : quadric(p) <= 0 and normal_k . p <= offset_k for all k}. It is convex, so a ray meets it in one
interval, which is computed exactly. A part is a solid, optionally less one convex hollow (a mug, a bowl). Vectors are
(3, n) float32 with coordinates first, which NumPy traverses about twice as fast as (n, 3).

An object stands on z = 0 around the z axis of its own frame. Lengths are in metres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

_NEVER = np.float32(1e30)
"""Ray parameter of a surface that is never met."""
_TINY = np.float32(1e-20)
"""Smallest divisor, against division by zero."""


@dataclasses.dataclass(frozen=True)
class Solid:
    """One convex solid with its pose."""

    quadric: np.ndarray
    """(5,) q, l, g of q0 x^2 + q1 y^2 + q2 z^2 + 2 l z + g <= 0 in the solid's frame; q = 0, g < 0 if absent."""
    planes: np.ndarray
    """(k, 4) outward unit normals and offsets in the solid's frame: inside where n . p <= offset."""
    axes: np.ndarray
    """(3, 3) columns are the solid's axes in the parent frame: a rotation."""
    centre: np.ndarray
    """(3,) origin of the solid's frame in the parent frame."""
    bound: np.ndarray
    """(4,) centre (parent frame) and radius of a sphere around the solid."""
    nappe: float = 0.0
    """dr/dz of a cone, to exclude its mirror image beyond the apex; 0 for other solids."""

    @property
    def radius_about_axis(self) -> float:
        """Radius of the smallest cylinder about z around the solid, m. A grid makes it too large by up to one cell."""
        steps, cell = np.linspace(-1, 1, 25, dtype=np.float32), self.bound[3] / 12
        grid = np.stack(np.meshgrid(steps, steps, steps)).reshape(3, -1)
        points = self.bound[:3, None] + self.bound[3] * grid
        points = points[:, contains(self, points, margin=float(cell))]
        return float(np.hypot(points[0], points[1]).max())


def _solid(quadric, planes, radius: float, middle=(0.0, 0.0, 0.0), nappe: float = 0.0) -> Solid:
    """A solid at the origin whose bounding sphere has this radius and middle."""
    bound = np.array([*middle, radius], np.float32)
    return Solid(
        np.asarray(quadric, np.float32),
        np.asarray(planes, np.float32).reshape(-1, 4),
        np.eye(3, dtype=np.float32),
        np.zeros(3, np.float32),
        bound,
        float(nappe),
    )


def ellipsoid(rx: float, ry: float, rz: float, *, below: float | None = None, above: float | None = None) -> Solid:
    """Makes an ellipsoid about the origin.

    Args:
      rx: Radius along x, m.
      ry: Radius along y, m.
      rz: Radius along z, m.
      below: Cuts it to z <= below, m.
      above: Cuts it to z >= above, m.

    Returns:
      The solid.
    """
    planes = [] if below is None else [(0, 0, 1, below)]
    planes += [] if above is None else [(0, 0, -1, -above)]
    return _solid((rx**-2, ry**-2, rz**-2, 0.0, -1.0), planes, max(rx, ry, rz))


def frustum(bottom: float, top: float, height: float) -> Solid:
    """Makes an upright section of a cone, or a cylinder, that stands on z = 0.

    Args:
      bottom: Radius at z = 0, m.
      top: Radius at z = height, m.
      height: Height, m.

    Returns:
      The solid.
    """
    slope = (top - bottom) / height
    planes = [(0, 0, 1, height), (0, 0, -1, 0.0)]
    quadric = (1.0, 1.0, -(slope**2), -bottom * slope, -(bottom**2))
    radius = float(np.hypot(height / 2, max(bottom, top)))
    return _solid(quadric, planes, radius, (0, 0, height / 2), slope)


def box(width: float, depth: float, height: float) -> Solid:
    """Makes an upright box that stands on z = 0, centred in x and y.

    Args:
      width: Size along x, m.
      depth: Size along y, m.
      height: Size along z, m.

    Returns:
      The solid.
    """
    sides = [(1, 0, 0, width / 2), (-1, 0, 0, width / 2), (0, 1, 0, depth / 2), (0, -1, 0, depth / 2)]
    planes = [*sides, (0, 0, 1, height), (0, 0, -1, 0.0)]
    radius = 0.5 * float(np.sqrt(width**2 + depth**2 + height**2))
    return _solid((0, 0, 0, 0, -1.0), planes, radius, (0, 0, height / 2))


def cut(solid: Solid, normal: tuple[float, float, float], offset: float) -> Solid:
    """Cuts a solid by a plane.

    Args:
      solid: The solid.
      normal: Unit normal in the solid's frame.
      offset: Offset of the plane, m.

    Returns:
      Its part with normal . p <= offset.
    """
    plane = np.array([[*normal, offset]], np.float32)
    return dataclasses.replace(solid, planes=np.concatenate([solid.planes, plane]))


def place(solid: Solid, centre, axes=None) -> Solid:
    """Moves a solid in its parent frame.

    Args:
      solid: The solid.
      centre: (3,) shift, applied last, m.
      axes: (3, 3) rotation; None is the identity.

    Returns:
      The moved solid.
    """
    turn = np.eye(3, dtype=np.float32) if axes is None else np.asarray(axes, np.float32)
    shift = np.asarray(centre, np.float32)
    bound = np.concatenate([turn @ solid.bound[:3] + shift, solid.bound[3:]])
    return dataclasses.replace(solid, axes=turn @ solid.axes, centre=turn @ solid.centre + shift, bound=bound)


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """Makes a rotation about z after one about y after one about x.

    Args:
      yaw: Angle about z, radians.
      pitch: Angle about y, radians.
      roll: Angle about x, radians.

    Returns:
      (3, 3) float32 matrix.
    """
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return (about_z @ about_y @ about_x).astype(np.float32)


def contains(solid: Solid, points: Float[np.ndarray, "3 n"], *, margin: float = 0.0) -> Bool[np.ndarray, " n"]:
    """Whether points lie in a solid.

    Args:
      solid: The solid.
      points: (3, N) in its parent frame, m.
      margin: Distance outside that still counts, m, to first order.

    Returns:
      (N,) bool.
    """
    return _nearest_surface(solid, points)[0] <= margin


def ray_interval(
    solid: Solid, origin: Float[np.ndarray, "3 _"], direction: Float[np.ndarray, "3 n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Intersects rays with a solid.

    Args:
      solid: The solid.
      origin: (3, N) or (3, 1) in its parent frame, m.
      direction: (3, N), of any length.

    Returns:
      (N,) ray parameters t between which origin + t direction lies in the solid; enter >= leave where it misses.
    """
    d = solid.axes.T @ direction
    o = solid.axes.T @ (origin - solid.centre[:, None])
    # Start where the ray passes the solid's origin, so that the terms of the quadratic have the size of the solid.
    start = -(o * d).sum(0) / np.maximum((d * d).sum(0), _TINY)
    o = o + start * d
    enter, leave = np.full(d.shape[1], -_NEVER), np.full(d.shape[1], _NEVER)
    if solid.quadric[:3].any():
        enter, leave = _quadric_interval(solid, o, d)
    for plane in solid.planes:
        axis = np.flatnonzero(plane[:3])
        if len(axis) == 1:
            along, room = plane[axis[0]] * d[axis[0]], plane[3] - plane[axis[0]] * o[axis[0]]
        else:
            along, room = plane[:3] @ d, plane[3] - plane[:3] @ o
        along = np.where(np.abs(along) < _TINY, _TINY, along)
        with np.errstate(over="ignore"):
            at = room / along
        enter = np.where(along < 0, np.maximum(enter, at), enter)
        leave = np.where(along > 0, np.minimum(leave, at), leave)
    return enter + start, leave + start


def _quadric_interval(solid, o, d):
    """Ray parameters between which o + t d, in the solid's frame, lies inside of its quadric."""
    q, slant, constant = solid.quadric[:3, None], solid.quadric[3], solid.quadric[4]
    qd = q * d
    a, b = (qd * d).sum(0), (qd * o).sum(0) + slant * d[2]
    c = (q * o * o).sum(0) + 2 * slant * o[2] + constant
    a = np.where(np.abs(a) < 1e-9, np.float32(1e-9), a)
    discriminant = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    # The stable form: no subtraction of nearly equal numbers when the ray runs along a cone's side.
    s = -(b + np.copysign(root, b))
    first, second = s / a, c / np.where(np.abs(s) < _TINY, _TINY, s)
    low, high = np.minimum(first, second), np.maximum(first, second)
    # a > 0: inside between the roots. a < 0: a ray within the opening angle of a cone is inside beyond the roots, and
    # only one of these half-lines is in the nappe that exists (towards growing radius).
    outward = solid.nappe * d[2] > 0
    enter = np.where(a > 0, low, np.where(outward, high, -_NEVER))
    leave = np.where(a > 0, high, np.where(outward, _NEVER, low))
    missed = (discriminant < 0) & (a > 0)
    return np.where(missed, _NEVER, enter), np.where(missed, -_NEVER, leave)


def first_hit(
    solid: Solid, hollow: Solid | None, origin: Float[np.ndarray, "3 _"], direction: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, " n"]:
    """Finds the first surface that rays meet of a solid less a hollow.

    Args:
      solid: The solid.
      hollow: The hollow, or None.
      origin: As in `ray_interval`, outside of the solid.
      direction: As in `ray_interval`.

    Returns:
      (N,) ray parameters; inf where missed.
    """
    enter, leave = ray_interval(solid, origin, direction)
    hit = (enter < leave) & (enter > 0)
    if hollow is not None:
        inner_enter, inner_leave = ray_interval(hollow, origin, direction)
        open_here = (inner_enter <= enter) & (enter < inner_leave)
        hit &= ~open_here | (inner_leave < leave)
        enter = np.where(open_here, inner_leave, enter)
    return np.where(hit, enter, np.float32(np.inf))


def blocks_segment(
    solid: Solid, hollow: Solid | None, origin: Float[np.ndarray, "3 _"], direction: Float[np.ndarray, "3 n"]
) -> Bool[np.ndarray, " n"]:
    """Whether a solid less a hollow meets segments.

    Args:
      solid: The solid.
      hollow: The hollow, or None.
      origin: As in `ray_interval`.
      direction: From the origin to the other end.

    Returns:
      (N,) bool.
    """
    enter, leave = ray_interval(solid, origin, direction)
    enter, leave = np.maximum(enter, 0), np.minimum(leave, 1)
    blocked = enter < leave
    if hollow is not None and blocked.any():
        inner_enter, inner_leave = ray_interval(hollow, origin, direction)
        blocked &= ~((inner_enter <= enter) & (inner_leave >= leave))
    return blocked


def _nearest_surface(solid, points):
    """Signed distance to the nearest surface of the solid (to first order) and the outward normal of that surface."""
    p = solid.axes.T @ (points - solid.centre[:, None])
    distance, normal = np.full(p.shape[1], -_NEVER), np.zeros_like(p)
    if solid.quadric[:3].any():
        q, slant, constant = solid.quadric[:3, None], solid.quadric[3], solid.quadric[4]
        gradient = q * p
        value = (gradient * p).sum(0) + 2 * slant * p[2] + constant
        gradient[2] += slant
        length = np.maximum(np.sqrt((gradient * gradient).sum(0)), _TINY)
        distance, normal = value / (2 * length), gradient / length
    for plane in solid.planes:
        beyond = plane[:3] @ p - plane[3]
        normal = np.where(beyond > distance, plane[:3, None], normal)
        distance = np.maximum(distance, beyond)
    return distance, solid.axes @ normal


def normals(solid: Solid, hollow: Solid | None, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """Computes normals of a solid less a hollow.

    Args:
      solid: The solid.
      hollow: The hollow, or None.
      points: (3, N) on its surface.

    Returns:
      (3, N) unit normals that point out of the material.
    """
    distance, normal = _nearest_surface(solid, points)
    if hollow is None:
        return normal
    inner_distance, inner_normal = _nearest_surface(hollow, points)
    return np.where(np.abs(inner_distance) < np.abs(distance), -inner_normal, normal)


Body: TypeAlias = Sequence[tuple[Solid, Solid | None, float]]
"""(solid, hollow or None, tone) of each part. The tone scales the named colour: 1.4 is lighter, 0.5 darker."""


def _ball(draw):
    r = draw.uniform(0.072, 0.1)
    return [(place(ellipsoid(r, r, r), (0, 0, r)), None, 1.0)]


def _box(draw):
    return [(box(draw.uniform(0.13, 0.19), draw.uniform(0.11, 0.15), draw.uniform(0.09, 0.15)), None, 1.0)]


def _vessel(bottom, top, height, wall):
    """Solid and hollow of an open cup with walls and floor of thickness `wall`. The hollow ends above the rim."""
    slope = (top - bottom) / height
    over = 0.01
    inner = frustum(bottom - wall + slope * wall, top - wall + slope * over, height - wall + over)
    return frustum(bottom, top, height), place(inner, (0, 0, wall))


def _mug(draw):
    r, h = draw.uniform(0.058, 0.072), draw.uniform(0.12, 0.15)
    outer, hollow = _vessel(r, r, h, 0.008)
    return [(outer, hollow, 1.0), (*_handle(draw.uniform(0.042, 0.048), r, h * 0.52, 0.0), 1.0)]


def _handle(ring, away, up, turned):
    """Half of an upright ring at distance `away` from the axis, height `up` and azimuth `turned`."""
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
    """The solid with the origin of its frame moved up by `down`, so that cuts and rotations are about its middle."""
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


SHAPES: dict[str, Callable[[np.random.Generator], Body]] = {
    "ball": _ball,
    "box": _box,
    "mug": _mug,
    "pot": _pot,
    "kettle": _kettle,
    "cup": _cup,
    "bowl": _bowl,
    "plate": _plate,
    "bottle": _bottle,
    "vase": _vase,
    "teddy": _teddy,
}
