"""The demo room's textures, and its large flat surfaces painted and lit once, so that they look alike in every view."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from jsecon.demo.light import LAMP, LIFT, SKY, contact, direct, lamp_points, lamp_visibility
from jsecon.demo.room import TABLE_HALF, TABLE_HEIGHT, TABLE_WOOD, Room, Texture, linear


@dataclasses.dataclass(frozen=True)
class _Plane:
    """A flat surface baked into a picture: radiance[v, u] at origin + u texel first + v texel second."""

    origin: np.ndarray
    first: np.ndarray
    second: np.ndarray
    texel: float
    radiance: np.ndarray

    def look_up(self, points):
        height, width = self.radiance.shape[:2]
        u = np.clip(((self.first @ points) - self.first @ self.origin) / self.texel, 0, width - 1).astype(np.int32)
        v = np.clip(((self.second @ points) - self.second @ self.origin) / self.texel, 0, height - 1).astype(np.int32)
        return self.radiance.reshape(-1, 3)[v * width + u]


@dataclasses.dataclass(frozen=True)
class BakedRoom:
    """A room made ready for rendering: its flat surfaces with their light."""

    room: Room
    walls: tuple[_Plane, ...]
    """x-, x+, y-, y+, floor, ceiling."""
    table: _Plane


def pattern(texture: Texture, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """The texture's s in [-1, 1] at points in its object's frame, (3, n) m."""
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


def bake(room: Room) -> BakedRoom:
    """Paints and lights the room's flat surfaces: noise, tiles, panels and wood in colours that no object has."""
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
    walls = [_wall(room, draw, tall, *side) for side in sides]
    ground = _flat(room, draw, np.array([-x, -y, floor], np.float32), 2 * x, 2 * y, up, 0.006, 0.05, _tiles)
    above = _flat(room, draw, np.array([-x, -y, ceiling], np.float32), 2 * x, 2 * y, -up, 0.02, None, _plaster)
    tx, ty = TABLE_HALF
    top = _cloth if room.cloth else _planks
    table = _flat(room, draw, np.array([-tx, -ty, 0], np.float32), 2 * tx, 2 * ty, up, 0.0025, 0.005, top)
    return BakedRoom(room, (*walls, ground, above), table)


def _grid(origin, first, second, width, height, texel):
    u, v = (np.arange(max(round(span / texel), 1), dtype=np.float32) for span in (width, height))
    u, v = np.meshgrid((u + 0.5) * texel, (v + 0.5) * texel)
    points = origin[:, None] + first[:, None] * u.ravel() + second[:, None] * v.ravel()
    return points.astype(np.float32), u, v


def _noise(draw, shape, cells):
    """Smooth random picture in [-1, 1]: bilinear between random values, three octaves from `cells` a side."""
    total = np.zeros(shape, np.float32)
    for octave in range(3):
        n = cells * 2**octave
        lattice = draw.uniform(-1, 1, (n + 2, n + 2)).astype(np.float32)
        total += _stretch(lattice, shape, n) * np.float32(0.5**octave)
    return total / np.float32(1.75)


def _stretch(picture, shape, cells=None):
    """Bilinear enlargement of a picture (h, w) to `shape`, corner to corner (or over its first `cells` cells)."""
    rows = np.linspace(0, (cells or picture.shape[0] - 1) - 1e-3, shape[0], dtype=np.float32)
    columns = np.linspace(0, (cells or picture.shape[1] - 1) - 1e-3, shape[1], dtype=np.float32)
    i, j = rows.astype(np.int32), columns.astype(np.int32)
    a, b = (rows - i)[:, None], (columns - j)[None]
    top = picture[i][:, j] * (1 - b) + picture[i][:, j + 1] * b
    return top * (1 - a) + picture[i + 1][:, j] * a * (1 - b) + picture[i + 1][:, j + 1] * a * b


def _tiles(draw, u, v):
    tone = 0.15 * ((np.floor(u / 0.35) + np.floor(v / 0.35)) % 2) + 0.1 * _noise(draw, u.shape, 40)
    joint = (np.minimum(u % 0.35, v % 0.35) < 0.012) * 0.12
    return linear((128, 126, 128)) * (0.95 + tone - joint)[..., None]


def _plaster(draw, u, v):
    return linear((172, 168, 162)) * (1 + 0.04 * _noise(draw, u.shape, 30))[..., None]


