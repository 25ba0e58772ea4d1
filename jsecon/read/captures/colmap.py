"""COLMAP captures, a model and its images, on the host: read (binary or text) and written (binary).

Format: https://colmap.github.io/format.html and src/colmap/scene/reconstruction_io*.cc. rigs.bin and frames.bin (COLMAP
3.12 and later) are not needed, since images.bin has each image's own pose. Poses are world-to-camera in OpenCV axes,
and pixel centres lie at (0.5, 0.5): both as everywhere in jsecon. pycolmap does not read them: it is an optional
package, and ends the process on a damaged file.
"""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.files import atomic_write, path_within, read_text
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.captures.coordinates import transform_poses
from jsecon.read.captures.frames import PosedImage, PosedImages
from jsecon.read.captures.images import find_image, write_image
from jsecon.read.captures.lens import PROJECTIONS, Lens
from jsecon.types import Capture

_MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "FOV": (7, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "THIN_PRISM_FISHEYE": (10, 12),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),
    "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EUCM": (16, 6),
    "EQUIRECTANGULAR": (17, 2),
}
"""camera model -> its number in binary files, and its number of parameters"""
_MODEL_OF_NUMBER = {number: (name, count) for name, (number, count) in _MODELS.items()}
_ONE_FOCAL = {name for name in _MODELS if name.startswith("SIMPLE_")} | {"RADIAL", "RADIAL_FISHEYE"}
_REMEDY = "Copy the model again, or export it anew with colmap model_converter."
_UNDISTORT = "Run colmap image_undistorter and load its output."
_POINT_HEAD = struct.calcsize("<Q3d3BdQ")
"""bytes of a point before its track"""


def find_models(path: str | Path) -> list[Path]:
    """Finds the COLMAP models of a capture.

    They lie in sparse/0, sparse/1, ... or in sparse itself. If there is none and no transforms.json, colmap/sparse,
    colmap_text and the capture's own folder are searched, as nerfstudio and instant-ngp lay them out.

    Args:
      path: Folder of the capture.

    Returns:
      Folders of the models, the one with the most images first.
    """
    path = Path(path)
    models = _models_in(path / "sparse")
    if not models and not (path / "transforms.json").exists():
        places = (path / "colmap" / "sparse", path / "colmap_text", path)
        models = next(filter(None, map(_models_in, places)), [])
    return models


def _models_in(folder: Path) -> list[Path]:
    """The models in a folder or, if it is called sparse, in its subfolders, the one with the most images first."""
    if not folder.is_dir():
        return []
    inner = [child for child in folder.iterdir() if child.is_dir()] if folder.name == "sparse" else []
    inner.sort(key=lambda child: (not child.name.isdecimal(), len(child.name), child.name))
    models = [place for place in (*inner, folder) if _model_file(place, "cameras") is not None]
    return sorted(models, key=_count_images, reverse=True) if len(models) > 1 else models


def _model_file(model: Path, kind: str) -> Path | None:
    """The binary or text file of a kind, or None."""
    return next((model / (kind + ending) for ending in (".bin", ".txt") if (model / (kind + ending)).is_file()), None)


def _require_file(model: Path, kind: str) -> Path:
    """The binary or text file of a kind."""
    file = _model_file(model, kind)
    if file is None:
        raise InputError(model, f"it has no {kind}.bin or {kind}.txt", remedy=_REMEDY)
    return file


