"""Twins: made-up rooms written in the exact layouts of LERF-OVS, 3D-OVS and Replica.

What the real datasets can't be had for is run on these: the loader, the protocol and the table see files of the true
form. ROOT/twin.json says of each scene what the generator put there; ROOT/truth/<scene>/<frame>.png is the object of
each pixel, for simulated vision: its number from 1, objects first and then walls, floor, ceiling and table, which a
segmenter finds too. Without masks around the objects every method that averages over masks grows halos.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from experiments.datasets.benchmark import TWIN_FILE
from experiments.datasets.mesh import SURROUNDINGS, mesh_of, surfaces_of
from experiments.datasets.mesh_files import write_mesh
from experiments.datasets.ovs3d import write_segmentations
from experiments.datasets.plain_room import make_room
from experiments.rooms.capture import label_frame, look_at, render_capture, room_cameras
from experiments.rooms.room import TABLE_WOOD, Part, Room, srgb_to_linear
from experiments.rooms.writers import write_colmap, write_lerf_labels
from jsecon.files import write_text
from jsecon.read.captures.images import write_image
from jsecon.read.masks.labels import LabelledFrame
from jsecon.types import Camera, Capture


def write_lerf_twin(
    root: Path,
    scene: str,
    seed: int,
    *,
    views: int = 30,
    width: int = 320,
    height: int = 240,
    annotated_every: int = 6,
    num_objects: int = 12,
    label_pixels: int = 40,
    kinds: bool = False,
    camouflage: float | int = 0,
) -> Path:
    """A room as a scene of LERF-OVS; every `annotated_every`-th frame is labelled, with the objects of at least
    `label_pixels` pixels there. `kinds`: a text names a shape, of which there may be several; `camouflage`: how far, 0
    to 1, the objects' colours are brought to the table's. Returns the root."""
    room = camouflaged(make_room(seed, num_objects=num_objects), camouflage)
    cameras = room_cameras(room, views=views, width=width, height=height)
    names = tuple(f"frame_{view + 1:05d}" for view in range(views))
    out = np.arange(views) % annotated_every == 0
    capture, instances, frames = _labelled_capture(root / scene, room, cameras, names, out, label_pixels)
    frames = [by_kind(frame, room) for frame in frames] if kinds else frames
    write_lerf_labels(root / "label" / scene, frames, image_ending=".jpg")
    pairs = sum(len(frame.objects) for frame in frames)
    queries = sorted({name for frame in frames for name in frame.objects})
    _, owners = surfaces_of(room, capture, instances)
    objects = (*(item.shape if kinds else item.name for item in room.objects), *SURROUNDINGS)
    _finish(root, scene, capture, owners, frames, seed=seed, pairs=pairs, queries=queries, objects=objects)
    return root


def by_kind(frame: LabelledFrame, room: Room) -> LabelledFrame:
    """The frame's label with the objects of a shape as one, under the shape's name."""
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for item in room.objects:
        if item.name in frame.objects:
            mask, boxes = frame.objects[item.name]
            others = found.get(item.shape, (np.zeros_like(mask), boxes[:0]))
            found[item.shape] = others[0] | mask, np.concatenate([others[1], boxes])
    return dataclasses.replace(frame, objects=found)


def camouflaged(room: Room, share: float) -> Room:
    """The room with its objects' colours brought to the table's by a share of the way."""

    def painted(part: Part) -> Part:
        return dataclasses.replace(part, albedo=(1 - share) * part.albedo + share * srgb_to_linear(TABLE_WOOD))

    objects = (dataclasses.replace(item, parts=tuple(map(painted, item.parts))) for item in room.objects)
    return dataclasses.replace(room, objects=tuple(objects)) if share else room


def write_ovs3d_twin(
    root: Path,
    scene: str,
    seed: int,
    *,
    views: int = 28,
    width: int = 320,
    height: int = 240,
    labelled_frames: int = 5,
    num_objects: int = 6,
) -> Path:
    """A room as a scene of 3D-OVS: views from the front, `labelled_frames` of them with a mask of every class."""
    room = make_room(seed, num_objects=num_objects)
    cameras = _forward_cameras(room, views, width, height)
    names = tuple(f"{view:02d}" for view in range(views))
    out = np.isin(np.arange(views), np.linspace(0, views - 1, labelled_frames + 2).round()[1:-1])
    capture, instances, frames = _labelled_capture(root / scene, room, cameras, names, out, 1)
    write_segmentations(root / scene / "segmentations", frames, names, room.names)
    pairs, queries = len(frames) * num_objects, sorted(room.names)
    _, owners = surfaces_of(room, capture, instances)
    objects = (*room.names, *SURROUNDINGS)
    _finish(root, scene, capture, owners, frames, seed=seed, pairs=pairs, queries=queries, objects=objects)
    return root


def write_replica_twin(
    root: Path,
    scene: str,
    seed: int,
    *,
    views: int = 30,
    width: int = 300,
    height: int = 170,
    num_objects: int = 12,
    fine_m: float = 0.012,
    coarse_m: float = 0.05,
) -> Path:
    """A room as a scene of Replica in NICE-SLAM's rendering. Classes are the objects' shapes, wall, floor, ceiling and
    table, in habitat's semantic mesh."""
    names = tuple(f"frame{view:06d}" for view in range(views))
    room = make_room(seed, num_objects=num_objects)
    cameras = room_cameras(room, views=views, width=width, height=height)
    capture, instances = render_capture(room, cameras, names, np.zeros(views, bool), points=100)
    surfaces, owners = surfaces_of(room, capture, instances)
    mesh = mesh_of(surfaces, owners, capture.frames, num_objects, fine=fine_m, coarse=coarse_m)
    classes = [item.shape for item in room.objects] + list(SURROUNDINGS)
    table = {name: n for n, name in enumerate(sorted(set(classes)), start=1)}
    scale, fx = 6553.5, float(capture.cameras.fx[0])
    camera = {"w": width, "h": height, "fx": fx, "fy": fx, "scale": scale}
    camera |= {"cx": width / 2 - 0.5, "cy": height / 2 - 0.5}
    write_text(root / "cam_params.json", json.dumps({"camera": camera}))
    poses = np.linalg.inv(np.asarray(capture.cameras.world_to_camera, np.float64))
    write_text(root / scene / "traj.txt", "".join(" ".join(map(repr, map(float, p.ravel()))) + "\n" for p in poses))
    assert capture.depths is not None
    for t in range(views):
        write_image(root / scene / "results" / f"frame{t:06d}.jpg", capture.frames[t])
        depth = np.rint(capture.depths[t] * scale).astype(np.uint16)
        write_image(root / scene / "results" / f"depth{t:06d}.png", depth)
    write_mesh(root / f"{scene}_mesh.ply", mesh.vertices, mesh.faces)
    habitat = root / f"{scene[:-1]}_{scene[-1]}" / "habitat"
    numbers = mesh.face_owners.astype(np.int32) + 1
    write_mesh(habitat / "mesh_semantic.ply", mesh.vertices, mesh.faces, {"object_id": numbers})
    info = {
        "classes": [{"id": n, "name": name, "children": [], "parents": []} for name, n in table.items()],
        "objects": [{"id": k + 1, "class_id": table[c], "class_name": c} for k, c in enumerate(classes)],
        "id_to_label": [-1, *(table[c] for c in classes)],
        "gravity_dir": [0.0, 0.0, -1.0],
    }
    write_text(habitat / "info_semantic.json", json.dumps(info))
    queries = sorted({item.shape for item in room.objects} | {"table"})
    occurring = {classes[k] for k in np.unique(mesh.vertex_owners)} & set(queries)
    pairs = len(occurring)
    _finish(root, scene, capture, owners, seed=seed, pairs=pairs, queries=queries, objects=classes)
    return root


