"""Masks of files at the size of the frames, and their ids as indices, on the host."""

from __future__ import annotations

import collections
from pathlib import Path

import numpy as np
from jaxtyping import Int16

from jsecon.errors import InputError
from jsecon.read.captures.images import TRANSPOSED, apply_orientation
from jsecon.read.masks.names import AllFrames

MAX_REGIONS = int(np.iinfo(np.int16).max)


def resize_nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resizes an image of integers (H, W): each pixel has the value at its centre."""
    rows, columns = image.shape
    down = (2 * np.arange(height) + 1) * rows // (2 * height)
    across = (2 * np.arange(width) + 1) * columns // (2 * width)
    return image[down[:, None], across]


def _same_aspect(rows: int, columns: int, width: int, height: int) -> bool:
    """Whether an image has the aspect of a size, to a pixel of the coarser of the two, whose size was rounded."""
    return min(abs(columns * height / rows - width), abs(width * rows / height - columns)) <= 1


class MaskFitter:
    """Brings masks to the size (H, W) of the frames, and counts the changes.

    Masks have the size of the frames' images, upright or as stored, at any scale.
    """

    def __init__(self, frames: AllFrames, size: tuple[int, int]):
        self.files = {name: file for name, file in frames.items() if file is not None}
        self.height, self.width = size
        self.count: collections.Counter[str] = collections.Counter()

    def __call__(self, path: Path, image: np.ndarray, name: str) -> np.ndarray:
        """Turns and resizes the mask of a frame to (H, W); raises InputError, with its file, for another aspect."""
        file = self.files.get(name)
        upright = (self.width, self.height) if file is None else (file.width, file.height)
        orientation = 1 if file is None else file.orientation
        stored = upright[::-1] if orientation in TRANSPOSED else upright
        rows, columns = image.shape
        fits_upright = _same_aspect(rows, columns, *upright)
        if orientation != 1 and _same_aspect(rows, columns, *stored) and not fits_upright:
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
    """Replaces the ids of a label image, negative for no region, by their indices: the ids, ascending, and (H, W)."""
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
