"""nerfstudio and instant-ngp captures, on the host: transforms.json and the images that it names.

Format: nerfstudio docs/quickstart/data_conventions.md, instant-ngp scripts/colmap2nerf.py. transform_matrix is
camera-to-world in OpenGL camera axes (x right, y up, looking along -z): columns 1 and 2 are negated for OpenCV axes.
The world is the file's own; Capture.source_from_scene undoes what made it of the source's (applied_transform, _scale).
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
from jsecon.read.captures.coordinates import make_rigid
from jsecon.read.captures.frames import PosedImage, PosedImages
from jsecon.read.captures.images import find_image, image_header
from jsecon.read.captures.lens import Lens
from jsecon.read.splats.ply import load_point_cloud

MILLIMETRE = 0.001
"""nerfstudio's default depth unit, metres"""
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
        try:
            matrix = np.array(self.get(record, key, where, list), np.float64)
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise self.error(f"{name} holds more than numbers", "4 rows of 4 numbers") from error
        if matrix.shape not in ((4, 4), (3, 4)):
            raise self.error(f"{name} has shape {matrix.shape}", "4 rows of 4 numbers")
        return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0, 0, 0, 1]]])


def read_nerfstudio(file: Path) -> PosedImages:
    """Reads the capture of a transforms.json, with its depth maps and sparse points if it names some.

    Args:
      file: The transforms.json.

    Returns:
      Its posed images; frames whose image is missing are skipped and counted in the notes.

    Raises:
      InputError: The file is damaged or lacks a key, a camera model is neither perspective nor fisheye, or no image
        exists.
    """
    scene = _Transforms(file)
    entries = scene.get(scene.content, "frames", "the file", list)
    notes, images, missing = [], [], []
    scale = scene.number(scene.content, "applied_scale", 1.0)
    unit = scene.number(scene.content, "depth_unit_scale_factor", MILLIMETRE) * scale
    for index, entry in enumerate(entries):
        where = f"frame {index}"
        if not isinstance(entry, dict):
            raise scene.error(f"{where} is not an object", "frames with file_path and transform_matrix")
        name = scene.get(entry, "file_path", where, str)
        pose = scene.matrix(entry, "transform_matrix", f"{where} ({name})")
        if (image := find_image(file.parent, name)) is None:
            missing.append(name)
            continue
        depth = None
        if entry.get("depth_file_path") is not None:
            depth = file.parent / scene.get(entry, "depth_file_path", where, str)
            if not os.path.isfile(depth):
                problem = f"no such depth map, which is the depth_file_path of {name}"
                raise InputError(depth, problem, remedy="Check the path.")
        lens, world_to_camera = _lens(scene, entry, name, image), _world_to_camera(pose, file, name)
        images.append(PosedImage(_full_name(name, image), image, lens, world_to_camera, depth, unit))
    first = f" (the first: {missing[0]})" if missing else ""
    if missing:
        skipped = f"{len(missing)} of {len(entries)} frames of {file.name} were left out"
        notes.append(f"{skipped}, since their images are missing{first}.")
    if not images:
        problem = f"it has {len(entries)} frames, none of which has its image{first}"
        raise scene.error(problem, remedy="Copy the images to where file_path says, relative to this file.")
    if any("mask_path" in entry for entry in entries):
        notes.append("The masks named by mask_path (pixels to ignore) were not used.")
    source_from_scene, points = _to_source(scene, scale), ()
    if scene.content.get("ply_file_path"):
        cloud = file.parent / scene.get(scene.content, "ply_file_path", "the file", str)
        if not os.path.isfile(cloud):  # False also for a name that no file can have
            problem = "no such file, which is the ply_file_path of transforms.json"
            raise InputError(cloud, problem, remedy="Check the path.")
        points = load_point_cloud(cloud)
    return PosedImages(images, file, *points, source_from_scene=source_from_scene, notes=tuple(notes))


def read_poses(file: Path) -> list[tuple[str, Lens, np.ndarray]]:
    """Reads the cameras of a transforms.json whose images are not needed.

    Args:
      file: The transforms.json.

    Returns:
      (name, lens, (4, 4) world_to_camera) of each frame, in the order of the file.

    Raises:
      InputError: The file is damaged or lacks a key, or a lens has no size.
    """
    scene, poses = _Transforms(file), []
    for index, entry in enumerate(scene.get(scene.content, "frames", "the file", list)):
        if not isinstance(entry, dict):
            raise scene.error(f"frame {index} is not an object", "frames with transform_matrix")
        name = str(entry.get("file_path", f"frame {index}"))
        pose = scene.matrix(entry, "transform_matrix", f"frame {index} ({name})")
        poses.append((name, _lens(scene, entry, name, None), _world_to_camera(pose, file, name)))
    return poses


def _world_to_camera(pose: np.ndarray, file: Path, name: str) -> np.ndarray:
    """(4, 4) world-to-camera in OpenCV axes from camera-to-world in OpenGL axes."""
    return np.linalg.inv(make_rigid(pose * [1, -1, -1, 1], file, name))


