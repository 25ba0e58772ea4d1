"""Poses of bare photographs, by structure from motion with pycolmap (extra sfm).

The steps run in a process of their own (jsecon.data.motion_steps), since COLMAP writes to the standard streams, ends
its process where a check of its own fails, and cannot be stopped within a step.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from PIL import Image

from jsecon.data import motion_steps
from jsecon.data.frames import frame_names
from jsecon.data.images import IMAGE_SUFFIXES, image_header, read_image, write_image
from jsecon.data.motion_steps import FEWEST
from jsecon.errors import InputError
from jsecon.files import list_files, write_text

_FOCAL, _FOCAL_35, _MODEL, _EXIF = 0x920A, 0xA405, 0x0110, 0x8769
"""tags of EXIF, and of the folder within it that holds the first two"""
_NO_PHOTOGRAPHS = re.compile(r"mask|depth|segmentation|proposal|label|confidence|normal|thumb")
"""in the name of a folder: it holds images that are no photographs"""


@dataclasses.dataclass(frozen=True)
class SfmResult:
    """What structure from motion found."""

    registered: tuple[str, ...]
    """names of the photographs whose poses were found, with their folders where there are several."""
    left_out: tuple[str, ...]
    """those of the others."""
    models: int
    """separate models; the one with the most photographs is kept."""
    points: int
    error_px: float
    """mean reprojection error, px of the photographs."""
    seconds: dict[str, float]
    """of each step."""

    def notes(self) -> tuple[str, ...]:
        """What a user should know, a sentence each."""
        count = len(self.registered) + len(self.left_out)
        steps = ", ".join(f"{name} {value:.0f} s" for name, value in self.seconds.items())
        told = f"Poses of {len(self.registered)} of {count} photographs were found, with {self.points} points"
        notes = [f"{told}; mean reprojection error {self.error_px:.2f} px ({steps})."]
        if self.left_out:
            names = ", ".join(self.left_out[:5]) + (" ..." if len(self.left_out) > 5 else "")
            apart = "" if self.models == 1 else f" There are {self.models} models apart: take photographs between them."
            notes.append(
                f"{len(self.left_out)} photographs match the others too little, and were left out: {names}.{apart}"
            )
        return tuple(notes)


def list_photographs(path: Path) -> list[Path]:
    """Lists the photographs of a folder, of its images/ where that has some, in name order.

    Where none lies in the folder itself, those of its subfolders are taken (cam0/, cam1/), but not what lies in folders
    of masks or depth, masks that are called like the photograph beside them (a.jpg.png), and output of jsecon.
    """
    folder = path / "images" if (path / "images").is_dir() else path
    if not folder.is_dir():
        return []
    own = sorted(file for file in folder.iterdir() if _is_image(file) and file.is_file())
    if own:
        return own
    found = [file for file in list_files(folder) if _is_image(file)]
    names = set(found)
    aside = [file.relative_to(folder).parts[:-1] for file in found]
    return [
        file
        for file, folders in zip(found, aside)
        if file.with_suffix("") not in names and not any(_NO_PHOTOGRAPHS.search(name.lower()) for name in folders)
    ]


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")


def require_pycolmap(where: object) -> None:
    """Raises InputError, at `where`, where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        remedy = "Run: pip install 'jsecon[sfm]' (or give poses: sparse/0 of COLMAP, or transforms.json)."
        raise InputError(where, "photographs without poses, and no pycolmap to find them", "pycolmap", remedy)


def check_photographs(photos: Sequence[Path], where: object) -> list[str]:
    """Returns the photographs' names below the folder that holds them all, with "/".

    Raises InputError, at `where`, on too few photographs, and where two differ in nothing but their endings.
    """
    if len(photos) < FEWEST:
        found = f"{len(photos)} photographs"
        raise InputError(where, found, f"at least {FEWEST}", "Take more, that overlap by two thirds.")
    root = os.path.commonpath([photo.parent for photo in photos])
    names = [photo.relative_to(root).as_posix() for photo in photos]
    frame_names(names, where)
    return names


