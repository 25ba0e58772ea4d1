"""Gaussians as a binary glTF 2.0 file (.glb) with Khronos' extension KHR_gaussian_splatting, on the host.

Format: KhronosGroup/glTF, specification/2.0 and extensions/2.0/Khronos/KHR_gaussian_splatting. Sizes are linear,
opacities between 0 and 1, quaternions xyzw of unit length; one attribute for each coefficient of the harmonics, in the
order and with the signs of INRIA's layout. Viewers without the extension show COLOR_0, a cloud of coloured points.

pygltflib is not used: it checks neither sizes nor strides, and reads and writes whole files in memory only.
"""

import dataclasses
import json
import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.files import atomic_write, parse_json, reading
from jsecon.read.splats.ply import drawable_gaussians, needs_float64, usable_blocks
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
_REMEDY = "Export the Gaussians alone, uncompressed, in sRGB colours and with all transforms applied, or as a .ply."


def save_glb(
    path: Path, gaussians: Gaussians, ids: Mapping[str, Int[Array, " n"]], similarity: Float[Array, "4 4"] | None
) -> None:
    """Writes Gaussians in float32, in glTF's axes: (x, y, z) becomes (-x, -y, z), y up.

    If float32 would not hold the positions (coordinates of a map projection), they are relative to the translation of
    the node. Ids are attributes such as _OBJECT_ID.
    """
    count, into = gaussians.count, _AXES if similarity is None else _AXES @ np.asarray(similarity, np.float64)
    origin = np.zeros(3)
    if needs_float64(gaussians, into):
        origin = np.median(next(transform_blocks(gaussians, into))[1].means, axis=0)

    def blocks(part: Gaussians) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Yields the number of a block's first Gaussian, and its attributes as the file has them."""
        for rows, block in usable_blocks(path, part, into):
            attributes = _attributes(dataclasses.replace(block, means=block.means - origin))
            attributes |= {f"_{name.upper()}": np.asarray(column[rows])[:, None] for name, column in ids.items()}
            kinds = {name: np.uint8 if name == "COLOR_0" else "<f4" for name in attributes}
            yield rows.start, {name: np.ascontiguousarray(a, kinds[name]) for name, a in attributes.items()}

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
        **{name: turned.sh[:, n] for n, name in enumerate(_harmonics(turned.sh.shape[1]))},
    }


def read_glb(path: Path) -> Gaussians:
    """Reads the Gaussians of all primitives of a scene, as NumPy arrays with the means in float64.

    They are transformed by their nodes, then turned back from glTF's axes to the world of the .ply that they were made
    from. Numbers may be float32, or whole numbers as the extension and KHR_mesh_quantization allow; harmonics of degree
    0 to 3. Other attributes are not read. What is not supported is an error: other extensions, kernels, projections and
    colour spaces, numbers in another file, and nodes that shear, mirror or scale their axes unequally.
    """
    with reading(path, remedy=_REMEDY, problem="its Gaussians cannot be read"):
        document, body = _open(path)
        parts = [
            transform_gaussians(_gaussians(path, document, body, attributes), _AXES @ matrix)
            for matrix, attributes in _primitives(document)
        ]
        if not parts:
            raise ValueError(f"no primitive of its scene holds Gaussians ({_EXTENSION})")
        if len({part.sh.shape[1] for part in parts}) > 1:
            raise ValueError("its primitives have harmonics of several degrees: export each as a .ply of its own")
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def _open(path: Path) -> tuple[Any, np.ndarray]:
    """The JSON document of a .glb, and its binary chunk, memory-mapped."""
    data = np.memmap(path, np.uint8, "r") if path.stat().st_size else np.zeros(0, np.uint8)
    magic, version, length, text, kind = struct.unpack("<4sIII4s", bytes(data[:20]))
    if (magic, version) != (b"glTF", 2):
        raise ValueError("it does not begin as a .glb of version 2 does")
    document, start = parse_json(bytes(data[20 : 20 + text])), 28 + text
    size, binary = struct.unpack("<I4s", bytes(data[start - 8 : start])) if start <= len(data) else (0, b"BIN\0")
    if length != len(data) or start + size > max(len(data), start) or (kind, binary) != (b"JSON", b"BIN\0"):
        raise ValueError(f"the file is cut short or damaged: {len(data)} of {length} bytes")
    if unsupported := set(document.get("extensionsRequired", ())) - {_EXTENSION, "KHR_mesh_quantization"}:
        raise ValueError(f"it requires the extension {', '.join(sorted(unsupported))}")
    return document, data[start : start + size]


