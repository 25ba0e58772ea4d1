"""Panoramas: equirectangular photographs of all directions, on the host; told by a mark, and cut into views."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from jsecon.errors import InputError
from jsecon.read.captures.frames import PosedImage, PosedImages
from jsecon.read.captures.images import image_header
from jsecon.read.captures.lens import PANORAMA, PANORAMA_VIEWS

_MARK = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular|sv3d.{0,200}?equi", re.DOTALL)
"""of XMP (GPano), and of Google's spherical video, versions 1 and 2"""
_HEAD = 1 << 18
"""bytes of a file in which its mark lies"""


def has_mark(head: bytes) -> bool:
    """Whether the first bytes of an image, or the header of a video, say that it is equirectangular."""
    return _MARK.search(head) is not None


def find_panoramas(photos: Sequence[Path], *, declared: bool) -> tuple[list[bool], tuple[str, ...]]:
    """Tells which photographs are panoramas, by marks in their files or as the user `declared` all to be, and notes.

    A panorama is twice as wide as high.
    """
    sizes = [image_header(photo).upright for photo in photos]
    wide = [width == 2 * height for width, height in sizes]
    if declared and not all(wide):
        first = wide.index(False)
        expected = "twice as wide as high, as a panorama of all directions is"
        remedy = "Export the whole sphere, or leave out --panoramas."
        raise InputError(photos[first], "its size is {}x{}".format(*sizes[first]), expected, remedy)
    found = [is_wide and (declared or _is_marked(photo)) for photo, is_wide in zip(photos, wide)]
    if not (unmarked := sum(wide) - sum(found)):
        return found, ()
    note = f"{unmarked} photographs are twice as wide as high, but their files do not call them panoramas."
    return found, (f"{note} Give --panoramas if they show all directions.",)


def _is_marked(photo: Path) -> bool:
    """Whether a photograph says that it is equirectangular."""
    with photo.open("rb") as file:
        return has_mark(file.read(_HEAD))


def cut_panoramas(posed: PosedImages) -> PosedImages:
    """Replaces each panorama of a capture by its views, which share its file; their numbers follow its name."""
    images: list[PosedImage] = []
    for image in posed.images:
        lens, path = image.lens, PurePosixPath(image.name)
        if lens is None or lens.model != PANORAMA:
            images.append(image)
            continue
        for view, rotation in enumerate(PANORAMA_VIEWS):
            pose = image.world_to_camera.copy()
            pose[:3] = rotation @ pose[:3]
            name = str(path.with_name(f"{path.stem}_{view}{path.suffix}"))
            turned = dataclasses.replace(lens, view=view)
            images.append(dataclasses.replace(image, name=name, lens=turned, world_to_camera=pose, depth=None))
    panoramas = [image for image in posed.images if image.lens is not None and image.lens.model == PANORAMA]
    if not panoramas:
        return posed
    each = f"{len(PANORAMA_VIEWS)} views each, of 95 degrees; what lies within 30 degrees of straight down is left out"
    notes = [f"{len(panoramas)} panoramas are cut into {each}, as the operator stands there."]
    if any(image.depth is not None for image in panoramas):
        notes.append("Depth maps of panoramas are not read.")
    return dataclasses.replace(posed, images=images, notes=(*posed.notes, *notes))
