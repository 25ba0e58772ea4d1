"""Masks from disk, on the host: which file belongs to which frame, and the labels of tracked regions.

A mask is named like its frame: `<frame>.png`, like the image's whole name (`<frame>.jpg.png`, as COLMAP has it), or
with a word for what it is (`<frame>_mask.png`). It lies in the folder itself, or in subfolders named like those of the
images (`cam0/<frame>.png`). Any other subfolder stands for an object (`<object>/<frame>.png`, black and white, as SAM 2
writes them with --per_obj_png_file), or merely divides the files.
"""

from __future__ import annotations

import collections
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Int, Int16

from jsecon.errors import InputError
from jsecon.files import is_output_folder, map_npy, reading
from jsecon.read.captures.images import IMAGE_SUFFIXES, TRANSPOSED, apply_orientation, read_label_image
from jsecon.types import ImageFile, Progress

LEVELS = ("default", "s", "m", "l")
"""levels of LangSplat's `_s.npy`, in their order: all of SAM's masks, subparts, parts, whole objects"""
MAX_REGIONS = int(np.iinfo(np.int16).max)
MAX_ID = 1 << 24
"""ids below which float32, LangSplat's type of ids, holds every integer"""
GREY_COLOUR = 65793
"""number of the colour (1, 1, 1), R*65536 + G*256 + B"""
MAX_DEPTH = 4
"""nested subfolders that are searched for masks"""
SAMPLED_MASKS = 64
"""masks whose values are read to tell cameras from objects"""
_LEVELS_SUFFIX = "_s.npy"
_LANGSPLAT = (_LEVELS_SUFFIX, "_f.npy")
_WORD = r"masks?|seg|segs|segmentations?|labels?|ids?|instances?|objects?|annotations?"
_AFFIX = re.compile(rf"(?:(?:{_WORD})[_.-])?(.+?)(?:[_.-](?:{_WORD}))?", re.IGNORECASE)
"""a frame's name within that of its mask"""
_LOWER_SUFFIXES = frozenset(suffix.lower() for suffix in IMAGE_SUFFIXES)
_UNSUPPORTED = (*sorted(_LOWER_SUFFIXES), ".npz", ".gif", ".exr")
"""suffixes of files that may be meant as masks and are not read as such"""


AllFrames: TypeAlias = Mapping[str, ImageFile | None]
"""all frames of a capture in order, by name, each with its image or None"""


class MaskFiles(NamedTuple):
    """Mask files of one suffix by frame: either one file a frame, or one for each object in it."""

    files: dict[str, dict[str, Path]]
    """Frame -> folder of an object, or "" for the mask of all objects -> file."""
    suffix: str
    notes: tuple[str, ...]
    """How the files were understood, a sentence each."""

    def path(self, name: str) -> Path | None:
        """Looks up the mask of a frame.

        Args:
          name: Name of the frame.

        Returns:
          Its file, or one of those of its objects; None if it has no mask.
        """
        return next(iter(self.files.get(name, {}).values()), None)


class _Frame(NamedTuple):
    """A frame: its name, its image's name without suffix, and its image's folders."""

    name: str
    stem: str
    folders: tuple[str, ...]


class _Match(NamedTuple):
    """A mask file that is named like a frame."""

    frame: str
    extra: tuple[str, ...]
    """Its folders that the frame's image does not have."""
    rank: tuple[int, int]
    """The lower, the closer is the file's name to the frame's."""
    folders: tuple[str, ...]
    path: Path


class FrameNames:
    """Looks up frames by the name of a mask.

    Args:
      frames: All frames of the capture, each with its image.
    """

    def __init__(self, frames: AllFrames):
        named = [_frame(name, file) for name, file in frames.items()]
        self._by_name: dict[str, list[_Frame]] = collections.defaultdict(list)
        by_first_part: dict[str, list[_Frame]] = collections.defaultdict(list)
        for frame in named:
            for key in {frame.name, frame.stem}:
                self._by_name[key].append(frame)
            by_first_part[frame.stem.split(".")[0]].append(frame)
        # LangSplat cuts names at the first dot.
        self._by_first_part = {key: frames for key, frames in by_first_part.items() if len(frames) == 1}

    def match(self, path: Path, folders: tuple[str, ...], suffix: str) -> _Match | None:
        """Finds the frame of a mask.

        Args:
          path: The mask file.
          folders: Its subfolders below the folder of masks.
          suffix: Its suffix.

        Returns:
          The match; None if there is none, or if two frames fit equally well.
        """
        base = path.name[: len(path.name) - len(suffix)]
        for rank, key in enumerate(_frame_keys(base)):
            frames = self._by_name.get(key) or (self._by_first_part.get(key) if rank == 0 else None)
            if not frames:
                continue
            fits = sorted((_compare_folders(folders, frame, key), frame.name) for frame in frames)
            if len(fits) > 1 and fits[0][0][:2] == fits[1][0][:2]:
                return None
            (_, _, extra), name = fits[0]
            return _Match(name, extra, (rank, -len(folders)), folders, path)
        return None


