"""Gaussians read from and written to files of any known format, which the suffix of a file names, on the host.

`READERS` is the table of formats. A reader takes the file, and returns Gaussians (NumPy) in the world of the .ply that
they were made from, and notes. Other packages add readers by entry points in the group jsecon.splats.

gsply (extra formats) decodes .spz, .sog and SuperSplat's compressed .ply. What it passes over is done here: it ignores
the axes that a .spz names and the flag of antialiasing, misreads version 1 of .spz, and reads a .ply and the codebooks
of a .sog without a check of their sizes. It returns linear positions, log scales, quaternions wxyz and logits of
opacities.
"""

import dataclasses
import gzip
import struct
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, require_shape
from jsecon.files import parse_json, reading
from jsecon.read.registry import SCENES, Reader, decoding, readers
from jsecon.read.splats.ply import drawable_gaussians, read_ply, read_ply_file, save_ply
from jsecon.read.splats.points import READERS as POINTS, gaussians_of_cloud
from jsecon.read.splats.usd import save_usda
from jsecon.splat.project import check_gaussians, unusable_rows
from jsecon.splat.sh import C0
from jsecon.splat.transform import float32_rounding, transform_axes, transform_gaussians
from jsecon.types import Array, Gaussians

_FORMATS = f"Gaussians or points as {', '.join(SCENES[:-1])} or {SCENES[-1]}"
MAX_READ_ROUNDING = 0.25
"""Rounding of a Gaussian's centre by float32, relative to its largest standard deviation, above which a file is not
read."""
_SPZ_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""from a .ply's x right, y down, z forward to .spz's x right, y up, z back; and back again"""


def _usable_gaussians(path: Path, *columns: np.ndarray) -> tuple[Gaussians, tuple[str, ...]]:
    """Makes Gaussians of the arrays of a compressed file without those that cannot be drawn, as viewers do, and notes.

    A file in which more than a tenth cannot be drawn is refused: it is damaged.
    """
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    wrong = np.any([unusable_rows(name, np.asarray(column)) for name, column in zip(names, columns)], axis=0)
    if not wrong.any() or wrong.mean() > 0.1:
        return drawable_gaussians(path, *columns), ()
    note = (
        f"{wrong.sum()} of {len(wrong)} Gaussians of {path.name} have numbers that cannot be drawn, and are left out."
    )
    return drawable_gaussians(path, *(np.asarray(column)[~wrong] for column in columns)), (note,)


def _gaussians(path: Path, data: Any) -> tuple[Gaussians, tuple[str, ...]]:
    """Makes Gaussians of gsply's arrays, and notes."""
    rest = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
    if rest.shape[1] not in (0, 3, 8, 15):
        raise ValueError(f"{rest.shape[1]} harmonics above the constant")
    sh = np.concatenate([np.asarray(data.sh0)[:, None], rest], axis=1)
    return _usable_gaussians(path, data.means, data.scales, data.quats, np.reshape(data.opacities, -1), sh)


def _antialiasing_notes(path: Path, is_antialiased: bool) -> tuple[str, ...]:
    """Notes that a file was trained with antialiasing, if it was."""
    note = f"{path.name} was trained with antialiasing (Mip-Splatting), and is drawn without it."
    return (note,) if is_antialiased else ()


