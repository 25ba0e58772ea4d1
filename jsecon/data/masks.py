"""Masklets from disk: one label image per frame, or one black and white mask per object and frame, matched by name."""

from __future__ import annotations

import collections
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int16

from jsecon.data.frames import Progress
from jsecon.data.images import TRANSPOSED, apply_orientation, read_label_image
from jsecon.data.mask_names import Masks, find_masks, object_ids
from jsecon.errors import InputError, describe_error
from jsecon.files import READ_ERRORS, map_npy
from jsecon.types import ImageFile

LEVELS = ("default", "s", "m", "l")
"""LangSplat's levels in the order of its `_s.npy`: all of SAM's masks, subpart, part, whole"""
MOST_REGIONS = int(np.iinfo(np.int16).max)
MOST_IDS = 1 << 24
"""what float32, in which LangSplat writes ids, holds without a gap"""
GREY = 65793
"""the number of the colour (1, 1, 1), R*65536 + G*256 + B"""
_SUFFIX = "_s.npy"


class MasksFromDisk(NamedTuple):
    """Labels as the pipeline wants them, and what they were called in the files."""

    labels: Int16[np.ndarray, "t h w"]
    """-1 = none, else 0..R-1, the same region in every frame."""
    ids: tuple[int, ...]
    """R ids as they are in the files (of a colour: R*65536 + G*256 + B)."""
    notes: tuple[str, ...]
    """what was left out or changed, a sentence each."""


def load_labels(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    background: int | None = 0,
    level: str | int = "l",
    shared: bool | None = None,
    order: Sequence[str] | None = None,
    files: Mapping[str, ImageFile] | None = None,
    progress: Progress = None,
) -> MasksFromDisk:
    """Reads the masks in `folder` of the frames called `names` as labels (T, H, W).

    A mask is called like its frame: `<name>.png`, also `<name>.jpg.png` or `<name>_mask.png`. It has an id per pixel:
    8 or 16 bit grey, a palette PNG (its indices), RGB (each colour an id, R*65536 + G*256 + B), or whole numbers in a
    `.npy`. Such are Gaussian Grouping's object_mask and SAM 2's PNGs. Or it is LangSplat's `<name>_s.npy` (4, H, W),
    -1 = none.

    Subfolders named like those of the images are cameras. Other subfolders of black and white masks are objects, as SAM
    2 writes them with --per_obj_png_file (`<id>/<name>.png`); where they overlap the lower id lies on top.

    Masks must be of the frames as the capture was loaded, undistorted. Another size is resized to theirs (nearest)
    where the aspect agrees to a pixel; masks of stored pixels are turned like their images. A frame without a mask file
    is wholly -1. The notes tell all of it.

    Args:
      folder: The masks.
      names: T frames.
      size: (H, W) of the labels.
      background: The id of no region; None: every id is one.
      level: LangSplat's level: "default", "s", "m", "l", or its index.
      shared: Whether an id means the same object in every frame. By default so for all but `_s.npy`: LangSplat numbers
        the masks of each frame afresh, and each is a region of its own. Say True for tracked ones.
      order: All frames of the capture. Where no file is called like a frame and the files are numbered from 0 to
        len(order) - 1, as SAM 2 wants them, number n is the mask of order[n].
      files: The image of each frame, by its name: its folders are the cameras', its orientation that of its masks.
      progress: Called with (frames done, frames).

    Raises:
      InputError: No frame has a mask, a file is damaged, or of another aspect or kind, or there are more than 32767
        regions.
    """
    folder = Path(folder)
    height, width = size
    found = _masks_of(folder, names, order, files)
    shared = found.ending != _SUFFIX if shared is None else shared
    reader = _Reader(found, names, level, None if found.objects else background, files or {}, size)
    labels = np.full((len(names), height, width), -1, np.int16)
    own_ids: list[np.ndarray] = []
    for index, name in enumerate(names):
        own, labels[index] = reader.read(name)
        own_ids.append(own)
        if progress is not None:
            progress(index + 1, len(names))
    own_ids = reader.without_background(folder, own_ids)

    if shared:
        ids = np.unique(np.concatenate(own_ids))
        ids = ids[ids >= 0]
        tables = [np.where(own >= 0, np.searchsorted(ids, own), -1) for own in own_ids]
    else:
        kept = [own >= 0 for own in own_ids]
        ids = np.concatenate([own[keep] for own, keep in zip(own_ids, kept)])
        starts = np.cumsum([0, *(int(keep.sum()) for keep in kept)])
        tables = [np.where(keep, np.cumsum(keep) - 1 + start, -1) for keep, start in zip(kept, starts)]
    if len(ids) > MOST_REGIONS:
        remedy = "Take a coarser level, fewer frames, or say shared=True if the ids are tracked."
        raise InputError(folder, f"there are {len(ids)} regions", f"at most {MOST_REGIONS}", remedy)
    for frame, table in zip(labels, tables):
        frame[:] = np.append(table, -1).astype(np.int16)[frame]
    return MasksFromDisk(labels, reader.named(ids), (*reader.notes(not shared), *found.notes))