def read_colmap(path: Path, models: Sequence[Path]) -> PosedImages:
    """Reads a COLMAP capture.

    Args:
      path: Folder of the capture; its images lie in images/, in it or in input/.
      models: Its models; the first is read.

    Returns:
      Its posed images and sparse points.

    Raises:
      InputError: The model is damaged, names images that are missing, or has EQUIRECTANGULAR cameras.
    """
    model = models[0]
    lenses, images = read_cameras(model), read_images(model)
    files = _find_images(path, [name for name, _, _ in images])
    if missing := [name for name, _, _ in images if name not in files]:
        problem = f"{len(missing)} of {len(images)} images of the model are missing (the first: {missing[0]})"
        remedy = "Copy them there, or take them out of the model (colmap image_deleter)."
        raise InputError(path / "images", problem, remedy=remedy)
    shots = []
    for name, camera, pose in images:
        if camera not in lenses:
            raise InputError(model, f"image {name} has camera {camera}, which the cameras file lacks", remedy=_REMEDY)
        shots.append(PosedImage(name, files[name], lenses[camera], pose))
    notes = []
    if len(models) > 1:
        others = ", ".join(f"{place.relative_to(path)} with {_count_images(place)}" for place in models[1:])
        notes.append(
            f"There are {len(models)} models. {model.relative_to(path)} has the most images, {len(images)}, and is used"
            f"; left out: {others}. Join them (colmap model_merger), or take photographs between them, to use all."
        )
    if _model_file(model, "points3D") is None:
        notes.append("The model has no points3D file: there are no sparse points.")
        return PosedImages(shots, model, notes=tuple(notes))
    return PosedImages(shots, model, *_read_points(model), notes=tuple(notes))


def _find_images(path: Path, names: Sequence[str]) -> dict[str, Path]:
    """The image files of a model by name: all in one folder, else those in the first that has any."""
    for name in names:
        path_within(path / "images", name)  # a name must not lead elsewhere
    some: dict[str, Path] = {}
    for folder in (path / "images", path, path / "input"):
        files = {name: file for name in names if (file := find_image(folder, name)) is not None}
        if len(files) == len(set(names)):
            return files
        some = some or files
    return some


