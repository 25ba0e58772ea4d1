"""Gaussians and point clouds as .ply files, on the host.

The container is read whatever its properties: text or binary, either byte order, lists (http://paulbourke.net/
dataformats/ply). The package plyfile is not used: it is under GPLv3+ and jsecon under Apache-2.0. Gaussians have the
layout of INRIA's 3D Gaussian Splatting and its relatives.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from jsecon.errors import InputError, require_shape
from jsecon.files import atomic_write, reading
from jsecon.numerics import is_finite_and_bounded
from jsecon.splat.project import check_gaussians, unusable_rows
from jsecon.splat.sh import C0
from jsecon.splat.transform import BLOCK_ROWS, float32_rounding, transform_blocks
from jsecon.types import Array, Gaussians

ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""format of a .ply -> NumPy's byte order"""
_TYPES = dict(char="i1", uchar="u1", short="i2", ushort="u2", int="i4", uint="u4", float="f4", double="f8")
_TYPES |= {np.dtype(kind).name: kind for kind in _TYPES.values()}
"""a property's type, by its old name or with its size (uchar, uint8) -> NumPy's"""
_POSITION, _OPACITY, _RGB = ("x", "y", "z"), ("opacity",), ("red", "green", "blue")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_SIZES = {"means": 3, "log_scales": 3, "quaternions": 4}


def _error(path: Path, problem: str, expected: str = "", remedy: str = "Export the file again.") -> InputError:
    """The error of a .ply that cannot be read."""
    return InputError(path, problem, expected, remedy)


@dataclasses.dataclass
class _Element:
    """An element of a .ply."""

    name: str
    count: int
    fields: list[tuple[str, str]]
    """(name, NumPy type) of each property; the type of a list is "list"."""
    lists: dict[str, tuple[str, str]]
    """Name of a list property -> NumPy types of its length and of its items."""

    @property
    def fixed(self) -> bool:
        """Whether all rows have one length: no property is a list."""
        return not self.lists

    def dtype(self, order: str) -> np.dtype:
        """Type of a row without its lists, in a byte order of NumPy."""
        return np.dtype([(name, order + kind) for name, kind in self.fields if kind != "list"])


@dataclasses.dataclass(frozen=True)
class Header:
    """The header of a .ply."""

    form: str
    """One of ORDERS."""
    elements: list[_Element]
    comments: tuple[str, ...]
    start: int
    """Offset of the first byte after the header."""


def _parse_header(path: Path, data: memoryview) -> Header:
    """Parses the header at the start of some bytes."""
    # The last line of a header, as Unix, Windows and old Macs end it.
    last = rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r|\Z)"
    end = re.search(last, data[: 1 << 24]) if data[:3] == b"ply" else None
    if end is None:
        problem = "it has no .ply header" if len(data) else "the file is empty"
        raise _error(path, problem, "a file that starts with 'ply' and a header")
    form, elements, comments = "", [], []
    for line in bytes(data[: end.start()]).decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            if not words:
                continue
            if words[0] in ("comment", "obj_info"):
                comments.append(line.strip().partition(" ")[2].strip())
            elif words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), [], {}))
                if elements[-1].count < 0:
                    raise ValueError(words[2])
            elif words[0] == "property" and words[1] == "list":
                elements[-1].fields.append((words[4], "list"))
                elements[-1].lists[words[4]] = _TYPES[words[2]], _TYPES[words[3]]
            elif words[0] == "property":
                elements[-1].fields.append((words[2], _TYPES[words[1]]))
            else:
                raise ValueError(words[0])
        except (IndexError, KeyError, ValueError) as error:
            raise _error(path, f"the header line {line.strip()!r} is not valid") from error
    if form not in ORDERS:
        raise _error(path, f"its format is {form!r}", f"one of {', '.join(ORDERS)}")
    return Header(form, elements, tuple(comments), end.end())


def read_ply_file(path: Path) -> tuple[memoryview, Header]:
    """Maps a .ply into memory: all its bytes, and its header."""
    data = np.memmap(path, np.uint8, "r").data if path.stat().st_size else memoryview(b"")
    return data, _parse_header(path, data)


