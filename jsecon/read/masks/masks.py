"""Masks of frames from disk, on the host: labels of tracked regions, or the masks of single frames.

`READERS` is the table of formats. A reader takes a file, the (width, height) of its frame's image and LangSplat's
level. It returns ids (H, W), the same for the same object in every frame, 0 for no region (or negative: 0 is a region
then); or a list of masks (H, W) of this frame alone, the best first, which may overlap. Other packages add readers by
entry points in the group jsecon.masks.

A mask is named like its frame, `<frame>.png`, or like the image's whole name (`<frame>.jpg.png`, as COLMAP has it). It
lies in the folder itself, or in subfolders named like those of the images (`cam0/<frame>.png`). Any other subfolders
stand for objects (`<object>/<frame>.png`, black and white, as SAM 2 writes them with --per_obj_png_file).

Masks must be of the frames as the capture was loaded, upright and undistorted. Other sizes of the same aspect are
resized (nearest).

LangSplat's `<frame>_s.npy` float32 (4, H, W) has ids by level, -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). The same thing has another row in each frame.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Int, Int16

from jsecon.errors import InputError, join_first
from jsecon.files import list_files, map_npy, reading
from jsecon.read.captures.frames import same_aspect
from jsecon.read.captures.images import IMAGE_SUFFIXES, read_label_image
from jsecon.read.masks.json_masks import READER as JSON_READER, ReadMasks, open_coco
from jsecon.read.registry import Reader, readers
from jsecon.types import ImageFile, Progress

LEVELS = ("default", "s", "m", "l")
"""levels of LangSplat's `_s.npy`, in their order: all of SAM's masks, subparts, parts, whole objects"""
_MAX_REGIONS = int(np.iinfo(np.int16).max)
_LARGEST = (255, 65535)
"""largest numbers of the types of ids: masks have them on pixels to ignore"""

AllFrames: TypeAlias = Mapping[str, ImageFile | None]
"""all frames of a capture in order, by name, each with its image or None"""


@np.errstate(invalid="ignore")  # of a signalling NaN
def _read_level(path: Path, size: tuple[int, int], level: str) -> Int[np.ndarray, "h w"]:
    """Reads one level of LangSplat's `_s.npy`: (H, W) ids, -1 for no region."""
    if level not in LEVELS:
        raise InputError("level", f"there is no level {level!r}", f"one of {', '.join(LEVELS)}", "l is the coarsest.")
    expected = f"a .npy of shape ({len(LEVELS)}, H, W): ids of levels {', '.join(LEVELS)}, -1 for no region"
    with reading(path, expected, "Write the masks again.", problem="the array cannot be read"):
        image = map_npy(path)
        if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
            raise ValueError(f"its shape is {image.shape}")
        image = np.asarray(image[LEVELS.index(level)], np.float64)
        # float32, LangSplat's type of ids, holds every integer below 1 << 24
        if not ((image >= -(1 << 24)) & (image < 1 << 24) & (image == image.round())).all():
            raise ValueError("it has numbers that are no integers or too large")
    return image.astype(np.int64)


def _read_langsplat(path: Path, size: tuple[int, int], level: str) -> list[np.ndarray]:
    """The masks of one level of LangSplat's `_s.npy`."""
    ids, image = _compact_ids(path, _read_level(path, size, level))
    return [image == index for index in range(len(ids))]


READERS = (
    Reader("LangSplat", ("_s.npy",), _read_langsplat),
    Reader("ids", (".png", ".npy"), lambda path, size, level: read_label_image(path)),
    JSON_READER,
)


class _TrackedMasks(NamedTuple):
    """Labels of tracked regions, and their ids in the files."""

    labels: Int16[np.ndarray, "t h w"]
    """-1 = none, else 0..R-1, the same region in every frame."""
    ids: tuple[int, ...]
    """R ids as the files have them (of a colour: R*65536 + G*256 + B), or numbers of objects from 1 on; masks of single
    frames are counted from 0 on."""
    notes: tuple[str, ...]
    """What was skipped or changed, a sentence each."""


