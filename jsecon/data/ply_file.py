"""The elements vertex and face of a .ply file (ascii or binary), whatever their properties.

Format: http://paulbourke.net/dataformats/ply. SuperSplat's compressed variant is told apart and refused.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.files import written_whole

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


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
    return InputError(path, found=found, expected=expected, remedy=remedy)


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """(format, elements, offset of the first byte behind the header)."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise bad_ply(
            path, "an empty file" if not data else "no .ply header", "a file that starts with 'ply' and a header"
        )
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
                kind = "list" if words[1] == "list" else _TYPES[words[1]]
                elements[-1].fields.append((words[-1], kind))
            else:
                raise ValueError(words[0])
        except (IndexError, KeyError, ValueError) as error:
            raise bad_ply(path, f"the header line {line.strip()!r}", "a valid .ply header") from error
    if form not in _ORDERS:
        raise bad_ply(path, f"format {form!r}", f"one of {', '.join(_ORDERS)}")
    return form, elements, after


def _opened(path: Path) -> tuple[bytes, str, list[_Element], int]:
    """The file, and what `_header` says of it."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise bad_ply(path, error.strerror or "an error on reading", "a .ply file", "Check the path.") from error
    return data, *_header(path, data)


def read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array."""
    data, form, elements, offset = _opened(path)
    names = [element.name for element in elements]
    if "chunk" in names or any(name == "packed_position" for element in elements for name, _ in element.fields):
        raise bad_ply(
            path,
            "a compressed .ply (SuperSplat's packed chunks)",
            "an uncompressed .ply",
            "Export it from SuperSplat as an uncompressed PLY, or convert it with splat-transform.",
        )
    if "vertex" not in names:
        raise bad_ply(path, f"elements {', '.join(names) or 'none'}", "an element vertex")
    before = elements[: names.index("vertex")]
    vertex = elements[names.index("vertex")]
    if not all(element.fixed for element in [*before, vertex]):
        raise bad_ply(
            path, "list properties before or in the element vertex", "numbers only", "Export the points alone."
        )
    if not vertex.fields:
        raise bad_ply(path, "an element vertex without properties", "x y z and more")
    if len({name for name, _ in vertex.fields}) < len(vertex.fields):
        raise bad_ply(path, "a vertex property that is there twice", "distinct names")
    if form == "ascii":
        return _ascii_vertices(path, data[offset:], sum(element.count for element in before), vertex)
    offset += sum(element.count * element.dtype(_ORDERS[form]).itemsize for element in before)
    dtype = vertex.dtype(_ORDERS[form])
    if offset + vertex.count * dtype.itemsize > len(data):
        raise bad_ply(
            path,
            f"{max(0, len(data) - offset) // max(1, dtype.itemsize)} of {vertex.count} vertices: the file is cut short",
        )
    return np.frombuffer(data, dtype, vertex.count, offset)


def _ascii_vertices(path: Path, body: bytes, skip: int, vertex: _Element) -> np.ndarray:
    lines = body.split(b"\n")[skip : skip + vertex.count]
    try:
        numbers = np.array([line.split() for line in lines], np.float64).reshape(len(lines), len(vertex.fields))
    except ValueError as error:
        raise bad_ply(
            path, f"vertex lines without {len(vertex.fields)} numbers each (or a file that is cut short)"
        ) from error
    if len(lines) < vertex.count:
        raise bad_ply(path, f"{len(lines)} of {vertex.count} vertices: the file is cut short")
    result = np.empty(vertex.count, vertex.dtype("="))
    for column, (name, _) in enumerate(vertex.fields):
        result[name] = numbers[:, column]
    return result


