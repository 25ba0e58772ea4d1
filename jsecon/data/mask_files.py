"""Masklets from disk: one label image per frame, matched to the frames by name.

One folder of black and white masks for each object, as SAM 2 writes them with --per_obj_png_file:
`<id>/<frame>.png`, the id in decimal digits (001, 002, ...).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Int16, Int64

from jsecon.data.frames import Progress
from jsecon.data.images import IMAGE_ENDINGS, read_ids
from jsecon.errors import InputError
from jsecon.files import UNREADABLE, map_array


def object_folders(folder: Path) -> tuple[Path, ...]:
    """The objects' folders by ascending id; none where `folder` itself holds masks, or no such folders."""
    own = any(path.suffix in (".png", ".npy") for path in folder.iterdir())
    numbered = [path for path in folder.iterdir() if path.is_dir() and path.name.isdecimal()]
    holding = [path for path in numbered if next(path.glob("*.png"), None) is not None]
    return () if own else tuple(sorted(holding, key=lambda path: int(path.name)))


def read_objects(folders: Sequence[Path], name: str) -> Int64[np.ndarray, "h w"]:
    """The ids (H, W) of one frame, the file `name` in each folder that has it, -1 = none.

    Where objects overlap, the lower id lies on top, as where SAM 2 writes them into one file. Raises InputError where a
    mask cannot be read or differs in size.
    """
    image: np.ndarray | None = None
    for folder in reversed(folders):
        if (folder / name).is_file():
            mask = read_ids(folder / name)[0]
            image = np.full(mask.shape, -1, np.int64) if image is None else image
            if mask.shape != image.shape:
                found, wanted = (f"{width}x{height}" for height, width in (mask.shape, image.shape))
                remedy = "Write all masks of a frame at one size."
                raise InputError(folder / name, f"a mask of {found}", f"{wanted}, like those of other objects", remedy)
            image[mask > 0] = int(folder.name)
    assert image is not None, f"{name} lies in none of the folders"
    return image


LEVELS = ("default", "s", "m", "l")
"""LangSplat's levels in the order of its `_s.npy`: all of SAM's masks, subpart, part, whole"""
MOST_REGIONS = int(np.iinfo(np.int16).max)
MOST_IDS = 1 << 24
"""what float32 holds without a gap, and colours of 8 bits make"""
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
    progress: Progress = None,
) -> MasksFromDisk:
    """The masks in `folder` of the frames called `names`, `size` = (H, W), as labels (T, H, W).

    `<name>.png` (also `<name>.jpg.png`), one id per pixel: 8 or 16 bit grey, a palette PNG (its indices), or RGB (each
    colour an id, R*65536 + G*256 + B); `background` is the id of no region (None: every id is one). Such are Gaussian
    Grouping's object_mask and SAM 2's PNGs. Or `<id>/<name>.png`, black and white masks in a folder for each object, as
    SAM 2 writes them with --per_obj_png_file; where they overlap the lower id lies on top. Or LangSplat's
    `<name>_s.npy` (4, H, W), -1 = none, of which `level` is taken ("default", "s", "m", "l", or its index).

    SAM 2 wants frames called 0, 1, ... `order` says what such numbers stand for: where no PNG is called like a frame,
    and they are numbered from 0 to len(order) - 1, number n is the mask of the frame `order[n]`.

    `shared`: whether an id means the same object in every frame. By default so for PNGs; not for `_s.npy`, since
    LangSplat numbers the masks of each frame afresh: each is then a region of its own. Say True for tracked ones.

    Masks must be of the frames as the capture was loaded, undistorted. Another size is resized to theirs (nearest)
    where the aspect agrees to a pixel. A frame without a mask file is wholly -1. Both are said in the notes. Raises
    InputError where no frame has a mask, a file is damaged, or of another aspect or kind, or there are more than 32767
    regions.
    """
    folder = Path(folder)
    height, width = size
    objects = object_folders(folder) if folder.is_dir() else ()
    files, kind = _find(folder, objects, names, order)
    per_frame = kind == _SUFFIX if shared is None else not shared
    labels = np.full((len(names), height, width), -1, np.int16)
    own_ids: list[np.ndarray] = []
    resized = colours = 0
    for index, name in enumerate(names):
        own_ids.append(np.zeros(0, np.int64))
        if name in files:
            if kind == _SUFFIX:
                image, none = read_level(files[name], level), -1
            elif objects:
                image, none = read_objects(objects, files[name].name), -1
            else:
                image, coloured = read_ids(files[name])
                none, colours = background, colours + coloured
            fitted = fitted_to_frame(files[name], image, width, height)
            resized += fitted is not image
            own_ids[-1], labels[index] = _compact(files[name], fitted, none)
        if progress is not None:
            progress(index + 1, len(names))
    if 0 < colours < len(files):
        found = f"{colours} colour images among {len(files)} masks"
        raise InputError(folder, found, "ids in all, or colours in all", "Write all alike, best as 16 bit grey PNGs.")

    if per_frame:
        ids = np.concatenate(own_ids)
        starts = np.cumsum([0, *map(len, own_ids)])
        tables = [np.arange(len(own)) + start for own, start in zip(own_ids, starts)]
    else:
        ids = np.unique(np.concatenate(own_ids))
        tables = [np.searchsorted(ids, own) for own in own_ids]
    if len(ids) > MOST_REGIONS:
        remedy = "Take a coarser level, fewer frames, or say shared=True if the ids are tracked."
        raise InputError(folder, f"{len(ids)} regions", f"at most {MOST_REGIONS}", remedy)
    for frame, table in zip(labels, tables):
        frame[:] = np.append(table, -1).astype(np.int16)[frame]
    notes = _notes(names, files, resized, colours, per_frame, size)
    return MasksFromDisk(labels, tuple(map(int, ids)), notes)


