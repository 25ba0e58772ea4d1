"""The elements vertex and face of a .ply file (ascii or binary), whatever their properties.

Format: http://paulbourke.net/dataformats/ply. SuperSplat's compressed variant is told apart and refused.
Read here, since the package plyfile is under GPLv3+ and jsecon under Apache-2.0.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jsecon.errors import InputError

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}
TYPES = {name: kind for kind, old in (_NAMES | {"f8": "double"}).items() for name in (old, np.dtype(kind).name)}
"""a property's type, by its old name or with its size (uchar, uint8) -> NumPy's"""
_LONGEST = 1 << 24
"""bytes in which a header's end is looked for"""
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclasses.dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]
    """(name, NumPy type); "list" for a list property."""

    @property
    def fixed(self) -> bool:
        return all(kind != "list" for _, kind in self.fields)

    def dtype(self, order: str) -> np.dtype:
        return np.dtype([(name, order + kind) for name, kind in self.fields])


def bad_ply(
    path: Path, found: str, expected: str = "a whole .ply file", remedy: str = "Export the file again."
) -> InputError:
    return InputError(path, found, expected, remedy)


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """(format, elements, offset of the first byte behind the header)."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        found = "no .ply header" if data else "an empty file"
        raise bad_ply(path, found, "a file that starts with 'ply' and a header")
    after = data.find(b"\n", end)
    after = len(data) if after < 0 else after + 1
    form, elements = "", []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
                if elements[-1].count < 0:
                    raise ValueError(words[2])
            elif words[0] == "property":
                kind = "list" if words[1] == "list" else TYPES[words[1]]
                elements[-1].fields.append((words[-1], kind))
            else:
                raise ValueError(words[0])
        except (IndexError, KeyError, ValueError) as error:
            raise bad_ply(path, f"the header line {line.strip()!r}", "a valid .ply header") from error
    if form not in ORDERS:
        raise bad_ply(path, f"format {form!r}", f"one of {', '.join(ORDERS)}")
    return form, elements, after


def opened(path: Path) -> tuple[bytes, str, list[_Element], int]:
    """The file, and what `_header` says of it."""
    with _reading(path) as file:
        data = file.read()
    return data, *_header(path, data)


def elements_of(path: Path) -> tuple[str, list[_Element], int]:
    """What `_header` says of the file, of which no more is read."""
    with _reading(path) as file:
        data = file.read(1 << 16)
        while b"end_header" not in data and len(data) < _LONGEST and (more := file.read(len(data))):
            data += more
        return _header(path, data + file.readline())


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise bad_ply(path, error.strerror or "an error on reading", "a .ply file", "Check the path.") from error


def read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array."""
    blocks = list(vertex_blocks(path, sys.maxsize)[2])
    return blocks[0]


def vertex_blocks(path: Path, rows: int) -> tuple[int, tuple[str, ...], Iterator[np.ndarray]]:
    """How many vertices there are, the names of their properties, and the vertices as structured arrays of at most
    `rows`, one at least; of a binary file no more is read at once. Raises InputError on what is wrong, before the first
    of them where the file tells."""
    form, elements, offset = elements_of(path)
    names = [element.name for element in elements]
    if "chunk" in names or any(name == "packed_position" for element in elements for name, _ in element.fields):
        remedy = f"Read it with jsecon.load_gaussians, or run: npx @playcanvas/splat-transform {path.name} plain.ply"
        raise bad_ply(path, "a compressed .ply (SuperSplat's packed chunks)", "an uncompressed .ply", remedy)
    if "vertex" not in names:
        raise bad_ply(path, f"elements {', '.join(names) or 'none'}", "an element vertex")
    before = elements[: names.index("vertex")]
    vertex = elements[names.index("vertex")]
    if not all(element.fixed for element in [*before, vertex]):
        raise bad_ply(path, "list properties before or in the element vertex", "numbers", "Export the points alone.")
    if not vertex.fields:
        raise bad_ply(path, "an element vertex without properties", "x y z and more")
    if len({name for name, _ in vertex.fields}) < len(vertex.fields):
        raise bad_ply(path, "a vertex property that is there twice", "distinct names")
    properties = tuple(name for name, _ in vertex.fields)
    if form == "ascii":
        body = opened(path)[0][offset:]
        whole = _ascii_vertices(path, body, sum(element.count for element in before), vertex)
        return vertex.count, properties, (whole[n : n + rows] for n in range(0, max(vertex.count, 1), rows))
    offset += sum(element.count * element.dtype(ORDERS[form]).itemsize for element in before)
    dtype, size = vertex.dtype(ORDERS[form]), path.stat().st_size
    if offset + vertex.count * dtype.itemsize > size:
        raise _cut(path, (size - offset) // dtype.itemsize, vertex.count)
    return vertex.count, properties, _binary_vertices(path, offset, dtype, vertex.count, rows)


def _cut(path: Path, there: int, count: int) -> InputError:
    return bad_ply(path, f"{max(there, 0)} of {count} vertices: the file is cut short")


def _binary_vertices(path: Path, offset: int, dtype: np.dtype, count: int, rows: int) -> Iterator[np.ndarray]:
    with _reading(path) as file:
        file.seek(offset)
        for first in range(0, max(count, 1), rows):
            wanted = min(rows, count - first) * dtype.itemsize
            data = file.read(wanted)
            if len(data) < wanted:  # cut since its size was looked at
                raise _cut(path, first + len(data) // dtype.itemsize, count)
            yield np.frombuffer(data, dtype)


def _ascii_vertices(path: Path, body: bytes, skip: int, vertex: _Element) -> np.ndarray:
    lines = body.split(b"\n")[skip : skip + vertex.count]
    try:
        numbers = np.array([line.split() for line in lines], np.float64).reshape(len(lines), len(vertex.fields))
    except ValueError as error:
        found = f"vertex lines without {len(vertex.fields)} numbers each (or a file that is cut short)"
        raise bad_ply(path, found) from error
    if len(lines) < vertex.count:
        raise bad_ply(path, f"{len(lines)} of {vertex.count} vertices: the file is cut short")
    result = np.empty(vertex.count, vertex.dtype("="))
    for column, (name, kind) in enumerate(vertex.fields):
        with np.errstate(over="ignore", invalid="ignore"):  # infinite: for the caller to refuse; integers: refused here
            result[name] = numbers[:, column]
        if kind[0] != "f" and (result[name] != numbers[:, column]).any():
            raise bad_ply(path, f"numbers of {name} that its type {kind} does not hold")
    return result
