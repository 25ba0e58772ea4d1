"""Masks of frames from disk, on the host: labels of tracked regions, or the masks of single frames.

`READERS` is the table of formats. A reader takes a file, the (width, height) of its frame's image and LangSplat's
level. It returns ids (H, W), the same for the same object in every frame, 0 for no region (or negative: 0 is a region
then); or a list of masks (H, W) of this frame alone, the best first, which may overlap. Other packages add readers by
entry points in the group jsecon.masks. `jsecon.read.masks.names` says which file belongs to which frame.

LangSplat's `<frame>_s.npy` float32 (4, H, W) has ids by level, -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). The same thing has another row in each frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Int16

from jsecon.errors import InputError
from jsecon.files import map_npy, reading
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.captures.images import read_label_image
from jsecon.read.masks.json_masks import open_coco, read_json_masks
from jsecon.read.masks.names import AllFrames, FrameNames, MaskFiles, find_masks
from jsecon.read.registry import Reader, readers
from jsecon.types import Progress

LEVELS = ("default", "s", "m", "l")
"""levels of LangSplat's `_s.npy`, in their order: all of SAM's masks, subparts, parts, whole objects"""
_MAX_REGIONS = int(np.iinfo(np.int16).max)


def _read_level(path: Path, level: str) -> Int[np.ndarray, "h w"]:
    """Reads one level of LangSplat's `_s.npy`: (H, W) ids, -1 for no region."""
    if level not in LEVELS:
        raise InputError("level", f"there is no level {level!r}", f"one of {', '.join(LEVELS)}", "l is the coarsest.")
    expected = f"a .npy of shape ({len(LEVELS)}, H, W)"
    with reading(path, expected, "Write the masks again.", problem="the array is damaged or missing"):
        image = map_npy(path)
    if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
        expected = f"({len(LEVELS)}, H, W): levels {', '.join(LEVELS)}"
        remedy = "Give _s.npy files, not the _f.npy ones."
        raise InputError(path, f"the array has shape {image.shape}", expected, remedy)
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        image = np.asarray(image[LEVELS.index(level)], np.float64)
    # float32, LangSplat's type of ids, holds every integer below 1 << 24
    if not ((image >= -(1 << 24)) & (image < 1 << 24) & (image == image.round())).all():
        problem = "the array has numbers that are no integers or too large"
        raise InputError(path, problem, "ids, -1 for no region", "Write the masks again.")
    return image.astype(np.int64)


def _read_ids(path: Path, size: tuple[int, int], level: str) -> np.ndarray:
    """The ids of a .png or .npy."""
    return read_label_image(path)


def _read_langsplat(path: Path, size: tuple[int, int], level: str) -> list[np.ndarray]:
    """The masks of one level of LangSplat's `_s.npy`."""
    ids, image = _compact_ids(path, _read_level(path, level))
    return [image == index for index in range(len(ids))]


READERS = (
    Reader("LangSplat", ("_s.npy",), _read_langsplat),
    Reader("ids", (".png", ".npy"), _read_ids),
    Reader("SAM", (".json",), lambda path, size, level: read_json_masks(path, size)),
)


class TrackedMasks(NamedTuple):
    """Labels of tracked regions, and their ids in the files."""

    labels: Int16[np.ndarray, "t h w"]
    """-1 = none, else 0..R-1, the same region in every frame."""
    ids: tuple[int, ...]
    """R ids as the files have them (of a colour: R*65536 + G*256 + B), or numbers of objects or of masks in a frame."""
    notes: tuple[str, ...]
    """What was skipped or changed, a sentence each."""


class Proposals(NamedTuple):
    """Masks of single frames, read on demand."""

    read: Callable[[int], Bool[np.ndarray, "m h w"]]
    """Index of a frame -> its masks (M, H, W). Raises InputError if a file is damaged."""
    notes: tuple[str, ...]
    """What was skipped or changed, a sentence each."""


