"""Panoramas: equirectangular photographs of all directions, on the host; told by a mark."""

import re
from collections.abc import Sequence
from pathlib import Path

from jsecon.read.captures.images import image_header
from jsecon.read.captures.lens import panorama_lens

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
