"""nerfstudio and instant-ngp captures, on the host: transforms.json and the images that it names.

Format: nerfstudio docs/quickstart/data_conventions.md, instant-ngp scripts/colmap2nerf.py. transform_matrix is
camera-to-world in OpenGL camera axes (x right, y up, looking along -z): columns 1 and 2 are negated for OpenCV axes.
The world is the file's own; `PosedImages.source_from_poses` undoes what made it of the source's (applied_transform,
_scale).
"""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError
from jsecon.files import read_json
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.captures.frames import PosedImage, PosedImages, make_rigid
from jsecon.read.captures.images import find_image, image_header
from jsecon.read.captures.lens import Lens
from jsecon.read.splats.ply import load_point_cloud

_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE"}
_FISHEYE = {"OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")
"""keys of instant-ngp's lenses that are neither perspective nor OpenCV's fisheye"""
_REMEDY = "Write the file anew (ns-process-data, colmap2nerf.py)."


class _Transforms:
    """A JSON file of transforms; its getters raise InputErrors that name the file."""

    def __init__(self, file: Path):
        self.file, content = file, read_json(file, "a transforms.json", _REMEDY)
        if not isinstance(content, dict):
            raise self.error("it is JSON without keys", "an object with frames")
        self.content: dict[str, Any] = content

    def error(self, problem: str, expected: str = "", remedy: str = _REMEDY) -> InputError:
        """An error of this file."""
        return InputError(self.file, problem, expected, remedy)

    def get(self, record: dict[str, Any], key: str, where: str, kind: type) -> Any:
        """A required value of some type; `where` names the record."""
        if key not in record:
            raise self.error(f"there is no key {key!r} in {where}")
        if not isinstance(record[key], kind):
            raise self.error(f"{key!r} of type {type(record[key]).__name__} in {where}", kind.__name__)
        return record[key]

    def number(self, record: dict[str, Any], key: str, default: float) -> float:
        """An optional number."""
        value = record.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not is_finite_and_bounded(value):
            raise self.error(f"{key} = {value!r}", "a finite number")
        return float(value)

    def matrix(self, record: dict[str, Any], key: str, where: str) -> Float[np.ndarray, "4 4"]:
        """A required matrix of 4 or 3 rows of 4 numbers."""
        name = key if where == "the file" else f"{key} of {where}"
        rows = self.get(record, key, where, list)
        try:
            matrix = np.array(rows, np.float64)
        except (TypeError, ValueError) as error:
            raise self.error(f"{name} holds more than numbers", "4 rows of 4 numbers") from error
        if matrix.shape not in ((4, 4), (3, 4)):
            raise self.error(f"{name} has shape {matrix.shape}", "4 rows of 4 numbers")
        return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0, 0, 0, 1]]])

    def named_file(self, record: dict[str, Any], key: str, where: str) -> Path | None:
        """The file that an optional key names, which must exist."""
        if not record.get(key):
            return None
        file = self.file.parent / self.get(record, key, where, str)
        if not os.path.isfile(file):  # False also for a name that no file can have
            raise InputError(file, f"there is no such file, which is the {key} of {where}", remedy="Check the path.")
        return file


def read_nerfstudio(path: Path) -> PosedImages:
    """Reads the posed images of a transforms.json, or of the folder that holds one, with their depth and points."""
    file = path / "transforms.json" if path.is_dir() else path
    transforms = _Transforms(file)
    scale = transforms.number(transforms.content, "applied_scale", 1.0)
    millimetre = 0.001  # nerfstudio's default
    unit = transforms.number(transforms.content, "depth_unit_scale_factor", millimetre) * scale
    images, notes = [], []
    entries = transforms.get(transforms.content, "frames", "the file", list)
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise transforms.error(f"frame {index} is not an object", "frames with file_path and transform_matrix")
        name = transforms.get(entry, "file_path", f"frame {index}", str)
        pose = transforms.matrix(entry, "transform_matrix", f"frame {index} ({name})")
        image = find_image(file.parent, name)
        lens = _lens(transforms, entry, name, image)
        depth = None if image is None else transforms.named_file(entry, "depth_file_path", name)
        images.append(PosedImage(_full_name(name, image), image, lens, _world_to_camera(pose, file, name), depth, unit))
    if any("mask_path" in entry for entry in entries):
        notes.append("The masks named by mask_path (pixels to ignore) were not used.")
    source_from_poses = _source_from_poses(transforms, scale)
    cloud = transforms.named_file(transforms.content, "ply_file_path", file.name)
    points = () if cloud is None else load_point_cloud(cloud)
    return PosedImages(images, file, *points, source_from_poses=source_from_poses, notes=tuple(notes))


def _world_to_camera(pose: np.ndarray, file: Path, name: str) -> np.ndarray:
    """(4, 4) world-to-camera in OpenCV axes from camera-to-world in OpenGL axes."""
    return np.linalg.inv(make_rigid(pose * [1, -1, -1, 1], file, name))


