"""Captures of depth cameras and phones, on the host: ScanNet, Replica, TUM, ARKitScenes, Polycam, Record3D.

Formats: ScanNet SensReader/python; NICE-SLAM's renders of Replica; TUM's RGB-D benchmark (file_formats); ARKitScenes
DATA.md; nerfstudio process_data polycam_utils.py and record3d_utils.py.
Each keeps its world. Phones look along -z of their own axes, and gravity is along an axis of their worlds: y of Polycam
and Record3D, z of ARKitScenes. A frame without a pose gets one that is not finite, and is left out later.
"""

import functools
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.files import parse_json, read_json, read_lines, reading
from jsecon.read.captures.frames import PosedImage, PosedImages, make_rigid, pose_matrix
from jsecon.read.captures.images import find_image, image_header
from jsecon.read.captures.lens import Lens
from jsecon.read.registry import Reader
from jsecon.types import UpAxis

_TUM_INTRINSICS = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""fx fy cx cy k1 k2 p1 p2 k3 of the benchmark's cameras freiburg1 to 3, the centre of the first pixel at (0, 0)"""
_PHONE_AXES = np.array([1.0, -1.0, -1.0, 1.0])
"""signs of the columns of a pose, from the axes of phones: a product of matrices would warn of infinite numbers"""
_LOST = np.full((4, 4), np.nan)
"""the pose of a frame of which the tracker lost it"""
_EXPORT = "Export the capture again."
_parsing = functools.partial(reading, remedy=_EXPORT)
"""makes errors in parsing a file InputErrors"""
_in_metres = functools.partial(PosedImages, metres_per_unit=1.0)
"""makes a capture of its images and its folder: all of these sensors measure metres"""


def _lines(file: Path) -> list[str]:
    """Lines of a text file that are neither empty nor comments."""
    return [line for line in read_lines(file) if line.strip() and not line.startswith("#")]


def _numbers(file: Path, columns: int, rows: int = -1) -> Float[np.ndarray, "n m"]:
    """The table of numbers of a text file."""
    with _parsing(file):
        return np.array([line.split() for line in _lines(file)] or [[]], np.float64).reshape(rows, columns)


def _list_images(folder: Path) -> list[Path]:
    """The images of a folder, of which there must be some."""
    images = [file for file in folder.iterdir() if file.suffix.lower() in (".jpg", ".jpeg", ".png")]
    images = sorted(file for file in images if not file.name.startswith("."))
    if not images:
        raise InputError(folder, "it holds no image", remedy=_EXPORT)
    return images


def _lens(width: Any, height: Any, *intrinsics: Any) -> Lens:
    """A pinhole lens of fx, fy, cx, cy as a file has them.

    Raises ValueError if the principal point lies outside: the intrinsics then are those of another size.
    """
    fx, fy, cx, cy = map(float, intrinsics)
    if not (0 < cx < width and 0 < cy < height):
        raise ValueError(f"a frame of {width}x{height} with its centre at {cx:g}, {cy:g}")
    return Lens(int(width), int(height), fx, fy, cx, cy)


def _frame(image: Path, lens: Lens | None, pose: np.ndarray, depth: Path | None = None, **options: Any) -> PosedImage:
    """A frame by its camera-to-world pose."""
    world_to_camera = np.linalg.inv(make_rigid(pose, image, image.name))
    return PosedImage(image.name, image, lens, world_to_camera, depth, **options)


