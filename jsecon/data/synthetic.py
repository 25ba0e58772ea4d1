"""The demo room as a capture, in memory or on disk as an ordinary COLMAP folder with instance masks and LERF labels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Int16

from jsecon.data.raycast import render_views
from jsecon.data.room import Room, make_room
from jsecon.errors import require
from jsecon.types import Camera, Capture


def room_cameras(room: Room, *, views: int = 30, width: int = 320, height: int = 240) -> Camera:
    """`views` cameras on a walk once around the table, at changing height, looking at it; field of view 60 degrees across."""
    draw = np.random.default_rng([room.seed, 5])
    turn = 2 * np.pi * (np.arange(views) / views) + draw.uniform(0, 2 * np.pi) + draw.normal(0, 0.03, views)
    wave = np.sin(3 * turn + draw.uniform(0, 2 * np.pi))
    radius = 1.5 + 0.1 * np.sin(2 * turn + draw.uniform(0, 2 * np.pi)) + draw.normal(0, 0.02, views)
    centres = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0.78 + 0.3 * wave + draw.normal(0, 0.02, views)], -1)
    targets = np.array([0, 0, 0.03]) + draw.normal(0, 0.03, (views, 3))
    focal = 0.5 * width / np.tan(np.radians(30))
    poses = np.stack([_look_at(centre, target) for centre, target in zip(centres, targets)])
    full = lambda value: np.full(views, value, np.float32)
    return Camera(poses, full(focal), full(focal), full(width / 2), full(height / 2), width, height)


def _look_at(centre, target):
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ centre
    return pose.astype(np.float32)


def room_capture(seed: int, *, views: int = 30, width: int = 320, height: int = 240, holdout: int = 5,
                 points: int = 6000, num_objects: int = 12, progress: Callable[[int, int], None] | None = None,
                 ) -> tuple[Capture, Int16[np.ndarray, "t h w"], tuple[str, ...]]:
    """The room of `seed` as a capture, its instances (index into the names, -1 = background) and the objects' names.

    Every `holdout`-th frame from the first on is held out; the sparse points come from the others alone.
    """
    require(views >= 2, "views", got=views, expected="at least 2", remedy="Sparse points are those that two views see.")
    room = make_room(seed, num_objects=num_objects)
    cameras = room_cameras(room, views=views, width=width, height=height)
    frames, instances, depths = render_views(room, cameras, progress=progress)
    held_out = np.arange(views) % holdout == 0
    cloud, colours = _sparse_points(np.random.default_rng([seed, 7]), frames, depths, cameras, held_out, points)
    names = tuple(f"frame_{view + 1:05d}" for view in range(views))
    capture = Capture(frames, cameras, cloud, colours, held_out, None, np.eye(4, dtype=np.float32), names)
    return capture, instances, room.names


def _sparse_points(draw, frames, depths, cameras, held_out, count):
    """Points as structure from motion would leave them: on corners and texture first, in at least two of the views that
    are not held out, off by the 0.4 px of a matched feature."""
    kept = np.flatnonzero(~held_out)
    _, height, width, _ = frames.shape
    focal, middle = float(cameras.fx[0]), (float(cameras.cx[0]), float(cameras.cy[0]))
    clouds, colours = [], []
    for view in kept:
        grey = frames[view].astype(np.float32).mean(-1)
        down, across = np.gradient(grey)
        weight = np.hypot(down, across).ravel()
        weight = weight + weight.mean() + 1e-3
        share = min(2 * count // len(kept) + 1, weight.size)
        pixels = draw.choice(weight.size, share, replace=False, p=weight / weight.sum())
        z = depths[view].ravel()[pixels]
        local = np.stack([(pixels % width + 0.5 - middle[0]) / focal * z, (pixels // width + 0.5 - middle[1]) / focal * z, z], -1)
        pose = cameras.world_to_camera[view]
        world = (local - pose[:3, 3]) @ pose[:3, :3]
        seen = sum(_sees(cameras.world_to_camera[other], depths[other], focal, middle, world) for other in kept)
        world = world + draw.normal(0, 0.4, world.shape) * (z / focal)[:, None]
        clouds.append(world[seen >= 2])
        colours.append(frames[view].reshape(-1, 3)[pixels][seen >= 2])
    cloud, colour = np.concatenate(clouds).astype(np.float32), np.concatenate(colours)
    chosen = draw.permutation(len(cloud))[:count]
    return cloud[chosen], colour[chosen]


def _sees(pose, depth, focal, middle, world):
    """Whether the view sees each point: inside of the picture, and at the depth of its pixel's surface."""
    height, width = depth.shape
    local = world @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    x = np.floor(local[:, 0] / z * focal + middle[0]).astype(np.int64)
    y = np.floor(local[:, 1] / z * focal + middle[1]).astype(np.int64)
    inside = (local[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    surface = depth[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return inside & (np.abs(surface - local[:, 2]) < 0.02 * z)