def _read_spz(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Niantic's .spz (github.com/nianticlabs/spz) of version 2 to 4.

    Versions 2 and 3 are one gzip stream, with records behind the numbers; version 4 has them behind the header.
    """
    with decoding(path, "gsply") as gsply:
        data = path.read_bytes()
        is_gzip = data.startswith(b"\x1f\x8b")
        body = gzip.decompress(data) if is_gzip else data
        magic, version, count, degree, _, flags = struct.unpack("<4sIIBBB", body[:15])
        if magic != b"NGSP":
            raise ValueError("it does not begin as a .spz does")
        if not 2 <= version <= 4:
            raise ValueError(f"it is of version {version}, expected a .spz of version 2 to 4")
        if count > 1000 * len(data):
            raise ValueError(f"it announces {count} Gaussians")
        if is_gzip:
            row = 16 + (4 if version > 2 else 3) + 3 * ((degree + 1) ** 2 - 1)
            records = body[16 + count * row :]
        else:
            records = data[32 : int.from_bytes(data[16:20], "little")]
        axes = _spz_axes(records if flags & 2 else b"")
        stored, notes = _gaussians(path, gsply.read_spz(path))
        gaussians = transform_axes(stored, axes)
    gaussians = dataclasses.replace(gaussians, means=gaussians.means.astype(np.float32))
    return gaussians, (*notes, *_antialiasing_notes(path, bool(flags & 1)))


def _spz_axes(records: bytes) -> np.ndarray:
    """(4, 4) from the axes that the records of a .spz name to those of a .ply; by default from its makers' (RUB)."""
    axes, offset = _SPZ_AXES, 0
    while offset + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, offset)
        if offset + 8 + length > len(records):
            raise EOFError
        number = int.from_bytes(records[offset + 8 : offset + 12], "little")
        if kind == 0xADBE0003 and number > 16:
            raise ValueError(f"its coordinate system has the unknown number {number}, expected 1 to 16")
        if kind == 0xADBE0003 and number > 0:  # 0: unspecified
            # 1 to 8 are LDB, RDB, LUB, RUB, LDF, ...: x points left or right, y down or up, z back or forward.
            # 9 to 16 are LFD, RFD, LFU, RFU, LBD, ...: y points forward or back, z down or up.
            bits, is_z_up = number - 1, number > 8
            signs = 1 if bits & 1 else -1, -1 if bits & 2 else 1, 1 if bool(bits & 4) != is_z_up else -1, 1
            axes = np.diag(signs)[:, [0, 2, 1, 3] if is_z_up else [0, 1, 2, 3]].astype(float)
        offset += 8 + length
    return axes


def _read_compressed_ply(path: Path, header: Any) -> tuple[Gaussians, tuple[str, ...]]:
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
            remedy = f"Run: npx @playcanvas/splat-transform {path.name} plain.ply"
            raise InputError(path, "its elements are not those of SuperSplat 2's compressed .ply", remedy=remedy)
        size = sum(element.count * element.dtype("<").itemsize for element in header.elements)
        if path.stat().st_size < header.start + size or chunk.count * 256 < vertex.count:  # 256 share their bounds
            raise EOFError
        if rest and rest[0].count != vertex.count:
            raise ValueError(f"it has {rest[0].count} rows of harmonics for {vertex.count} Gaussians")
        return _gaussians(path, gsply.plyread(path))


def _read_sog(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads PlayCanvas' .sog, images in a zip."""
    with decoding(path, "gsply") as gsply:
        with zipfile.ZipFile(path) as archive:
            meta = parse_json(archive.read("meta.json"))
            books = [part["codebook"] for part in meta.values() if isinstance(part, dict) and "codebook" in part]
            if any(len(book) < 256 for book in books):  # gsply indexes them without a check of their size
                raise ValueError("a codebook of fewer than 256 numbers")
        gaussians, notes = _gaussians(path, gsply.sogread(path.read_bytes()))
        return gaussians, (*notes, *_antialiasing_notes(path, meta.get("antialias") is True))


def _read_splat(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads antimatter15's .splat: 32 bytes a Gaussian, degree 0, without a header."""
    data = path.read_bytes()
    row = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    if len(data) % row.itemsize:
        problem = f"it has {len(data)} bytes, which is not a multiple of {row.itemsize}, the size of a Gaussian"
        raise InputError(path, problem, remedy="The file is cut short or of another format: export it again.")
    rows = np.frombuffer(data, row)
    half_step = 0.5 / 255
    opacity = np.clip(rows["rgba"][:, 3] / 255, half_step, 1 - half_step)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])  # a size of 0 is that of a flat Gaussian
    turns, sh = (rows["rotation"].astype(np.float32) - 128) / 128, (rows["rgba"][:, None, :3] / 255.0 - 0.5) / C0
    return _usable_gaussians(path, rows["means"], log_scales, turns, np.log(opacity / (1 - opacity)), sh)


