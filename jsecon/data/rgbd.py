"""Posed folders of depth cameras and phones: ScanNet's, TUM's, ARKitScenes', Polycam's and Record3D's.

Formats: ScanNet SensReader/python; TUM's RGB-D benchmark (file_formats); ARKitScenes DATA.md; nerfstudio process_data
polycam_utils.py and record3d_utils.py. Each keeps its own world; phones look along -z with y up.
"""

import contextlib
import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jsecon.data.frames import LEAST_FOCAL, PosedImage, PosedImages
from jsecon.data.images import MAX_PIXELS, image_header, image_size
from jsecon.data.lens import Lens
from jsecon.data.poses import invert_pose
from jsecon.errors import InputError, describe_error
from jsecon.files import READ_ERRORS, parse_json, read_text
from jsecon.numerics import is_finite_and_bounded

_TUM = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""fx fy cx cy k1 k2 p1 p2 k3 of the benchmark's cameras freiburg1 to 3, the centre of the first pixel at (0, 0)"""
_TUM_UNIT = 1 / 5000
_TOGETHER = 0.02
"""seconds between an image and the pose or depth that are taken for its own"""
_PHONE = np.diag([1.0, -1.0, -1.0, 1.0])


def find_rgbd(path: Path) -> Callable[[Path], PosedImages] | None:
    """What reads the folder, where it is one of these. It raises InputError on what is damaged, and leaves out frames
    without a pose, which it tells in the notes."""
    fits = lambda marks: all((path / mark).exists() for mark in marks)
    found = next((read for marks, read in _FOLDERS.items() if fits(marks)), None)

    def read(path: Path) -> PosedImages:
        assert found is not None
        with _reading(path), np.errstate(invalid="ignore", over="ignore"):
            return found(path)

    return read if found is not None else None


@contextlib.contextmanager
def _reading(file: Path) -> Iterator[None]:
    """Tells what goes wrong on taking numbers out of a file as an InputError."""
    try:
        yield
    except InputError:
        raise
    except READ_ERRORS as error:
        found = f"it cannot be read ({describe_error(error)})"
        raise InputError(file, found, "the numbers of its format", "Export the capture again.") from error


def _words(file: Path) -> list[list[str]]:
    lines = [line.split() for line in read_text(file).splitlines() if line.strip() and not line.startswith("#")]
    return lines or [[]]


def _rows(file: Path, columns: int, count: int = -1) -> Float[np.ndarray, "n m"]:
    with _reading(file):
        return np.array(_words(file), np.float64).reshape(count, columns)


def _images(folder: Path) -> list[Path]:
    found = [file for file in folder.iterdir() if file.suffix.lower() in (".jpg", ".jpeg", ".png")]
    found = sorted(file for file in found if not file.name.startswith("."))
    if not found:
        raise InputError(folder, "no image", "the capture's images", "Export the capture again.")
    return found


def _beside(folder: Path, stem: str, ending: str) -> Path:
    """The file of a frame, also where its ending is in upper case."""
    upper = folder / f"{stem}{ending.upper()}"
    return upper if upper.is_file() else folder / f"{stem}{ending}"


def _matrix(rotation: Rotation, translation: np.ndarray) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), translation
    return pose


def _lens(width: Any, height: Any, *numbers: Any) -> Lens:
    """Of numbers as a file has them. Raises ValueError for a frame without pixels, without a focal length, or whose
    centre lies outside of it: the numbers are then those of another size."""
    fx, fy, cx, cy = map(float, numbers)
    if not (
        1 <= width <= MAX_PIXELS
        and 1 <= height <= MAX_PIXELS
        and is_finite_and_bounded(numbers)
        and min(fx, fy) >= LEAST_FOCAL
    ):
        raise ValueError(f"a frame of {width}x{height} with focal lengths {fx:g}, {fy:g}")
    if not (0 < cx < width and 0 < cy < height):
        raise ValueError(f"a frame of {width}x{height} with its centre at {cx:g}, {cy:g}")
    return Lens(int(width), int(height), fx, fy, cx, cy)


