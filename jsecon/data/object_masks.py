"""One folder of black and white masks for each object, as SAM 2 writes them with --per_obj_png_file:
`<id>/<frame>.png`, the id in decimal digits (001, 002, ...)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from jsecon.data.images import read_ids
from jsecon.errors import InputError


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
                raise InputError(
                    folder / name,
                    found=f"a mask of {mask.shape[1]}x{mask.shape[0]}",
                    expected=f"{image.shape[1]}x{image.shape[0]}, like those of other objects",
                    remedy="Write all masks of a frame at one size.",
                )
            image[mask > 0] = int(folder.name)
    assert image is not None, f"{name} lies in none of the folders"
    return image
