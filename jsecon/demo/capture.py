"""The demo room as a capture, in memory or on disk as an ordinary COLMAP folder with instance masks and LERF labels."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Int16, UInt

from jsecon.data.colmap import write_colmap
from jsecon.data.frames import check_options, held_out
from jsecon.data.lerf_labels import LabelledFrame, write_lerf_labels
from jsecon.demo.crowd import crowded_room
from jsecon.demo.raycast import render_views
from jsecon.demo.room import Room, make_room
from jsecon.errors import require
from jsecon.files import atomic_write, write_text
from jsecon.types import Camera, Capture

LABEL_PIXELS = 40
"""visible ones from which `write_room` labels an object in a frame"""


def room_cameras(room: Room, *, views: int = 30, width: int = 320, height: int = 240) -> Camera:
    """`views` cameras on a walk once around the table, at changing height, looking at it; 60 degrees across."""
    draw = np.random.default_rng([room.seed, 5])
    turn = 2 * np.pi * (np.arange(views) / views) + draw.uniform(0, 2 * np.pi) + draw.normal(0, 0.03, views)
    wave = np.sin(3 * turn + draw.uniform(0, 2 * np.pi))
    radius = 1.5 + 0.1 * np.sin(2 * turn + draw.uniform(0, 2 * np.pi)) + draw.normal(0, 0.02, views)
    height_m = 0.78 + 0.3 * wave + draw.normal(0, 0.02, views)
    centres = np.stack([radius * np.cos(turn), radius * np.sin(turn), height_m], -1)
    targets = np.array([0, 0, 0.03]) + draw.normal(0, 0.03, (views, 3))
    focal = 0.5 * width / np.tan(np.radians(30))
    poses = np.stack([look_at(centre, target) for centre, target in zip(centres, targets)])
    focal_px, cx, cy = (np.full(views, value, np.float32) for value in (focal, width / 2, height / 2))
    return Camera(poses, focal_px, focal_px, cx, cy, width, height)


def look_at(centre, target, up=(0, 0, 1)):
    """(4, 4) float32 world-to-camera of a camera at `centre` that looks at `target`, upright."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ centre
    return pose.astype(np.float32)


def room_capture(
    seed: int,
    *,
    views: int = 30,
    width: int = 320,
    height: int = 240,
    holdout: int = 5,
    points: int = 6000,
    num_objects: int = 12,
    crowded: bool | int = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Capture, Int16[np.ndarray, "t h w"], tuple[str, ...]]:
    """The room of `seed` as a capture, its instances (index into the names, -1 = background) and the objects' names.

    `crowded`: that of `crowded_room`, in which a name may be there twice, or "", instead of `num_objects`.
    Every `holdout`-th frame from the first on is held out (0: none); the sparse points come from the others alone.
    Raises InputError or ValueError on options that leave fewer than two frames.
    """
    check_options(None, views, holdout)
    out = held_out(views, holdout)
    got, remedy = f"{views} with every {holdout}. held out", "Sparse points are those that two views see: take more."
    require(int((~out).sum()) >= 2, "views", got, "2 that are not held out", remedy)
    room = crowded_room(seed) if crowded else make_room(seed, num_objects=num_objects)
    cameras = room_cameras(room, views=views, width=width, height=height)
    names = tuple(f"frame_{view + 1:05d}" for view in range(views))
    capture, instances = captured(room, cameras, names, out, points=points, progress=progress)
    return dataclasses.replace(capture, depths=None), instances, room.names


def captured(
    room: Room,
    cameras: Camera,
    names: tuple[str, ...],
    out: Bool[np.ndarray, " t"],
    *,
    points: int,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Capture, Int16[np.ndarray, "t h w"]]:
    """A room seen by `cameras` as a capture with depth, frames `out` held out, and its instances (-1 = background)."""
    frames, instances, depths = render_views(room, cameras, progress=progress)
    cloud, colours = _sparse_points(np.random.default_rng([room.seed, 7]), frames, depths, cameras, out, points)
    return Capture(frames, cameras, cloud, colours, out, depths, np.eye(4, dtype=np.float32), names), instances


def _sparse_points(draw, frames, depths, cameras, out, count):
    """Points as structure from motion would leave them: on corners and texture first, in at least two of the views that
    are not held out, off by the 0.4 px of a matched feature."""
    kept = np.flatnonzero(~out)
    width = frames.shape[2]
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
        x, y = (pixels % width + 0.5 - middle[0]) / focal, (pixels // width + 0.5 - middle[1]) / focal
        local = np.stack([x * z, y * z, z], -1)
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


def write_room(
    folder: str | Path,
    seed: int,
    *,
    holdout: int = 5,
    progress: Callable[[int, int], None] | None = None,
    **options: int,
) -> Path:
    """Writes the room of `seed` to `folder` as a COLMAP capture (images/, sparse/0/), and its ground truth beside it.

    `options` as for `room_capture`. masks/<frame>.png: 8-bit integers, 0 = none, else the object's id from 1.
    label/<frame>.json: LangSplat's layout of LERF labels, for the held-out frames, of the objects with at least
    LABEL_PIXELS visible pixels there. scene.json, written last: seed, options, objects by id. Returns the folder;
    raises InputError where it cannot be written.
    """
    folder = Path(folder)
    _clear(folder)
    capture, instances, names = room_capture(seed, holdout=holdout, progress=progress, **options)
    write_colmap(capture, folder)
    for name, instance in zip(capture.names, instances):
        write_ids(folder / "masks" / f"{name}.png", (instance + 1).astype(np.uint8))
    held = np.flatnonzero(capture.held_out)
    labels = [labelled(capture.names[t], instances[t], names, LABEL_PIXELS) for t in held]
    write_lerf_labels(folder / "label", labels)
    scene = {
        "seed": seed,
        "views": len(capture.names),
        "width": capture.cameras.width,
        "height": capture.cameras.height,
        "holdout": holdout,
        "points": len(capture.points),
        "held_out": [capture.names[t] for t in held],
        "objects": {str(k + 1): name for k, name in enumerate(names)},
    }
    write_text(folder / "scene.json", json.dumps(scene, indent=2) + "\n")
    return folder


def _clear(folder):
    """Removes what an earlier room in `folder` may have more of than this one; its other files are written over."""
    if (folder / "scene.json").is_file():
        for pattern in ("scene.json", "label/frame_*.json", "masks/frame_*.png", "images/frame_*.png"):
            for file in list(folder.glob(pattern)):
                file.unlink()


def labelled(frame, instance, names, label_pixels):
    """The label of a frame: masks and boxes by name, those of a name together; without a name, none."""
    objects = {}
    for name in dict.fromkeys(filter(None, names)):
        each = [mask for mask in (instance == k for k, own in enumerate(names) if own == name) if mask.any()]
        if sum(mask.sum() for mask in each) >= label_pixels:
            objects[name] = np.any(each, axis=0), np.concatenate([_box(mask) for mask in each])
    return LabelledFrame(frame, instance.shape[1], instance.shape[0], objects)


def _box(mask):
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([[columns[0], rows[0], columns[-1], rows[-1]]], np.float32)


def write_ids(path: Path, ids: UInt[np.ndarray, "h w"]) -> None:
    """Writes a label image as a grey PNG, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", ids)[1].tobytes())
