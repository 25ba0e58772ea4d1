"""Gaussians read from files of any known format, which the suffix of a file names, on the host.

`READERS` is the table of formats. A reader takes the file, and returns Gaussians (NumPy) in the world of the .ply that
they were made from, and notes. Other packages add readers by entry points in the group jsecon.splats.

gsply (extra formats) decodes .spz, .sog and SuperSplat's compressed .ply. What it passes over is done here: it ignores
the axes that a .spz names and the flag of antialiasing, misreads version 1 of .spz, and reads a .ply and the codebooks
of a .sog without a check of their sizes. It returns linear positions, log scales, quaternions wxyz and logits of
opacities.
"""

import dataclasses
import functools
import gzip
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.errors import InputError
from jsecon.files import parse_json, reading
from jsecon.read.registry import SCENES, Reader, decoding, readers
from jsecon.read.splats.ply import read_ply, read_ply_file, require_drawable
from jsecon.read.splats.point_clouds import READERS as POINTS, gaussians_of_cloud
from jsecon.splat.project import unusable_rows
from jsecon.splat.sh import C0
from jsecon.splat.transform import float32_rounding, transform_gaussians
from jsecon.types import Gaussians

_FORMATS = f"Gaussians or points as {', '.join(SCENES[:-1])} or {SCENES[-1]}"
MAX_READ_ROUNDING = 0.25
"""Rounding of a Gaussian's centre by float32, relative to its largest standard deviation, above which a file is not
read."""


def _gaussians(*columns: np.ndarray) -> Gaussians:
    """Makes Gaussians of arrays, in the order of their fields."""
    return Gaussians(*(np.require(column, np.float32, "C") for column in columns))


def _from_gsply(data: Any) -> Gaussians:
    """Makes Gaussians of gsply's arrays."""
    rest = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
    if rest.shape[1] not in (0, 3, 8, 15):
        raise ValueError(f"{rest.shape[1]} harmonics above the constant")
    sh = np.concatenate([np.asarray(data.sh0)[:, None], rest], axis=1)
    return _gaussians(data.means, data.scales, data.quats, np.reshape(data.opacities, -1), sh)


def _without_unusable(path: Path, gaussians: Gaussians) -> tuple[Gaussians, tuple[str, ...]]:
    """Leaves out Gaussians that cannot be drawn, as viewers do, and counts them in a note.

    A file in which more than a tenth cannot be drawn is refused: it is damaged.
    """
    wrong = functools.reduce(np.logical_or, (unusable_rows(name, rows) for name, rows in vars(gaussians).items()))
    if not wrong.any():
        return gaussians, ()
    if wrong.mean() > 0.1:
        require_drawable(
            path, gaussians, 0, "Remove these Gaussians (SuperSplat drops them on loading), or train again."
        )
    note = f"{wrong.sum()} of {len(wrong)} Gaussians of {path.name} cannot be drawn, and are left out."
    return jax.tree.map(lambda rows: rows[~wrong], gaussians), (note,)


def _antialiasing_notes(path: Path, is_antialiased: bool) -> tuple[str, ...]:
    """Notes that a file was trained with antialiasing, if it was."""
    note = f"{path.name} was trained with antialiasing (Mip-Splatting), and is drawn without it."
    return (note,) if is_antialiased else ()


def _read_spz(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Niantic's .spz (github.com/nianticlabs/spz) of version 2 to 4.

    Versions 2 and 3 are one gzip stream, with records behind the numbers; version 4 has them behind the header.
    """
    with decoding(path, "gsply") as gsply:
        gaussians, data = _from_gsply(gsply.read_spz(path)), path.read_bytes()
        is_gzip = data.startswith(b"\x1f\x8b")
        body = gzip.decompress(data) if is_gzip else data
        version, count, degree, _, flags = struct.unpack("<4xIIBBB", body[:15])
        if version == 1:
            raise ValueError("it is of version 1, expected a .spz of version 2 to 4")
        if is_gzip:
            row = 16 + (4 if version > 2 else 3) + 3 * ((degree + 1) ** 2 - 1)
            records = body[16 + count * row :]
        else:
            records = data[32 : int.from_bytes(data[16:20], "little")]
        axes = _spz_axes(records if flags & 2 else b"")
        if np.linalg.det(axes) < 0:
            problem = "it is stored in left-handed axes, in which the scene stands mirrored"
            raise InputError(path, problem, remedy="Export it with right-handed axes, such as RUB.")
        gaussians = transform_gaussians(gaussians, axes)
    gaussians = dataclasses.replace(gaussians, means=gaussians.means.astype(np.float32))
    return gaussians, _antialiasing_notes(path, bool(flags & 1))


def _spz_axes(records: bytes) -> np.ndarray:
    """(4, 4) from the axes that the records of a .spz name to those of a .ply; by default from its makers' (RUB)."""
    axes, offset = np.diag([1.0, -1.0, -1.0, 1.0]), 0
    while offset + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, offset)
        if offset + 8 + length > len(records):
            raise EOFError
        number = int.from_bytes(records[offset + 8 : offset + 12], "little")
        if kind == 0xADBE0003 and number > 8:
            raise ValueError(f"its coordinate system has the unknown number {number}, expected 1 to 8")
        if kind == 0xADBE0003 and number > 0:  # 0: unspecified
            # LDB, RDB, LUB, RUB, LDF, ...: x points left or right, y down or up, z back or forward.
            bits = number - 1
            axes = np.diag([1.0 if bits & 1 else -1.0, -1.0 if bits & 2 else 1.0, 1.0 if bits & 4 else -1.0, 1.0])
        offset += 8 + length
    return axes


