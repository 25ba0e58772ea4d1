"""COLMAP models, binary and text, with their images; and a writer of them.

Format: https://colmap.github.io/format.html and src/colmap/scene/reconstruction_io*.cc. Poses are world-to-camera in OpenCV
axes, and pixel centres lie at (0.5, 0.5): both as everywhere in jsecon. rigs.bin and frames.bin (COLMAP 3.12 and later) are not
needed, since images.bin keeps each image's own pose.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from jsecon.data.frames import Progress, Shot, assemble, check_options
from jsecon.data.images import write_image
from jsecon.data.lens import Lens
from jsecon.errors import InputError
from jsecon.files import written_whole
from jsecon.types import Array, Capture

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
}
_BY_NUMBER = {number: (name, count) for name, (number, count) in MODELS.items()}
_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_REMEDY = "Copy the model again, or export it anew with colmap model_converter."


def find_model(path: str | Path) -> Path | None:
    """The folder of the model below a capture: sparse/0, sparse, or None."""
    for folder in (Path(path) / "sparse" / "0", Path(path) / "sparse"):
        if any((folder / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
            return folder
    return None


def load_colmap(
    path: str | Path,
    *,
    downscale: float | None = None,
    frames: int | None = None,
    holdout: int | None = 8,
    progress: Progress = None,
) -> Capture:
    """A COLMAP capture: `path`/sparse/0 (or sparse) and `path`/images. Options as in `jsecon.data.capture.load_capture`.

    Every camera model that OpenCV can undistort is read. Raises InputError on a model that is cut short or names images that
    are not there, and on the models FOV and THIN_PRISM_FISHEYE.
    """
    path = Path(path)
    check_options(downscale, frames, holdout)
    model = find_model(path)
    if model is None:
        raise InputError(
            path,
            found="no COLMAP model",
            expected="sparse/0/cameras.bin (or .txt)",
            remedy="Run colmap mapper, and keep its output in sparse/0 beside images/.",
        )
    lenses, notes = _read_cameras(model), []
    images = _read_images(model)
    missing = [name for name, _, _ in images if not (path / "images" / name).is_file()]
    if missing:
        raise InputError(
            path / "images",
            found=f"{len(missing)} of {len(images)} images of the model missing (the first: {missing[0]})",
            expected="every image that the model names",
            remedy="Copy them there, or take them out of the model (colmap image_deleter).",
        )
    shots = []
    for name, camera, pose in images:
        if camera not in lenses:
            raise InputError(
                model,
                found=f"image {name} of camera {camera}, which is not in the cameras file",
                expected="cameras and images of one model",
                remedy=_REMEDY,
            )
        shots.append(Shot(name, path / "images" / name, lenses[camera], pose))
    if _file(model, "points3D") is None:
        notes.append("The model has no points3D file: there are no sparse points.")
        points, colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    else:
        points, colours = _read_points(model)
    return assemble(
        shots,
        points,
        colours,
        where=model,
        downscale=downscale,
        frames=frames,
        holdout=holdout,
        notes=notes,
        progress=progress,
    )


def _file(model: Path, kind: str) -> Path | None:
    return next((model / (kind + ending) for ending in (".bin", ".txt") if (model / (kind + ending)).is_file()), None)


def _existing(model: Path, kind: str) -> Path:
    file = _file(model, kind)
    if file is None:
        raise InputError(
            model, found=f"no {kind}.bin or {kind}.txt", expected="cameras, images and points3D", remedy=_REMEDY
        )
    return file


class _Bytes:
    """A binary file read from front to back, with one clear error where it ends too early."""

    def __init__(self, file: Path):
        self.file, self.data, self.offset = file, file.read_bytes(), 0

    def cut(self) -> InputError:
        return InputError(
            self.file,
            found=f"a file that breaks off after {len(self.data)} bytes",
            expected="the records it announces",
            remedy=_REMEDY,
        )

    def take(self, form: str) -> tuple:
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.data, self.offset - size)

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


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """(number, text) of each line but comments. Empty lines stay: an image without observations has one."""
    text = file.read_text(encoding="utf-8", errors="surrogateescape")
    return ((n, line) for n, line in enumerate(text.split("\n"), start=1) if not line.lstrip().startswith("#"))


def _bad_line(file: Path, number: int, line: str, expected: str) -> InputError:
    return InputError(file, found=f"line {number}: {line.strip()[:80]!r}", expected=expected, remedy=_REMEDY)


def _lens(file: Path, model: str, width: int, height: int, parameters: tuple[float, ...]) -> Lens:
    if model not in MODELS or model in ("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"):
        raise InputError(
            file,
            found=f"camera model {model}",
            expected="one that OpenCV can undistort: "
            + ", ".join(name for name, (number, _) in MODELS.items() if number not in (7, 10, 11)),
            remedy="Run colmap image_undistorter and load its output.",
        )
    if len(parameters) != MODELS[model][1]:
        raise InputError(
            file,
            found=f"{len(parameters)} parameters of a {model} camera",
            expected=str(MODELS[model][1]),
            remedy=_REMEDY,
        )
    focals = 1 if model in _ONE_FOCAL else 2
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *distortion = parameters[focals:]
    if not (np.isfinite(parameters).all() and fx > 0 and fy > 0 and width > 0 and height > 0):
        raise InputError(
            file,
            found=f"a camera of {width}x{height} px with parameters {parameters}",
            expected="positive size and focal length",
            remedy="Estimate the cameras again.",
        )
    return Lens(width, height, fx, fy, cx, cy, tuple(distortion), fisheye="FISHEYE" in model)


def _read_cameras(model: Path) -> dict[int, Lens]:
    file = _existing(model, "cameras")
    lenses = {}
    if file.suffix == ".txt":
        for number, line in _lines(file):
            if not line.strip():
                continue
            try:
                identity, name, width, height, *parameters = line.split()
                lenses[int(identity)] = _lens(file, name, int(width), int(height), tuple(map(float, parameters)))
            except InputError:
                raise
            except ValueError as error:
                raise _bad_line(file, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from error
        return lenses
    data = _Bytes(file)
    for _ in range(data.take("Q")[0]):
        identity, number, width, height = data.take("iiQQ")
        if number not in _BY_NUMBER:
            raise InputError(
                file,
                found=f"camera model number {number}",
                expected=f"one of 0 to {max(_BY_NUMBER)}",
                remedy="Run colmap image_undistorter and load its output.",
            )
        name, count = _BY_NUMBER[number]
        lenses[identity] = _lens(file, name, width, height, data.take(f"{count}d"))
    return lenses


def _pose(file: Path, name: str, numbers: tuple[float, ...]) -> np.ndarray:
    """(4, 4) world-to-camera from qw qx qy qz tx ty tz."""
    quaternion = np.array(numbers[:4], np.float64)
    length = np.linalg.norm(quaternion)
    if not np.isfinite(numbers).all() or not length > 1e-6:
        raise InputError(
            file,
            found=f"a pose of {name} with NaN or infinite numbers, or without rotation: {numbers}",
            expected="finite poses",
            remedy="Estimate the poses again, or delete this image from the model.",
        )
    w, x, y, z = quaternion / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = numbers[4:7]
    return pose


def _read_images(model: Path) -> list[tuple[str, int, np.ndarray]]:
    """(name, camera, world_to_camera) of each image."""
    file = _existing(model, "images")
    images = []
    if file.suffix == ".txt":
        lines = _lines(file)
        for number, line in lines:
            if not line.strip():
                continue
            try:
                _, *numbers, camera, name = line.strip().split(maxsplit=9)
                images.append((name, int(camera), _pose(file, name, tuple(map(float, numbers)))))
            except InputError:
                raise
            except ValueError as error:
                raise _bad_line(file, number, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from error
            if len(numbers) != 7:
                raise _bad_line(file, number, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
            next(lines, None)  # the observations
        return images
    data = _Bytes(file)
    for _ in range(data.take("Q")[0]):
        _, *numbers, camera = data.take("i7di")
        name = data.name()
        images.append((name, camera, _pose(file, name, tuple(numbers))))
        data.skip(24 * data.take("Q")[0])
    return images


def _read_points(model: Path) -> tuple[Float[Array, "p 3"], UInt8[Array, "p 3"]]:
    file = _existing(model, "points3D")
    if file.suffix == ".txt":
        points, colours = [], []
        for number, line in _lines(file):
            if not line.strip():
                continue
            try:
                _, x, y, z, *rgb, _ = line.split(maxsplit=8)[:8]
                points.append((float(x), float(y), float(z)))
                colours.append(tuple(map(int, rgb)))
                if len(rgb) != 3 or not all(0 <= value <= 255 for value in colours[-1]):
                    raise ValueError("not a colour")
            except ValueError as error:
                raise _bad_line(file, number, line, "POINT3D_ID X Y Z R G B ERROR TRACK") from error
        points, colours = np.array(points, np.float64).reshape(-1, 3), np.array(colours, np.uint8).reshape(-1, 3)
    else:
        points, colours = _read_binary_points(file)
    if not np.isfinite(points).all():
        raise InputError(
            file,
            found="sparse points with NaN or infinite coordinates",
            expected="finite points",
            remedy="Estimate the model again.",
        )
    return points, colours


def _read_binary_points(file: Path) -> tuple[Float[Array, "p 3"], UInt8[Array, "p 3"]]:
    data = _Bytes(file)
    (count,) = data.take("Q")
    fixed, raw = struct.calcsize("<Q3d3BdQ"), data.data
    if count * fixed > len(raw):
        raise data.cut()
    # The tracks make the records differ in length: a short loop finds where each begins, NumPy reads them all.
    starts, offset, track = np.empty(count, np.int64), data.offset, struct.Struct("<Q")
    for index in range(count):
        starts[index] = offset
        if offset + fixed > len(raw):
            raise data.cut()
        offset += fixed + 8 * track.unpack_from(raw, offset + fixed - 8)[0]
    if offset > len(raw):
        raise data.cut()
    heads = np.frombuffer(raw, np.uint8)[starts[:, None] + np.arange(8, 35)]
    return np.ascontiguousarray(heads[:, :24]).view("<f8"), np.ascontiguousarray(heads[:, 24:])


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz, w >= 0: the eigenvector of Bar-Itzhack's matrix, which has no singular case."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    quaternion = np.linalg.eigh(matrix)[1][:, -1]
    return -quaternion if quaternion[0] < 0 else quaternion


def write_colmap(capture: Capture, path: str | Path, *, image_format: str = "png") -> None:
    """Writes `capture` as a COLMAP capture: `path`/sparse/0/{cameras,images,points3D}.bin (PINHOLE) and `path`/images.

    The points keep their colours; observations and tracks are empty and errors -1 (not computed), since a Capture holds
    none. Depths and the held-out frames have no place in the format: choose the latter again on loading. Raises InputError
    where the folder cannot be written.
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
    for n, (file, pose, camera) in enumerate(
        zip(files, np.asarray(cameras.world_to_camera, np.float64), which.ravel()), start=1
    ):
        numbers = itertools.chain(_quaternion(pose[:3, :3]), pose[:3, 3])
        image_bytes.append(struct.pack("<i7di", n, *numbers, camera + 1) + file.encode() + b"\0" + struct.pack("<Q", 0))
    points = np.zeros(len(capture.points), "<u8, 3<f8, 3u1, <f8, <u8")
    points["f0"] = np.arange(1, len(points) + 1)
    points["f1"], points["f2"], points["f3"] = capture.points, capture.point_colors, -1.0
    contents = {
        "cameras": b"".join(camera_bytes),
        "images": b"".join(image_bytes),
        "points3D": struct.pack("<Q", len(points)) + points.tobytes(),
    }
    for kind, content in contents.items():
        with written_whole(path / "sparse" / "0" / f"{kind}.bin") as temporary:
            temporary.write_bytes(content)
