"""COLMAP captures, a model and its images: read and written.

Poses are world-to-camera in OpenCV axes, and pixel centres lie at (0.5, 0.5): both as everywhere in jsecon.
"""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jsecon.data.colmap_model import (
    MODELS,
    REMEDY,
    count_images,
    model_file,
    read_cameras,
    read_images,
    read_points,
)
from jsecon.data.coordinates import transform_poses
from jsecon.data.frames import PosedImage, PosedImages
from jsecon.data.images import find_image, write_image
from jsecon.errors import InputError
from jsecon.files import atomic_write, path_within
from jsecon.splat.transform import quaternion_from_matrix
from jsecon.types import Capture


def find_models(path: str | Path) -> list[Path]:
    """Finds the folders of COLMAP models below a capture, the one with the most images first.

    They lie in sparse/0, sparse/1, ... or in sparse itself. Where neither holds one and there is no transforms.json,
    colmap/sparse, colmap_text and the capture's own folder are tried, as nerfstudio and instant-ngp lay them out.
    """
    path = Path(path)
    models = _models_below(path / "sparse")
    if not models and not (path / "transforms.json").exists():
        places = (path / "colmap" / "sparse", path / "colmap_text", path)
        models = next(filter(None, map(_models_below, places)), [])
    return models


def _models_below(folder: Path) -> list[Path]:
    """The models in the folders of a folder, or in itself, the one with the most images first."""
    if not folder.is_dir():
        return []
    inner = [child for child in folder.iterdir() if child.is_dir()] if folder.name == "sparse" else []
    inner.sort(key=lambda child: (not child.name.isdecimal(), len(child.name), child.name))
    models = [place for place in (*inner, folder) if model_file(place, "cameras") is not None]
    return sorted(models, key=count_images, reverse=True) if len(models) > 1 else models


def find_model(path: str | Path) -> Path | None:
    """The folder of the largest model below a capture (`find_models`), or None."""
    return next(iter(find_models(path)), None)


def read_colmap(path: Path, models: Sequence[Path]) -> PosedImages:
    """Reads a COLMAP capture: the first of `models` and the images in `path`/images, or beside each other in `path`.

    Every camera model is read but EQUIRECTANGULAR. The notes tell which models were left out. Raises InputError on a
    model that is cut short or names images that are not there.
    """
    model = models[0]
    lenses, images = read_cameras(model), read_images(model)
    files = _image_files(path, [name for name, _, _ in images])
    missing = [name for name, _, _ in images if name not in files]
    if missing:
        found = f"{len(missing)} of {len(images)} images of the model missing (the first: {missing[0]})"
        remedy = "Copy them there, or take them out of the model (colmap image_deleter)."
        raise InputError(path / "images", found, "every image that the model names", remedy)
    shots = []
    for name, camera, pose in images:
        if camera not in lenses:
            found = f"image {name} of camera {camera}, which is not in the cameras file"
            raise InputError(model, found, "cameras and images of one model", REMEDY)
        shots.append(PosedImage(name, files[name], lenses[camera], pose))
    notes = []
    if len(models) > 1:
        others = ", ".join(f"{place.relative_to(path)} with {count_images(place)}" for place in models[1:])
        told = (
            f"There are {len(models)} models. {model.relative_to(path)} has the most images, {len(images)}, and is used"
        )
        remedy = "Join them (colmap model_merger), or take photographs between them, to use all images."
        notes.append(f"{told}; left out: {others}. {remedy}")
    if model_file(model, "points3D") is None:
        return PosedImages(shots, model, notes=(*notes, "The model has no points3D file: there are no sparse points."))
    return PosedImages(shots, model, *read_points(model), notes=tuple(notes))


def _image_files(path: Path, names: Sequence[str]) -> dict[str, Path]:
    """The image files of a model by name: all from images/, or else all from the capture's own folder or input/."""
    for name in names:
        path_within(path / "images", name)  # a name from a file is no path to elsewhere
    found: dict[str, Path] = {}
    for folder in (path / "images", path, path / "input"):
        files = {name: file for name in names if (file := find_image(folder, name)) is not None}
        if len(files) == len(set(names)):
            return files
        found = found or files
    return found


def write_colmap(capture: Capture, path: str | Path, *, image_format: str = "png") -> None:
    """Writes `capture` as a COLMAP capture: `path`/sparse/0/{cameras,images,points3D}.bin (PINHOLE) and `path`/images,
    in the world of the poses that it was loaded from.

    The points keep their colours; observations and tracks are empty and errors -1 (not computed), since a Capture holds
    none. Depths and the held-out frames have no place in the format: choose the latter again on loading. Raises
    InputError where the folder cannot be written.
    """
    path, cameras = Path(path), capture.cameras
    intrinsics = np.stack([cameras.fx, cameras.fy, cameras.cx, cameras.cy], axis=-1).astype(np.float64)
    distinct, which = np.unique(intrinsics, axis=0, return_inverse=True)
    files = [f"{name}.{image_format.lstrip('.')}" for name in capture.names]
    places = [path_within(path / "images", file) for file in files]
    for place, frame in zip(places, np.asarray(capture.frames)):
        write_image(place, frame)
    camera_bytes = [struct.pack("<Q", len(distinct))]
    camera_bytes += [
        struct.pack("<iiQQ4d", n, MODELS["PINHOLE"][0], cameras.width, cameras.height, *row)
        for n, row in enumerate(distinct, start=1)
    ]
    image_bytes = [struct.pack("<Q", len(files))]
    from_world = np.eye(4) if capture.to_poses is None else np.asarray(capture.to_poses, np.float64)
    poses = transform_poses(np.asarray(cameras.world_to_camera, np.float64), from_world)
    for n, (file, pose, camera) in enumerate(zip(files, poses, which.ravel()), start=1):
        quaternion = quaternion_from_matrix(pose[:3, :3])
        numbers = itertools.chain(-quaternion if quaternion[0] < 0 else quaternion, pose[:3, 3])
        head = struct.pack("<i7di", n, *numbers, camera + 1)
        image_bytes.append(head + os.fsencode(file) + b"\0" + struct.pack("<Q", 0))
    points = np.zeros(len(capture.points), "<u8, 3<f8, 3u1, <f8, <u8")
    points["f0"] = np.arange(1, len(points) + 1)
    points["f1"] = np.asarray(capture.points, np.float64) @ from_world[:3, :3] + from_world[:3, 3]
    points["f2"], points["f3"] = capture.point_colors, -1.0
    contents = {
        "cameras": b"".join(camera_bytes),
        "images": b"".join(image_bytes),
        "points3D": struct.pack("<Q", len(points)) + points.tobytes(),
    }
    for kind, content in contents.items():
        with atomic_write(path / "sparse" / "0" / f"{kind}.bin") as temporary:
            temporary.write_bytes(content)
