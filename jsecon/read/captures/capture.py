"""Captures of any known format, and photographs without poses, on the host.

`READERS` is the table of formats. A reader takes a folder, or a file of poses, and returns PosedImages: images, lenses
and poses in OpenCV axes. Other packages add readers by entry points in the group jsecon.captures.
"""

import contextlib
import dataclasses
import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from PIL import Image

from jsecon.errors import InputError, join_first
from jsecon.files import is_output_folder, list_files, reading
from jsecon.read.captures import colmap, nerfstudio, opensfm, rgbd
from jsecon.read.captures.build import build_capture
from jsecon.read.captures.frames import FrameOptions, PosedImage, PosedImages
from jsecon.read.captures.images import IMAGE_SUFFIXES, image_header, unread_remedy
from jsecon.read.captures.lens import PANORAMA_VIEWS, panorama_lens
from jsecon.read.captures.video import has_panorama_mark, is_video
from jsecon.read.registry import SCENES, Reader, readers
from jsecon.types import Capture, Progress

READERS = (*colmap.READERS, *nerfstudio.READERS, *colmap.NESTED_READERS, *opensfm.READERS, *rgbd.READERS)
"""The formats, the preferred first: a folder of both COLMAP and nerfstudio is read as COLMAP, which has the points."""
_OTHER_IMAGES = re.compile(r"mask|depth|segmentation|proposal|label|confidence|normal|thumb")
"""in the name of a folder whose images are not photographs"""
_OTHER_WORD = re.compile(
    r"(?<![a-z])(mask(?:s|ed)?|depths?|disparity|seg|semantics?|instances?|labels?|normals?|alpha)(?![a-z])"
)
_IMAGE_WORD = re.compile(r"(?<![a-z])(colou?r|rgba?|images?|img|frame|photo)(?![a-z])")
"""words in names of images, beside each other: frame0001.jpg and depth0001.png, a.color.png and a.depth.png"""
_EXIF, _TAKEN, _DATE = 0x8769, 0x9003, re.compile(r"(\d{4}):(\d\d):(\d\d)")
"""EXIF's block of a photograph, its tag DateTimeOriginal, and the date in that"""
_POSE = re.compile(
    r"(camera_?)?poses?|cams?|cameras|extrinsics?|traj(ectory)?"
    r"|.*(pose|traj|extrinsic|odometry|ground_?truth|camera).*\.(txt|json|npy|npz|csv|log|xml|ya?ml)"
)
"""names of folders and files that may hold poses"""


def load_capture(
    path: str | Path,
    *,
    downscale: float | int | None = None,
    long_side: int | None = None,
    frames: int | None = None,
    holdout: int | None = None,
    progress: Progress | None = None,
) -> Capture:
    """Loads a capture.

    Formats are COLMAP (sparse/0 and images/), nerfstudio and instant-ngp (transforms.json), ScanNet, TUM, ARKitScenes,
    Polycam, Record3D and OpenSfM. A folder of both COLMAP and nerfstudio is read as COLMAP, which has the points.
    Frames come in name order; a panorama becomes eight of them.

    Args:
      path: Folder of the capture, or a file of transforms with any name.
      downscale: Divides width and height, at least 1.
      long_side: Longest side of the frames, px, if `downscale` is None; None: no limit.
      frames: Most frames, evenly spaced, the views of a panorama together one; None: all.
      holdout: k holds out the frames 0, k, 2k, ..., and 0 no frame. None holds out those that the capture's own split
        sets aside (train_filenames, test_filenames, test_frames), or else every eighth.
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
    with reading(path, remedy="Export the capture again."):
        if reader is None:
            raise _no_capture(path)
        return _cut_panoramas(reader.read(path))


def _cut_view(panorama: PosedImage, view: int) -> PosedImage:
    """A view of a panorama."""
    pose, path = panorama.world_to_camera.copy(), PurePosixPath(panorama.name)
    pose[:3] = PANORAMA_VIEWS[view] @ pose[:3]
    name = str(path.with_name(f"{path.stem}_{view}{path.suffix}"))
    lens = panorama.lens and dataclasses.replace(panorama.lens, view=view)
    return dataclasses.replace(panorama, name=name, lens=lens, world_to_camera=pose, depth=None)


def _cut_panoramas(posed: PosedImages) -> PosedImages:
    """Replaces each panorama of a capture by its views, which share its file; their numbers follow its name."""
    panoramas = [image for image in posed.images if image.lens is not None and image.lens.view is not None]
    if not panoramas:
        return posed
    images = [image for image in posed.images if image.lens is None or image.lens.view is None]
    images += [_cut_view(panorama, view) for panorama in panoramas for view in range(len(PANORAMA_VIEWS))]
    each = f"{len(PANORAMA_VIEWS)} views each, of 95 degrees; what lies within 30 degrees of straight down is left out"
    note = f"{len(panoramas)} panoramas are cut into {each}, as the operator stands there."
    return dataclasses.replace(posed, images=images, notes=(*posed.notes, note))


def _find_reader(path: Path) -> Reader | None:
    """The reader of a capture's format, or None."""
    return next((reader for reader in readers("jsecon.captures", READERS) if reader.fits(path)), None)


