"""nerfstudio and instant-ngp captures, on the host: transforms.json and the images that it names.

INRIA's cameras.json, which lies beside a trained splat, is told from it by its content: a list of cameras.

Format: nerfstudio docs/quickstart/data_conventions.md, instant-ngp scripts/colmap2nerf.py. transform_matrix is
camera-to-world in OpenGL camera axes (x right, y up, looking along -z): columns 1 and 2 are negated for OpenCV axes.
The world is the file's own; `PosedImages.source_from_poses` undoes what made it of the source's (applied_transform,
_scale).
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jsecon.files import read_json, reading
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.captures.frames import PosedImage, PosedImages, make_rigid
from jsecon.read.captures.images import find_image, image_header, without_image_suffix
from jsecon.read.captures.lens import PANORAMA, Lens, panorama_lens
from jsecon.read.registry import Reader
from jsecon.read.splats.point_clouds import load_point_cloud
from jsecon.types import UpAxis

_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE"}
_FISHEYE = {"OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_OF_LENS = {"camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y"}
_OF_LENS |= {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "ftheta_p0", "latlong", "equirectangular"}
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
_KNOWN = {*_OF_LENS, *_SPLITS, "frames", "up", "orientation_override", "val_frames", "test_frames"}
_KNOWN |= {"applied_transform", "applied_scale"}
_KNOWN |= {"depth_unit_scale_factor", "ply_file_path", "file_path", "transform_matrix", "depth_file_path", "mask_path"}
_KNOWN |= {"aabb_scale", "scale", "offset", "colmap_im_id", "camera_id", "sharpness", "timestamp"}
"""keys that are used, or that change no number"""
_REMEDY = "Write the file anew (ns-process-data, colmap2nerf.py)."


def _read_nerfstudio(path: Path) -> PosedImages:
    """Reads the posed images of a transforms.json, or of the folder that holds one, with their depth and points.

    Of a folder in NeRF's layout, transforms_train.json has the images, and those of transforms_test.json are held out.
    """
    file = path / "transforms.json" if path.is_dir() else path
    file = file if file.is_file() else path / "transforms_train.json"
    content = read_json(file, "a transforms.json", _REMEDY)
    if isinstance(content, list):
        return _read_inria(file, content)
    images = []
    with reading(file, remedy=_REMEDY):
        tested = path / "transforms_test.json"
        if file.name == "transforms_train.json" and tested.is_file():
            content["test_frames"] = read_json(tested, "a transforms.json", _REMEDY)["frames"]
        scale = _number(content, "applied_scale", 1.0)
        unit = _number(content, "depth_unit_scale_factor", 0.001) * scale  # millimetres are nerfstudio's default
        entries, notes = _split_frames(file, content)
        for index, (entry, held_out) in enumerate(entries):
            name = entry["file_path"]
            with reading(file, remedy=_REMEDY, problem=f"frame {index} ({name}) cannot be read"):
                image = find_image(file.parent, name)
                # From OpenGL's axes of the camera to OpenCV's.
                pose = make_rigid(_matrix(entry["transform_matrix"]) * [1, -1, -1, 1], file, name)
                lens = _lens({**content, **entry}, image)
                depth, mask = (_named_file(file, entry, key) for key in ("depth_file_path", "mask_path"))
                full_name, pose = _full_name(name, image), np.linalg.inv(pose)
                images.append(PosedImage(full_name, image, lens, pose, depth, unit, held_out=held_out, mask=mask))
        up = _stated_up(content)
        source_from_poses = _source_from_world(file, content.get("applied_transform", np.eye(4)), scale)
        photographed = any(image.image is not None for image in images)  # poses alone need no points
        cloud = _named_file(file, content, "ply_file_path") if photographed else None
    points = () if cloud is None else load_point_cloud(cloud)
    return PosedImages(images, file, *points, source_from_poses=source_from_poses, notes=tuple(notes), up=up)


def _read_inria(file: Path, cameras: list[Any]) -> PosedImages:
    """The cameras of INRIA's cameras.json: position and rotation are camera-to-world, in OpenCV axes."""
    images = []
    for index, camera in enumerate(cameras):
        with reading(file, remedy="Copy it again from the folder of the training.", problem=f"camera {index} is wrong"):
            name, pose = str(camera["img_name"]), np.eye(4)
            pose[:3] = np.column_stack([camera["rotation"], camera["position"]])
            width, height, fx, fy = (_number(camera, key, 0.0) for key in ("width", "height", "fx", "fy"))
            lens = Lens(round(width), round(height), fx, fy, width / 2, height / 2)
            images.append(PosedImage(name, None, lens, np.linalg.inv(make_rigid(pose, file, name))))
    return PosedImages(images, file)


