"""Gaussians and point clouds as .ply files, in the layout of INRIA's 3D Gaussian Splatting."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jsecon.errors import InputError, require
from jsecon.files import written_whole
from jsecon.types import Array, Gaussians

SH_DC = 0.5 / np.sqrt(np.pi)
"""the constant basis function of spherical harmonics: rgb = 0.5 + SH_DC f_dc"""
GREY = 128
"""colour of points whose file has none"""
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
_GAUSSIAN = (
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
)
_REST_COUNTS = (0, 9, 24, 45)
_WANTED = "3D Gaussians in INRIA's layout (x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3)"


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


def _bad(
    path: Path, found: str, expected: str = "a whole .ply file", remedy: str = "Export the file again."
) -> InputError:
    return InputError(path, found=found, expected=expected, remedy=remedy)


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """(format, elements, offset of the first byte behind the header)."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise _bad(
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
            elif words[0] == "property":
                kind = "list" if words[1] == "list" else _TYPES[words[1]]
                elements[-1].fields.append((words[-1], kind))
            else:
                raise ValueError(words[0])
        except (IndexError, KeyError, ValueError) as error:
            raise _bad(path, f"the header line {line.strip()!r}", "a valid .ply header") from error
    if form not in _ORDERS:
        raise _bad(path, f"format {form!r}", f"one of {', '.join(_ORDERS)}")
    return form, elements, after


