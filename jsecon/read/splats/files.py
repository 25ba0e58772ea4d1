"""Gaussians read from and written to files of any known format, which the suffix of a file names, on the host.

.ply (INRIA's layout) and .glb have modules of their own; the compressed formats are here. .spz
(github.com/nianticlabs/spz) is read in every version and written as version 3. It has a header and six columns, in one
gzip stream (versions 1 to 3) or a zstd stream each (version 4); x right, y up, z back, unless a record says otherwise.
The package gsply is not used for it: it misreads version 1, ignores the record of the axes and the flag of
antialiasing, and writes only from arrays in memory.

SuperSplat's compressed .ply (github.com/playcanvas/splat-transform, decompress-ply.ts) has chunks of 256 Gaussians that
share the bounds of positions, sizes and colours. .sog is read by gsply (extra formats), .splat is antimatter15's.
"""

import contextlib
import dataclasses
import gzip
import importlib.util
import itertools
import math
import shutil
import struct
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, describe_error
from jsecon.files import atomic_write, parse_json, reading
from jsecon.read.splats.gltf import read_glb, save_glb
from jsecon.read.splats.ply import (
    drawable_gaussians,
    in_float32,
    read_elements,
    read_ply,
    read_ply_file,
    save_ply,
    usable_blocks,
)
from jsecon.splat.project import check_gaussians
from jsecon.splat.sh import C0
from jsecon.splat.transform import transform_axes
from jsecon.types import Array, Gaussians

WRITTEN = (".ply", ".spz", ".glb")
"""suffixes of files that can be written"""
_FORMATS = "Gaussians as .ply (INRIA's or SuperSplat's compressed), .glb, .spz, .sog or .splat"
_CONVERTIBLE = (".ksplat", ".lcc", ".mjs")
"""suffixes that splat-transform reads, besides meta.json of an unpacked .sog"""
SPZ_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""from a .ply's x right, y down, z forward to .spz's x right, y up, z back; and back again"""
_MAX_FIXED = (1 << 23) - 1
"""largest fixed-point number of a coordinate"""
_BITS, _BITS_OF_SMALL = 16, 24
"""most bits of a coordinate after the point: of scenes that reach farther than 1 unit, and of others"""
_STEPS_PER_LOG, _MIN_LOG_SCALE = 16, -10.0
"""steps per unit of a log scale, and the least log scale; the largest is 255 steps above it"""
_MAX_TOO_SMALL = 0.01
"""share of the Gaussians that may be smaller than the least size"""
_COLOUR_SCALE = 0.15
"""colour, in 0..1, per coefficient of degree 0"""
_MIN_OPACITY = 1e-6
"""opacity of byte 0, and distance of that of byte 255 from 1"""
_GZIP_LEVEL = 6
_MAX_DEFLATE_RATIO = 1032
"""bytes that one byte of a deflated stream can stand for"""
_ANTIALIASED_FLAG, _RECORDS_FLAG = 1, 2
_ORBIT_RECORD, _AXES_RECORD = 0xADBE0002, 0xADBE0003
"""kinds of records: limits of a viewer's camera, and the axes of the numbers"""
_MAX_RECORDS = 1 << 20
"""bytes of records that are read"""
_SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""axes 1 to 16: where x, y and z point to, left or right, up or down, forward or back"""
_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
"""a direction in the axes of a .ply"""
_AGAIN = "Export it again, or as a .ply."
_CHUNK = 256
"""Gaussians of a compressed .ply that share bounds"""
_BOUNDS = [f"{end}_{kind}" for end in ("min", "max") for kind in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
_COLOUR_BOUNDS = [f"{end}_{kind}" for end in ("min", "max") for kind in "rgb"]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_PLY_REMEDY = "Export it again, or as an uncompressed .ply."
_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""a Gaussian of antimatter15's .splat"""