def _notes(names, files, resized, colours, per_frame, size) -> tuple[str, ...]:
    notes, missing = [], [name for name in names if name not in files]
    if missing:
        without = f"{len(missing)} of {len(names)} frames have no mask"
        notes.append(f"{without} (the first: {missing[0]}); they are unlabelled.")
    if resized:
        notes.append(f"{resized} masks were resized to {size[1]}x{size[0]} (nearest).")
    if colours:
        notes.append("The masks are colour images: each colour is a region, numbered R*65536 + G*256 + B.")
    if numbered := [name for name in files if files[name].stem.isdecimal() and files[name].stem != name]:
        first = numbered[0]
        notes.append(f"The masks are numbered, and taken in the order of the frames: {files[first].name} is {first}.")
    if per_frame:
        notes.append("Each frame's masks count as regions of their own, since their ids are not shared between frames.")
    return tuple(notes)


def _find(
    folder: Path, objects: Sequence[Path], names: Sequence[str], order: Sequence[str] | None
) -> tuple[dict[str, Path], str]:
    """Mask files by frame name, and their common ending; where objects have folders of their own, one of each frame."""
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a folder of masks", "Check the path.")
    found: dict[str, dict[str, Path]] = {".png": {}, _SUFFIX: {}}
    for file in sorted(file for place in objects or (folder,) for file in place.iterdir()):
        for ending, files in found.items():
            if file.name.lower().endswith(ending):
                key = file.name[: -len(ending)]
                files[key] = file
                # COLMAP calls the mask of a.jpg "a.jpg.png"; the plain name has precedence.
                if Path(key).suffix in IMAGE_ENDINGS:
                    files.setdefault(Path(key).stem, file)
    # LangSplat cuts names at the first dot.
    arrays = {name: found[_SUFFIX].get(name) or found[_SUFFIX].get(name.split(".")[0]) for name in names}
    matched = {
        ".png": {name: found[".png"][name] for name in names if name in found[".png"]},
        _SUFFIX: {name: file for name, file in arrays.items() if file is not None},
    }
    numbered = {int(key): file for key, file in found[".png"].items() if key.isdecimal()}
    if order is not None and not matched[".png"] and sorted(numbered) == list(range(len(order))):
        matched[".png"] = {name: numbered[order.index(name)] for name in names}
    if not matched[".png"] and not matched[_SUFFIX]:
        inside = len(set(found[".png"].values())) + len(found[_SUFFIX])
        found_there = f"{inside} masks, none of which is called like a frame"
        numbers = "" if order is None else f"; or a PNG for each number from 0 to {len(order) - 1}"
        wanted = f"<name>.png or <name>{_SUFFIX}, for instance {names[0]}.png{numbers}"
        raise InputError(folder, found_there, wanted, "Name each mask like its frame.")
    if matched[".png"] and matched[_SUFFIX]:
        both = f"both .png and {_SUFFIX} masks of these frames"
        raise InputError(folder, both, "one kind", "Keep each kind in a folder of its own.")
    kind = ".png" if matched[".png"] else _SUFFIX
    return matched[kind], kind


