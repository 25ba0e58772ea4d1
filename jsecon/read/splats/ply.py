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

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from jsecon.errors import InputError, describe_error, require_shape
from jsecon.files import atomic_write
from jsecon.numerics import is_finite_and_bounded
from jsecon.splat.project import check_gaussians, unusable_rows
from jsecon.splat.sh import C0
from jsecon.splat.transform import float32_rounding, transform_blocks, transform_gaussians_float64
from jsecon.types import Array, Gaussians

ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""format of a .ply -> NumPy's byte order"""
GREY = 128
"""colour of points without one"""
MAX_WRITE_ROUNDING, MAX_READ_ROUNDING = 0.02, 0.25
"""Rounding of a Gaussian's centre by float32, relative to its largest standard deviation: above the first, centres are
written in float64; above the second, a file is not read."""
_TYPE_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}
_TYPES = {name: kind for kind, old in (_TYPE_NAMES | {"f8": "double"}).items() for name in (old, np.dtype(kind).name)}
"""a property's type, by its old name or with its size (uchar, uint8) -> NumPy's"""
_END = re.compile(rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r|\Z)")
"""last line of a header, as Unix, Windows and old Macs end it"""
_MAX_HEADER = 1 << 24
"""bytes searched for the end of a header"""
_BLOCK = 1 << 18
"""Gaussians that are converted at a time"""
_POSITION, _OPACITY, _RGB = ("x", "y", "z"), ("opacity",), ("red", "green", "blue")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_FILTERS = ("filter_3D", "filter_3d")
"""standard deviation of Mip-Splatting's 3D filter, world units: of its own training, and of other programs"""
_SIZES = {"means": 3, "log_scales": 3, "quaternions": 4}
_REST_COUNTS = (0, 9, 24, 45)
_LAYOUT = "3D Gaussians in INRIA's layout (x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3)"


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

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties that are not lists."""
        return tuple(name for name, kind in self.fields if kind != "list")

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

    @property
    def is_compressed(self) -> bool:
        """Whether the vertices are packed as in SuperSplat's compressed .ply."""
        return any(name == "packed_position" for element in self.elements for name, _ in element.fields)


def _parse_header(path: Path, data: memoryview) -> Header:
    """Parses the header at the start of some bytes."""
    end = _END.search(data[:_MAX_HEADER]) if data[:3] == b"ply" else None
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
    for element in elements:
        if len({name for name, _ in element.fields}) < len(element.fields):
            raise _error(path, f"its element {element.name} has two properties of one name")
    return Header(form, elements, tuple(comments), end.end())


def read_ply_file(path: Path) -> tuple[memoryview, Header]:
    """Maps a .ply into memory, and parses its header.

    Args:
      path: The file.

    Returns:
      All its bytes, and its header.

    Raises:
      InputError: It is not a .ply.
    """
    try:
        data = np.memmap(path, np.uint8, "r").data if path.stat().st_size else memoryview(b"")
    except OSError as error:
        raise _error(path, describe_error(error), remedy="Check the path.") from error
    return data, _parse_header(path, data)


def _read_vertices(path: Path) -> np.ndarray:
    """(N,) structured array of the vertices' properties that are not lists; of a binary file, mapped into memory."""
    header = read_ply_file(path)[1]
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise _error(path, f"its elements are {', '.join(names) or 'missing'}", "an element vertex")
    if header.is_compressed:
        remedy = f"Read it with jsecon.load_gaussians, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
        raise _error(path, "it is compressed (SuperSplat's packed chunks)", remedy=remedy)
    if not header.elements[names.index("vertex")].names:
        raise _error(path, "its element vertex has no properties", "x y z and more")
    return read_elements(path, "vertex")["vertex"]


def read_elements(path: Path, only: str = "") -> dict[str, np.ndarray]:
    """Reads the elements of a .ply.

    Args:
      path: The file.
      only: Name of the only element to read; "" reads all.

    Returns:
      By element a structured array of the properties that are not lists.

    Raises:
      InputError: The file is not a .ply, or is truncated.
    """
    data, header = read_ply_file(path)
    tables, order = {}, ORDERS[header.form]
    lines, position = [], header.start
    if header.form == "ascii":
        lines, position = [line for line in bytes(data[header.start :]).splitlines() if line.strip()], 0
    for element in header.elements:
        if header.form != "ascii":
            tables[element.name], position = _parse_rows(path, data, position, element, order)
        else:
            if only in ("", element.name):
                tables[element.name] = _parse_text(path, lines[position : position + element.count], element)
            position += element.count
        if only == element.name:
            break
    return tables


