"""Captures of any known format, on the host, and whether their views can be used together."""

import itertools
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from jsecon.data.colmap import find_models, read_colmap
from jsecon.data.frames import CaptureExtent, PosedImages, build_capture, check_capture_options, planned_extent
from jsecon.data.nerfstudio import read_nerfstudio
from jsecon.data.rgbd import find_rgbd
from jsecon.data.sfm import list_photographs
from jsecon.errors import InputError
from jsecon.files import is_output_folder
from jsecon.types import Camera, Capture, Progress

_POINT_BLOCK = 65536
"""points that are projected at a time"""


def load_capture(
    path: str | Path,
    *,
    downscale: float | int | None = None,
    long_side: int | None = None,
    frames: int | None = None,
    holdout: int | None = 8,
    only: Collection[str] | None = None,
    progress: Progress | None = None,
) -> Capture:
    """Loads a capture.

    Formats are COLMAP (sparse/0 and images/), nerfstudio and instant-ngp (transforms.json), ScanNet, TUM, ARKitScenes,
    Polycam and Record3D. A folder of both COLMAP and nerfstudio is read as COLMAP, which has the points. Frames come in
    name order.

    Args:
      path: Folder of the capture, or a file of transforms with any name.
      downscale: Divides width and height, at least 1.
      long_side: Longest side of the frames, px, if `downscale` is None; None: no limit.
      frames: Most frames, evenly spaced; None: all.
      holdout: k holds out the frames 0, k, 2k, ...; 0 or None holds out no frame.
      only: Names of the frames to load, as in Capture.names; None: all.
      progress: Called with (frames done, frames).

    Returns:
      The capture; its notes say what was skipped or changed.

    Raises:
      InputError: The path holds no capture, or a damaged one.
    """
    check_capture_options(downscale, frames, holdout, long_side)
    options = {"downscale": downscale, "long_side": long_side, "frames": frames, "holdout": holdout, "only": only}
    return build_capture(_read(Path(path)), **options, progress=progress)


def capture_extent(
    path: str | Path, *, downscale: float | None = None, long_side: int | None = None, frames: int | None = None
) -> CaptureExtent:
    """Computes what frames `load_capture` would load, from image headers only.

    Args:
      path: As in `load_capture`.
      downscale: As in `load_capture`.
      long_side: As in `load_capture`.
      frames: As in `load_capture`.

    Returns:
      Number, size and names of the frames.

    Raises:
      InputError: As in `load_capture`, but for damaged pixels.
    """
    check_capture_options(downscale, frames, None, long_side)
    return planned_extent(_read(Path(path)), downscale, long_side, frames)


def _find_reader(path: Path) -> Callable[[], PosedImages] | None:
    """The reader of a capture's format, or None."""
    if path.is_dir() and (models := find_models(path)):
        return lambda: read_colmap(path, models)
    if (file := _transforms_file(path)) is not None:
        return lambda: read_nerfstudio(file)
    if (reader := find_rgbd(path)) is not None:
        return lambda: reader(path)
    return None


def _transforms_file(path: Path) -> Path | None:
    """The file of transforms at a path, or None."""
    file = path / "transforms.json" if path.is_dir() else path
    return file if file.is_file() and file.suffix.lower() == ".json" else None


def _read(path: Path) -> PosedImages:
    """Reads a capture without its pixels."""
    reader = _find_reader(path)
    if reader is None:
        raise _no_capture(path)
    return reader()


def _has_poses(path: Path) -> bool:
    """Whether a path is a capture with poses, of any known format."""
    return _find_reader(path) is not None


def may_have_depth(path: Path) -> bool:
    """Whether a capture can have depth maps, by its format and its transforms.json; reads no frame.

    Args:
      path: As in `load_capture`; anything else has no depth.

    Returns:
      False for COLMAP, and for transforms without `depth_file_path`.
    """
    if path.is_dir() and find_models(path):
        return False
    if (file := _transforms_file(path)) is not None:
        return b"depth_file_path" in file.read_bytes()
    return find_rgbd(path) is not None


def unposed_photographs(path: Path) -> list[Path]:
    """Lists the photographs of a folder without poses; those of subfolders only if none of these is a capture.

    Args:
      path: A folder, or another path, which has no photographs.

    Returns:
      Paths of the photographs; empty if the folder has poses.
    """
    if not path.is_dir() or _has_poses(path):
        return []
    photos = list_photographs(path)
    is_nested = bool(photos) and photos[0].parent not in (path, path / "images")
    return [] if is_nested and _inner_captures(path) else photos


def _inner_captures(path: Path) -> list[Path]:
    """The subfolders that are captures."""
    folders = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    return [child for child in folders if not is_output_folder(child) and _has_poses(child)]


def _no_capture(path: Path) -> InputError:
    """The error of a path without a capture: what lies there, and what to give instead."""
    expected = "a capture of COLMAP, nerfstudio, a depth camera or a phone; or photographs, or a video"
    if not path.exists():
        return InputError(path, "there is no such file or folder", expected, "Check the path.")
    if not path.is_dir():
        remedy = "Give the folder of the capture, its transforms file (.json), or the video."
        return InputError(path, f"a file with the suffix {path.suffix!r} is not a capture", expected, remedy)
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
    """Checks that two views can see a thing in common, as tracking and fitting need.

    With sparse points, a point must lie in two views' frusta; without, two frusta (unbounded pyramids) must meet. Both
    are necessary for an overlap and ignore occlusion: views that pass may still overlap too little. A single view
    passes if it has depth.

    Args:
      capture: The capture.

    Raises:
      InputError: No two views overlap.
    """
    count = len(capture.names)
    if count < 2 and capture.depths is not None:
        return
    if count < 2:
        problem = "it has a single view"
    elif len(capture.points):
        if _share_points(capture.cameras, np.asarray(capture.points)):
            return
        problem = f"no two of its {count} views see the same of {len(capture.points)} sparse points"
    else:
        cameras = [capture.cameras[index] for index in range(count)]
        if any(_frusta_meet(a, b) for a, b in itertools.combinations(cameras, 2)):
            return
        problem = f"its {count} views look apart from each other"
    remedy = "Check the poses and their axes (world-to-camera, OpenCV), and take views that overlap."
    raise InputError(f"capture of {capture.names[0]} ...", problem, "two views of the same things", remedy)


def _share_points(cameras: Camera, points: np.ndarray) -> bool:
    """Whether a point lies in two frusta."""
    for start in range(0, len(points), _POINT_BLOCK):
        block = np.asarray(points[start : start + _POINT_BLOCK], np.float64)
        views = np.zeros(len(block), np.int32)
        for index in range(len(cameras.fx)):
            pose = np.asarray(cameras.world_to_camera[index], np.float64)
            x, y, z = pose[:3, :3] @ block.T + pose[:3, 3:]
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
    """Whether two pyramids have a point in common.

    They do exactly if b's apex - a's apex = (a ray of a) - (a ray of b), that is if it lies in the cone of a's corner
    rays and b's negated ones: a sum of them with weights that are not negative.
    """
    rays = np.concatenate([_corner_rays(a), -_corner_rays(b)])
    gap = np.asarray(b.centres, np.float64) - np.asarray(a.centres, np.float64)
    return bool(nnls(rays.T, gap)[1] <= 1e-9 * max(1.0, np.abs(gap).max()))
