"""Gaussians of compressed files, on the host: .spz, .sog and SuperSplat's compressed .ply by gsply, and .splat.

gsply (extra formats) decodes the numbers. What it passes over is done here: it ignores the axes that a .spz names and
the flag of antialiasing, misreads version 1 of .spz, and reads a .ply and the codebooks of a .sog without a check of
their sizes. It returns linear positions, log scales, quaternions wxyz and logits of opacities.
"""

import contextlib
import gzip
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError, describe_error
from jsecon.files import atomic_write, parse_json
from jsecon.read.registry import Reader
from jsecon.read.splats.ply import Header, drawable_gaussians, usable_blocks
from jsecon.splat.sh import C0
from jsecon.splat.transform import transform_axes
from jsecon.types import Array, Gaussians

_AGAIN = "Export it again, or as an uncompressed .ply."
_SPZ_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""from a .ply's x right, y down, z forward to .spz's x right, y up, z back; and back again"""
_SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""axes 1 to 16: where x, y and z point to, left or right, up or down, forward or back"""
_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
"""a direction in the axes of a .ply"""
_CHUNK_SIZE = 256
"""Gaussians of a compressed .ply that share bounds"""
_CHUNK_FIELDS = [
    (f"{end}_{kind}", "f4")
    for kinds in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for kind in kinds
]
_VERTEX_FIELDS = [(f"packed_{name}", "u4") for name in ("position", "rotation", "scale", "color")]
_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""a Gaussian of antimatter15's .splat"""


def import_gsply(path: Path) -> Any:
    """Imports gsply, of the extra formats; `path` is the file that needs it."""
    try:
        import gsply
    except ImportError as error:
        problem = f"a {path.suffix.lower()} like this needs the package gsply, which is not installed"
        raise InputError(path, problem, remedy="Run: pip install 'jsecon[formats]' (or use a plain .ply).") from error
    return gsply


@contextlib.contextmanager
def _decoding(path: Path) -> Iterator[Any]:
    """Yields gsply; whatever it raises on damaged bytes becomes an InputError."""
    gsply = import_gsply(path)
    try:
        with np.errstate(invalid="ignore", over="ignore"):
            yield gsply
    except InputError:
        raise
    except Exception as error:
        problem = f"the file is damaged or cut short ({describe_error(error).replace(f': {path}', '')})"
        raise InputError(path, problem, remedy=_AGAIN) from error


def _gaussians(path: Path, data: Any) -> Gaussians:
    """Makes Gaussians of gsply's arrays."""
    rest = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
    if rest.shape[1] not in (0, 3, 8, 15):
        raise ValueError(f"{rest.shape[1]} harmonics above the constant")
    arrays = {
        "means": data.means,
        "log_scales": data.scales,
        "quaternions": data.quats,
        "opacity_logits": np.reshape(data.opacities, -1),
        "sh": np.concatenate([np.asarray(data.sh0)[:, None], rest], axis=1),
    }
    return drawable_gaussians(path, {name: np.ascontiguousarray(a, np.float32) for name, a in arrays.items()})


def antialiasing_note(path: Path) -> tuple[str, ...]:
    """Notes that a file was trained with antialiasing."""
    return (f"{path.name} was trained with antialiasing (Mip-Splatting), and is drawn without it.",)