def _split_frames(file: Path, content: dict[str, Any]) -> tuple[list[tuple[dict[str, Any], bool | None]], list[str]]:
    """The frames of a file, each with whether its own split holds it out (None without a split), and notes.

    As nerfstudio does, frames that no list names are left out if the training frames and others are listed.
    """
    train, *others = ({_plain_name(name) for name in content.get(key) or ()} for key in _SPLITS)
    tested = set().union(*others) - train
    aside = [entry for key in ("val_frames", "test_frames") for entry in content.get(key) or ()]
    entries: list[tuple[dict[str, Any], bool | None]] = [(entry, True) for entry in aside]
    left_out = []
    for entry in content["frames"]:
        name = _plain_name(entry["file_path"])
        if train and tested and name not in train | tested:
            left_out.append(name)
        elif train or tested or aside:
            entries.append((entry, name in tested if tested or not train else name not in train))
        else:
            entries.append((entry, None))
    notes = []
    if left_out:
        notes.append(f"{len(left_out)} frames in no list of the split were left out (the first: {left_out[0]}).")
    records = [content, *(entry for entry, _ in entries)]
    keys = {key for record in records for key, value in record.items() if value not in (None, False, "", [])}
    if unused := sorted(keys - _KNOWN):
        notes.append(f"Keys of {file.name} that are not used: {', '.join(unused)}.")
    return entries, notes


def _plain_name(name: str) -> str:
    """A frame's path with "/", without "./" and the suffix of an image."""
    return without_image_suffix(name.replace("\\", "/").removeprefix("./"))


def _number(record: dict[str, Any], key: str, default: float) -> float:
    """An optional number."""
    value = float(record.get(key, default))
    if not is_finite_and_bounded(value):
        raise ValueError(f"{key} is {value}")
    return value


def _matrix(rows: Any) -> Float[np.ndarray, "4 4"]:
    """A matrix of 4 or 3 rows of 4 numbers; NaN for null, a pose that is lost."""
    matrix = np.full((4, 4), np.nan) if rows is None else np.array(rows, np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"its matrix has shape {matrix.shape}")
    return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0, 0, 0, 1]]])


def _named_file(file: Path, record: dict[str, Any], key: str) -> Path | None:
    """The file that an optional key names."""
    return file.parent / record[key] if record.get(key) else None


def source_from_trained(file: Path) -> Float[np.ndarray, "4 4"]:
    """Reads the similarity from the world that nerfstudio trained and exported Gaussians in to the source's world.

    The file is a dataparser_transforms.json: trained = scale * (transform source), before any applied_transform.
    """
    remedy = "Copy it again from the folder of the training."
    content = read_json(file, "a dataparser_transforms.json", remedy)
    with reading(file, remedy=remedy):
        return _source_from_world(file, content["transform"], _number(content, "scale", 1.0))


