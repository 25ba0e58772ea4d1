"""Meshes in .ply files: faces read and written."""

from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.files import atomic_write
from jsecon.read.splats.ply import ORDERS, read_ply_file


def _error(path: Path, problem: str, expected: str) -> InputError:
    return InputError(path, problem, expected, "Export the file again.")


def read_faces(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Vertex indices (F, K) int64 of the faces, and their other properties (F,) by name.

    Binary files whose faces all have K corners (triangles, or Replica's quads) and no second list. Raises InputError
    on any other, and on indices beyond the vertices.
    """
    path = Path(path)
    data, header = read_ply_file(path)
    form, elements, offset = header.form, header.elements, header.start
    names = [element.name for element in elements]
    if form == "ascii" or "face" not in names or "vertex" not in names:
        raise _error(path, f"{form} elements {', '.join(names) or 'none'}", "binary elements vertex and face")
    before, face = elements[: names.index("face")], elements[names.index("face")]
    kinds = [kind for element in elements for kind in element.lists.values()]
    if any(element.lists for element in before) or len(kinds) != 1 or not face.lists:
        raise _error(path, "list properties elsewhere than in one property of the faces", "faces with one list")
    offset += sum(element.count * element.dtype(ORDERS[form]).itemsize for element in before)
    order, (size, index) = ORDERS[form], kinds[0]
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
        raise _error(path, f"fewer than {face.count} faces of {corners} corners", "faces of one number of corners")
    table = np.frombuffer(data, dtype, face.count, offset)
    if (table["corners"] != corners).any():
        raise _error(path, "faces of several numbers of corners", "triangles only, or quads only")
    vertices = table["vertices"].astype(np.int64)
    count = elements[names.index("vertex")].count
    if vertices.min() < 0 or vertices.max() >= count:
        raise _error(path, f"a face with vertex {vertices.max()}", f"vertices 0 to {count - 1}")
    return vertices, {name: table[name] for name, kind in face.fields if kind != "list"}


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
    with atomic_write(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header\n"]).encode() + b"".join(body))
