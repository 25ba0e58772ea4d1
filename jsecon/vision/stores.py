"""A cache on disk of what networks compute, by content. Host code.

    FOLDER/<digest of model, settings and frame>.safetensors      masks of a frame, bits (M, ceil(H W / 8)) uint8

A run that was stopped computes only what is missing: SAM takes minutes per frame on a CPU. A file that cannot be read
is computed again.
"""

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from jsecon.errors import InputError
from jsecon.files import READ_ERRORS, atomic_write, read_arrays, write_arrays


def stored_array(path: Path, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """Reads an array from a file, or computes and stores it."""
    with contextlib.suppress(*READ_ERRORS):
        return read_arrays(path)[1]["array"]
    array = compute()
    # A full disk costs the next run minutes, and is no reason to end this one.
    with contextlib.suppress(InputError), atomic_write(path) as temporary:
        write_arrays(temporary, {"array": array})
    return array


class StoredSegmenter:
    """Segmenter with a network (`jsecon.vision.protocols.Models`), and a cache on disk by its name."""

    def __init__(self, segmenter: Any, folder: Path):
        self.name = segmenter.name
        self.check, self.close = segmenter.check, segmenter.close
        self._segmenter, self._folder = segmenter, folder

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Returns the masks of the segmenter for a frame, from the cache if they are there."""
        height, width = frame.shape[:2]
        digest = hashlib.blake2b(f"{self.name} {frame.shape}".encode(), digest_size=16)
        digest.update(np.ascontiguousarray(frame).data)

        def packed() -> np.ndarray:
            masks = np.asarray(self._segmenter(frame, index), bool)
            return np.packbits(masks.reshape(len(masks), height * width), axis=1)

        bits = stored_array(self._folder / f"{digest.hexdigest()}.safetensors", packed)
        return np.unpackbits(bits, axis=1, count=height * width).reshape(-1, height, width).astype(bool)