class _Match(NamedTuple):
    """A mask file that is named like a frame."""

    frame: str
    extra: str
    """Its folders that the frame's image does not have, with "/"."""
    path: PurePosixPath
    """Path in the folder of masks."""


_Matcher: TypeAlias = Callable[[PurePosixPath, str], _Match | None]


def _match_frames(frames: AllFrames) -> _Matcher:
    """Makes a function from the path of a mask file in its folder, and its suffix, to its frame.

    It returns None if no frame fits, or two equally well.
    """
    by_key: dict[str, list[tuple[str, tuple[str, ...]]]] = collections.defaultdict(list)
    for name, file in frames.items():
        path = PurePosixPath(name if file is None else file.path)
        stem = name if file is None else _without_image_suffix(path.name)
        for key, folders in {name: (), stem: path.parts[:-1]}.items():
            by_key[key].append((name, folders))

    def match(path: PurePosixPath, suffix: str) -> _Match | None:
        base = path.name[: len(path.name) - len(suffix)]
        for key in dict.fromkeys((base, _without_image_suffix(base))):
            fits = [(_extra_folders(path.parts[:-1], folders), name) for name, folders in by_key.get(key, ())]
            if fits:
                fewest = min(len(extra) for extra, _ in fits)
                (extra, name), *others = (fit for fit in fits if len(fit[0]) == fewest)
                return None if others else _Match(name, "/".join(extra), path)
        return None

    return match


