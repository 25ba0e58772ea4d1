"""Ray tracing of the made-up room in NumPy: colour, instance and depth images that serve as ground truth.

Depth and instance are those of the ray through the pixel's centre, exact to float32. Colour averages 2 x 2 rays.
A square lamp casts soft shadows by rays to points on it. A sky is brighter from above and darker where surfaces touch.
Walls, floor and table top are painted and lit once, so that their shadows are the same in every view.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Float32, Int16, UInt8

from experiments.rooms.room import TABLE_HALF, TABLE_HEIGHT, TABLE_WOOD, Part, Room, Texture, srgb_to_linear
from experiments.rooms.shapes import blocks_segment, first_hit, normals
from jsecon.types import Camera, Progress

SKY_RADIANCE, LAMP_RADIANCE = 0.84, 0.48
"""Radiance of a white surface under the whole sky, and facing the lamp. Their sum keeps the lightness of a colour."""
SHADOW_OFFSET_M = np.float32(1e-3)
"""Distance from a surface at which its shadow rays start, m."""


def lamp_visibility(
    room: Room, points: Float[np.ndarray, "3 n"], *, lamps: Float[np.ndarray, "3 m"], skip_furniture: bool = False
) -> Float[np.ndarray, " n"]:
    """Share of the lamp that each point sees.

    Args:
      room: The room.
      points: (3, N) world, m.
      lamps: (3, M) points of the lamp, world.
      skip_furniture: Leave out the shadows of the table.

    Returns:
      (N,) shares, 0 to 1.
    """
    if not points.shape[1]:
        return np.ones(0, np.float32)
    count = lamps.shape[1]
    blocked = np.zeros((count, points.shape[1]), bool)
    for part in _shading_parts(room, points, skip_furniture):
        near = np.flatnonzero(_may_shade(room, part.solid.bound, points))
        if len(near):
            origin = np.tile(points[:, near], count)
            target = np.repeat(lamps, len(near), 1)
            blocked[:, near] |= blocks_segment(part.solid, part.hollow, origin, target - origin).reshape(count, -1)
    return 1 - blocked.mean(0, dtype=np.float32)


def _shading_parts(room: Room, points: np.ndarray, skip_furniture: bool) -> Iterator[Part]:
    """Parts near the cone from the lamp to a sphere around the points; others cannot shade any of them."""
    middle = 0.5 * (points.min(1) + points.max(1))
    spread = np.sqrt(((points - middle[:, None]) ** 2).sum(0).max())
    for part in room.parts:
        if part.owner < 0 and skip_furniture:
            continue
        wider = part.solid.bound + np.array([0, 0, 0, spread], np.float32)
        if _may_shade(room, wider, middle[:, None])[0]:
            yield part


def _may_shade(room, bound, points):
    """Whether a bounding sphere may reach into the cone from each point to the lamp. It can err towards True only."""
    to_lamp, to_bound = room.light[:, None] - points, bound[:3, None] - points
    length2 = (to_lamp * to_lamp).sum(0)
    along = np.clip((to_lamp * to_bound).sum(0) / length2, 0, 1)
    off = to_bound - along * to_lamp
    # The cone is widest, within the sphere, at the sphere's far side.
    far = np.minimum(along + 1.5 * bound[3] / np.sqrt(length2), 1)
    reach = bound[3] + far * np.float32(room.light_half * np.sqrt(2))
    return (off * off).sum(0) < reach * reach


def _lamp_cosine(
    room: Room, points: Float[np.ndarray, "3 n"], normal: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, " n"]:
    """Cosine between the normal and the direction of the lamp's middle, 0 where the surface faces away."""
    to_lamp = room.light[:, None] - points
    return np.maximum((normal * to_lamp).sum(0) / np.sqrt((to_lamp * to_lamp).sum(0)), 0)


def _sky_visibility(
    room: Room, points: Float[np.ndarray, "3 n"], normal: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, " n"]:
    """Share of the sky that a point sees past the objects, each part of which counts as a sphere within its bound."""
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


@dataclasses.dataclass(frozen=True)
class _Plane:
    """A flat surface with its light as an image: radiance[v, u] at origin + u texel first + v texel second."""

    origin: np.ndarray
    first: np.ndarray
    second: np.ndarray
    texel: float
    radiance: np.ndarray

    def look_up(self, points):
        """Radiance (n, 3) at points (3, n) of the surface."""
        height, width = self.radiance.shape[:2]
        u = np.clip(((self.first @ points) - self.first @ self.origin) / self.texel, 0, width - 1).astype(np.int32)
        v = np.clip(((self.second @ points) - self.second @ self.origin) / self.texel, 0, height - 1).astype(np.int32)
        return self.radiance.reshape(-1, 3)[v * width + u]


