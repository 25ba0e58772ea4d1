"""Pictures of the demo room by ray casting in NumPy: colour, instance and depth.

Depth and instance are those of the ray through the pixel's centre, exact to float32; colour averages 2 x 2 rays.
Light: a square lamp (soft shadows by rays to points on it) and a sky that is a little brighter from above and darkened
where things touch. The large flat surfaces are lit once, so their shadows are the same in every view by construction.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32, Int16, UInt8

from jsecon.demo.light import LAMP, LIFT, SKY, direct, lamp_points, lamp_visibility
from jsecon.demo.room import TABLE_HEIGHT, Room
from jsecon.demo.solids import first_hit, normals
from jsecon.demo.surfaces import bake, pattern
from jsecon.types import Camera

_OFFSETS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""the rays whose mean is a pixel's colour, px from its centre"""


def _rays(camera, dx, dy):
    """World origin (3,) and directions (3, H * W) with a camera z of 1, so that a ray's parameter is its z-depth."""
    pose = np.asarray(camera.world_to_camera, np.float32)
    x = (np.arange(camera.width, dtype=np.float32) + np.float32(0.5 + dx) - float(camera.cx)) / float(camera.fx)
    y = (np.arange(camera.height, dtype=np.float32) + np.float32(0.5 + dy) - float(camera.cy)) / float(camera.fy)
    x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    local = np.stack([x.ravel(), y.ravel(), np.ones(x.size, np.float32)])
    return -pose[:3, :3].T @ pose[:3, 3], pose[:3, :3].T @ local


def _window(camera, bound):
    """Rows and columns of the pixels that may see the sphere: its exact silhouette's box, one pixel wider."""
    pose = np.asarray(camera.world_to_camera, np.float64)
    x, y, z = pose[:3, :3] @ bound[:3] + pose[:3, 3]
    r = float(bound[3])
    if z + r <= 0:
        return slice(0, 0), slice(0, 0)
    if z <= 1.01 * r:
        return slice(0, camera.height), slice(0, camera.width)
    spans, c = [], camera
    for side, focal, middle, size in [(y, c.fy, c.cy, c.height), (x, c.fx, c.cx, c.width)]:
        swing = r * np.sqrt(side * side + z * z - r * r)
        low, high = ((side * z + sign * swing) / (z * z - r * r) * float(focal) + float(middle) for sign in (-1, 1))
        spans.append(slice(int(np.clip(np.floor(low) - 1, 0, size)), int(np.clip(np.ceil(high) + 1, 0, size))))
    return spans[0], spans[1]


def trace(
    room: Room, camera: Camera, *, dx: float = 0.0, dy: float = 0.0
) -> tuple[Float32[np.ndarray, "h w"], Int16[np.ndarray, "h w"]]:
    """z-depth (m) and index into `room.parts` (-1 = a wall, the floor or the ceiling) of the rays through the pixels'
    centres shifted by (dx, dy) px. The camera must stand in the room and outside of every part."""
    origin, direction = _rays(camera, dx, dy)
    shape = (camera.height, camera.width)
    corner = np.array([*room.half, room.ceiling], np.float32)[:, None]
    low = np.array([*-room.half, -TABLE_HEIGHT], np.float32)[:, None]
    with np.errstate(divide="ignore"):
        depth = (np.where(direction > 0, corner, low) - origin[:, None]) / direction
    depth = np.where(direction == 0, np.inf, depth).min(0).astype(np.float32).reshape(shape)
    index = np.full(shape, -1, np.int16)
    direction = direction.reshape(3, *shape)
    for k, part in enumerate(room.parts):
        rows, columns = _window(camera, part.solid.bound)
        rays = direction[:, rows, columns]
        if not rays.size:
            continue
        t = first_hit(part.solid, part.hollow, origin[:, None], rays.reshape(3, -1)).reshape(rays.shape[1:])
        nearer = t < depth[rows, columns]
        depth[rows, columns][nearer] = t[nearer]
        index[rows, columns][nearer] = k
    return depth, index


