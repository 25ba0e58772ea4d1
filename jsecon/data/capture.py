"""Captures of any known format, and whether their views can be used together."""

import itertools
from collections.abc import Collection
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from jsecon.data.colmap import find_models, read_colmap
from jsecon.data.frames import (
    CaptureExtent,
    PosedImages,
    Progress,
    build_capture,
    check_capture_options,
    planned_extent,
)
from jsecon.data.nerfstudio import read_nerfstudio
from jsecon.data.rgbd import find_rgbd
from jsecon.data.sfm import list_photographs
from jsecon.errors import InputError
from jsecon.files import is_output_folder
from jsecon.types import Camera, Capture

POINTS_AT_ONCE = 65536


def load_capture(
    path: str | Path,
    *,
    downscale: float | int | None = None,
    long_side: int | None = None,
    frames: int | None = None,
    holdout: int | None = 8,
    only: Collection[str] | None = None,
    progress: Progress = None,
) -> Capture:
    """Loads a capture folder: COLMAP (sparse/0 and images/), nerfstudio / instant-ngp (transforms.json; also that file
    itself, under any name), or one of `find_rgbd`: ScanNet, TUM, ARKitScenes, Polycam, Record3D.

    Frames come in name order. `downscale` (>= 1) divides width and height; where it is None, the longer side is brought
    to `long_side` px at most (None: kept). `frames`: at most so many, evenly spaced. `holdout` = k holds out the frames
    0, k, 2k, ... of those taken; 0 or None none. `only`: frames of these names alone, as Capture.names has them. What
    was left out or changed is in Capture.notes. A folder that holds both formats is read as COLMAP, which has the
    points. `progress(done, total)` counts frames.
    Raises InputError where the path holds neither, or what it holds is damaged.
    """
    check_capture_options(downscale, frames, holdout, long_side)
    how = {"downscale": downscale, "long_side": long_side, "frames": frames, "holdout": holdout, "only": only}
    return build_capture(_posed(Path(path)), **how, progress=progress)


def capture_extent(
    path: str | Path, *, downscale: float | None = None, long_side: int | None = None, frames: int | None = None
) -> CaptureExtent:
    """How much `load_capture` would load; of the images, only the headers are read."""
    check_capture_options(downscale, frames, None, long_side)
    return planned_extent(_posed(Path(path)), downscale, long_side, frames)


def has_poses(path: Path) -> bool:
    """Whether a path is a capture with poses, of any known format."""
    if path.is_file():
        return path.suffix.lower() == ".json"
    return bool(find_models(path)) or (path / "transforms.json").exists() or find_rgbd(path) is not None


def may_have_depth(path: Path) -> bool:
    """Whether a capture's files can hold depth, as its format and its transforms.json tell; loads no frame."""
    if path.is_dir() and find_models(path):
        return False
    file = path / "transforms.json" if path.is_dir() else path
    if file.is_file() and file.suffix.lower() == ".json":
        return b"depth_file_path" in file.read_bytes()
    return find_rgbd(path) is not None


def _posed(path: Path) -> PosedImages:
    if path.is_dir() and (models := find_models(path)):
        return read_colmap(path, models)
    file = path / "transforms.json" if path.is_dir() else path
    if file.is_file() and file.suffix.lower() == ".json":
        return read_nerfstudio(file)
    if (read := find_rgbd(path)) is not None:
        return read(path)
    raise _no_capture(path)


def unposed_photographs(path: Path) -> list[Path]:
    """Lists the photographs of a folder that has no poses; those of subfolders only where none is a capture itself."""
    if not path.is_dir() or has_poses(path):
        return []
    photos = list_photographs(path)
    nested = bool(photos) and photos[0].parent not in (path, path / "images")
    return [] if nested and _inner_captures(path) else photos


def _inner_captures(path: Path) -> list[Path]:
    folders = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    return [child for child in folders if not is_output_folder(child) and has_poses(child)]


