"""Made-up rooms as captures: in memory, or as a COLMAP folder with instance masks and LERF labels."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int16

from experiments.rooms.raycast import render_views
from experiments.rooms.room import Room
from experiments.rooms.writers import write_colmap, write_lerf_labels
from jsecon.errors import require
from jsecon.files import write_text
from jsecon.read.captures.frames import FrameOptions
from jsecon.read.captures.images import write_image
from jsecon.read.masks.labels import LabelledFrame
from jsecon.types import Camera, Capture, Progress

MIN_LABEL_PIXELS = 40
"""Visible pixels from which `write_room` labels an object in a frame."""


def room_cameras(room: Room, *, views: int = 30, width: int = 320, height: int = 240) -> Camera:
    """Cameras on a walk around the table.

    Args:
      room: The room, whose seed also decides the walk.
      views: Number of cameras T.
      width: Width of the images, px.
      height: Height of the images, px.

    Returns:
      T cameras that look at the table from changing heights, 60 degrees across.
    """
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
    """Makes the pose of an upright camera.

    Args:
      centre: (3,) its place, world.
      target: (3,) the point in the middle of its image.
      up: (3,) direction that is up in the image.

    Returns:
      (4, 4) float32 world-to-camera matrix.
    """
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ centre
    return pose.astype(np.float32)


def room_capture(
    room: Room,
    *,
    views: int = 30,
    width: int = 320,
    height: int = 240,
    holdout: int = 5,
    points: int = 6000,
    progress: Progress | None = None,
) -> tuple[Capture, Int16[np.ndarray, "t h w"]]:
    """Makes the capture of a room from cameras around its table.

    Args:
      room: The room.
      views: Number of frames T.
      width: Width of the frames, px.
      height: Height of the frames, px.
      holdout: Every `holdout`-th frame from the first on is held out; 0 holds out no frame.
      points: Number of sparse points. They come from frames that are not held out.
      progress: Called with the number of finished frames and T.

    Returns:
      The capture and its instances (index of the object, -1 = background).

    Raises:
      InputError: The options of the frames are invalid.
      ValueError: Fewer than two frames are not held out.
    """
    FrameOptions(frames=views, holdout=holdout)  # checks both
    is_held_out = np.arange(views) % holdout == 0 if holdout else np.zeros(views, bool)
    got, remedy = f"{views} with every {holdout}. held out", "Sparse points are those that two views see: take more."
    require(int((~is_held_out).sum()) >= 2, "views", got, "2 that are not held out", remedy)
    cameras = room_cameras(room, views=views, width=width, height=height)
    names = tuple(f"frame_{view + 1:05d}" for view in range(views))
    capture, instances = render_capture(room, cameras, names, is_held_out, points=points, progress=progress)
    return dataclasses.replace(capture, depths=None), instances


def render_capture(
    room: Room,
    cameras: Camera,
    names: tuple[str, ...],
    is_held_out: Bool[np.ndarray, " t"],
    *,
    points: int,
    progress: Progress | None = None,
) -> tuple[Capture, Int16[np.ndarray, "t h w"]]:
    """Makes the capture of a room from chosen cameras.

    Args:
      room: The room.
      cameras: T cameras inside the room.
      names: T names of the frames.
      is_held_out: (T,) frames that the sparse points are not taken from.
      points: Number of sparse points.
      progress: Called with the number of finished frames and T.

    Returns:
      The capture with depth, and its instances (index of the object, -1 = background).
    """
    frames, instances, depths = render_views(room, cameras, progress=progress)
    cloud, colours = _sparse_points(np.random.default_rng([room.seed, 7]), frames, depths, cameras, is_held_out, points)
    return Capture(frames, cameras, cloud, colours, is_held_out, depths, np.eye(4, dtype=np.float32), names), instances


def _sparse_points(draw, frames, depths, cameras, is_held_out, count):
    """Points like those of structure from motion: on texture, seen by two training views, with errors of 0.4 px."""
    kept = np.flatnonzero(~is_held_out)
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
    """Whether a view sees each point: inside the image and at the depth of the surface at its pixel."""
    height, width = depth.shape
    local = world @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    x = np.floor(local[:, 0] / z * focal + middle[0]).astype(np.int64)
    y = np.floor(local[:, 1] / z * focal + middle[1]).astype(np.int64)
    inside = (local[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    surface = depth[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return inside & (np.abs(surface - local[:, 2]) < 0.02 * z)


def write_room(
    folder: str | Path, room: Room, *, holdout: int = 5, progress: Progress | None = None, **options: int
) -> Path:
    """Writes a room as a COLMAP capture (images/, sparse/0/) with its ground truth beside it.

    masks/<frame>.png holds 8-bit ids of the objects from 1 on; 0 is background. label/<frame>.json holds LERF labels in
    LangSplat's layout: held-out frames, objects with at least MIN_LABEL_PIXELS visible pixels. scene.json is written
    last and holds seed, options and the names by id.

    Args:
      folder: Where to write. Files of an earlier room there are replaced.
      room: The room.
      holdout: Every `holdout`-th frame is held out.
      progress: Called with the number of finished frames and of all.
      **options: Further options of `room_capture`.

    Returns:
      The folder.

    Raises:
      InputError: The folder cannot be written.
    """
    folder = Path(folder)
    _clear(folder)
    capture, instances = room_capture(room, holdout=holdout, progress=progress, **options)
    write_colmap(capture, folder)
    for name, instance in zip(capture.names, instances):
        write_image(folder / "masks" / f"{name}.png", (instance + 1).astype(np.uint8))
    test_frames = np.flatnonzero(capture.held_out)
    labels = [label_frame(capture.names[t], instances[t], room.names, MIN_LABEL_PIXELS) for t in test_frames]
    write_lerf_labels(folder / "label", labels)
    scene = {
        "seed": room.seed,
        "views": len(capture.names),
        "width": capture.cameras.width,
        "height": capture.cameras.height,
        "holdout": holdout,
        "points": len(capture.points),
        "held_out": [capture.names[t] for t in test_frames],
        "objects": {str(k + 1): name for k, name in enumerate(room.names)},
    }
    write_text(folder / "scene.json", json.dumps(scene, indent=2) + "\n")
    return folder


def _clear(folder):
    """Removes the files of an earlier room whose number depends on its options."""
    if (folder / "scene.json").is_file():
        for pattern in ("scene.json", "label/frame_*.json", "masks/frame_*.png", "images/frame_*.png"):
            for file in list(folder.glob(pattern)):
                file.unlink()


def label_frame(frame: str, instance: Int16[np.ndarray, "h w"], names: Sequence[str], min_pixels: int) -> LabelledFrame:
    """Labels the objects of a frame by name. Objects without a name get no label.

    Args:
      frame: Name of the frame.
      instance: (H, W) index into `names`, -1 = background.
      names: Names of the objects; those of one name share a label.
      min_pixels: Visible pixels that a label needs.

    Returns:
      Masks and boxes by name.
    """
    objects = {}
    for name in dict.fromkeys(filter(None, names)):
        masks = [mask for mask in (instance == k for k, other in enumerate(names) if other == name) if mask.any()]
        if sum(mask.sum() for mask in masks) >= min_pixels:
            objects[name] = np.any(masks, axis=0), np.concatenate([_box(mask) for mask in masks])
    return LabelledFrame(frame, instance.shape[1], instance.shape[0], objects)


def _box(mask):
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return np.array([[columns[0], rows[0], columns[-1], rows[-1]]], np.float32)