def load_gaussians(path: str | Path, *, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Reads Gaussians from a .ply (INRIA's layout, or SuperSplat's compressed one), .glb, .spz, .sog or .splat.

    All come in the world of the .ply that they were made from: .spz and .glb have y up by their makers' definition, and
    are turned back, (x, -y, -z) and (-x, -y, z). Warns (UserWarning) if a file was trained with antialiasing, which is
    not done.

    Args:
      path: The file; its suffix, in small or capital letters, names the format.
      similarity: (4, 4) float64. Carries the Gaussians into another world before they become float32. The inverse of
        `Capture.source_from_scene` carries them from the world of a capture's files into that of its cameras, and keeps
        the digits of a map projection's coordinates.

    Returns:
      Its Gaussians, float32; N may be 0.

    Raises:
      InputError: The file is of another format, damaged, or holds numbers that cannot be drawn; float32 does not hold
        its positions; or a package is missing (gsply for .sog, zstandard for .spz of version 4).
    """
    gaussians, notes = read_gaussians(path)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return in_float32(Path(path), gaussians, similarity)


def read_gaussians(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Gaussians as `load_gaussians` does, as NumPy arrays.

    Args:
      path: The file.

    Returns:
      Its Gaussians, whose means are float64 if the file has them finer than float32; and notes, which `load_gaussians`
      gives as warnings.

    Raises:
      InputError: As in `load_gaussians`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        remedy = "Export the scene as a .ply."
        if suffix in _CONVERTIBLE or path.name == "meta.json":
            remedy = f"Run: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        elif suffix == ".gltf":
            remedy = "Export it as one .glb file, or as a .ply."
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", _FORMATS, remedy)
    if not path.is_file():
        problem = "it is a folder" if path.is_dir() else "No such file or directory"
        raise InputError(path, problem, _FORMATS, "Check the path.")
    return _READERS[suffix](path)


def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    codes: Float[Array, "n d"] | None = None,
    regions: Int[Array, " n"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians as a .ply (INRIA's layout, exact), a .spz (version 3) or a .glb.

    Written in blocks: memory-mapped arrays need not fit into memory. A .spz holds positions in 24 bits: to 2^-16 units
    or, in scenes beyond 128 units, to 2^-22 of the farthest coordinate; those within 1 unit to 2^-22 of it, or 2^-24.
    It holds sizes to 3 % and from exp(-10) to exp(5.9) units, opacities and colours in 8 bits, rotations in 32.

    Args:
      path: The file; its suffix names the format.
      gaussians: N Gaussians.
      codes: (N, D) codes, written to a .glb only.
      regions: (N,) region ids, -1 for no region, written to a .glb only.
      similarity: (4, 4) transform into the world of the file.

    Raises:
      ValueError: Shapes disagree.
      InputError: The format cannot be written, a Gaussian cannot be drawn, or the folder cannot be written. Of a .spz:
        one lies farther than 4,194,303 units from the origin, or most are smaller than the rounding of their positions;
        one is larger than exp(5.9) units, or more than 1 % are smaller than exp(-10).
    """
    path = Path(path)
    require_writable_format(path)
    suffix = path.suffix.lower()
    if suffix == ".glb":
        save_glb(path, gaussians, codes=codes, regions=regions, similarity=similarity)
    elif suffix == ".spz":
        _save_spz(path, gaussians, similarity=similarity)
    else:
        save_ply(path, gaussians, similarity=similarity)


def require_writable_format(path: Path) -> None:
    """Checks that `save_gaussians` can write a file.

    Args:
      path: The file, which need not exist.

    Raises:
      InputError: Its suffix is not one of WRITTEN.
    """
    if path.suffix.lower() not in WRITTEN:
        remedy = f"For example: {path.stem}.ply; npx @playcanvas/splat-transform makes other formats of it."
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", " or ".join(WRITTEN), remedy)


def _gaussians(path: Path, **arrays: np.ndarray) -> Gaussians:
    """Makes Gaussians of decoded arrays, in float32."""
    return drawable_gaussians(path, {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()})


def _logits(opacity: np.ndarray, least: float = _MIN_OPACITY) -> np.ndarray:
    """Logits of opacities, which are clipped to finite ones."""
    clipped = np.clip(opacity, least, 1 - least)
    return np.log(clipped / (1 - clipped))


def _with_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions of the index of the largest component (N,) and the three others (N, 3)."""
    quaternions = np.empty((len(largest), 4))
    rest = np.sqrt(np.maximum(1 - (others**2).sum(1, keepdims=True), 0))
    np.put_along_axis(quaternions, _other_indices(largest), others, axis=1)
    np.put_along_axis(quaternions, largest[:, None], rest, axis=1)
    return quaternions


def _other_indices(largest: np.ndarray) -> np.ndarray:
    """(N, 3) the indices 0 to 3 without the largest component's."""
    return (np.arange(4) + (np.arange(4) >= largest[:, None]))[:, :3]


def _antialiasing_note(path: Path) -> tuple[str, ...]:
    """The note on a file that was trained with antialiasing."""
    return (f"{path.name} was trained with antialiasing (Mip-Splatting), and is drawn without it.",)


def _save_spz(path: str | Path, gaussians: Gaussians, *, similarity: Float[Array, "4 4"] | None = None) -> None:
    """Writes a .spz in blocks. Packed columns lie beside the file until it is complete, 20 to 65 bytes a Gaussian."""
    into = SPZ_AXES if similarity is None else SPZ_AXES @ np.asarray(similarity, np.float64)
    bits = _fraction_bits(path, gaussians, into)
    if gaussians.count >= 1 << 32:
        raise InputError(path, f"{gaussians.count} Gaussians", "fewer than 2^32 in a .spz", "Write a .ply.")
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, gaussians.count, degree, bits, 0, 0)
    with atomic_write(path) as temporary, contextlib.ExitStack() as stack:
        columns = [stack.enter_context(tempfile.TemporaryFile(dir=temporary.parent)) for _ in range(6)]
        for _, block in usable_blocks(path, gaussians, into):
            for column, data in zip(columns, _pack(block, bits), strict=True):
                column.write(data)
        raw = stack.enter_context(open(temporary, "wb"))
        # Without a name or a time: equal scenes give equal bytes.
        with gzip.GzipFile("", "wb", _GZIP_LEVEL, raw, mtime=0) as file:
            file.write(header)
            for column in columns:
                column.seek(0)
                shutil.copyfileobj(column, file, 1 << 20)