def _read_vertices(path: Path) -> np.ndarray:
    """(N,) structured array of the vertices' properties; of a binary file, mapped into memory."""
    data, header = read_ply_file(path)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise _error(path, f"its elements are {', '.join(names) or 'missing'}", "an element vertex")
    *before, vertices = header.elements[: names.index("vertex") + 1]
    if lists := [element.name for element in (*before, vertices) if not element.fixed]:
        raise _error(path, f"its element {lists[0]} has lists", "lists behind the vertices only")
    if header.form == "ascii":
        lines = [line for line in bytes(data[header.start :]).splitlines() if line.strip()]
        first = sum(element.count for element in before)
        return _parse_text(path, lines[first : first + vertices.count], vertices)
    order = ORDERS[header.form]
    dtype = vertices.dtype(order)
    offset = header.start + sum(element.count * element.dtype(order).itemsize for element in before)
    if offset + vertices.count * dtype.itemsize > len(data):
        raise _truncated(path, (len(data) - offset) // dtype.itemsize, vertices)
    return np.frombuffer(data, dtype, vertices.count, offset)


def _truncated(path: Path, count: int, vertices: _Element) -> InputError:
    """The error of a file that ends before the last vertex."""
    return _error(path, f"the file is cut short: it holds {max(count, 0)} of {vertices.count} vertices")


def _parse_text(path: Path, lines: list[bytes], vertices: _Element) -> np.ndarray:
    """Parses the lines of the vertices of a text file."""
    names = [name for name, _ in vertices.fields]
    try:
        numbers = np.array([line.split() for line in lines], np.float64).reshape(len(lines), len(names))
    except ValueError as error:
        problem = f"a vertex line does not have {len(names)} numbers, or the file is cut short"
        raise _error(path, problem) from error
    if len(lines) < vertices.count:
        raise _truncated(path, len(lines), vertices)
    result = np.empty(vertices.count, vertices.dtype("="))
    for column, name in enumerate(names):
        with np.errstate(over="ignore", invalid="ignore"):  # infinite numbers are refused by the caller
            result[name] = numbers[:, column]
    return result


@np.errstate(over="ignore", invalid="ignore")  # beyond float32: infinite, which every reader refuses
def _columns(vertices: np.ndarray, names: tuple[str, ...] | list[str], dtype: type = np.float32) -> np.ndarray:
    """(N, C) some properties of the vertices."""
    fields = vertices.dtype.names or ()
    if len({vertices.dtype[name] for name in fields}) == 1:
        # One type throughout, as in nearly every file: a plain table, read along its rows (twice as fast).
        table = vertices.view(vertices.dtype[0]).reshape(len(vertices), len(fields))
        return table[:, [fields.index(name) for name in names]].astype(dtype)
    result = np.empty((len(vertices), len(names)), dtype)
    for column, name in enumerate(names):
        result[:, column] = vertices[name]
    return result


def read_ply(path: Path) -> Gaussians:
    """Reads Gaussians in INRIA's layout (graphdeco-inria/gaussian-splatting, gaussian_model.py), as NumPy arrays.

    The degree of the spherical harmonics follows from the number of f_rest properties (0, 9, 24, 45; channel-major).
    The means are float64 if the file has them so. Variants are read as the program that wrote them draws them:

    - 2D Gaussians (no scale_2, or -inf there) are flat.
    - Mip-Splatting's `filter_3D` is fused into sizes and opacities, as by its create_fused_ply.py.
    - Colours red, green, blue of 8 bits replace f_dc (nerfstudio's --ply-color-mode rgb).

    Other properties and elements are ignored.
    """
    table = _read_vertices(path)
    count, names = len(table), table.dtype.names or ()
    scales = _SCALE if "scale_2" in names else _SCALE[:2]
    has_rgb = not set(_DC) & set(names) and all(name in names and table.dtype[name] == np.uint8 for name in _RGB)
    colours = _RGB if has_rgb else _DC
    if missing := [name for name in (*_POSITION, *colours, *_OPACITY, *scales, *_ROTATION) if name not in names]:
        expected = "3D Gaussians in INRIA's layout (x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3)"
        remedy = "A plain point cloud is not enough: export the trained Gaussians as an uncompressed .ply."
        raise _error(path, f"its vertices have no {', '.join(missing)}", expected, remedy)
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{index}" for index in range(rest)]
    if rest not in (0, 9, 24, 45) or any(name not in names for name in rest_names):
        expected = "0, 9, 24 or 45 of them, counted from f_rest_0 (spherical harmonics of degree 0 to 3)"
        remedy = "Export the file again, with harmonics of degree 3 or less."
        raise _error(path, f"its vertices have {rest} properties f_rest", expected, remedy)
    exact = all(np.can_cast(table.dtype[name], np.float32) for name in _POSITION)
    arrays: dict[str, np.ndarray] = {name: np.empty((count, size), np.float32) for name, size in _SIZES.items()}
    arrays["means"] = np.empty((count, 3), np.float32 if exact else np.float64)
    arrays["opacity_logits"] = np.empty(count, np.float32)
    arrays["sh"] = np.empty((count, 1 + rest // 3, 3), np.float32)
    for first in range(0, count, BLOCK_ROWS):
        rows = slice(first, first + BLOCK_ROWS)
        vertices = table[rows]
        arrays["means"][rows] = _columns(vertices, _POSITION, arrays["means"].dtype.type)
        arrays["log_scales"][rows, 2] = -np.inf
        arrays["log_scales"][rows, : len(scales)] = _columns(vertices, scales)
        arrays["quaternions"][rows] = _columns(vertices, _ROTATION)
        arrays["opacity_logits"][rows] = _columns(vertices, _OPACITY)[:, 0]
        first_band = _columns(vertices, colours)
        arrays["sh"][rows, 0] = (first_band / 255 - 0.5) / C0 if has_rgb else first_band
        others = _columns(vertices, rest_names).reshape(len(vertices), 3, rest // 3)
        arrays["sh"][rows, 1:] = others.transpose(0, 2, 1)
        if "filter_3D" in names:
            block = {name: array[rows] for name, array in arrays.items()}
            _fuse_filter(path, block, _columns(vertices, ["filter_3D"])[:, 0])
    return drawable_gaussians(path, arrays)


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def _fuse_filter(path: Path, arrays: dict[str, np.ndarray], deviation: np.ndarray) -> None:
    """Widens Gaussians, in place, by a filter with standard deviations (M,).

    Sizes become sqrt(s^2 + f^2), opacities shrink by the ratio of the volumes (Mip-Splatting,
    get_opacity_with_3D_filter).
    """
    if not (np.isfinite(deviation) & (deviation >= 0)).all():
        problem = "numbers of filter_3D are negative or not finite"
        raise _error(path, problem, "standard deviations", "Train again.")
    before = arrays["log_scales"].astype(np.float64)
    after = 0.5 * np.logaddexp(2 * before, 2 * np.log(deviation.astype(np.float64))[:, None])
    shrink = np.exp(np.where(after == before, 0.0, before - after).sum(axis=1))
    opacity = shrink / (1 + np.exp(-arrays["opacity_logits"].astype(np.float64)))
    arrays["log_scales"][:] = after
    arrays["opacity_logits"][:] = np.log(opacity) - np.log1p(-opacity)


def drawable_gaussians(path: Path, arrays: Mapping[str, np.ndarray]) -> Gaussians:
    """Makes Gaussians of NumPy arrays of a file, by the names of their fields; refuses numbers that cannot be drawn."""
    _require_drawable(path, arrays, 0, "Remove these Gaussians (SuperSplat drops them on loading), or train again.")
    return Gaussians(**arrays)


def usable_blocks(
    path: str | Path, gaussians: Gaussians, similarity: Float[Array, "4 4"] | None
) -> Iterator[tuple[slice, Gaussians]]:
    """Yields the rows of a block, and its Gaussians in the (4, 4) transformed world of the file that is written.

    The Gaussians may be memory-mapped. A Gaussian that cannot be drawn is an error: `load_gaussians` would refuse it.
    """
    check_gaussians(gaussians)
    for rows, block in transform_blocks(gaussians, similarity):
        columns = {name: getattr(block, name) for name in (*_SIZES, "opacity_logits", "sh")}
        _require_drawable(path, columns, rows.start, "Remove these Gaussians first.")
        yield rows, block


def _require_drawable(path: str | Path, arrays: Mapping[str, np.ndarray], first: int, remedy: str) -> None:
    """Raises InputError if a Gaussian, counted from `first`, cannot be drawn."""
    for name, array in arrays.items():
        rows = unusable_rows(name, array)
        if rows.any():
            state = "not finite or zero" if name == "quaternions" else "not finite"
            example = f"(the first: {first + rows.argmax()})"
            problem = f"{name} of {rows.sum()} of {len(rows)} Gaussians are {state} {example}"
            raise InputError(path, problem, remedy=remedy)


def save_ply(
    path: str | Path,
    gaussians: Gaussians,
    *,
    object_ids: Int[Array, " n"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians in INRIA's layout: binary little endian float32, normals zero, f_rest channel-major.

    Float32 Gaussians come back bit by bit. Positions are written in float64 if float32 would not hold them (coordinates
    of a map projection). Object ids are a further property, int32, which other readers skip.
    """
    check_gaussians(gaussians)
    if object_ids is not None:
        require_shape("object_ids", object_ids, (gaussians.count,), "Give one id per Gaussian.")
    rest_names = (f"f_rest_{index}" for index in range(3 * (gaussians.sh.shape[1] - 1)))
    names = (*_POSITION, "nx", "ny", "nz", *_DC, *rest_names, *_OPACITY, *_SCALE, *_ROTATION)
    is_double = needs_float64(gaussians, similarity)
    kinds = ("double" if is_double and name in _POSITION else "float" for name in names)
    properties = [f"property {kind} {name}" for kind, name in zip(kinds, names)]
    properties += [] if object_ids is None else ["property int object_id"]
    vertices = f"element vertex {gaussians.count}"
    header = ["ply", "format binary_little_endian 1.0", vertices, *properties, "end_header\n"]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for rows, block in usable_blocks(path, gaussians, similarity):
            ids = None if object_ids is None else np.asarray(object_ids[rows])
            file.write(_table(block, is_double, ids).tobytes())  # tofile hides a full disk


def needs_float64(gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None) -> bool:
    """Whether float32 would round centres by over 0.02 of the largest standard deviation of 1 in 100 Gaussians.

    `similarity` is applied first. False for float32 centres without it.
    """
    if similarity is None and gaussians.means.dtype != np.float64:
        return False
    bare = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    far = sum(int((float32_rounding(block) > 0.02).sum()) for _, block in transform_blocks(bare, similarity))
    return far > 0.01 * gaussians.count


def _table(block: Gaussians, is_double: bool, object_ids: np.ndarray | None) -> np.ndarray:
    """The rows of a file."""
    sh = np.asarray(block.sh, np.float32)
    count = len(sh)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (sh.shape[1] - 1))
    normals, opacity = np.zeros((count, 3)), np.asarray(block.opacity_logits)[:, None]
    columns = [normals, sh[:, 0], rest, opacity, block.log_scales, block.quaternions]
    others = np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1)
    last = [] if object_ids is None else [("object_id", "<i4")]
    kinds = [("means", "<f8" if is_double else "<f4", 3), ("others", "<f4", others.shape[1]), *last]
    rows = np.empty(count, kinds)
    rows["means"], rows["others"] = block.means, others
    if object_ids is not None:
        rows["object_id"] = object_ids
    return rows


def load_point_cloud(path: str | Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Reads a plain point cloud (.ply): (P, 3) float64 points and uint8 colours, grey if the file has none.

    Colours red green blue are whole numbers of 8 or 16 bits, or floats from 0 to 1.
    """
    path = Path(path)
    with reading(path, remedy="Export the file again."):
        vertices = _read_vertices(path)
    names = vertices.dtype.names or ()
    if missing := [name for name in _POSITION if name not in names]:
        raise _error(path, f"its vertices have no {', '.join(missing)}", "a point cloud with x y z")
    points = _columns(vertices, _POSITION, np.float64)
    if not is_finite_and_bounded(points):
        raise _error(path, "its points have NaN, infinite or absurd coordinates")
    if not all(name in names for name in _RGB):
        return points, np.full((len(points), 3), 128, np.uint8)
    kind = vertices.dtype["red"]
    brightest = np.iinfo(kind).max if kind.kind in "iu" else 1.0
    colours = np.nan_to_num(_columns(vertices, _RGB, np.float64))
    return points, np.clip(colours * (255 / brightest), 0, 255).round().astype(np.uint8)