def _without_image_suffix(name: str) -> str:
    """The name without the suffix of an image."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in IMAGE_SUFFIXES else name


def _extra_folders(folders: tuple[str, ...], of_image: tuple[str, ...]) -> list[str]:
    """The folders of a mask that its image does not have."""
    others, extra = list(of_image), []
    for folder in reversed(folders):
        if folder in others:
            others.remove(folder)
        else:
            extra.insert(0, folder)
    return extra


def _find_masks(
    folder: Path, frames: AllFrames, match: _Matcher, formats: Sequence[Reader], level: str
) -> tuple[dict[str, ReadMasks], list[str]]:
    """Finds the masks of frames, which must be of one format: readers by frame, and notes."""
    if not folder.is_dir():
        problem = "this is a file" if folder.exists() else "there is no such folder"
        raise InputError(folder, problem, "a folder of masks", "Check the path.")
    matched: dict[Reader, list[_Match]] = collections.defaultdict(list)
    unmatched: dict[Reader, list[Path]] = collections.defaultdict(list)
    unread = []
    for path in list_files(folder):
        reader = next((reader for reader in formats if reader.fits(path)), None)
        marks = () if reader is None else reader.marks
        suffix = next((mark for mark in marks if path.name.lower().endswith(mark)), path.suffix)
        found = match(PurePosixPath(path.relative_to(folder)), suffix)
        if reader is None:
            unread += [] if found is None else [path]
        elif found is None:
            unmatched[reader].append(path)
        else:
            matched[reader].append(found)
    if not matched:
        for path in unread:
            suffix = path.suffix.lower()
            if suffix in (*IMAGE_SUFFIXES, ".npz", ".gif", ".exr"):  # may be meant as masks
                remedy = "Export the masks again: one that is converted from JPEG keeps the wrong ids."
                raise InputError(path, f"the mask is a {suffix} file", "a PNG or .npy", remedy)
        count = sum(map(len, unmatched.values()))
        problem = f"it holds {count} masks{', none of which is called like a frame' if count else ''}"
        expected = " or ".join(next(iter(frames)) + mark for reader in formats for mark in reader.marks) + " and so on"
        raise InputError(folder, problem, expected, "Name each mask like its frame.")
    if len(matched) > 1:
        first, second = (reader.marks[0] for reader in list(matched)[:2])
        problem = f"there are both {first} and {second} masks of these frames"
        raise InputError(folder, problem, "one kind", "Put each kind into a folder of its own.")
    ((reader, matches),) = matched.items()
    # Folders that the images do not have stand for objects, if all files lie in several of them.
    extras = sorted({found.extra for found in matches}, key=_natural_order)
    objects = extras if "" not in extras and len(extras) > 1 else []
    notes = []
    if objects:
        notes.append(f"The folders {join_first(objects)} are read as objects: each has black and white masks of one.")
    elif extras[1:]:
        notes.append(f"Masks in other folders ({join_first(extras[1:])}) were not used.")
    if others := unmatched[reader]:
        files = f"{len(others)} of the {reader.marks[0]} files, first {others[0].name}"
        notes.append(f"There are masks of no frame of this capture: {files}.")
    paths: dict[str, dict[str, Path]] = collections.defaultdict(dict)
    for found in sorted(matches, key=lambda found: -len(found.path.parts)):
        if found.extra in (objects or extras[:1]):
            paths[found.frame].setdefault(found.extra, folder / found.path)
    return {name: functools.partial(_read_files, reader, objects, some, level) for name, some in paths.items()}, notes


class _FrameIds(NamedTuple):
    """What the ids of a frame look like."""

    ids: set[int]
    """All that are above 0."""
    largest: int
    """The largest, if it is one of _LARGEST, else 0."""
    neighbours: set[int]
    """Those that touch the largest."""


def _inspect_ids(image: Int[np.ndarray, "h w"]) -> _FrameIds:
    """Looks for the id of one frame that may stand for no object."""
    ids = {number for number in np.unique(image).tolist() if number > 0}
    largest = max(ids, default=0)
    if largest not in _LARGEST:
        return _FrameIds(ids, 0, set())
    around = (cv2.dilate((image == largest).astype(np.uint8), np.ones((3, 3))) > 0) & (image > 0)
    return _FrameIds(ids, largest, {*np.unique(image[around]).tolist()} - {largest})


def _find_ignored(frames: Sequence[_FrameIds]) -> int | None:
    """The id that stands for pixels to ignore: one of _LARGEST, far above the others, most of which it touches."""
    largest = max((frame.largest for frame in frames), default=0)
    others = sorted(set().union(*(frame.ids for frame in frames)) - {largest})
    if not largest or len(others) < 2 or largest - others[-1] <= 2 * max(np.diff([0, *others])):
        return None
    marked = [frame for frame in frames if frame.largest]
    touched = sum(len(frame.neighbours) for frame in marked)
    return largest if touched >= 0.8 * sum(len(frame.ids) - 1 for frame in marked) else None


def _ignored_notes(ignored: int | None) -> list[str]:
    """Says which id was taken as unlabelled."""
    borders = "it lies along the borders of the others and is the largest number of its type"
    return [] if ignored is None else [f"The id {ignored} counts as unlabelled (pixels to ignore): {borders}."]


def _count_things(labels: Int16[np.ndarray, "h w"]) -> int:
    """Counts the connected regions of a frame that are more than a few pixels wide."""
    inner = (cv2.dilate(labels, np.ones((3, 3))) == cv2.erode(labels, np.ones((3, 3)))) & (labels >= 0)
    areas = cv2.connectedComponentsWithStats(inner.astype(np.uint8))[2][1:, cv2.CC_STAT_AREA]
    return int((areas >= 9).sum())


def _natural_order(name: str) -> tuple[str, int, str]:
    """Sort key that puts 9 before 10."""
    return re.sub(r"\d+", lambda number: number[0].zfill(20), name), len(name), name


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resizes an image of integers (H, W): each pixel has the value at its centre."""
    rows, columns = image.shape
    down = (2 * np.arange(height) + 1) * rows // (2 * height)
    across = (2 * np.arange(width) + 1) * columns // (2 * width)
    return image[down[:, None], across]


def _compact_ids(path: Path, image: np.ndarray) -> tuple[np.ndarray, Int16[np.ndarray, "h w"]]:
    """Replaces the ids of a label image, negative for no region, by their indices: the ids, ascending, and (H, W)."""
    ids, index = np.unique(image, return_inverse=True)
    unlabelled = int((ids < 0).sum())
    if len(ids) - unlabelled > _MAX_REGIONS + 1:  # and the background
        remedy = "Give label images, not photographs."
        raise InputError(path, f"the mask has {len(ids)} ids", f"at most {_MAX_REGIONS}", remedy)
    return ids[unlabelled:], np.maximum(index.reshape(image.shape) - unlabelled, -1).astype(np.int16)