def trained_to_source(file: Path) -> Float[np.ndarray, "4 4"]:
    """Reads where the world that nerfstudio trained and exported Gaussians in lies in the source's world.

    Args:
      file: A dataparser_transforms.json: trained = scale * (transform source).

    Returns:
      (4, 4) similarity from the trained world to the source's, before any applied_transform.

    Raises:
      InputError: The file is damaged, or holds no similarity.
    """
    transforms = _Transforms(file)
    matrix = transforms.matrix(transforms.content, "transform", "the file")
    scale = transforms.number(transforms.content, "scale", 1.0)
    if not scale > 0:
        remedy = "Copy it again from the folder of the training."
        raise transforms.error(f"scale = {scale}", "a number above 0", remedy)
    return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ make_rigid(matrix, file, "the trained world"))


def _to_source(scene: _Transforms, scale: float) -> np.ndarray:
    """(4, 4) inverse of world = applied_scale * (applied_transform source)."""
    transform = np.eye(4)
    if "applied_transform" in scene.content:
        transform = scene.matrix(scene.content, "applied_transform", "the file")
    is_bounded = is_finite_and_bounded(transform)
    scaled = np.diag([scale, scale, scale, 1.0]) @ (transform if is_bounded else np.zeros((4, 4)))
    size = np.abs(scaled[:3, :3]).max()
    turn = scaled[:3, :3] / size if size > 0 else np.zeros((3, 3))
    if not (np.linalg.det(turn) > 0 and np.allclose(turn @ turn.T, (turn @ turn.T)[0, 0] * np.eye(3), atol=1e-3)):
        problem = "applied_transform or applied_scale cannot be inverted, or shears or mirrors"
        raise scene.error(problem, "a rotation, a scale and a shift")
    return np.linalg.inv(scaled)


def _full_name(name: str, image: Path) -> str:
    """A frame's path without "./", with the image's suffix if the file omits it."""
    name = name.replace("\\", "/").removeprefix("./")
    return name if name.lower().endswith(image.suffix.lower()) else name + image.suffix


def _lens(scene: _Transforms, entry: dict[str, Any], name: str, image: Path | None) -> Lens:
    """The lens of a frame: its keys take precedence over those of the file."""
    keys = {**scene.content, **entry}
    model = str(keys.get("camera_model", "OPENCV")).upper()
    if model not in _PERSPECTIVE | _FISHEYE:
        known = ", ".join(sorted(_PERSPECTIVE | _FISHEYE))
        raise scene.error(f"camera_model {model}", f"one of {known}", "Undistort the images first.")
    if other := next((key for key in _OTHER_LENSES if keys.get(key)), None):
        problem = f"the lens of {name} is one of instant-ngp's own ({other})"
        raise scene.error(problem, "a perspective or an OpenCV fisheye lens", "Undistort the images first.")
    is_fisheye = model in _FISHEYE or keys.get("is_fisheye") is True
    if keys.get("w") is None or keys.get("h") is None:
        if image is None:
            raise scene.error(f"{name} has no size", "w and h, in the file or the frame")
        width, height = image_header(image).closest_to_centre(keys.get("cx"), keys.get("cy"))
    else:
        width, height = (round(scene.number(keys, key, 0.0)) for key in ("w", "h"))
    fx = _focal(scene, keys, "fl_x", "camera_angle_x", width)
    fy = _focal(scene, keys, "fl_y", "camera_angle_y", height)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise scene.error(f"{name} has no focal length", "fl_x or camera_angle_x, in the file or the frame")
    if min(width, height, fx, fy) <= 0:
        raise scene.error(f"{name} has {width}x{height} px and focal lengths {fx}, {fy}", "positive numbers")
    order = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = tuple(scene.number(keys, key, 0.0) for key in order)
    if model == "OPENCV" and not is_fisheye and distortion[5] != 0:
        # nerfstudio's OPENCV has k1..k4 in one polynomial; OpenCV's own k4 divides. Not the same lens: refuse to guess.
        problem = f"k4 = {keys['k4']} with camera_model OPENCV"
        raise scene.error(problem, "k1 k2 p1 p2 k3, or FULL_OPENCV", "Undistort the images first.")
    cx, cy = scene.number(keys, "cx", width / 2), scene.number(keys, "cy", height / 2)
    return Lens(width, height, fx, fy, cx, cy, distortion, is_fisheye)


def _focal(scene: _Transforms, keys: dict[str, Any], direct: str, angle: str, size: int) -> float | None:
    """A focal length, px, of a key or of a field of view."""
    if direct in keys:
        return scene.number(keys, direct, 0.0)
    if angle in keys:
        value = scene.number(keys, angle, 0.0)
        if not 0 < value < math.pi:
            raise scene.error(f"{angle} = {value}", "an angle between 0 and pi (radians)")
        return 0.5 * size / math.tan(0.5 * value)
    return None