def _read_vertices(path: Path) -> np.ndarray:
    """The vertex element as a structured array."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _bad(path, error.strerror or "an error on reading", "a .ply file", "Check the path.") from error
    form, elements, offset = _header(path, data)
    names = [element.name for element in elements]
    if "chunk" in names or any(name == "packed_position" for element in elements for name, _ in element.fields):
        raise _bad(
            path,
            "a compressed .ply (SuperSplat's packed chunks)",
            _WANTED,
            "Export it from SuperSplat as an uncompressed PLY, or convert it with splat-transform.",
        )
    if "vertex" not in names:
        raise _bad(path, f"elements {', '.join(names) or 'none'}", "an element vertex")
    before = elements[: names.index("vertex")]
    vertex = elements[names.index("vertex")]
    if not all(element.fixed for element in [*before, vertex]):
        raise _bad(path, "list properties before or in the element vertex", "numbers only", "Export the points alone.")
    if len({name for name, _ in vertex.fields}) < len(vertex.fields):
        raise _bad(path, "a vertex property that is there twice", "distinct names")
    if form == "ascii":
        return _ascii_vertices(path, data[offset:], sum(element.count for element in before), vertex)
    offset += sum(element.count * element.dtype(_ORDERS[form]).itemsize for element in before)
    dtype = vertex.dtype(_ORDERS[form])
    if offset + vertex.count * dtype.itemsize > len(data):
        raise _bad(
            path,
            f"{max(0, len(data) - offset) // max(1, dtype.itemsize)} of {vertex.count} vertices: the file is cut short",
        )
    return np.frombuffer(data, dtype, vertex.count, offset)


def _ascii_vertices(path: Path, body: bytes, skip: int, vertex: _Element) -> np.ndarray:
    lines = body.split(b"\n")[skip : skip + vertex.count]
    result = np.empty(vertex.count, vertex.dtype("="))
    try:
        numbers = np.array([line.split() for line in lines], np.float64).reshape(len(lines), len(vertex.fields))
    except ValueError as error:
        raise _bad(
            path, f"vertex lines without {len(vertex.fields)} numbers each (or a file that is cut short)"
        ) from error
    if len(lines) < vertex.count:
        raise _bad(path, f"{len(lines)} of {vertex.count} vertices: the file is cut short")
    for column, (name, _) in enumerate(vertex.fields):
        result[name] = numbers[:, column]
    return result


def _columns(vertices: np.ndarray, names: tuple[str, ...] | list[str]) -> np.ndarray:
    result = np.empty((len(vertices), len(names)), np.float32)
    for column, name in enumerate(names):
        result[:, column] = vertices[name]
    return result


def load_ply(path: str | Path) -> Gaussians:
    """Gaussians from a .ply in INRIA's layout (REFERENCE A.7), binary or ascii; N may be 0.

    The degree of the spherical harmonics follows from the number of f_rest properties (0, 9, 24, 45; channel-major).
    Other properties (normals, OpenGaussian's ins_feat, Gaussian Grouping's obj_dc) are ignored. Raises InputError on a compressed
    file, missing properties, a file cut short, numbers that are not finite (infinite opacity logits, exactly 0 or 1, are
    kept), and zero quaternions.
    """
    path = Path(path)
    vertices = _read_vertices(path)
    names = vertices.dtype.names or ()
    missing = [name for name in _GAUSSIAN if name not in names]
    if missing:
        raise _bad(
            path,
            f"no properties {', '.join(missing)}",
            _WANTED,
            "A plain point cloud or a 2D Gaussian file won't do: export 3D Gaussians as an uncompressed PLY.",
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{index}" for index in range(rest)]
    if rest not in _REST_COUNTS or any(name not in names for name in rest_names):
        raise _bad(
            path,
            f"{rest} properties f_rest",
            "0, 9, 24 or 45 of them, counted from f_rest_0 (spherical harmonics of degree 0 to 3)",
        )
    first = _columns(vertices, ("f_dc_0", "f_dc_1", "f_dc_2"))[:, None]
    others = _columns(vertices, rest_names).reshape(len(vertices), 3, rest // 3).transpose(0, 2, 1)
    arrays = {
        "means": _columns(vertices, ("x", "y", "z")),
        "log_scales": _columns(vertices, ("scale_0", "scale_1", "scale_2")),
        "quaternions": _columns(vertices, ("rot_0", "rot_1", "rot_2", "rot_3")),
        "opacity_logits": _columns(vertices, ("opacity",))[:, 0],
        "sh": np.concatenate([first, others], axis=1),
    }
    clean = "Remove these Gaussians (SuperSplat drops them on loading), or train again."
    for name, array in arrays.items():
        rows = (np.isnan(array) if name == "opacity_logits" else ~np.isfinite(array)).reshape(len(array), -1).any(1)
        if rows.any():
            raise _bad(
                path,
                f"{rows.sum()} Gaussians of {len(rows)} whose {name} are not finite (the first: {rows.argmax()})",
                "finite numbers",
                clean,
            )
    zero = (arrays["quaternions"] == 0).all(1)
    if zero.any():
        raise _bad(
            path,
            f"{zero.sum()} Gaussians of {len(zero)} without rotation (the first: {zero.argmax()})",
            "quaternions that are not 0",
            clean,
        )
    return Gaussians(**{name: jnp.asarray(array) for name, array in arrays.items()})


def save_ply(path: str | Path, gaussians: Gaussians, *, rgb: Float[Array, "n 3"] | None = None) -> None:
    """Writes Gaussians in INRIA's layout: binary little endian float32, normals zero, f_rest channel-major.

    Float32 Gaussians come back bit by bit from `load_ply`. `rgb` (0..1) replaces the spherical harmonics by one colour a
    Gaussian, for showing codes or similarities; viewers such as SuperSplat open either. A selection is written by giving its
    subset. Raises InputError where the folder cannot be written.
    """
    count = gaussians.count
    if rgb is None:
        sh = np.asarray(gaussians.sh, np.float32)
    else:
        require(
            rgb.shape == (count, 3),
            "rgb",
            got=rgb.shape,
            expected=f"({count}, 3)",
            remedy="Give one colour a Gaussian.",
        )
        sh = ((np.asarray(rgb, np.float64) - 0.5) / SH_DC).astype(np.float32)[:, None]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        *(f"f_rest_{index}" for index in range(rest.shape[1])),
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    columns = [
        gaussians.means,
        np.zeros((count, 3), np.float32),
        sh[:, 0],
        rest,
        np.asarray(gaussians.opacity_logits)[:, None],
        gaussians.log_scales,
        gaussians.quaternions,
    ]
    table = np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    with written_whole(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        table.astype("<f4", copy=False).tofile(file)


def load_points_ply(path: str | Path) -> tuple[Float[Array, "p 3"], UInt8[Array, "p 3"]]:
    """Points and colours of a plain point cloud (nerfstudio's ply_file_path). Colours red green blue, 8 bit or 0..1 in float;
    mid grey where there are none. Raises InputError on a damaged file, or one without x y z."""
    path = Path(path)
    vertices = _read_vertices(path)
    names = vertices.dtype.names or ()
    missing = [name for name in ("x", "y", "z") if name not in names]
    if missing:
        raise _bad(path, f"no properties {', '.join(missing)}", "a point cloud with x y z")
    points = _columns(vertices, ("x", "y", "z"))
    if not np.isfinite(points).all():
        raise _bad(path, "points with NaN or infinite coordinates", "finite points")
    channels = ("red", "green", "blue")
    if not all(name in names for name in channels):
        return points, np.full((len(points), 3), GREY, np.uint8)
    colours = np.stack([vertices[name] for name in channels], axis=-1)
    if colours.dtype.kind == "f":
        colours = np.clip(np.nan_to_num(colours) * 255, 0, 255).round()
    elif colours.dtype.itemsize == 2:
        colours = colours // 257
    return points, colours.astype(np.uint8)