def _fraction_bits(path: str | Path, gaussians: Gaussians, into: np.ndarray) -> int:
    """Bits after the point with which the farthest Gaussian fits into 24; checks that sizes fit."""
    check_gaussians(gaussians)
    bare = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    reach, small, largest = 0.0, 0, -np.inf
    for _, block in usable_blocks(path, bare, into):
        sizes = np.asarray(block.log_scales, np.float64).max(axis=1)
        reach = max(reach, float(np.abs(block.means).max()))
        largest = max(largest, float(sizes.max()))
        small += int((sizes < _MIN_LOG_SCALE - 0.5 / _STEPS_PER_LOG).sum())
    bits = _BITS if reach > 1 else _BITS_OF_SMALL
    while bits > 0 and reach * 2.0**bits > _MAX_FIXED:
        bits -= 1
    if bits < 1:  # the format allows 0, but not all of its readers do
        remedy = "Write a .ply, or bring the scene nearer to its origin."
        raise InputError(path, f"a Gaussian lies {reach:,.0f} units from the origin", "at most 4,194,303", remedy)
    step, coarse = 2.0**-bits, 0
    if bits < _BITS:
        for _, block in usable_blocks(path, bare, into):
            coarse += int((np.exp(np.asarray(block.log_scales, np.float64).max(axis=1)) < 2 * step).sum())
    if coarse > 0.5 * gaussians.count:
        problem = f"positions would be rounded to {step:.3g} units, which is coarser than most of the Gaussians"
        raise InputError(path, problem, remedy="Write a .ply or a .glb, or bring the scene nearer to its origin.")
    if largest > _MIN_LOG_SCALE + 255.5 / _STEPS_PER_LOG:
        problem = f"a Gaussian is {math.exp(min(largest, 700)):.3g} units large"
        raise InputError(path, problem, "at most 379 in a .spz", "Write a .ply, or scale the scene down.")
    if small > _MAX_TOO_SMALL * gaussians.count:
        problem = f"{small} of {gaussians.count} Gaussians are smaller than 4.5e-5 units, the least in a .spz"
        raise InputError(path, problem, remedy="Write a .ply, or scale the scene up.")
    return bits


