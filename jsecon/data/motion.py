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
from jsecon.data.images import IMAGE_ENDINGS, read_image, write_image
from jsecon.data.motion_steps import FEWEST
from jsecon.errors import InputError
from jsecon.files import write_text

_FOCAL, _FOCAL_35, _MODEL, _EXIF = 0x920A, 0xA405, 0x0110, 0x8769
"""tags of EXIF, and of the folder within it that holds the first two"""


@dataclasses.dataclass(frozen=True)
class Motion:
    """What structure from motion found."""

    registered: tuple[str, ...]
    """file names of the photographs whose poses were found."""
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


def photographs(path: Path) -> list[Path]:
    """The image files of a folder, of its images/ where it has one, in name order; hidden ones don't count."""
    folder = path / "images" if (path / "images").is_dir() else path
    endings = {ending.lower() for ending in IMAGE_ENDINGS}
    files = [f for f in folder.iterdir() if f.suffix.lower() in endings and f.is_file()] if folder.is_dir() else []
    return sorted(file for file in files if not file.name.startswith("."))


def find_poses(
    photos: Sequence[Path],
    work: Path,
    *,
    where: object = "photographs",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Motion, Path]:
    """Finds the poses of photographs; what was found, and the capture's folder, of COLMAP's layout, below `work`.

    The lens is COLMAP's OPENCV (two focal lengths, four coefficients), shared by all photographs whose EXIF names the
    same camera and focal length, or names none. images/ holds links to the photographs (copies where the system has no
    links). `work`: a folder where the steps keep what they have found, to be removed by the caller. `progress(done,
    total)` counts photographs, then pairs, then steps of placing them all or photographs registered; `where` names the
    capture in errors. Seeds are set, but COLMAP's threads add up in any order: another run may differ in the last
    digits. Raises InputError where pycolmap is not installed, on too few, damaged or unequally large photographs, and
    where no model can be made.
    """
    if importlib.util.find_spec("pycolmap") is None:
        remedy = "Run: pip install 'jsecon[sfm]' (or give poses: sparse/0 of COLMAP, or transforms.json)."
        raise InputError(where, "photographs without poses, and no pycolmap to find them", "pycolmap", remedy)
    remedy = "Take more, that overlap by two thirds."
    if len(photos) < FEWEST:
        raise InputError(where, f"{len(photos)} photographs", f"at least {FEWEST}", remedy)
    size, groups = _one_size(photos, where), _lenses(photos)
    endings = [photo.suffix.lower().replace(".heic", ".png") for photo in photos]  # COLMAP reads no HEIC
    names = [f"{number:06d}{ending}" for number, ending in enumerate(endings)]  # COLMAP's lists have spaces
    (work / "links").mkdir(parents=True, exist_ok=True)
    for name, photo in zip(names, photos):
        _link(photo, work / "links" / name)
    job = {"size": size, "groups": [[names[n] for n in group] for group in groups]}
    write_text(work / "job.json", json.dumps(job | {"names": {n: photo.name for n, photo in zip(names, photos)}}))
    _run_steps(work, progress)
    told = json.loads((work / "found.json").read_text())
    if len(told["registered"]) < FEWEST:
        found = f"{len(photos)} photographs, of which no {FEWEST} could be brought together"
        raise InputError(where, found, "sharp photographs of a still scene, from places apart", remedy)
    capture = work / "capture"
    for name, photo in zip(names, photos):
        if name in told["registered"]:
            _link(photo, capture / "images" / photo.name)
    registered = tuple(photo.name for name, photo in zip(names, photos) if name in told["registered"])
    others = tuple(photo.name for name, photo in zip(names, photos) if name not in told["registered"])
    return Motion(registered, others, told["models"], told["points"], told["error_px"], told["seconds"]), capture


def _one_size(photos: Sequence[Path], where: object) -> tuple[int, int]:
    """(width, height) of all the photographs, each read whole. Raises InputError where they differ."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        sizes = [image.shape[1::-1] for image, _ in pool.map(read_image, photos)]
    commonest = max(set(sizes), key=sizes.count)
    odd = [f"{p.name} of {w}x{h}" for p, (w, h) in zip(photos, sizes) if (w, h) != commonest]
    if odd:
        told, remedy = ", ".join(odd[:3]) + (" ..." if len(odd) > 3 else ""), "Take these out, or run each size alone."
        found, expected = f"photographs of several sizes ({told})", f"all of {commonest[0]}x{commonest[1]}, as most are"
        raise InputError(where, found, expected, remedy)
    return commonest


def _lenses(photos: Sequence[Path]) -> list[list[int]]:
    """The photographs' numbers, those together whose EXIF names one camera and focal length."""
    groups: dict[Any, list[int]] = {}
    for number, photo in enumerate(photos):
        lens = None
        ignored = contextlib.suppress(OSError, SyntaxError, ValueError), warnings.catch_warnings(action="ignore")
        with ignored[0], ignored[1], Image.open(photo) as image:
            exif = image.getexif()
            inner = exif.get_ifd(_EXIF)
            lens = exif.get(_MODEL), str(inner.get(_FOCAL)), str(inner.get(_FOCAL_35))
        groups.setdefault(lens, []).append(number)
    return list(groups.values())


def _link(photo: Path, link: Path) -> None:
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    if link.suffix.lower() != photo.suffix.lower():
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
