"""COCO's run-length encoded masks, as SAM's own generator writes them: {"size": [H, W], "counts": ...}.

Runs alternate between 0 and 1, 0 first, down the columns. `counts` is a list of them, or a text of 6-bit digits: five
bits a sign, the lowest first, the sixth says that more follow, the last one's highest bit is the sign of the number.
From the third run after the first on, a number is the difference from the run two before.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool

from jsecon.errors import InputError


def decode_rle(rle: object, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """The mask (H, W) of an encoded one. Raises InputError, at `where`, for anything else."""
    try:
        height, width = (int(side) for side in rle["size"])
        counts = rle["counts"]
        runs = np.asarray(_numbers(counts) if isinstance(counts, str) else counts, np.int64)
    except (TypeError, KeyError, ValueError, IndexError) as error:
        raise _no_mask(where, f"a mask that cannot be read ({error!r})") from error
    if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width or height * width == 0:
        raise _no_mask(where, f"runs that fill {int(runs.sum())} of {height}x{width} pixels")
    values = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(values, runs).reshape(width, height).T)


def _numbers(text: str) -> list[int]:
    """The runs in a text of 6-bit digits."""
    runs: list[int] = []
    value = shift = 0
    for sign in text:
        digit = ord(sign) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"{sign!r} is no digit of a run")
        value |= (digit & 31) << shift
        shift += 5
        if not digit & 32:
            if digit & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the last run breaks off")
    return runs


def _no_mask(where: str | Path, found: str) -> InputError:
    return InputError(
        where,
        found=found,
        expected='run-length encoded masks: {"size": [H, W], "counts": a text or a list}',
        remedy="Write them with SAM's scripts/amg.py --convert-to-rle.",
    )
