"""Gaussians of SuperSplat's compressed .ply: chunks of 256 that share the bounds of places, sizes and colours.

Format: github.com/playcanvas/splat-transform, decompress-ply.ts. Files of SuperSplat 1 have no bounds of colours, which
are then 0 to 1. Harmonics beyond the constant are bytes of an element of their own.
"""

from pathlib import Path

import numpy as np

from jsecon.data.gaussians.ply import SH_DC, drawable_gaussians
from jsecon.data.gaussians.ply_file import ply_error, read_elements
from jsecon.types import Gaussians

_CHUNK = 256
"""Gaussians that share their bounds"""
_BOUNDS = [f"{end}_{kind}" for end in ("min", "max") for kind in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
_COLOURS = [f"{end}_{kind}" for end in ("min", "max") for kind in "rgb"]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_LEAST_OPACITY = 1e-6
"""that the bytes 0 and 255 are read as, and its distance from 1"""
_WANTED, _REMEDY = "a compressed .ply as SuperSplat writes it", "Export it again, or as an uncompressed .ply."


def load_compressed_ply(path: Path) -> Gaussians:
    """Reads a compressed .ply.

    Args:
      path: The file.

    Returns:
      Its Gaussians, float32; N may be 0.

    Raises:
      InputError: The file is cut short or text, lacks properties or chunks, or has harmonics of no whole degree.
    """
    header, tables = read_elements(path)
    if header.form == "ascii":
        raise ply_error(path, "its format is ascii", "a binary compressed .ply", _REMEDY)
    empty = np.zeros(0, [])
    chunks, vertices, rest = (tables.get(name, empty) for name in ("chunk", "vertex", "sh"))
    bounds, packed = chunks.dtype.names or (), vertices.dtype.names or ()
    with_colours = any(name in bounds for name in _COLOURS)
    missing = [name for name in (*_BOUNDS, *(_COLOURS if with_colours else ())) if name not in bounds]
    if missing := [*missing, *(name for name in _PACKED if name not in packed)]:
        raise ply_error(path, f"it has no properties {', '.join(missing)}", _WANTED, _REMEDY)
    if wrong := [
        name for name in _PACKED if vertices.dtype[name].kind not in "iu" or vertices.dtype[name].itemsize != 4
    ]:
        raise ply_error(path, f"{wrong[0]} is of type {vertices.dtype[wrong[0]].name}", "uint", _REMEDY)
    count = len(vertices)
    if len(chunks) * _CHUNK < count:
        raise ply_error(
            path, f"it has {len(chunks)} chunks for {count} Gaussians", f"a chunk for each {_CHUNK}", _REMEDY
        )
    position, rotation, scale, colour = (vertices[name].astype(np.uint32) for name in _PACKED)

    def between(kinds: str | tuple[str, ...], share: np.ndarray) -> np.ndarray:
        """(N, 3) numbers that lie at a share of the way between the bounds of their chunks."""
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused below
            low, high = (np.stack([chunks[f"{end}_{kind}"] for kind in kinds], axis=1) for end in ("min", "max"))
            low, high = (np.repeat(a.astype(np.float64), _CHUNK, axis=0)[:count] for a in (low, high))
            return low * (1 - share) + high * share

    rgba = _shares(colour, (24, 8), (16, 8), (8, 8), (0, 8))
    rgb = between("rgb", rgba[:, :3]) if with_colours else rgba[:, :3]
    alpha = np.clip(rgba[:, 3], _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    with np.errstate(invalid="ignore", over="ignore"):
        constant = ((rgb - 0.5) / SH_DC)[:, None]
        arrays = {
            "means": between("xyz", _shares(position, (21, 11), (11, 10), (0, 11))),
            "log_scales": between(("scale_x", "scale_y", "scale_z"), _shares(scale, (21, 11), (11, 10), (0, 11))),
            "quaternions": _turns(rotation),
            "opacity_logits": np.log(alpha / (1 - alpha)),
            "sh": np.concatenate([constant, _harmonics(path, rest, count)], axis=1),
        }
        return drawable_gaussians(
            path, {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
        )


def _shares(words: np.ndarray, *fields: tuple[int, int]) -> np.ndarray:
    """(N, F) in [0, 1]: fields of words (N,), each from a bit on, so many bits wide."""
    parts = [((words >> np.uint32(start)) & np.uint32(2**bits - 1)) / (2**bits - 1) for start, bits in fields]
    return np.stack(parts, axis=1)


def _turns(words: np.ndarray) -> np.ndarray:
    """(N, 4) unit wxyz: which component is largest, in two bits, and the three others in ten each."""
    others = (_shares(words, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2)
    largest = (words >> np.uint32(30)).astype(np.int64)
    turns = np.empty((len(words), 4))
    places = (np.arange(4) + (np.arange(4) >= largest[:, None]))[:, :3]
    np.put_along_axis(turns, places, others, axis=1)
    np.put_along_axis(turns, largest[:, None], np.sqrt(np.maximum(1 - (others**2).sum(1, keepdims=True), 0)), axis=1)
    return turns


def _harmonics(path: Path, rest: np.ndarray, count: int) -> np.ndarray:
    """(N, K - 1, 3) coefficients out of the bytes of the element sh."""
    names = rest.dtype.names or ()
    if len(names) not in (0, 9, 24, 45) or any(f"f_rest_{index}" not in names for index in range(len(names))):
        found = f"its element sh has {len(names)} properties"
        raise ply_error(path, found, "0, 9, 24 or 45 of them, f_rest_0 and on", _REMEDY)
    if not names:
        return np.zeros((count, 0, 3))
    if len(rest) != count:
        raise ply_error(path, f"it has {len(rest)} rows of sh for {count} Gaussians", "one for each", _REMEDY)
    numbers = np.stack([rest[f"f_rest_{index}"].astype(np.float64) for index in range(len(names))], axis=1)
    share = np.where(numbers <= 0, 0.0, np.where(numbers >= 255, 1.0, (numbers + 0.5) / 256))
    return ((share - 0.5) * 8).reshape(count, 3, len(names) // 3).transpose(0, 2, 1)
