"""The files of a COLMAP model (cameras, images, points3D), binary or text, as plain records.

Format: https://colmap.github.io/format.html and src/colmap/scene/reconstruction_io*.cc. rigs.bin and frames.bin (COLMAP
3.12 and later) are not needed, since images.bin keeps each image's own pose.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jsecon.data.lens import PROJECTIONS, Lens
from jsecon.errors import InputError
from jsecon.files import read_text
from jsecon.numerics import is_finite_and_bounded

# name -> (number in the binary format, count of parameters)
MODELS = {
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
_BY_NUMBER = {number: (name, count) for name, (number, count) in MODELS.items()}
_ONE_FOCAL = {name for name in MODELS if name.startswith("SIMPLE_")} | {"RADIAL", "RADIAL_FISHEYE"}
_UNDISTORT = "Run colmap image_undistorter and load its output."
_PERSPECTIVE_VIEWS = "Cut perspective views out of the panoramas (colmap panorama_sfm.py does) and load those."
REMEDY = "Copy the model again, or export it anew with colmap model_converter."


def bad_model(file: Path, found: str, expected: str, remedy: str = REMEDY) -> InputError:
    """What is wrong with a file of a model."""
    return InputError(file, found, expected, remedy)


def model_file(model: Path, kind: str) -> Path | None:
    return next((model / (kind + ending) for ending in (".bin", ".txt") if (model / (kind + ending)).is_file()), None)


def _existing(model: Path, kind: str) -> Path:
    file = model_file(model, kind)
    if file is None:
        raise bad_model(model, f"no {kind}.bin or {kind}.txt", "cameras, images and points3D")
    return file


class _Bytes:
    """A binary file read from front to back, with one clear error where it ends too early."""

    def __init__(self, file: Path):
        self.file, self.data, self.offset = file, file.read_bytes(), 0

    def cut(self) -> InputError:
        return bad_model(self.file, f"a file that breaks off after {len(self.data)} bytes", "the records it announces")

    def take(self, form: str) -> tuple:
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.data, self.offset - size)

    def records(self, least: int) -> range:
        """As many as are announced next, each of at least so many bytes. Raises where the file cannot hold them."""
        (count,) = self.take("Q")
        if count * least > len(self.data) - self.offset:
            raise self.cut()
        return range(count)

    def skip(self, size: int) -> None:
        if size < 0 or self.offset + size > len(self.data):
            raise self.cut()
        self.offset += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.cut()
        name, self.offset = self.data[self.offset : end], end + 1
        return name.decode("utf-8", "surrogateescape")


def _records(file: Path, expected: str, read: Callable[[str], Any], skip: Callable[[str], bool] | None = None) -> list:
    """What `read` makes of the text file's records, a line each; comments and empty lines are left out.

    `skip` tells whether the line behind a record belongs to it and is not read. Raises InputError, naming the line,
    where `read` raises ValueError.
    """
    found, behind = [], False
    for number, line in enumerate(read_text(file).split("\n"), start=1):
        line = line.strip()
        if line.startswith("#"):
            continue
        if (behind and skip is not None and skip(line)) or not line:
            behind = False
            continue
        try:
            found.append(read(line))
        except InputError:
            raise
        except ValueError as error:
            raise bad_model(file, f"line {number}: {line[:80]!r}", expected) from error
        behind = True
    return found


def _observations(line: str) -> bool:
    """Whether a line of images.txt is the second one of an image: X Y POINT3D_ID, any number of times.

    Some programs leave these lines out. An image's first line has 10 words, or more where its name has spaces.
    """
    return not line.strip("0123456789+-.eE \t") and len(line.split()) % 3 == 0


def _lens(file: Path, model: str, width: int, height: int, parameters: tuple[float, ...]) -> Lens:
    if model not in MODELS:
        known = ", ".join(name for name in MODELS if name != "EQUIRECTANGULAR")
        raise bad_model(file, f"the unknown camera model {model}", f"one of {known}", _UNDISTORT)
    if model == "EQUIRECTANGULAR":
        found = f"the camera model {model}, whose images see all around"
        raise bad_model(file, found, "cameras with a field of view below 180 degrees", _PERSPECTIVE_VIEWS)
    if len(parameters) != MODELS[model][1]:
        raise bad_model(file, f"{len(parameters)} parameters of a {model} camera", str(MODELS[model][1]))
    focals = 1 if model in _ONE_FOCAL else 2
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *distortion = parameters[focals:]
    if not (is_finite_and_bounded(parameters) and fx > 0 and fy > 0 and 0 < width < 1 << 31 and 0 < height < 1 << 31):
        found = f"a camera of {width}x{height} px with parameters {parameters}"
        raise bad_model(file, found, "positive size and focal length", "Estimate the cameras again.")
    own = model if model in PROJECTIONS else None
    return Lens(width, height, fx, fy, cx, cy, tuple(distortion), "FISHEYE" in model and own is None, own)


def read_cameras(model: Path) -> dict[int, Lens]:
    file = _existing(model, "cameras")

    def camera(line: str) -> tuple[int, Lens]:
        identity, name, width, height, *parameters = line.split()
        return int(identity), _lens(file, name, int(width), int(height), tuple(map(float, parameters)))

    if file.suffix == ".txt":
        return dict(_records(file, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", camera))
    data, lenses = _Bytes(file), {}
    for _ in data.records(48):
        identity, number, width, height = data.take("iiQQ")
        if number not in _BY_NUMBER:
            found = f"the unknown camera model number {number}"
            raise bad_model(file, found, f"one of 0 to {max(_BY_NUMBER)} (COLMAP 4.2)", _UNDISTORT)
        name, count = _BY_NUMBER[number]
        lenses[identity] = _lens(file, name, width, height, data.take(f"{count}d"))
    return lenses


def _pose(file: Path, name: str, numbers: tuple[float, ...]) -> np.ndarray:
    """(4, 4) world-to-camera from qw qx qy qz tx ty tz."""
    quaternion = np.array(numbers[:4], np.float64)
    length = np.linalg.norm(quaternion) if is_finite_and_bounded(numbers) else 0.0
    if not length > 1e-6:
        found = f"a pose of {name} with NaN, infinite or absurd numbers, or without rotation: {numbers}"
        raise bad_model(file, found, "finite poses", "Estimate the poses again, or delete this image from the model.")
    w, x, y, z = quaternion / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = numbers[4:7]
    return pose


def read_images(model: Path) -> list[tuple[str, int, np.ndarray]]:
    """(name, camera, world_to_camera) of each image."""
    file = _existing(model, "images")

    def image(line: str) -> tuple[str, int, np.ndarray]:
        _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
        return name, int(camera), _pose(file, name, tuple(map(float, (qw, qx, qy, qz, tx, ty, tz))))

    if file.suffix == ".txt":
        return _records(file, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", image, _observations)
    data, images = _Bytes(file), []
    for _ in data.records(73):
        _, *numbers, camera = data.take("i7di")
        name = data.name()
        images.append((name, camera, _pose(file, name, tuple(numbers))))
        data.skip(24 * data.take("Q")[0])
    return images


def count_images(model: Path) -> int:
    """How many images a model says that it has; 0 where it has no such file."""
    file = model_file(model, "images")
    if file is None:
        return 0
    if file.suffix == ".txt":
        return len(read_images(model))
    with file.open("rb") as stream:
        return int.from_bytes(stream.read(8), "little")


def read_points(model: Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    file = _existing(model, "points3D")
    if file.suffix == ".txt":
        rows = np.array(_records(file, "POINT3D_ID X Y Z R G B ERROR TRACK", _point), np.float64).reshape(-1, 6)
        points, colours = rows[:, :3], rows[:, 3:].astype(np.uint8)
    else:
        points, colours = _read_binary_points(file)
    if not is_finite_and_bounded(points):
        found = "points with NaN, infinite or absurd coordinates"
        raise bad_model(file, found, "finite points", "Estimate the model again.")
    return points, colours


def _point(line: str) -> tuple[float, float, float, int, int, int]:
    _, x, y, z, red, green, blue, _ = line.split(maxsplit=8)[:8]
    colour = int(red), int(green), int(blue)
    if not all(0 <= value <= 255 for value in colour):
        raise ValueError("not a colour")
    return float(x), float(y), float(z), *colour


def _read_binary_points(file: Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    data = _Bytes(file)
    fixed, raw = struct.calcsize("<Q3d3BdQ"), data.data
    count = len(data.records(fixed))
    # The tracks make the records differ in length: a short loop finds where each begins, NumPy reads them all.
    starts, offset, track = np.empty(count, np.int64), data.offset, struct.Struct("<Q")
    for index in range(count):
        if offset + fixed > len(raw):
            raise data.cut()
        starts[index] = offset
        offset += fixed + 8 * track.unpack_from(raw, offset + fixed - 8)[0]
    if offset > len(raw):
        raise data.cut()
    heads = np.frombuffer(raw, np.uint8)[starts[:, None] + np.arange(8, 35)]
    return np.ascontiguousarray(heads[:, :24]).view("<f8"), np.ascontiguousarray(heads[:, 24:])