class _BinaryReader:
    """Reads a binary file from front to back, with one clear error if it ends too early."""

    def __init__(self, file: Path):
        self.file, self.data, self.offset = file, file.read_bytes(), 0

    def truncated(self) -> InputError:
        """The error of a file that ends too early."""
        return InputError(self.file, f"the file breaks off after {len(self.data)} bytes", remedy=_REMEDY)

    def take(self, form: str) -> tuple:
        """The next values of a struct format."""
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.data, self.offset - size)

    def records(self, min_size: int) -> range:
        """As many records as the file announces next; checks that so many of `min_size` bytes fit."""
        (count,) = self.take("Q")
        if count * min_size > len(self.data) - self.offset:
            raise self.truncated()
        return range(count)

    def skip(self, size: int) -> None:
        """Skips bytes."""
        if size < 0 or self.offset + size > len(self.data):
            raise self.truncated()
        self.offset += size

    def name(self) -> str:
        """The next text, up to a zero byte."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.truncated()
        name, self.offset = self.data[self.offset : end], end + 1
        return name.decode("utf-8", "surrogateescape")


def _parse_lines(
    file: Path, layout: str, parse: Callable[[str], Any], is_continuation: Callable[[str], bool] | None = None
) -> list:
    """Parses the records of a text file, a line each.

    A line after a record is skipped if `is_continuation` holds. A ValueError of `parse` becomes an error with the
    line's number and the `layout` that it should have.
    """
    records, follows = [], False
    for number, line in enumerate(read_text(file).split("\n"), start=1):
        line = line.strip()
        if line.startswith("#"):
            continue
        if (follows and is_continuation is not None and is_continuation(line)) or not line:
            follows = False
            continue
        try:
            records.append(parse(line))
        except InputError:
            raise
        except ValueError as error:
            raise InputError(file, f"line {number} is {line[:80]!r}", layout, _REMEDY) from error
        follows = True
    return records


def _lens(file: Path, model: str, width: int, height: int, parameters: tuple[float, ...]) -> Lens:
    """The lens of a camera of a model file."""
    if model not in _MODELS:
        known = ", ".join(name for name in _MODELS if name != "EQUIRECTANGULAR")
        raise InputError(file, f"the camera model {model} is unknown", f"one of {known}", _UNDISTORT)
    if model == "EQUIRECTANGULAR":
        remedy = "Cut perspective views out of the panoramas (colmap panorama_sfm.py does) and load those."
        raise InputError(file, f"the camera model {model} sees all around, which is not supported", remedy=remedy)
    if len(parameters) != _MODELS[model][1]:
        raise InputError(file, f"a {model} camera has {len(parameters)} parameters", str(_MODELS[model][1]), _REMEDY)
    focals = 1 if model in _ONE_FOCAL else 2
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *distortion = parameters[focals:]
    is_valid = fx > 0 and fy > 0 and 0 < width < 1 << 31 and 0 < height < 1 << 31
    if not (is_finite_and_bounded(parameters) and is_valid):
        problem = f"a camera of {width}x{height} px has the parameters {parameters}"
        raise InputError(file, problem, "positive size and focal length", "Estimate the cameras again.")
    projection = model if model in PROJECTIONS else None
    is_fisheye = "FISHEYE" in model and projection is None
    return Lens(width, height, fx, fy, cx, cy, tuple(distortion), is_fisheye, projection)


def read_cameras(model: Path) -> dict[int, Lens]:
    """Reads the lenses of a model.

    Args:
      model: Folder of the model.

    Returns:
      Lenses by camera number.

    Raises:
      InputError: The file is missing or damaged, or a lens sees all around.
    """
    file = _require_file(model, "cameras")

    def parse(line: str) -> tuple[int, Lens]:
        number, name, width, height, *parameters = line.split()
        return int(number), _lens(file, name, int(width), int(height), tuple(map(float, parameters)))

    if file.suffix == ".txt":
        return dict(_parse_lines(file, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", parse))
    data, lenses = _BinaryReader(file), {}
    for _ in data.records(48):
        camera, number, width, height = data.take("iiQQ")
        if number not in _MODEL_OF_NUMBER:
            expected = f"one of 0 to {max(_MODEL_OF_NUMBER)} (COLMAP 4.2)"
            raise InputError(file, f"the unknown camera model number {number}", expected, _UNDISTORT)
        name, count = _MODEL_OF_NUMBER[number]
        lenses[camera] = _lens(file, name, width, height, data.take(f"{count}d"))
    return lenses


def _pose(file: Path, name: str, numbers: tuple[float, ...]) -> np.ndarray:
    """(4, 4) world-to-camera from qw qx qy qz tx ty tz."""
    quaternion = np.array(numbers[:4], np.float64)
    length = np.linalg.norm(quaternion) if is_finite_and_bounded(numbers) else 0.0
    if not length > 1e-6:
        problem = f"the pose of {name} has NaN, infinite or absurd numbers, or no rotation: {numbers}"
        raise InputError(file, problem, remedy="Estimate the poses again, or delete this image from the model.")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    pose[:3, 3] = numbers[4:7]
    return pose


def read_images(model: Path) -> list[tuple[str, int, np.ndarray]]:
    """Reads the images of a model.

    Args:
      model: Folder of the model.

    Returns:
      (name, camera number, (4, 4) float64 world_to_camera) of each image, in the order of the file.

    Raises:
      InputError: The file is missing or damaged.
    """
    file = _require_file(model, "images")

    def parse(line: str) -> tuple[str, int, np.ndarray]:
        _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
        return name, int(camera), _pose(file, name, tuple(map(float, (qw, qx, qy, qz, tx, ty, tz))))

    if file.suffix == ".txt":
        return _parse_lines(file, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", parse, _are_observations)
    data, images = _BinaryReader(file), []
    for _ in data.records(73):
        _, *numbers, camera = data.take("i7di")
        name = data.name()
        images.append((name, camera, _pose(file, name, tuple(numbers))))
        data.skip(24 * data.take("Q")[0])
    return images


def _are_observations(line: str) -> bool:
    """Whether a line of images.txt is the second one of an image: X Y POINT3D_ID, any number of times.

    Some programs omit these lines. An image's first line has 10 words, or more if its name has spaces.
    """
    return not line.strip("0123456789+-.eE \t") and len(line.split()) % 3 == 0


def _count_images(model: Path) -> int:
    """Number of images of a model; 0 if the file is missing."""
    file = _model_file(model, "images")
    if file is None:
        return 0
    if file.suffix == ".txt":
        return len(read_images(model))
    with file.open("rb") as stream:
        return int.from_bytes(stream.read(8), "little")


def _read_points(model: Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Reads the sparse points of a model, float64, and their colours."""
    file = _require_file(model, "points3D")
    if file.suffix == ".txt":
        rows = _parse_lines(file, "POINT3D_ID X Y Z R G B ERROR TRACK", _parse_point)
        table = np.array(rows, np.float64).reshape(-1, 6)
        points, colours = table[:, :3], table[:, 3:].astype(np.uint8)
    else:
        points, colours = _read_binary_points(file)
    if not is_finite_and_bounded(points):
        raise InputError(file, "points have NaN, infinite or absurd coordinates", remedy="Estimate the model again.")
    return points, colours