class FrameMasks(NamedTuple):
    """The masks of single frames with an embedding each."""

    labels: np.ndarray
    """(T, H, W) int32 rows of `embeddings`, -1 = none; no row is in two frames."""
    embeddings: np.ndarray
    """(M, E) float32 unit."""
    frame: np.ndarray
    """(M,) int32 the frame of each mask."""


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resizes an image of integers (H, W): each pixel has the value at its centre."""
    rows, columns = image.shape
    down = (2 * np.arange(height) + 1) * rows // (2 * height)
    across = (2 * np.arange(width) + 1) * columns // (2 * width)
    return image[down[:, None], across]


def _same_aspect(rows: int, columns: int, width: int, height: int) -> bool:
    """Whether an image has the aspect of a size, to a pixel of the coarser of the two, whose size was rounded."""
    return min(abs(columns * height / rows - width), abs(width * rows / height - columns)) <= 1


class _MaskFitter:
    """Brings masks, upright like their frames' images and at any scale, to the size (H, W) of the frames."""

    def __init__(self, frames: AllFrames, size: tuple[int, int]):
        self.files = {name: file for name, file in frames.items() if file is not None}
        self.height, self.width = size
        self.resized = 0

    def __call__(self, path: Path, image: np.ndarray, name: str) -> np.ndarray:
        """Resizes the mask of a frame to (H, W); raises InputError, with its file, for another aspect."""
        file = self.files.get(name)
        width, height = (self.width, self.height) if file is None else (file.width, file.height)
        rows, columns = image.shape
        sizes = (width, height), (self.width, self.height)
        if not any(_same_aspect(rows, columns, *size) for size in sizes):
            remedy = "Make the masks from the frames as they are loaded (undistorted, upright), at any scale."
            expected = f"{width}x{height} like its frame, or that aspect"
            raise InputError(path, f"the mask is {image.shape[1]}x{image.shape[0]}", expected, remedy)
        if image.shape == (self.height, self.width):
            return image
        self.resized += 1
        return resize_nearest(image, self.width, self.height)

    def notes(self) -> list[str]:
        """What was changed."""
        return [f"{self.resized} masks were resized to {self.width}x{self.height} (nearest)."] if self.resized else []


def _compact_ids(path: Path, image: np.ndarray) -> tuple[np.ndarray, Int16[np.ndarray, "h w"]]:
    """Replaces the ids of a label image, negative for no region, by their indices: the ids, ascending, and (H, W)."""
    if image.max(initial=0) < 1 << 20:
        # A table instead of a sort: some ten times faster, and most masks have small ids.
        seen = np.zeros(int(image.max(initial=0)) + 2, bool)
        seen[np.maximum(image, -1)] = True
        ids = np.flatnonzero(seen[:-1])
    else:
        ids = np.unique(image)
        ids = ids[ids >= 0]
    if len(ids) > _MAX_REGIONS + 1:  # and the background
        remedy = "Give label images, not photographs."
        raise InputError(path, f"the mask has {len(ids)} ids", f"at most {_MAX_REGIONS}", remedy)
    if not len(ids):
        return ids, np.full(image.shape, -1, np.int16)
    position = np.minimum(np.searchsorted(ids, image), len(ids) - 1)
    return ids, np.where(ids[position] == image, position, -1).astype(np.int16)


