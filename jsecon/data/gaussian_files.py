"""Gaussians out of a file and into one, whose ending says how: INRIA's .ply and what viewers and phones use.

SuperSplat's compressed .ply, .spz and .sog are read, and .spz is written, by gsply (extra formats).
"""

import importlib.util
import math
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from jsecon.data.gltf import save_glb
from jsecon.data.ply import SH_DC, load_ply, save_ply, sound
from jsecon.data.ply_file import opened
from jsecon.errors import InputError
from jsecon.files import parsed_json, written_whole
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Array, Gaussians

WRITTEN = (".ply", ".spz", ".glb")
_GSPLY = {".ply": "plyread", ".spz": "read_spz", ".sog": "sogread"}
_READ = "Gaussians as .ply (INRIA's or SuperSplat's compressed), .spz, .sog or .splat"
_SPZ_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""from a .ply's x right, y down, z forward to .spz's x right, y up, z back; and back again"""
_SPZ_BITS = 16
"""most of a coordinate's 24 bits behind the point; far Gaussians need more of them before it"""
_CHUNK = 256
"""Gaussians that share their bounds in a compressed .ply"""
_SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def load_gaussians(path: str | Path) -> Gaussians:
    """Gaussians from a .ply in INRIA's layout or SuperSplat's compressed one, a .spz, .sog or .splat; N may be 0.

    All come in the world of the .ply that they were made from: .spz has y up by its makers' definition, and is turned
    back (x, -y, -z), as by splat-transform; the others are not turned. Raises InputError on other formats, damaged
    files, numbers that are not finite, and where gsply is needed and not installed.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*_GSPLY, ".splat"):
        other = "Export the scene as one of them."
        remedy = other if kind == ".glb" else f"Run: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        raise InputError(path, f"a file that ends in {kind or 'nothing'}", _READ, remedy)
    try:
        with path.open("rb") as file:
            head = file.read(16384)
    except OSError as error:
        raise InputError(path, error.strerror or "an error on reading", _READ, "Check the path.") from error
    if kind == ".ply" and b"packed_position" not in head:
        return load_ply(path)
    arrays = _read_splat(path) if kind == ".splat" else _read_by_gsply(path, kind)
    gaussians = sound(path, {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()})
    return transform_gaussians(gaussians, _SPZ_AXES) if kind == ".spz" else gaussians


def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    codes: Float[Array, "n d"] | None = None,
    regions: Int[Array, " n"] | None = None,
) -> None:
    """Writes Gaussians as a .ply (INRIA's layout, exact), a .spz (version 3) or a .glb, which alone takes codes and
    regions (`save_glb`).

    A .spz holds places in 24 bits to 2^-16 units or, in scenes beyond 128 units, to 2^-23 of its extent; sizes to 3 %
    and from exp(-10) to exp(5.9) units, opacities and colours in 8 bits, turns in 32. Raises InputError where
    `require_written` does, and where the folder cannot be written.
    """
    path = Path(path)
    require_written(path)
    if path.suffix == ".glb":
        save_glb(path, gaussians, codes=codes, regions=regions)
    elif path.suffix == ".spz":
        _save_spz(path, gaussians)
    else:
        save_ply(path, gaussians)


def require_written(path: Path) -> None:
    """Raises InputError where a file of this ending cannot be written here."""
    if path.suffix not in WRITTEN:
        remedy = f"For example: {path.stem}.ply; npx @playcanvas/splat-transform makes other formats of it."
        raise InputError(path, f"the ending {path.suffix or 'of nothing'}", " or ".join(WRITTEN), remedy)
    if path.suffix == ".spz":
        _require_gsply(path)


def _require_gsply(path: Path) -> None:
    if importlib.util.find_spec("gsply") is None:
        remedy = "Run: pip install 'jsecon[formats]' (or use an uncompressed .ply)."
        raise InputError(path, "no package gsply", "gsply, for compressed .ply, .spz and .sog", remedy)


def _read_by_gsply(path: Path, kind: str) -> dict[str, np.ndarray]:
    _require_gsply(path)
    import gsply

    remedy = f"Export it again, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
    if kind == ".ply":  # gsply looks up a chunk that is not there without an error, as it does a .sog's codebook
        counts = {element.name: element.count for element in opened(path)[2]}
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
        raise InputError(path, f"what gsply cannot read ({error})", f"a whole {kind}", remedy) from error
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


def _save_spz(path: Path, gaussians: Gaussians) -> None:
    import gsply

    turned = jax.tree.map(lambda a: np.asarray(a, np.float32), transform_gaussians(gaussians, _SPZ_AXES))
    reach = float(np.abs(turned.means).max(initial=1.0))
    bits = min(_SPZ_BITS, 23 - math.ceil(math.log2(reach)))
    if bits < 1:
        found, wanted = f"a Gaussian {reach:.3g} units from the origin", "at most 4,000,000"
        raise InputError(path, found, wanted, "Write a .ply, or bring the scene nearer to its origin.")
    shape, logits = (turned.means, turned.log_scales, turned.quaternions), np.clip(turned.opacity_logits, -30, 30)
    data = gsply.GSData.from_arrays(*shape, logits, turned.sh[:, 0], turned.sh[:, 1:], format="ply")
    with written_whole(path) as temporary:
        gsply.write_spz(temporary, data, version=3, fractional_bits=bits)