def _planks(draw, u, v):
    wood = Texture("wood", 0.07, 1.0, draw.uniform(-1, 1, 3).astype(np.float32))
    board = np.floor(v / 0.16)
    flat = np.stack([u + 0.37 * board, v + 0.11 * board, 0 * u]).astype(np.float32).reshape(3, -1)
    grain = pattern(wood, flat).reshape(u.shape)
    tone = 0.1 * grain + 0.05 * _noise(draw, u.shape, 24) + 0.05 * ((board * 7) % 3 - 1) - 0.2 * ((v % 0.16) < 0.004)
    return linear(TABLE_WOOD) * (1 + tone)[..., None]


def _cloth(draw, u, v):
    share = 0.5 * ((u % 0.11 < 0.055) * 1.0 + (v % 0.11 < 0.055)) - 0.25 * (np.minimum(u % 0.11, v % 0.11) < 0.008)
    mixed = linear((206, 198, 184)) * (1 - share[..., None]) + linear((104, 110, 124)) * share[..., None]
    return mixed * (1 + 0.05 * _noise(draw, u.shape, 40))[..., None]


def _flat(room, draw, origin, width, depth, normal, texel, shadow_texel, paint):
    right, back, _ = np.eye(3, dtype=np.float32)
    points, u, v = _grid(origin, right, back, width, depth, texel)
    turn = np.broadcast_to(normal[:, None], points.shape)
    light = np.full(u.shape, SKY * (1.0 if normal[2] > 0 else 1.05), np.float32)
    if shadow_texel is not None:
        coarse, cu, _ = _grid(origin, right, back, width, depth, shadow_texel)
        on_table = bool(abs(origin[2]) < 1e-6)
        lifted = coarse + LIFT * normal[:, None]
        seen = lamp_visibility(room, lifted, lamps=lamp_points(room), skip_furniture=on_table).reshape(cu.shape)
        if on_table:
            upward = np.broadcast_to(normal[:, None], coarse.shape)
            light *= _stretch(contact(room, coarse, upward).reshape(cu.shape), u.shape)
        else:
            light *= _under_table(points).reshape(u.shape)
        light += LAMP * direct(room, points, turn).reshape(u.shape) * _stretch(seen, u.shape)
    return _Plane(origin, right, back, texel, (paint(draw, u, v) * light[..., None]).astype(np.float32))


def _under_table(points):
    """The share of the sky that the floor sees beside and below the table."""
    beyond = np.maximum(np.abs(points[:2]) - np.array(TABLE_HALF, np.float32)[:, None], -0.3)
    return np.clip(0.75 + 0.4 * beyond.max(0), 0.6, 1)


def _wall(room, draw, tall, corner, first, span, normal):
    origin, up = np.array(corner, np.float32), np.array([0, 0, 1], np.float32)
    points, u, v = _grid(origin, first, up, span, tall, 0.008)
    tone = 0.05 * _noise(draw, u.shape, 36) + 0.035 * np.sign(np.sin(2 * np.pi * u / 0.24))
    low = v < 0.95
    tone -= 0.28 * low + 0.15 * ((v > 0.95) & (v < 0.99)) + 0.2 * (v < 0.1)
    tone = np.where(low & (u % 0.5 < 0.012), tone - 0.12, tone)
    paint = linear((178, 169, 153)) * (1 + tone)[..., None]
    blot = np.sign(_noise(draw, u.shape, 20))[..., None]
    for k in range(3):
        _hang_picture(draw, paint, blot, u, v, span * (k + 0.5) / 3 + draw.uniform(-0.15, 0.15))
    turn = np.broadcast_to(normal[:, None], points.shape)
    light = SKY * (0.82 + 0.18 * np.clip(v / 0.5, 0, 1)) + 0.6 * LAMP * direct(room, points, turn).reshape(u.shape)
    return _Plane(origin, first, up, 0.008, (paint * light[..., None]).astype(np.float32))


def _hang_picture(draw, paint, blot, u, v, middle):
    """A framed picture in greys, for walls that a camera can be located by."""
    half_w, half_h, height = draw.uniform(0.2, 0.3), draw.uniform(0.18, 0.26), draw.uniform(1.42, 1.55)
    inside = np.maximum(np.abs(u - middle) - half_w, np.abs(v - height) - half_h)
    paint[inside < 0.03] = linear((98, 94, 90))
    paint[inside < 0] = (linear((150, 150, 152)) * (1 + 0.25 * blot))[inside < 0]