@dataclasses.dataclass(frozen=True)
class LitRoom:
    """A room and its flat surfaces with their light."""

    room: Room
    walls: tuple[_Plane, ...]
    """-x, +x, -y, +y, floor, ceiling."""
    table: _Plane


def texture_pattern(texture: Texture, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """Evaluates a texture.

    Args:
      texture: The texture.
      points: (3, N) in the frame of its object, m.

    Returns:
      (N,) float32 in [-1, 1]; 0 for "plain".
    """
    p = (points + texture.phase[:, None]) / np.float32(texture.scale)
    if texture.kind == "checks":
        return (2 * (np.floor(p).sum(0) % 2) - 1).astype(np.float32)
    if texture.kind == "stripes":
        return np.clip(3 * np.sin(2 * np.pi * (p[2] + 0.35 * p[0])), -1, 1).astype(np.float32)
    if texture.kind == "marble":
        fold = np.sin(2.1 * p[0] + 1.3 * p[1]) + np.sin(2.7 * p[2] - 1.1 * p[0]) + np.sin(1.7 * p[1] + 2.3 * p[2])
        return np.sin(1.4 * fold + 1.2 * p.sum(0)).astype(np.float32)
    if texture.kind == "wood":
        bend = 0.25 * np.sin(0.9 * p[0]) + 0.08 * np.sin(3.1 * p[0] + 2.0 * np.sin(1.3 * p[1]))
        grain = np.sin(2 * np.pi * (p[1] + bend)) * 0.6 + 0.4 * np.sin(2 * np.pi * (4.3 * p[1] + 2 * bend + 0.1 * p[0]))
        return grain.astype(np.float32)
    return np.zeros(points.shape[1], np.float32)


def bake_room(room: Room, *, coarser: int = 1) -> LitRoom:
    """Paints and lights the flat surfaces of a room, in colours that no object has.

    Args:
      room: The room.
      coarser: Factor on the texels of their paint and shadows.

    Returns:
      The room with its walls, floor, ceiling and table top.
    """
    x, y = (float(v) for v in room.half)
    floor, ceiling = -TABLE_HEIGHT, room.ceiling
    right, back, up = np.eye(3, dtype=np.float32)
    draw = np.random.default_rng([room.seed, 3])
    tall = ceiling - floor
    sides = [
        ((-x, -y, floor), back, 2 * y, right),
        ((x, -y, floor), back, 2 * y, -right),
        ((-x, -y, floor), right, 2 * x, back),
        ((-x, y, floor), right, 2 * x, -back),
    ]
    walls = [_wall(room, draw, tall, *side, 0.008 * coarser) for side in sides]
    ground = _flat(
        room, draw, np.array([-x, -y, floor], np.float32), 2 * x, 2 * y, up, 0.006 * coarser, 0.05 * coarser, _tiles
    )
    above = _flat(
        room, draw, np.array([-x, -y, ceiling], np.float32), 2 * x, 2 * y, -up, 0.02 * coarser, None, _plaster
    )
    tx, ty = TABLE_HALF
    top = _cloth if room.cloth else _planks
    table = _flat(
        room, draw, np.array([-tx, -ty, 0], np.float32), 2 * tx, 2 * ty, up, 0.0025 * coarser, 0.005 * coarser, top
    )
    return LitRoom(room, (*walls, ground, above), table)


def _grid(origin, first, second, width, height, texel):
    u, v = (np.arange(max(round(span / texel), 1), dtype=np.float32) for span in (width, height))
    u, v = np.meshgrid((u + 0.5) * texel, (v + 0.5) * texel)
    points = origin[:, None] + first[:, None] * u.ravel() + second[:, None] * v.ravel()
    return points.astype(np.float32), u, v


def _noise(draw, shape, cells):
    """Smooth noise in [-1, 1]: three octaves of bilinear value noise, the first with `cells` cells a side."""
    total = np.zeros(shape, np.float32)
    for octave in range(3):
        n = cells * 2**octave
        lattice = draw.uniform(-1, 1, (n + 2, n + 2)).astype(np.float32)
        total += _stretch(lattice, shape, n) * np.float32(0.5**octave)
    return total / np.float32(1.75)


def _stretch(picture, shape, cells=None):
    """Bilinear enlargement of an image (h, w) to `shape`, corner to corner or over its first `cells` cells."""
    rows = np.linspace(0, (cells or picture.shape[0] - 1) - 1e-3, shape[0], dtype=np.float32)
    columns = np.linspace(0, (cells or picture.shape[1] - 1) - 1e-3, shape[1], dtype=np.float32)
    i, j = rows.astype(np.int32), columns.astype(np.int32)
    a, b = (rows - i)[:, None], (columns - j)[None]
    top = picture[i][:, j] * (1 - b) + picture[i][:, j + 1] * b
    return top * (1 - a) + picture[i + 1][:, j] * a * (1 - b) + picture[i + 1][:, j + 1] * a * b


def _tiles(draw, u, v):
    tone = 0.15 * ((np.floor(u / 0.35) + np.floor(v / 0.35)) % 2) + 0.1 * _noise(draw, u.shape, 40)
    joint = (np.minimum(u % 0.35, v % 0.35) < 0.012) * 0.12
    return srgb_to_linear((128, 126, 128)) * (0.95 + tone - joint)[..., None]


def _plaster(draw, u, v):
    return srgb_to_linear((172, 168, 162)) * (1 + 0.04 * _noise(draw, u.shape, 30))[..., None]


def _planks(draw, u, v):
    wood = Texture("wood", 0.07, 1.0, draw.uniform(-1, 1, 3).astype(np.float32))
    board = np.floor(v / 0.16)
    flat = np.stack([u + 0.37 * board, v + 0.11 * board, 0 * u]).astype(np.float32).reshape(3, -1)
    grain = texture_pattern(wood, flat).reshape(u.shape)
    tone = 0.1 * grain + 0.05 * _noise(draw, u.shape, 24) + 0.05 * ((board * 7) % 3 - 1) - 0.2 * ((v % 0.16) < 0.004)
    return srgb_to_linear(TABLE_WOOD) * (1 + tone)[..., None]


def _cloth(draw, u, v):
    share = 0.5 * ((u % 0.11 < 0.055) * 1.0 + (v % 0.11 < 0.055)) - 0.25 * (np.minimum(u % 0.11, v % 0.11) < 0.008)
    mixed = (
        srgb_to_linear((206, 198, 184)) * (1 - share[..., None]) + srgb_to_linear((104, 110, 124)) * share[..., None]
    )
    return mixed * (1 + 0.05 * _noise(draw, u.shape, 40))[..., None]


def _flat(room, draw, origin, width, depth, normal, texel, shadow_texel, paint):
    right, back, _ = np.eye(3, dtype=np.float32)
    points, u, v = _grid(origin, right, back, width, depth, texel)
    turn = np.broadcast_to(normal[:, None], points.shape)
    light = np.full(u.shape, SKY_RADIANCE * (1.0 if normal[2] > 0 else 1.05), np.float32)
    if shadow_texel is not None:
        coarse, cu, _ = _grid(origin, right, back, width, depth, shadow_texel)
        on_table = bool(abs(origin[2]) < 1e-6)
        lifted = coarse + SHADOW_OFFSET_M * normal[:, None]
        seen = lamp_visibility(room, lifted, lamps=room.lamp_points, skip_furniture=on_table).reshape(cu.shape)
        if on_table:
            upward = np.broadcast_to(normal[:, None], coarse.shape)
            light *= _stretch(_sky_visibility(room, coarse, upward).reshape(cu.shape), u.shape)
        else:
            light *= _under_table(points).reshape(u.shape)
        light += LAMP_RADIANCE * _lamp_cosine(room, points, turn).reshape(u.shape) * _stretch(seen, u.shape)
    return _Plane(origin, right, back, texel, (paint(draw, u, v) * light[..., None]).astype(np.float32))


def _under_table(points):
    """Share of the sky that points of the floor see beside and below the table."""
    beyond = np.maximum(np.abs(points[:2]) - np.array(TABLE_HALF, np.float32)[:, None], -0.3)
    return np.clip(0.75 + 0.4 * beyond.max(0), 0.6, 1)


def _wall(room, draw, tall, corner, first, span, normal, texel):
    origin, up = np.array(corner, np.float32), np.array([0, 0, 1], np.float32)
    points, u, v = _grid(origin, first, up, span, tall, texel)
    tone = 0.05 * _noise(draw, u.shape, 36) + 0.035 * np.sign(np.sin(2 * np.pi * u / 0.24))
    low = v < 0.95
    tone -= 0.28 * low + 0.15 * ((v > 0.95) & (v < 0.99)) + 0.2 * (v < 0.1)
    tone = np.where(low & (u % 0.5 < 0.012), tone - 0.12, tone)
    paint = srgb_to_linear((178, 169, 153)) * (1 + tone)[..., None]
    blot = np.sign(_noise(draw, u.shape, 20))[..., None]
    for k in range(3):
        _hang_picture(draw, paint, blot, u, v, span * (k + 0.5) / 3 + draw.uniform(-0.15, 0.15))
    turn = np.broadcast_to(normal[:, None], points.shape)
    light = SKY_RADIANCE * (0.82 + 0.18 * np.clip(v / 0.5, 0, 1)) + 0.6 * LAMP_RADIANCE * _lamp_cosine(
        room, points, turn
    ).reshape(u.shape)
    return _Plane(origin, first, up, texel, (paint * light[..., None]).astype(np.float32))


def _hang_picture(draw, paint, blot, u, v, middle):
    """Paints a framed picture in greys, which gives cameras features on the wall."""
    half_w, half_h, height = draw.uniform(0.2, 0.3), draw.uniform(0.18, 0.26), draw.uniform(1.42, 1.55)
    inside = np.maximum(np.abs(u - middle) - half_w, np.abs(v - height) - half_h)
    paint[inside < 0.03] = srgb_to_linear((98, 94, 90))
    paint[inside < 0] = (srgb_to_linear((150, 150, 152)) * (1 + 0.25 * blot))[inside < 0]


_OFFSETS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""Offsets from the pixel's centre of the rays that are averaged to its colour, px."""


@dataclasses.dataclass(frozen=True)
class PanoramaCamera:
    """Pose of an equirectangular image: its middle looks along z, its rows and columns are equal steps of angles."""

    world_to_camera: np.ndarray
    width: int
    height: int


def _rays(camera, dx, dy):
    """World origin (3,) and directions (3, H * W). Their camera z is 1, so that ray parameters are z-depths.

    Directions of a panorama have length 1, and the parameters are distances.
    """
    pose = np.asarray(camera.world_to_camera, np.float32)
    if isinstance(camera, PanoramaCamera):
        longitude = 2 * np.pi * ((np.arange(camera.width) + 0.5 + dx) / camera.width - 0.5)
        latitude = np.pi * ((np.arange(camera.height) + 0.5 + dy) / camera.height - 0.5)[:, None]
        x, z = np.cos(latitude) * np.sin(longitude), np.cos(latitude) * np.cos(longitude)
        local = np.stack([x, np.broadcast_to(np.sin(latitude), x.shape), z]).reshape(3, -1).astype(np.float32)
        return -pose[:3, :3].T @ pose[:3, 3], pose[:3, :3].T @ local
    x = (np.arange(camera.width, dtype=np.float32) + np.float32(0.5 + dx) - float(camera.cx)) / float(camera.fx)
    y = (np.arange(camera.height, dtype=np.float32) + np.float32(0.5 + dy) - float(camera.cy)) / float(camera.fy)
    x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    local = np.stack([x.ravel(), y.ravel(), np.ones(x.size, np.float32)])
    return -pose[:3, :3].T @ pose[:3, 3], pose[:3, :3].T @ local


def _window(camera, bound):
    """Rows and columns of the pixels that may see a sphere: the box of its exact silhouette, one pixel wider."""
    pose = np.asarray(camera.world_to_camera, np.float64)
    x, y, z = pose[:3, :3] @ bound[:3] + pose[:3, 3]
    r = float(bound[3])
    if isinstance(camera, PanoramaCamera):
        distance, level = np.sqrt(x * x + y * y + z * z), np.hypot(x, z)
        half = np.arcsin(min(r / distance, 1.0))
        rows, columns = ((np.arctan2(y, level) + sign * half) / np.pi + 0.5 for sign in (-1, 1)), slice(None)
        if r < level:
            wide = np.arcsin(r / level) / (2 * np.pi)
            low, high = ((np.arctan2(x, z) / (2 * np.pi) + 0.5 + sign * wide) * camera.width for sign in (-1, 1))
            columns = slice(int(low) - 1, int(high) + 2) if low > 1 and high < camera.width - 1 else columns
        low, high = (row * camera.height for row in rows)
        return slice(max(int(low) - 1, 0), int(high) + 2), columns
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


def trace_rays(
    room: Room, camera: Camera | PanoramaCamera, *, dx: float = 0.0, dy: float = 0.0
) -> tuple[Float32[np.ndarray, "h w"], Int16[np.ndarray, "h w"]]:
    """Traces one ray through each pixel.

    Args:
      room: The room.
      camera: One camera inside the room and outside of every part.
      dx: Shift of the rays from the pixels' centres, px.
      dy: The same along the rows.

    Returns:
      z-depth (m) and index into `room.parts` (-1 = wall, floor or ceiling).
    """
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
        if owner < 0:
            colour[chosen] = _shade_furniture(room, baked.table, points[:, chosen], index[chosen])
        else:
            colour[chosen] = _shade_object(room, owner, points[:, chosen], index[chosen], lamps)
    return colour


def _shade_furniture(room, table, p, index):
    """Linear RGB (n, 3) of points of the table."""
    top = (index == 0) & (p[2] > -1e-3)
    side = room.furniture[0].albedo * np.where(index == 0, SKY_RADIANCE * 0.75, SKY_RADIANCE * 0.6)[:, None]
    colour = side.astype(np.float32)
    colour[top] = table.look_up(p[:, top])
    return colour


def _shade_object(room, owner, p, index, lamps):
    """Linear RGB (n, 3) of points of one object."""
    item = room.objects[owner]
    normal, albedo = np.empty_like(p), np.empty((p.shape[1], 3), np.float32)
    for k in np.unique(index):
        on = index == k
        normal[:, on] = normals(room.parts[k].solid, room.parts[k].hollow, p[:, on])
        albedo[on] = room.parts[k].albedo
    light = SKY_RADIANCE * (0.9 + 0.1 * normal[2]) * (0.8 + 0.2 * np.clip(p[2] / 0.06, 0, 1))
    from_lamp = LAMP_RADIANCE * _lamp_cosine(room, p, normal)
    facing = np.flatnonzero(from_lamp > 0)
    lifted = p[:, facing] + SHADOW_OFFSET_M * normal[:, facing]
    light[facing] += from_lamp[facing] * lamp_visibility(room, lifted, lamps=lamps, skip_furniture=True)
    tone = 1 + np.float32(item.texture.depth) * texture_pattern(item.texture, item.axes.T @ (p - item.centre[:, None]))
    return albedo * (tone * light)[:, None]


def _linear_to_srgb(rgb: Float[np.ndarray, "... 3"]) -> UInt8[np.ndarray, "... 3"]:
    """Converts linear RGB, clipped to 0..1, to 8-bit sRGB (IEC 61966-2-1)."""
    c = np.clip(rgb, 0, 1)
    return np.round(255 * np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)).astype(np.uint8)