def _parse_point(line: str) -> tuple[float, float, float, int, int, int]:
    """Position and colour of a line of points3D.txt."""
    _, x, y, z, red, green, blue, _ = line.split(maxsplit=8)[:8]
    colour = int(red), int(green), int(blue)
    if not all(0 <= value <= 255 for value in colour):
        raise ValueError("not a colour")
    return float(x), float(y), float(z), *colour


def _read_binary_points(file: Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Positions and colours of points3D.bin."""
    data = _BinaryReader(file)
    raw, count = data.data, len(data.records(_POINT_HEAD))
    # Tracks make the records differ in length: a short loop finds where each begins, NumPy reads them all.
    starts, offset, track = np.empty(count, np.int64), data.offset, struct.Struct("<Q")
    for index in range(count):
        if offset + _POINT_HEAD > len(raw):
            raise data.truncated()
        starts[index] = offset
        offset += _POINT_HEAD + 8 * track.unpack_from(raw, offset + _POINT_HEAD - 8)[0]
    if offset > len(raw):
        raise data.truncated()
    heads = np.frombuffer(raw, np.uint8)[starts[:, None] + np.arange(8, 35)]
    return np.ascontiguousarray(heads[:, :24]).view("<f8"), np.ascontiguousarray(heads[:, 24:])


def write_colmap(capture: Capture, path: str | Path, *, image_format: str = "png") -> None:
    """Writes a capture for COLMAP, in the world of the poses that it was loaded from.

    Points keep their colours; observations and tracks are empty and errors -1 (not computed), since a Capture has none.
    The format has no place for depths and held-out frames: hold frames out again on loading.

    Args:
      capture: The capture.
      path: Folder for sparse/0/{cameras,images,points3D}.bin (PINHOLE) and images/.
      image_format: Suffix of the images.

    Raises:
      InputError: The folder cannot be written.
    """
    path, cameras = Path(path), capture.cameras
    intrinsics = np.stack([cameras.fx, cameras.fy, cameras.cx, cameras.cy], axis=-1).astype(np.float64)
    distinct, camera_of = np.unique(intrinsics, axis=0, return_inverse=True)
    names = [f"{name}.{image_format.lstrip('.')}" for name in capture.names]
    files = [path_within(path / "images", name) for name in names]
    for file, frame in zip(files, np.asarray(capture.frames)):
        write_image(file, frame)
    camera_bytes = [struct.pack("<Q", len(distinct))]
    camera_bytes += [
        struct.pack("<iiQQ4d", n, _MODELS["PINHOLE"][0], cameras.width, cameras.height, *row)
        for n, row in enumerate(distinct, start=1)
    ]
    image_bytes = [struct.pack("<Q", len(names))]
    poses_from_scene = (
        np.eye(4) if capture.poses_from_scene is None else np.asarray(capture.poses_from_scene, np.float64)
    )
    poses = transform_poses(np.asarray(cameras.world_to_camera, np.float64), poses_from_scene)
    for n, (name, pose, camera) in enumerate(zip(names, poses, camera_of.ravel()), start=1):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
        numbers = itertools.chain(quaternion, pose[:3, 3])
        head = struct.pack("<i7di", n, *numbers, camera + 1)
        image_bytes.append(head + os.fsencode(name) + b"\0" + struct.pack("<Q", 0))
    points = np.zeros(len(capture.points), "<u8, 3<f8, 3u1, <f8, <u8")
    points["f0"] = np.arange(1, len(points) + 1)
    points["f1"] = np.asarray(capture.points, np.float64) @ poses_from_scene[:3, :3] + poses_from_scene[:3, 3]
    points["f2"], points["f3"] = capture.point_colors, -1.0
    contents = {
        "cameras": b"".join(camera_bytes),
        "images": b"".join(image_bytes),
        "points3D": struct.pack("<Q", len(points)) + points.tobytes(),
    }
    for kind, content in contents.items():
        with atomic_write(path / "sparse" / "0" / f"{kind}.bin") as temporary:
            temporary.write_bytes(content)
