"""A cache on disk of what networks compute, by content. Host code.

    FOLDER/<digest of model, settings and frame>.safetensors      masks of a frame, bits (M, ceil(H W / 8)) uint8

A run that was stopped computes only what is missing: SAM takes minutes per frame on a CPU. A file that cannot be read
is computed again.
"""

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path

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


def stored_masks(
    folder: Path, name: str, frame: UInt8[np.ndarray, "h w 3"], segment: Callable[[], Bool[np.ndarray, "m h w"]]
) -> Bool[np.ndarray, "m h w"]:
    """Reads the masks that the segmenter of a name finds in a frame, or finds and stores them."""
    height, width = frame.shape[:2]
    digest = hashlib.blake2b(f"{name} {frame.shape}".encode(), digest_size=16)
    digest.update(np.ascontiguousarray(frame).data)
    path = folder / f"{digest.hexdigest()}.safetensors"
    bits = stored_array(path, lambda: np.packbits(segment().reshape(-1, height * width), axis=1))
    return np.unpackbits(bits, axis=1, count=height * width).reshape(-1, height, width).astype(bool)
