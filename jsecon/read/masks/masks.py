"""Masks of frames from disk, on the host: labels of tracked regions, or the masks of single frames.

`READERS` is the table of formats. A reader takes a file, the (width, height) of its frame's image and LangSplat's
level. It returns ids (H, W), the same for the same object in every frame, 0 for no region (or negative: 0 is a region
then); or masks (H, W) by such ids, which may overlap; or a list of masks (H, W) of this frame alone, the best first,
which may overlap. Other packages add readers by entry points in the group jsecon.masks.

A mask is named like its frame, `<frame>.png`, or like the image's whole name (`<frame>.jpg.png`, as COLMAP has it). It
lies in the folder itself, or in subfolders named like those of the images (`cam0/<frame>.png`). Any other subfolders
stand for objects (`<object>/<frame>.png`, black and white, as SAM 2 writes them with --per_obj_png_file).

Masks must be of the frames as the capture was loaded, upright and undistorted. Other sizes of the same aspect are
resized (nearest).

LangSplat's `<frame>_s.npy` float32 (4, H, W) has ids by level, -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). The same thing has another row in each frame.

JSON is a file a frame of SAM's generator or of SA-1B, or COCO's one file for all frames. A mask is run-length encoded
or polygons. Run lengths are {"size": [H, W], "counts": ...}: runs of 0 and 1 in turn, 0 first, down the columns.
`counts` is a list of them, or COCO's text of 6-bit digits, decoded here: that also checks that the runs fill the mask,
and needs no compiled dependency. Polygons are [[x, y, x, y, ...], ...] in px of the image, and add up. Numbers by which
all frames know an object are `track_id` (TAO's; CVAT has it among `attributes`) or `instance_id` (CocoVID's).
"""

from __future__ import annotations

import collections
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Int, Int16

from jsecon.errors import InputError, join_first
from jsecon.files import list_files, map_npy, read_json, reading
from jsecon.read.captures.frames import same_aspect
from jsecon.read.captures.images import (
    IMAGE_SUFFIXES,
    MAX_PIXELS,
    read_label_image,
    whole_numbers,
    without_image_suffix,
)
from jsecon.read.masks.nesting import lies_in, nest_masks
from jsecon.read.registry import Reader, readers
from jsecon.types import ImageFile, Progress

LEVELS = ("default", "s", "m", "l")
"""levels of LangSplat's `_s.npy`, in their order: all of SAM's masks, subparts, parts, whole objects"""
_MAX_REGIONS = int(np.iinfo(np.int16).max)
_LARGEST = (255, 65535)
"""largest numbers of the types of ids: masks have them on pixels to ignore"""

AllFrames: TypeAlias = Mapping[str, ImageFile | None]
"""all frames of a capture in order, by name, each with its image or None"""
FrameContent: TypeAlias = np.ndarray | dict[int, np.ndarray] | list[np.ndarray]
"""ids (H, W) of a frame, or masks (H, W) by id, or masks of this frame alone, the best first"""
ReadMasks: TypeAlias = Callable[[tuple[int, int]], tuple[Path, FrameContent]]
"""(width, height) of the image of a frame -> a file, and what it holds"""
_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle, or as COCO polygons."
_MASK = '{"size": [H, W], "counts": a text or a list}, or polygons of three corners or more'
_JSON = 'a list of {"segmentation": ...}, or COCO\'s {"images", "annotations"}'


def _read_langsplat(path: Path, size: tuple[int, int], level: str) -> list[np.ndarray]:
    """The masks of one level of LangSplat's `_s.npy`."""
    expected = f"a .npy of shape ({len(LEVELS)}, H, W): ids of levels {', '.join(LEVELS)}, -1 for no region"
    with reading(path, expected, "Write the masks again.", problem="the array cannot be read"):
        image = map_npy(path)
        if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
            raise ValueError(f"its shape is {image.shape}")
        ids, image = compact_ids(path, whole_numbers(image[LEVELS.index(level)]))
    return [image == index for index in range(len(ids))]


def _decode_rle(rle: Any) -> Bool[np.ndarray, "h w"]:
    """Decodes a run-length encoded mask."""
    (height, width), counts = rle["size"], rle["counts"]
    runs = np.asarray(_parse_runs(counts) if isinstance(counts, str) else counts, np.int64)
    valid = runs.ndim == 1 and ((runs >= 0) & (runs <= MAX_PIXELS)).all()
    if not valid or height * width > MAX_PIXELS or runs.sum() != height * width:
        raise ValueError(f"its runs fill {int(runs.sum())} of {height}x{width} pixels")
    values = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(values, runs).reshape(width, height).T)


