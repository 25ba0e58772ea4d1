"""Gaussians as a .spz: read in every version, written as version 3, column after column, a block at a time.

Format: github.com/nianticlabs/spz. A header and six columns, in one gzip stream (versions 1 to 3) or a zstd stream each
(version 4); x right, y up, z back, unless a record says otherwise. Places are fixed-point numbers in 24 bits (float16
in version 1), turns three components of 8 bits, from version 3 on of 10, all else is 8 bits.
"""

import contextlib
import dataclasses
import gzip
import itertools
import math
import shutil
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jsecon.data.gaussians.ply import drawable_gaussians, usable_blocks
from jsecon.errors import InputError, describe_error
from jsecon.files import atomic_write
from jsecon.splat.project import check_gaussians
from jsecon.splat.transform import transform_axes
from jsecon.types import Array, Gaussians

AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""from a .ply's x right, y down, z forward to .spz's x right, y up, z back; and back again"""
_LARGEST = (1 << 23) - 1
"""of a place's fixed-point number"""
_BITS, _SMALL_BITS = 16, 24
"""most of a coordinate's bits behind the point: of scenes that reach farther than 1 unit, and of others"""
_SIZE_STEPS, _LEAST_SIZE = 16, -10.0
"""steps of a size's logarithm in a unit, and its least; 255 steps above it is the largest"""
_TOO_SMALL = 0.01
"""part of the Gaussians that may be smaller than the least size: more, and another scene would be written"""
_COLOUR = 0.15
"""part of a colour's byte that a coefficient of degree 0 changes"""
_LEAST_OPACITY = 1e-6
"""that the bytes 0 and 255 are read as, and its distance from 1"""
_LEVEL = 6
"""of gzip: more takes longer and gains little"""
_MOST_DEFLATED = 1032
"""bytes that one byte of a deflated stream can stand for"""
_ANTIALIASED, _RECORDS = 1, 2
"""flags of a file"""
_ORBIT, _COORDINATES = 0xADBE0002, 0xADBE0003
"""kinds of records: limits of a viewer's camera, and the axes that the numbers are stored in"""
_MOST_RECORDS = 1 << 20
"""bytes of records that are read"""
_SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""coordinate systems 1 to 16: where x, y and z point to, left or right, up or down, forward or back"""
_TOWARDS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
"""a direction in a .ply's axes"""
_WANTED, _AGAIN = "a whole .spz", "Export it again, or as a .ply."


def save_spz(path: str | Path, gaussians: Gaussians, *, similarity: Float[Array, "4 4"] | None = None) -> None:
    """Writes Gaussians, carried by `similarity` (4, 4) into another world, in blocks: mapped columns need not fit into
    memory. What it packs lies beside the file until that is whole, 20 to 65 bytes a Gaussian.

    Precision as in `save_gaussians`. Raises ValueError where shapes disagree; InputError for Gaussians that cannot be
    drawn, farther than 4,194,303 units from the origin, or so far that places are rounded by more than most Gaussians'
    size, larger than exp(5.9) units, or of which more than 1 % are smaller than exp(-10) units, for more than 2^32, and
    where the folder cannot be written.
    """
    into = AXES if similarity is None else AXES @ np.asarray(similarity, np.float64)
    bits = _fraction_bits(path, gaussians, into)
    if gaussians.count >= 1 << 32:
        raise InputError(path, f"{gaussians.count} Gaussians", "fewer than 2^32 in a .spz", "Write a .ply.")
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, gaussians.count, degree, bits, 0, 0)
    with atomic_write(path) as temporary, contextlib.ExitStack() as stack:
        columns = [stack.enter_context(tempfile.TemporaryFile(dir=temporary.parent)) for _ in range(6)]
        for _, part in usable_blocks(path, gaussians, into):
            for column, data in zip(columns, _packed(part, bits), strict=True):
                column.write(data)
        raw = stack.enter_context(open(temporary, "wb"))
        # Without a name or a time: equal scenes give equal bytes.
        with gzip.GzipFile("", "wb", _LEVEL, raw, mtime=0) as file:
            file.write(header)
            for column in columns:
                column.seek(0)
                shutil.copyfileobj(column, file, 1 << 20)