def read_faces(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Vertex indices (F, K) int64 of the faces, and their other properties (F,) by name.

    Binary files whose faces all have K corners (triangles, or Replica's quads) and no second list. Raises InputError
    on any other, and on indices beyond the vertices.
    """
    path = Path(path)
    data, form, elements, offset = _opened(path)
    names = [element.name for element in elements]
    if form == "ascii" or "face" not in names or "vertex" not in names:
        raise bad_ply(path, f"{form} elements {', '.join(names) or 'none'}", "binary elements vertex and face")
    before, face = elements[: names.index("face")], elements[names.index("face")]
    kinds = _list_types(data[: data.find(b"end_header")])
    if not all(element.fixed for element in before) or len(kinds) != 1 or face.fixed:
        raise bad_ply(path, "list properties elsewhere than in one property of the faces", "faces with one list")
    offset += sum(element.count * element.dtype(_ORDERS[form]).itemsize for element in before)
    order, (size, index) = _ORDERS[form], kinds[0]
    if not face.count:
        return np.zeros((0, 4), np.int64), {name: np.zeros(0) for name, kind in face.fields if kind != "list"}
    # The length of the first list stands where the properties before it end; all others must be as long.
    lead = sum(np.dtype(kind).itemsize for _, kind in face.fields[: [k for _, k in face.fields].index("list")])
    corners = int(np.frombuffer(data, order + size, 1, offset + lead)[0]) if offset + lead < len(data) else 0
    fields: list[tuple] = []
    for name, kind in face.fields:
        fields += [("corners", order + size), ("vertices", order + index, (corners,))] if kind == "list" else []
        fields += [] if kind == "list" else [(name, order + kind)]
    dtype = np.dtype(fields)
    if offset + face.count * dtype.itemsize > len(data):
        raise bad_ply(path, f"fewer than {face.count} faces of {corners} corners", "faces of one number of corners")
    table = np.frombuffer(data, dtype, face.count, offset)
    if (table["corners"] != corners).any():
        raise bad_ply(path, "faces of several numbers of corners", "triangles only, or quads only")
    vertices = table["vertices"].astype(np.int64)
    count = elements[names.index("vertex")].count
    if vertices.min() < 0 or vertices.max() >= count:
        raise bad_ply(path, f"a face with vertex {vertices.max()}", f"vertices 0 to {count - 1}")
    return vertices, {name: table[name] for name, kind in face.fields if kind != "list"}


def _list_types(header: bytes) -> list[tuple[str, str]]:
    """(type of the length, type of the entries) of each list property of the header."""
    words = (line.split() for line in header.decode("ascii", "replace").splitlines())
    return [(_TYPES[w[2]], _TYPES[w[3]]) for w in words if w[:2] == ["property", "list"] and len(w) == 5]


def write_mesh(
    path: Path, vertices: np.ndarray, faces: np.ndarray | None = None, properties: dict[str, np.ndarray] | None = None
) -> None:
    """Writes a binary mesh: `vertices` a structured array, its fields the vertex properties; faces (F, K) with a uchar
    count and int indices, followed by the faces' `properties` (F,). Raises InputError where the folder cannot be
    written."""
    of = {np.dtype(kind).str[1:]: name for name, kind in (("uchar", "u1"), ("ushort", "u2"), ("int", "i4"))} | {
        "f4": "float",
        "f8": "double",
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {of[vertices.dtype[name].str[1:]]} {name}" for name in vertices.dtype.names or ()]
    body = [vertices.astype(vertices.dtype.newbyteorder("<")).tobytes()]
    if faces is not None:
        properties = properties or {}
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        header += [f"property {of[np.asarray(a).dtype.str[1:]]} {name}" for name, a in properties.items()]
        fields = [("corners", "u1"), ("vertices", "<i4", (faces.shape[1],))]
        fields += [(name, "<" + np.asarray(a).dtype.str[1:]) for name, a in properties.items()]
        table = np.zeros(len(faces), np.dtype(fields))
        table["corners"], table["vertices"] = faces.shape[1], faces
        for name, values in properties.items():
            table[name] = values
        body.append(table.tobytes())
    with written_whole(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header\n"]).encode() + b"".join(body))