def _read_compressed_ply(path: Path, header: Any) -> Gaussians:
    """Reads SuperSplat's compressed .ply (github.com/playcanvas/splat-transform, decompress-ply.ts)."""
    with decoding(path, "gsply") as gsply:
        chunk, vertex, *rest = header.elements
        bounds = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
        fields = [
            [(f"{end}_{name}", "f4") for names in bounds for end in ("min", "max") for name in names],
            [(f"packed_{name}", "u4") for name in ("position", "rotation", "scale", "color")],
            *([(f"f_rest_{n}", "u1") for n in range(len(harmonics.fields))] for harmonics in rest[:1]),
        ]
        if header.form != "binary_little_endian" or [element.fields for element in header.elements] != fields:
            raise ValueError("its elements are not those of SuperSplat 2's compressed .ply")
        size = sum(element.count * element.dtype("<").itemsize for element in header.elements)
        if path.stat().st_size < header.start + size or chunk.count * 256 < vertex.count:  # 256 share their bounds
            raise EOFError
        if rest and rest[0].count != vertex.count:
            raise ValueError(f"it has {rest[0].count} rows of harmonics for {vertex.count} Gaussians")
        return _from_gsply(gsply.plyread(path))


def _read_sog(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads PlayCanvas' .sog, images in a zip."""
    with decoding(path, "gsply") as gsply:
        with zipfile.ZipFile(path) as archive:
            meta = parse_json(archive.read("meta.json"))
            books = [part["codebook"] for part in meta.values() if isinstance(part, dict) and "codebook" in part]
            if any(len(book) < 256 for book in books):  # gsply indexes them without a check of their size
                raise ValueError("a codebook of fewer than 256 numbers")
        gaussians = _from_gsply(gsply.sogread(path.read_bytes()))
        return gaussians, _antialiasing_notes(path, meta.get("antialias") is True)


def _read_splat(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads antimatter15's .splat: 32 bytes a Gaussian, degree 0, without a header."""
    data = path.read_bytes()
    row = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    if len(data) % row.itemsize:
        raise ValueError(f"it has {len(data)} bytes, which is not a multiple of {row.itemsize}, the size of a Gaussian")
    rows = np.frombuffer(data, row)
    half_step = 0.5 / 255
    opacity = np.clip(rows["rgba"][:, 3] / 255, half_step, 1 - half_step)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])  # a size of 0 is that of a flat Gaussian
    turns, sh = (rows["rotation"].astype(np.float32) - 128) / 128, (rows["rgba"][:, None, :3] / 255.0 - 0.5) / C0
    return _gaussians(rows["means"], log_scales, turns, np.log(opacity / (1 - opacity)), sh), ()


def _read_ply(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .ply, compressed or not."""
    header = read_ply_file(path)[1]
    names = {name for element in header.elements for name, _ in element.fields}
    if "packed_position" in names:
        return _read_compressed_ply(path, header), ()
    if any(name.startswith(("f_dc_", "scale_", "rot_", "opacity")) for name in names):
        return read_ply(path), ()
    return gaussians_of_cloud(path)


READERS = (
    Reader("PLY", (".ply",), _read_ply),
    Reader("SPZ", (".spz",), _read_spz),
    Reader("SOG", (".sog",), _read_sog),
    Reader("splat", (".splat",), _read_splat),
    *(Reader(name, marks, gaussians_of_cloud) for name, marks, _ in POINTS),
)


def load_gaussians(path: str | Path) -> Gaussians:
    """Reads Gaussians from a .ply (INRIA's layout, or SuperSplat's compressed one), .spz, .sog or .splat.

    Points of a .las, .laz, .e57, .pcd, .xyz, .txt or .ply become round, opaque Gaussians, at most 200,000.
    All come in the world of the .ply that they were made from: a .spz has y up by its makers' definition, and
    is turned back, (x, -y, -z). Warns (UserWarning) if a file was trained with antialiasing, which is
    not done.

    Args:
      path: The file; its suffix, in small or capital letters, names the format.

    Returns:
      Its Gaussians, float32; N may be 0.

    Raises:
      InputError: The file is of another format, damaged, or holds numbers that cannot be drawn; float32 does not hold
        its positions; or gsply is missing (for .spz, .sog and a compressed .ply).
    """
    gaussians, notes = read_gaussians(path)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    rounding = float32_rounding(gaussians)
    if len(rounding) and np.median(rounding) > MAX_READ_ROUNDING:
        place = ", ".join(f"{number:.10g}" for number in np.median(gaussians.means, axis=0))
        problem = f"the Gaussians lie about ({place}), where float32 does not tell them apart"
        remedy = "Move the scene near 0, or give its file to jsecon run, which does."
        raise InputError(path, problem, remedy=remedy)
    return jax.tree.map(jnp.asarray, gaussians)


def read_gaussians(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Gaussians as `load_gaussians` does, but as NumPy arrays, and returns notes in place of warnings.

    The means are float64 if the file has them finer than float32.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "there is no such file", _FORMATS, "Check the path.")
    reader = next((reader for reader in readers("jsecon.splats", READERS) if reader.fits(path)), None)
    if reader is None:
        convert = f"npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        remedy = f"Export the scene as a .ply; a .ksplat, .lcc or unpacked .sog by: {convert}"
        with reading(path):  # a pointer of Git LFS may stand there
            raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", _FORMATS, remedy)
    with reading(path, remedy="Export it again, or as a .ply."):
        gaussians, notes = reader.read(path)
        gaussians, left_out = _without_unusable(path, gaussians)
        return gaussians, (*notes, *left_out)
