"""Gaussians read from and written to files of any known format, which the suffix of a file names."""

import warnings
from collections.abc import Callable
from pathlib import Path

from jaxtyping import Float, Int

from jsecon.data.gaussians.compressed import (
    antialiasing_note,
    load_compressed_ply,
    load_sog,
    load_splat,
    load_spz,
    save_spz,
)
from jsecon.data.gaussians.gltf import read_glb, save_glb
from jsecon.data.gaussians.ply import in_float32, read_header, read_ply, save_ply
from jsecon.errors import InputError
from jsecon.types import Array, Gaussians

WRITTEN = (".ply", ".spz", ".glb")
"""suffixes of files that can be written"""
_FORMATS = "Gaussians as .ply (INRIA's or SuperSplat's compressed), .glb, .spz, .sog or .splat"
_CONVERTIBLE = (".ksplat", ".lcc", ".mjs")
"""suffixes that splat-transform reads, besides meta.json of an unpacked .sog"""


def load_gaussians(path: str | Path, *, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Reads Gaussians from a .ply (INRIA's layout, or SuperSplat's compressed one), .glb, .spz, .sog or .splat.

    All come in the world of the .ply that they were made from: .spz and .glb have y up by their makers' definition, and
    are turned back, (x, -y, -z) and (-x, -y, z). Warns (UserWarning) if a file was trained with antialiasing, which is
    not done.

    Args:
      path: The file; its suffix, in small or capital letters, names the format.
      similarity: (4, 4) float64. Carries the Gaussians into another world before they become float32. The inverse of
        `Capture.to_source` carries them from the world of a capture's files into that of its cameras, and keeps the
        digits of a map projection's coordinates.

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


def _read_ply(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .ply, compressed or not."""
    header = read_header(path)
    notes = antialiasing_note(path) if any(map(_names_antialiasing, header.comments)) else ()
    return (load_compressed_ply(path) if header.is_compressed else read_ply(path, header)), notes


def _names_antialiasing(comment: str) -> bool:
    """Whether a comment of a .ply marks a training with antialiasing, as Brush and Postshot write it."""
    return comment.lower().replace(":", " ").split() in (["splatrendermode", "mip"], ["antialiased", "1"])


_READERS: dict[str, Callable[[Path], tuple[Gaussians, tuple[str, ...]]]] = {
    ".ply": _read_ply,
    ".glb": lambda path: (read_glb(path), ()),
    ".spz": load_spz,
    ".sog": load_sog,
    ".splat": lambda path: (load_splat(path), ()),
}
"""suffix -> reader of Gaussians and notes"""


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
      regions: (N,) region ids, -1 = none, written to a .glb only.
      similarity: (4, 4) transform into the world of the file.

    Raises:
      ValueError: Shapes disagree.
      InputError: The format cannot be written, a Gaussian cannot be drawn, positions or sizes lie outside of what a
        .spz holds, or the folder cannot be written.
    """
    path = Path(path)
    require_writable_format(path)
    suffix = path.suffix.lower()
    if suffix == ".glb":
        save_glb(path, gaussians, codes=codes, regions=regions, similarity=similarity)
    elif suffix == ".spz":
        save_spz(path, gaussians, similarity=similarity)
    else:
        save_ply(path, gaussians, similarity=similarity)


def require_writable_format(path: Path) -> None:
    """Raises InputError if files with the suffix of `path` cannot be written."""
    if path.suffix.lower() not in WRITTEN:
        remedy = f"For example: {path.stem}.ply; npx @playcanvas/splat-transform makes other formats of it."
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", " or ".join(WRITTEN), remedy)
