"""Gaussians out of a file and into one, whose ending says how: INRIA's .ply and what viewers and phones use.

PlayCanvas' .sog is read by gsply (extra formats), all else here. What is written is written in blocks.
"""

import importlib.util
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jsecon.data.gaussians.compressed import load_compressed_ply
from jsecon.data.gaussians.gltf import read_glb, save_glb
from jsecon.data.gaussians.ply import SH_DC, drawable_gaussians, in_float32, read_ply, save_ply
from jsecon.data.gaussians.ply_file import header_of, is_compressed
from jsecon.data.gaussians.spz import load_spz, save_spz
from jsecon.errors import InputError, describe_error
from jsecon.files import parse_json
from jsecon.types import Array, Gaussians

WRITTEN = (".ply", ".spz", ".glb")
_READ = "Gaussians as .ply (INRIA's or SuperSplat's compressed), .glb, .spz, .sog or .splat"
_CONVERTED = (".ksplat", ".lcc", ".mjs")
"""endings that splat-transform reads, besides meta.json of an unpacked .sog"""
_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def load_gaussians(path: str | Path, *, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Reads Gaussians from a .ply (INRIA's layout, see `load_ply`, or SuperSplat's compressed one), .glb (see
    `load_glb`), .spz, .sog or .splat.

    All come in the world of the .ply that they were made from: .spz and .glb have y up by their makers' definition, and
    are turned back, (x, -y, -z) and (-x, -y, z); a .spz that names other axes is turned from those. The others are not
    turned. Warns (UserWarning) of what a file says that is not done: that it was trained with antialiasing.

    Args:
      path: The file; its ending, in small or capital letters, says the format.
      similarity: (4, 4) float64. Carries the Gaussians into another world before they become float32. The inverse of
        `Capture.to_source` carries them from the world of a capture's files into that of its cameras. Positions in
        double precision, as in a map projection's coordinates, keep their digits so.

    Returns:
      Its Gaussians, float32; N may be 0.

    Raises:
      InputError: The file is of another format, damaged, or holds numbers that cannot be drawn; float32 does not hold
        its positions; or it needs a package that is not installed (gsply for .sog, zstandard for .spz of version 4).
    """
    gaussians, notes = read_gaussians(path)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return in_float32(Path(path), gaussians, similarity)


def read_gaussians(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """What `load_gaussians` reads, as NumPy arrays, with what it would warn of, a sentence each. The means are float64
    where the file has them finer than float32."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".ply", ".glb", ".spz", ".sog", ".splat"):
        remedy = "Export the scene as a .ply."
        if kind in _CONVERTED or path.name == "meta.json":
            remedy = f"Run: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        elif kind == ".gltf":
            remedy = "Export it as one .glb file, or as a .ply."
        raise InputError(path, f"its name ends in {kind or 'nothing'}", _READ, remedy)
    if kind == ".ply":
        header = header_of(path)
        notes = _trained_antialiased(path) if any(map(_antialiased, header.comments)) else ()
        return (load_compressed_ply if is_compressed(header) else read_ply)(path), notes
    if kind == ".glb":
        return read_glb(path), ()
    if kind == ".spz":
        return load_spz(path)
    if not path.is_file():
        found = "it is a folder" if path.is_dir() else "No such file or directory"
        raise InputError(path, found, _READ, "Check the path.")
    arrays, notes = _read_splat(path) if kind == ".splat" else _read_sog(path)
    return drawable_gaussians(
        path, {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
    ), notes


def _antialiased(comment: str) -> bool:
    """Whether a .ply's comment says that it was trained with antialiasing, as Brush and Postshot write it."""
    return comment.lower().replace(":", " ").split() in (["splatrendermode", "mip"], ["antialiased", "1"])


def _trained_antialiased(path: Path) -> tuple[str, ...]:
    return (f"{path.name} was trained with antialiasing (Mip-Splatting), and is drawn without it.",)


def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    codes: Float[Array, "n d"] | None = None,
    regions: Int[Array, " n"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians as a .ply (INRIA's layout, exact), a .spz (version 3) or a .glb, which alone takes codes and
    regions (`save_glb`); carried by `similarity` (4, 4) into another world, in blocks: mapped columns need not fit into
    memory.

    A .spz holds places in 24 bits: to 2^-16 units or, in scenes beyond 128 units, to 2^-22 of the farthest coordinate;
    those within 1 unit to 2^-22 of it, or 2^-24. It holds sizes to 3 % and from exp(-10) to exp(5.9) units, opacities
    and colours in 8 bits, turns in 32.

    Raises ValueError where shapes disagree. Raises InputError where `load_gaussians` would refuse what is written or,
    of a .spz, where places or sizes lie outside of what it holds; where
    `require_writable_format` does, and where the folder cannot be written.
    """
    path = Path(path)
    require_writable_format(path)
    kind = path.suffix.lower()
    if kind == ".glb":
        save_glb(path, gaussians, codes=codes, regions=regions, similarity=similarity)
    elif kind == ".spz":
        save_spz(path, gaussians, similarity=similarity)
    else:
        save_ply(path, gaussians, similarity=similarity)


def require_writable_format(path: Path) -> None:
    """Raises InputError where a file of this ending cannot be written here."""
    if path.suffix.lower() not in WRITTEN:
        remedy = f"For example: {path.stem}.ply; npx @playcanvas/splat-transform makes other formats of it."
        raise InputError(path, f"its name ends in {path.suffix or 'nothing'}", " or ".join(WRITTEN), remedy)


def _read_sog(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """PlayCanvas' .sog: images in a zip."""
    if importlib.util.find_spec("gsply") is None:
        remedy = "Run: pip install 'jsecon[formats]' (or use another format)."
        raise InputError(path, "there is no package gsply", "gsply, for .sog", remedy)
    import gsply

    try:
        # gsply looks up a codebook's number that is not there without an error
        told = parse_json(zipfile.ZipFile(path).read("meta.json"))
        if any(len(part.get("codebook", [0] * 256)) < 256 for part in told.values() if isinstance(part, dict)):
            raise ValueError("a codebook of fewer than 256 numbers")
        with np.errstate(invalid="ignore", over="ignore"):
            read: Any = gsply.sogread
            data = read(path)
        if (rest := 0 if data.shN is None else data.shN.shape[1]) not in (0, 3, 8, 15):
            raise ValueError(f"{rest} harmonics above the constant")
    except Exception as error:  # whatever a decoder says of damaged bytes
        remedy = f"Export it again, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
        raise InputError(path, f"gsply cannot read it ({describe_error(error)})", "a whole .sog", remedy) from error
    sh = [np.asarray(data.sh0)[:, None], *([] if data.shN is None else [data.shN])]
    given = {"means": data.means, "log_scales": data.scales, "quaternions": data.quats}
    notes = _trained_antialiased(path) if told.get("antialias") is True else ()
    return given | {"opacity_logits": np.reshape(data.opacities, -1), "sh": np.concatenate(sh, axis=1)}, notes


def _read_splat(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """antimatter15's .splat: 32 bytes a Gaussian, no header."""
    data = path.read_bytes()
    if len(data) % _SPLAT.itemsize:
        found, wanted = f"it has {len(data)} bytes", f"a multiple of {_SPLAT.itemsize}, so many for each Gaussian"
        raise InputError(path, found, wanted, "The file is cut short or another format: export it again.")
    rows = np.frombuffer(data, _SPLAT)
    alpha = np.clip(rows["rgba"][:, 3], 0.5, 254.5) / 255
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])  # a size of 0 is that of a flat Gaussian
    return {
        "means": rows["means"],
        "log_scales": log_scales,
        "quaternions": (rows["rotation"].astype(np.float32) - 128) / 128,
        "opacity_logits": np.log(alpha / (1 - alpha)),
        "sh": ((rows["rgba"][:, None, :3] / 255.0) - 0.5) / SH_DC,
    }, ()