def _source_from_world(file: Path, rows: Any, scale: float) -> Float[np.ndarray, "4 4"]:
    """The inverse of world = scale * (transform source), with a rigid transform."""
    transform = make_rigid(_matrix(rows), file, "the world")
    if not (scale > 0 and np.isfinite(transform).all()):
        raise ValueError(f"the scale of its world is {scale}, or the transform has no ordinary numbers")
    return np.linalg.inv(np.diag([scale, scale, scale, 1.0]) @ transform)


def _full_name(name: str, image: Path | None) -> str:
    """A frame's path without "./", with the image's suffix if the file omits it."""
    name = name.replace("\\", "/").removeprefix("./")
    return name if image is None or name.lower().endswith(image.suffix.lower()) else name + image.suffix


def _stated_up(content: dict[str, Any]) -> UpAxis | None:
    """Which way is up in the file's world, if it says so: instant-ngp's "up", or nerfstudio's "orientation_override".

    "none" marks a world that phones (Polycam) aligned with gravity, z up, which a training must not turn.
    """
    if "up" in content:
        axis = np.array(content["up"], np.float64)
        if axis.shape != (3,) or not is_finite_and_bounded(axis) or not np.linalg.norm(axis) > 0:
            raise ValueError(f"up is {content['up']}, expected three numbers that are not all 0")
        return UpAxis(tuple((axis / np.linalg.norm(axis)).tolist()), 'the capture ("up" of its transforms)')
    if content.get("orientation_override") == "none":
        return UpAxis((0.0, 0.0, 1.0), 'gravity in the capture ("orientation_override" of its transforms)')
    return None


def _lens(keys: dict[str, Any], image: Path | None) -> Lens | None:
    """The lens of a frame by its keys and, after them, those of the file; None if neither gives its size."""
    model = str(keys.get("camera_model", "OPENCV")).upper()
    if model not in _PERSPECTIVE | _FISHEYE | {PANORAMA}:
        raise ValueError(f"camera_model {model} is not read: undistort the images first")
    if other := next((key for key in ("ftheta_p0", "latlong", "equirectangular") if keys.get(key)), None):
        raise ValueError(f"its lens is one of instant-ngp's own, {other}: undistort the images first")
    is_fisheye = model in _FISHEYE or keys.get("is_fisheye") is True
    if keys.get("w") is not None and keys.get("h") is not None:
        width, height = (round(_number(keys, key, 0.0)) for key in ("w", "h"))
    elif image is not None:
        width, height = image_header(image).upright
    else:
        return None
    if model == PANORAMA:
        return panorama_lens(image or "a frame", width, height)
    fx, fy = _focal(keys, "fl_x", "camera_angle_x", width), _focal(keys, "fl_y", "camera_angle_y", height)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise ValueError("it has no focal length: fl_x or camera_angle_x, in the file or the frame")
    order = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = tuple(_number(keys, key, 0.0) for key in order)
    if model == "OPENCV" and not is_fisheye and distortion[5] != 0:
        # nerfstudio's OPENCV has k1..k4 in one polynomial; OpenCV's own k4 divides. Not the same lens: refuse to guess.
        raise ValueError(f"k4 = {keys['k4']} with camera_model OPENCV: undistort the images first, or use FULL_OPENCV")
    cx, cy = _number(keys, "cx", width / 2), _number(keys, "cy", height / 2)
    return Lens(width, height, fx, fy, cx, cy, distortion, is_fisheye)


def _focal(keys: dict[str, Any], direct: str, angle: str, size: int) -> float | None:
    """A focal length, px, of a key or of a field of view."""
    if direct in keys:
        return _number(keys, direct, 0.0)
    if angle in keys:
        value = _number(keys, angle, 0.0)
        if not 0 < value < math.pi:
            raise ValueError(f"{angle} = {value}, which is no angle between 0 and pi (radians)")
        return 0.5 * size / math.tan(0.5 * value)
    return None


READERS = tuple(
    Reader("nerfstudio", (mark,), _read_nerfstudio) for mark in ("transforms.json", "transforms_train.json", ".json")
)