def _fraction_bits(path: str | Path, gaussians: Gaussians, into: np.ndarray) -> int:
    """The bits behind the point with which the farthest Gaussian fits into 24. Raises InputError where none do, and
    where sizes do not fit."""
    reach, small, large = 0.0, 0, -np.inf
    check_gaussians(gaussians)
    for _, part in usable_blocks(path, dataclasses.replace(gaussians, sh=gaussians.sh[:, :1]), into):
        sizes = np.asarray(part.log_scales, np.float64).max(axis=1)
        reach = max(reach, float(np.abs(part.means).max()))
        large = max(large, float(sizes.max()))
        small += int((sizes < _LEAST_SIZE - 0.5 / _SIZE_STEPS).sum())
    bits = _BITS if reach > 1 else _SMALL_BITS
    while bits > 0 and reach * 2.0**bits > _LARGEST:
        bits -= 1
    if bits < 1:  # 0 would do for the format, but not for all of its readers
        remedy = "Write a .ply, or bring the scene nearer to its origin."
        raise InputError(path, f"a Gaussian lies {reach:,.0f} units from the origin", "at most 4,194,303", remedy)
    step, coarse = 2.0**-bits, 0
    if bits < _BITS:
        for _, part in usable_blocks(path, dataclasses.replace(gaussians, sh=gaussians.sh[:, :1]), into):
            coarse += int((np.exp(np.asarray(part.log_scales, np.float64).max(axis=1)) < 2 * step).sum())
    if coarse > 0.5 * gaussians.count:
        found = f"its places would be rounded to {step:.3g} units, which is coarser than most of the Gaussians"
        remedy = "Write a .ply or a .glb, or bring the scene nearer to its origin."
        raise InputError(path, found, "a scene nearer to its origin in a .spz", remedy)
    if large > _LEAST_SIZE + 255.5 / _SIZE_STEPS:
        found = f"a Gaussian is {math.exp(min(large, 700)):.3g} units large"
        raise InputError(path, found, "at most 379 in a .spz", "Write a .ply, or scale the scene down.")
    if small > _TOO_SMALL * gaussians.count:
        found = f"{small} of {gaussians.count} Gaussians are smaller than 4.5e-5 units"
        raise InputError(path, found, "larger ones in a .spz", "Write a .ply, or scale the scene up.")
    return bits


