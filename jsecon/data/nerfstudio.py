"""nerfstudio and instant-ngp captures: transforms.json and the images it names.

Format: nerfstudio docs/quickstart/data_conventions.md, instant-ngp scripts/colmap2nerf.py. transform_matrix is
camera-to-world in OpenGL camera axes (x right, y up, looking along -z): columns 1 and 2 are negated for OpenCV axes.
The world is the file's own; Capture.to_source undoes what made it of the source's (applied_transform, _scale).
"""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jsecon.data.frames import PosedImage, PosedImages
from jsecon.data.gaussians.ply import load_point_cloud
from jsecon.data.images import find_image, image_header
from jsecon.data.lens import Lens
from jsecon.data.poses import invert_pose, make_rigid
from jsecon.errors import InputError
from jsecon.files import read_json
from jsecon.numerics import is_finite_and_bounded

MILLIMETRE = 0.001
"""nerfstudio's default depth unit, metres"""
_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE"}
_FISHEYE = {"OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")
"""keys by which instant-ngp names lenses that are neither perspective nor OpenCV's fisheye"""
_REMEDY = "Write the file anew (ns-process-data, colmap2nerf.py)."


def read_nerfstudio(file: Path) -> PosedImages:
    """The capture of a transforms.json.

    Entries whose image is not there are left out and counted in the notes. Depth maps (depth_file_path) and sparse
    points (ply_file_path) come with it where named. Raises InputError on a file that is no JSON or lacks a key, on
    camera models that are neither perspective nor fisheye, and where no image is left.
    """
    scene = _parse(file)
    entries = _key(file, scene, "frames", "the file", list)
    notes, shots, missing = [], [], []
    scale = _number(file, scene, "applied_scale", 1.0)
    for index, entry in enumerate(entries):
        where = f"frame {index}"
        if not isinstance(entry, dict):
            raise _bad(file, f"{where} that is no object", "frames with file_path and transform_matrix")
        name = _key(file, entry, "file_path", where, str)
        rows = _key(file, entry, "transform_matrix", f"{where} ({name})", list)
        pose = _matrix(file, rows, f"transform_matrix of {name}")
        if (image := find_image(file.parent, name)) is None:
            missing.append(name)
            continue
        deep = entry.get("depth_file_path") is not None
        depth = file.parent / _key(file, entry, "depth_file_path", where, str) if deep else None
        if depth is not None and not os.path.isfile(depth):
            raise _bad(depth, "no such depth map", f"the depth_file_path of {name}")
        unit = _number(file, scene, "depth_unit_scale_factor", MILLIMETRE) * scale
        lens, world_to_camera = _lens(file, scene, entry, name, image), invert_pose(pose * [1, -1, -1, 1], file, name)
        shots.append(PosedImage(_order_name(name, image), image, lens, world_to_camera, depth, unit))
    first = f" (the first: {missing[0]})" if missing else ""
    if missing:
        left_out = f"{len(missing)} of {len(entries)} frames of {file.name} were left out"
        notes.append(f"{left_out}, since their images are missing{first}.")
    if not shots:
        found, wanted = f"{len(entries)} frames, none of which has its image{first}", "images where file_path says"
        raise _bad(file, found, f"{wanted}, relative to this file", "Copy the images beside it.")
    if any("mask_path" in entry for entry in entries):
        notes.append("The masks named by mask_path (pixels to ignore) were not used.")
    to_source, points = _to_source(file, scene, scale), ()
    if scene.get("ply_file_path"):
        cloud = file.parent / _key(file, scene, "ply_file_path", "the file", str)
        if not os.path.isfile(cloud):  # False also for a name that no file can have
            raise _bad(cloud, "no such file", "the ply_file_path of transforms.json", "Check the path.")
        points = load_point_cloud(cloud)
    return PosedImages(shots, file, *points, to_source=to_source, notes=tuple(notes))


def trained_to_source(file: Path) -> Float[np.ndarray, "4 4"]:
    """From the world that nerfstudio trained and exported Gaussians in to the source's, before any applied_transform:
    the inverse of a dataparser_transforms.json, trained = scale * (transform source).

    Raises InputError where the file is damaged or holds no similarity.
    """
    told = _parse(file)
    matrix = _matrix(file, _key(file, told, "transform", "the file", list), "transform")
    scale = _number(file, told, "scale", 1.0)
    if not scale > 0:
        raise _bad(file, f"scale = {scale}", "a number above 0", "Copy it again from the folder of the training.")
    return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ make_rigid(matrix, file, "the trained world"))


def _bad(file: Path, found: str, expected: str, remedy: str = _REMEDY) -> InputError:
    return InputError(file, found, expected, remedy)


def _parse(file: Path) -> dict[str, Any]:
    scene = read_json(file, "a transforms.json", _REMEDY)
    if not isinstance(scene, dict):
        raise _bad(file, "JSON without keys", "an object with frames")
    return scene


