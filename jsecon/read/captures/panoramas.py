"""Panoramas: equirectangular photographs of all directions, on the host; told by a mark, and cut into views."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from jsecon.read.captures.frames import PosedImage, PosedImages
from jsecon.read.captures.images import image_header
from jsecon.read.captures.lens import PANORAMA_VIEWS, Lens, panorama_lens

_MARK = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*equirectangular|sv3d.{0,200}?equi", re.DOTALL)
"""of XMP (GPano), and of Google's spherical video, versions 1 and 2"""


def has_mark(head: bytes) -> bool:
    """Whether the first bytes of an image, or the header of a video, say that it is equirectangular."""
    return _MARK.search(head) is not None


def find_panoramas(photos: Sequence[Path], *, declared: bool) -> tuple[list[Path], tuple[str, ...]]:
    """Finds the panoramas among photographs, by marks in their files or as the user `declared` all to be, and notes.

    A panorama is twice as wide as high.
    """
    found, unmarked = [], 0
    for photo in photos:
        width, height = image_header(photo).upright
        if declared:
            panorama_lens(photo, width, height)  # refuses another aspect
        if width == 2 * height:
            with photo.open("rb") as file:
                is_found = declared or has_mark(file.read(1 << 18))
            found += [photo] if is_found else []
            unmarked += not is_found
    note = f"{unmarked} photographs are twice as wide as high, but their files do not call them panoramas."
    return found, (f"{note} Give --panoramas if they show all directions.",) if unmarked else ()


def _cut_view(panorama: PosedImage, lens: Lens, view: int) -> PosedImage:
    """A view of a panorama."""
    pose, path = panorama.world_to_camera.copy(), PurePosixPath(panorama.name)
    pose[:3] = PANORAMA_VIEWS[view] @ pose[:3]
    name = str(path.with_name(f"{path.stem}_{view}{path.suffix}"))
    turned = dataclasses.replace(lens, view=view)
    return dataclasses.replace(panorama, name=name, lens=turned, world_to_camera=pose, depth=None)


def cut_panoramas(posed: PosedImages) -> PosedImages:
    """Replaces each panorama of a capture by its views, which share its file; their numbers follow its name."""
    lenses = [(image, image.lens) for image in posed.images if image.lens is not None]
    panoramas = [(image, lens) for image, lens in lenses if lens.panorama]
    if not panoramas:
        return posed
    images = [image for image in posed.images if image.lens is None or not image.lens.panorama]
    images += [_cut_view(*panorama, view) for panorama in panoramas for view in range(len(PANORAMA_VIEWS))]
    each = f"{len(PANORAMA_VIEWS)} views each, of 95 degrees; what lies within 30 degrees of straight down is left out"
    note = f"{len(panoramas)} panoramas are cut into {each}, as the operator stands there."
    return dataclasses.replace(posed, images=images, notes=(*posed.notes, note))
