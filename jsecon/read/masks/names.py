"""Which file of masks belongs to which frame, on the host.

A mask is named like its frame: `<frame>.png`, like the image's whole name (`<frame>.jpg.png`, as COLMAP has it), or
with a word for what it is (`<frame>_mask.png`). It lies in the folder itself, or in subfolders named like those of the
images (`cam0/<frame>.png`). Any other subfolders stand for objects (`<object>/<frame>.png`, black and white, as SAM 2
writes them with --per_obj_png_file).
"""

from __future__ import annotations

import collections
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeAlias

from jsecon.errors import InputError
from jsecon.files import is_output_folder
from jsecon.read.captures.images import IMAGE_SUFFIXES
from jsecon.read.registry import Reader
from jsecon.types import ImageFile

_WORD = r"masks?|seg|segs|segmentations?|labels?|ids?|instances?|objects?|annotations?"
_AFFIX = re.compile(rf"(?:(?:{_WORD})[_.-])?(.+?)(?:[_.-](?:{_WORD}))?", re.IGNORECASE)
"""a frame's name within that of its mask"""

AllFrames: TypeAlias = Mapping[str, ImageFile | None]
"""all frames of a capture in order, by name, each with its image or None"""


class MaskFiles(NamedTuple):
    """Mask files of one format by frame: either one file a frame, or one for each object in it."""

    reader: Reader
    files: dict[str, dict[str, Path]]
    """Frame -> folder of an object, or "" for the mask of all objects -> file."""
    objects: tuple[str, ...]
    """The folders of objects; empty if there is one file a frame."""
    notes: tuple[str, ...]
    """How the files were understood, a sentence each."""


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
    """Looks up frames by the name of a mask."""

    def __init__(self, frames: AllFrames):
        self._by_name: dict[str, list[_Frame]] = collections.defaultdict(list)
        for name, file in frames.items():
            path = PurePosixPath(name if file is None else file.path)
            folders = () if file is None else tuple(part for part in path.parts[:-1] if part not in ("/", ".", ".."))
            frame = _Frame(name, name if file is None else _without_image_suffix(path.name), folders)
            for key in {frame.name, frame.stem}:
                self._by_name[key].append(frame)

    def match(self, path: Path, folders: tuple[str, ...], suffix: str) -> _Match | None:
        """Finds the frame of a mask file in subfolders; None also if two frames fit equally well."""
        base = path.name[: len(path.name) - len(suffix)]
        keys = [base, _without_image_suffix(base)]
        if word := _AFFIX.fullmatch(base):
            keys += [word[1], _without_image_suffix(word[1])]
        for rank, key in enumerate(dict.fromkeys(keys)):
            if not (frames := self._by_name.get(key)):
                continue
            fits = sorted((_compare_folders(folders, frame, key), frame.name) for frame in frames)
            if len(fits) > 1 and fits[0][0][:2] == fits[1][0][:2]:
                return None
            (_, _, extra), name = fits[0]
            return _Match(name, extra, (rank, -len(folders)), folders, path)
        return None