def _frame(name: str, file: ImageFile | None) -> _Frame:
    """The names of a frame and its image."""
    if file is None:
        return _Frame(name, name, ())
    path = PurePosixPath(file.path)
    stem = path.stem if path.suffix.lower() in _LOWER_SUFFIXES else path.name
    return _Frame(name, stem, tuple(part for part in path.parts[:-1] if part not in ("/", ".", "..")))


def _frame_keys(base: str) -> list[str]:
    """The names that a mask's frame may have, the likeliest first."""
    keys = [base, _without_image_suffix(base)]
    if word := _AFFIX.fullmatch(base):
        keys += [word[1], _without_image_suffix(word[1])]
    return list(dict.fromkeys(keys))


def _without_image_suffix(name: str) -> str:
    """The name without the suffix of an image."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in _LOWER_SUFFIXES else name


def _compare_folders(folders: tuple[str, ...], frame: _Frame, key: str) -> tuple[int, int, tuple[str, ...]]:
    """Compares a mask's folders with the last ones of a frame's image.

    Returns the number of folders that the image does not have, minus the number that agree, and the former.
    """
    of_image = frame.folders if key == frame.stem else ()

    def agree(some: tuple[str, ...]) -> bool:
        return some == of_image[len(of_image) - len(some) :]

    if agree(folders):
        return 0, -len(folders), ()
    for place, folder in enumerate(folders):
        if agree(rest := folders[:place] + folders[place + 1 :]):
            return 1, -len(rest), (folder,)
    common = next(n for n in range(len(folders), -1, -1) if agree(folders[len(folders) - n :]))
    return len(folders) - common, -common, folders[: len(folders) - common]


def _list_files(folder: Path) -> list[tuple[Path, tuple[str, ...]]]:
    """Lists the visible files below a folder with their subfolders, in order, without output of jsecon."""
    files = []
    for place, inner, names in os.walk(folder, followlinks=True):
        folders = Path(place).relative_to(folder).parts
        visible = (name for name in inner if not name.startswith(".") and not is_output_folder(Path(place) / name))
        inner[:] = sorted(visible) if len(folders) < MAX_DEPTH else []
        files += [(Path(place) / name, folders) for name in sorted(names) if not name.startswith(".")]
    return files


def find_masks(folder: Path, frames: AllFrames, suffixes: Sequence[str], *, numbered: bool = False) -> list[MaskFiles]:
    """Finds the masks of frames.

    Args:
      folder: Where the masks are.
      frames: All frames of the capture, each with its image, whose folders are those of the cameras.
      suffixes: Suffixes of masks, the longer before the shorter.
      numbered: If no file is named like a frame, take number n for the n-th frame, if all frames have one.

    Returns:
      The masks of each suffix that any frame has.

    Raises:
      InputError: The folder is missing, or no file in it is named like a frame.
    """
    if not folder.is_dir():
        problem = "this is a file" if folder.exists() else "there is no such folder"
        raise InputError(folder, problem, "a folder of masks", "Check the path.")
    frame_names, names = FrameNames(frames), tuple(frames)
    matched: dict[str, list[_Match]] = collections.defaultdict(list)
    unmatched: dict[str, list[tuple[Path, tuple[str, ...]]]] = collections.defaultdict(list)
    others = []
    for path, folders in _list_files(folder):
        suffix = next((suffix for suffix in suffixes if path.name.lower().endswith(suffix)), None)
        if suffix is None:
            others.append((path, folders))
        elif (match := frame_names.match(path, folders, suffix)) is not None:
            matched[suffix].append(match)
        else:
            unmatched[suffix].append((path, folders))
    if not matched and numbered:
        for suffix, pairs in unmatched.items():
            stems = [(path.name[: -len(suffix)], path, folders) for path, folders in pairs]
            by_number = [(int(stem), path, folders) for stem, path, folders in stems if stem.isdecimal()]
            if {number for number, _, _ in by_number} == set(range(len(names))):
                matched[suffix] = [_Match(names[n], folders, (0, 0), folders, path) for n, path, folders in by_number]
                unmatched[suffix] = []
    if not matched:
        for path, folders in others:
            if path.suffix.lower() in _UNSUPPORTED and frame_names.match(path, folders, path.suffix) is not None:
                raise _unsupported(path)
        numbers = f"; or a PNG for each number from 0 to {len(names) - 1}" if numbered else ""
        expected = f"{' or '.join(names[0] + suffix for suffix in suffixes)} and so on{numbers}"
        count = sum(map(len, unmatched.values()))
        problem = f"it holds {count} masks{', none of which is called like a frame' if count else ''}"
        raise InputError(folder, problem, expected, "Name each mask like its frame.")
    return [_arrange(suffix, some, unmatched[suffix]) for suffix, some in matched.items()]


def _unsupported(path: Path) -> InputError:
    """The error of a mask in a format that is not read."""
    if path.suffix.lower() in (".jpg", ".jpeg"):
        remedy = "Export the masks again as PNG: one that is converted from JPEG keeps the wrong ids."
        return InputError(path, "the mask is a JPEG, whose compression changes ids", "a PNG or .npy", remedy)
    return InputError(path, f"masks are not read from {path.suffix.lower()} files", "a PNG or .npy", "Convert it.")


def _arrange(suffix: str, matches: list[_Match], unmatched: list[tuple[Path, tuple[str, ...]]]) -> MaskFiles:
    """Arranges the files of one suffix, as one of each frame or one of each object in it."""
    plain = [match for match in matches if not match.extra]
    others = [match for match in matches if match.extra]
    by_frame: dict[str, list[_Match]] = collections.defaultdict(list)
    for match in sorted(matches, key=lambda match: (len(match.extra), match.rank)):
        by_frame[match.frame].append(match)
    notes = []
    if unmatched:
        verb = "belongs" if len(unmatched) == 1 else "belong"
        example = unmatched[0][0].name
        notes = [f"{len(unmatched)} of the {suffix} files {verb} to no frame of this capture (the first: {example})."]
    if _are_objects(plain, others, by_frame):
        folders = sorted({_object_of(match) for match in matches}, key=_natural_order)
        notes = [f"The folders {_shorten(folders)} are read as objects: each has black and white masks of one.", *notes]
        by_object = {frame: {_object_of(m): m.path for m in reversed(some)} for frame, some in by_frame.items()}
        objects = {frame: {name: some[name] for name in folders if name in some} for frame, some in by_object.items()}
        return MaskFiles(objects, suffix, tuple(notes))
    best = {frame: some[0] for frame, some in by_frame.items() if not (plain and some[0].extra)}
    if plain and others:
        places = _shorten(sorted({"/".join(match.folders) for match in others}))
        notes = [f"{len(others)} masks in other folders ({places}) were not used.", *notes]
    if len(folders := sorted({match.folders for match in best.values()})) > 1:
        places = _shorten(["/".join(each) or "." for each in folders])
        reason = "they are named like those of the images" if plain else "their masks are not black and white"
        notes = [f"The folders {places} are read as cameras, not as objects: {reason}.", *notes]
    return MaskFiles({frame: {"": match.path} for frame, match in best.items()}, suffix, tuple(notes))


def _are_objects(plain: list[_Match], others: list[_Match], by_frame: Mapping[str, list[_Match]]) -> bool:
    """Whether the subfolders stand for objects, not for cameras."""
    if not others or any(not match.folders for match in plain):
        return False
    several = any(len(some) > 1 for some in by_frame.values())
    extra = {match.extra[-1] for match in others}
    if not several and (plain or (len(extra) == 1 and not all(map(str.isdecimal, extra)))):
        return False
    if several and not plain:
        return True
    paths = [match.path for some in by_frame.values() for match in some]
    return all(_is_black_and_white(path) for path in paths[:: -(-len(paths) // SAMPLED_MASKS)])


def _object_of(match: _Match) -> str:
    """The folder that stands for the object of a mask."""
    return match.extra[-1] if match.extra else match.folders[-1]


def _natural_order(name: str) -> tuple[str, int, str]:
    """Sort key that puts 9 before 10."""
    return re.sub(r"\d+", lambda number: number[0].zfill(20), name), len(name), name


def _shorten(names: Sequence[str]) -> str:
    """Joins the first of some names."""
    return ", ".join(names[:4]) + (f", ... ({len(names)})" if len(names) > 4 else "")


def _object_ids(folders: Sequence[str]) -> dict[str, int]:
    """The id of each object: the number in its folder's name if all are named alike (001, obj_2), else 1, 2, ..."""
    parts = [re.fullmatch(r"(\D*)([0-9]+)", name) for name in folders]
    if all(parts) and len({part[1] for part in parts if part}) == 1:
        return {name: int(part[2]) for name, part in zip(folders, parts) if part}
    return {name: number for number, name in enumerate(sorted(folders, key=_natural_order), start=1)}


