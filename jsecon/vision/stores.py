"""Embeddings kept on disk by content: the same mask of the same frame is embedded once by the same model.

    FOLDER/<digest of model and frame>.safetensors      keys (M, 16) uint8 of its masks, vectors (M, E) float32

So a run that was stopped embeds only what is missing, and so does one whose masks have changed in part.

A segmenter whose masks are kept on disk by content: a frame is cut once by the same model with the same settings.

    FOLDER/<digest of model, settings and frame>.safetensors      bits (M, ceil(H W / 8)) uint8, shape (3,)

SAM takes minutes per frame on a CPU; a run that is stopped in the middle of its frames goes on where it stopped.
"""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from jsecon.files import READ_ERRORS, atomic_write, read_arrays, write_arrays
from jsecon.vision.protocols import NamedSegmenter


@dataclasses.dataclass(frozen=True)
class EmbeddingStore:
    """What one model has embedded."""

    folder: Path
    model: str
    """names the model by its content."""

    def read(self, frame: UInt8[np.ndarray, "h w 3"]) -> dict[bytes, np.ndarray]:
        """Mask key -> vector (E,) float32 of a frame. A file that cannot be read holds nothing: it only saves time."""
        try:
            _, stored = read_arrays(self._path(frame))
            pairs = zip(stored["keys"], stored["vectors"], strict=True)
            return {key.tobytes(): vector for key, vector in pairs if np.isfinite(vector).all()}
        except READ_ERRORS:
            return {}

    def write(self, frame: UInt8[np.ndarray, "h w 3"], vectors: dict[bytes, np.ndarray]) -> None:
        """Keeps the vectors of a frame, in place of those kept before. Raises InputError where it cannot write."""
        if not vectors:
            return
        keys = np.stack([np.frombuffer(key, np.uint8) for key in vectors])
        _write(self._path(frame), keys=keys, vectors=np.stack(list(vectors.values())))

    def _path(self, frame: np.ndarray) -> Path:
        return self.folder / f"{frame_digest(self.model, frame)}.safetensors"


def _write(path: Path, **arrays: np.ndarray) -> None:
    with atomic_write(path) as temporary:
        write_arrays(temporary, arrays)


def frame_digest(model: str, frame: UInt8[np.ndarray, "h w 3"]) -> str:
    """32 hex digits that name a frame as one model sees it."""
    digest = hashlib.blake2b(f"{model} {frame.shape}".encode(), digest_size=16)
    digest.update(np.ascontiguousarray(frame).data)
    return digest.hexdigest()


def mask_key(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """16 bytes that name a mask."""
    return hashlib.blake2b(np.packbits(mask).tobytes(), digest_size=16).digest()


def lookup_vectors(
    known: dict[bytes, np.ndarray], keys: list[bytes], dim: int
) -> tuple[Float32[np.ndarray, "m e"], list[int]]:
    """Rows (M, E) of the keys that are known, zero for the others, and the indices of those others."""
    rows = np.zeros((len(keys), dim), np.float32)
    missing = []
    for index, key in enumerate(keys):
        if key in known and known[key].shape == (dim,):
            rows[index] = known[key]
        else:
            missing.append(index)
    return rows, missing


class StoredSegmenter:
    """Segmenter (jsecon.vision.protocols) that asks `segmenter` for what `folder` does not hold.

    The segmenter's `name` must tell it from others, and from itself with other settings. A file that cannot be read is
    computed again. Raises InputError where the folder cannot be written.
    """

    def __init__(self, segmenter: NamedSegmenter, folder: str | Path):
        self.name = segmenter.name
        self._segmenter, self._folder = segmenter, Path(folder)

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """frame (H, W, 3) uint8 -> masks (M, H, W) bool, as the segmenter gave them."""
        path = self._folder / f"{frame_digest(self.name, frame)}.safetensors"
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

    def check(self) -> None:
        """Raises InputError where the segmenter cannot work."""
        self._segmenter.check()

    def close(self) -> None:
        """Drops what the segmenter holds in memory."""
        self._segmenter.close()