def _shade(baked, points, index, lamps):
    """Linear RGB (n, 3) of surface points (3, n)."""
    room = baked.room
    colour = np.empty((points.shape[1], 3), np.float32)
    background = np.flatnonzero(index < 0)
    p = points[:, background]
    (a, b), (x, y, z) = room.half, p
    gaps = np.stack([a + x, a - x, b + y, b - y, z + np.float32(TABLE_HEIGHT), np.float32(room.ceiling) - z])
    nearest = gaps.argmin(0)
    for side, plane in enumerate(baked.walls):
        on = nearest == side
        colour[background[on]] = plane.look_up(p[:, on])
    owners = np.array([part.owner for part in room.parts] + [-2], np.int16)[index]
    for owner in np.unique(owners[index >= 0]):
        chosen = np.flatnonzero(owners == owner)
        shade = _shade_furniture if owner < 0 else _shade_object
        colour[chosen] = shade(baked, int(owner), points[:, chosen], index[chosen], lamps)
    return colour


def _shade_furniture(baked, owner, p, index, lamps):
    del owner, lamps
    room = baked.room
    top = (index == 0) & (p[2] > -1e-3)
    side = room.furniture[0].albedo * np.where(index == 0, SKY * 0.75, SKY * 0.6)[:, None]
    colour = side.astype(np.float32)
    colour[top] = baked.table.look_up(p[:, top])
    return colour


def _shade_object(baked, owner, p, index, lamps):
    room, item = baked.room, baked.room.objects[owner]
    normal, albedo = np.empty_like(p), np.empty((p.shape[1], 3), np.float32)
    for k in np.unique(index):
        on = index == k
        normal[:, on] = normals(room.parts[k].solid, room.parts[k].hollow, p[:, on])
        albedo[on] = room.parts[k].albedo
    light = SKY * (0.9 + 0.1 * normal[2]) * (0.8 + 0.2 * np.clip(p[2] / 0.06, 0, 1))
    from_lamp = LAMP * direct(room, p, normal)
    facing = np.flatnonzero(from_lamp > 0)
    lifted = p[:, facing] + LIFT * normal[:, facing]
    light[facing] += from_lamp[facing] * lamp_visibility(room, lifted, lamps=lamps, skip_furniture=True)
    tone = 1 + np.float32(item.texture.depth) * pattern(item.texture, item.axes.T @ (p - item.centre[:, None]))
    return albedo * (tone * light)[:, None]


def srgb(rgb: Float[np.ndarray, "... 3"]) -> UInt8[np.ndarray, "... 3"]:
    """Linear RGB, clipped to 0..1, to 8-bit sRGB (IEC 61966-2-1)."""
    c = np.clip(rgb, 0, 1)
    return np.round(255 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)).astype(np.uint8)


def render_views(
    room: Room, cameras: Camera, *, progress: Callable[[int, int], None] | None = None
) -> tuple[UInt8[np.ndarray, "t h w 3"], Int16[np.ndarray, "t h w"], Float32[np.ndarray, "t h w"]]:
    """Frames, instances (index of the object, -1 = background) and z-depths (m) of a batch of cameras in the room."""
    baked = bake(room)
    lamps = lamp_points(room)
    owners = np.array([part.owner for part in room.parts] + [-1], np.int16)
    count = int(np.asarray(cameras.fx).shape[0])
    frames, instances, depths = [], [], []
    for view in range(count):
        camera = cameras[view]
        depth, index = trace(room, camera)
        total = np.zeros((depth.size, 3), np.float32)
        for k, (dx, dy) in enumerate(_OFFSETS):
            t, hit = trace(room, camera, dx=dx, dy=dy)
            origin, direction = _rays(camera, dx, dy)
            total += _shade(baked, origin[:, None] + t.ravel() * direction, hit.ravel(), lamps[:, k :: len(_OFFSETS)])
        frames.append(srgb(total / len(_OFFSETS)).reshape(*depth.shape, 3))
        instances.append(owners[index])
        depths.append(depth)
        if progress is not None:
            progress(view + 1, count)
    return np.stack(frames), np.stack(instances), np.stack(depths)