class _Source:
    """The masks of a folder, or of a COCO file, frame by frame at the size of the frames."""

    def __init__(self, folder: Path, names: Sequence[str], size: tuple[int, int], level: str, frames: AllFrames | None):
        self.folder, self.size, self.level = folder, size, level
        self.frames: AllFrames = frames or dict.fromkeys(names)
        self.coco = open_coco(folder, FrameNames(self.frames))
        self.files: MaskFiles | None = None
        if self.coco is None:
            self.files = find_masks(folder, self.frames, readers("jsecon.masks", READERS))
        self.names = [name for name in names if self._has(name)]
        if not self.names:
            problem = f"it has masks, but of none of the {len(names)} frames in use"
            raise InputError(folder, problem, f"a mask of {names[0]} and others", "Name each mask like its frame.")
        self.missing = [name for name in names if not self._has(name)]
        self.objects = self.files.objects if self.files else ()
        self.fit = _MaskFitter(self.frames, size)

    def _has(self, name: str) -> bool:
        return name in self.coco if self.coco is not None else self.files is not None and name in self.files.files

    def read(self, name: str) -> tuple[Path, np.ndarray | list[np.ndarray]]:
        """The file of a frame, and its ids or masks at the size of the frames."""
        file = self.frames.get(name)
        size = (self.size[1], self.size[0]) if file is None else (file.width, file.height)
        if self.coco is not None:
            path, stored = self.coco.file, self.coco.read(name, size)
        else:
            assert self.files is not None
            path = self.files.files[name][""]
            with reading(path, remedy="Write the masks again."):
                stored = self.files.reader.read(path, size, self.level)
        if not isinstance(stored, list):
            return path, self.fit(path, stored, name)
        masks = (self.fit(path, mask, name) for mask in stored)
        return path, [mask for mask in masks if mask.any()]

    def masks(self, name: str) -> list[np.ndarray]:
        """The masks (H, W) of a frame that have pixels at this size, one for each object, id or mask."""
        if self.objects:
            paths = self.files.files[name] if self.files else {}
            masks = [self._object(path, name) for path in paths.values()]
            return [mask for mask in masks if mask.any()]
        _, stored = self.read(name)
        return stored if isinstance(stored, list) else [stored == number for number in np.unique(stored) if number > 0]

    def object_labels(self, name: str) -> tuple[Path, np.ndarray]:
        """A file of a frame, and (H, W) index of the object of each pixel, the first on top, -1 for none."""
        paths = self.files.files[name] if self.files else {}
        labels = np.full(self.size, -1, np.int16)
        for key, path in reversed(paths.items()):
            labels[self._object(path, name)] = self.objects.index(key)
        return next(iter(paths.values())), labels

    def _object(self, path: Path, name: str) -> np.ndarray:
        """(H, W) mask of one object."""
        image = self.fit(path, read_label_image(path), name)
        if len(values := np.unique(image[image > 0])) > 1:
            objects = ", ".join(self.objects[:4])
            problem = f"the mask has {len(values)} values besides 0, but the folders {objects} hold objects"
            remedy = "Name folders of cameras like those of the images; make masks of objects black and white."
            raise InputError(path, problem, "one value for the object", remedy)
        return image > 0

    def notes(self) -> list[str]:
        """What was skipped or changed."""
        notes = list(self.files.notes) if self.files else []
        if self.missing:
            count = len(self.missing) + len(self.names)
            notes.insert(0, f"{len(self.missing)} of {count} frames have no masks (the first: {self.missing[0]}).")
        return notes + self.fit.notes()


def load_labels(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
) -> TrackedMasks:
    """Reads masks as labels (H, W) of regions over T frames called `names`.

    Ids mean the same object in every frame; the masks of single frames (SAM's, COCO's, LangSplat's) are regions of
    their own. Where masks overlap, the first lies on top. Masks must be of the frames as the capture was loaded,
    undistorted and upright; other sizes of the same aspect are resized (nearest). A frame without a mask is -1
    everywhere.

    `level` is LangSplat's, a name of LEVELS. `frames` are all frames of the capture in order, each with its image.
    `limit` is the most masks to read, for a check: other frames are left out.
    """
    source = _Source(Path(folder), names, size, level, frames)
    names = list(names) if limit is None else source.names[:limit]
    labels = np.full((len(names), *size), -1, np.int16)
    frame_ids: list[np.ndarray] = []
    is_shared, has_negative = True, False
    for t, name in enumerate(names):
        ids = np.zeros(0, np.int64)
        if name not in source.missing:
            path, stored = source.object_labels(name) if source.objects else source.read(name)
            if isinstance(stored, list):
                is_shared = False
                ids = np.arange(len(stored))
                for number in reversed(ids):
                    labels[t][stored[number]] = number
            else:
                has_negative |= not source.objects and bool(stored.min() < 0)
                ids, labels[t] = _compact_ids(path, stored)
        frame_ids.append(ids)
        if progress is not None:
            progress(t + 1, len(names))
    has_background = is_shared and not source.objects and not has_negative
    if is_shared:
        ids = np.unique(np.concatenate(frame_ids))
        ids = ids[ids != 0] if has_background else ids
        tables = [np.where(np.isin(each, ids), np.searchsorted(ids, each), -1) for each in frame_ids]
    else:
        ids = np.concatenate(frame_ids)
        starts = np.cumsum([0, *map(len, frame_ids)])
        tables = [each + start for each, start in zip(frame_ids, starts)]
    if len(ids) > _MAX_REGIONS:
        remedy = "Take a coarser level or fewer frames."
        raise InputError(folder, f"there are {len(ids)} regions", f"at most {_MAX_REGIONS}", remedy)
    for frame, table in zip(labels, tables):
        frame[:] = np.append(table, -1).astype(np.int16)[frame]
    notes = source.notes()
    if has_negative:
        notes.append("The masks hold negative ids: these count as unlabelled, and 0 as a region.")
    if not is_shared:
        notes.append("Each frame's masks count as regions of their own, since their ids are not shared.")
    return TrackedMasks(labels, tuple(map(int, ids)), tuple(notes))