def has_depth(path: Path) -> bool:
    """Whether a capture names depth maps; False also for any path that cannot be read."""
    reader = _find_reader(path)
    if reader is None or reader.name == "COLMAP":
        return False
    with contextlib.suppress(InputError):
        return any(image.depth is not None for image in read_posed_images(path).images)
    return False


def _sort_images(path: Path) -> tuple[list[Path], list[Path]]:
    """The photographs of a folder, or of its images/, in name order, and the images beside them that are none.

    If no image lies directly there, those of the subfolders are listed (cam0/, cam1/), except in folders of masks or
    depth, and output of jsecon. Depth maps, masks, and images with another's name and a word more (a_mask.png,
    a.jpg.png) are no photographs.
    """
    folder = path / "images" if (path / "images").is_dir() else path
    if not folder.is_dir():
        return [], []
    images = sorted(file for file in folder.iterdir() if _is_image(file) and file.is_file())
    if not images:
        inner = [(file, file.relative_to(folder).parent.as_posix()) for file in list_files(folder) if _is_image(file)]
        images = [file for file, place in inner if not _OTHER_IMAGES.search(place.lower())]
    derived = _derived_images(images)
    photos = [file for file in images if file not in derived and _is_photograph(file)]
    return photos, sorted({*images}.difference(photos))


def _is_photograph(path: Path) -> bool:
    """Whether the header of an image may be a photograph's: grey of 16 bits is depth, and 1 bit a mask.

    True for files that cannot be read: whoever reads them says why.
    """
    if path.suffix.lower() not in (".png", ".tif", ".tiff", ".bmp"):
        return True
    with contextlib.suppress(InputError):
        return image_header(path).mode not in ("1", "I", "F", "I;16", "I;16B", "I;16L")
    return True


def _derived_images(images: Sequence[Path]) -> set[Path]:
    """Images whose names are those of others with a word added or changed: masks, depth maps, masked copies."""

    def base(file: Path) -> tuple[Path, str]:
        plain = _IMAGE_WORD.sub("", _OTHER_WORD.sub("", file.stem.lower()))
        return file.parent, re.sub("[^a-z0-9]", "", plain)

    names = {*images}
    bases = {base(file) for file in images if not _OTHER_WORD.search(file.stem.lower())}
    derived = {file for file in images if _OTHER_WORD.search(file.stem.lower()) and base(file) in bases}
    return derived.union(file for file in images if file.with_suffix("") in names)


def _is_image(file: Path) -> bool:
    """Whether a file is named like a visible image."""
    return file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")