def check_labels(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str | int = "l",
    order: Sequence[str] | None = None,
    files: Mapping[str, ImageFile] | None = None,
) -> None:
    """Raises InputError where `load_labels` would, as far as the names of the masks and the first of them tell."""
    found = _masks_of(Path(folder), names, order, files)
    first = next(name for name in names if found.path(name) is not None)
    load_labels(folder, [first], size, level=level, order=order, files=files)


def _masks_of(
    folder: Path, names: Sequence[str], order: Sequence[str] | None, files: Mapping[str, ImageFile] | None
) -> Masks:
    """The mask files of the frames. Raises InputError where there are none, or of two kinds."""
    every = order if order is not None else names
    kinds = find_masks(
        folder, every, (".png", _SUFFIX, ".npy"), black_and_white, files=files, numbered=order is not None
    )
    if len(kinds) > 1:
        both = f"there are both {kinds[0].ending} and {kinds[1].ending} masks of these frames"
        raise InputError(folder, both, "one kind", "Keep each kind in a folder of its own.")
    if not any(name in kinds[0].files or name in kinds[0].objects for name in names):
        problem = f"it has masks, but of none of the {len(names)} frames that are worked with"
        raise InputError(folder, problem, f"a mask of {names[0]} and others", "Name each mask like its frame.")
    return kinds[0]


def black_and_white(path: Path) -> bool:
    """Whether a mask has no value but 0 and 1, or 0 and the largest of its kind."""
    image, coloured = read_label_image(path)
    values = np.unique(image)
    values = values // GREY if coloured and not (values % GREY).any() else values
    return len(values) <= 2 and set(values.tolist()) <= {0, int(values.max())} and values.max() in (0, 1, 255, 65535)


