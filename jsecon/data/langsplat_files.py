"""What a dataset's masks mean, on disk: LangSplat's `language_features/` and OpenGaussian's `text_features.json`.

`<frame>_s.npy` float32 (4, H, W): ids by level (default, s, m, l), -1 = none, which are rows of `<frame>_f.npy` float32
(M, E), unit (REFERENCE B.4). Masks are those of single frames: the same thing has another row in each.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jsecon.data.labels import LEVELS, load_labels
from jsecon.errors import InputError
from jsecon.files import write_text, written_whole
from jsecon.vision.protocols import CANONICAL


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
            raise InputError(
                file,
                found=f"rows of {table.shape[-1]} numbers",
                expected=f"{len(rows[0])}, as in the frames before",
                remedy="Write all frames' files with the same model.",
            )
        found = load_labels(folder, [name], size, level=level)
        if table.ndim != 2 or not np.isfinite(table).all() or max(found.ids, default=-1) >= len(table):
            raise InputError(
                file,
                found=f"an array {table.shape} for ids up to {max(found.ids, default=-1)}",
                expected="a finite row for each id of the _s.npy beside it",
                remedy="Write both files of the frame again.",
            )
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
        raise InputError(
            folder,
            found="no _f.npy",
            expected="<frame>_f.npy beside <frame>_s.npy",
            remedy="Give the language_features folder that LangSplat's preprocess.py wrote.",
        )
    return int(_read_table(files[0]).shape[-1])


def _read_table(file: Path) -> np.ndarray:
    try:
        table = np.load(file, allow_pickle=False)
        if table.ndim == 0:
            raise ValueError("a single number")
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            file,
            found=f"nothing readable ({error})",
            expected="a (M, E) array, one row a mask",
            remedy="Run LangSplat's preprocess.py on every frame.",
        ) from error
    return table


def write_features(
    folder: Path, name: str, labels: Int[np.ndarray, "h w"], embeddings: Float[np.ndarray, "m e"]
) -> None:
    """Writes one frame's masks (ids 0 .. M-1, -1 = none) to all four levels, with their embeddings."""
    levels = np.repeat(labels[None].astype(np.float32), len(LEVELS), axis=0)
    for ending, array in (("_s", levels), ("_f", embeddings.astype(np.float32))):
        with written_whole(folder / f"{name}{ending}.npy") as temporary:
            np.save(temporary, array)


def load_text_features(file: Path, queries: Sequence[str]) -> tuple[Float[np.ndarray, "q e"], Float[np.ndarray, "4 e"]]:
    """Embeddings (Q, E) of the queries and (4, E) of the canonical phrases, from a JSON of text -> numbers. Raises
    InputError for a text that the file does not have."""
    try:
        table = json.loads(file.read_text(encoding="utf-8"))
        missing = [text for text in (*queries, *CANONICAL) if text not in table]
        if missing:
            raise InputError(
                file,
                found=f"no vector of {', '.join(missing)}",
                expected="every query and the four canonical phrases",
                remedy="Embed them with the text encoder of the embedder that made the masks' features.",
            )
        found = [np.array([table[text] for text in texts], np.float32) for texts in (queries, CANONICAL)]
    except (OSError, json.JSONDecodeError, TypeError, AttributeError) as error:
        raise InputError(
            file, found=str(error), expected="a JSON of text -> vector", remedy="Write it again."
        ) from error
    return found[0].reshape(len(queries), -1), found[1]


def write_text_features(file: Path, texts: Sequence[str], vectors: Float[np.ndarray, "q e"]) -> None:
    """Writes what `load_text_features` reads."""
    rows = {text: [round(float(x), 7) for x in vector] for text, vector in zip(texts, vectors, strict=True)}
    write_text(file, json.dumps(rows))