def _read_spz(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Niantic's .spz (github.com/nianticlabs/spz) of version 2 to 4, from the axes that it names, else RUB.

    Versions 2 and 3 are one gzip stream, with records behind the numbers; version 4 has them behind the header.
    """
    with _decoding(path) as gsply:
        data = path.read_bytes()
        is_gzip = data.startswith(b"\x1f\x8b")
        body = gzip.decompress(data) if is_gzip else data
        magic, version, count, degree, _, flags = struct.unpack("<4sIIBBB", body[:15])
        if magic != b"NGSP":
            raise InputError(path, "it does not begin as a .spz does", remedy=_AGAIN)
        if not 2 <= version <= 4:
            raise InputError(path, f"it is of version {version}", "a .spz of version 2 to 4", _AGAIN)
        if count > 1000 * len(data):
            raise ValueError(f"it announces {count} Gaussians")
        if is_gzip:
            row = 16 + (4 if version > 2 else 3) + 3 * ((degree + 1) ** 2 - 1)
            records = body[16 + count * row :]
        else:
            records = data[32 : int.from_bytes(data[16:20], "little")]
        axes, notes = _parse_records(path, records if flags & 2 else b"")
        gaussians = _gaussians(path, gsply.read_spz(path))
    if flags & 1:
        notes = (*notes, *antialiasing_note(path))
    return transform_axes(gaussians, axes), notes


def _parse_records(path: Path, records: bytes) -> tuple[np.ndarray, tuple[str, ...]]:
    """(4, 4) from the axes that the records name to those of a .ply, and notes on unknown records."""
    axes, notes, offset = _SPZ_AXES, (), 0
    while offset + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, offset)
        body, offset = records[offset + 8 : offset + 8 + length], offset + 8 + length
        if len(body) < length:
            raise EOFError
        if kind == 0xADBE0003:
            axes = _axes(path, int.from_bytes(body[:4], "little"))
        elif kind != 0xADBE0002:  # that one limits a viewer's camera
            notes = (*notes, f"{path.name} has a record {kind:#010x} that jsecon does not know and ignores.")
    return axes, notes


def _axes(path: Path, number: int) -> np.ndarray:
    """(4, 4) from a file's axes, by their number, to those of a .ply."""
    if number == 0:  # unspecified, which the format's makers read as their own axes
        return _SPZ_AXES
    if number > len(_SYSTEMS):
        remedy = "Export the scene again, in Niantic's own axes (RUB)."
        raise InputError(path, f"its coordinate system has the unknown number {number}", "1 to 16", remedy)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([_DIRECTIONS[letter] for letter in _SYSTEMS[number - 1]]).T
    return matrix


def save_spz(path: Path, gaussians: Gaussians, *, similarity: Float[Array, "4 4"] | None = None) -> None:
    """Writes a .spz of version 3, with the finest positions that hold the farthest Gaussian in 24 bits."""
    gsply = import_gsply(path)
    if not gaussians.count:
        raise InputError(path, "there are no Gaussians to write", remedy="Write a .ply, which may be empty.")
    into = _SPZ_AXES if similarity is None else _SPZ_AXES @ np.asarray(similarity, np.float64)
    blocks = [block for _, block in usable_blocks(path, gaussians, into)]
    means, log_scales, quaternions, opacity_logits, sh = (
        np.concatenate([np.asarray(getattr(block, name)) for block in blocks])
        for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    )
    reach = float(np.abs(means).max(initial=0))
    largest = log_scales.max(axis=1)
    finest = 16 if reach > 1 else 24
    bits = next((n for n in range(finest, 0, -1) if reach * 2.0**n < 1 << 23), 0)
    if bits == 0 or (bits < finest and (np.exp(largest) < 2.0 ** (1 - bits)).mean() > 0.5):
        problem = f"positions up to {reach:,.0f} units from the origin would be rounded to {2.0**-bits:.3g} units"
        remedy = "Write a .ply or a .glb, or bring the scene nearer to its origin."
        raise InputError(path, problem, "a rounding below the size of most Gaussians", remedy)
    if (largest > 5.95).any() or (largest < -10.05).sum() > 0.01 * len(largest):
        problem = f"its Gaussians are up to {np.exp(largest.max()):.3g} units large, or many are tiny"
        remedy = "Write a .ply, or scale the scene."
        raise InputError(path, problem, "sizes from 4.5e-5 to 379 units in a .spz", remedy)
    columns = {"means": means, "scales": log_scales, "quats": quaternions, "opacities": opacity_logits, "sh0": sh[:, 0]}
    arrays = {name: np.ascontiguousarray(a, np.float32) for name, a in columns.items()}
    rest = np.ascontiguousarray(sh[:, 1:], np.float32) if sh.shape[1] > 1 else None
    with atomic_write(path) as temporary, np.errstate(over="ignore"):
        data = gsply.GSData.from_arrays(**arrays, shN=rest, format="ply")
        gsply.write_spz(temporary, data, version=3, fractional_bits=bits)


def read_compressed_ply(path: Path, header: Header) -> Gaussians:
    """Reads SuperSplat's compressed .ply (github.com/playcanvas/splat-transform, decompress-ply.ts)."""
    with _decoding(path) as gsply:
        chunk, vertex, *rest = header.elements
        sh_fields = [(f"f_rest_{n}", "u1") for n in range(len(rest[0].fields) if rest else 0)]
        fields = [_CHUNK_FIELDS, _VERTEX_FIELDS, *([sh_fields] if rest else [])]
        if header.form != "binary_little_endian" or [element.fields for element in header.elements] != fields:
            remedy = f"Run: npx @playcanvas/splat-transform {path.name} plain.ply"
            raise InputError(path, "its elements are not those of SuperSplat 2's compressed .ply", remedy=remedy)
        size = sum(element.count * element.dtype("<").itemsize for element in header.elements)
        if path.stat().st_size < header.start + size or chunk.count * _CHUNK_SIZE < vertex.count:
            raise EOFError
        if rest and rest[0].count != vertex.count:
            raise ValueError(f"it has {rest[0].count} rows of harmonics for {vertex.count} Gaussians")
        return _gaussians(path, gsply.plyread(path))


def _read_sog(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads PlayCanvas' .sog, images in a zip."""
    with _decoding(path) as gsply:
        with zipfile.ZipFile(path) as archive:
            meta = parse_json(archive.read("meta.json"))
        # gsply indexes a codebook without a check of its size
        if any(len(part.get("codebook", [0] * 256)) < 256 for part in meta.values() if isinstance(part, dict)):
            raise ValueError("a codebook of fewer than 256 numbers")
        return _gaussians(path, gsply.sogread(path)), antialiasing_note(path) if meta.get("antialias") is True else ()


def _read_splat(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads antimatter15's .splat: 32 bytes a Gaussian, degree 0, without a header."""
    data = path.read_bytes()
    if len(data) % _SPLAT.itemsize:
        problem = f"it has {len(data)} bytes, which is not a multiple of {_SPLAT.itemsize}, the size of a Gaussian"
        raise InputError(path, problem, remedy="The file is cut short or of another format: export it again.")
    rows = np.frombuffer(data, _SPLAT)
    half_step = 0.5 / 255
    opacity = np.clip(rows["rgba"][:, 3] / 255, half_step, 1 - half_step)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])  # a size of 0 is that of a flat Gaussian
    arrays = {
        "means": rows["means"],
        "log_scales": log_scales,
        "quaternions": (rows["rotation"].astype(np.float32) - 128) / 128,
        "opacity_logits": np.log(opacity / (1 - opacity)),
        "sh": (rows["rgba"][:, None, :3] / 255.0 - 0.5) / C0,
    }
    return drawable_gaussians(path, {name: np.ascontiguousarray(a, np.float32) for name, a in arrays.items()}), ()


READERS = (
    Reader("SPZ", (".spz",), _read_spz),
    Reader("SOG", (".sog",), _read_sog),
    Reader("splat", (".splat",), _read_splat),
)