def _shot(image: Path, lens: Lens, camera_to_world: np.ndarray, depth: Path | None = None) -> PosedImage:
    seen = None if depth is None or not depth.is_file() else depth
    return PosedImage(image.name, image, lens, invert_pose(camera_to_world, image, image.name), seen)


def _posed(path: Path, shots: list[PosedImage], count: int, *notes: str) -> PosedImages:
    lost = count - len(shots)
    told = (f"{lost} of {count} frames were left out, since they have no pose.",) if lost else ()
    return PosedImages(shots, path, notes=(*told, *notes))


def _scannet(path: Path) -> PosedImages:
    images, lenses = _images(path / "color"), {}
    for kind in ("color", "depth"):
        file = path / "intrinsic" / f"intrinsic_{kind}.txt"
        first = images[0] if kind == "color" else _beside(path / "depth", images[0].stem, ".png")
        if file.is_file() and first.is_file():
            k = _rows(file, 4, 4)
            with _reading(file):
                lenses[kind] = _lens(*image_size(first), k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    shots = []
    for image in images:
        pose = _rows(path / "pose" / f"{image.stem}.txt", 4, 4)
        if np.isfinite(pose).all():  # infinite where tracking was lost
            shot = _shot(image, lenses["color"], pose, _beside(path / "depth", image.stem, ".png"))
            shots.append(dataclasses.replace(shot, depth_lens=lenses.get("depth")))
    return _posed(path, shots, len(images))


def _listed(file: Path) -> tuple[np.ndarray, list[Path]]:
    """Times and files of TUM's lists."""
    with _reading(file):
        lines = [line for line in read_text(file).splitlines() if line.strip() and not line.startswith("#")] or [""]
        rows = [line.strip().split(maxsplit=1) for line in lines]  # a name may have spaces
        return np.array([float(row[0]) for row in rows]), [file.parent / row[1] for row in rows]


def _together(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The index of the time nearest to each that is wanted; -1 where it lies more than _TOGETHER away."""
    if not len(times):
        return np.full(len(wanted), -1)
    gap, index = KDTree(times[:, None]).query(wanted[:, None])
    return np.where(gap <= _TOGETHER, index, -1)


def _tum(path: Path) -> PosedImages:
    (times, images), poses = _listed(path / "rgb.txt"), _rows(path / "groundtruth.txt", 8)
    file = path / "intrinsics.txt"
    known = re.search(r"(?:freiburg|fr)([123])", path.resolve().name)
    if not file.is_file() and known is None:
        remedy = "Write fx fy cx cy (px) there, and k1 k2 p1 p2 k3 where the lens is distorted."
        wanted = "the camera's intrinsics, or freiburg1 to 3 in the folder's name"
        raise InputError(file, "nothing there", wanted, remedy)
    with _reading(file):
        fx, fy, cx, cy, *distortion = map(float, _words(file)[0]) if file.is_file() or not known else _TUM[known[1]]
        if len(distortion) > 8:
            raise ValueError(f"{len(distortion)} numbers behind fx fy cx cy, at most k1 k2 p1 p2 k3 k4 k5 k6 can be")
        seen = _listed(path / "depth.txt") if (path / "depth.txt").is_file() else (np.zeros(0), [])
        lens = Lens(*image_size(images[0]), fx, fy, cx + 0.5, cy + 0.5, tuple(distortion))
    shots = []
    for image, own, beside in zip(images, _together(poses[:, 0], times), _together(seen[0], times)):
        if own >= 0:
            with _reading(path / "groundtruth.txt"):
                pose = _matrix(Rotation.from_quat(poses[own, 4:]), poses[own, 1:4])
            shot = _shot(image, lens, pose, seen[1][beside] if beside >= 0 else None)
            shots.append(dataclasses.replace(shot, depth_unit=_TUM_UNIT))
    return _posed(path, shots, len(images))


def _arkitscenes(path: Path) -> PosedImages:
    images, rows = _images(path / "lowres_wide"), _rows(path / "lowres_wide.traj", 7)
    files = sorted((path / "lowres_wide_intrinsics").glob("*.pincam"))
    with _reading(path / "lowres_wide"):
        times, of_lens = (np.array([float(f.stem.rpartition("_")[2]) for f in each]) for each in (images, files))
    shots = []
    # The intrinsics of a frame can be called a millisecond earlier or later than its image.
    for image, own, lens in zip(images, _together(rows[:, 0], times), _together(of_lens, times)):
        if own >= 0 and lens >= 0:
            width, height, *numbers = _rows(files[lens], 6)[0]
            pose = _matrix(Rotation.from_rotvec(rows[own, 1:4]), rows[own, 4:])  # from the world
            depth = path / "lowres_depth" / image.name
            with _reading(files[lens]):
                shots.append(_shot(image, _lens(width, height, *numbers), np.linalg.inv(pose), depth))
    return _posed(path, shots, len(images))


def _polycam(path: Path) -> PosedImages:
    frames = path / "keyframes"
    corrected = all((frames / f"corrected_{kind}").is_dir() for kind in ("images", "cameras"))
    kind = "corrected_" if corrected else ""
    if not (frames / f"{kind}images").is_dir() or not (frames / f"{kind}cameras").is_dir():
        remedy = "Export the raw data from Polycam again, with its developer mode on."
        raise InputError(frames, "no images/ or no cameras/", "both, of a Polycam capture", remedy)
    images, shots = _images(frames / f"{kind}images"), []
    for image in images:
        file = _beside(frames / f"{kind}cameras", image.stem, ".json")
        if file.is_file():
            with _reading(file):
                told = parse_json(file.read_bytes())
                size = _polycam_size(told, _beside(frames / "cameras", image.stem, ".json"), image)
                lens = _lens(*size, *(told[name] for name in ("fx", "fy", "cx", "cy")))
                pose = np.array([[told[f"t_{i}{j}"] for j in range(4)] for i in range(3)] + [[0, 0, 0, 1]], np.float64)
            shots.append(_shot(image, lens, pose @ _PHONE, _beside(frames / "depth", image.stem, ".png")))
    return _posed(path, shots, len(images))


def _polycam_size(told: Any, uncorrected: Path, image: Path) -> tuple[Any, Any]:
    """(width, height) that a camera's numbers are for: as its file says, or that of the image before its correction, or
    else the image's own. Recent corrected_cameras/ have no sizes; the images can be smaller than their numbers say."""
    if "width" in told and "height" in told:
        return told["width"], told["height"]
    own = image_header(image).about(told.get("cx"), told.get("cy"))
    before = parse_json(uncorrected.read_bytes()) if uncorrected.is_file() else {}
    width, height = before.get("width", own[0]), before.get("height", own[1])
    return (width, height) if abs(width * own[1] - height * own[0]) <= max(width, height) else own


def _record3d(path: Path) -> PosedImages:
    unpacked = (path / "rgbd").is_dir()  # a .r3d is an archive
    images, shots = _images(path / ("rgbd" if unpacked else "rgb")), []
    file = path / ("metadata" if unpacked else "metadata.json")
    with _reading(file):
        told = parse_json(file.read_bytes())
        k = told["K"]  # by columns
        numbers = told.get("perFrameIntrinsicCoeffs") or [(k[0], k[4], k[6], k[7])] * len(told["poses"])
        poses = np.array(told["poses"], np.float64).reshape(-1, 7)
        for image in images:
            n = int(image.stem)
            if n < len(poses):
                pose = _matrix(Rotation.from_quat(poses[n, :4]), poses[n, 4:]) @ _PHONE
                size = (told["w"], told["h"]) if "w" in told and "h" in told else image_size(image)
                shots.append(_shot(image, _lens(*size, *numbers[n]), pose))
    return _posed(path, shots, len(images), "Record3D's depth was not read: it has a compression of its own.")


_FOLDERS: dict[tuple[str, ...], Callable[[Path], PosedImages]] = {
    ("color", "pose", "intrinsic/intrinsic_color.txt"): _scannet,
    ("rgb.txt", "groundtruth.txt"): _tum,
    ("lowres_wide", "lowres_wide.traj"): _arkitscenes,
    ("keyframes",): _polycam,
    ("rgb", "metadata.json"): _record3d,
    ("rgbd", "metadata"): _record3d,
}
"""what a folder holds -> what reads it"""