def _pack(block: Gaussians, bits: int) -> list[bytes]:
    """The six columns of a block: positions, opacities, colours, sizes, rotations, harmonics."""
    means, sh = np.asarray(block.means, np.float64), np.asarray(block.sh, np.float64)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-np.asarray(block.opacity_logits, np.float64)))
    return [
        fixed.view(np.uint8).reshape(len(fixed), 3, 4)[:, :, :3].tobytes(),
        _pack_bytes(255 * opacity),
        _pack_bytes(255 * (_COLOUR_SCALE * sh[:, 0] + 0.5)),
        _pack_bytes(_STEPS_PER_LOG * (np.asarray(block.log_scales, np.float64) - _MIN_LOG_SCALE)),
        _pack_rotations(np.asarray(block.quaternions, np.float64)),
        _pack_bytes(128 * (sh[:, 1:] + 1)),
    ]


def _pack_bytes(values: np.ndarray) -> bytes:
    """Values rounded and clipped to bytes."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _pack_rotations(wxyz: np.ndarray) -> bytes:
    """Packs quaternions into words: the index of the largest component of xyzw in two bits, and the others in ten each.

    The others have the sign that makes the largest positive: a sign bit, and their size up to sqrt(1/2) in nine bits;
    the first stands highest.
    """
    xyzw = np.roll(wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True), -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    others = np.take_along_axis(xyzw, _other_indices(largest), axis=1)
    others = others * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    sizes = np.minimum(np.rint(511 * math.sqrt(2) * np.abs(others)), 511).astype(np.uint32)
    a, b, c = (sizes | (others < 0).astype(np.uint32) << 9).T
    return (largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c).astype("<u4").tobytes()


@dataclasses.dataclass(frozen=True)
class _SpzHeader:
    """The header of a .spz."""

    version: int
    count: int
    degree: int
    bits: int
    flags: int

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of a Gaussian in each column: positions, opacities, colours, sizes, rotations, harmonics."""
        return 6 if self.version == 1 else 9, 1, 3, 3, 3 if self.version < 3 else 4, 3 * ((self.degree + 1) ** 2 - 1)


