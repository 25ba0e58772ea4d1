"""LangSplat's `language_features/`, on the host: masks of single frames with an embedding each.

`<frame>_s.npy` float32 (4, H, W): ids by level (default, s, m, l), -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). The same thing has another row in each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jsecon.errors import InputError
from jsecon.files import map_npy, reading
from jsecon.numerics import is_finite_and_bounded
from jsecon.read.masks.masks import AllFrames, MaskFitter, compact_ids, find_masks, read_level


class FrameMasks(NamedTuple):
    """The masks of single frames with an embedding each."""

    labels: np.ndarray
    """(T, H, W) int32 rows of `embeddings`, -1 = none; no row is in two frames."""
    embeddings: np.ndarray
    """(M, E) float32 unit."""
    frame: np.ndarray
    """(M,) int32 the frame of each mask."""


def load_features(
    folder: Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> FrameMasks:
    """Reads one level of the masks of frames, with their embeddings.

    Files are named as in `jsecon.read.masks.masks`. Masks that vanish at the size asked for are skipped.

    Args:
      folder: The language_features folder.
      names: T frames.
      size: (H, W) of the labels.
      level: A name of LEVELS.
      frames: All frames of the capture in order, each with its image.

    Returns:
      Labels, embeddings and the frame of each mask.

    Raises:
      InputError: A frame has no file, its two files disagree, or embeddings are not finite.
    """
    every = frames or dict.fromkeys(names)
    by_suffix = {kind.suffix: kind.path for kind in find_masks(folder, every, ("_s.npy", "_f.npy"))}

    def path_of(name: str, suffix: str) -> Path:
        path = by_suffix[suffix](name) if suffix in by_suffix else None
        return folder / f"{name}{suffix}" if path is None else path  # a missing file is an error of its reader

    fit = MaskFitter(every, size, lambda name: read_level(path_of(name, "_s.npy"), level).shape)
    labels = np.full((len(names), *size), -1, np.int32)
    rows: list[np.ndarray] = []
    frame: list[int] = []
    for t, name in enumerate(names):
        file, masks = path_of(name, "_f.npy"), path_of(name, "_s.npy")
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
    """Reads the size of the embeddings in a folder.

    Args:
      folder: The language_features folder.

    Returns:
      E, of the first file.

    Raises:
      InputError: It has no `_f.npy`, or a damaged one.
    """
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
