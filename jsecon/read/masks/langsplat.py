"""LangSplat's `language_features/`, on the host: masks of single frames with an embedding each.

`<frame>_s.npy` float32 (4, H, W): ids by level (default, s, m, l), -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). The same thing has another row in each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jsecon.errors import InputError
from jsecon.files import map_npy, reading
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.masks.fitting import MaskFitter, compact_ids
from jsecon.read.masks.names import AllFrames, find_masks
from jsecon.read.registry import Reader

LEVELS = ("default", "s", "m", "l")
"""levels of LangSplat's `_s.npy`, in their order: all of SAM's masks, subparts, parts, whole objects"""


class FrameMasks(NamedTuple):
    """The masks of single frames with an embedding each."""

    labels: np.ndarray
    """(T, H, W) int32 rows of `embeddings`, -1 = none; no row is in two frames."""
    embeddings: np.ndarray
    """(M, E) float32 unit."""
    frame: np.ndarray
    """(M,) int32 the frame of each mask."""


def read_level(path: Path, level: str) -> Int[np.ndarray, "h w"]:
    """Reads one level of LangSplat's `_s.npy`: (H, W) ids, -1 for no region."""
    if level not in LEVELS:
        raise InputError("level", f"there is no level {level!r}", f"one of {', '.join(LEVELS)}", "l is the coarsest.")
    expected = f"a .npy of shape ({len(LEVELS)}, H, W)"
    with reading(path, expected, "Write the masks again.", problem="the array is damaged or missing"):
        image = map_npy(path)
    if image.ndim != 3 or len(image) != len(LEVELS) or not image.size:
        expected = f"({len(LEVELS)}, H, W): levels {', '.join(LEVELS)}"
        remedy = "Give _s.npy files, not the _f.npy ones."
        raise InputError(path, f"the array has shape {image.shape}", expected, remedy)
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        image = np.asarray(image[LEVELS.index(level)], np.float64)
    # float32, LangSplat's type of ids, holds every integer below 1 << 24
    if not ((image >= -(1 << 24)) & (image < 1 << 24) & (image == image.round())).all():
        problem = "the array has numbers that are no integers or too large"
        raise InputError(path, problem, "ids, -1 for no region", "Write the masks again.")
    return image.astype(np.int64)


def load_features(
    folder: Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> FrameMasks:
    """Reads one level of the masks of frames as labels (H, W), with their embeddings.

    Masks that vanish at the size asked for are skipped. `frames` are all frames of the capture, each with its image.
    """
    every = frames or dict.fromkeys(names)
    found = find_masks(folder, every, (Reader("LangSplat", ("_s.npy",), read_level),))

    def masks_of(name: str) -> Path:
        return found.path(name) or folder / f"{name}_s.npy"  # a missing file is an error of its reader

    fit = MaskFitter(every, size)
    labels = np.full((len(names), *size), -1, np.int32)
    rows: list[np.ndarray] = []
    frame: list[int] = []
    for t, name in enumerate(names):
        masks = masks_of(name)
        file = masks.with_name(masks.name[: -len("_s.npy")] + "_f.npy")
        table = _read_table(file)
        if rows and table.shape[-1] != len(rows[0]):
            problem, expected = f"it has rows of {table.shape[-1]} numbers", f"{len(rows[0])}, as in the frames before"
            raise InputError(file, problem, expected, "Write all frames' files with the same model.")
        ids, indices = compact_ids(masks, read_level(masks, level))
        last = max(ids.tolist(), default=-1)
        if table.ndim != 2 or not is_finite_and_bounded(table) or last >= len(table):
            problem = f"it is an array {table.shape} for ids up to {last}"
            expected = "a finite row for each id of the _s.npy beside it"
            raise InputError(file, problem, expected, "Write both files of the frame again.")
        fitted = fit(masks, indices, name)
        kept = np.unique(fitted[fitted >= 0])
        row_of = np.full(len(ids) + 1, -1, np.int32)
        row_of[kept] = len(rows) + np.arange(len(kept))
        labels[t] = row_of[fitted]
        rows += [table[ids[k]] for k in kept]
        frame += [t] * len(kept)
    width = rows[0].shape[-1] if rows else 0
    embeddings = np.stack(rows).astype(np.float32) if rows else np.zeros((0, width), np.float32)
    return FrameMasks(labels, embeddings, np.array(frame, np.int32))


def embedding_size(folder: Path) -> int:
    """Reads the size E of the embeddings in a folder, by its first file."""
    files = sorted(folder.rglob("*_f.npy"))
    if not files:
        remedy = "Give the language_features folder that LangSplat's preprocess.py wrote."
        raise InputError(folder, "it holds no _f.npy", "<frame>_f.npy beside <frame>_s.npy", remedy)
    return int(_read_table(files[0]).shape[-1])


def _read_table(file: Path) -> np.ndarray:
    """Reads an array of embeddings."""
    with reading(file, "a (M, E) array, one row per mask", "Run LangSplat's preprocess.py on every frame."):
        table = map_npy(file)
        if table.ndim == 0:
            raise ValueError("a single number")
    return table