def find_poses(
    photos: Sequence[Path],
    work: Path,
    *,
    where: object = "photographs",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[SfmResult, Path]:
    """Finds the poses of photographs; what was found, and the capture's folder, of COLMAP's layout, below `work`.

    The lens is COLMAP's OPENCV (two focal lengths, four coefficients), shared by all photographs whose EXIF names the
    same camera and focal length; of those whose EXIF names none, by all of one size in one folder. images/ holds links
    to the photographs (copies where the system has no links). `work`: a folder where the steps keep what they have
    found, to be removed by the caller. `progress(done, total)` counts photographs, then pairs, then steps of placing
    them all or photographs registered; `where` names the capture in errors. Seeds are set, but COLMAP's threads add up
    in any order: another run may differ in the last digits. Raises InputError where pycolmap is not installed, on too
    few or damaged photographs, where two differ in nothing but their endings, and where no model can be made.
    """
    require_pycolmap(where)
    own_names = check_photographs(photos, where)
    sizes = _sizes(photos)
    groups = _lenses(photos, sizes)
    turned = [image_header(photo).orientation != 1 for photo in photos]
    copied = [turn or photo.suffix.lower() in (".heic", ".heif") for turn, photo in zip(turned, photos)]
    endings = [".png" if copy else photo.suffix.lower() for copy, photo in zip(copied, photos)]
    names = [f"{number:06d}{ending}" for number, ending in enumerate(endings)]  # COLMAP's lists have spaces
    (work / "links").mkdir(parents=True, exist_ok=True)
    for name, photo, copy in zip(names, photos, copied):
        _link(photo, work / "links" / name, upright_copy=copy)
    job = {"size": max(set(sizes), key=sizes.count), "groups": [[names[n] for n in group] for group in groups]}
    write_text(work / "job.json", json.dumps(job | {"names": dict(zip(names, own_names))}))
    _run_steps(work, progress)
    told = json.loads((work / "found.json").read_text())
    if len(told["registered"]) < FEWEST:
        found = f"{len(photos)} photographs, of which no {FEWEST} could be brought together"
        remedy = "Take more, that overlap by two thirds."
        raise InputError(where, found, "sharp photographs of a still scene, from places apart", remedy)
    capture = work / "capture"
    for name, photo, own in zip(names, photos, own_names):
        if name in told["registered"]:
            _link(photo, capture / "images" / own)
    registered = tuple(own for name, own in zip(names, own_names) if name in told["registered"])
    others = tuple(own for name, own in zip(names, own_names) if name not in told["registered"])
    return SfmResult(registered, others, told["models"], told["points"], told["error_px"], told["seconds"]), capture


def _sizes(photos: Sequence[Path]) -> list[tuple[int, int]]:
    """(width, height) of each photograph, all of it read. Raises InputError where one is damaged."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return [image.shape[1::-1] for image, _ in pool.map(read_image, photos)]


def _lenses(photos: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> list[list[int]]:
    """The photographs' numbers, those together that have one size and whose EXIF names one camera and focal length; or
    names none, and they lie in one folder."""
    groups: dict[Any, list[int]] = {}
    for number, (photo, size) in enumerate(zip(photos, sizes)):
        lens: tuple = (photo.parent,)
        ignored = contextlib.suppress(OSError, SyntaxError, ValueError), warnings.catch_warnings(action="ignore")
        with ignored[0], ignored[1], Image.open(photo) as image:
            exif = image.getexif()
            inner = exif.get_ifd(_EXIF)
            told = exif.get(_MODEL), inner.get(_FOCAL), inner.get(_FOCAL_35)
            if any(value is not None for value in told):
                lens = tuple(map(str, told))
        groups.setdefault((size, lens), []).append(number)
    return list(groups.values())


def _link(photo: Path, link: Path, *, upright_copy: bool = False) -> None:
    """Makes `link` stand for a photograph; a copy of its upright pixels where COLMAP does not read those from the file:
    it has no HEIC, and ignores EXIF's orientation."""
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    if upright_copy:
        write_image(link, read_image(photo)[0])
        return
    try:
        link.symlink_to(photo.resolve())
    except OSError:
        shutil.copyfile(photo, link)


def _run_steps(work: Path, progress: Callable[[int, int], None] | None) -> None:
    """Runs the steps in a process of its own, and tells how far it is. It ends with this process, whichever way."""
    home = str(Path(__file__).parents[2])
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, (home, os.environ.get("PYTHONPATH"))))}
    command = [sys.executable, "-m", motion_steps.__name__, str(work)]
    with open(work / "log.txt", "w") as log:
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, env=environ, text=True)
        try:
            for line in child.stdout or ():
                if progress is not None:
                    progress(*map(int, line.split()))
            code = child.wait()
        finally:
            child.kill()
            child.wait()
    if code != 0:
        said = (work / "log.txt").read_text(errors="replace").strip().splitlines()[-1:] or ["nothing said"]
        remedy = f"All that it said is in {work / 'log.txt'}."
        raise InputError("pycolmap", f"an end with code {code} ({said[0]})", "structure from motion to its end", remedy)