def unposed_photographs(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Lists the photographs of a folder without poses, and notes; those of subfolders if none of these is a capture.

    Raises InputError if they are those of a capture whose folder lies above.
    """
    if not path.is_dir() or _find_reader(path) is not None:
        return [], ()
    photos, others = _sort_images(path)
    is_nested = bool(photos) and photos[0].parent not in (path, path / "images")
    if is_nested and _inner_captures(path):
        return [], ()
    if photos and (above := _capture_above(path)) is not None:
        raise InputError(path, f"its photographs are part of a {above[1]} capture", remedy=f"Give that: {above[0]}")
    return photos, _notes_beside(path, photos, others) if photos else ()


def find_panoramas(photos: Sequence[Path], *, declared: bool) -> tuple[list[Path], tuple[str, ...]]:
    """Finds the panoramas among photographs, by marks in their files or as the user `declared` all to be, and notes.

    A panorama is twice as wide as high.
    """
    sizes = {photo: image_header(photo).upright for photo in photos}
    for photo, size in sizes.items() if declared else ():
        panorama_lens(photo, *size)  # refuses another aspect
    wide = [photo for photo, (width, height) in sizes.items() if width == 2 * height]
    found = [photo for photo in wide if declared or has_panorama_mark(photo)]
    unmarked = len(wide) - len(found)
    note = f"{unmarked} photographs are twice as wide as high, but their files do not call them panoramas."
    return found, (f"{note} Give --panoramas if they show all directions.",) if unmarked else ()


def lone_photographs(path: Path) -> list[Path]:
    """Photographs without poses: one file, or those of a folder; none of a capture."""
    return [path] if path.is_file() and _is_image(path) else unposed_photographs(path)[0]


def taken_on(path: Path) -> str | None:
    """The latest date, YYYY-MM-DD, in the EXIF data of photographs or of those of a capture; None if none has one."""
    dates = []
    with contextlib.suppress(InputError):
        for file in lone_photographs(path) or [image.image for image in read_posed_images(path).images]:
            with contextlib.suppress(OSError, SyntaxError, ValueError), Image.open(file or "") as opened:
                text = str(opened.getexif().get_ifd(_EXIF).get(_TAKEN))
                dates += ["-".join(match.groups()) for match in [_DATE.match(text)] if match]
    return max(dates, default=None)


def _capture_above(path: Path) -> tuple[Path, str] | None:
    """The folder of a capture, up to three above, whose images lie in a folder, and its format."""
    place = Path(os.path.abspath(path))
    for folder in place.parents[:3]:
        reader = _find_reader(folder)
        with contextlib.suppress(InputError):  # then its photographs are no capture
            images = [] if reader is None else [image.image for image in read_posed_images(folder).images]
            places = [Path(os.path.abspath(image)).parents for image in images if image is not None]
            if reader is not None and any(place in parents for parents in places):
                return folder, reader.name
    return None


def _notes_beside(path: Path, photos: Sequence[Path], others: Sequence[Path]) -> tuple[str, ...]:
    """Says what lies beside the photographs of a folder and is not used."""
    children = [*path.iterdir(), *(photos[0].parent.iterdir() if photos[0].parent != path else ())]
    poses = [child for child in children if _POSE.fullmatch(child.name.lower())]
    unread = [child for child in children if unread_remedy(child) or is_video(child)]
    rows = (
        (others, "{} images are left out as depth maps, masks or copies of the photographs ({})."),
        (poses, "{} files may be poses in a layout that is not read ({}): write a COLMAP model or a transforms.json."),
        (unread, "{} files of formats that are not read here are left out ({}). Give a video by itself."),
    )
    return tuple(text.format(len(files), join_first(sorted(f.name for f in files))) for files, text in rows if files)


def _inner_captures(path: Path) -> list[Path]:
    """The subfolders that are captures."""
    folders = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    return [child for child in folders if not is_output_folder(child) and _find_reader(child) is not None]


def _no_capture(path: Path) -> InputError:
    """The error of a path without a capture: what lies there, and what to give instead."""
    expected = "a capture of COLMAP, nerfstudio, a depth camera or a phone; or photographs, or a video"
    if not path.is_dir():
        problem = f"a file with the suffix {path.suffix!r} is not a capture"
        problem = problem if path.exists() else "there is no such file or folder"
        return InputError(path, problem, expected, "Give the folder of the capture, its transforms file, or the video.")
    entries = sorted(child for child in path.iterdir() if not child.name.startswith("."))
    problem = f"a folder without poses and photographs, but with {join_first([child.name for child in entries])}"
    remedy = "Give a folder with images/ and sparse/0, with transforms.json, or with photographs in it."
    trained = sorted(path.glob("point_cloud/*/*.ply"), key=lambda file: -file.stat().st_mtime)  # INRIA's
    scenes = [*trained, *(child for child in entries if child.suffix.lower() in SCENES[:-1])]
    if not entries:
        problem, remedy = "an empty folder", "Copy the capture there, or check the path."
    elif photos := unposed_photographs(path)[0]:
        problem, expected = f"{len(photos)} photographs without poses", "a capture with poses"
        remedy = "Find their poses first: jsecon run does so (extra sfm), and keeps them in OUT/cache as a capture."
    elif captures := _inner_captures(path):
        remedy = f"Give the capture's own folder, for example {captures[0]}."
    elif unread := list(filter(unread_remedy, [*entries, *path.glob("images/*")])):
        problem, remedy = f"{len(unread)} {unread[0].suffix} images, which are not read", unread_remedy(unread[0])
    elif inputs := [*filter(is_video, entries), *scenes]:
        remedy = f"Give the video or the scene: jsecon run {inputs[0]}"
    return InputError(path, problem, expected, remedy)