def _packed(part: Gaussians, bits: int) -> list[bytes]:
    """The six columns of a block: places, opacities, colours, sizes, turns, harmonics."""
    means, sh = np.asarray(part.means, np.float64), np.asarray(part.sh, np.float64)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-np.asarray(part.opacity_logits, np.float64)))
    return [
        fixed.view(np.uint8).reshape(len(fixed), 3, 4)[:, :, :3].tobytes(),
        _byte(255 * opacity),
        _byte(255 * (_COLOUR * sh[:, 0] + 0.5)),
        _byte(_SIZE_STEPS * (np.asarray(part.log_scales, np.float64) - _LEAST_SIZE)),
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
    others = np.take_along_axis(xyzw, _others(largest), axis=1)
    others = others * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    sizes = np.minimum(np.rint(511 * math.sqrt(2) * np.abs(others)), 511).astype(np.uint32)
    a, b, c = (sizes | (others < 0).astype(np.uint32) << 9).T
    return (largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c).astype("<u4").tobytes()


def load_spz(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .spz of version 1 to 4, degrees 0 to 3, in the world of the .ply that it was made from.

    Versions 1 to 3 are gzip, version 4 is zstd and needs the package zstandard. Numbers are turned from the axes that
    the file names in its record of a coordinate system (0xADBE0003), else from x right, y up, z back.

    Args:
      path: The .spz file.

    Returns:
      Its Gaussians, float32 (N may be 0); and sentences about what the file says that is not done.

    Raises:
      InputError: The file is damaged, of another version or of degree 4, names axes that are not known, or needs
        zstandard where that is not installed.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, describe_error(error), _WANTED, "Check the path.") from error
    try:
        head, columns, records = (_unzipped if data[:2] == b"\x1f\x8b" else _streams)(path, data)
        axes, notes = _recorded(path, records)
    except (EOFError, zlib.error, struct.error, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "the file is damaged or cut short", _WANTED, _AGAIN) from error
    if head.flags & _ANTIALIASED:
        notes = (*notes, f"{path.name} was trained with antialiasing (Mip-Splatting), and is drawn without it.")
    gaussians = drawable_gaussians(path, _unpacked(head, columns))
    return transform_axes(gaussians, axes), notes


@dataclasses.dataclass(frozen=True)
class _Head:
    """What a file says of its numbers."""

    version: int
    count: int
    degree: int
    bits: int
    flags: int

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of a Gaussian in each column: places, opacities, colours, sizes, turns, harmonics."""
        return 6 if self.version == 1 else 9, 1, 3, 3, 3 if self.version < 3 else 4, 3 * ((self.degree + 1) ** 2 - 1)


def _head(path: Path, data: bytes) -> _Head:
    magic, *numbers = struct.unpack("<4sIIBBB", data[:15])
    head = _Head(*numbers)
    if magic != b"NGSP":
        raise InputError(path, "it does not begin as a .spz does", _WANTED, _AGAIN)
    if not 1 <= head.version <= 4:
        raise InputError(path, f"it is of version {head.version}", "a .spz of version 1 to 4", _AGAIN)
    if head.degree > 3:
        remedy = "Export it again with harmonics of degree 3 or less."
        raise InputError(path, f"its spherical harmonics are of degree {head.degree}", "a degree of 0 to 3", remedy)
    if head.bits > 30:
        raise InputError(path, f"its places have {head.bits} bits behind the point", "30 at most", _AGAIN)
    return head


def _unzipped(path: Path, data: bytes) -> tuple[_Head, list[np.ndarray], bytes]:
    """What a file of version 1 to 3 says, its columns of bytes, and the records behind them."""
    stream = zlib.decompressobj(wbits=31)
    text = stream.decompress(data, 16)
    head = _head(path, text)
    if head.version > 3:
        raise InputError(path, f"it is of version {head.version} in gzip", "version 1 to 3", _AGAIN)
    size = head.count * sum(head.widths)
    if size > _MOST_DEFLATED * len(data):
        raise EOFError
    body = stream.decompress(stream.unconsumed_tail, size) if size else b""
    if len(body) < size:
        raise EOFError
    records = stream.decompress(stream.unconsumed_tail, _MOST_RECORDS) if head.flags & _RECORDS else b""
    if not stream.eof and not records:  # to the end, where the checksum stands
        stream.decompress(stream.unconsumed_tail, _MOST_RECORDS)
    if not stream.eof:
        raise EOFError
    ends = np.cumsum([0, *(head.count * width for width in head.widths)])
    table = np.frombuffer(body, np.uint8)
    columns = [table[start:end] for start, end in itertools.pairwise(ends)]
    return head, [column.reshape(head.count, -1) if head.count else column for column in columns], records


def _streams(path: Path, data: bytes) -> tuple[_Head, list[np.ndarray], bytes]:
    """As `_unzipped`, of a file of version 4."""
    head = _head(path, data)
    if head.version != 4:
        raise InputError(path, f"it is of version {head.version} and not in gzip", "gzip or version 4", _AGAIN)
    try:
        import zstandard
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the scene as .ply)."
        raise InputError(path, "a .spz of version 4 needs the package zstandard", "it installed", remedy) from error
    count, table = struct.unpack_from("<BI", data, 15)
    sizes = [head.count * width for width in head.widths]
    if count != sum(size > 0 for size in sizes) or table < 32:
        raise EOFError
    start, columns = table + 16 * count, []
    for index, size in enumerate(sizes):
        if not size:
            columns.append(np.zeros((head.count, 0), np.uint8))
            continue
        packed, announced = struct.unpack_from("<QQ", data, table + 16 * index)
        if announced != size or start + packed > len(data):
            raise EOFError
        try:
            body = _inflated(zstandard.ZstdDecompressor().stream_reader(data[start : start + packed]), size)
        except zstandard.ZstdError as error:
            raise EOFError from error
        columns.append(np.frombuffer(body, np.uint8).reshape(head.count, -1))
        start += packed
    return head, columns, data[32:table] if head.flags & _RECORDS else b""


def _inflated(stream: Any, size: int) -> bytes:
    """All of a stream, which must hold `size` bytes: room is made as they come."""
    parts, left = [], size
    while left > 0 and (part := stream.read(min(left, 1 << 20))):
        parts.append(part)
        left -= len(part)
    if left or stream.read(1):
        raise EOFError
    return b"".join(parts)


def _recorded(path: Path, records: bytes) -> tuple[np.ndarray, tuple[str, ...]]:
    """(4, 4) from the axes that a file's records name to a .ply's, and what they say that is not known."""
    axes, notes, at = AXES, (), 0
    while at + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, at)
        body, at = records[at + 8 : at + 8 + length], at + 8 + length
        if len(body) < length:
            raise EOFError
        if kind == _COORDINATES:
            axes = _axes(path, int.from_bytes(body[:4], "little"))
        elif kind != _ORBIT:
            notes = (*notes, f"{path.name} has a record {kind:#010x} that jsecon does not know and passes over.")
    return axes, notes


def _axes(path: Path, number: int) -> np.ndarray:
    """(4, 4) from a coordinate system of the format to a .ply's x right, y down, z forward."""
    if number == 0:  # unspecified, which the format's makers read as their own axes
        return AXES
    if number > len(_SYSTEMS):
        remedy = "Export the scene again, in Niantic's own axes (RUB)."
        raise InputError(path, f"its coordinate system has the unknown number {number}", "1 to 16", remedy)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([_TOWARDS[letter] for letter in _SYSTEMS[number - 1]]).T
    return matrix


def _unpacked(head: _Head, columns: list[np.ndarray]) -> dict[str, np.ndarray]:
    """The fields of `Gaussians` in the file's axes, float32."""
    places, alpha, colours, sizes, turns, rest = columns
    count = head.count
    if head.version == 1:
        means = places.reshape(-1).view("<f2").astype(np.float32).reshape(count, 3)
    else:
        fixed = np.zeros((count, 3, 4), np.uint8)
        fixed[..., 1:] = places.reshape(count, 3, 3)
        means = np.ldexp((fixed.reshape(count, 12).view("<i4") >> 8).astype(np.float32), -head.bits)
    opacity = np.clip(alpha.reshape(-1) / 255.0, _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    constant = (colours.reshape(count, 1, 3) / 255.0 - 0.5) / _COLOUR
    others = (rest.reshape(count, (head.degree + 1) ** 2 - 1, 3) - 128.0) / 128
    arrays = {
        "means": means,
        "log_scales": sizes.reshape(count, 3) / _SIZE_STEPS + _LEAST_SIZE,
        "quaternions": np.roll(_turns_of(turns, count), 1, axis=1),
        "opacity_logits": np.log(opacity / (1 - opacity)),
        "sh": np.concatenate([constant, others], axis=1),
    }
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}


def _turns_of(packed: np.ndarray, count: int) -> np.ndarray:
    """(N, 4) unit xyzw out of three bytes, of version 1 and 2, or of four: see `_turns`."""
    if packed.size == 3 * count:
        first = packed.reshape(count, 3) / 127.5 - 1
        return np.concatenate([first, np.sqrt(np.maximum(1 - (first**2).sum(1, keepdims=True), 0))], axis=1)
    word = packed.reshape(count, 4).copy().view("<u4")[:, 0]
    parts = np.stack([word >> 20, word >> 10, word], axis=1) & 1023
    others = (parts & 511) / 511 * math.sqrt(0.5) * np.where(parts >> 9, -1, 1)
    largest = (word >> 30).astype(np.int64)
    xyzw = np.empty((count, 4))
    np.put_along_axis(xyzw, _others(largest), others, axis=1)
    np.put_along_axis(xyzw, largest[:, None], np.sqrt(np.maximum(1 - (others**2).sum(1, keepdims=True), 0)), axis=1)
    return xyzw


def _others(largest: np.ndarray) -> np.ndarray:
    """(N, 3) the indices 0 to 3 without the largest component's."""
    return (np.arange(4) + (np.arange(4) >= largest[:, None]))[:, :3]