def _parse_rows(path: Path, data: memoryview, offset: int, element: _Element, order: str) -> tuple[np.ndarray, int]:
    """Returns the rows of a binary element without their lists, and the offset of their end."""
    dtype = element.dtype(order)
    if element.fixed:
        end = offset + element.count * dtype.itemsize
        if end > len(data):
            raise _truncated(path, (len(data) - offset) // max(dtype.itemsize, 1), element)
        return np.frombuffer(data, dtype, element.count, offset) if dtype.itemsize else np.empty(0, dtype), end
    fixed_parts = bytearray()
    for row in range(element.count):
        for name, kind in element.fields:
            if kind != "list":
                size = np.dtype(kind).itemsize
                fixed_parts += data[offset : offset + size]
            else:
                length, item = (np.dtype(order + part) for part in element.lists[name])
                if offset + length.itemsize > len(data):
                    raise _truncated(path, row, element)
                count = int(np.frombuffer(data, length, 1, offset)[0])
                if count < 0:
                    raise _error(path, f"a list of its element {element.name} has a length of {count}")
                size = length.itemsize + count * item.itemsize
            offset += size
            if offset > len(data):
                raise _truncated(path, row, element)
    return np.frombuffer(bytes(fixed_parts), dtype), offset


def _truncated(path: Path, there: int, element: _Element) -> InputError:
    """The error of a file that ends before the last row of an element."""
    rows = "vertices" if element.name == "vertex" else f"rows of its element {element.name}"
    return _error(path, f"the file is cut short: it holds {max(there, 0)} of {element.count} {rows}")


def _parse_text(path: Path, lines: list[bytes], element: _Element) -> np.ndarray:
    """Parses the lines of an element of a text file."""
    rows = [line.split() for line in lines]
    try:
        if not element.fixed:
            rows = [_without_lists(row, element) for row in rows]
        numbers = np.array(rows, np.float64).reshape(len(rows), len(element.names))
    except (ValueError, IndexError) as error:
        problem = f"a {element.name} line does not have {len(element.names)} numbers, or the file is cut short"
        raise _error(path, problem) from error
    if len(lines) < element.count:
        raise _truncated(path, len(lines), element)
    result = np.empty(element.count, element.dtype("="))
    for column, name in enumerate(element.names):
        kind = result.dtype[name]
        with np.errstate(over="ignore", invalid="ignore"):  # checked below, and infinite numbers by the caller
            result[name] = numbers[:, column]
        if kind.kind != "f" and (result[name] != numbers[:, column]).any():
            raise _error(path, f"numbers of {name} do not fit its type {kind.name}")
    return result


def _without_lists(words: list[bytes], element: _Element) -> list[bytes]:
    """The words of a line that are not part of a list."""
    kept, position = [], 0
    for _, kind in element.fields:
        if kind == "list":
            position += 1 + int(words[position])
        else:
            kept.append(words[position])
            position += 1
    return kept


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


def load_ply(path: str | Path, *, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Reads Gaussians from a .ply in INRIA's layout (graphdeco-inria/gaussian-splatting, gaussian_model.py).

    The degree of the spherical harmonics follows from the number of f_rest properties (0, 9, 24, 45; channel-major).
    Variants are read as the program that wrote them draws them:

    - 2D Gaussians (no scale_2, or -inf there) are flat.
    - Mip-Splatting's `filter_3D` is fused into sizes and opacities, as by its create_fused_ply.py.
    - Colours red, green, blue replace f_dc (nerfstudio's --ply-color-mode rgb): whole numbers of 8 or 16 bits, or
      floats (0..1, or 0..255 if any is above 1).

    Other properties and elements are ignored.

    Args:
      path: The file.
      similarity: (4, 4) float64, see `load_gaussians`.

    Returns:
      Its Gaussians, float32; N may be 0.

    Raises:
      InputError: The file is compressed or truncated, a property is missing, a number cannot be drawn (NaN, infinite
        other than log scales of -inf and opacity logits, a zero quaternion), or float32 does not hold the positions.
    """
    path = Path(path)
    return in_float32(path, read_ply(path), similarity)


def read_ply(path: Path) -> Gaussians:
    """Reads Gaussians as `load_ply` does, as NumPy arrays.

    Args:
      path: The file.

    Returns:
      Its Gaussians; the means are float64 if the file has them finer than float32.

    Raises:
      InputError: As in `load_ply`.
    """
    table = _read_vertices(path)
    count, names = len(table), table.dtype.names or ()
    scales = _SCALE if "scale_2" in names else _SCALE[:2]
    has_rgb = all(name in names for name in _RGB) and not any(name in names for name in _DC)
    colours = _RGB if has_rgb else _DC
    if missing := [name for name in (*_POSITION, *colours, *_OPACITY, *scales, *_ROTATION) if name not in names]:
        remedy = "A plain point cloud is not enough: export the trained Gaussians as an uncompressed .ply."
        raise _error(path, f"its vertices have no {', '.join(missing)}", _LAYOUT, remedy)
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{index}" for index in range(rest)]
    if rest not in _REST_COUNTS or any(name not in names for name in rest_names):
        expected = "0, 9, 24 or 45 of them, counted from f_rest_0 (spherical harmonics of degree 0 to 3)"
        remedy = "Export the file again, with harmonics of degree 3 or less."
        raise _error(path, f"its vertices have {rest} properties f_rest", expected, remedy)
    filters = [name for name in _FILTERS if name in names][:1]
    exact = all(np.can_cast(table.dtype[name], np.float32) for name in _POSITION)
    arrays: dict[str, np.ndarray] = {name: np.empty((count, size), np.float32) for name, size in _SIZES.items()}
    arrays["means"] = np.empty((count, 3), np.float32 if exact else np.float64)
    arrays["opacity_logits"] = np.empty(count, np.float32)
    arrays["sh"] = np.empty((count, 1 + rest // 3, 3), np.float32)
    brightest = 1.0
    for first in range(0, count, _BLOCK):
        rows = slice(first, first + _BLOCK)
        vertices = table[rows]
        arrays["means"][rows] = _columns(vertices, _POSITION, arrays["means"].dtype.type)
        arrays["log_scales"][rows, 2] = -np.inf
        arrays["log_scales"][rows, : len(scales)] = _columns(vertices, scales)
        arrays["quaternions"][rows] = _columns(vertices, _ROTATION)
        arrays["opacity_logits"][rows] = _columns(vertices, _OPACITY)[:, 0]
        arrays["sh"][rows, 0] = _columns(vertices, colours)
        others = _columns(vertices, rest_names).reshape(len(vertices), 3, rest // 3)
        arrays["sh"][rows, 1:] = others.transpose(0, 2, 1)
        if filters:
            block = {name: array[rows] for name, array in arrays.items()}
            _fuse_filter(path, block, _columns(vertices, filters)[:, 0])
        if has_rgb:
            brightest = max(brightest, _brightest(vertices))
    if has_rgb:
        arrays["sh"][:, 0] = (arrays["sh"][:, 0].astype(np.float64) / brightest - 0.5) / C0
    return drawable_gaussians(path, arrays)


def _brightest(vertices: np.ndarray) -> float:
    """The number of the brightest red, green or blue; for floats, it follows from the vertices."""
    kinds = [vertices.dtype[name] for name in _RGB]
    if all(kind.kind == "f" for kind in kinds):
        return 255.0 if max(np.nanmax(vertices[name], initial=0) for name in _RGB) > 1 else 1.0
    return 65535.0 if max(kind.itemsize for kind in kinds) == 2 else 255.0


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
    """Makes Gaussians of the arrays of a file.

    Args:
      path: The file, for errors.
      arrays: NumPy arrays of the fields of `Gaussians`.

    Returns:
      Gaussians of these arrays.

    Raises:
      InputError: A Gaussian cannot be drawn (`unusable_rows`).
    """
    _require_drawable(path, arrays, 0, "Remove these Gaussians (SuperSplat drops them on loading), or train again.")
    return Gaussians(**arrays)


def in_float32(path: Path, gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Puts the Gaussians of a file on jax's device.

    Args:
      path: The file, for errors.
      gaussians: NumPy arrays.
      similarity: (4, 4) transform into another world, applied in float64 first.

    Returns:
      The Gaussians, float32.

    Raises:
      InputError: Float32 does not hold the positions.
    """
    if similarity is not None:
        gaussians = transform_gaussians_float64(gaussians, similarity)
    rounding = float32_rounding(gaussians)
    if len(rounding) and np.median(rounding) > MAX_READ_ROUNDING:
        place = ", ".join(f"{number:.10g}" for number in np.median(gaussians.means, axis=0))
        remedy = (
            "Give load_gaussians a similarity that brings them near 0, as numpy.linalg.inv(capture.source_from_scene)."
        )
        problem = f"the Gaussians lie about ({place}), where float32 does not tell them apart"
        raise _error(path, problem, remedy=remedy)
    return jax.tree.map(jnp.asarray, gaussians)


def usable_blocks(
    path: str | Path, gaussians: Gaussians, similarity: Float[Array, "4 4"] | None
) -> Iterator[tuple[slice, Gaussians]]:
    """Yields Gaussians in blocks for writing.

    Args:
      path: The file that is written, for errors.
      gaussians: N Gaussians; may be memory-mapped.
      similarity: (4, 4) transform into the world of the file, or None.

    Yields:
      The rows of a block, and its transformed Gaussians.

    Raises:
      ValueError: Shapes disagree.
      InputError: A Gaussian cannot be drawn: `load_gaussians` would refuse the file.
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
    rgb: Float[Array, "n 3"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
    object_ids: Int[Array, " n"] | None = None,
) -> None:
    """Writes Gaussians in INRIA's layout: binary little endian float32, normals zero, f_rest channel-major.

    Float32 Gaussians come back bit by bit from `load_ply`. Positions are written in float64 if float32 would not hold
    them (coordinates of a map projection). The file is written in blocks: memory-mapped arrays need not fit into
    memory.

    Args:
      path: The file.
      gaussians: N Gaussians.
      rgb: (N, 3) in 0..1, one colour a Gaussian instead of its spherical harmonics, to show codes or similarities.
      similarity: (4, 4) transform into the world of the file.
      object_ids: (N,) written as a further property `object_id`, int32, which other readers skip.

    Raises:
      ValueError: Shapes disagree.
      InputError: A Gaussian cannot be drawn, or the folder cannot be written.
    """
    check_gaussians(gaussians)
    count = gaussians.count
    if object_ids is not None:
        require_shape("object_ids", object_ids, (count,), "Give one id per Gaussian.")
    if rgb is not None:
        require_shape("rgb", rgb, (count, 3), "Give one colour per Gaussian.")
    rest_names = (f"f_rest_{index}" for index in range(0 if rgb is not None else 3 * (gaussians.sh.shape[1] - 1)))
    names = (*_POSITION, "nx", "ny", "nz", *_DC, *rest_names, *_OPACITY, *_SCALE, *_ROTATION)
    double = needs_float64(gaussians, similarity)
    kinds = ("double" if double and name in _POSITION else "float" for name in names)
    properties = [f"property {kind} {name}" for kind, name in zip(kinds, names)]
    properties += [] if object_ids is None else ["property int object_id"]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header\n"]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for rows, block in usable_blocks(path, gaussians, similarity):
            sh = block.sh if rgb is None else ((np.asarray(rgb[rows], np.float64) - 0.5) / C0)[:, None]
            ids = None if object_ids is None else np.asarray(object_ids[rows])
            file.write(_table(block, np.asarray(sh, np.float32), double, ids).tobytes())  # tofile hides a full disk


def needs_float64(gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None) -> bool:
    """Whether float32 would round centres by more than MAX_WRITE_ROUNDING of the size of more than 1 in 100 Gaussians.

    Args:
      gaussians: N Gaussians; may be memory-mapped.
      similarity: (4, 4) transform that is applied first; None is the identity.

    Returns:
      False for float32 centres without a transform.
    """
    if similarity is None and gaussians.means.dtype != np.float64:
        return False
    bare = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    far = sum(
        int((float32_rounding(block) > MAX_WRITE_ROUNDING).sum()) for _, block in transform_blocks(bare, similarity)
    )
    return far > 0.01 * gaussians.count


def _table(block: Gaussians, sh: np.ndarray, double: bool, object_ids: np.ndarray | None = None) -> np.ndarray:
    """The rows of a file."""
    count = len(sh)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (sh.shape[1] - 1))
    normals, opacity = np.zeros((count, 3)), np.asarray(block.opacity_logits)[:, None]
    columns = [block.means, normals, sh[:, 0], rest, opacity, block.log_scales, block.quaternions]
    table = np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1).astype("<f4", copy=False)
    if not double and object_ids is None:
        return table
    last = [] if object_ids is None else [("object_id", "<i4")]
    rows = np.empty(count, [("means", "<f8" if double else "<f4", 3), ("others", "<f4", table.shape[1] - 3), *last])
    rows["means"], rows["others"] = block.means, table[:, 3:]
    if object_ids is not None:
        rows["object_id"] = object_ids
    return rows


def load_point_cloud(path: str | Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Reads a plain point cloud (nerfstudio's ply_file_path).

    Args:
      path: A .ply. Colours red green blue have 8 or 16 bits, or are floats (0..1, or 0..255 if any is above 1).

    Returns:
      (P, 3) float64 points, and (P, 3) uint8 colours, GREY if the file has none.

    Raises:
      InputError: The file is damaged, or has no x y z.
    """
    path = Path(path)
    vertices = _read_vertices(path)
    names = vertices.dtype.names or ()
    if missing := [name for name in _POSITION if name not in names]:
        raise _error(path, f"its vertices have no {', '.join(missing)}", "a point cloud with x y z")
    points = _columns(vertices, _POSITION, np.float64)
    if not is_finite_and_bounded(points):
        raise _error(path, "its points have NaN, infinite or absurd coordinates")
    if not all(name in names for name in _RGB):
        return points, np.full((len(points), 3), GREY, np.uint8)
    colours = np.stack([np.nan_to_num(vertices[name].astype(np.float64)) for name in _RGB], axis=-1)
    return points, np.clip(colours * (255 / _brightest(vertices)), 0, 255).round().astype(np.uint8)