class TrackedMasks(NamedTuple):
    """Labels of tracked regions, and their ids in the files."""

    labels: Int16[np.ndarray, "t h w"]
    """-1 = none, else 0..R-1, the same region in every frame."""
    ids: tuple[int, ...]
    """R ids as the files have them (of a colour: R*65536 + G*256 + B)."""
    notes: tuple[str, ...]
    """What was skipped or changed, a sentence each."""


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
    """Reads masks whose ids mean the same object in every frame, except for LangSplat's, which number each afresh.

    A mask has an id per pixel, 0 for no region: 8 or 16 bit grey, a palette PNG (its indices), RGB (each colour an id),
    or whole numbers in a `.npy`, as Gaussian Grouping's object_mask and SAM 2's PNGs; or LangSplat's `<name>_s.npy`
    (4, H, W). Files are named, and subfolders read, as this module says; where masks of objects overlap, the lower id
    lies on top.

    Masks must be of the frames as the capture was loaded, undistorted. Other sizes of the same aspect are resized
    (nearest), and masks of stored pixels are turned like their images. A frame without a mask is -1 everywhere.

    Args:
      folder: The masks.
      names: T frames.
      size: (H, W) of the labels.
      level: LangSplat's level, a name of LEVELS.
      frames: All frames of the capture in order, each with its image. If no file is named like a frame and the files
        are numbered from 0 to len(frames) - 1, as SAM 2 wants them, number n is the mask of the n-th frame.
      limit: Most masks to read, for a check: other frames are left out.
      progress: Called with (frames done, frames).

    Returns:
      The labels, their ids and notes.

    Raises:
      InputError: No frame has a mask, a file is damaged, or of another aspect or kind, or there are more than
        MAX_REGIONS regions.
    """
    folder = Path(folder)
    masks = _find_one_kind(folder, names, frames)
    names = names if limit is None else [name for name in names if masks.path(name) is not None][:limit]
    shared = masks.suffix != _LEVELS_SUFFIX  # of LangSplat each mask of a frame is a region of its own
    reader = _LabelReader(masks, names, level, frames or {}, size)
    labels = np.full((len(names), *size), -1, np.int16)
    frame_ids: list[np.ndarray] = []
    for index, name in enumerate(names):
        ids, labels[index] = reader.read(name)
        frame_ids.append(ids)
        if progress is not None:
            progress(index + 1, len(names))
    frame_ids = reader.without_background(folder, frame_ids)
    if shared:
        ids = np.unique(np.concatenate(frame_ids))
        ids = ids[ids >= 0]
        tables = [np.where(each >= 0, np.searchsorted(ids, each), -1) for each in frame_ids]
    else:
        kept = [each >= 0 for each in frame_ids]
        ids = np.concatenate([each[keep] for each, keep in zip(frame_ids, kept)])
        starts = np.cumsum([0, *(int(keep.sum()) for keep in kept)])
        tables = [np.where(keep, np.cumsum(keep) - 1 + start, -1) for keep, start in zip(kept, starts)]
    if len(ids) > MAX_REGIONS:
        remedy = "Take a coarser level or fewer frames."
        raise InputError(folder, f"there are {len(ids)} regions", f"at most {MAX_REGIONS}", remedy)
    for frame, table in zip(labels, tables):
        frame[:] = np.append(table, -1).astype(np.int16)[frame]
    return TrackedMasks(labels, reader.file_ids(ids), (*reader.notes(shared), *masks.notes))