def _read_files(
    reader: Reader, objects: Sequence[str], paths: dict[str, Path], level: str, size: tuple[int, int]
) -> tuple[Path, np.ndarray | list[np.ndarray]]:
    """A file of a frame, and its ids or masks; of objects, ids from 1 on, the first on top."""
    path, ids = next(iter(paths.values())), np.zeros((0, 0), np.int64)
    if not objects:
        with reading(path, remedy="Write the masks again."):
            return path, reader.read(path, size, level)
    for number, name in reversed([*enumerate(objects, start=1)]):
        if name not in paths:
            continue
        image = read_label_image(paths[name])
        if len(values := np.unique(image[image > 0])) > 1:
            folders = ", ".join(objects[:4])
            problem = f"the mask has {len(values)} values besides 0, but the folders {folders} hold objects"
            remedy = "Name folders of cameras like those of the images; make masks of objects black and white."
            raise InputError(paths[name], problem, "one value for the object", remedy)
        ids = ids if ids.size else np.zeros(image.shape, np.int64)
        if image.shape != ids.shape:
            problem, expected = f"the mask is {image.shape[1]}x{image.shape[0]}", f"{ids.shape[1]}x{ids.shape[0]}"
            raise InputError(paths[name], problem, f"{expected}, as others of its frame", "Write all at one size.")
        ids[image > 0] = number
    return path, ids


class _Source:
    """The masks of a folder, or of a COCO file, frame by frame at the size of the frames."""

    def __init__(self, folder: Path, names: Sequence[str], size: tuple[int, int], level: str, frames: AllFrames | None):
        self.size, self.frames = size, frames or dict.fromkeys(names)
        self.resized = 0
        self.notes: list[str] = []
        match = _match_frames(self.frames)
        found = open_coco(folder, match)
        if found is None:
            found, self.notes = _find_masks(folder, self.frames, match, readers("jsecon.masks", READERS), level)
        self.readers: dict[str, ReadMasks] = found
        self.missing = [name for name in names if name not in self.readers]
        if len(self.missing) == len(names):
            problem = f"it has masks, but of none of the {len(names)} frames in use"
            raise InputError(folder, problem, f"a mask of {names[0]} and others", "Name each mask like its frame.")
        if self.missing:
            note = f"{len(self.missing)} of {len(names)} frames have no masks (the first: {self.missing[0]})."
            self.notes.insert(0, note)

    def read(self, name: str) -> tuple[Path, np.ndarray | list[np.ndarray]]:
        """A file of a frame, and its ids or masks (those that have pixels) at the size of the frames."""
        path, stored = self.readers[name](self._image_size(name))
        if not isinstance(stored, list):
            return path, self._fit(path, stored, name)
        masks = (self._fit(path, mask, name) for mask in stored)
        return path, [mask for mask in masks if mask.any()]

    def _image_size(self, name: str) -> tuple[int, int]:
        """(width, height) of the image of a frame."""
        file = self.frames.get(name)
        return (self.size[1], self.size[0]) if file is None else (file.width, file.height)

    def _fit(self, path: Path, image: np.ndarray, name: str) -> np.ndarray:
        """Resizes the mask of a frame to (H, W); raises InputError, with its file, for another aspect."""
        upright, size = self._image_size(name), image.shape[::-1]
        if not same_aspect(upright, size) and not same_aspect(self.size[::-1], size):
            remedy = "Make the masks from the frames as they are loaded (undistorted, upright), at any scale."
            expected = f"{upright[0]}x{upright[1]} like its frame, or that aspect"
            raise InputError(path, f"the mask is {size[0]}x{size[1]}", expected, remedy)
        if image.shape == self.size:
            return image
        self.resized += 1
        return resize_nearest(image, self.size[1], self.size[0])


