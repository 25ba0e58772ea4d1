"""Gaussians read from and written to files of any known format, which the suffix of a file names, on the host.

`READERS` is the table of formats. A reader takes the file, and returns Gaussians (NumPy) in the world of the .ply that
they were made from, and notes. Other packages add readers by entry points in the group jsecon.splats.
"""

import warnings
from pathlib import Path

from jaxtyping import Float, Int

from jsecon.errors import InputError
from jsecon.files import reading
from jsecon.read.registry import Reader, find_reader
from jsecon.read.splats import packed
from jsecon.read.splats.gltf import read_glb, save_glb
from jsecon.read.splats.packed import antialiasing_note, import_gsply, read_compressed_ply, save_spz
from jsecon.read.splats.ply import in_float32, read_ply, read_ply_file, save_ply
from jsecon.types import Array, Gaussians

_FORMATS = "Gaussians as .ply (INRIA's or SuperSplat's compressed), .glb, .spz, .sog or .splat"
_CONVERTIBLE = (".ksplat", ".lcc", ".mjs")
"""suffixes that splat-transform reads, besides meta.json of an unpacked .sog"""


def _read_ply(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a .ply, compressed or not."""
    header = read_ply_file(path)[1]
    notes = antialiasing_note(path) if any(map(_names_antialiasing, header.comments)) else ()
    return (read_compressed_ply(path, header) if header.is_compressed else read_ply(path)), notes


def _names_antialiasing(comment: str) -> bool:
    """Whether a comment of a .ply marks a training with antialiasing, as Brush and Postshot write it."""
    return comment.lower().replace(":", " ").split() in (["splatrendermode", "mip"], ["antialiased", "1"])


READERS = (
    Reader("PLY", (".ply",), _read_ply),
    Reader("glTF", (".glb",), lambda path: (read_glb(path), ())),
    *packed.READERS,
)


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
        its positions; or gsply is missing (for .spz, .sog and a compressed .ply).
    """
    gaussians, notes = read_gaussians(path)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return in_float32(Path(path), gaussians, similarity)


def read_gaussians(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads Gaussians as `load_gaussians` does, but as NumPy arrays, and returns notes in place of warnings.

    The means are float64 if the file has them finer than float32.
    """
    path = Path(path)
    if path.is_dir() or not path.exists():
        problem = "it is a folder" if path.is_dir() else "there is no such file"
        raise InputError(path, problem, _FORMATS, "Check the path.")
    reader = find_reader("jsecon.splats", READERS, path)
    if reader is None:
        remedy = "Export the scene as a .ply."
        if path.suffix.lower() in _CONVERTIBLE or path.name == "meta.json":
            remedy = f"Run: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        elif path.suffix.lower() == ".gltf":
            remedy = "Export it as one .glb file, or as a .ply."
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", _FORMATS, remedy)
    with reading(path, remedy="Export it again, or as a .ply."):
        return reader.read(path)


def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    object_ids: Int[Array, " n"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians as a .ply (INRIA's layout, exact), a .glb, or a .spz (version 3, by gsply).

    A .ply and a .glb are written in blocks: memory-mapped arrays need not fit into memory. A .spz holds positions in 24
    bits, sizes to 3 % and from 4.5e-5 to 379 units, opacities and colours in 8 bits, rotations in 32.

    Args:
      path: The file; its suffix names the format.
      gaussians: N Gaussians.
      object_ids: (N,) ids of objects, -1 for none: a property of a .ply, an attribute of a .glb. A .spz has no place.
      similarity: (4, 4) transform into the world of the file.

    Raises:
      ValueError: Shapes disagree.
      InputError: The format cannot be written, gsply is missing for a .spz, a Gaussian cannot be drawn or is out of the
        format's range, or the folder cannot be written.
    """
    path = Path(path)
    require_writable_format(path)
    suffix = path.suffix.lower()
    if suffix == ".spz":
        save_spz(path, gaussians, similarity=similarity)
    else:
        save = save_glb if suffix == ".glb" else save_ply
        save(path, gaussians, object_ids=object_ids, similarity=similarity)


def require_writable_format(path: Path) -> None:
    """Checks that `save_gaussians` can write a file, which need not exist."""
    if path.suffix.lower() not in (".ply", ".spz", ".glb"):
        remedy = f"For example: {path.stem}.ply; npx @playcanvas/splat-transform makes other formats of it."
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", ".ply or .spz or .glb", remedy)
    if path.suffix.lower() == ".spz":
        import_gsply(path)