def _key(file: Path, record: dict[str, Any], key: str, where: str, kind: type) -> Any:
    if key not in record:
        raise _bad(file, f"no key {key!r} in {where}", f"{key!r} there")
    if not isinstance(record[key], kind):
        raise _bad(file, f"{key!r} of type {type(record[key]).__name__} in {where}", kind.__name__)
    return record[key]


def _number(file: Path, record: dict[str, Any], key: str, default: float) -> float:
    value = record.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not is_finite_and_bounded(value):
        raise _bad(file, f"{key} = {value!r}", "a finite number")
    return float(value)


def _matrix(file: Path, rows: list, what: str) -> Float[np.ndarray, "4 4"]:
    """From 4 or 3 rows of 4 numbers."""
    try:
        matrix = np.array(rows, np.float64)
    except (TypeError, ValueError) as error:
        raise _bad(file, f"{what} that holds more than numbers", "4 rows of 4 numbers") from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise _bad(file, f"{what} of shape {matrix.shape}", "4 rows of 4 numbers")
    return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0, 0, 0, 1]]])


def _to_source(file: Path, scene: dict[str, Any], scale: float) -> np.ndarray:
    """world = applied_scale * (applied_transform source), inverted."""
    transform = np.eye(4)
    if "applied_transform" in scene:
        transform = _matrix(file, _key(file, scene, "applied_transform", "the file", list), "applied_transform")
    scaled = np.diag([scale, scale, scale, 1.0]) @ (transform if is_finite_and_bounded(transform) else np.zeros((4, 4)))
    size = np.abs(scaled[:3, :3]).max()
    turn = scaled[:3, :3] / size if size > 0 else np.zeros((3, 3))
    if not (np.linalg.det(turn) > 0 and np.allclose(turn @ turn.T, (turn @ turn.T)[0, 0] * np.eye(3), atol=1e-3)):
        found = "an applied_transform or applied_scale that cannot be inverted, or shears or mirrors"
        raise _bad(file, found, "a rotation, a scale and a shift")
    return np.linalg.inv(scaled)


def _order_name(name: str, image: Path) -> str:
    """The name that orders a frame and is its own: without "./", with the file's ending where it was left out."""
    name = name.replace("\\", "/").removeprefix("./")
    return name if name.lower().endswith(image.suffix.lower()) else name + image.suffix


def _lens(file: Path, scene: dict[str, Any], entry: dict[str, Any], name: str, image: Path) -> Lens:
    """Intrinsics of one frame: its own keys before the file's."""
    keys = {**scene, **entry}
    model = str(keys.get("camera_model", "OPENCV")).upper()
    if model not in _PERSPECTIVE | _FISHEYE:
        known = ", ".join(sorted(_PERSPECTIVE | _FISHEYE))
        raise _bad(file, f"camera_model {model}", f"one of {known}", "Undistort the images first.")
    if any(keys.get(key) for key in _OTHER_LENSES):
        key = next(key for key in _OTHER_LENSES if keys.get(key))
        problem = f"the lens of {name} is one of instant-ngp's own ({key})"
        raise _bad(file, problem, "a perspective or an OpenCV fisheye lens", "Undistort the images first.")
    fisheye = model in _FISHEYE or keys.get("is_fisheye") is True
    width, height = (keys.get("w"), keys.get("h"))
    if width is None or height is None:
        width, height = image_header(image).about(keys.get("cx"), keys.get("cy"))
    width, height = (round(_number(file, {key: value}, key, 0.0)) for key, value in (("w", width), ("h", height)))
    fx = _focal(file, keys, "fl_x", "camera_angle_x", width)
    fy = _focal(file, keys, "fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        raise _bad(file, f"no focal length for {name}", "fl_x or camera_angle_x, in the file or the frame")
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None or min(width, height, fx, fy) <= 0:
        raise _bad(file, f"{width}x{height} px and focal lengths {fx}, {fy} for {name}", "positive numbers")
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = tuple(_number(file, keys, key, 0.0) for key in order)
    if model == "OPENCV" and not fisheye and distortion[5] != 0:
        # nerfstudio's OPENCV has k1..k4 in one polynomial; OpenCV's own k4 divides. Not the same lens: refuse to guess.
        found = f"k4 = {keys['k4']} with camera_model OPENCV"
        raise _bad(file, found, "k1 k2 p1 p2 k3, or FULL_OPENCV", "Undistort the images first.")
    cx, cy = _number(file, keys, "cx", width / 2), _number(file, keys, "cy", height / 2)
    return Lens(width, height, fx, fy, cx, cy, distortion, fisheye)


def _focal(file: Path, keys: dict[str, Any], direct: str, angle: str, size: int) -> float | None:
    if direct in keys:
        return _number(file, keys, direct, 0.0)
    if angle in keys:
        value = _number(file, keys, angle, 0.0)
        if not 0 < value < math.pi:
            raise _bad(file, f"{angle} = {value}", "an angle between 0 and pi (radians)")
        return 0.5 * size / math.tan(0.5 * value)
    return None