def _no_capture(path: Path) -> InputError:
    """What lies at a path that is no capture, and what to give instead."""
    expected = "a capture: COLMAP's, nerfstudio's, of a depth camera or phone; or photographs, or a video"
    if not path.exists():
        return InputError(path, "nothing there", expected, "Check the path.")
    if not path.is_dir():
        remedy = "Give the folder of the capture, its transforms file (.json), or the video."
        return InputError(path, f"a file that ends in {path.suffix or 'nothing'}", expected, remedy)
    if photos := unposed_photographs(path):
        remedy = "Find their poses first: jsecon run does so (extra sfm), and keeps them in OUT/poses as a capture."
        return InputError(path, f"{len(photos)} photographs without poses", "a capture with poses", remedy)
    entries = sorted(child for child in path.iterdir() if not child.name.startswith("."))
    if not entries:
        return InputError(path, "an empty folder", expected, "Copy the capture there, or check the path.")
    remedy = "Give a folder with images/ and sparse/0, with transforms.json, or with photographs in it."
    if captures := _inner_captures(path):
        remedy = f"Give the capture's own folder, for example {captures[0]}."
    elif files := [child for child in entries if child.suffix.lower() == ".json"]:
        remedy = f"Give the transforms file itself, for example {files[0]}."
    names = ", ".join(child.name for child in entries[:5]) + (", ..." if len(entries) > 5 else "")
    return InputError(path, f"a folder without poses and photographs, but with {names}", expected, remedy)


def check_views_overlap(capture: Capture) -> None:
    """Raises InputError where no two views can see a thing in common, so that nothing could be followed or fitted.

    With sparse points: no point lies in two views' frusta. Without: no two frusta (unbounded pyramids) meet. Either is
    necessary for an overlap and ignores occlusion, so what it refuses has none; what passes may still have too little.
    A single view passes where it has depth.
    """
    count = len(capture.names)
    if count < 2 and capture.depths is not None:
        return
    if count < 2:
        found = "a single view"
    elif len(capture.points):
        if _share_points(capture.cameras, np.asarray(capture.points)):
            return
        found = f"{count} views, no two of which see the same of {len(capture.points)} sparse points"
    else:
        cameras = [capture.cameras[index] for index in range(count)]
        if any(_frusta_meet(a, b) for a, b in itertools.combinations(cameras, 2)):
            return
        found = f"{count} views that look apart from each other"
    remedy = "Check the poses and their axes (world-to-camera, OpenCV), and take views that overlap."
    raise InputError(f"capture of {capture.names[0]} ...", found, "at least two views of the same things", remedy)


def _share_points(cameras: Camera, points: np.ndarray) -> bool:
    for start in range(0, len(points), POINTS_AT_ONCE):
        chunk = np.asarray(points[start : start + POINTS_AT_ONCE], np.float64)
        views = np.zeros(len(chunk), np.int32)
        for index in range(len(cameras.fx)):
            pose = np.asarray(cameras.world_to_camera[index], np.float64)
            x, y, z = pose[:3, :3] @ chunk.T + pose[:3, 3:]
            z = np.where(z > 0, z, np.nan)
            u, v = cameras.fx[index] * x / z + cameras.cx[index], cameras.fy[index] * y / z + cameras.cy[index]
            views += (u >= 0) & (u <= cameras.width) & (v >= 0) & (v <= cameras.height)
            if (views > 1).any():
                return True
    return False


def _corner_rays(camera: Camera) -> np.ndarray:
    """(4, 3) directions of the image's corners, world."""
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], np.float64)
    x, y = (corners[:, 0] - camera.cx) / camera.fx, (corners[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(4)], axis=-1) @ np.asarray(camera.world_to_camera, np.float64)[:3, :3]


def _frusta_meet(a: Camera, b: Camera) -> bool:
    """Whether the two pyramids have a point in common.

    They do exactly where b's apex - a's apex = (a ray of a) - (a ray of b), that is where it lies in the cone of a's
    corner rays and b's negated ones: a sum of them with weights that are not negative.
    """
    rays = np.concatenate([_corner_rays(a), -_corner_rays(b)])
    gap = np.asarray(b.centres, np.float64) - np.asarray(a.centres, np.float64)
    return bool(nnls(rays.T, gap)[1] <= 1e-9 * max(1.0, np.abs(gap).max()))
