"""Convex solids and what a ray does to them, exactly: a diagonal quadric cut by planes, optionally with a hollow.

Every solid of the demo room is {p : quadric(p) <= 0 and normal_k . p <= offset_k for all k}, which is convex, so a ray
meets it in one interval. A part may have one convex hollow taken out of it (a mug, a bowl). Vectors are (3, n) float32,
coordinates first, which NumPy goes through about twice as fast as (n, 3).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

_NEVER = np.float32(1e30)
_TINY = np.float32(1e-20)


@dataclasses.dataclass(frozen=True)
class Solid:
    """One convex solid with its pose."""

    quadric: np.ndarray
    """(5,) q, l, g of q0 x^2 + q1 y^2 + q2 z^2 + 2 l z + g <= 0 in the solid's own frame; q = 0, g < 0 for none."""
    planes: np.ndarray
    """(k, 4) outward unit normals and offsets in the solid's own frame: inside where n . p <= offset."""
    axes: np.ndarray
    """(3, 3) columns are the solid's axes in the parent frame: a rotation."""
    centre: np.ndarray
    """(3,) origin of the solid's frame in the parent frame."""
    bound: np.ndarray
    """(4,) centre (parent frame) and radius of a sphere around the solid."""
    nappe: float = 0.0
    """dr/dz of a cone, whose mirror image beyond the apex is not part of the solid; 0 for anything else."""


def _solid(quadric, planes, radius: float, middle=(0.0, 0.0, 0.0), nappe: float = 0.0) -> Solid:
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
    """Ellipsoid of radii rx, ry, rz about the origin, cut to z <= `below` and z >= `above` where given."""
    planes = [] if below is None else [(0, 0, 1, below)]
    planes += [] if above is None else [(0, 0, -1, -above)]
    return _solid((rx**-2, ry**-2, rz**-2, 0.0, -1.0), planes, max(rx, ry, rz))


def frustum(bottom: float, top: float, height: float) -> Solid:
    """Upright cone section, radius `bottom` at z = 0 and `top` at z = `height`; a cylinder where they agree."""
    slope = (top - bottom) / height
    planes = [(0, 0, 1, height), (0, 0, -1, 0.0)]
    quadric = (1.0, 1.0, -(slope**2), -bottom * slope, -(bottom**2))
    radius = float(np.hypot(height / 2, max(bottom, top)))
    return _solid(quadric, planes, radius, (0, 0, height / 2), slope)


def box(width: float, depth: float, height: float) -> Solid:
    """Upright box standing on z = 0, centred in x and y."""
    sides = [(1, 0, 0, width / 2), (-1, 0, 0, width / 2), (0, 1, 0, depth / 2), (0, -1, 0, depth / 2)]
    planes = [*sides, (0, 0, 1, height), (0, 0, -1, 0.0)]
    radius = 0.5 * float(np.sqrt(width**2 + depth**2 + height**2))
    return _solid((0, 0, 0, 0, -1.0), planes, radius, (0, 0, height / 2))


def cut(solid: Solid, normal: tuple[float, float, float], offset: float) -> Solid:
    """The solid's part with normal . p <= offset, in its own frame; `normal` of unit length."""
    plane = np.array([[*normal, offset]], np.float32)
    return dataclasses.replace(solid, planes=np.concatenate([solid.planes, plane]))


def place(solid: Solid, centre, axes=None) -> Solid:
    """The solid moved: its parent frame is turned by `axes` (3, 3) and then shifted by `centre` (3,)."""
    turn = np.eye(3, dtype=np.float32) if axes is None else np.asarray(axes, np.float32)
    shift = np.asarray(centre, np.float32)
    bound = np.concatenate([turn @ solid.bound[:3] + shift, solid.bound[3:]])
    return dataclasses.replace(solid, axes=turn @ solid.axes, centre=turn @ solid.centre + shift, bound=bound)


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """Rotation about z by `yaw` after y by `pitch` after x by `roll`, radians."""
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return (about_z @ about_y @ about_x).astype(np.float32)


def contains(solid: Solid, points: Float[np.ndarray, "3 n"], *, margin: float = 0.0) -> Bool[np.ndarray, " n"]:
    """Which points lie in the solid, or (to first order) within `margin` of it."""
    return _nearest_surface(solid, points)[0] <= margin


def interval(
    solid: Solid, origin: Float[np.ndarray, "3 _"], direction: Float[np.ndarray, "3 n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Ray parameters between which origin + t direction lies in the solid; enter >= leave where it misses."""
    d = solid.axes.T @ direction
    o = solid.axes.T @ (origin - solid.centre[:, None])
    # Start where the ray passes the solid's origin, so that the quadratic's terms are of the solid's own size.
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
    """Ray parameter of the first surface in front of an origin outside of `solid` (less `hollow`); inf where missed."""
    enter, leave = interval(solid, origin, direction)
    hit = (enter < leave) & (enter > 0)
    if hollow is not None:
        inner_enter, inner_leave = interval(hollow, origin, direction)
        open_here = (inner_enter <= enter) & (enter < inner_leave)
        hit &= ~open_here | (inner_leave < leave)
        enter = np.where(open_here, inner_leave, enter)
    return np.where(hit, enter, np.float32(np.inf))


def blocks(
    solid: Solid, hollow: Solid | None, origin: Float[np.ndarray, "3 _"], direction: Float[np.ndarray, "3 n"]
) -> Bool[np.ndarray, " n"]:
    """Whether the solid (less its hollow) meets the segment from origin to origin + direction."""
    enter, leave = interval(solid, origin, direction)
    enter, leave = np.maximum(enter, 0), np.minimum(leave, 1)
    blocked = enter < leave
    if hollow is not None and blocked.any():
        inner_enter, inner_leave = interval(hollow, origin, direction)
        blocked &= ~((inner_enter <= enter) & (inner_leave >= leave))
    return blocked


def _nearest_surface(solid, points):
    """Signed distance to the nearest of the solid's surfaces (to first order) and that surface's outward normal."""
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
    """Unit normals, out of the material, at points on the surface of `solid` less `hollow`."""
    distance, normal = _nearest_surface(solid, points)
    if hollow is None:
        return normal
    inner_distance, inner_normal = _nearest_surface(hollow, points)
    return np.where(np.abs(inner_distance) < np.abs(distance), -inner_normal, normal)