def _primitives(document: Any) -> Iterator[tuple[np.ndarray, Any]]:
    """Yields the attributes of each primitive with Gaussians, after the (4, 4) transform of its node into the world."""
    nodes = document["nodes"]
    queue = [(index, np.eye(4)) for index in document["scenes"][document.get("scene", 0)].get("nodes", ())]
    visited = set()
    while queue:
        index, parent = queue.pop(0)
        if index in visited:
            raise ValueError(f"node {index} is in its scene twice")
        visited.add(index)
        node = nodes[index]
        matrix = parent @ _node_matrix(node)
        queue += [(child, matrix) for child in node.get("children", ())]
        for primitive in document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            if (properties := primitive.get("extensions", {}).get(_EXTENSION)) is not None:
                _require_supported(properties, index, matrix)
                yield matrix, primitive["attributes"]


def _require_supported(properties: Any, index: int, matrix: np.ndarray) -> None:
    """Raises ValueError if Gaussians have a property that jsecon does not draw, or a node that it cannot apply."""
    supported = {"kernel": "ellipse", "projection": "perspective", "colorSpace": _SRGB, "extensions": {}}
    for key, value in supported.items():
        if (found := properties.get(key, value)) != value:
            raise ValueError(f"the {key} of its Gaussians is {found}, expected {value or 'none'}")
    axes = matrix[:3, :3]
    squares = axes.T @ axes
    if not (np.allclose(squares, squares[0, 0] * np.eye(3), atol=2e-4 * squares[0, 0]) and np.linalg.det(axes) > 0):
        sizes = ", ".join(f"{size:.6g}" for size in np.linalg.norm(axes, axis=0))
        problem = f"its node {index} scales its axes by {sizes}, or shears or mirrors them"
        raise ValueError(f"{problem}, expected a rotation, one positive scale and a shift")


def _node_matrix(node: Any) -> np.ndarray:
    """(4, 4) transform of a node."""
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    matrix, turn = np.eye(4), Rotation.from_quat(np.asarray(node.get("rotation", (0, 0, 0, 1)), np.float64))
    matrix[:3, :3] = turn.as_matrix() * np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _gaussians(path: Path, document: Any, body: np.ndarray, accessors: Any) -> Gaussians:
    """The Gaussians of a primitive's attributes."""
    harmonics = [name for name in _harmonics(16) if name in accessors]
    if len(harmonics) not in COEFFICIENT_COUNTS or harmonics != _harmonics(len(harmonics)):
        raise ValueError(f"it has {len(harmonics)} coefficients of harmonics, expected whole degrees from 0 on")
    columns = {"POSITION": 3, f"{_EXTENSION}:SCALE": 3, f"{_EXTENSION}:ROTATION": 4, f"{_EXTENSION}:OPACITY": 1}
    columns |= dict.fromkeys(harmonics, 3)
    arrays = [_column(document, body, name, accessors[name]) for name in columns]
    for array, (name, size) in zip(arrays, columns.items()):
        if array.shape != (len(arrays[0]), size):
            raise ValueError(f"its attribute {name} has shape {array.shape}, expected {len(arrays[0]), size}")
    means, scales, rotations, alpha, *sh = arrays
    with np.errstate(all="ignore"):  # numbers that are not finite are refused by their name later
        alpha = alpha[:, 0].astype(np.float64)
        logits, log_scales = np.log(alpha / (1 - alpha)), np.log(scales, dtype=np.float64)
    return drawable_gaussians(path, means, log_scales, np.roll(rotations, 1, axis=1), logits, np.stack(sh, axis=1))


def _harmonics(count: int) -> list[str]:
    """The attributes of the first coefficients of the harmonics."""
    degrees = range(math.isqrt(count))
    return [f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in degrees for n in range(2 * degree + 1)]


def _column(document: Any, body: np.ndarray, name: str, index: int) -> Float[np.ndarray, "n c"]:
    """(N, components) float32 of an attribute's accessor."""
    accessor = document["accessors"][index]
    view, count = document["bufferViews"][accessor["bufferView"]], int(accessor["count"])
    kind, size = np.dtype(_DTYPES[accessor["componentType"]]), _COMPONENTS[accessor["type"]]
    row = kind.itemsize * size
    stride = int(view.get("byteStride", row))
    offset = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    if "sparse" in accessor or view["buffer"] != 0 or "uri" in document["buffers"][0]:
        raise ValueError(f"the numbers of {name} are sparse or lie in another file")
    if count < 0 or stride < row or offset < 0 or offset + (count - 1) * stride + row > len(body):
        raise ValueError(f"{name} has {count} rows of {stride} bytes from {offset} on, in {len(body)} bytes")
    array = np.ndarray((count, size), kind, body, offset, (stride, kind.itemsize)).astype(np.float32)
    is_share = kind.kind != "f" and accessor.get("normalized") is True
    return np.maximum(array / np.iinfo(kind).max, -1) if is_share else array