def _find_one_kind(folder: Path, names: Sequence[str], frames: AllFrames | None) -> MaskFiles:
    """Finds the mask files of the frames, which must be of one kind."""
    suffixes = (".png", _LEVELS_SUFFIX, ".npy")
    kinds = find_masks(folder, frames or dict.fromkeys(names), suffixes, numbered=frames is not None)
    if len(kinds) > 1:
        problem = f"there are both {kinds[0].suffix} and {kinds[1].suffix} masks of these frames"
        raise InputError(folder, problem, "one kind", "Put each kind into a folder of its own.")
    if not any(name in kinds[0].files for name in names):
        problem = f"it has masks, but of none of the {len(names)} frames in use"
        raise InputError(folder, problem, f"a mask of {names[0]} and others", "Name each mask like its frame.")
    return kinds[0]


def _is_black_and_white(path: Path) -> bool:
    """Whether a file holds the mask of one object: only the values 0 and 1, or 0 and the largest of its type."""
    if path.name.endswith(_LANGSPLAT):
        return False
    image, is_colour = read_label_image(path)
    values = np.unique(image)
    values = values // GREY_COLOUR if is_colour and not (values % GREY_COLOUR).any() else values
    return len(values) <= 2 and set(values.tolist()) <= {0, int(values.max())} and values.max() in (0, 1, 255, 65535)


