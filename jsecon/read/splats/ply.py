"""Gaussians read from .ply files, and vertices of any kind, on the host.

The container is read whatever its properties: text or binary, either byte order, lists (http://paulbourke.net/
dataformats/ply). The package plyfile is not used: it is under GPLv3+ and jsecon under Apache-2.0. Gaussians have the
layout of INRIA's 3D Gaussian Splatting and its relatives.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.files import scratch_array
from jsecon.splat.project import unusable_rows
from jsecon.splat.sh import C0
from jsecon.types import Gaussians

BLOCK_ROWS = 1 << 18
"""Number of Gaussians read or transformed at a time."""
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""format of a .ply -> NumPy's byte order"""
TYPES = dict(char="i1", uchar="u1", short="i2", ushort="u2", int="i4", uint="u4", float="f4", double="f8")
TYPES |= {np.dtype(kind).name: kind for kind in TYPES.values()}
"""a property's type, by its old name or with its size (uchar, uint8) -> NumPy's"""
POSITION, OPACITY, _RGB = ("x", "y", "z"), ("opacity",), ("red", "green", "blue")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")


@dataclasses.dataclass
class _Element:
    """An element of a .ply."""

    name: str
    count: int
    fields: list[tuple[str, str]]
    """(name, NumPy type) of each property; the type of a list is "list"."""
    lists: dict[str, tuple[str, str]]
    """Name of a list property -> NumPy types of its length and of its items."""

    def dtype(self, order: str) -> np.dtype:
        """Type of a row without its lists, in a byte order of NumPy."""
        return np.dtype([(name, order + kind) for name, kind in self.fields if kind != "list"])


@dataclasses.dataclass(frozen=True)
class _Header:
    """The header of a .ply."""

    form: str
    """One of ORDERS."""
    elements: list[_Element]
    start: int
    """Offset of the first byte after the header."""


def _parse_header(data: memoryview) -> _Header:
    """Parses the header at the start of some bytes."""
    # The last line of a header, as Unix, Windows and old Macs end it.
    last = rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r|\Z)"
    end = re.search(last, data[: 1 << 24]) if data[:3] == b"ply" else None
    if end is None:
        raise ValueError("it has no .ply header" if len(data) else "the file is empty")
    form, elements = "", []
    for line in bytes(data[: end.start()]).decode("ascii", "replace").splitlines()[1:]:
        try:
            match line.split():
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", form, *_]:
                    pass
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name, int(count), [], {}))
                case ["property", "list", length, item, name]:
                    elements[-1].fields.append((name, "list"))
                    elements[-1].lists[name] = TYPES[length], TYPES[item]
                case ["property", kind, name]:
                    elements[-1].fields.append((name, TYPES[kind]))
                case _:
                    raise ValueError(line)
        except (IndexError, KeyError, ValueError) as error:
            raise ValueError(f"the header line {line.strip()!r} is not valid") from error
    if form not in ORDERS:
        raise ValueError(f"its format is {form!r}, expected one of {', '.join(ORDERS)}")
    return _Header(form, elements, end.end())


def read_ply_file(path: Path) -> tuple[memoryview, _Header]:
    """Maps a .ply into memory: all its bytes, and its header. Raises ValueError if it is none."""
    data = np.memmap(path, np.uint8, "r").data if path.stat().st_size else memoryview(b"")
    return data, _parse_header(data)


def read_vertices(path: Path) -> np.ndarray:
    """(N,) structured array of the vertices' properties; of a binary file, mapped into memory."""
    data, header = read_ply_file(path)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise ValueError(f"its elements are {', '.join(names) or 'missing'}, expected an element vertex")
    *before, vertices = header.elements[: names.index("vertex") + 1]
    if lists := [element.name for element in (*before, vertices) if element.lists]:
        raise ValueError(f"its element {lists[0]} has lists, expected lists behind the vertices only")
    dtype = vertices.dtype(ORDERS[header.form])
    if header.form == "ascii":
        first = sum(element.count for element in before)
        lines = [line for line in bytes(data[header.start :]).splitlines() if line.strip()][first:]
        rows = lines[: vertices.count]
        count = len(rows)
    else:
        offset = header.start + sum(element.count * element.dtype("<").itemsize for element in before)
        count = max(len(data) - offset, 0) // max(dtype.itemsize, 1)
    if count < vertices.count:
        raise ValueError(f"the file is cut short: it holds {count} of {vertices.count} vertices")
    if header.form != "ascii":
        return np.frombuffer(data, dtype, vertices.count, offset)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite numbers are refused by the caller
        return np.loadtxt(rows, dtype, comments=None, ndmin=1) if rows else np.empty(0, dtype)


