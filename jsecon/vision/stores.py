"""A cache on disk of what networks compute: masks of frames, embeddings of words. Host code.

A run that was stopped computes only what is missing: SAM takes minutes per frame on a CPU. A file that cannot be read
is computed again.
"""

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

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