class _LabelReader:
    """Reads the labels of frame after frame, and collects what the notes report."""

    def __init__(self, masks: MaskFiles, names: Sequence[str], level: str, frames: AllFrames, size: tuple[int, int]):
        self.masks, self.names, self.level, self.size = masks, names, level, size
        folders = {folder for by_object in masks.files.values() for folder in by_object if folder}
        self.object_ids = _object_ids(sorted(folders))
        self.folders = sorted(folders, key=lambda folder: (self.object_ids[folder], folder))
        self.is_colour: dict[Path | None, bool] = {}
        self.has_negative = False
        self.fit = MaskFitter(frames, size, self._shape)

    def _shape(self, name: str) -> tuple[int, ...] | None:
        path = self.masks.path(name)
        return None if path is None else self._values(path).shape

    def _values(self, path: Path) -> np.ndarray:
        """(H, W) ids of a file."""
        if self.masks.suffix == _LEVELS_SUFFIX:
            return read_level(path, self.level)
        image, self.is_colour[path] = read_label_image(path)
        self.has_negative |= bool(image.min() < 0)
        return image

    def read(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """The ids of a frame, ascending, and its labels (H, W) as indices into them, -1 for no region."""
        if self.folders:
            return self._read_objects(name, self.masks.files.get(name, {}))
        path = self.masks.path(name)
        if path is None:
            return np.zeros(0, np.int64), np.full(self.size, -1, np.int16)
        return compact_ids(path, self.fit(path, self._values(path), name))

    def _read_objects(self, name: str, paths: Mapping[str, Path]) -> tuple[np.ndarray, np.ndarray]:
        """As `read`, of one mask for each object; an id is the index of its folder, and the first lies on top."""
        labels = np.full(self.size, -1, np.int16)
        for index, folder in reversed(list(enumerate(self.folders))):
            if folder in paths:
                image = self.fit(paths[folder], read_label_image(paths[folder])[0], name)
                values = np.unique(image[image > 0])
                if len(values) > 1:
                    objects = ", ".join(self.folders[:4])
                    problem = f"the mask has {len(values)} values besides 0, but the folders {objects} hold objects"
                    remedy = "Name folders of cameras like those of the images; make masks of objects black and white."
                    raise InputError(paths[folder], problem, "one value for the object", remedy)
                labels[image > 0] = index
        ids = np.unique(labels[labels >= 0]).astype(np.int64)
        return ids, np.where(labels >= 0, np.searchsorted(ids, labels), -1).astype(np.int16)

    def without_background(self, folder: Path, frame_ids: list[np.ndarray]) -> list[np.ndarray]:
        """Replaces the background's id, 0, by -1, and colours that are all grey by their grey values."""
        if self.folders or self.masks.suffix == _LEVELS_SUFFIX:
            return frame_ids
        colours = [self.is_colour.get(self.masks.path(name), False) for name in self.names]
        if not any((ids % GREY_COLOUR).any() for ids, colour in zip(frame_ids, colours) if colour):
            frame_ids = [ids // GREY_COLOUR if colour else ids for ids, colour in zip(frame_ids, colours)]
            self.is_colour = {}
        count = sum(self.is_colour.values())
        if 0 < count < len(self.is_colour):
            problem = f"there are {count} colour images among {len(self.is_colour)} masks"
            raise InputError(folder, problem, "ids in all, or colours in all", "Write all as 16 bit grey PNGs.")
        return frame_ids if self.has_negative else [np.where(ids == 0, -1, ids) for ids in frame_ids]

    def file_ids(self, ids: np.ndarray) -> tuple[int, ...]:
        """The ids as the files, or the folders of objects, have them."""
        return tuple(self.object_ids[self.folders[int(i)]] if self.folders else int(i) for i in ids)

    def notes(self, shared: bool) -> list[str]:
        """What was skipped or changed."""
        notes, paths = [], {name: self.masks.path(name) for name in self.names}
        if missing := [name for name, path in paths.items() if path is None]:
            problem = f"{len(missing)} of {len(self.names)} frames have no mask (the first: {missing[0]})"
            notes.append(f"{problem}; they are unlabelled.")
        notes += self.fit.notes
        if any(self.is_colour.values()):
            notes.append("The masks are colour images: each colour is a region, numbered R*65536 + G*256 + B.")
        if self.has_negative:
            notes.append("The masks hold negative ids: these count as unlabelled, and 0 as a region.")
        for name, path in paths.items():
            if path and path.stem.isdecimal() and name != path.stem and not name.endswith(f"_{path.stem}"):
                notes.append(f"The masks are numbered, and taken in the order of the frames: {path.name} is {name}.")
                break
        if not shared:
            notes.append("Each frame's masks count as regions of their own, since their ids are not shared.")
        if not all(folder.isdecimal() for folder in self.folders):
            numbers = ", ".join(f"{folder} is {self.object_ids[folder]}" for folder in self.folders[:8])
            notes.append(f"The objects are numbered: {numbers}{' ...' if len(self.folders) > 8 else ''}.")
        return notes


def read_level(path: Path, level: str) -> Int[np.ndarray, "h w"]:
    """Reads one level of LangSplat's `_s.npy`.

    Args:
      path: The file.
      level: A name of LEVELS.

    Returns:
      (H, W) ids, -1 for no region.

    Raises:
      InputError: The level is unknown, or the file is damaged or of another kind.
    """
    if level not in LEVELS:
        raise InputError("level", f"there is no level {level!r}", f"one of {', '.join(LEVELS)}", "l is the coarsest.")
    expected = f"a .npy of shape ({len(LEVELS)}, H, W)"
    with reading(path, expected, "Write the masks again.", problem="the array is damaged or missing"):
        image = map_npy(path)
    if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
        expected = f"({len(LEVELS)}, H, W): levels {', '.join(LEVELS)}"
        raise InputError(
            path, f"the array has shape {image.shape}", expected, "Give _s.npy files, not the _f.npy ones."
        )
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        image = np.asarray(image[LEVELS.index(level)], np.float64)
    if not ((image >= -MAX_ID) & (image < MAX_ID) & (image == image.round())).all():
        problem = "the array has numbers that are no integers or too large"
        raise InputError(path, problem, "ids, -1 for no region", "Write the masks again.")
    return image.astype(np.int64)


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resizes an image of integers: each pixel has the value at its centre.

    Args:
      image: (H, W) integers.
      width: New width, px.
      height: New height, px.

    Returns:
      (height, width) integers.
    """
    rows, columns = image.shape
    down = (2 * np.arange(height) + 1) * rows // (2 * height)
    across = (2 * np.arange(width) + 1) * columns // (2 * width)
    return image[down[:, None], across]


def _same_aspect(rows: int, columns: int, width: int, height: int) -> bool:
    """Whether an image has the aspect of a size, to a pixel of the coarser of the two, whose size was rounded."""
    return min(abs(columns * height / rows - width), abs(width * rows / height - columns)) <= 1


class MaskFitter:
    """Brings masks to the size of the frames, and counts the changes.

    Args:
      frames: The frames' images by name. Masks have their size, upright or as stored, at any scale.
      size: (H, W) of the frames.
      shape: Returns the shape (H, W) of a frame's mask by name, or None. If masks of images that lie on their side are
        of the stored pixels, so are those of images that stand on their head, whose size cannot tell.
    """

    def __init__(self, frames: AllFrames, size: tuple[int, int], shape: Callable[[str], tuple[int, ...] | None]):
        self.files = files = {name: file for name, file in frames.items() if file is not None}
        self.height, self.width = size
        self.count: collections.Counter[str] = collections.Counter()
        self.of_stored_pixels = False
        if any(1 < file.orientation < 5 for file in files.values()):
            lying = [name for name, file in files.items() if file.orientation in TRANSPOSED]
            self.of_stored_pixels = any(self._fits_stored_only(files[name], shape(name)) for name in lying[:8])

    def _fits_stored_only(self, file: ImageFile, shape: tuple[int, ...] | None) -> bool:
        """Whether a mask fits the stored pixels of an image, and not its upright ones."""
        if shape is None:
            return False
        stored = _same_aspect(shape[0], shape[1], file.height, file.width)
        return stored and not _same_aspect(shape[0], shape[1], file.width, file.height)

    def __call__(self, path: Path, image: np.ndarray, name: str) -> np.ndarray:
        """Turns and resizes the mask of a frame to (H, W); raises InputError, with its file, for another aspect."""
        file = self.files.get(name)
        upright = (self.width, self.height) if file is None else (file.width, file.height)
        orientation = 1 if file is None else file.orientation
        stored = upright[::-1] if orientation in TRANSPOSED else upright
        rows, columns = image.shape
        fits_upright = _same_aspect(rows, columns, *upright)
        if orientation != 1 and _same_aspect(rows, columns, *stored) and (self.of_stored_pixels or not fits_upright):
            image = apply_orientation(image, orientation)
            self.count["turned"] += 1
        elif not fits_upright and not _same_aspect(rows, columns, self.width, self.height):
            remedy = "Make the masks from the frames as they are loaded (undistorted, upright), at any scale."
            expected = f"{upright[0]}x{upright[1]} like its frame, or that aspect"
            raise InputError(path, f"the mask is {columns}x{rows}", expected, remedy)
        if image.shape == (self.height, self.width):
            return image
        self.count["resized"] += 1
        return resize_nearest(image, self.width, self.height)

    @property
    def notes(self) -> list[str]:
        """The changes, a sentence each."""
        notes = []
        if count := self.count["resized"]:
            notes.append(f"{count} masks were resized to {self.width}x{self.height} (nearest).")
        if count := self.count["turned"]:
            notes.append(f"{count} masks were of the stored pixels, and were turned upright like their images.")
        return notes


def compact_ids(path: Path, image: np.ndarray) -> tuple[np.ndarray, Int16[np.ndarray, "h w"]]:
    """Replaces the ids of a label image by their indices.

    Args:
      path: Its file, for errors.
      image: (H, W) ids, negative for no region.

    Returns:
      The ids, ascending, and (H, W) indices into them, -1 for no region.

    Raises:
      InputError: There are more ids than regions can be.
    """
    if image.max(initial=0) < 1 << 20:
        # A table instead of a sort: some ten times faster, and most masks have small ids.
        seen = np.zeros(int(image.max(initial=0)) + 2, bool)
        seen[np.maximum(image, -1)] = True
        ids = np.flatnonzero(seen[:-1])
    else:
        ids = np.unique(image)
        ids = ids[ids >= 0]
    if len(ids) > MAX_REGIONS + 1:  # and the background
        remedy = "Give label images, not photographs."
        raise InputError(path, f"the mask has {len(ids)} ids", f"at most {MAX_REGIONS}", remedy)
    if not len(ids):
        return ids, np.full(image.shape, -1, np.int16)
    position = np.minimum(np.searchsorted(ids, image), len(ids) - 1)
    return ids, np.where(ids[position] == image, position, -1).astype(np.int16)