def _read_scannet(path: Path) -> PosedImages:
    """Reads ScanNet's exported folders, in which a pose is infinite where tracking was lost."""
    images, lenses, frames = _list_images(path / "color"), {}, []
    depths = [find_image(path / "depth", f"{image.stem}.png") for image in images]
    for kind, first in ("color", images[0]), ("depth", depths[0]):
        file = path / "intrinsic" / f"intrinsic_{kind}.txt"
        if file.is_file() and first is not None:
            k = _numbers(file, 4, 4)
            with _parsing(file):
                lenses[kind] = _lens(*image_header(first).upright, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    for image, depth in zip(images, depths):
        pose = _numbers(path / "pose" / f"{image.stem}.txt", 4, 4)
        frames.append(_frame(image, lenses["color"], pose, depth, depth_lens=lenses.get("depth")))
    return _in_metres(frames, path)


def _read_replica(path: Path) -> PosedImages:
    """Reads a scene of Replica in the layout of NICE-SLAM's renders, whose cam_params.json lies in it or above it."""
    images = [file for file in _list_images(path / "results") if not file.stem.startswith("depth")]
    poses = _numbers(path / "traj.txt", 16).reshape(-1, 4, 4)
    if len(poses) != len(images):
        raise InputError(path / "traj.txt", f"{len(poses)} poses for {len(images)} images", remedy="Copy both again.")
    file = path / "cam_params.json"
    file = file if file.is_file() else path.absolute().parent / file.name
    content = read_json(file, "the intrinsics of Replica's renders", "Copy it there, or write a transforms.json.")
    with _parsing(file):
        camera = content["camera"]
        fx, fy, cx, cy, scale = (float(camera[name]) for name in ("fx", "fy", "cx", "cy", "scale"))
        lens, unit = _lens(camera["w"], camera["h"], fx, fy, cx + 0.5, cy + 0.5), 1 / scale
    depths = [find_image(path / "results", image.stem.replace("frame", "depth") + ".png") for image in images]
    rows = zip(images, poses, depths)
    return _in_metres([_frame(image, lens, pose, depth, depth_unit=unit) for image, pose, depth in rows], path)


def _read_tum_list(file: Path) -> tuple[np.ndarray, list[Path]]:
    """Times and files of one of TUM's lists."""
    with _parsing(file):
        rows = [line.strip().split(maxsplit=1) for line in _lines(file) or [""]]  # a name may have spaces
        return np.array([float(row[0]) for row in rows]), [file.parent / row[1] for row in rows]


def _nearest_times(times: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """(Q,) index of the time nearest to each query; -1 if it is more than 20 ms away."""
    if not len(times):
        return np.full(len(queries), -1)
    gap, index = KDTree(times[:, None]).query(queries[:, None])
    return np.where(gap <= 0.02, index, -1)


def _read_tum(path: Path) -> PosedImages:
    """Reads a sequence of TUM's RGB-D benchmark."""
    (times, images), poses = _read_tum_list(path / "rgb.txt"), _numbers(path / "groundtruth.txt", 8)
    has_depth = (path / "depth.txt").is_file()
    depth_times, depths = _read_tum_list(path / "depth.txt") if has_depth else (np.zeros(0), [])
    file = path / "intrinsics.txt"
    camera = re.search(r"(?:freiburg|fr)([123])", path.resolve().name)
    content = "fx fy cx cy (px), and k1 k2 p1 p2 k3 of a distorted lens, of a folder without freiburg1 to 3 in its name"
    with reading(file, content, "Write the file."):
        intrinsics = _TUM_INTRINSICS[camera[1]] if camera and not file.is_file() else _lines(file)[0].split()
        fx, fy, cx, cy, *distortion = map(float, intrinsics)
        lens = Lens(*image_header(images[0]).upright, fx, fy, cx + 0.5, cy + 0.5, tuple(distortion))
    frames = []
    pose_of, depth_of = _nearest_times(poses[:, 0], times), _nearest_times(depth_times, times)
    for image, row, depth in zip(images, pose_of, depth_of):
        with _parsing(path / "groundtruth.txt"):
            pose = _LOST if row < 0 else pose_matrix(Rotation.from_quat(poses[row, 4:]), poses[row, 1:4])
        depth_file = depths[depth] if depth >= 0 and depths[depth].is_file() else None
        frames.append(_frame(image, lens, pose, depth_file, depth_unit=1 / 5000))
    return _in_metres(frames, path)


def _read_arkitscenes(path: Path) -> PosedImages:
    """Reads ARKitScenes' low resolution frames."""
    images, rows = _list_images(path / "lowres_wide"), _numbers(path / "lowres_wide.traj", 7)
    lens_files = sorted((path / "lowres_wide_intrinsics").glob("*.pincam"))
    with _parsing(path / "lowres_wide"):
        stems = [[file.stem.rpartition("_")[2] for file in files] for files in (images, lens_files)]
        times, lens_times = (np.array(each, np.float64) for each in stems)
    frames = []
    # The name of a frame's intrinsics can be a millisecond earlier or later than that of its image.
    for image, row, number in zip(images, _nearest_times(rows[:, 0], times), _nearest_times(lens_times, times)):
        lens, pose = None, _LOST
        if row >= 0 and number >= 0:
            with _parsing(lens_files[number]):
                lens = _lens(*_numbers(lens_files[number], 6)[0])
                pose = np.linalg.inv(pose_matrix(Rotation.from_rotvec(rows[row, 1:4]), rows[row, 4:]))
        frames.append(_frame(image, lens, pose, find_image(path / "lowres_depth", image.name)))
    return _in_metres(frames, path, up=UpAxis((0.0, 0.0, 1.0), "gravity in the capture (ARKitScenes)"))


def _read_polycam(path: Path) -> PosedImages:
    """Reads Polycam's raw data. Recent corrected_cameras/ have no sizes: then it is that of the image."""
    folder = path / "keyframes"
    is_corrected = all((folder / f"corrected_{kind}").is_dir() for kind in ("images", "cameras"))
    prefix = "corrected_" if is_corrected else ""
    if not (folder / f"{prefix}images").is_dir() or not (folder / f"{prefix}cameras").is_dir():
        raise InputError(
            folder, "it has no images/ or no cameras/", remedy="Export Polycam's raw data (developer mode)."
        )
    frames = []
    for image in _list_images(folder / f"{prefix}images"):
        file, lens, pose = find_image(folder / f"{prefix}cameras", f"{image.stem}.json"), None, _LOST
        if file is not None:
            with _parsing(file):
                camera = parse_json(file.read_bytes())
                size = (camera["width"], camera["height"]) if "width" in camera else image_header(image).stored
                lens = _lens(*size, *(camera[name] for name in ("fx", "fy", "cx", "cy")))
                rows = [[camera[f"t_{i}{j}"] for j in range(4)] for i in range(3)]
                pose = np.array([*rows, [0, 0, 0, 1]], np.float64) * _PHONE_AXES
        frames.append(_frame(image, lens, pose, find_image(folder / "depth", f"{image.stem}.png")))
    return _in_metres(frames, path, up=UpAxis((0.0, 1.0, 0.0), "gravity in the capture (Polycam)"))


def _read_record3d(path: Path) -> PosedImages:
    """Reads Record3D's exported or unpacked folders."""
    is_unpacked = (path / "rgbd").is_dir()  # a .r3d is an archive
    images, frames = _list_images(path / ("rgbd" if is_unpacked else "rgb")), []
    file = path / ("metadata" if is_unpacked else "metadata.json")
    with _parsing(file):
        metadata = parse_json(file.read_bytes())
        k = metadata["K"]  # by columns
        intrinsics = metadata.get("perFrameIntrinsicCoeffs") or [(k[0], k[4], k[6], k[7])] * len(metadata["poses"])
        poses = np.array(metadata["poses"], np.float64).reshape(-1, 7)
        size = (metadata["w"], metadata["h"]) if "w" in metadata else image_header(images[0]).upright
        for image in images:
            lens, pose = None, _LOST
            if (n := int(image.stem)) < len(poses):
                lens = _lens(*size, *intrinsics[n])
                pose = pose_matrix(Rotation.from_quat(poses[n, :4]), poses[n, 4:]) * _PHONE_AXES
            frames.append(_frame(image, lens, pose))
    notes = ("Record3D's depth was not read: its compression is not supported.",)
    return _in_metres(frames, path, notes=notes, up=UpAxis((0.0, 1.0, 0.0), "gravity in the capture (Record3D)"))


READERS = (
    Reader("ScanNet", ("color", "pose", "intrinsic/intrinsic_color.txt"), _read_scannet),
    Reader("Replica", ("results", "traj.txt"), _read_replica),
    Reader("TUM", ("rgb.txt", "groundtruth.txt"), _read_tum),
    Reader("ARKitScenes", ("lowres_wide", "lowres_wide.traj"), _read_arkitscenes),
    Reader("Polycam", ("keyframes",), _read_polycam),
    Reader("Record3D", ("rgb", "metadata.json"), _read_record3d),
    Reader("Record3D", ("rgbd", "metadata"), _read_record3d),
)