def load_labels(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
) -> _TrackedMasks:
    """Reads masks as labels (H, W) of regions over T frames called `names`.

    Ids mean the same object in every frame; the masks of single frames (SAM's, COCO's, LangSplat's) are regions of
    their own. Where masks overlap, the first lies on top. A frame without a mask is -1 everywhere.

    `level` is LangSplat's, a name of LEVELS. `frames` are all frames of the capture in order, each with its image.
    `limit` is the most masks to read, for a check: other frames are left out.
    """
    source = _Source(Path(folder), names, size, level, frames)
    names = list(names) if limit is None else [name for name in names if name not in source.missing][:limit]
    labels = np.full((len(names), *size), -1, np.int16)
    frame_ids: list[np.ndarray] = []
    inspected: list[_FrameIds] = []
    is_shared, has_negative, count = True, False, 0
    for t, name in enumerate(names):
        ids = np.zeros(0, np.int64)
        if name not in source.missing:
            path, stored = source.read(name)
            if isinstance(stored, list):
                is_shared, image = False, np.full(size, -1)
                for number, mask in reversed([*enumerate(stored, start=count)]):
                    image[mask] = number
                stored, count = image, count + len(stored)
            else:
                inspected.append(_inspect_ids(stored))
                has_negative |= bool(stored.min() < 0)
            ids, labels[t] = _compact_ids(path, stored)
        frame_ids.append(ids)
        if progress is not None:
            progress(t + 1, len(names))
    ignored = _find_ignored(inspected)
    ids = np.setdiff1d(np.concatenate(frame_ids), [] if ignored is None else [ignored])
    ids = ids[ids != 0] if is_shared and not has_negative else ids
    tables = [np.where(np.isin(each, ids), np.searchsorted(ids, each), -1) for each in frame_ids]
    if len(ids) > _MAX_REGIONS:
        remedy = "Take a coarser level or fewer frames."
        raise InputError(folder, f"there are {len(ids)} regions", f"at most {_MAX_REGIONS}", remedy)
    for frame, table in zip(labels, tables):
        frame[:] = np.append(table, -1).astype(np.int16)[frame]
    notes = [*source.notes, *_ignored_notes(ignored)]
    things = np.median([_count_things(frame) for frame in labels]) if is_shared else np.inf
    if len(ids) > 10 * max(things, 1):
        hint = f"There are {len(ids)} ids, but a frame shows some {things:.0f} connected things."
        reasons = "If each frame numbers its masks anew, give them as --proposals"
        notes.append(f"{hint} {reasons}; if colours were smoothed or compressed, export the masks again.")
    if source.resized:
        notes.append(f"{source.resized} masks were resized to {size[1]}x{size[0]} (nearest).")
    if has_negative:
        notes.append("The masks hold negative ids: these count as unlabelled, and 0 as a region.")
    if not is_shared:
        notes.append("Each frame's masks count as regions of their own, since their ids are not shared.")
    return _TrackedMasks(labels, tuple(map(int, ids)), tuple(notes))


def load_proposals(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> tuple[Callable[[int], Bool[np.ndarray, "m h w"]], tuple[str, ...]]:
    """Finds the masks of single frames: a function from a frame's index to its masks (M, H, W), and notes.

    The function raises InputError if a file is damaged. Arguments as of `load_labels`.
    """
    source = _Source(Path(folder), names, size, level, frames)
    present = [name for name in names if name not in source.missing]
    some = []
    for name in present[:3]:
        with contextlib.suppress(InputError):  # which comes when the frame is asked for
            stored = source.read(name)[1]
            some += [] if isinstance(stored, list) else [stored]
    ignored = _find_ignored([_inspect_ids(stored) for stored in some])

    def read(index: int) -> Bool[np.ndarray, "m h w"]:
        _, stored = (None, []) if names[index] in source.missing else source.read(names[index])
        if not isinstance(stored, list):
            stored = [stored == number for number in np.unique(stored) if number > 0 and number != ignored]
        return np.stack([np.zeros(size, bool), *stored])[1:]

    return read, (*source.notes, *_ignored_notes(ignored))