def _load_spz(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .spz of version 1 to 4 (4 needs zstandard), degrees 0 to 3, from the axes that it names, else RUB."""
    with reading(path, remedy=_AGAIN, problem="the file is damaged or cut short"):
        data = path.read_bytes()
        header, columns, records = (_read_gzip if data[:2] == b"\x1f\x8b" else _read_zstd)(path, data)
        axes, notes = _parse_records(path, records)
    if header.flags & _ANTIALIASED_FLAG:
        notes = (*notes, *_antialiasing_note(path))
    return transform_axes(_unpack(path, header, columns), axes), notes


def _parse_spz_header(path: Path, data: bytes) -> _SpzHeader:
    """Parses and checks the header at the start of some bytes."""
    magic, *numbers = struct.unpack("<4sIIBBB", data[:15])
    header = _SpzHeader(*numbers)
    if magic != b"NGSP":
        raise InputError(path, "it does not begin as a .spz does", remedy=_AGAIN)
    if not 1 <= header.version <= 4:
        raise InputError(path, f"it is of version {header.version}", "a .spz of version 1 to 4", _AGAIN)
    if header.degree > 3:
        remedy = "Export it again with harmonics of degree 3 or less."
        raise InputError(path, f"its spherical harmonics are of degree {header.degree}", "a degree of 0 to 3", remedy)
    if header.bits > 30:
        raise InputError(path, f"its positions have {header.bits} bits after the point", "30 at most", _AGAIN)
    return header


def _read_gzip(path: Path, data: bytes) -> tuple[_SpzHeader, list[np.ndarray], bytes]:
    """Reads header, columns of bytes and records of version 1 to 3."""
    stream = zlib.decompressobj(wbits=31)
    header = _parse_spz_header(path, stream.decompress(data, 16))
    if header.version > 3:
        raise InputError(path, f"it is of version {header.version} in gzip", "version 1 to 3", _AGAIN)
    size = header.count * sum(header.widths)
    if size > _MAX_DEFLATE_RATIO * len(data):
        raise EOFError
    body = stream.decompress(stream.unconsumed_tail, size) if size else b""
    if len(body) < size:
        raise EOFError
    rest = stream.decompress(stream.unconsumed_tail, _MAX_RECORDS)  # also compares the checksum at the end
    if not stream.eof:
        raise EOFError
    ends = np.cumsum([0, *(header.count * width for width in header.widths)])
    table = np.frombuffer(body, np.uint8)
    columns = [table[start:end] for start, end in itertools.pairwise(ends)]
    return header, columns, rest if header.flags & _RECORDS_FLAG else b""


def _read_zstd(path: Path, data: bytes) -> tuple[_SpzHeader, list[np.ndarray], bytes]:
    """Reads header, columns of bytes and records of version 4."""
    header = _parse_spz_header(path, data)
    if header.version != 4:
        raise InputError(path, f"it is of version {header.version} and not in gzip", "gzip or version 4", _AGAIN)
    try:
        import zstandard
    except ImportError as error:
        remedy = "Run: pip install 'jsecon[formats]' (or export the scene as .ply)."
        raise InputError(path, "a .spz of version 4 needs the package zstandard", remedy=remedy) from error
    count, table = struct.unpack_from("<BI", data, 15)
    sizes = [header.count * width for width in header.widths]
    if count != sum(size > 0 for size in sizes) or table < 32:
        raise EOFError
    start, columns = table + 16 * count, []
    for index, size in enumerate(sizes):
        if not size:
            columns.append(np.zeros(0, np.uint8))
            continue
        packed, announced = struct.unpack_from("<QQ", data, table + 16 * index)
        if announced != size or start + packed > len(data):
            raise EOFError
        try:
            body = _inflate(zstandard.ZstdDecompressor().stream_reader(data[start : start + packed]), size)
        except zstandard.ZstdError as error:
            raise EOFError from error
        columns.append(np.frombuffer(body, np.uint8))
        start += packed
    return header, columns, data[32:table] if header.flags & _RECORDS_FLAG else b""


def _inflate(stream: Any, size: int) -> bytes:
    """Reads a stream of `size` bytes bit by bit: a false size must not fill the memory."""
    parts, left = [], size
    while left > 0 and (part := stream.read(min(left, 1 << 20))):
        parts.append(part)
        left -= len(part)
    if left or stream.read(1):
        raise EOFError
    return b"".join(parts)


def _parse_records(path: Path, records: bytes) -> tuple[np.ndarray, tuple[str, ...]]:
    """(4, 4) from the axes that the records name to those of a .ply, and notes on unknown records."""
    axes, notes, offset = SPZ_AXES, (), 0
    while offset + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, offset)
        body, offset = records[offset + 8 : offset + 8 + length], offset + 8 + length
        if len(body) < length:
            raise EOFError
        if kind == _AXES_RECORD:
            axes = _axes(path, int.from_bytes(body[:4], "little"))
        elif kind != _ORBIT_RECORD:
            notes = (*notes, f"{path.name} has a record {kind:#010x} that jsecon does not know and ignores.")
    return axes, notes


def _axes(path: Path, number: int) -> np.ndarray:
    """(4, 4) from a file's axes, by their number, to those of a .ply."""
    if number == 0:  # unspecified, which the format's makers read as their own axes
        return SPZ_AXES
    if number > len(_SYSTEMS):
        remedy = "Export the scene again, in Niantic's own axes (RUB)."
        raise InputError(path, f"its coordinate system has the unknown number {number}", "1 to 16", remedy)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([_DIRECTIONS[letter] for letter in _SYSTEMS[number - 1]]).T
    return matrix


def _unpack(path: Path, header: _SpzHeader, columns: list[np.ndarray]) -> Gaussians:
    """Decodes the columns of a .spz, in the file's axes."""
    count = header.count
    positions, alpha, colours, sizes, rotations, rest = (
        column.reshape(count, width) for column, width in zip(columns, header.widths)
    )
    if header.version == 1:
        means = positions.reshape(-1).view("<f2").astype(np.float32).reshape(count, 3)
    else:
        fixed = np.zeros((count, 3, 4), np.uint8)
        fixed[..., 1:] = positions.reshape(count, 3, 3)
        means = np.ldexp((fixed.reshape(count, 12).view("<i4") >> 8).astype(np.float32), -header.bits)
    if header.version < 3:
        first = rotations / 127.5 - 1
        xyzw = np.concatenate([first, np.sqrt(np.maximum(1 - (first**2).sum(1, keepdims=True), 0))], axis=1)
    else:
        words = rotations.reshape(count, 4).copy().view("<u4")[:, 0]
        parts = np.stack([words >> 20, words >> 10, words], axis=1) & 1023
        others = (parts & 511) / 511 * math.sqrt(0.5) * np.where(parts >> 9, -1, 1)
        xyzw = _with_largest((words >> 30).astype(np.int64), others)
    constant = (colours.reshape(count, 1, 3) / 255.0 - 0.5) / _COLOUR_SCALE
    others = (rest.reshape(count, (header.degree + 1) ** 2 - 1, 3) - 128.0) / 128
    return _gaussians(
        path,
        means=means,
        log_scales=sizes / _STEPS_PER_LOG + _MIN_LOG_SCALE,
        quaternions=np.roll(xyzw, 1, axis=1),
        opacity_logits=_logits(alpha[:, 0] / 255.0),
        sh=np.concatenate([constant, others], axis=1),
    )


def _load_compressed_ply(path: Path) -> Gaussians:
    """Reads SuperSplat's compressed .ply."""
    tables = read_elements(path)
    empty = np.zeros(0, [])
    chunks, vertices, rest = (tables.get(name, empty) for name in ("chunk", "vertex", "sh"))
    bounds, packed = chunks.dtype.names or (), vertices.dtype.names or ()
    has_colours = any(name in bounds for name in _COLOUR_BOUNDS)  # SuperSplat 1 writes no bounds of colours: 0 to 1
    missing = [name for name in (*_BOUNDS, *(_COLOUR_BOUNDS if has_colours else ())) if name not in bounds]
    missing += [name for name in _PACKED if name not in packed]
    if missing:
        raise InputError(path, f"it has no properties {', '.join(missing)}", remedy=_PLY_REMEDY)
    for name in _PACKED:
        kind = vertices.dtype[name]
        if kind.kind not in "iu" or kind.itemsize != 4:
            raise InputError(path, f"{name} is of type {kind.name}", "uint", _PLY_REMEDY)
    count = len(vertices)
    if len(chunks) * _CHUNK < count:
        problem = f"it has {len(chunks)} chunks for {count} Gaussians"
        raise InputError(path, problem, f"a chunk for each {_CHUNK}", _PLY_REMEDY)
    position, rotation, scale, colour = (vertices[name].astype(np.uint32) for name in _PACKED)

    def between(kinds: str | tuple[str, ...], share: np.ndarray) -> np.ndarray:
        """(N, 3) numbers at a share of the way between the bounds of their chunks."""
        low, high = (np.stack([chunks[f"{end}_{kind}"] for kind in kinds], axis=1) for end in ("min", "max"))
        low, high = (np.repeat(a.astype(np.float64), _CHUNK, axis=0)[:count] for a in (low, high))
        return low * (1 - share) + high * share

    with np.errstate(invalid="ignore", over="ignore"):  # refused below, if not finite
        rgba = _bit_fields(colour, (24, 8), (16, 8), (8, 8), (0, 8))
        rgb = between("rgb", rgba[:, :3]) if has_colours else rgba[:, :3]
        others = (_bit_fields(rotation, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2)
        scale_names = ("scale_x", "scale_y", "scale_z")
        return _gaussians(
            path,
            means=between("xyz", _bit_fields(position, (21, 11), (11, 10), (0, 11))),
            log_scales=between(scale_names, _bit_fields(scale, (21, 11), (11, 10), (0, 11))),
            quaternions=_with_largest((rotation >> np.uint32(30)).astype(np.int64), others),
            opacity_logits=_logits(rgba[:, 3]),
            sh=np.concatenate([((rgb - 0.5) / C0)[:, None], _harmonics(path, rest, count)], axis=1),
        )


def _bit_fields(words: np.ndarray, *fields: tuple[int, int]) -> np.ndarray:
    """(N, F) in [0, 1]: fields of words (N,), by their first bit and their width in bits."""
    parts = [((words >> np.uint32(start)) & np.uint32(2**bits - 1)) / (2**bits - 1) for start, bits in fields]
    return np.stack(parts, axis=1)


def _harmonics(path: Path, rest: np.ndarray, count: int) -> np.ndarray:
    """(N, K - 1, 3) coefficients of the bytes of the element sh."""
    names = rest.dtype.names or ()
    if len(names) not in (0, 9, 24, 45) or any(f"f_rest_{index}" not in names for index in range(len(names))):
        problem = f"its element sh has {len(names)} properties"
        raise InputError(path, problem, "0, 9, 24 or 45 of them, from f_rest_0 on", _PLY_REMEDY)
    if not names:
        return np.zeros((count, 0, 3))
    if len(rest) != count:
        raise InputError(path, f"it has {len(rest)} rows of sh for {count} Gaussians", remedy=_PLY_REMEDY)
    numbers = np.stack([rest[f"f_rest_{index}"].astype(np.float64) for index in range(len(names))], axis=1)
    share = np.where(numbers <= 0, 0.0, np.where(numbers >= 255, 1.0, (numbers + 0.5) / 256))
    return ((share - 0.5) * 8).reshape(count, 3, len(names) // 3).transpose(0, 2, 1)


def _load_splat(path: Path) -> Gaussians:
    """Reads antimatter15's .splat: 32 bytes a Gaussian, degree 0, without a header."""
    data = path.read_bytes()
    if len(data) % _SPLAT.itemsize:
        problem = f"it has {len(data)} bytes, which is not a multiple of {_SPLAT.itemsize}, the size of a Gaussian"
        raise InputError(path, problem, remedy="The file is cut short or of another format: export it again.")
    rows = np.frombuffer(data, _SPLAT)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])  # a size of 0 is that of a flat Gaussian
    return _gaussians(
        path,
        means=rows["means"],
        log_scales=log_scales,
        quaternions=(rows["rotation"].astype(np.float32) - 128) / 128,
        opacity_logits=_logits(rows["rgba"][:, 3] / 255, 0.5 / 255),
        sh=((rows["rgba"][:, None, :3] / 255.0) - 0.5) / C0,
    )


def _load_sog(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads PlayCanvas' .sog, images in a zip, by gsply."""
    if importlib.util.find_spec("gsply") is None:
        remedy = "Run: pip install 'jsecon[formats]' (or use another format)."
        raise InputError(path, "a .sog needs the package gsply, which is not installed", remedy=remedy)
    import gsply

    try:
        # gsply indexes a codebook without a check of its size
        meta = parse_json(zipfile.ZipFile(path).read("meta.json"))
        if any(len(part.get("codebook", [0] * 256)) < 256 for part in meta.values() if isinstance(part, dict)):
            raise ValueError("a codebook of fewer than 256 numbers")
        with np.errstate(invalid="ignore", over="ignore"):
            read: Any = gsply.sogread
            data = read(path)
        rest = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
        if rest.shape[1] not in (0, 3, 8, 15):
            raise ValueError(f"{rest.shape[1]} harmonics above the constant")
    except Exception as error:  # whatever a decoder raises on damaged bytes
        remedy = f"Export it again, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
        raise InputError(path, f"gsply cannot read it ({describe_error(error)})", remedy=remedy) from error
    gaussians = _gaussians(
        path,
        means=data.means,
        log_scales=data.scales,
        quaternions=data.quats,
        opacity_logits=np.reshape(data.opacities, -1),
        sh=np.concatenate([np.asarray(data.sh0)[:, None], rest], axis=1),
    )
    return gaussians, _antialiasing_note(path) if meta.get("antialias") is True else ()


def _read_ply(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .ply, compressed or not."""
    header = read_ply_file(path)[1]
    notes = _antialiasing_note(path) if any(map(_names_antialiasing, header.comments)) else ()
    if header.is_compressed and header.form == "ascii":
        raise InputError(path, "its format is ascii", "a binary .ply", _PLY_REMEDY)
    return (_load_compressed_ply(path) if header.is_compressed else read_ply(path)), notes


def _names_antialiasing(comment: str) -> bool:
    """Whether a comment of a .ply marks a training with antialiasing, as Brush and Postshot write it."""
    return comment.lower().replace(":", " ").split() in (["splatrendermode", "mip"], ["antialiased", "1"])


_READERS: dict[str, Callable[[Path], tuple[Gaussians, tuple[str, ...]]]] = {
    ".ply": _read_ply,
    ".glb": lambda path: (read_glb(path), ()),
    ".spz": _load_spz,
    ".sog": _load_sog,
    ".splat": lambda path: (_load_splat(path), ()),
}
"""suffix -> reader of Gaussians and notes"""
