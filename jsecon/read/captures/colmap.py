"""COLMAP models and their images, on the host, binary or text.

Format: https://colmap.github.io/format.html and src/colmap/scene/reconstruction_io*.cc. rigs.bin and frames.bin (COLMAP
3.12 and later) are not needed, since images.bin has each image's own pose. Poses are world-to-camera in OpenCV axes,
and pixel centres lie at (0.5, 0.5): both as everywhere in jsecon. pycolmap does not read them: it is an optional
package, and ends the process on a damaged file.
"""

from __future__ import annotations

import functools
import io
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.files import path_within, read_lines, reading
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.captures.frames import PosedImage, PosedImages, pose_matrix
from jsecon.read.captures.images import find_image
from jsecon.read.captures.lens import PANORAMA, Lens, panorama_lens
from jsecon.read.registry import Reader

_MARK = "cameras.[bt][ix][nt]"
"""cameras.bin or cameras.txt, which every model has"""
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    17: (PANORAMA, 2),
}
"""camera models by their numbers in binary files: names and numbers of parameters; OpenCV does not have the others"""
_REMEDY = "Copy the model again, or export it anew with colmap model_converter."


def _read_colmap(places: Sequence[str], path: Path) -> PosedImages:
    """Reads the posed images and sparse points of the largest COLMAP model of a capture's folder, in some places.

    The images lie in images/, in the folder itself or in input/; of a folder such as sparse/0, in the images/ above it.
    """
    found = {file.parent for place in places for file in path.glob(place + _MARK)}
    found = sorted(found, key=lambda model: (not model.name.isdecimal(), len(model.name), model))
    found = [model for model in found if _model_file(model, "images").is_file()] or found
    models, notes = {model: _read_images(_model_file(model, "images")) for model in found}, []
    model, *others = sorted(models, key=lambda model: -len(models[model]))
    if others:
        largest = f"{model.relative_to(path)} with {len(models[model])} images"
        notes.append(
            f"Of {len(models)} models the largest, {largest}, is used. Join them (colmap model_merger) to use all."
        )
    lenses, images = _read_cameras(_model_file(model, "cameras")), models[model]
    above = (path.parent / "images", path.parent.parent / "images") if model == path else ()
    files = _find_images(path, [name for name, _, _ in images], above)
    split = model / "test.txt"  # the split of INRIA's training: names of images
    tested = {line.strip() for line in read_lines(split)} if split.is_file() else None
    posed = []
    for name, camera, pose in images:
        if camera not in lenses:
            raise InputError(model, f"image {name} has camera {camera}, which the cameras file lacks", remedy=_REMEDY)
        held_out = None if tested is None else name in tested
        posed.append(PosedImage(name, files.get(name), lenses[camera], pose, held_out=held_out))
    points = _read_points(file) if (file := _model_file(model, "points3D")).is_file() else ()
    return PosedImages(posed, model, *points, notes=tuple(notes), ignores_exif=True)


def _model_file(model: Path, kind: str) -> Path:
    """The binary file of a kind, or else the text file, which may be missing."""
    binary = model / f"{kind}.bin"
    return binary if binary.is_file() else binary.with_suffix(".txt")


def _find_images(path: Path, names: Sequence[str], more: Sequence[Path]) -> dict[str, Path]:
    """The image files of a model by name, in the first folder that has any."""
    for name in names:
        path_within(path / "images", name)  # a name must not lead elsewhere
    folders = (path / "images", path, path / "input", *more)
    found = ({name: file for name in names if (file := find_image(folder, name)) is not None} for folder in folders)
    return next(filter(None, found), {})


_reading = functools.partial(reading, remedy=_REMEDY, problem="the file is damaged or breaks off")
"""makes errors in reading a binary file InputErrors"""


def _take(stream: io.BufferedIOBase, form: str) -> tuple:
    """The next values of a struct format; raises struct.error at the end of the file."""
    return struct.unpack("<" + form, stream.read(struct.calcsize("<" + form)))


def _parse_lines(file: Path, layout: str, parse: Callable[[str], Any]) -> list:
    """Parses the records of a text file, a line each, but for lines of which `parse` makes None.

    A ValueError of `parse` becomes an error with the line's number and the `layout` that it should have.
    """
    records = []
    with reading(file, layout, _REMEDY):
        for number, line in enumerate(map(str.strip, read_lines(file)), start=1):
            if line and not line.startswith("#"):
                with reading(file, layout, _REMEDY, problem=f"line {number} is {line[:80]!r}"):
                    records.append(parse(line))
    return [record for record in records if record is not None]


def _lens(file: Path, model: str, width: int, height: int, parameters: tuple[float, ...]) -> Lens:
    """The lens of a camera of a model file."""
    if (model, len(parameters)) not in _MODELS.values():
        problem = f"the camera model {model} with {len(parameters)} parameters is not read"
        raise InputError(file, problem, remedy="Run colmap image_undistorter and load its output.")
    if model == PANORAMA:
        return panorama_lens(file, width, height)
    focals = 1 if model.startswith("SIMPLE_") or model in ("RADIAL", "RADIAL_FISHEYE") else 2
    fx, fy = parameters[0], parameters[focals - 1]
    cx, cy, *distortion = parameters[focals:]
    with reading(file, remedy=_REMEDY, problem="a camera cannot be read"):
        return Lens(width, height, fx, fy, cx, cy, tuple(distortion), "FISHEYE" in model)