class _Reader:
    """Reads the labels of one frame after the other, and remembers what a note should tell."""

    def __init__(self, found: Masks, names, level, background, files: Mapping[str, ImageFile], size):
        self.found, self.names, self.level, self.background = found, names, level, background
        self.files, self.size = files, size
        folders = {folder for masks in found.objects.values() for folder in masks}
        self.ids = object_ids(sorted(folders))
        self.folders = sorted(folders, key=lambda folder: (self.ids[folder], folder))
        self.coloured: dict[Path | None, bool] = {}
        self.negative = False
        self.fit = Fit(files, size, self._shape)

    def _shape(self, name: str) -> tuple[int, ...] | None:
        path = self.found.path(name)
        return None if path is None else self._values(path).shape

    def _values(self, path: Path) -> np.ndarray:
        """The ids (H, W) of a file."""
        if self.found.ending == _SUFFIX:
            return read_level(path, self.level)
        image, self.coloured[path] = read_label_image(path)
        self.negative |= bool(image.min() < 0)
        return image

    def read(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """The ids of a frame, ascending, and its labels (H, W) as indices into them, -1 = none."""
        if name in self.found.objects:
            return self._objects(name, self.found.objects[name])
        if name not in self.found.files:
            return np.zeros(0, np.int64), np.full(self.size, -1, np.int16)
        path = self.found.files[name]
        return compact(path, self.fit(path, self._values(path), name))

    def _objects(self, name: str, masks: Mapping[str, Path]) -> tuple[np.ndarray, np.ndarray]:
        """The objects of a frame as indices into `folders`; the first lies on top."""
        labels = np.full(self.size, -1, np.int16)
        shown = []
        for index, folder in reversed(list(enumerate(self.folders))):
            if folder in masks:
                image = self.fit(masks[folder], read_label_image(masks[folder])[0], name)
                self._require_one_object(masks[folder], image)
                labels[image > 0] = index
        shown = np.unique(labels[labels >= 0]).astype(np.int64)
        return shown, np.where(labels >= 0, np.searchsorted(shown, labels), -1).astype(np.int16)

    def _require_one_object(self, path: Path, image: np.ndarray) -> None:
        inside = image[image > 0]
        if inside.size and (inside != inside[0]).any():
            count = len(np.unique(inside))
            problem = (
                f"the mask has {count} values besides 0, but the folders {', '.join(self.folders[:4])} hold objects"
            )
            remedy = (
                "Name the folders like those of the images where they are cameras, or make each mask black and white."
            )
            raise InputError(path, problem, "one value for the object", remedy)

    def without_background(self, folder: Path, own_ids: list[np.ndarray]) -> list[np.ndarray]:
        """The frames' ids with -1 in place of the background's. Grey that is stored as colours has its grey values."""
        if self.found.objects or self.found.ending == _SUFFIX:
            return own_ids
        coloured = [self.coloured.get(self.found.path(name), False) for name in self.names]
        if not any((own % GREY).any() for own, colour in zip(own_ids, coloured) if colour):
            own_ids = [own // GREY if colour else own for own, colour in zip(own_ids, coloured)]
            self.coloured = {}
        count = sum(self.coloured.values())
        if 0 < count < len(self.coloured):
            problem = f"there are {count} colour images among {len(self.coloured)} masks"
            raise InputError(folder, problem, "ids in all, or colours in all", "Write all as 16 bit grey PNGs.")
        if self.background is None or (self.negative and self.background == 0):
            return own_ids
        return [np.where(own == self.background, -1, own) for own in own_ids]

    def named(self, ids: np.ndarray) -> tuple[int, ...]:
        """The ids as the files, or the folders of objects, have them."""
        return tuple(self.ids[self.folders[int(index)]] if self.found.objects else int(index) for index in ids)

    def notes(self, per_frame: bool) -> list[str]:
        notes, paths = [], {name: self.found.path(name) for name in self.names}
        missing = [name for name, path in paths.items() if path is None]
        if missing:
            without = f"{len(missing)} of {len(self.names)} frames have no mask"
            notes.append(f"{without} (the first: {missing[0]}); they are unlabelled.")
        notes += self.fit.notes()
        if any(self.coloured.values()):
            notes.append("The masks are colour images: each colour is a region, numbered R*65536 + G*256 + B.")
        if self.negative and self.background == 0:
            notes.append("The masks hold negative ids: these are taken for no region, and 0 for one.")
        numbered = [
            (name, path) for name, path in paths.items() if path and path.stem.isdecimal() and _other(name, path)
        ]
        if numbered:
            name, path = numbered[0]
            notes.append(f"The masks are numbered, and taken in the order of the frames: {path.name} is {name}.")
        if per_frame:
            notes.append("Each frame's masks count as regions of their own, since their ids are not shared.")
        if not all(folder.isdecimal() for folder in self.folders):
            told = ", ".join(f"{folder} is {self.ids[folder]}" for folder in self.folders[:8])
            notes.append(f"The objects are numbered: {told}{' ...' if len(self.folders) > 8 else ''}.")
        return notes


def _other(name: str, path: Path) -> bool:
    """Whether a numbered mask is not called like its frame."""
    return name != path.stem and not name.endswith(f"_{path.stem}")


def read_level(path: Path, level: str | int) -> np.ndarray:
    """ids (H, W) of one level of a `_s.npy`, -1 = none. Raises InputError where it is no such file."""
    if level not in (*LEVELS, 0, 1, 2, 3):
        raise InputError("level", f"there is no level {level!r}", f"one of {', '.join(LEVELS)}", "l is the coarsest.")
    try:
        image = map_npy(path)
    except READ_ERRORS as error:
        wanted = f"a .npy of shape ({len(LEVELS)}, H, W)"
        raise InputError(
            path, f"there is no whole array ({describe_error(error)})", wanted, "Write the masks again."
        ) from error
    if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
        wanted, remedy = f"({len(LEVELS)}, H, W): levels {', '.join(LEVELS)}", "Give _s.npy files, not the _f.npy ones."
        raise InputError(path, f"the array has shape {image.shape}", wanted, remedy)
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        image = np.asarray(image[LEVELS.index(level) if isinstance(level, str) else level], np.float64)
    if not ((image >= -MOST_IDS) & (image < MOST_IDS) & (image == image.round())).all():
        problem = "the array holds numbers that are no integers or too large"
        raise InputError(path, problem, "ids, -1 = none", "Write the masks again.")
    return image.astype(np.int64)


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """An image (H, W) of integers at another size: each pixel has the value at its centre."""
    rows, columns = image.shape
    down = (2 * np.arange(height) + 1) * rows // (2 * height)
    across = (2 * np.arange(width) + 1) * columns // (2 * width)
    return image[down[:, None], across]


def _alike(rows: int, columns: int, width: int, height: int) -> bool:
    """Whether an image has this size's aspect, within a pixel of the coarser of the two, whose size was rounded."""
    return min(abs(columns * height / rows - width), abs(width * rows / height - columns)) <= 1


class Fit:
    """Brings masks to their frames' size, and counts what that took.

    Args:
      files: The frames' images by name. Masks have their size, upright or as stored, at any scale.
      size: (H, W) of the frames.
      shape: The shape (H, W) of a frame's mask by name, None where it has none. Where masks of images that lie on their
        side turn out to be of the stored pixels, so are those of images that stand on their head, whose size cannot
        tell.
    """

    def __init__(
        self,
        files: Mapping[str, ImageFile],
        size: tuple[int, int],
        shape: Callable[[str], tuple[int, ...] | None],
    ):
        self.files, (self.height, self.width) = files, size
        self.count: collections.Counter[str] = collections.Counter()
        self.stored = False
        if any(1 < file.orientation < 5 for file in files.values()):
            lying = [name for name, file in files.items() if file.orientation in TRANSPOSED]
            self.stored = any(self._of_stored(files[name], shape(name)) for name in lying[:8])

    def _of_stored(self, file: ImageFile, shape: tuple[int, ...] | None) -> bool:
        """Whether a mask of this shape can only be one of the stored pixels of an image that lies on its side."""
        if shape is None:
            return False
        rows, columns = shape
        stored = _alike(rows, columns, file.height, file.width)
        return stored and not _alike(rows, columns, file.width, file.height)

    def __call__(self, path: Path, image: np.ndarray, name: str) -> np.ndarray:
        """The mask (H, W) of the frame `name` at the frames' size; itself where it has that. Raises InputError, at
        `path`, where its aspect is another."""
        file = self.files.get(name)
        upright = (self.width, self.height) if file is None else (file.width, file.height)
        turn = 1 if file is None else file.orientation
        stored = upright[::-1] if turn in TRANSPOSED else upright
        rows, columns = image.shape
        if turn != 1 and _alike(rows, columns, *stored) and (self.stored or not _alike(rows, columns, *upright)):
            image = apply_orientation(image, turn)
            self.count["turned"] += 1
        elif not _alike(rows, columns, *upright) and not _alike(rows, columns, self.width, self.height):
            remedy = "Make the masks from the frames as they are loaded (undistorted, upright), at any scale."
            wanted = f"{upright[0]}x{upright[1]} like its frame, or that aspect"
            raise InputError(path, f"the mask is {columns}x{rows}", wanted, remedy)
        if image.shape == (self.height, self.width):
            return image
        self.count["resized"] += 1
        return resize_nearest(image, self.width, self.height)

    def notes(self) -> list[str]:
        """What was done to the masks, a sentence each."""
        notes = []
        if count := self.count["resized"]:
            notes.append(f"{count} masks were resized to {self.width}x{self.height} (nearest).")
        if count := self.count["turned"]:
            notes.append(f"{count} masks were of the stored pixels, and were turned upright like their images.")
        return notes


def compact(path: Path, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ids of an image in ascending order, and the image as indices into them: -1 for negative ids."""
    if image.max(initial=0) < 1 << 20:
        # A table instead of a sort: some ten times faster, and most masks have small ids.
        seen = np.zeros(int(image.max(initial=0)) + 2, bool)
        seen[np.maximum(image, -1)] = True
        ids = np.flatnonzero(seen[:-1])
    else:
        ids = np.unique(image)
        ids = ids[ids >= 0]
    if len(ids) > MOST_REGIONS + 1:  # and the background
        remedy = "Give label images, not photographs."
        raise InputError(path, f"the mask has {len(ids)} ids", f"at most {MOST_REGIONS}", remedy)
    if not len(ids):
        return ids, np.full(image.shape, -1, np.int16)
    position = np.minimum(np.searchsorted(ids, image), len(ids) - 1)
    return ids, np.where(ids[position] == image, position, -1).astype(np.int16)
