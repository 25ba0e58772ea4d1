"""What a dataset's masks mean, on disk: LangSplat's `language_features/` and OpenGaussian's `text_features.json`.

`<frame>_s.npy` float32 (4, H, W): ids by level (default, s, m, l), -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (minghanqin/LangSplat, preprocess.py). Masks are those of single frames: the same thing has another row in
each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jsecon.data.mask_names import find_masks
from jsecon.data.masks import Fit, compact, read_level
from jsecon.errors import InputError, describe_error
from jsecon.files import READ_ERRORS, map_npy
from jsecon.numerics import is_finite_and_bounded
from jsecon.types import ImageFile


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
    order: Sequence[str] | None = None,
    files: Mapping[str, ImageFile] | None = None,
) -> FrameMasks:
    """Reads one level of the masks of the frames `names`, at `size` (H, W), with their embeddings.

    Files are found by name as by `jsecon.data.masks.load_labels`, which says what `order` and `files` are. Masks
    that vanish at the size asked for are left out. Raises InputError where a frame has no file, where the two files of
    a frame disagree, and on embeddings that are not finite.
    """
    found = find_masks(folder, order if order is not None else names, ("_s.npy", "_f.npy"), _is_object, files=files)
    by_ending = {kind.ending: kind.path for kind in found}

    def file_of(name: str, ending: str) -> Path:
        path = by_ending[ending](name) if ending in by_ending else None
        return folder / f"{name}{ending}" if path is None else path  # which cannot be read

    fit = Fit(files or {}, size, lambda name: read_level(file_of(name, "_s.npy"), level).shape)
    labels = np.full((len(names), *size), -1, np.int32)
    rows: list[np.ndarray] = []
    frame: list[int] = []
    for t, name in enumerate(names):
        file, masks = file_of(name, "_f.npy"), file_of(name, "_s.npy")
        table = _read_table(file)
        if rows and table.shape[-1] != len(rows[0]):
            problem, wanted = f"it has rows of {table.shape[-1]} numbers", f"{len(rows[0])}, as in the frames before"
            raise InputError(file, problem, wanted, "Write all frames' files with the same model.")
        ids, indices = compact(masks, read_level(masks, level))
        last = max(ids.tolist(), default=-1)
        if table.ndim != 2 or not is_finite_and_bounded(table) or last >= len(table):
            wanted = "a finite row for each id of the _s.npy beside it"
            problem = f"it is an array {table.shape} for ids up to {last}"
            raise InputError(file, problem, wanted, "Write both files of the frame again.")
        own = fit(masks, indices, name)
        kept = np.unique(own[own >= 0])
        place = np.full(len(ids) + 1, -1, np.int32)
        place[kept] = len(rows) + np.arange(len(kept))
        labels[t] = place[own]
        rows += [table[ids[k]] for k in kept]
        frame += [t] * len(kept)
    width = rows[0].shape[-1] if rows else 0
    embeddings = np.stack(rows).astype(np.float32) if rows else np.zeros((0, width), np.float32)
    return FrameMasks(labels, embeddings, np.array(frame, np.int32))


def _is_object(path: Path) -> bool:
    """Whether a file holds the mask of one object alone: LangSplat's hold those of many."""
    return False


def embedding_size(folder: Path) -> int:
    """E of the embeddings in `folder`. Raises InputError where it holds no `_f.npy`, or the first is damaged."""
    files = sorted(folder.rglob("*_f.npy"))
    if not files:
        remedy = "Give the language_features folder that LangSplat's preprocess.py wrote."
        raise InputError(folder, "it holds no _f.npy", "<frame>_f.npy beside <frame>_s.npy", remedy)
    return int(_read_table(files[0]).shape[-1])


def _read_table(file: Path) -> np.ndarray:
    try:
        table = map_npy(file)
        if table.ndim == 0:
            raise ValueError("a single number")
    except READ_ERRORS as error:
        wanted, remedy = "a (M, E) array, one row per mask", "Run LangSplat's preprocess.py on every frame."
        raise InputError(file, f"there is nothing readable ({describe_error(error)})", wanted, remedy) from error
    return table
