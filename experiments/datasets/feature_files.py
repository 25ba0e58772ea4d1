"""Features as LangSplat keeps them, read, and written for twins; and vectors of texts in a JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError
from jsecon.files import atomic_write, map_npy, reading, write_text
from jsecon.read.masks.masks import LEVELS, compact_ids, resize_nearest
from jsecon.vision.protocols import CANONICAL


def write_features(
    folder: Path, name: str, labels: Int[np.ndarray, "*levels h w"], embeddings: Float[np.ndarray, "m e"]
) -> None:
    """Writes one frame's masks (ids 0 .. M-1, -1 = none) with their embeddings: of the four levels default, s, m and l,
    or the same for all."""
    levels = np.broadcast_to(labels, (len(LEVELS), *labels.shape[-2:])).astype(np.float32)
    for ending, array in (("_s", levels), ("_f", embeddings.astype(np.float32))):
        with atomic_write(folder / f"{name}{ending}.npy") as temporary:
            np.save(temporary, array)


class FrameMasks(NamedTuple):
    """The masks of single frames with an embedding each."""

    labels: np.ndarray
    """(T, H, W) int32 rows of `embeddings`, -1 = none; no row is in two frames."""
    embeddings: np.ndarray
    """(M, E) float32 unit."""
    frame: np.ndarray
    """(M,) int32 the frame of each mask."""


def load_features(folder: Path, names: Sequence[str], size: tuple[int, int], *, level: str = "l") -> FrameMasks:
    """Reads one level of the masks of frames as labels (H, W), with their embeddings; without masks that vanish at this
    size."""
    remedy = "Run LangSplat's preprocess.py on every frame."
    labels = np.full((len(names), *size), -1, np.int32)
    rows: list[np.ndarray] = []
    for t, name in enumerate(names):
        path, file = (folder / f"{name}_{kind}.npy" for kind in "sf")
        if not path.is_file():
            raise InputError(path, "there is no such file", remedy=remedy)
        ids = map_npy(path)[LEVELS.index(level)].astype(np.int64)
        kept, index = compact_ids(path, ids if ids.shape == size else resize_nearest(ids, size[1], size[0]))
        with reading(file, "a row for each id of the _s.npy beside it", remedy):
            table = map_npy(file)[kept]
        labels[t] = np.where(index >= 0, index + sum(map(len, rows)), -1)
        rows.append(table)
    frame = np.repeat(np.arange(len(rows), dtype=np.int32), [len(each) for each in rows])
    return FrameMasks(labels, np.concatenate(rows).astype(np.float32), frame)


def load_text_features(file: Path, queries: Sequence[str]) -> tuple[Float[np.ndarray, "q e"], Float[np.ndarray, "4 e"]]:
    """Embeddings (Q, E) of the queries and (4, E) of the canonical phrases, from a JSON of text -> numbers. Raises
    InputError for a text that the file does not have."""
    try:
        table = json.loads(file.read_text(encoding="utf-8"))
        missing = [text for text in (*queries, *CANONICAL) if text not in table]
        if missing:
            remedy = "Embed every query and canonical phrase with the embedder that made the masks' features."
            raise InputError(file, f"no vector of {', '.join(missing)}", remedy=remedy)
        found = [np.array([table[text] for text in texts], np.float32) for texts in (queries, CANONICAL)]
    except (OSError, json.JSONDecodeError, TypeError, AttributeError) as error:
        raise InputError(file, str(error), "a JSON of text -> vector", "Write it again.") from error
    return found[0].reshape(len(queries), -1), found[1]


def write_text_features(file: Path, texts: Sequence[str], vectors: Float[np.ndarray, "q e"]) -> None:
    """Writes what `load_text_features` reads."""
    rows = {text: [round(float(x), 7) for x in vector] for text, vector in zip(texts, vectors, strict=True)}
    write_text(file, json.dumps(rows))