def load_proposals(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> Proposals:
    """Finds the masks of single frames, which are read on demand; arguments as of `load_labels`."""
    source = _Source(Path(folder), names, size, level, frames)

    def read(index: int) -> Bool[np.ndarray, "m h w"]:
        masks = [] if names[index] in source.missing else source.masks(names[index])
        return np.stack([np.zeros(size, bool), *masks])[1:]

    return Proposals(read, tuple(source.notes()))


def load_features(
    folder: Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> FrameMasks:
    """Reads one level of the masks of frames as labels (H, W), with their embeddings.

    Masks that vanish at the size asked for are skipped. `frames` are all frames of the capture, each with its image.
    """
    every = frames or dict.fromkeys(names)
    found = find_masks(folder, every, (Reader("LangSplat", ("_s.npy",), _read_level),))

    fit = _MaskFitter(every, size)
    labels = np.full((len(names), *size), -1, np.int32)
    rows: list[np.ndarray] = []
    frame: list[int] = []
    for t, name in enumerate(names):
        masks = found.files.get(name, {}).get("", folder / f"{name}_s.npy")  # a missing file is an error of its reader
        file = masks.with_name(masks.name[: -len("_s.npy")] + "_f.npy")
        table = _read_table(file)
        if rows and table.shape[-1] != len(rows[0]):
            problem, expected = f"it has rows of {table.shape[-1]} numbers", f"{len(rows[0])}, as in the frames before"
            raise InputError(file, problem, expected, "Write all frames' files with the same model.")
        ids, indices = _compact_ids(masks, _read_level(masks, level))
        last = max(ids.tolist(), default=-1)
        if table.ndim != 2 or not is_finite_and_bounded(table) or last >= len(table):
            problem = f"it is an array {table.shape} for ids up to {last}"
            expected = "a finite row for each id of the _s.npy beside it"
            raise InputError(file, problem, expected, "Write both files of the frame again.")
        fitted = fit(masks, indices, name)
        kept = np.unique(fitted[fitted >= 0])
        row_of = np.full(len(ids) + 1, -1, np.int32)
        row_of[kept] = len(rows) + np.arange(len(kept))
        labels[t] = row_of[fitted]
        rows += [table[ids[k]] for k in kept]
        frame += [t] * len(kept)
    width = rows[0].shape[-1] if rows else 0
    embeddings = np.stack(rows).astype(np.float32) if rows else np.zeros((0, width), np.float32)
    return FrameMasks(labels, embeddings, np.array(frame, np.int32))


def embedding_size(folder: Path) -> int:
    """Reads the size E of the embeddings in a folder, by its first file."""
    files = sorted(folder.rglob("*_f.npy"))
    if not files:
        remedy = "Give the language_features folder that LangSplat's preprocess.py wrote."
        raise InputError(folder, "it holds no _f.npy", "<frame>_f.npy beside <frame>_s.npy", remedy)
    return int(_read_table(files[0]).shape[-1])


def _read_table(file: Path) -> np.ndarray:
    """Reads an array of embeddings."""
    with reading(file, "a (M, E) array, one row per mask", "Run LangSplat's preprocess.py on every frame."):
        table = map_npy(file)
        if table.ndim == 0:
            raise ValueError("a single number")
    return table
