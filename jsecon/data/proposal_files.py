"""Masks of single frames from disk, which still have to be brought together over the frames.

Of each frame, under its name: `<name>.json`, COCO's run-length encoded masks as SAM's own generator writes them (they
may overlap); `<name>_s.npy`, a level of LangSplat's; or `<name>.png`, one id per pixel. What an id is called does not
matter.

A run-length encoded mask is {"size": [H, W], "counts": ...}. Runs alternate between 0 and 1, 0 first, down the columns.
`counts` is a list of them, or a text of 6-bit digits: five bits a sign, the lowest first, the sixth says that more
follow, the last one's highest bit is the sign of the number. From the third run after the first on, a number is the
difference from the run two before.
Decoded here: about fifty lines, which also check that the runs fill the mask, spare a compiled dependency.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from jsecon.data.images import MOST_PIXELS, read_ids
from jsecon.data.mask_files import fitted_to_frame, read_level
from jsecon.errors import InputError, why
from jsecon.files import read_json

ENDINGS = (".json", "_s.npy", ".png")
_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle."
_RLE = ('run-length encoded masks: {"size": [H, W], "counts": a text or a list}', _REMEDY)


def decode_rle(rle: Any, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """The mask (H, W) of an encoded one. Raises InputError, at `where`, for anything else."""
    try:
        height, width = (int(side) for side in rle["size"])
        counts = rle["counts"]
        runs = np.asarray(_numbers(counts) if isinstance(counts, str) else counts, np.int64)
    except (TypeError, KeyError, ValueError, IndexError, OverflowError) as error:
        raise InputError(where, f"the mask cannot be read ({why(error)})", *_RLE) from error
    fits = runs.ndim == 1 and ((runs >= 0) & (runs <= MOST_PIXELS)).all() and min(height, width) > 0
    if not fits or height * width > MOST_PIXELS or runs.sum() != height * width:
        raise InputError(where, f"runs that fill {int(runs.sum())} of {height}x{width} pixels", *_RLE)
    values = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(values, runs).reshape(width, height).T)


def _numbers(text: str) -> list[int]:
    """The runs in a text of 6-bit digits."""
    runs: list[int] = []
    value = shift = 0
    for sign in text:
        digit = ord(sign) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"{sign!r} is no digit of a run")
        value |= (digit & 31) << shift
        shift += 5
        if not digit & 32:
            if digit & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the last run breaks off")
    return runs


def proposals_from_disk(
    folder: str | Path, names: Sequence[str], size: tuple[int, int], *, level: str = "l"
) -> tuple[Callable[[int], Bool[np.ndarray, "m h w"]], tuple[str, ...]]:
    """A function of a frame's index that reads its masks (M, H, W) bool at `size` = (H, W), and notes.

    Masks are best first where the file holds scores (SAM's stability times predicted IoU), else as they are in it; of
    another size they are resized (nearest) where the aspect agrees. A frame without a file has none. Raises InputError
    where no frame has a file, and later where one is damaged.
    """
    folder = Path(folder)
    files = [next((p for p in _places(folder, name) if p.is_file()), None) for name in names]
    missing = [name for name, file in zip(names, files) if file is None]
    if len(missing) == len(names):
        found = "no masks called like a frame" if folder.is_dir() else "no such folder"
        wanted = f"{', '.join(names[0] + ending for ending in ENDINGS)} or the like"
        raise InputError(folder, found, wanted, "Name each file like its frame.")
    notes = (f"{len(missing)} of {len(names)} frames have no masks (the first: {missing[0]}).",) if missing else ()

    def of_frame(index: int) -> Bool[np.ndarray, "m h w"]:
        file = files[index]
        masks = [] if file is None else _read(file, size, level)
        return np.stack(masks) if masks else np.zeros((0, *size), bool)

    return of_frame, notes


def _places(folder: Path, name: str) -> list[Path]:
    return [folder / f"{stem}{ending}" for stem in (name, name.split(".")[0]) for ending in ENDINGS]


def _read(file: Path, size: tuple[int, int], level: str) -> list[np.ndarray]:
    if file.suffix == ".json":
        masks = [fitted_to_frame(file, mask.astype(np.int64), size[1], size[0]) > 0 for mask in _read_json(file)]
        return [mask for mask in masks if mask.any()]
    none, image = (-1, read_level(file, level)) if file.suffix == ".npy" else (0, read_ids(file)[0])
    image = fitted_to_frame(file, image, size[1], size[0])
    return [image == id for id in np.unique(image) if id != none and id >= 0]


def _read_json(file: Path) -> list[np.ndarray]:
    """The masks of a file of SAM's generator: a list of records, or one under "annotations" as in SA-1B."""
    wanted = 'a list of {"segmentation": {"size", "counts"}, ...}'
    content = read_json(file, wanted, _REMEDY)
    try:
        records = content["annotations"] if isinstance(content, dict) else content
        coded = [record["segmentation"] for record in records]
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(file, f"it is not a list of masks ({why(error)})", wanted, _REMEDY) from error
    return [decode_rle(coded[i], f"{file}, mask {i}") for i in np.argsort(-np.asarray(scores), kind="stable")]
