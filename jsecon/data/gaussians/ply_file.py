"""The elements vertex and face of a .ply file (ascii or binary), whatever their properties.

Format: http://paulbourke.net/dataformats/ply. SuperSplat's compressed variant is told apart and refused.
Read here, since the package plyfile is under GPLv3+ and jsecon under Apache-2.0.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jsecon.errors import InputError, describe_error

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}
TYPES = {name: kind for kind, old in (_NAMES | {"f8": "double"}).items() for name in (old, np.dtype(kind).name)}
"""a property's type, by its old name or with its size (uchar, uint8) -> NumPy's"""
_LONGEST = 1 << 24
"""bytes in which a header's end is looked for"""
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


_END = re.compile(rb"[\r\n]end_header[ \t]*(?:\r\n|\n|\r|\Z)")
"""the last line of a header: as Unix, Windows and old Macs end it"""


@dataclasses.dataclass
class Element:
    """An element of a .ply."""

    name: str
    count: int
    fields: list[tuple[str, str]]
    """(name, NumPy type); "list" for a list property."""
    lists: dict[str, tuple[str, str]]
    """name of a list property -> NumPy types of its length and of its numbers."""

    @property
    def fixed(self) -> bool:
        """Whether all rows are of one length: no property is a list."""
        return all(kind != "list" for _, kind in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties that are no lists."""
        return tuple(name for name, kind in self.fields if kind != "list")

    def dtype(self, order: str) -> np.dtype:
        """Of a row, lists left out."""
        return np.dtype([(name, order + kind) for name, kind in self.fields if kind != "list"])


@dataclasses.dataclass(frozen=True)
class Header:
    """What a .ply says of itself."""

    form: str
    """one of ORDERS."""
    elements: list[Element]
    comments: tuple[str, ...]
    start: int
    """offset of the first byte behind the header."""


def ply_error(
    path: Path, found: str, expected: str = "a whole .ply file", remedy: str = "Export the file again."
) -> InputError:
    return InputError(path, found, expected, remedy)


def _header(path: Path, data: bytes) -> Header:
    end = _END.search(data)
    if not data.startswith(b"ply") or end is None:
        found = "it has no .ply header" if data else "the file is empty"
        raise ply_error(path, found, "a file that starts with 'ply' and a header")
    form, elements, comments = "", [], []
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            if not words:
                continue
            if words[0] in ("comment", "obj_info"):
                comments.append(line.strip().partition(" ")[2].strip())
            elif words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append(Element(words[1], int(words[2]), [], {}))
                if elements[-1].count < 0:
                    raise ValueError(words[2])
            elif words[0] == "property" and words[1] == "list":
                elements[-1].fields.append((words[4], "list"))
                elements[-1].lists[words[4]] = TYPES[words[2]], TYPES[words[3]]
            elif words[0] == "property":
                elements[-1].fields.append((words[2], TYPES[words[1]]))
            else:
                raise ValueError(words[0])
        except (IndexError, KeyError, ValueError) as error:
            raise ply_error(path, f"the header line {line.strip()!r} is not valid", "a valid .ply header") from error
    if form not in ORDERS:
        raise ply_error(path, f"its format is {form!r}", f"one of {', '.join(ORDERS)}")
    for element in elements:
        if len({name for name, _ in element.fields}) < len(element.fields):
            raise ply_error(path, f"a property of its element {element.name} is there twice", "distinct names")
    return Header(form, elements, tuple(comments), end.end())


def read_ply_file(path: Path) -> tuple[bytes, Header]:
    """The whole file, and its header."""
    with _reading(path) as file:
        data = file.read()
    return data, _header(path, data)


def header_of(path: Path) -> Header:
    """The header of the file, of which no more is read."""
    with _reading(path) as file:
        data = file.read(1 << 16)
        while not _END.search(data) and len(data) < _LONGEST and (more := file.read(len(data))):
            data += more
        return _header(path, data)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise ply_error(path, describe_error(error), "a .ply file", "Check the path.") from error


def property_types(path: Path) -> dict[str, str]:
    """NumPy's type of each property of the element vertex, by its name. Only the header is read."""
    return next((dict(element.fields) for element in header_of(path).elements if element.name == "vertex"), {})


def read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array."""
    blocks = list(vertex_blocks(path, sys.maxsize)[2])
    return blocks[0]


def vertex_blocks(path: Path, rows: int) -> tuple[int, tuple[str, ...], Iterator[np.ndarray]]:
    """The vertices of a .ply, read in blocks.

    Args:
      path: The file.
      rows: Most vertices of a block. Of a binary file without lists no more is read at once.

    Returns:
      How many vertices there are, the names of their properties without lists, and the vertices as structured arrays,
      one block at least.

    Raises:
      InputError: The file is no .ply with vertices, or is cut short.
    """
    header = header_of(path)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise ply_error(path, f"its elements are {', '.join(names) or 'none'}", "an element vertex")
    vertex = header.elements[names.index("vertex")]
    if is_compressed(header):
        remedy = f"Read it with jsecon.load_gaussians, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
        raise ply_error(path, "it is compressed (SuperSplat's packed chunks)", "an uncompressed .ply", remedy)
    if not vertex.names:
        raise ply_error(path, "its element vertex has no properties", "x y z and more")
    before = header.elements[: names.index("vertex")]
    plain = header.form != "ascii" and all(element.fixed for element in [*before, vertex])
    if not plain:
        whole = _vertices_of_any_rows(path, before, vertex)
        return vertex.count, vertex.names, (whole[n : n + rows] for n in range(0, max(vertex.count, 1), rows))
    order = ORDERS[header.form]
    offset = header.start + sum(element.count * element.dtype(order).itemsize for element in before)
    dtype, size = vertex.dtype(order), path.stat().st_size
    if offset + vertex.count * dtype.itemsize > size:
        raise _cut(path, (size - offset) // dtype.itemsize, vertex.count)
    return vertex.count, vertex.names, _binary_vertices(path, offset, dtype, vertex.count, rows)


def is_compressed(header: Header) -> bool:
    """Whether the vertices are packed in the way of SuperSplat's compressed .ply."""
    return any(name == "packed_position" for element in header.elements for name, _ in element.fields)


def read_elements(path: Path) -> tuple[Header, dict[str, np.ndarray]]:
    """All elements of a binary .ply as structured arrays, lists left out. Raises InputError as `vertex_blocks` does."""
    data, header = read_ply_file(path)
    tables, offset = {}, header.start
    for element in header.elements:
        tables[element.name], offset = _rows(path, data, offset, element, ORDERS[header.form])
    return header, tables


def _vertices_of_any_rows(path: Path, before: list[Element], vertex: Element) -> np.ndarray:
    """The vertices of a file that holds text, or lists before its vertices or in them."""
    data, header = read_ply_file(path)
    if header.form == "ascii":
        return _ascii_vertices(path, data[header.start :], sum(element.count for element in before), vertex)
    offset = header.start
    for element in before:
        _, offset = _rows(path, data, offset, element, ORDERS[header.form])
    return _rows(path, data, offset, vertex, ORDERS[header.form])[0]


def _rows(path: Path, data: bytes, offset: int, element: Element, order: str) -> tuple[np.ndarray, int]:
    """The rows of a binary element without their lists, and where they end."""
    dtype = element.dtype(order)
    if element.fixed:
        end = offset + element.count * dtype.itemsize
        if end > len(data):
            raise _cut(path, (len(data) - offset) // max(dtype.itemsize, 1), element.count, element.name)
        return np.frombuffer(data, dtype, element.count, offset) if dtype.itemsize else np.empty(0, dtype), end
    kept = bytearray()
    for row in range(element.count):
        for name, kind in element.fields:
            if kind != "list":
                size = np.dtype(kind).itemsize
                kept += data[offset : offset + size]
            else:
                length, number = (np.dtype(order + part) for part in element.lists[name])
                if offset + length.itemsize > len(data):
                    raise _cut(path, row, element.count, element.name)
                count = int(np.frombuffer(data, length, 1, offset)[0])
                if count < 0:
                    raise ply_error(path, f"a list of its element {element.name} has a length of {count}")
                size = length.itemsize + count * number.itemsize
            offset += size
            if offset > len(data):
                raise _cut(path, row, element.count, element.name)
    return np.frombuffer(bytes(kept), dtype), offset


def _cut(path: Path, there: int, count: int, name: str = "vertex") -> InputError:
    what = "vertices" if name == "vertex" else f"rows of its element {name}"
    return ply_error(path, f"the file is cut short: it holds {max(there, 0)} of {count} {what}")


def _binary_vertices(path: Path, offset: int, dtype: np.dtype, count: int, rows: int) -> Iterator[np.ndarray]:
    with _reading(path) as file:
        file.seek(offset)
        for first in range(0, max(count, 1), rows):
            wanted = min(rows, count - first) * dtype.itemsize
            data = file.read(wanted)
            if len(data) < wanted:  # cut since its size was looked at
                raise _cut(path, first + len(data) // dtype.itemsize, count)
            yield np.frombuffer(data, dtype)


def _ascii_vertices(path: Path, body: bytes, skip: int, vertex: Element) -> np.ndarray:
    lines = [line for line in body.splitlines() if line.strip()][skip : skip + vertex.count]
    rows = [line.split() for line in lines]
    try:
        if not vertex.fixed:
            rows = [_without_lists(row, vertex) for row in rows]
        numbers = np.array(rows, np.float64).reshape(len(rows), len(vertex.names))
    except (ValueError, IndexError) as error:
        found = f"its vertex lines have not {len(vertex.names)} numbers each, or the file is cut short"
        raise ply_error(path, found) from error
    if len(lines) < vertex.count:
        raise _cut(path, len(lines), vertex.count)
    result = np.empty(vertex.count, vertex.dtype("="))
    for column, name in enumerate(vertex.names):
        kind = result.dtype[name]
        with np.errstate(over="ignore", invalid="ignore"):  # infinite: for the caller to refuse; integers: refused here
            result[name] = numbers[:, column]
        if kind.kind != "f" and (result[name] != numbers[:, column]).any():
            raise ply_error(path, f"numbers of {name} do not fit its type {kind.name}")
    return result


def _without_lists(words: list[bytes], element: Element) -> list[bytes]:
    """The words of a line that belong to no list."""
    kept, at = [], 0
    for _, kind in element.fields:
        if kind == "list":
            at += 1 + int(words[at])
        else:
            kept.append(words[at])
            at += 1
    return kept