def _without_image_suffix(name: str) -> str:
    """The name without the suffix of an image."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in IMAGE_SUFFIXES else name


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
        inner[:] = sorted(visible) if len(folders) < 4 else []  # deeper folders are not those of masks
        files += [(Path(place) / name, folders) for name in sorted(names) if not name.startswith(".")]
    return files


def find_masks(folder: Path, frames: AllFrames, readers: Sequence[Reader]) -> MaskFiles:
    """Finds the masks of frames, which must be of one format."""
    if not folder.is_dir():
        problem = "this is a file" if folder.exists() else "there is no such folder"
        raise InputError(folder, problem, "a folder of masks", "Check the path.")
    frame_names, names = FrameNames(frames), tuple(frames)
    matched: dict[Reader, list[_Match]] = collections.defaultdict(list)
    unmatched: dict[Reader, list[Path]] = collections.defaultdict(list)
    others = []
    for path, folders in _list_files(folder):
        reader = next((reader for reader in readers if reader.fits(path)), None)
        if reader is None:
            others.append((path, folders))
            continue
        suffix = next(mark for mark in reader.marks if path.name.lower().endswith(mark))
        if (match := frame_names.match(path, folders, suffix)) is not None:
            matched[reader].append(match)
        else:
            unmatched[reader].append(path)
    if not matched:
        image_suffixes = (*IMAGE_SUFFIXES, ".npz", ".gif", ".exr")  # may be meant as masks
        for path, folders in others:
            if path.suffix.lower() in image_suffixes and frame_names.match(path, folders, path.suffix) is not None:
                raise _unsupported(path)
        count = sum(map(len, unmatched.values()))
        problem = f"it holds {count} masks{', none of which is called like a frame' if count else ''}"
        expected = " or ".join(names[0] + mark for reader in readers for mark in reader.marks) + " and so on"
        raise InputError(folder, problem, expected, "Name each mask like its frame.")
    if len(matched) > 1:
        first, second = (reader.marks[0] for reader in list(matched)[:2])
        problem = f"there are both {first} and {second} masks of these frames"
        raise InputError(folder, problem, "one kind", "Put each kind into a folder of its own.")
    ((reader, matches),) = matched.items()
    return _arrange(reader, matches, unmatched[reader])


def _unsupported(path: Path) -> InputError:
    """The error of a mask in a format that is not read."""
    if path.suffix.lower() in (".jpg", ".jpeg"):
        remedy = "Export the masks again as PNG: one that is converted from JPEG keeps the wrong ids."
        return InputError(path, "the mask is a JPEG, whose compression changes ids", "a PNG or .npy", remedy)
    return InputError(path, f"masks are not read from {path.suffix.lower()} files", "a PNG or .npy", "Convert it.")


def _arrange(reader: Reader, matches: list[_Match], unmatched: list[Path]) -> MaskFiles:
    """Arranges files as one of each frame, or as one of each object in it: in folders that the images do not have."""
    by_frame: dict[str, list[_Match]] = collections.defaultdict(list)
    for match in sorted(matches, key=lambda match: (len(match.extra), match.rank)):
        by_frame[match.frame].append(match)
    notes = []
    if unmatched:
        verb = "belongs" if len(unmatched) == 1 else "belong"
        first = unmatched[0].name
        notes = [f"{len(unmatched)} of the {reader.marks[0]} files {verb} to no frame of this capture, first {first}."]
    extras = {"/".join(match.extra) for match in matches}
    if "" not in extras and len(extras) > 1:
        objects = sorted(extras, key=_natural_order)
        notes = [f"The folders {_shorten(objects)} are read as objects: each has black and white masks of one.", *notes]
        by_object = {frame: {"/".join(m.extra): m.path for m in reversed(some)} for frame, some in by_frame.items()}
        files = {frame: {name: some[name] for name in objects if name in some} for frame, some in by_object.items()}
        return MaskFiles(reader, files, tuple(objects), tuple(notes))
    best = {frame: some[0] for frame, some in by_frame.items() if "/".join(some[0].extra) == min(extras)}
    if unused := {"/".join(match.folders) for match in matches if "" in extras and match.extra}:
        notes = [f"Masks in other folders ({_shorten(sorted(unused))}) were not used.", *notes]
    return MaskFiles(reader, {frame: {"": match.path} for frame, match in best.items()}, (), tuple(notes))


def _natural_order(name: str) -> tuple[str, int, str]:
    """Sort key that puts 9 before 10."""
    return re.sub(r"\d+", lambda number: number[0].zfill(20), name), len(name), name


def _shorten(names: Sequence[str]) -> str:
    """Joins the first of some names."""
    return ", ".join(names[:4]) + (f", ... ({len(names)})" if len(names) > 4 else "")