def _read_ply(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .ply, compressed or not."""
    header = read_ply_file(path)[1]
    comments = [comment.lower().replace(":", " ").split() for comment in header.comments]
    is_antialiased = ["splatrendermode", "mip"] in comments or ["antialiased", "1"] in comments  # of Brush, Postshot
    names = {name for element in header.elements for name, _ in element.fields}
    if "packed_position" in names:
        gaussians, notes = _read_compressed_ply(path, header)
    elif any(name.startswith(("f_dc_", "scale_", "rot_", "opacity")) for name in names):
        gaussians, notes = read_ply(path), ()
    else:
        gaussians, notes = gaussians_of_cloud(path)
    return gaussians, (*notes, *_antialiasing_notes(path, is_antialiased))


READERS = (
    Reader("PLY", (".ply",), _read_ply),
    Reader("SPZ", (".spz",), _read_spz),
    Reader("SOG", (".sog",), _read_sog),
    Reader("splat", (".splat",), _read_splat),
    *(Reader(name, marks, gaussians_of_cloud) for name, marks, _ in POINTS),
)


def load_gaussians(path: str | Path, *, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Reads Gaussians from a .ply (INRIA's layout, or SuperSplat's compressed one), .spz, .sog or .splat.

    Points of a .las, .laz, .e57, .pcd, .xyz, .txt or .ply become round, opaque Gaussians, at most 200,000.
    All come in the world of the .ply that they were made from: a .spz has y up by its makers' definition, and
    is turned back, (x, -y, -z). Warns (UserWarning) if a file was trained with antialiasing, which is
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
        its positions; or gsply is missing (for .spz, .sog and a compressed .ply).
    """
    gaussians, notes = read_gaussians(path)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    if similarity is not None:
        gaussians = transform_gaussians(gaussians, similarity)
    rounding = float32_rounding(gaussians)
    if len(rounding) and np.median(rounding) > MAX_READ_ROUNDING:
        place = ", ".join(f"{number:.10g}" for number in np.median(gaussians.means, axis=0))
        problem = f"the Gaussians lie about ({place}), where float32 does not tell them apart"
        remedy = "Give load_gaussians a similarity that brings them near 0, as inv(capture.source_from_scene)."
        raise InputError(path, problem, remedy=remedy)
    return jax.tree.map(jnp.asarray, gaussians)


def read_gaussians(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Gaussians as `load_gaussians` does, but as NumPy arrays, and returns notes in place of warnings.

    The means are float64 if the file has them finer than float32.
    """
    path = Path(path)
    if path.is_dir() or not path.exists():
        problem = "it is a folder" if path.is_dir() else "there is no such file"
        raise InputError(path, problem, _FORMATS, "Check the path.")
    reader = next((reader for reader in readers("jsecon.splats", READERS) if reader.fits(path)), None)
    if reader is None:
        remedy = "Export the scene as a .ply."
        if path.suffix.lower() in (".ksplat", ".lcc", ".mjs") or path.name == "meta.json":  # of an unpacked .sog
            remedy = f"Run: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        with reading(path):  # a pointer of Git LFS may stand there
            raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", _FORMATS, remedy)
    with reading(path, remedy="Export it again, or as a .ply."):
        return reader.read(path)


def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    ids: Mapping[str, Int[Array, " n"]] = MappingProxyType({}),
    names: Sequence[str] = (),
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians as a .ply (INRIA's layout, exact) or a .usda.

    A .ply is written in blocks: memory-mapped arrays need not fit into memory. A .usda is a text of OpenUSD
    with a ParticleField3DGaussianSplat for each object.

    Args:
      path: The file; its suffix names the format.
      gaussians: N Gaussians.
      ids: Integers of each Gaussian by name, such as "object_id", -1 for none: properties of a .ply. A .usda has a prim
        for each "object_id".
      names: Names of the objects by id, for a .usda.
      similarity: (4, 4) transform into the world of the file.

    Raises:
      ValueError: Shapes disagree.
      InputError: The format cannot be written, a Gaussian cannot be drawn, or the folder cannot be written.
    """
    path = Path(path)
    require_writable_format(path)
    check_gaussians(gaussians)
    for name, column in ids.items():
        require_shape(name, column, (gaussians.count,), "Give one id per Gaussian.")
    if not gaussians.count and path.suffix.lower() != ".ply":
        raise InputError(path, "there are no Gaussians to write", remedy="Write a .ply, which may be empty.")
    options = {"names": names} if path.suffix.lower() == ".usda" else {}
    _WRITERS[path.suffix.lower()](path, gaussians, ids, similarity, **options)


def require_writable_format(path: Path, points: bool = False) -> None:
    """Checks that `save_gaussians`, or `save_point_cloud`, can write a file, which need not exist."""
    known = (".las", ".laz", ".ply") if points else tuple(_WRITERS)
    if path.suffix.lower() not in known:
        command = f"npx @playcanvas/splat-transform {path.stem}.ply {path.stem}.glb"
        remedy = f"Write {path.stem}.ply. To make a .glb, .spz or .sog of it, run: {command}"
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", " or ".join(known), remedy)


_WRITERS: dict[str, Callable[..., None]] = {".ply": save_ply, ".usda": save_usda}
"""suffix -> function that writes a file from Gaussians, ids by name, and a similarity or None"""
