"""What a dataset's masks mean, on disk: LangSplat's `language_features/` and OpenGaussian's `text_features.json`.

`<frame>_s.npy` float32 (4, H, W): ids by level (default, s, m, l), -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). Masks are those of single frames: the same thing has another row in
each.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jsecon.data.mask_files import load_labels
from jsecon.errors import InputError
from jsecon.files import UNREADABLE, map_array
from jsecon.numerics import sane


class FrameMasks(NamedTuple):
    """The masks of single frames with an embedding each."""

    labels: np.ndarray
    """(T, H, W) int32 rows of `embeddings`, -1 = none; no row is in two frames."""
    embeddings: np.ndarray
    """(M, E) float32 unit."""
    frame: np.ndarray
    """(M,) int32 the frame of each mask."""


def load_features(folder: Path, names: Sequence[str], size: tuple[int, int], *, level: str = "l") -> FrameMasks:
    """One level of the masks of the frames `names`, at `size` (H, W), with their embeddings.

    Raises InputError where a frame has no file, where the two files of a frame disagree, and on embeddings that are not
    finite. Masks that vanish at the size asked for are left out.
    """
    labels = np.full((len(names), *size), -1, np.int32)
    rows: list[np.ndarray] = []
    frame: list[int] = []
    for t, name in enumerate(names):
        file = folder / f"{name}_f.npy"
        table = _read_table(file)
        if rows and table.shape[-1] != len(rows[0]):
            found, wanted = f"rows of {table.shape[-1]} numbers", f"{len(rows[0])}, as in the frames before"
            raise InputError(file, found, wanted, "Write all frames' files with the same model.")
        found = load_labels(folder, [name], size, level=level)
        last = max(found.ids, default=-1)
        if table.ndim != 2 or not sane(table) or last >= len(table):
            wanted = "a finite row for each id of the _s.npy beside it"
            there = f"an array {table.shape} for ids up to {last}"
            raise InputError(file, there, wanted, "Write both files of the frame again.")
        kept = [k for k in range(len(found.ids)) if (found.labels[0] == k).any()]
        place = np.full(len(found.ids) + 1, -1, np.int32)
        place[kept] = len(rows) + np.arange(len(kept))
        labels[t] = place[found.labels[0]]
        rows += [table[found.ids[k]] for k in kept]
        frame += [t] * len(kept)
    width = rows[0].shape[-1] if rows else 0
    embeddings = np.stack(rows).astype(np.float32) if rows else np.zeros((0, width), np.float32)
    return FrameMasks(labels, embeddings, np.array(frame, np.int32))


def feature_size(folder: Path) -> int:
    """E of the embeddings in `folder`. Raises InputError where it holds no `_f.npy`, or the first is damaged."""
    files = sorted(folder.glob("*_f.npy"))
    if not files:
        remedy = "Give the language_features folder that LangSplat's preprocess.py wrote."
        raise InputError(folder, "no _f.npy", "<frame>_f.npy beside <frame>_s.npy", remedy)
    return int(_read_table(files[0]).shape[-1])


def _read_table(file: Path) -> np.ndarray:
    try:
        table = map_array(file)
        if table.ndim == 0:
            raise ValueError("a single number")
    except UNREADABLE as error:
        wanted, remedy = "a (M, E) array, one row per mask", "Run LangSplat's preprocess.py on every frame."
        raise InputError(file, f"nothing readable ({error})", wanted, remedy) from error
    return table