def _read_cameras(file: Path) -> dict[int, Lens]:
    """The lenses of a model by camera number."""

    def parse(line: str) -> tuple[int, Lens]:
        number, name, width, height, *parameters = line.split()
        return int(number), _lens(file, name, int(width), int(height), tuple(map(float, parameters)))

    if file.suffix == ".txt":
        return dict(_parse_lines(file, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", parse))
    lenses = {}
    with _reading(file):
        stream = io.BytesIO(file.read_bytes())
        for _ in range(*_take(stream, "Q")):
            camera, number, width, height = _take(stream, "iiQQ")
            model, count = _MODELS.get(number, (f"number {number}", 0))
            lenses[camera] = _lens(file, model, width, height, _take(stream, f"{count}d"))
    return lenses


def _pose(numbers: tuple[float, ...]) -> np.ndarray:
    """(4, 4) world-to-camera from qw qx qy qz tx ty tz; NaN for a pose that is lost."""
    quaternion = np.array(numbers[:4], np.float64)
    if not is_finite_and_bounded(numbers) or not np.linalg.norm(quaternion) > 1e-6:
        return np.full((4, 4), np.nan)
    return pose_matrix(Rotation.from_quat(np.roll(quaternion, -1)), numbers[4:7])


def _read_images(file: Path) -> list[tuple[str, int, np.ndarray]]:
    """(name, camera number, (4, 4) float64 world-to-camera) of each image of a model, in the order of the file."""

    def parse(line: str) -> tuple[str, int, np.ndarray] | None:
        numeric = not line.strip("0123456789+-.eEnaifNAIF \t")  # with nan and inf
        if numeric and (len(line) > 1000 or len(line.split()) % 3 == 0):
            return None  # an image's second line, which some programs omit: X Y POINT3D_ID, any number of times
        _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
        return name, int(camera), _pose(tuple(map(float, (qw, qx, qy, qz, tx, ty, tz))))

    if file.suffix == ".txt":
        return _parse_lines(file, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", parse)
    images = []
    with _reading(file), file.open("rb") as stream:  # features of many photographs are larger than memory may be
        for _ in range(*_take(stream, "Q")):
            _, *numbers, camera = _take(stream, "i7di")
            start, ahead = stream.tell(), stream.read(1 << 12)
            encoded = ahead[: ahead.index(0)]
            name = encoded.decode("utf-8", "surrogateescape")
            images.append((name, camera, _pose(tuple(numbers))))
            stream.seek(start + len(encoded) + 1)
            stream.seek(24 * _take(stream, "Q")[0], 1)
            if stream.tell() > file.stat().st_size:
                raise EOFError
    return images


def _read_points(file: Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """The sparse points of a model, float64, and their colours."""
    if file.suffix == ".bin":
        return _read_binary_points(file)
    with reading(file, "POINT3D_ID X Y Z R G B ERROR TRACK", _REMEDY):
        rows = [line for line in read_lines(file) if line.strip() and not line.startswith("#")]
        table = np.loadtxt(rows, usecols=range(1, 7), ndmin=2) if rows else np.zeros((0, 6))
        if not ((table[:, 3:] >= 0) & (table[:, 3:] <= 255)).all():
            raise ValueError("its colours are not from 0 to 255")
    return table[:, :3], table[:, 3:].astype(np.uint8)


def _read_binary_points(file: Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Positions and colours of points3D.bin."""
    with _reading(file):
        raw, starts, offset = file.read_bytes(), [], 8
        # Tracks make the records differ in length: a short loop finds where each begins, NumPy reads them all.
        for _ in range(*struct.unpack_from("<Q", raw)):
            starts.append(offset)
            offset += 51 + 8 * struct.unpack_from("<Q", raw, offset + 43)[0]
        if offset > len(raw):
            raise EOFError
        places, count = np.array(starts, np.int64)[:, None], 1 << 16  # at a time: indices are larger than the points
        blocks = [places[start : start + count] for start in range(0, max(len(places), 1), count)]
        heads = np.concatenate([np.frombuffer(raw, np.uint8)[block + np.arange(8, 35)] for block in blocks])
    return np.ascontiguousarray(heads[:, :24]).view("<f8"), np.ascontiguousarray(heads[:, 24:])


def _rows(*places: str) -> tuple[Reader, ...]:
    """The readers of models in some places of a capture's folder."""
    return tuple(Reader("COLMAP", (place + _MARK,), functools.partial(_read_colmap, places)) for place in places)


READERS = _rows("sparse/*/", "sparse/")
NESTED_READERS = (*_rows("colmap/sparse/*/", "colmap/sparse/"), *_rows("colmap_text/"), *_rows(""))
"""of models in places that nerfstudio and instant-ngp use beside a transforms.json, which goes first; or no folder"""