def render_views(
    room: Room, cameras: Camera | Sequence[PanoramaCamera], *, coarser: int = 1, progress: Progress | None = None
) -> tuple[UInt8[np.ndarray, "t h w 3"], Int16[np.ndarray, "t h w"], Float32[np.ndarray, "t h w"]]:
    """Renders a room.

    Args:
      room: The room.
      cameras: T cameras inside the room (leading batch axis), or panoramas.
      coarser: Factor on the texels of walls, floor and table (`bake_room`).
      progress: Called with the number of finished views and T.

    Returns:
      Frames, instances (index of the object, -1 = background) and z-depths (m; distances in panoramas).
    """
    baked = bake_room(room, coarser=coarser)
    lamps = room.lamp_points
    owners = np.array([part.owner for part in room.parts] + [-1], np.int16)
    count = len(cameras)
    frames, instances, depths = [], [], []
    for view in range(count):
        camera = cameras[view]
        depth, index = trace_rays(room, camera)
        total = np.zeros((depth.size, 3), np.float32)
        for k, (dx, dy) in enumerate(_OFFSETS):
            t, hit = trace_rays(room, camera, dx=dx, dy=dy)
            origin, direction = _rays(camera, dx, dy)
            total += _shade(baked, origin[:, None] + t.ravel() * direction, hit.ravel(), lamps[:, k :: len(_OFFSETS)])
        frames.append(_linear_to_srgb(total / len(_OFFSETS)).reshape(*depth.shape, 3))
        instances.append(owners[index])
        depths.append(depth)
        if progress is not None:
            progress(view + 1, count)
    return np.stack(frames), np.stack(instances), np.stack(depths)
