"""Caches on disk by content: embeddings of masks, and masks of frames. Host code.

    FOLDER/<digest of model and frame>.safetensors                keys (M, 16) uint8 of masks, vectors (M, E) float32
    FOLDER/<digest of model, settings and frame>.safetensors      bits (M, ceil(H W / 8)) uint8, shape (3,)

A run that was stopped, or whose masks changed partly, computes only what is missing. SAM takes minutes per frame on a
CPU.
"""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from jsecon.files import READ_ERRORS, atomic_write, read_arrays, write_arrays
from jsecon.vision.protocols import NamedSegmenter


@dataclasses.dataclass(frozen=True)
class EmbeddingStore:
    """Cache of the embeddings of one model."""

    folder: Path
    model: str
    """Identifies the model by its content."""

    def read(self, frame: UInt8[np.ndarray, "h w 3"]) -> dict[bytes, np.ndarray]:
        """Reads the cached vectors of a frame.

        Args:
          frame: (H, W, 3) uint8 RGB.

        Returns:
          Vectors (E,) float32 by `mask_key`; empty if the file cannot be read.
        """
        try:
            _, stored = read_arrays(self._path(frame))
            pairs = zip(stored["keys"], stored["vectors"], strict=True)
            return {key.tobytes(): vector for key, vector in pairs if np.isfinite(vector).all()}
        except READ_ERRORS:
            return {}

    def write(self, frame: UInt8[np.ndarray, "h w 3"], vectors: dict[bytes, np.ndarray]) -> None:
        """Replaces the cached vectors of a frame.

        Args:
          frame: (H, W, 3) uint8 RGB.
          vectors: Vectors (E,) float32 by `mask_key`.

        Raises:
          InputError: The file cannot be written.
        """
        if not vectors:
            return
        keys = np.stack([np.frombuffer(key, np.uint8) for key in vectors])
        _write(self._path(frame), keys=keys, vectors=np.stack(list(vectors.values())))

    def _path(self, frame: np.ndarray) -> Path:
        return self.folder / f"{_frame_digest(self.model, frame)}.safetensors"


def _write(path: Path, **arrays: np.ndarray) -> None:
    with atomic_write(path) as temporary:
        write_arrays(temporary, arrays)


def _frame_digest(model: str, frame: UInt8[np.ndarray, "h w 3"]) -> str:
    """Returns 32 hex digits that identify a frame (H, W, 3) for one model."""
    digest = hashlib.blake2b(f"{model} {frame.shape}".encode(), digest_size=16)
    digest.update(np.ascontiguousarray(frame).data)
    return digest.hexdigest()


def mask_key(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """Identifies a mask by its content.

    Args:
      mask: (H, W) bool.

    Returns:
      16 bytes.
    """
    return hashlib.blake2b(np.packbits(mask).tobytes(), digest_size=16).digest()


class StoredSegmenter:
    """Segmenter (jsecon.vision.protocols) with a cache on disk.

    The `name` of the segmenter must identify its model and settings. A file that cannot be read is computed again.
    Calls raise InputError if the folder cannot be written.

    Args:
      segmenter: Computes masks that are not cached.
      folder: Folder of the cache.
    """

    def __init__(self, segmenter: NamedSegmenter, folder: str | Path):
        self.name = segmenter.name
        self._segmenter, self._folder = segmenter, Path(folder)

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Returns the masks (M, H, W) bool of the segmenter for a frame (H, W, 3) uint8."""
        path = self._path(frame)
        try:
            bits, pixels = read_arrays(path)[1]["bits"], frame.shape[0] * frame.shape[1]
            if bits.shape[1] != -(-pixels // 8):
                raise ValueError(f"{bits.shape[1]} bytes a mask")
            return np.unpackbits(bits, axis=1, count=pixels).reshape(-1, *frame.shape[:2]).astype(bool)
        except READ_ERRORS:
            masks = np.asarray(self._segmenter(frame, index), bool)
        bits = np.packbits(masks.reshape(len(masks), frame.shape[0] * frame.shape[1]), axis=1)
        _write(path, bits=bits, shape=np.asarray(masks.shape))
        return masks

    def _path(self, frame: np.ndarray) -> Path:
        return self._folder / f"{_frame_digest(self.name, frame)}.safetensors"

    def check(self) -> None:
        """Checks that the segmenter can work.

        Raises:
          InputError: It cannot.
        """
        self._segmenter.check()

    def close(self) -> None:
        """Frees the memory of the segmenter."""
        self._segmenter.close()
