"""Gaussians out of a file and into one, whose ending says how: INRIA's .ply and what viewers and phones use.

SuperSplat's compressed .ply, .spz and .sog are read by gsply (extra formats). What is written is written in blocks.
"""

import importlib.util
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jsecon.data.gltf import load_glb, save_glb
from jsecon.data.ply import SH_DC, load_ply, save_ply, sound
from jsecon.data.ply_file import elements_of
from jsecon.data.spz import AXES as SPZ_AXES, save_spz
from jsecon.errors import InputError, why
from jsecon.files import parsed_json
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Array, Gaussians

WRITTEN = (".ply", ".spz", ".glb")
_GSPLY = {".ply": "plyread", ".spz": "read_spz", ".sog": "sogread"}
_READ = "Gaussians as .ply (INRIA's or SuperSplat's compressed), .glb, .spz, .sog or .splat"
_CHUNK = 256
"""Gaussians that share their bounds in a compressed .ply"""
_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def load_gaussians(path: str | Path) -> Gaussians:
    """Gaussians from a .ply in INRIA's layout or SuperSplat's compressed one, a .glb (`load_glb`), .spz, .sog or
    .splat; N may be 0.

    All come in the world of the .ply that they were made from: .spz and .glb have y up by their makers' definition, and
    are turned back, (x, -y, -z) and (-x, -y, z), as by splat-transform; the others are not turned. Raises InputError on
    other formats, damaged files, numbers that are not finite, and where gsply is needed and not installed.
    """
    return read_gaussians(path)[0]


def read_gaussians(path: str | Path) -> tuple[Gaussians, tuple[str, ...]]:
    """As `load_gaussians`, and sentences about what the file says that is not done."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*_GSPLY, ".splat", ".glb"):
        remedy = f"Run: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        raise InputError(path, f"a file that ends in {kind or 'nothing'}", _READ, remedy)
    try:
        with path.open("rb") as file:
            head = file.read(16384)
    except OSError as error:
        raise InputError(path, why(error), _READ, "Check the path.") from error
    if kind == ".ply" and b"packed_position" not in head:
        return load_ply(path), ()
    if kind == ".glb":
        return load_glb(path), ()
    arrays = _read_splat(path) if kind == ".splat" else _read_by_gsply(path, kind)
    gaussians = sound(path, {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()})
    return (transform_gaussians(gaussians, SPZ_AXES) if kind == ".spz" else gaussians), ()


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

    A .spz holds places in 24 bits to 2^-16 units or, in scenes beyond 128 units, to 2^-23 of its extent; sizes to 3 %
    and from exp(-10) to exp(5.9) units, opacities and colours in 8 bits, turns in 32. Raises InputError where
    `require_written` does, and where the folder cannot be written.
    """
    path = Path(path)
    require_written(path)
    if path.suffix == ".glb":
        save_glb(path, gaussians, codes=codes, regions=regions, similarity=similarity)
    elif path.suffix == ".spz":
        save_spz(path, gaussians, similarity=similarity)
    else:
        save_ply(path, gaussians, similarity=similarity)


def require_written(path: Path) -> None:
    """Raises InputError where a file of this ending cannot be written here."""
    if path.suffix not in WRITTEN:
        remedy = f"For example: {path.stem}.ply; npx @playcanvas/splat-transform makes other formats of it."
        raise InputError(path, f"the ending {path.suffix or 'of nothing'}", " or ".join(WRITTEN), remedy)


def _require_gsply(path: Path) -> None:
    if importlib.util.find_spec("gsply") is None:
        remedy = "Run: pip install 'jsecon[formats]' (or use an uncompressed .ply)."
        raise InputError(path, "no package gsply", "gsply, for compressed .ply, .spz and .sog", remedy)


def _read_by_gsply(path: Path, kind: str) -> dict[str, np.ndarray]:
    _require_gsply(path)
    import gsply

    remedy = f"Export it again, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
    if kind == ".ply":  # gsply looks up a chunk that is not there without an error, as it does a .sog's codebook
        counts = {element.name: element.count for element in elements_of(path)[1]}
        if counts.get("chunk", 0) * _CHUNK < counts.get("vertex", 0):
            found = f"{counts.get('chunk', 0)} chunks for {counts['vertex']} Gaussians"
            raise InputError(path, f"a compressed .ply of {found}", f"a chunk for every {_CHUNK}", remedy)
    try:
        if kind == ".sog":
            told = parsed_json(zipfile.ZipFile(path).read("meta.json")).values()
            if any(len(part.get("codebook", [0] * 256)) < 256 for part in told if isinstance(part, dict)):
                raise ValueError("a codebook of fewer than 256 numbers")
        with np.errstate(invalid="ignore", over="ignore"):
            data: Any = getattr(gsply, _GSPLY[kind])(path)
        if (rest := 0 if data.shN is None else data.shN.shape[1]) not in (0, 3, 8, 15):
            raise ValueError(f"{rest} harmonics above the constant")
    except Exception as error:  # whatever a decoder says of damaged bytes
        raise InputError(path, f"gsply cannot read it ({why(error)})", f"a whole {kind}", remedy) from error
    sh = [np.asarray(data.sh0)[:, None], *([] if data.shN is None else [data.shN])]
    given = {"means": data.means, "log_scales": data.scales, "quaternions": data.quats}
    return given | {"opacity_logits": np.reshape(data.opacities, -1), "sh": np.concatenate(sh, axis=1)}


def _read_splat(path: Path) -> dict[str, np.ndarray]:
    """antimatter15's .splat: 32 bytes a Gaussian, no header."""
    data = path.read_bytes()
    if len(data) % _SPLAT.itemsize:
        found, wanted = f"{len(data)} bytes", f"{_SPLAT.itemsize} for each Gaussian"
        raise InputError(path, found, wanted, "The file is cut short or no .splat: export it again.")
    rows = np.frombuffer(data, _SPLAT)
    alpha = np.clip(rows["rgba"][:, 3], 0.5, 254.5) / 255
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])
    return {
        "means": rows["means"],
        "log_scales": log_scales,
        "quaternions": (rows["rotation"].astype(np.float32) - 128) / 128,
        "opacity_logits": np.log(alpha / (1 - alpha)),
        "sh": ((rows["rgba"][:, None, :3] / 255.0) - 0.5) / SH_DC,
    }
