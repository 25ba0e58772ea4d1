"""Captures of depth cameras and phones, on the host: ScanNet, Replica, TUM, ARKitScenes, Polycam, Record3D.

Formats: ScanNet SensReader/python; NICE-SLAM's renders of Replica; TUM's RGB-D benchmark (file_formats); ARKitScenes
DATA.md; nerfstudio process_data polycam_utils.py and record3d_utils.py.
Each keeps its world. Phones look along -z of their own axes, and gravity is along an axis of their worlds: y of Polycam
and Record3D, z of ARKitScenes. Frames without a pose are left out, and counted in a note.
"""

import dataclasses
import functools
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.files import parse_json, read_lines, reading
from jsecon.read.captures.frames import PosedImage, PosedImages, make_rigid, same_aspect
from jsecon.read.captures.images import find_image, image_header, size_around
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
_EXPORT = "Export the capture again."
_parsing = functools.partial(reading, remedy=_EXPORT)
"""makes errors in parsing a file InputErrors"""


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


def _matrix(rotation: Rotation, translation: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """A pose."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), translation
    return pose


def _lens(width: Any, height: Any, *intrinsics: Any) -> Lens:
    """A pinhole lens of fx, fy, cx, cy as a file has them.

    Raises ValueError if the principal point lies outside: the intrinsics then are those of another size.
    """
    fx, fy, cx, cy = map(float, intrinsics)
    if not (0 < cx < width and 0 < cy < height):
        raise ValueError(f"a frame of {width}x{height} with its centre at {cx:g}, {cy:g}")
    return Lens(int(width), int(height), fx, fy, cx, cy)


def _posed_image(image: Path, lens: Lens, camera_to_world: np.ndarray, depth: Path | None = None) -> PosedImage:
    """A frame."""
    world_to_camera = np.linalg.inv(make_rigid(camera_to_world, image, image.name))
    return PosedImage(image.name, image, lens, world_to_camera, depth)


def _posed_images(
    path: Path, images: list[PosedImage], count: int, *notes: str, up: UpAxis | None = None
) -> PosedImages:
    """The frames with a pose, of `count` images, in metres: all of these sensors measure them."""
    lost = count - len(images)
    lost_note = (f"{lost} of {count} frames were left out, since they have no pose.",) if lost else ()
    return PosedImages(images, path, notes=(*lost_note, *notes), up=up, metres_per_unit=1.0)


def _read_scannet(path: Path) -> PosedImages:
    """Reads ScanNet's exported folders."""
    images, lenses = _list_images(path / "color"), {}
    for kind, first in ("color", images[0]), ("depth", find_image(path / "depth", f"{images[0].stem}.png")):
        file = path / "intrinsic" / f"intrinsic_{kind}.txt"
        if file.is_file() and first is not None:
            k = _numbers(file, 4, 4)
            with _parsing(file):
                lenses[kind] = _lens(*image_header(first).upright, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    posed = []
    for image in images:
        pose = _numbers(path / "pose" / f"{image.stem}.txt", 4, 4)
        if np.isfinite(pose).all():  # infinite where tracking was lost
            frame = _posed_image(image, lenses["color"], pose, find_image(path / "depth", f"{image.stem}.png"))
            posed.append(dataclasses.replace(frame, depth_lens=lenses.get("depth")))
    return _posed_images(path, posed, len(images))


def _read_replica(path: Path) -> PosedImages:
    """Reads a scene of Replica in the layout of NICE-SLAM's renders, whose cam_params.json lies in it or above it."""
    images = [file for file in _list_images(path / "results") if not file.stem.startswith("depth")]
    poses = _numbers(path / "traj.txt", 16).reshape(-1, 4, 4)
    numbers = [*range(len(images))]
    if len(poses) != len(images):
        with _parsing(path / "results"):
            numbers = [int(re.sub(r"\D", "", file.stem)) for file in images]
    stated = [file for file in (path / "cam_params.json", path.absolute().parent / "cam_params.json") if file.is_file()]
    width, height = image_header(images[0]).upright
    if stated:
        with _parsing(stated[0]):
            camera = parse_json(stated[0].read_bytes())["camera"]
            fx, fy, cx, cy, scale = (float(camera[name]) for name in ("fx", "fy", "cx", "cy", "scale"))
            lens = _lens(camera["w"], camera["h"], fx, fy, cx + 0.5, cy + 0.5)
    elif (width, height) == (1200, 680):
        lens, scale = _lens(width, height, 600.0, 600.0, 600.0, 340.0), 6553.5
    else:
        problem = f"no cam_params.json states the intrinsics of its images, which are {width}x{height}"
        raise InputError(path, problem, remedy="Write it as NICE-SLAM's, or give a transforms.json.")
    posed = []
    for image, number in zip(images, numbers):
        if number < len(poses) and np.isfinite(poses[number]).all():
            depth = find_image(path / "results", image.stem.replace("frame", "depth") + ".png")
            frame = _posed_image(image, lens, poses[number], depth if depth != image else None)
            posed.append(dataclasses.replace(frame, depth_unit=1 / scale))
    return _posed_images(path, posed, len(images))


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
    file = path / "intrinsics.txt"
    camera = re.search(r"(?:freiburg|fr)([123])", path.resolve().name)
    if not file.is_file() and camera is None:
        remedy = "Write fx fy cx cy (px) there, and k1 k2 p1 p2 k3 if the lens is distorted."
        problem = "there is no such file, and the folder's name has no freiburg1 to 3"
        raise InputError(file, problem, "the camera's intrinsics", remedy)
    with _parsing(file):
        intrinsics = _lines(file)[0].split() if file.is_file() or camera is None else _TUM_INTRINSICS[camera[1]]
        fx, fy, cx, cy, *distortion = map(float, intrinsics)
        if len(distortion) > 8:
            raise ValueError(f"{len(distortion)} numbers after fx fy cx cy, at most k1 k2 p1 p2 k3 k4 k5 k6 can be")
        has_depth = (path / "depth.txt").is_file()
        depth_times, depths = _read_tum_list(path / "depth.txt") if has_depth else (np.zeros(0), [])
        lens = Lens(*image_header(images[0]).upright, fx, fy, cx + 0.5, cy + 0.5, tuple(distortion))
    posed = []
    pose_of, depth_of = _nearest_times(poses[:, 0], times), _nearest_times(depth_times, times)
    for image, row, depth in zip(images, pose_of, depth_of):
        if row >= 0:
            with _parsing(path / "groundtruth.txt"):
                pose = _matrix(Rotation.from_quat(poses[row, 4:]), poses[row, 1:4])
            frame = _posed_image(image, lens, pose, depths[depth] if depth >= 0 and depths[depth].is_file() else None)
            posed.append(dataclasses.replace(frame, depth_unit=1 / 5000))
    return _posed_images(path, posed, len(images))


def _read_arkitscenes(path: Path) -> PosedImages:
    """Reads ARKitScenes' low resolution frames."""
    images, rows = _list_images(path / "lowres_wide"), _numbers(path / "lowres_wide.traj", 7)
    lens_files = sorted((path / "lowres_wide_intrinsics").glob("*.pincam"))
    with _parsing(path / "lowres_wide"):
        stems = [[file.stem.rpartition("_")[2] for file in files] for files in (images, lens_files)]
        times, lens_times = (np.array(each, np.float64) for each in stems)
    posed = []
    # The name of a frame's intrinsics can be a millisecond earlier or later than that of its image.
    for image, row, lens in zip(images, _nearest_times(rows[:, 0], times), _nearest_times(lens_times, times)):
        if row >= 0 and lens >= 0:
            width, height, *intrinsics = _numbers(lens_files[lens], 6)[0]
            world_to_camera = _matrix(Rotation.from_rotvec(rows[row, 1:4]), rows[row, 4:])
            depth = find_image(path / "lowres_depth", image.name)
            with _parsing(lens_files[lens]):
                lens_of_frame = _lens(width, height, *intrinsics)
                posed.append(_posed_image(image, lens_of_frame, np.linalg.inv(world_to_camera), depth))
    return _posed_images(path, posed, len(images), up=UpAxis((0.0, 0.0, 1.0), "gravity in the capture (ARKitScenes)"))


def _read_polycam(path: Path) -> PosedImages:
    """Reads Polycam's raw data."""
    frames = path / "keyframes"
    is_corrected = all((frames / f"corrected_{kind}").is_dir() for kind in ("images", "cameras"))
    prefix = "corrected_" if is_corrected else ""
    if not (frames / f"{prefix}images").is_dir() or not (frames / f"{prefix}cameras").is_dir():
        remedy = "Export the raw data from Polycam again, with its developer mode on."
        raise InputError(frames, "it has no images/ or no cameras/", remedy=remedy)
    images, posed = _list_images(frames / f"{prefix}images"), []
    for image in images:
        file = find_image(frames / f"{prefix}cameras", f"{image.stem}.json")
        if file is not None:
            with _parsing(file):
                camera = parse_json(file.read_bytes())
                size = _polycam_size(camera, find_image(frames / "cameras", f"{image.stem}.json"), image)
                lens = _lens(*size, *(camera[name] for name in ("fx", "fy", "cx", "cy")))
                rows = [[camera[f"t_{i}{j}"] for j in range(4)] for i in range(3)]
                pose = np.array([*rows, [0, 0, 0, 1]], np.float64) * _PHONE_AXES
            posed.append(_posed_image(image, lens, pose, find_image(frames / "depth", f"{image.stem}.png")))
    return _posed_images(path, posed, len(images), up=UpAxis((0.0, 1.0, 0.0), "gravity in the capture (Polycam)"))


def _polycam_size(camera: Any, uncorrected: Path | None, image: Path) -> tuple[Any, Any]:
    """(width, height) that a camera's intrinsics are for.

    Recent corrected_cameras/ have no sizes: then it is that of the uncorrected camera, if its aspect is the image's.
    """
    if "width" in camera:
        return camera["width"], camera["height"]
    size = size_around(image, camera["cx"], camera["cy"])
    before = {} if uncorrected is None else parse_json(uncorrected.read_bytes())
    stated = before.get("width", size[0]), before.get("height", size[1])
    return stated if same_aspect(stated, size) else size


def _read_record3d(path: Path) -> PosedImages:
    """Reads Record3D's exported or unpacked folders."""
    is_unpacked = (path / "rgbd").is_dir()  # a .r3d is an archive
    images, posed = _list_images(path / ("rgbd" if is_unpacked else "rgb")), []
    file = path / ("metadata" if is_unpacked else "metadata.json")
    with _parsing(file):
        metadata = parse_json(file.read_bytes())
        k = metadata["K"]  # by columns
        intrinsics = metadata.get("perFrameIntrinsicCoeffs") or [(k[0], k[4], k[6], k[7])] * len(metadata["poses"])
        poses = np.array(metadata["poses"], np.float64).reshape(-1, 7)
        size = (metadata["w"], metadata["h"]) if "w" in metadata else image_header(images[0]).upright
        for image in images:
            if (n := int(image.stem)) < len(poses):
                pose = _matrix(Rotation.from_quat(poses[n, :4]), poses[n, 4:]) * _PHONE_AXES
                posed.append(_posed_image(image, _lens(*size, *intrinsics[n]), pose))
    note = "Record3D's depth was not read: its compression is not supported."
    return _posed_images(
        path, posed, len(images), note, up=UpAxis((0.0, 1.0, 0.0), "gravity in the capture (Record3D)")
    )


READERS = (
    Reader("ScanNet", ("color", "pose", "intrinsic/intrinsic_color.txt"), _read_scannet),
    Reader("Replica", ("results", "traj.txt"), _read_replica),
    Reader("TUM", ("rgb.txt", "groundtruth.txt"), _read_tum),
    Reader("ARKitScenes", ("lowres_wide", "lowres_wide.traj"), _read_arkitscenes),
    Reader("Polycam", ("keyframes",), _read_polycam),
    Reader("Record3D", ("rgb", "metadata.json"), _read_record3d),
    Reader("Record3D", ("rgbd", "metadata"), _read_record3d),
)
