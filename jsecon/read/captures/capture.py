"""Captures of any known format, and photographs without poses, on the host.

`READERS` is the table of formats. A reader takes a folder, or a file of poses, and returns PosedImages: images, lenses
and poses in OpenCV axes. Other packages add readers by entry points in the group jsecon.captures.
"""

import re
from pathlib import Path

from jsecon.errors import InputError
from jsecon.files import is_output_folder, list_files, reading
from jsecon.read.captures import colmap, nerfstudio, rgbd
from jsecon.read.captures.build import build_capture
from jsecon.read.captures.frames import FrameOptions, PosedImages
from jsecon.read.captures.images import IMAGE_SUFFIXES
from jsecon.read.registry import Reader, find_reader
from jsecon.types import Capture, Progress

READERS = (*colmap.READERS, *nerfstudio.READERS, *colmap.NESTED_READERS, *rgbd.READERS)
"""The formats, the preferred first: a folder of both COLMAP and nerfstudio is read as COLMAP, which has the points."""
_OTHER_IMAGES = re.compile(r"mask|depth|segmentation|proposal|label|confidence|normal|thumb")
"""in the name of a folder whose images are not photographs"""


def load_capture(
    path: str | Path,
    *,
    downscale: float | int | None = None,
    long_side: int | None = None,
    frames: int | None = None,
    holdout: int | None = 8,
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
      progress: Called with (frames done, frames).

    Returns:
      The capture; its notes say what was skipped or changed.

    Raises:
      InputError: The path holds no capture, or a damaged one.
    """
    options = FrameOptions(downscale, long_side, frames, holdout)
    return build_capture(read_posed_images(Path(path)), options, progress=progress)


def read_posed_images(path: Path) -> PosedImages:
    """Reads a capture without its pixels; its images need not be there."""
    reader = _find_reader(path)
    if reader is None:
        raise _no_capture(path)
    with reading(path, remedy="Export the capture again."):
        return reader.read(path)


def _find_reader(path: Path) -> Reader | None:
    """The reader of a capture's format, or None."""
    return find_reader("jsecon.captures", READERS, path)


def has_depth(path: Path) -> bool:
    """Whether a capture names depth maps; False also for any path that cannot be read."""
    reader = _find_reader(path)
    if reader is None or reader.name == "COLMAP":
        return False
    try:
        return any(image.depth is not None for image in read_posed_images(path).images)
    except InputError:
        return False


def list_photographs(path: Path) -> list[Path]:
    """Lists the photographs of a folder, or of its images/, in name order.

    If none lies directly in the folder, those of its subfolders are listed (cam0/, cam1/), except in folders of masks
    or depth, masks named like the photograph beside them (a.jpg.png), and output of jsecon.
    """
    folder = path / "images" if (path / "images").is_dir() else path
    if not folder.is_dir():
        return []
    direct = sorted(file for file in folder.iterdir() if _is_image(file) and file.is_file())
    if direct:
        return direct
    images = [file for file in list_files(folder) if _is_image(file)]
    masked = {image.with_suffix("") for image in images}.intersection(images)
    return [
        file
        for file in images
        if file.with_suffix("") not in masked
        and not any(_OTHER_IMAGES.search(part.lower()) for part in file.relative_to(folder).parts[:-1])
    ]


def _is_image(file: Path) -> bool:
    """Whether a file is named like a visible image."""
    return file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")


def unposed_photographs(path: Path) -> list[Path]:
    """Lists the photographs of a folder without poses; those of subfolders only if none of these is a capture."""
    if not path.is_dir() or _find_reader(path) is not None:
        return []
    photos = list_photographs(path)
    is_nested = bool(photos) and photos[0].parent not in (path, path / "images")
    return [] if is_nested and _inner_captures(path) else photos


def _inner_captures(path: Path) -> list[Path]:
    """The subfolders that are captures."""
    folders = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    return [child for child in folders if not is_output_folder(child) and _find_reader(child) is not None]


def _no_capture(path: Path) -> InputError:
    """The error of a path without a capture: what lies there, and what to give instead."""
    expected = "a capture of COLMAP, nerfstudio, a depth camera or a phone; or photographs, or a video"
    entries = sorted(child for child in path.iterdir() if not child.name.startswith(".")) if path.is_dir() else []
    names = ", ".join(child.name for child in entries[:5]) + (", ..." if len(entries) > 5 else "")
    problem = f"a folder without poses and photographs, but with {names}"
    remedy = "Give a folder with images/ and sparse/0, with transforms.json, or with photographs in it."
    if not path.exists():
        problem, remedy = "there is no such file or folder", "Check the path."
    elif not path.is_dir():
        problem = f"a file with the suffix {path.suffix!r} is not a capture"
        remedy = "Give the folder of the capture, its transforms file (.json), or the video."
    elif photos := unposed_photographs(path):
        problem, expected = f"{len(photos)} photographs without poses", "a capture with poses"
        remedy = "Find their poses first: jsecon run does so (extra sfm), and keeps them in OUT/poses as a capture."
    elif not entries:
        problem, remedy = "an empty folder", "Copy the capture there, or check the path."
    elif captures := _inner_captures(path):
        remedy = f"Give the capture's own folder, for example {captures[0]}."
    elif files := [child for child in entries if child.suffix.lower() == ".json"]:
        remedy = f"Give the transforms file itself, for example {files[0]}."
    return InputError(path, problem, expected, remedy)
