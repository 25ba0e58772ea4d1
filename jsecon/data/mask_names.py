"""Which file of a folder of masks belongs to which frame, and what its subfolders are: cameras or objects.

A mask is called like its frame: `<frame>.png`, like the image's whole name (`<frame>.jpg.png`, as COLMAP has it), or
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
from typing import NamedTuple

from jsecon.data.images import IMAGE_SUFFIXES
from jsecon.errors import InputError
from jsecon.files import is_output_folder
from jsecon.types import ImageFile

DEEPEST = 4
"""subfolders of a folder of masks, one in the other, that are looked into"""
LOOKED_AT = 64
"""masks, at most, whose values are looked at to tell cameras from objects"""
_WORD = r"masks?|seg|segs|segmentations?|labels?|ids?|instances?|objects?|annotations?"
_AFFIX = re.compile(rf"(?:(?:{_WORD})[_.-])?(.+?)(?:[_.-](?:{_WORD}))?", re.IGNORECASE)
"""a frame's name within a mask's"""
_LOWER_ENDINGS = frozenset(ending.lower() for ending in IMAGE_SUFFIXES)
_OTHERS = (*sorted(_LOWER_ENDINGS), ".npz", ".gif", ".exr")
"""endings of files that may be meant as masks and are not read as such"""


class Masks(NamedTuple):
    """The mask files of the frames, by frame name; of a frame either one file or one for each object."""

    files: dict[str, Path]
    objects: dict[str, dict[str, Path]]
    """frame -> the object's folder -> file."""
    ending: str
    """of all files."""
    notes: tuple[str, ...]
    """how the files were taken, a sentence each."""

    def path(self, name: str) -> Path | None:
        """The file of a frame, or one of those of its objects."""
        return self.files.get(name) or next(iter(self.objects.get(name, {}).values()), None)


class _Frame(NamedTuple):
    name: str
    stem: str
    folders: tuple[str, ...]


class _Match(NamedTuple):
    """A file that is called like a frame."""

    frame: str
    extra: tuple[str, ...]
    """its folders that the frame's image does not have."""
    order: tuple[int, int]
    """the lower, the nearer is the file's name to the frame's."""
    folders: tuple[str, ...]
    path: Path


class Names:
    """The frames of a capture, by what their masks may be called."""

    def __init__(self, names: Sequence[str], files: Mapping[str, ImageFile] | None = None):
        self.frames = [_frame(name, (files or {}).get(name)) for name in names]
        self._called: dict[str, list[_Frame]] = collections.defaultdict(list)
        cut: dict[str, list[_Frame]] = collections.defaultdict(list)
        for frame in self.frames:
            for key in {frame.name, frame.stem}:
                self._called[key].append(frame)
            cut[frame.stem.split(".")[0]].append(frame)
        # LangSplat cuts names at the first dot.
        self._cut = {key: frames for key, frames in cut.items() if len(frames) == 1}

    def match(self, path: Path, folders: tuple[str, ...], ending: str) -> _Match | None:
        """The frame that a mask file in these subfolders belongs to, or None; None also where two are as likely."""
        base = path.name[: len(path.name) - len(ending)]
        for rank, key in enumerate(_keys(base)):
            frames = self._called.get(key) or (self._cut.get(key) if rank == 0 else None)
            if not frames:
                continue
            fits = sorted((_extra(folders, frame, key), frame.name) for frame in frames)
            if len(fits) > 1 and fits[0][0][:2] == fits[1][0][:2]:
                return None
            (_, _, extra), name = fits[0]
            return _Match(name, extra, (rank, -len(folders)), folders, path)
        return None


def _frame(name: str, file: ImageFile | None) -> _Frame:
    if file is None:
        return _Frame(name, name, ())
    path = PurePosixPath(file.path)
    stem = path.stem if path.suffix.lower() in _LOWER_ENDINGS else path.name
    return _Frame(name, stem, tuple(part for part in path.parts[:-1] if part not in ("/", ".", "..")))


def _keys(base: str) -> list[str]:
    """What a mask's frame may be called, the likeliest first."""
    keys = [base, _without_image_ending(base)]
    if word := _AFFIX.fullmatch(base):
        keys += [word[1], _without_image_ending(word[1])]
    return list(dict.fromkeys(keys))