def _parse_runs(text: str) -> list[int]:
    """The runs in COCO's text of 6-bit digits.

    A digit has five bits of a number, the lowest first, and a sixth bit that says whether more follow; the highest bit
    of the last digit is the sign. From the fourth run on, a number is the difference from the run two before.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        digit = ord(character) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"{character!r} is not a digit of its runs")
        value |= (digit & 31) << shift
        shift += 5
        if not digit & 32:
            if digit & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the last run breaks off")
    return runs


def _fill_polygons(polygons: list[Any], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Draws COCO's polygons [[x, y, x, y, ...], ...], px, as one mask of `size` (width, height), edges included."""
    nested = all(isinstance(polygon, list) for polygon in polygons)
    corners = [np.asarray(each, np.float64).reshape(-1, 2) for each in (polygons if nested else [polygons])]
    if not all(len(each) > 2 and np.isfinite(each).all() for each in corners):
        raise ValueError("one of its polygons has no three corners")
    if min(size) < 1 or size[0] * size[1] > MAX_PIXELS:
        raise ValueError(f"its image is {size[0]}x{size[1]}")
    far = np.concatenate(corners)
    if (far < -1).any() or (far > np.array(size) + 1).any():  # corners may lie on the far edges
        raise ValueError(f"its polygons reach from {far.min(0).tolist()} to {far.max(0).tolist()}, beyond {size} px")
    canvas = np.zeros(size[::-1], np.uint8)
    for each in corners:
        cv2.fillPoly(canvas, [np.round(each).astype(np.int32)], 1)
    return canvas.astype(bool)


def _read_json_masks(file: Path, size: tuple[int, int], level: str) -> FrameContent:
    """The masks of one frame, the best first. Polygons are drawn on `size` (width, height), or on the file's."""
    content = read_json(file, _JSON, _REMEDY)
    with reading(file, _JSON, _REMEDY, problem="it holds no masks"):
        content = content if isinstance(content, dict) else {"annotations": content}
        image = [content.get("image"), *content.get("images", ())][-1]
        return _decode_records(file, list(content["annotations"]), image, size)[1]


def _decode_records(file: Path, records: list[Any], image: Any, size: tuple[int, int]) -> tuple[Path, FrameContent]:
    """The file, and the masks of its records, those with the best scores (SAM's stability times predicted IoU) first.

    They are by id if each has one of its own. `image` is the record of the image in the file, whose size goes before
    `size`.
    """
    size = (image["width"], image["height"]) if isinstance(image, dict) and "width" in image else size
    with reading(file, _JSON, _REMEDY, problem="a mask's score cannot be read"):
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    masks, tracks = [], []
    for number in np.argsort(-np.asarray(scores), kind="stable"):
        with reading(f"{file}, mask {number}", _MASK, _REMEDY, problem="the mask cannot be read"):
            if (segmentation := records[number]["segmentation"]) == []:
                continue
            is_rle, attributes = isinstance(segmentation, dict), records[number].get("attributes")
            masks.append(_decode_rle(segmentation) if is_rle else _fill_polygons(list(segmentation), size))
            keys = records[number] | (attributes if isinstance(attributes, dict) else {})
            tracks.append(keys.get("track_id", keys.get("instance_id")))
    has_ids = len(masks) == len({track for track in tracks if isinstance(track, int)})
    return file, dict(zip(tracks, masks)) if has_ids else masks


def _open_coco(folder: Path, names: Mapping[str, Sequence[str]]) -> dict[str, ReadMasks] | None:
    """Opens the COCO file of all frames: `folder` itself, or the only JSON in it, if that is no frame's and has images.

    `names` has what the image of each frame may be called, without its suffix and in small letters.
    """
    files = [folder] if folder.is_file() else list(folder.glob("*.json"))
    known = {name for spellings in names.values() for name in spellings}
    if len(files) != 1 or files[0].suffix.lower() != ".json" or files[0].stem.lower() in known:
        return None
    file, content = files[0], read_json(files[0], _JSON, _REMEDY)
    if file != folder and "images" not in content:
        return None
    found: dict[str, ReadMasks] = {}
    with reading(file, _JSON, _REMEDY, problem="it is not a COCO file"):
        records: dict[Any, list[Any]] = {image["id"]: [] for image in content["images"]}
        for record in content["annotations"]:
            records[record["image_id"]].append(record)
        images = {str(image["file_name"]).lower(): image for image in content["images"]}
        images |= {without_image_suffix(name): image for name, image in images.items()}
        for frame, spellings in names.items():
            for image in [images[name] for name in spellings if name in images][:1]:
                found[frame] = functools.partial(_decode_records, file, records[image["id"]], image)
        if not found:
            raise ValueError(f"none of its {len(records)} images is called like a frame, as {next(iter(names))} is")
    return found


