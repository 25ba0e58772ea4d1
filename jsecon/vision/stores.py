"""Caches on disk by content: embeddings of masks, and masks of frames. Host code.

    FOLDER/<digest of model and frame>.safetensors                keys (M, 16) uint8 of masks, vectors (M, E) float32
    FOLDER/<digest of model, settings and frame>.safetensors      bits (M, ceil(H W / 8)) uint8

A run that was stopped, or whose masks changed partly, computes only what is missing. SAM takes minutes per frame on a
CPU. A file that cannot be read is computed again.
"""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from jsecon.files import READ_ERRORS, atomic_write, read_arrays, write_arrays


def _file_of_frame(folder: Path, model: str, frame: UInt8[np.ndarray, "h w 3"]) -> Path:
    """Returns the file of a frame for one model."""
    digest = hashlib.blake2b(f"{model} {frame.shape}".encode(), digest_size=16)
    digest.update(np.ascontiguousarray(frame).data)
    return folder / f"{digest.hexdigest()}.safetensors"


def _write(path: Path, **arrays: np.ndarray) -> None:
    with atomic_write(path) as temporary:
        write_arrays(temporary, arrays)


class EmbeddingStore:
    """Cache of the embeddings of one model, whose name follows from its content."""

    def __init__(self, folder: Path, model: str):
        self._folder, self._model = folder, model

    def read(self, frame: UInt8[np.ndarray, "h w 3"]) -> dict[bytes, np.ndarray]:
        """Reads the cached vectors (E,) of a frame by the digests of their masks."""
        try:
            stored = read_arrays(_file_of_frame(self._folder, self._model, frame))[1]
            pairs = zip(stored["keys"], stored["vectors"], strict=True)
            return {key.tobytes(): vector for key, vector in pairs if np.isfinite(vector).all()}
        except READ_ERRORS:
            return {}

    def write(self, frame: UInt8[np.ndarray, "h w 3"], vectors: dict[bytes, np.ndarray]) -> None:
        """Replaces the cached vectors (E,) of a frame by the digests of their masks; there must be one."""
        keys = np.stack([np.frombuffer(key, np.uint8) for key in vectors])
        _write(_file_of_frame(self._folder, self._model, frame), keys=keys, vectors=np.stack(list(vectors.values())))


class StoredSegmenter:
    """Segmenter with a network (`jsecon.vision.protocols.Models`), and a cache on disk by its name."""

    def __init__(self, segmenter: Any, folder: Path):
        self.name = segmenter.name
        self.check, self.close = segmenter.check, segmenter.close
        self._segmenter, self._folder = segmenter, folder

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Returns the masks of the segmenter for a frame, from the cache if they are there."""
        path, (height, width) = _file_of_frame(self._folder, self.name, frame), frame.shape[:2]
        try:
            bits = read_arrays(path)[1]["bits"]
            if bits.shape[1] != -(-height * width // 8):
                raise ValueError(f"{bits.shape[1]} bytes a mask")
            return np.unpackbits(bits, axis=1, count=height * width).reshape(-1, height, width).astype(bool)
        except READ_ERRORS:
            masks = np.asarray(self._segmenter(frame, index), bool)
        _write(path, bits=np.packbits(masks.reshape(len(masks), height * width), axis=1))
        return masks