def _without_image_ending(name: str) -> str:
    stem, ending = os.path.splitext(name)
    return stem if ending.lower() in _LOWER_ENDINGS else name


def _extra(folders: tuple[str, ...], frame: _Frame, key: str) -> tuple[int, int, tuple[str, ...]]:
    """How many of a mask's folders are none of the frame's, how many agree (negative), and which are none."""
    own = frame.folders if key == frame.stem else ()
    agree = lambda some: some == own[len(own) - len(some) :]
    if agree(folders):
        return 0, -len(folders), ()
    for place, folder in enumerate(folders):
        if agree(rest := folders[:place] + folders[place + 1 :]):
            return 1, -len(rest), (folder,)
    common = next(n for n in range(len(folders), -1, -1) if agree(folders[len(folders) - n :]))
    return len(folders) - common, -common, folders[: len(folders) - common]


def _files_beneath(folder: Path) -> list[tuple[Path, tuple[str, ...]]]:
    """The files of a folder and of its subfolders, in order, each with its subfolders; without hidden ones, and
    without the output of jsecon."""
    found = []
    for place, inner, files in os.walk(folder, followlinks=True):
        folders = Path(place).relative_to(folder).parts
        kept = (name for name in inner if not name.startswith(".") and not is_output_folder(Path(place) / name))
        inner[:] = sorted(kept) if len(folders) < DEEPEST else []
        found += [(Path(place) / name, folders) for name in sorted(files) if not name.startswith(".")]
    return found


def find_masks(
    folder: Path,
    names: Sequence[str],
    endings: Sequence[str],
    black_and_white: Callable[[Path], bool],
    *,
    files: Mapping[str, ImageFile] | None = None,
    numbered: bool = False,
) -> list[Masks]:
    """The masks in `folder` of the frames `names`, those of each ending that any has.

    Args:
      folder: Where the masks are.
      names: All frames of the capture.
      endings: Those of masks, the longer before the shorter.
      black_and_white: Whether a file holds the mask of one object. Folders that can be cameras as well as objects are
        told apart by it.
      files: The frames' images, whose folders are the cameras'.
      numbered: Where no file is called like a frame, take number n for the n-th frame, if all have one.

    Raises:
      InputError: The folder is not there, or none of its files is called like a frame.
    """
    if not folder.is_dir():
        there = "this is a file" if folder.exists() else "there is no such folder"
        raise InputError(folder, there, "a folder of masks", "Check the path.")
    known, matched, unknown = Names(names, files), collections.defaultdict(list), collections.defaultdict(list)
    others = []
    for path, folders in _files_beneath(folder):
        ending = next((ending for ending in endings if path.name.lower().endswith(ending)), None)
        match = None if ending is None else known.match(path, folders, ending)
        if match is not None:
            matched[ending].append(match)
        elif ending is not None:
            unknown[ending].append((path, folders))
        else:
            others.append((path, folders))
    if not matched and numbered:
        for ending, some in unknown.items():
            by_number = [(int(path.name[: -len(ending)]), path, own) for path, own in some if _is_number(path, ending)]
            if {number for number, _, _ in by_number} == set(range(len(names))):
                matched[ending] = [_Match(names[n], own, (0, 0), own, path) for n, path, own in by_number]
                unknown[ending] = []
    if not matched:
        raise _unmatched(folder, names, endings, sum(map(len, unknown.values())), others, known, numbered)
    return [_arranged(ending, some, unknown[ending], black_and_white) for ending, some in matched.items()]


def _is_number(path: Path, ending: str) -> bool:
    return path.name[: -len(ending)].isdecimal()


def _unmatched(folder, names, endings, count, others, known, numbered) -> InputError:
    """What is wrong with a folder without masks of the frames: perhaps they are of a kind that is not read."""
    for path, folders in others:
        ending = path.suffix.lower()
        if ending in _OTHERS and known.match(path, folders, path.suffix) is not None:
            if ending in (".jpg", ".jpeg"):
                remedy = "Export the masks again as PNG: one that is converted from JPEG keeps the wrong ids."
                return InputError(path, "the mask is a JPEG, whose compression changes ids", "a PNG or .npy", remedy)
            return InputError(path, f"masks are not read from {ending} files", "a PNG or .npy", "Save it as one.")
    numbers = f"; or a PNG for each number from 0 to {len(names) - 1}" if numbered else ""
    wanted = f"{' or '.join(names[0] + ending for ending in endings)} and so on{numbers}"
    problem = f"it holds {count} masks{', none of which is called like a frame' if count else ''}"
    return InputError(folder, problem, wanted, "Name each mask like its frame.")