@np.errstate(over="ignore", invalid="ignore")  # beyond float32: infinite, which every reader refuses
def _columns(vertices: np.ndarray, names: tuple[str, ...] | list[str], dtype: type = np.float32) -> np.ndarray:
    """(N, C) some properties of the vertices."""
    return np.array([vertices[name] for name in names], dtype).T


def read_ply(path: Path) -> Gaussians:
    """Reads Gaussians in INRIA's layout (graphdeco-inria/gaussian-splatting, gaussian_model.py), as NumPy arrays.

    The degree of the spherical harmonics follows from the number of f_rest properties (0, 9, 24, 45; channel-major).
    The means are float64 if the file has them so. Variants are read as the program that wrote them draws them:

    - 2D Gaussians (no scale_2, or -inf there) are flat.
    - Mip-Splatting's `filter_3D`, also in small letters, is fused into sizes and opacities (its create_fused_ply.py).
    - Colours red, green, blue of 8 bits replace f_dc (nerfstudio's --ply-color-mode rgb).

    Other properties and elements are ignored.
    """
    table = read_vertices(path)
    count, names = len(table), table.dtype.names or ()
    scales = SCALE if "scale_2" in names else SCALE[:2]
    has_rgb = not set(DC) & set(names) and all(name in names and table.dtype[name] == np.uint8 for name in _RGB)
    colours = _RGB if has_rgb else DC
    if missing := [name for name in (*POSITION, *colours, *OPACITY, *scales, *ROTATION) if name not in names]:
        layout = "3D Gaussians in INRIA's layout (x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3)"
        raise ValueError(f"its vertices have no {', '.join(missing)}, expected {layout}")
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{index}" for index in range(rest)]
    if rest not in (0, 9, 24, 45) or any(name not in names for name in rest_names):
        raise ValueError(f"its vertices have {rest} properties f_rest, expected 0, 9, 24 or 45 (degree 0 to 3)")
    filters = [name for name in names if name.lower() == "filter_3d"][:1]
    exact = all(np.can_cast(table.dtype[name], np.float32) for name in POSITION)
    means = np.empty((count, 3), np.float32 if exact else np.float64)
    log_scales, quaternions, logits = (np.empty((count, *shape), np.float32) for shape in ((3,), (4,), ()))
    sh = scratch_array((count, 1 + rest // 3, 3), np.float32)
    for first in range(0, count, BLOCK_ROWS):
        rows = slice(first, first + BLOCK_ROWS)
        vertices = table[rows]
        means[rows] = _columns(vertices, POSITION, means.dtype.type)
        log_scales[rows, 2] = -np.inf
        log_scales[rows, : len(scales)] = _columns(vertices, scales)
        quaternions[rows] = _columns(vertices, ROTATION)
        logits[rows] = _columns(vertices, OPACITY)[:, 0]
        first_band = _columns(vertices, colours)
        sh[rows, 0] = (first_band / 255 - 0.5) / C0 if has_rgb else first_band
        sh[rows, 1:] = _columns(vertices, rest_names).reshape(len(vertices), 3, rest // 3).transpose(0, 2, 1)
        if filters:
            _fuse_filter(log_scales[rows], logits[rows], _columns(vertices, filters)[:, 0])
    return Gaussians(means, log_scales, quaternions, logits, sh)


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def _fuse_filter(log_scales: np.ndarray, logits: np.ndarray, deviation: np.ndarray) -> None:
    """Widens Gaussians, in place, by a filter with standard deviations (M,).

    Sizes become sqrt(s^2 + f^2), opacities shrink by the ratio of the volumes (Mip-Splatting,
    get_opacity_with_3D_filter).
    """
    if not (np.isfinite(deviation) & (deviation >= 0)).all():
        raise ValueError("numbers of filter_3D are negative or not finite")
    before = log_scales.astype(np.float64)
    after = 0.5 * np.logaddexp(2 * before, 2 * np.log(deviation.astype(np.float64))[:, None])
    shrink = np.exp(np.where(after == before, 0.0, before - after).sum(axis=1))
    opacity = shrink / (1 + np.exp(-logits.astype(np.float64)))
    log_scales[:] = after
    logits[:] = np.log(opacity) - np.log1p(-opacity)


def require_drawable(path: str | Path, gaussians: Gaussians, first: int, remedy: str) -> None:
    """Raises InputError if a Gaussian, counted from `first`, cannot be drawn."""
    for name, array in vars(gaussians).items():
        rows = unusable_rows(name, array)
        if rows.any():
            state = "not finite or zero" if name == "quaternions" else "not finite"
            problem = (
                f"{name} of {rows.sum()} of {len(rows)} Gaussians are {state} (the first: {first + rows.argmax()})"
            )
            raise InputError(path, problem, remedy=remedy)