READERS = (
    Reader("LangSplat", ("_s.npy",), _read_langsplat),
    Reader("ids", (".png", ".npy"), lambda path, size, level: read_label_image(path)),
    Reader("SAM", (".json",), _read_json_masks),
)


class _TrackedMasks(NamedTuple):
    """Labels of tracked regions, and their ids in the files."""

    labels: Int16[np.ndarray, "t h w"]
    """-1 = none, else 0..R-1, the same region in every frame."""
    ids: tuple[int, ...]
    """R ids as the files have them (of a colour: R*65536 + G*256 + B), or numbers of objects from 1 on."""
    notes: tuple[str, ...]
    """What was skipped or changed, a sentence each."""


def _mask_names(frames: AllFrames) -> dict[str, list[str]]:
    """What the mask of each frame may be called without its suffix, in small letters: like the frame or its image.

    That is, like the end of the image's path, but for a bare name that several images have.
    """
    paths = {name: PurePosixPath(name if file is None else file.path) for name, file in frames.items()}
    count = collections.Counter(without_image_suffix(path.name) for path in paths.values())
    names = {}
    for name, path in paths.items():
        ends = ["/".join(path.parts[n:]) for n in range(len(path.parts))]
        ends = ends[:-1] if count[without_image_suffix(path.name)] > 1 else ends
        names[name] = [key.lower() for end in (*ends, name) for key in (without_image_suffix(end), end)]
    return names


def _find_masks(
    folder: Path, names: dict[str, list[str]], formats: Sequence[Reader], level: str
) -> tuple[dict[str, ReadMasks], list[str]]:
    """Finds the masks of frames, of the first format of which there are any: readers by frame, and notes."""
    files = {path.relative_to(folder).as_posix().lower(): path for path in list_files(folder)}

    def matches(marks: Sequence[str], place: str = "") -> dict[str, Path]:
        found = {}
        for name, keys in names.items():
            paths = (files.get(f"{place}{key}{mark}".lower()) for key in keys for mark in marks)
            found[name] = next((path for path in paths if path is not None), None)
        return {name: path for name, path in found.items() if path is not None}

    for reader in formats:
        if found := matches(reader.marks):
            return {name: functools.partial(_read_file, reader, path, level) for name, path in found.items()}, []
    folders = {file.relative_to(folder).parts[0] for place, file in files.items() if "/" in place}
    if len(folders) == 1:
        return _find_masks(folder / folders.pop(), names, formats, level)
    objects = {place: matches([".png"], f"{place}/") for place in sorted(folders)}
    objects = {place: found for place, found in objects.items() if found}
    if not objects:
        found, suffixes = matches(IMAGE_SUFFIXES), [mark for reader in formats for mark in reader.marks]
        problem = "it holds no mask called like a frame" if folder.is_dir() else "there is no such folder"
        problem = f"{next(iter(found.values())).name} is no PNG" if found else problem
        remedy = "Name each mask like its frame, and export it anew: one converted from JPEG keeps the wrong ids."
        raise InputError(folder, problem, " or ".join(next(iter(names)) + suffix for suffix in suffixes), remedy)
    note = f"The folders {join_first([*objects])} are read as objects: each has black and white masks of one."
    paths: dict[str, dict[int, Path]] = collections.defaultdict(dict)
    for number, found in enumerate(objects.values(), start=1):
        for name, path in found.items():
            paths[name][number] = path
    return {name: functools.partial(_read_objects, mask_files) for name, mask_files in paths.items()}, [note]


def _find_ignored(frames: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[int | None, list[str]]:
    """Finds the id that stands for pixels to ignore, and notes; of each frame, its ids and its labels (`compact_ids`).

    It is one of _LARGEST, far above the others, most of which it touches.
    """
    ids = np.unique(np.concatenate([frame_ids[frame_ids > 0] for frame_ids, _ in frames] or [[0]]))
    if len(ids) < 3 or ids[-1] not in _LARGEST or ids[-1] - ids[-2] <= 2 * np.diff([0, *ids[:-1]]).max():
        return None, []
    touched = count = 0
    for frame_ids, labels in frames:
        if ids[-1] in frame_ids:
            inside = labels == len(frame_ids) - 1
            around = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3))) > 0
            touched += (frame_ids[np.unique(labels[around & (labels >= 0)])] > 0).sum() - 1
            count += (frame_ids > 0).sum() - 1
    if touched < 0.8 * count:
        return None, []
    borders = "it lies along the borders of the others and is the largest number of its type"
    return int(ids[-1]), [f"The id {ids[-1]} counts as unlabelled (pixels to ignore): {borders}."]