def _arranged(
    ending: str,
    matches: list[_Match],
    unknown: list[tuple[Path, tuple[str, ...]]],
    black_and_white: Callable[[Path], bool],
) -> Masks:
    """The files of one ending, read as one of each frame or as one of each object in it."""
    plain = [match for match in matches if not match.extra]
    others = [match for match in matches if match.extra]
    by_frame = collections.defaultdict(list)
    for match in sorted(matches, key=lambda match: (len(match.extra), match.order)):
        by_frame[match.frame].append(match)
    notes = []
    if _holds_objects(plain, others, by_frame, black_and_white):
        folders = sorted({_object(match) for match in matches}, key=_natural)
        notes.append(f"The folders {_listed(folders)} are taken for objects: each holds black and white masks of one.")
        ranked = {frame: {_object(match): match.path for match in reversed(some)} for frame, some in by_frame.items()}
        objects = {frame: {name: some[name] for name in folders if name in some} for frame, some in ranked.items()}
        return Masks({}, objects, ending, (*notes, *_left_over(ending, unknown)))
    best = {frame: some[0] for frame, some in by_frame.items() if not (plain and some[0].extra)}
    if len(folders := sorted({match.folders for match in best.values()})) > 1:
        told = _listed(["/".join(each) or "." for each in folders])
        why = "they are named like those of the images" if plain else "their masks are not black and white"
        notes.append(f"The folders {told} are taken for cameras, not for objects: {why}.")
    if dropped := [match for match in others if plain]:
        told = _listed(sorted({"/".join(match.folders) for match in dropped}))
        notes.append(f"{len(dropped)} masks in other folders ({told}) were not used.")
    return Masks(
        {frame: match.path for frame, match in best.items()}, {}, ending, (*notes, *_left_over(ending, unknown))
    )


def _holds_objects(plain, others, by_frame, black_and_white) -> bool:
    """Whether the subfolders stand for objects, not for cameras."""
    if not others or any(not match.folders for match in plain):
        return False
    several = any(len(some) > 1 for some in by_frame.values())
    extra = {match.extra[-1] for match in others}
    if not several and (plain or (len(extra) == 1 and not all(map(str.isdecimal, extra)))):
        return False
    if several and not plain:
        return True
    every = [match.path for some in by_frame.values() for match in some]
    return all(black_and_white(path) for path in every[:: -(-len(every) // LOOKED_AT)])


def _left_over(ending: str, unknown: list[tuple[Path, tuple[str, ...]]]) -> list[str]:
    if not unknown:
        return []
    verb = "belongs" if len(unknown) == 1 else "belong"
    return [
        f"{len(unknown)} of the {ending} files {verb} to no frame of this capture (the first: {unknown[0][0].name})."
    ]


def _object(match: _Match) -> str:
    return match.extra[-1] if match.extra else match.folders[-1]


def _natural(name: str) -> tuple[str, int, str]:
    """Sorts 9 before 10."""
    return re.sub(r"\d+", lambda number: number[0].zfill(20), name), len(name), name


def object_ids(folders: Sequence[str]) -> dict[str, int]:
    """The number of each object: that in its folder's name where all are called alike (001, obj_2), else 1, 2, ... in
    the order of the names."""
    parts = [re.fullmatch(r"(\D*)([0-9]+)", name) for name in folders]
    if all(parts) and len({part[1] for part in parts if part}) == 1:
        return {name: int(part[2]) for name, part in zip(folders, parts) if part}
    return {name: number for number, name in enumerate(sorted(folders, key=_natural), start=1)}


def _listed(names: Sequence[str]) -> str:
    """The first of some names."""
    return ", ".join(names[:4]) + (f", ... ({len(names)})" if len(names) > 4 else "")
