"""Replica as NICE-SLAM rendered it, with the semantics of the original release; truth is at the vertices.

ROOT/cam_params.json, ROOT/<room0>/{traj.txt, results/frame000000.jpg, results/depth000000.png}, ROOT/<room0>_mesh.ply;
semantics as ROOT/<room_0>/habitat/{mesh_semantic.ply, info_semantic.json}. Frames as cvg/nice-slam reads them
(src/utils/datasets.py), semantics as facebookresearch/Replica-Dataset's README describes them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from experiments.datasets.benchmark import Benchmark, require_count, twin_of
from experiments.datasets.mesh_files import read_faces
from jsecon.errors import InputError
from jsecon.read.captures.build import build_capture
from jsecon.read.captures.frames import FrameOptions, PosedImage, PosedImages
from jsecon.read.captures.lens import Lens
from jsecon.read.splats.point_clouds import load_point_cloud
from jsecon.types import Capture

REPLICA_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
REPLICA_CLASSES = ("chair", "blinds", "sofa", "table", "rug", "window", "lamp", "door", "pillow", "tv-screen")
"""our ten: the most frequent object classes of the eight scenes. The paper does not say which ten it asked, so
a number on these is not one of its Table 3"""


def load_replica(
    root: str | Path,
    scene: str,
    *,
    classes: Sequence[str] | None = None,
    every: int = 10,
    downscale: float | int | None = None,
) -> Benchmark:
    """A scene of Replica: every `every`-th frame with depth, all vertices in order, the class of each.

    classes: the queries; default `REPLICA_CLASSES`, or what the twin's generator wrote. Each class that no vertex has
    is kept as a query, but does not count (`pairs`: classes that occur). Vertices of other classes are -1. No frame is
    held out: truth is at the points. Raises InputError where files are missing, damaged, or of different counts, and
    for a class that the scene's own table of classes does not know.
    """
    root, told = Path(root), twin_of(root, scene)
    capture = load_frames(root, scene, every=every, downscale=downscale)
    points, colors, ids, names = load_semantics(root, scene)
    queries = tuple(classes or (REPLICA_CLASSES if told is None else told["queries"]))
    unknown = sorted(set(queries) - set(names.values()))
    if unknown:
        problem = f"classes {', '.join(unknown)} asked for, which the scene's own table does not have"
        raise InputError(root / scene, problem, remedy=f"It has {', '.join(sorted(names.values())[:5])} and so on.")
    index = {number: queries.index(name) for number, name in names.items() if name in queries}
    numbers, place = np.unique(ids, return_inverse=True)
    table = np.array([index.get(int(number), -1) for number in numbers], np.int32)
    point_classes = table[place.reshape(-1)] if len(numbers) else np.zeros(0, np.int32)
    occurring = len(np.unique(point_classes[point_classes >= 0]))
    if told is not None:
        require_count(root / scene, occurring, told["pairs"], "classes that occur")
    return Benchmark(
        capture=capture,
        frames=(),
        points=points,
        point_colors=colors,
        point_classes=point_classes,
        name=scene,
        dataset="replica",
        queries=queries,
        pairs=occurring,
        twin=told is not None,
    )


def load_frames(root: Path, scene: str, *, every: int, downscale: float | int | None) -> Capture:
    """The RGB-D frames of a scene; poses are camera-to-world in OpenCV axes, one per line of traj.txt."""
    file = root / "cam_params.json"
    camera = _json(file).get("camera", {})
    keys = ("w", "h", "fx", "fy", "cx", "cy", "scale")
    if not all(isinstance(camera.get(key), int | float) for key in keys):
        raise InputError(file, f"camera {camera}", f"numbers {', '.join(keys)}", "Copy it again.")
    # The principal point counts pixel centres from 0.
    lens = Lens(*(int(camera[k]) for k in "wh"), camera["fx"], camera["fy"], camera["cx"] + 0.5, camera["cy"] + 0.5)
    file = root / scene / "traj.txt"
    try:
        rows = np.loadtxt(file, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(file, str(error), "16 numbers per line", "Copy it again.") from error
    if rows.shape[1:] != (16,) or not np.isfinite(rows).all():
        raise InputError(file, f"{rows.shape}", "16 finite numbers per line", "Copy it again.")
    poses = np.linalg.inv(rows.reshape(-1, 4, 4))
    images = sorted((root / scene / "results").glob("frame*.jpg"))
    require_count(root / scene / "results", len(images), len(poses), "frames beside the poses")
    shots = []
    for image in images[::every]:
        number = image.stem.removeprefix("frame")
        depth = image.with_name(f"depth{number}.png")
        if not number.isdigit() or int(number) >= len(poses) or not depth.is_file():
            raise InputError(image, f"no {depth.name} beside it, or no pose", remedy="Copy the rendering again.")
        shots.append(PosedImage(image.name, image, lens, poses[int(number)], depth, 1.0 / camera["scale"]))
    return build_capture(PosedImages(shots, root / scene), FrameOptions(downscale, holdout=0))


def load_semantics(
    root: Path, scene: str
) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"], Int[np.ndarray, " p"], dict[int, str]]:
    """Vertices in order, their colours, class ids (-1 = undefined), and the names of the classes."""
    habitat = root / re.sub(r"(\D)(\d+)$", r"\1_\2", scene) / "habitat"
    mesh = habitat / "mesh_semantic.ply"
    points, colors = load_point_cloud(mesh)
    faces, properties = read_faces(mesh)
    if "object_id" not in properties:
        raise InputError(mesh, "faces without object_id", "Replica's habitat mesh", "Use that.")
    info = _json(habitat / "info_semantic.json")
    try:
        names = {int(entry["id"]): str(entry["name"]) for entry in info["classes"]}
        of_object = {int(entry["id"]): int(entry["class_id"]) for entry in info["objects"]}
    except (KeyError, TypeError, ValueError) as error:
        problem = f"no usable {error}: classes need id and name, objects id and class_id"
        raise InputError(habitat / "info_semantic.json", problem, remedy="Copy it again.") from error
    return points, colors, vertex_classes(len(points), faces, properties["object_id"], of_object), names


def vertex_classes(
    count: int, faces: Int[np.ndarray, "f k"], objects: Int[np.ndarray, " f"], of_object: dict[int, int]
) -> Int[np.ndarray, " p"]:
    """(count,) class id of the object of the first face that has the vertex; -1 without face, object or class."""
    numbers, place = np.unique(objects, return_inverse=True)
    table = np.array([of_object.get(int(number), -1) for number in numbers], np.int64)
    of_face = np.where(table > 0, table, -1)[place.reshape(-1)] if len(numbers) else np.zeros(0, np.int64)
    result = np.full(count, -1, np.int64)
    # Written last to first: where several faces share a vertex the first one's class stays.
    result[faces[::-1].reshape(-1)] = np.repeat(of_face[::-1], faces.shape[1])
    return result


def _json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(file, str(error), "a JSON file", "Copy it again.") from error
    if not isinstance(content, dict):
        raise InputError(file, "no JSON object", "one", "Copy it again.")
    return content
