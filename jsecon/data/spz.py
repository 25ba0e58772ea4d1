"""Gaussians as a .spz, written column after column, a block of Gaussians at a time.

Format: github.com/nianticlabs/spz, version 3: one gzip stream of a header and six columns, with x right, y up, z back.
Places are fixed-point numbers in 24 bits, turns three components in 10 bits, all else is 8 bits. It is read by gsply.
"""

import contextlib
import dataclasses
import gzip
import math
import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError
from jsecon.files import written_whole
from jsecon.splat.transform import transformed_blocks
from jsecon.types import Array, Gaussians

AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""from a .ply's x right, y down, z forward to .spz's x right, y up, z back; and back again"""
_BITS = 16
"""most of a coordinate's 24 bits behind the point; far Gaussians need more of them before it"""
_LEVEL = 6
"""of gzip: more takes longer and gains little"""


def save_spz(path: str | Path, gaussians: Gaussians, *, similarity: Float[Array, "4 4"] | None = None) -> None:
    """Writes Gaussians, carried by `similarity` (4, 4) into another world, in blocks: mapped columns need not fit into
    memory. What it packs lies beside the file until that is whole, 20 to 65 bytes a Gaussian.

    Precision as in `save_gaussians`. Raises InputError for Gaussians farther than 4,000,000 units from the origin, for
    more than 2^32, and where the folder cannot be written.
    """
    carried = AXES if similarity is None else AXES @ np.asarray(similarity, np.float64)
    bare, reach = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1]), 1.0
    for _, part in transformed_blocks(bare, carried):
        reach = max(reach, float(np.abs(part.means).max(initial=1.0)))
    bits = min(_BITS, 23 - math.ceil(math.log2(reach))) if math.isfinite(reach) else 0
    if bits < 1:
        found, wanted = f"a Gaussian {reach:.3g} units from the origin", "at most 4,000,000"
        raise InputError(path, found, wanted, "Write a .ply, or bring the scene nearer to its origin.")
    if gaussians.count >= 1 << 32:
        raise InputError(path, f"{gaussians.count} Gaussians", "fewer than 2^32 in a .spz", "Write a .ply.")
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, gaussians.count, degree, bits, 0, 0)
    with written_whole(path) as temporary, contextlib.ExitStack() as stack:
        columns = [stack.enter_context(tempfile.TemporaryFile(dir=temporary.parent)) for _ in range(6)]
        for _, part in transformed_blocks(gaussians, carried):
            for column, data in zip(columns, _packed(part, bits), strict=True):
                column.write(data)
        raw = stack.enter_context(open(temporary, "wb"))
        # Without a name or a time: equal scenes give equal bytes.
        with gzip.GzipFile("", "wb", _LEVEL, raw, mtime=0) as file:
            file.write(header)
            for column in columns:
                column.seek(0)
                shutil.copyfileobj(column, file, 1 << 20)


def _packed(part: Gaussians, bits: int) -> list[bytes]:
    """The six columns of a block: places, opacities, colours, sizes, turns, harmonics."""
    means, sh = np.asarray(part.means, np.float64), np.asarray(part.sh, np.float64)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-np.asarray(part.opacity_logits, np.float64)))
    return [
        fixed.view(np.uint8).reshape(len(fixed), 3, 4)[:, :, :3].tobytes(),
        _byte(255 * opacity),
        _byte(255 * (0.15 * sh[:, 0] + 0.5)),
        _byte(16 * (np.asarray(part.log_scales, np.float64) + 10)),
        _turns(np.asarray(part.quaternions, np.float64)),
        _byte(128 * (sh[:, 1:] + 1)),
    ]


def _byte(values: np.ndarray) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _turns(wxyz: np.ndarray) -> bytes:
    """Of each unit xyzw which component is largest, in two bits, and of the three others, brought to the sign that
    makes it positive, a sign and their size up to sqrt(1/2) in nine bits; the first stands highest."""
    xyzw = np.roll(wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True), -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    others = np.take_along_axis(xyzw, (np.arange(4) + (np.arange(4) >= largest[:, None]))[:, :3], axis=1)
    others = others * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    sizes = np.minimum(np.rint(511 * math.sqrt(2) * np.abs(others)), 511).astype(np.uint32)
    a, b, c = (sizes | (others < 0).astype(np.uint32) << 9).T
    return (largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c).astype("<u4").tobytes()
