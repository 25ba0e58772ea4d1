"""Gaussians as a binary glTF 2.0 file (.glb) with Khronos' extension KHR_gaussian_splatting, on the host.

Format: KhronosGroup/glTF, specification/2.0 and extensions/2.0/Khronos/KHR_gaussian_splatting. Sizes are linear,
opacities between 0 and 1, quaternions xyzw of unit length; one attribute for each coefficient of the harmonics, in the
order and with the signs of INRIA's layout. Viewers without the extension show COLOR_0, a cloud of coloured points.

pygltflib is not used: it checks neither sizes nor strides, and reads and writes whole files in memory only.
"""

import dataclasses
import functools
import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError, require_shape
from jsecon.files import atomic_write, parse_json, reading
from jsecon.read.splats.ply import drawable_gaussians, needs_float64, usable_blocks
from jsecon.splat.project import check_gaussians
from jsecon.splat.sh import C0, COEFFICIENT_COUNTS
from jsecon.splat.transform import transform_blocks, transform_gaussians
from jsecon.types import Array, Gaussians

_EXTENSION = "KHR_gaussian_splatting"
_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""from a .ply's x right, y down, z forward to glTF's x left, y up, z forward; and back again"""
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0
"""glTF's numbers for component types, a target of buffers and a mode of primitives"""
_DTYPES = {5120: "i1", _BYTE: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_SRGB = "srgb_rec709_display"
_REMEDY = "Export the scene again, or as a .ply."


def save_glb(
    path: str | Path,
    gaussians: Gaussians,
    *,
    object_ids: Int[Array, " n"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians in float32, in glTF's axes: (x, y, z) becomes (-x, -y, z), y up.

    If float32 would not hold the positions (coordinates of a map projection), they are relative to the translation of
    the node. Object ids are the attribute _OBJECT_ID, -1 for none.
    """
    check_gaussians(gaussians)
    if object_ids is not None:
        require_shape("object_ids", object_ids, (gaussians.count,), "Give one id per Gaussian.")
    count, into = gaussians.count, _AXES if similarity is None else _AXES @ np.asarray(similarity, np.float64)
    if not count:
        raise InputError(path, "there are no Gaussians to write", remedy="Write a .ply, which may be empty.")
    origin = np.zeros(3)
    if needs_float64(gaussians, into):
        origin = np.median(next(transform_blocks(gaussians, into))[1].means, axis=0)

    blocks = functools.partial(_attribute_blocks, path, into, origin, object_ids)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for _, block in blocks(dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])):
        low, high = np.minimum(low, block["POSITION"].min(0)), np.maximum(high, block["POSITION"].max(0))
    views, accessors, size, types = [], [], 0, {number: name for name, number in _COMPONENTS.items()}
    first = next(blocks(jax.tree.map(lambda a: a[:1], gaussians)))[1]
    for name, array in first.items():
        accessor = {"bufferView": len(views), "count": count, "type": types[array.shape[1]]}
        if name == "POSITION":
            accessor |= {"min": low.tolist(), "max": high.tolist()}
        number = {"componentType": _FLOAT} if array.dtype == "<f4" else {"componentType": _BYTE, "normalized": True}
        accessors.append(accessor | number)
        views.append({"buffer": 0, "byteOffset": size, "byteLength": count * array.nbytes, "target": _VERTICES})
        size += count * array.nbytes
    extensions = {_EXTENSION: {"kernel": "ellipse", "colorSpace": _SRGB}}
    primitive = {"mode": _POINTS, "attributes": dict(zip(first, range(len(views)))), "extensions": extensions}
    node = {"mesh": 0} | ({"translation": origin.tolist()} if origin.any() else {})
    document = {
        "asset": {"version": "2.0", "generator": "jsecon"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    if (length := 12 + 8 + len(text) + 8 + size) > (1 << 32) - 1:
        problem = f"{count} Gaussians fill {length / 2**30:.3g} GiB"
        raise InputError(path, problem, "at most 4 GiB in a .glb", "Write a .ply.")
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, length))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", size, b"BIN\0"))
        body = file.tell()
        for start, block in blocks(gaussians):
            for view, array in zip(views, block.values(), strict=True):
                file.seek(body + view["byteOffset"] + start * array[:1].nbytes)
                file.write(array.tobytes())


def _attribute_blocks(
    path: str | Path, into: np.ndarray, origin: np.ndarray, object_ids: Any, gaussians: Gaussians
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Yields the attributes of Gaussians in blocks, as the file has them, after the number of the first Gaussian."""
    for rows, block in usable_blocks(path, gaussians, into):
        if block.log_scales.max() > 88:  # beyond, float32 does not hold the exponential
            problem = f"a Gaussian is exp({block.log_scales.max():.4g}) units large"
            raise InputError(path, problem, "at most exp(88) in a .glb", "Write a .ply, or scale the scene down.")
        attributes = _attributes(dataclasses.replace(block, means=block.means - origin))
        if object_ids is not None:
            attributes["_OBJECT_ID"] = np.asarray(object_ids[rows])[:, None]
        kinds = {name: np.uint8 if name == "COLOR_0" else "<f4" for name in attributes}
        yield rows.start, {name: np.ascontiguousarray(a, kinds[name]) for name, a in attributes.items()}


def _attributes(block: Gaussians) -> dict[str, np.ndarray]:
    """The attributes of Gaussians that are in glTF's axes, (N, components)."""
    turned = jax.tree.map(lambda a: np.asarray(a, np.float64), block)
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-turned.opacity_logits))[:, None]
    shown = np.clip(0.5 + C0 * turned.sh[:, 0], 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # glTF's colours are linear
    unit = turned.quaternions / np.linalg.norm(turned.quaternions, axis=1, keepdims=True)
    return {
        "POSITION": turned.means,
        "COLOR_0": (255 * np.concatenate([linear, opacity], axis=1)).round(),
        f"{_EXTENSION}:ROTATION": np.roll(unit, -1, axis=1),
        f"{_EXTENSION}:SCALE": np.exp(turned.log_scales),
        f"{_EXTENSION}:OPACITY": opacity,
    } | {
        f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{n}": turned.sh[:, degree**2 + n]
        for degree in range(math.isqrt(turned.sh.shape[1]))
        for n in range(2 * degree + 1)
    }


def read_glb(path: Path) -> Gaussians:
    """Reads the Gaussians of all primitives of a scene, as NumPy arrays with the means in float64.

    They are transformed by their nodes, then turned back from glTF's axes to the world of the .ply that they were made
    from. Numbers may be float32, or whole numbers as the extension and KHR_mesh_quantization allow; harmonics of degree
    0 to 3. Other attributes are not read. What is not supported is an error: other extensions, kernels, projections and
    colour spaces, numbers in another file, and nodes that shear, mirror or scale their axes unequally.
    """
    parts, count = [], 0
    problem = "its Gaussians cannot be read"
    with reading(path, remedy=_REMEDY, problem=problem), path.open("rb") as file:
        glb = _open(path, file)
        for matrix, primitive in _primitives(glb):
            arrays = _fields(glb, primitive)
            count += len(arrays["means"])
            if 12 * count > glb.length:
                raise glb.error(f"{count} Gaussians do not fit into {glb.length} bytes")
            parts.append(transform_gaussians(drawable_gaussians(path, arrays), _AXES @ matrix))
    if not parts:
        raise InputError(path, f"no primitive of its scene holds Gaussians ({_EXTENSION})", remedy=_REMEDY)
    counts = {part.sh.shape[1] for part in parts}
    if len(counts) > 1:
        problem = f"its primitives have {' and '.join(map(str, sorted(counts)))} coefficients of harmonics"
        raise InputError(path, problem, "one degree for all", "Export each part as a .ply of its own.")
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


@dataclasses.dataclass(frozen=True)
class _Glb:
    """An open .glb: its JSON document, and its binary chunk."""

    path: Path
    file: BinaryIO
    document: Any
    start: int
    """Offset of the binary chunk."""
    length: int
    """Bytes of the binary chunk."""

    def error(self, problem: str, expected: str = "", remedy: str = _REMEDY) -> InputError:
        """An error of this file."""
        return InputError(self.path, problem, expected, remedy)


def _open(path: Path, file: BinaryIO) -> _Glb:
    """Reads the container of a .glb, and checks that it is complete."""
    size = path.stat().st_size
    magic, version, length = struct.unpack("<4sII", file.read(12))
    if (magic, version) != (b"glTF", 2):
        raise InputError(path, "it does not begin as a .glb of version 2 does", remedy=_REMEDY)
    text, kind = struct.unpack("<I4s", file.read(8))
    document, start = parse_json(file.read(text)), 28 + text
    body, binary = struct.unpack("<I4s", file.read(8)) if start <= size else (0, b"BIN\0")
    if length != size or start + body > max(size, start) or (kind, binary) != (b"JSON", b"BIN\0"):
        raise InputError(path, f"the file is cut short or damaged: {size} of {length} bytes", remedy=_REMEDY)
    if unsupported := set(document.get("extensionsRequired", ())) - {_EXTENSION, "KHR_mesh_quantization"}:
        remedy = "Export the Gaussians alone and without compression, or as a .ply."
        raise InputError(path, f"it requires the extension {', '.join(sorted(unsupported))}", remedy=remedy)
    return _Glb(path, file, document, start, body)


def _primitives(glb: _Glb) -> Iterator[tuple[np.ndarray, Any]]:
    """Yields each primitive with Gaussians, after the (4, 4) transform of its node into the world."""
    scenes, nodes = glb.document["scenes"], glb.document["nodes"]
    queue = [(index, np.eye(4)) for index in scenes[glb.document.get("scene", 0)].get("nodes", ())]
    visited = set()
    while queue:
        index, parent = queue.pop(0)
        if index in visited:
            raise glb.error(f"node {index} is in its scene twice")
        visited.add(index)
        node = nodes[index]
        matrix = parent @ _node_matrix(node)
        queue += [(child, matrix) for child in node.get("children", ())]
        for primitive in glb.document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            if (properties := primitive.get("extensions", {}).get(_EXTENSION)) is not None:
                _require_supported(glb, properties)
                yield matrix, primitive


def _require_supported(glb: _Glb, properties: Any) -> None:
    """Raises InputError if a primitive's Gaussians have a property that jsecon does not draw."""
    supported = {"kernel": "ellipse", "projection": "perspective", "colorSpace": _SRGB, "extensions": {}}
    for key, value in supported.items():
        if (found := properties.get(key, value)) != value:
            remedy = "Export the scene uncompressed and with sRGB colours, or as a .ply."
            raise glb.error(f"the {key} of its Gaussians is {found}", str(value or "none"), remedy)


def _node_matrix(node: Any) -> np.ndarray:
    """(4, 4) transform of a node."""
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    matrix, turn = np.eye(4), Rotation.from_quat(np.asarray(node.get("rotation", (0, 0, 0, 1)), np.float64))
    matrix[:3, :3] = turn.as_matrix() * np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _fields(glb: _Glb, primitive: Any) -> dict[str, np.ndarray]:
    """The fields of `Gaussians` of a primitive's attributes."""
    accessors = primitive["attributes"]
    harmonics = [f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
    present = [name in accessors for name in harmonics]
    if (count := sum(present)) not in COEFFICIENT_COUNTS or not all(present[:count]):
        expected = "all of degree 0, and of each higher degree up to 3 all or none of them"
        raise glb.error(f"it has {count} coefficients of harmonics", expected)
    names = {kind: f"{_EXTENSION}:{kind.upper()}" for kind in ("rotation", "scale", "opacity")} | {"means": "POSITION"}
    columns = {name: _column(glb, name, accessors[name]) for name in (*names.values(), *harmonics[:count])}
    rows = len(columns["POSITION"])
    sizes = {names["rotation"]: 4, names["opacity"]: 1}
    for name, column in columns.items():
        if column.shape != (rows, sizes.get(name, 3)):
            problem = f"its attribute {name} has {column.shape[0]} rows of {column.shape[1]} numbers"
            raise glb.error(problem, f"{rows} of {sizes.get(name, 3)}")
    with np.errstate(all="ignore"):  # numbers that are not finite are refused by their name later
        alpha = columns[names["opacity"]][:, 0].astype(np.float64)
        fields = {
            "means": columns["POSITION"],
            "log_scales": np.log(columns[names["scale"]], dtype=np.float64),
            "quaternions": np.roll(columns[names["rotation"]], 1, axis=1),
            "opacity_logits": np.log(alpha / (1 - alpha)),
            "sh": np.stack([columns[name] for name in harmonics[:count]], axis=1),
        }
    return {name: np.ascontiguousarray(array, np.float32) for name, array in fields.items()}


def _column(glb: _Glb, name: str, index: int) -> Float[np.ndarray, "n c"]:
    """(N, components) float32 of an attribute's accessor; reads and allocates no more than the binary chunk."""
    accessor = glb.document["accessors"][index]
    view, count = glb.document["bufferViews"][accessor["bufferView"]], int(accessor["count"])
    kind, size = np.dtype(_DTYPES[accessor["componentType"]]), _COMPONENTS[accessor["type"]]
    row = kind.itemsize * size
    stride = int(view.get("byteStride", row))
    offset = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    needed = (count - 1) * stride + row if count else 0
    if "sparse" in accessor or view["buffer"] != 0 or "uri" in glb.document["buffers"][0]:
        raise glb.error(f"the numbers of {name} are sparse or lie in another file")
    if count < 0 or stride < row or offset < 0 or offset + needed > glb.length:
        raise glb.error(f"{name} has {count} rows of {stride} bytes from {offset} on, in {glb.length} bytes")
    glb.file.seek(glb.start + offset)
    array = np.ndarray((count, size), kind, glb.file.read(needed), strides=(stride, kind.itemsize))
    if kind.kind == "f" or accessor.get("normalized") is not True:
        return array.astype(np.float32)
    return np.maximum(array.astype(np.float32) / np.iinfo(kind).max, -1)