def _count_things(labels: Int16[np.ndarray, "h w"]) -> int:
    """Counts the connected regions of a frame that are more than a few pixels wide."""
    inner = (cv2.dilate(labels, np.ones((3, 3))) == cv2.erode(labels, np.ones((3, 3)))) & (labels >= 0)
    areas = cv2.connectedComponentsWithStats(inner.astype(np.uint8))[2][1:, cv2.CC_STAT_AREA]
    return int((areas >= 9).sum())


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resizes an image of integers (H, W): each pixel has the value at its centre."""
    rows, columns = image.shape
    down = (2 * np.arange(height) + 1) * rows // (2 * height)
    across = (2 * np.arange(width) + 1) * columns // (2 * width)
    return image[down[:, None], across]


def compact_ids(path: Path, image: np.ndarray) -> tuple[np.ndarray, Int16[np.ndarray, "h w"]]:
    """Replaces the ids of a label image, negative for no region, by their indices: the ids, ascending, and (H, W)."""
    ids, index = np.unique(image, return_inverse=True)
    unlabelled = int((ids < 0).sum())
    if len(ids) - unlabelled > _MAX_REGIONS + 1:  # and the background
        raise InputError(path, f"the mask has {len(ids)} ids", f"at most {_MAX_REGIONS}", "Give images of labels.")
    return ids[unlabelled:], np.maximum(index.reshape(image.shape) - unlabelled, -1).astype(np.int16)


def _read_file(reader: Reader, path: Path, level: str, size: tuple[int, int]) -> tuple[Path, Any]:
    """The file of a frame, and its ids or masks."""
    with reading(path, remedy="Write the masks again."):
        return path, reader.read(path, size, level)


def _read_objects(paths: dict[int, Path], size: tuple[int, int]) -> tuple[Path, dict[int, Bool[np.ndarray, "h w"]]]:
    """A file of a frame, and the masks of its objects by id. `paths` are those by id, from 1 on."""
    masks = {}
    for number, file in paths.items():
        image = read_label_image(file)
        with reading(file, remedy="Name folders of cameras like those of the images."):
            if len(values := np.unique(image[image > 0])) > 1:
                raise ValueError(f"it has {len(values)} values besides 0, but its folder is that of an object")
        masks[number] = image > 0
    return next(iter(paths.values())), masks


class _Source:
    """The masks of a folder, or of a COCO file, frame by frame at the size of the frames."""

    def __init__(self, folder: Path, names: Sequence[str], size: tuple[int, int], frames: AllFrames | None, level: str):
        self.size, self.frames, self.notes = size, frames or dict.fromkeys(names), []
        mask_names = {name: spellings for name, spellings in _mask_names(self.frames).items() if name in names}
        found = _open_coco(folder, mask_names)
        if found is None:
            found, self.notes = _find_masks(folder, mask_names, readers("jsecon.masks", READERS), level)
        self.readers: dict[str, ReadMasks] = found
        self.missing = [name for name in names if name not in self.readers]
        if self.missing:
            note = f"{len(self.missing)} of {len(names)} frames have no masks (the first: {self.missing[0]})."
            self.notes.insert(0, note)

    def read(self, name: str) -> tuple[Path, FrameContent]:
        """A file of a frame, and its ids or masks (those that have pixels) at the size of the frames."""
        file = self.frames.get(name)
        size = (self.size[1], self.size[0]) if file is None else (file.width, file.height)
        path, stored = self.readers[name](size)
        if isinstance(stored, np.ndarray):
            return path, self._fit(path, stored, size)
        numbered = stored.items() if isinstance(stored, dict) else enumerate(stored)
        masks = {number: fit for number, mask in numbered if (fit := self._fit(path, mask, size)).any()}
        return path, masks if isinstance(stored, dict) else list(masks.values())

    def _fit(self, path: Path, image: np.ndarray, upright: tuple[int, int]) -> np.ndarray:
        """Resizes the mask of a frame to (H, W); raises InputError for another aspect than `upright`."""
        size = image.shape[::-1]
        if not same_aspect(upright, size) and not same_aspect(self.size[::-1], size):
            expected = f"{upright[0]}x{upright[1]} like its frame, or that aspect"
            raise InputError(path, f"the mask is {size[0]}x{size[1]}", expected, "Make it of the undistorted image.")
        return image if image.shape == self.size else resize_nearest(image, self.size[1], self.size[0])


def load_labels(folder: str | Path, names: Sequence[str], size: tuple[int, int], **options: Any) -> _TrackedMasks:
    """Reads masks as labels (H, W) of regions over T frames called `names`, as `load_nested_labels` does."""
    return load_nested_labels(folder, names, size, **options)[0]


def load_nested_labels(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    frames: AllFrames | None = None,
    progress: Progress = lambda done, total: None,
) -> tuple[_TrackedMasks, Int[np.ndarray, " r"]]:
    """Reads masks as labels (H, W) of regions over T frames called `names`, and the parent of each (`nest_masks`).

    Ids mean the same object in every frame. A frame without a mask is -1 everywhere. Of masks that overlap, one
    that lies in another is on top, and else the one of the smallest id. `frames` are all frames of the capture in
    order, each with its image.
    """
    source = _Source(Path(folder), names, size, frames, "l")
    labels = np.full((len(names), *size), -1, np.int16)
    frame_ids: list[np.ndarray] = []
    nesting, has_negative = {}, False
    for t, name in enumerate(names):
        ids = np.zeros(0, np.int64)
        if name not in source.missing:
            path, stored = source.read(name)
            if isinstance(stored, list):
                remedy = "Give masks of single frames as --proposals."
                raise InputError(path, "its masks are of a single frame", "ids of objects in all frames", remedy)
            if isinstance(stored, dict):
                ids, has_negative = np.array(sorted(stored), np.int64), True
                masks = np.stack([np.zeros(size, bool), *(stored[number] for number in ids)])[1:]
                nesting[t] = lies_in(masks)
                for row in np.lexsort((-ids, nesting[t][0].sum(1))):
                    labels[t][masks[row]] = row
            else:
                has_negative |= bool(stored.min() < 0)
                ids, labels[t] = compact_ids(path, stored)
        frame_ids.append(ids)
        progress(t + 1, len(names))
    ignored, ignored_notes = _find_ignored([*zip(frame_ids, labels)])
    ids = np.setdiff1d(np.concatenate(frame_ids), [] if ignored is None else [ignored])
    ids = ids if has_negative else ids[ids != 0]
    tables = [np.where(np.isin(each, ids), np.searchsorted(ids, each), -1) for each in frame_ids]
    if len(ids) > _MAX_REGIONS:
        raise InputError(folder, f"there are {len(ids)} regions", f"at most {_MAX_REGIONS}", "Take fewer frames.")
    for frame, table in zip(labels, tables):
        frame[:] = np.append(table, -1).astype(np.int16)[frame]
    parent = nest_masks([(tables[t], *found) for t, found in nesting.items()], len(ids))
    notes = [*source.notes, *ignored_notes]
    if count := np.count_nonzero(parent >= 0):
        notes.append(f"The masks of {count} of the {len(ids)} regions lie in those of others, as parts.")
    things = np.median([_count_things(frame) for frame in labels])
    if len(ids) > 10 * max(things, 1):
        hint = f"There are {len(ids)} ids, but a frame shows some {things:.0f} connected things."
        notes.append(f"{hint} Give masks that each frame numbers anew as --proposals; export smoothed colours again.")
    return _TrackedMasks(labels, tuple(map(int, ids)), tuple(notes)), parent


def load_proposals(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> tuple[Callable[[int], Bool[np.ndarray, "m h w"]], tuple[str, ...]]:
    """Finds the masks of single frames: a function from a frame's index to its masks (M, H, W), and notes.

    The function raises InputError if a file is damaged. `level` is LangSplat's, a name of LEVELS; other arguments as of
    `load_labels`.
    """
    source = _Source(Path(folder), names, size, frames, level)

    def read(index: int) -> Bool[np.ndarray, "m h w"]:
        if names[index] in source.missing:
            return np.zeros((0, *size), bool)
        path, stored = source.read(names[index])
        stored = list(stored.values()) if isinstance(stored, dict) else stored
        if not isinstance(stored, list):
            ids, labels = compact_ids(path, stored)
            ignored, _ = _find_ignored([(ids, labels)])
            stored = [labels == row for row, number in enumerate(ids) if number > 0 and number != ignored]
        return np.stack([np.zeros(size, bool), *stored])[1:]

    return read, tuple(source.notes)