def source_from_trained(file: Path) -> Float[np.ndarray, "4 4"]:
    """Reads the similarity from the world that nerfstudio trained and exported Gaussians in to the source's world.

    The file is a dataparser_transforms.json: trained = scale * (transform source), before any applied_transform.
    """
    transforms = _Transforms(file)
    matrix = transforms.matrix(transforms.content, "transform", "the file")
    scale = transforms.number(transforms.content, "scale", 1.0)
    if not scale > 0:
        raise transforms.error(f"scale = {scale}", "a number above 0", "Copy it again from the folder of the training.")
    return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ make_rigid(matrix, file, "the trained world"))


def _source_from_poses(transforms: _Transforms, scale: float) -> np.ndarray:
    """(4, 4) inverse of world = applied_scale * (applied_transform source)."""
    matrix = np.eye(4)
    if "applied_transform" in transforms.content:
        matrix = transforms.matrix(transforms.content, "applied_transform", "the file")
    if not is_finite_and_bounded(matrix):
        matrix = np.zeros((4, 4))
    scaled = np.diag([scale, scale, scale, 1.0]) @ matrix
    size = np.abs(scaled[:3, :3]).max()
    turn = scaled[:3, :3] / size if size > 0 else np.zeros((3, 3))
    if not (np.linalg.det(turn) > 0 and np.allclose(turn @ turn.T, (turn @ turn.T)[0, 0] * np.eye(3), atol=1e-3)):
        problem = "applied_transform or applied_scale cannot be inverted, or shears or mirrors"
        raise transforms.error(problem, "a rotation, a scale and a shift")
    return np.linalg.inv(scaled)


def _full_name(name: str, image: Path | None) -> str:
    """A frame's path without "./", with the image's suffix if the file omits it."""
    name = name.replace("\\", "/").removeprefix("./")
    return name if image is None or name.lower().endswith(image.suffix.lower()) else name + image.suffix


def _lens(transforms: _Transforms, entry: dict[str, Any], name: str, image: Path | None) -> Lens | None:
    """The lens of a frame: its keys take precedence over those of the file. None if neither gives its size."""
    keys = {**transforms.content, **entry}
    model = str(keys.get("camera_model", "OPENCV")).upper()
    if model not in _PERSPECTIVE | _FISHEYE:
        known = ", ".join(sorted(_PERSPECTIVE | _FISHEYE))
        raise transforms.error(f"camera_model {model}", f"one of {known}", "Undistort the images first.")
    if other := next((key for key in _OTHER_LENSES if keys.get(key)), None):
        problem = f"the lens of {name} is one of instant-ngp's own ({other})"
        raise transforms.error(problem, "a perspective or an OpenCV fisheye lens", "Undistort the images first.")
    is_fisheye = model in _FISHEYE or keys.get("is_fisheye") is True
    if keys.get("w") is not None and keys.get("h") is not None:
        width, height = (round(transforms.number(keys, key, 0.0)) for key in ("w", "h"))
    elif image is not None:
        width, height = image_header(image).closest_to_centre(keys.get("cx"), keys.get("cy"))
    else:
        return None
    fx = _focal(transforms, keys, "fl_x", "camera_angle_x", width)
    fy = _focal(transforms, keys, "fl_y", "camera_angle_y", height)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise transforms.error(f"{name} has no focal length", "fl_x or camera_angle_x, in the file or the frame")
    if min(width, height, fx, fy) <= 0:
        raise transforms.error(f"{name} has {width}x{height} px and focal lengths {fx}, {fy}", "positive numbers")
    order = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = tuple(transforms.number(keys, key, 0.0) for key in order)
    if model == "OPENCV" and not is_fisheye and distortion[5] != 0:
        # nerfstudio's OPENCV has k1..k4 in one polynomial; OpenCV's own k4 divides. Not the same lens: refuse to guess.
        problem = f"k4 = {keys['k4']} with camera_model OPENCV"
        raise transforms.error(problem, "k1 k2 p1 p2 k3, or FULL_OPENCV", "Undistort the images first.")
    cx, cy = transforms.number(keys, "cx", width / 2), transforms.number(keys, "cy", height / 2)
    return Lens(width, height, fx, fy, cx, cy, distortion, is_fisheye)


def _focal(transforms: _Transforms, keys: dict[str, Any], direct: str, angle: str, size: int) -> float | None:
    """A focal length, px, of a key or of a field of view."""
    if direct in keys:
        return transforms.number(keys, direct, 0.0)
    if angle in keys:
        value = transforms.number(keys, angle, 0.0)
        if not 0 < value < math.pi:
            raise transforms.error(f"{angle} = {value}", "an angle between 0 and pi (radians)")
        return 0.5 * size / math.tan(0.5 * value)
    return None