def read_level(path: Path, level: str | int) -> np.ndarray:
    """ids (H, W) of one level of a `_s.npy`, -1 = none. Raises InputError where it is no such file."""
    if level not in (*LEVELS, 0, 1, 2, 3):
        raise InputError("level", repr(level), f"one of {', '.join(LEVELS)}", "l is the coarsest.")
    try:
        image = map_array(path)
    except UNREADABLE as error:
        wanted = f"a .npy of shape ({len(LEVELS)}, H, W)"
        raise InputError(path, f"no whole array ({error})", wanted, "Write the masks again.") from error
    if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
        wanted, remedy = f"({len(LEVELS)}, H, W): levels {', '.join(LEVELS)}", "Give _s.npy files, not the _f.npy ones."
        raise InputError(path, f"an array of shape {image.shape}", wanted, remedy)
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        image = np.asarray(image[LEVELS.index(level) if isinstance(level, str) else level], np.float64)
    if not ((image >= -MOST_IDS) & (image < MOST_IDS) & (image == image.round())).all():
        raise InputError(path, "numbers that are no integers or too large", "ids, -1 = none", "Write the masks again.")
    return image.astype(np.int64)


def fitted_to_frame(path: Path, image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The mask at the frames' size; itself where it has that."""
    if image.shape == (height, width):
        return image
    rows, columns = image.shape
    # Within a pixel of the coarser of the two, whose size was rounded.
    if min(abs(columns * height / rows - width), abs(width * rows / height - columns)) > 1:
        remedy = "Make the masks from the frames as they are loaded (undistorted, unrotated), at any scale."
        wanted = f"{width}x{height} like its frame, or that aspect"
        raise InputError(path, f"a mask of {columns}x{rows}", wanted, remedy)
    # Integers below 2^24 pass through float32 unchanged; OpenCV has no int64.
    return cv2.resize(image.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST_EXACT).astype(np.int64)


def _compact(path: Path, image: np.ndarray, none: int | None) -> tuple[np.ndarray, np.ndarray]:
    """The ids of an image in ascending order, and the image as indices into them: -1 for `none` and negative ids."""
    if image.max(initial=0) < 1 << 20:
        # A table instead of a sort: some ten times faster, and most masks have small ids.
        seen = np.zeros(int(image.max(initial=0)) + 2, bool)
        seen[np.maximum(image, -1)] = True
        ids = np.flatnonzero(seen[:-1])
    else:
        ids = np.unique(image)
        ids = ids[ids >= 0]
    if none is not None:
        ids = ids[ids != none]
    if len(ids) > MOST_REGIONS:
        remedy = "Give label images, not photographs."
        raise InputError(path, f"{len(ids)} ids in one mask", f"at most {MOST_REGIONS}", remedy)
    if not len(ids):
        return ids, np.full(image.shape, -1, np.int16)
    position = np.minimum(np.searchsorted(ids, image), len(ids) - 1)
    return ids, np.where(ids[position] == image, position, -1).astype(np.int16)