def _forward_cameras(room: Room, views: int, width: int, height: int) -> Camera:
    """Views from the front, in three rows over some 50 degrees; 60 degrees across."""
    draw = np.random.default_rng([room.seed, 9])
    along = np.radians(25) * (2 * np.arange(views) / max(views - 1, 1) - 1) + draw.uniform(0, 2 * np.pi)
    lift = 0.75 + 0.12 * (np.arange(views) % 3) + draw.normal(0, 0.01, views)
    centres = np.stack([1.5 * np.cos(along), 1.5 * np.sin(along), lift], -1)
    poses = np.stack([look_at(centre, np.zeros(3)) for centre in centres])
    focal, cx, cy = (
        np.full(views, value, np.float32) for value in (0.5 * width / np.tan(np.radians(30)), width / 2, height / 2)
    )
    return Camera(poses, focal, focal, cx, cy, width, height)


def _labelled_capture(
    folder: Path, room: Room, cameras: Camera, names: tuple[str, ...], out: Bool[np.ndarray, " t"], label_pixels: int
) -> tuple[Capture, Int[np.ndarray, "t h w"], list[LabelledFrame]]:
    """The room seen by `cameras`, written for COLMAP; its instances, and the labels of the frames `out`."""
    capture, instances = render_capture(room, cameras, names, out, points=200 * len(names))
    write_colmap(capture, folder, image_format="jpg")
    frames = [label_frame(names[t], instances[t], room.names, label_pixels) for t in np.flatnonzero(out)]
    return capture, instances, frames


def _finish(
    root: Path,
    scene: str,
    capture: Capture,
    owners: Int[np.ndarray, "t h w"],
    frames: Sequence[LabelledFrame] = (),
    **told: Any,
) -> None:
    """The truth of each pixel, and, last, what was written of the scene."""
    for name, image in zip(capture.names, owners):
        write_image(root / "truth" / scene / f"{name}.png", (image + 1).astype(np.uint8))
    file = root / TWIN_FILE
    scenes = json.loads(file.read_text())["scenes"] if file.exists() else {}
    told |= {"frames": [frame.name for frame in frames]}
    write_text(file, json.dumps({"scenes": scenes | {scene: told}}, indent=1) + "\n")
