"""COLMAP captures, a model and its images: read and written.

Poses are world-to-camera in OpenCV axes, and pixel centres lie at (0.5, 0.5): both as everywhere in jsecon.
"""

from __future__ import annotations

import itertools
import os
import struct
from pathlib import Path

import numpy as np

from jsecon.data.colmap_model import MODELS, REMEDY, model_file, read_cameras, read_images, read_points
from jsecon.data.frames import Posed, Shot
from jsecon.data.images import write_image
from jsecon.data.worlds import moved_poses
from jsecon.errors import InputError
from jsecon.files import written_whole
from jsecon.splat.transform import quaternion_of
from jsecon.types import Capture


def find_model(path: str | Path) -> Path | None:
    """The folder of the model below a capture: sparse/0, sparse, or None."""
    for folder in (Path(path) / "sparse" / "0", Path(path) / "sparse"):
        if model_file(folder, "cameras") is not None:
            return folder
    return None


def read_colmap(path: Path, model: Path) -> Posed:
    """A COLMAP capture: the model in `model` and the images in `path`/images.

    Every camera model that OpenCV can undistort is read. Raises InputError on a model that is cut short or names images
    that are not there, and on the models that OpenCV lacks (FOV, thin prisms).
    """
    lenses, images = read_cameras(model), read_images(model)
    missing = [name for name, _, _ in images if not os.path.isfile(path / "images" / name)]
    if missing:
        found = f"{len(missing)} of {len(images)} images of the model missing (the first: {missing[0]})"
        remedy = "Copy them there, or take them out of the model (colmap image_deleter)."
        raise InputError(path / "images", found, "every image that the model names", remedy)
    shots = []
    for name, camera, pose in images:
        if camera not in lenses:
            found = f"image {name} of camera {camera}, which is not in the cameras file"
            raise InputError(model, found, "cameras and images of one model", REMEDY)
        shots.append(Shot(name, path / "images" / name, lenses[camera], pose))
    if model_file(model, "points3D") is None:
        return Posed(shots, model, notes=("The model has no points3D file: there are no sparse points.",))
    return Posed(shots, model, *read_points(model))


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
    for file, frame in zip(files, np.asarray(capture.frames)):
        write_image(path / "images" / file, frame)
    camera_bytes = [struct.pack("<Q", len(distinct))]
    camera_bytes += [
        struct.pack("<iiQQ4d", n, MODELS["PINHOLE"][0], cameras.width, cameras.height, *row)
        for n, row in enumerate(distinct, start=1)
    ]
    image_bytes = [struct.pack("<Q", len(files))]
    from_world = np.eye(4) if capture.to_poses is None else np.asarray(capture.to_poses, np.float64)
    poses = moved_poses(np.asarray(cameras.world_to_camera, np.float64), from_world)
    for n, (file, pose, camera) in enumerate(zip(files, poses, which.ravel()), start=1):
        quaternion = quaternion_of(pose[:3, :3])
        numbers = itertools.chain(-quaternion if quaternion[0] < 0 else quaternion, pose[:3, 3])
        image_bytes.append(struct.pack("<i7di", n, *numbers, camera + 1) + file.encode() + b"\0" + struct.pack("<Q", 0))
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
        with written_whole(path / "sparse" / "0" / f"{kind}.bin") as temporary:
            temporary.write_bytes(content)
