"""Gaussians as a binary glTF 2.0 file (.glb) with Khronos' extension KHR_gaussian_splatting.

Format: KhronosGroup/glTF, specification/2.0 and extensions/2.0/Khronos/KHR_gaussian_splatting. Sizes are linear,
opacities between 0 and 1, quaternions xyzw of length 1; one attribute for each coefficient of the harmonics, in the
order and with the signs of INRIA's layout. Viewers without the extension show COLOR_0, a cloud of coloured points.
"""

import dataclasses
import json
import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jsecon.data.gaussians.ply import drawable_gaussians, in_float32, needs_float64, usable_blocks
from jsecon.errors import InputError, describe_error
from jsecon.files import READ_ERRORS, atomic_write, parse_json
from jsecon.splat.project import check_gaussians
from jsecon.splat.sh import C0, COEFFICIENT_COUNTS
from jsecon.splat.transform import transform_blocks, transform_gaussians_float64
from jsecon.types import Array, Gaussians

_NAME = "KHR_gaussian_splatting"
_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""from a .ply's x right, y down, z forward to glTF's x left, y up, z forward; and back again"""
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {size: name for name, size in _COMPONENTS.items()}
_LARGEST_LOG_SCALE = 88.0
"""whose exponential float32 holds"""
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0
_READ = {5120: "i1", _BYTE: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_MOST = (1 << 32) - 1
"""bytes of a .glb"""
_KNOWN = {_NAME, "KHR_mesh_quantization"}
"""extensions that a file may require"""
_OF_LOOKS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_xmp", "EXT_texture_", "EXT_lights_")
"""beginnings of the names of extensions that change nothing about Gaussians"""
_WHOLE = ("POSITION", f"{_NAME}:SCALE")
"""attributes that may hold whole numbers as they are, not as parts of the largest"""
_SRGB = "srgb_rec709_display"
_UNEQUAL = 1e-4
"""relative difference of the scales of a node's axes that rounding explains"""
_WANTED, _REMEDY = f"a .glb of Gaussians ({_NAME})", "Export the scene again, or as a .ply."


def save_glb(
    path: str | Path,
    gaussians: Gaussians,
    *,
    codes: Float[Array, "n d"] | None = None,
    regions: Int[Array, " n"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians in float32, carried by `similarity` (4, 4) into another world and turned to glTF's axes:
    (x, y, z) becomes (-x, -y, z), y up. In blocks: mapped columns need not fit into memory. Where float32 would not
    hold the positions (in a map projection's coordinates, say), they are relative to a point that the node has as its
    translation.

    `codes` become the application's attributes _CODE_0, _CODE_1 ..., four numbers in each; `regions` (-1 = none)
    _REGION. Raises ValueError where shapes disagree; InputError where there is no Gaussian, which glTF has no form for,
    where one cannot be drawn or is too large for float32, where they fill more than 4 GiB, and where the folder cannot
    be written.
    """
    check_gaussians(gaussians)
    count, into = gaussians.count, _AXES if similarity is None else _AXES @ np.asarray(similarity, np.float64)
    if not count:
        raise InputError(
            path, "there are no Gaussians to write", "at least one in a .glb", "Write a .ply, which may be empty."
        )

    middle = np.zeros(3)
    if needs_float64(gaussians, into):
        middle = np.median(next(transform_blocks(gaussians, into))[1].means, axis=0)

    def blocks(of: Gaussians) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        for own, part in usable_blocks(path, of, into):
            if part.log_scales.max() > _LARGEST_LOG_SCALE:
                found = f"a Gaussian is exp({part.log_scales.max():.4g}) units large"
                raise InputError(path, found, "at most exp(88) in a .glb", "Write a .ply, or scale the scene down.")
            attributes = _attributes(dataclasses.replace(part, means=part.means - middle))
            if codes is not None:
                table = np.asarray(codes[own])
                attributes |= {f"_CODE_{n // 4}": table[:, n : n + 4] for n in range(0, table.shape[1], 4)}
            if regions is not None:
                attributes["_REGION"] = np.asarray(regions[own])[:, None]
            kinds = {name: np.uint8 if name == "COLOR_0" else "<f4" for name in attributes}
            yield own.start, {name: np.ascontiguousarray(a, kinds[name]) for name, a in attributes.items()}

    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for _, part in blocks(dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])):
        low, high = np.minimum(low, part["POSITION"].min(0)), np.maximum(high, part["POSITION"].max(0))
    views, accessors, offset = [], [], 0
    first = next(blocks(jax.tree.map(lambda a: a[:1], gaussians)))[1]
    for name, array in first.items():
        accessor = {"bufferView": len(views), "count": count, "type": _TYPES[array.shape[1]]}
        if name == "POSITION":
            accessor |= {"min": low.tolist(), "max": high.tolist()}
        number = {"componentType": _FLOAT} if array.dtype == "<f4" else {"componentType": _BYTE, "normalized": True}
        accessors.append(accessor | number)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": count * array.nbytes, "target": _VERTICES})
        offset += count * array.nbytes
    splats = {_NAME: {"kernel": "ellipse", "colorSpace": _SRGB}}
    primitive = {"mode": _POINTS, "attributes": dict(zip(first, range(len(views)))), "extensions": splats}
    told = {"asset": {"version": "2.0", "generator": "jsecon"}, "extensionsUsed": [_NAME]}
    node = {"mesh": 0} | ({"translation": middle.tolist()} if middle.any() else {})
    told |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node], "meshes": [{"primitives": [primitive]}]}
    told |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": offset}]}
    text = json.dumps(told, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    if (length := 12 + 8 + len(text) + 8 + offset) > _MOST:
        found, remedy = f"{count} Gaussians of {length / 2**30:.3g} GiB", "Write a .ply, or without harmonics or codes."
        raise InputError(path, found, "at most 4 GiB in a .glb", remedy)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, length))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", offset, b"BIN\0"))
        body = file.tell()
        for start, part in blocks(gaussians):
            for view, array in zip(views, part.values(), strict=True):
                file.seek(body + view["byteOffset"] + start * array[:1].nbytes)
                file.write(array.tobytes())


def _attributes(part: Gaussians) -> dict[str, np.ndarray]:
    """What the extension stores of each Gaussian of a block in glTF's axes, (N, components)."""
    turned = jax.tree.map(lambda a: np.asarray(a, np.float64), part)
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-turned.opacity_logits))[:, None]
    shown = np.clip(0.5 + C0 * turned.sh[:, 0], 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # glTF's colours are linear
    unit = turned.quaternions / np.linalg.norm(turned.quaternions, axis=1, keepdims=True)
    return {
        "POSITION": turned.means,
        "COLOR_0": (255 * np.concatenate([linear, opacity], axis=1)).round(),
        f"{_NAME}:ROTATION": np.roll(unit, -1, axis=1),
        f"{_NAME}:SCALE": np.exp(turned.log_scales),
        f"{_NAME}:OPACITY": opacity,
    } | {
        f"{_NAME}:SH_DEGREE_{degree}_COEF_{n}": turned.sh[:, degree**2 + n]
        for degree in range(math.isqrt(turned.sh.shape[1]))
        for n in range(2 * degree + 1)
    }


def load_glb(path: str | Path) -> Gaussians:
    """Reads the Gaussians of all primitives of the scene that have the extension, in the world of the .ply that they
    were made from: carried by their nodes, then turned back from glTF's axes.

    Numbers may be float32, or whole numbers as the extension and KHR_mesh_quantization allow them; harmonics of degree
    0 to 3. Codes and regions (`save_glb`) are not read.

    Args:
      path: The .glb file.

    Returns:
      Its Gaussians, float32.

    Raises:
      InputError: The file is damaged, or asks for what is not known here: an extension or a file that it requires, a
        kernel but ellipses, a projection but the perspective, colours but sRGB, a node that shears, mirrors or scales
        its axes unequally; or it holds numbers that cannot be drawn.
    """
    path = Path(path)
    return in_float32(path, read_glb(path))


def read_glb(path: Path) -> Gaussians:
    """What `load_glb` reads, as NumPy arrays, the means in float64."""
    try:
        with path.open("rb") as file:
            told, start, length = _container(path, file, path.stat().st_size)
            found, count = [], 0
            for matrix, primitive in _primitives(path, told):
                arrays = _arrays(
                    path, lambda name, index: _column(path, file, told, name, index, start, length), primitive
                )
                count += len(arrays["means"])
                if 12 * count > length:
                    raise InputError(path, f"{count} Gaussians do not fit into {length} bytes", _WANTED, _REMEDY)
                found.append(transform_gaussians_float64(drawable_gaussians(path, arrays), _AXES @ matrix))
    except InputError:
        raise
    except OSError as error:
        raise InputError(path, describe_error(error), _WANTED, "Check the path.") from error
    except (*READ_ERRORS, struct.error) as error:
        raise InputError(path, "its description (JSON) is damaged or incomplete", _WANTED, _REMEDY) from error
    if not found:
        raise InputError(path, "no primitive of its scene holds Gaussians", _WANTED, _REMEDY)
    degrees = {part.sh.shape[1] for part in found}
    if len(degrees) > 1:
        what = f"its primitives have {' and '.join(map(str, sorted(degrees)))} coefficients of harmonics"
        raise InputError(path, what, "one degree for all", "Export each part as a .ply of its own.")
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def _container(path: Path, file: BinaryIO, size: int) -> tuple[Any, int, int]:
    """The JSON, and where the binary chunk begins and how long it is."""
    if size < 20:
        raise InputError(path, "the file is cut short", _WANTED, _REMEDY)
    magic, version, length = struct.unpack("<4sII", file.read(12))
    if (magic, version) != (b"glTF", 2):
        raise InputError(path, "it does not begin as a .glb of version 2 does", _WANTED, _REMEDY)
    if length != size:
        raise InputError(path, f"the file is cut short: {size} of {length} bytes", _WANTED, _REMEDY)
    text, kind = struct.unpack("<I4s", file.read(8))
    if kind != b"JSON" or text > size - 20:
        raise InputError(path, "it does not begin with its description (JSON)", _WANTED, _REMEDY)
    told, start, length = parse_json(file.read(text)), 28 + text, 0
    if start <= size:
        length, kind = struct.unpack("<I4s", file.read(8))
        if kind != b"BIN\0" or start + length > size:
            raise InputError(path, "its numbers (the binary chunk) are cut short", _WANTED, _REMEDY)
    needed = {str(name) for name in told.get("extensionsRequired", ())}
    if others := sorted(name for name in needed - _KNOWN if not name.startswith(_OF_LOOKS)):
        found = f"it requires the extension {', '.join(others)}"
        raise InputError(path, found, "a .glb without it", "Export the scene without compression, or as a .ply.")
    return told, start, length


def _primitives(path: Path, told: Any) -> Iterator[tuple[np.ndarray, Any]]:
    """(4, 4) world of a node, and a primitive with Gaussians in it."""
    wanted, seen = [(index, np.eye(4)) for index in told["scenes"][told.get("scene", 0)].get("nodes", ())], set()
    while wanted:
        index, above = wanted.pop(0)
        if index in seen:
            raise InputError(path, f"node {index} is in its scene twice", "each node once", _REMEDY)
        seen.add(index)
        node = told["nodes"][index]
        matrix = above @ _matrix(node)
        wanted += [(child, matrix) for child in node.get("children", ())]
        for primitive in told["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            if (how := primitive.get("extensions", {}).get(_NAME)) is not None:
                _require_known(path, how)
                _require_similarity(path, index, matrix)
                yield matrix, primitive


def _require_known(path: Path, how: Any) -> None:
    """Raises InputError where a primitive's Gaussians are of a kind that is not drawn here: says which of its
    properties is at fault."""
    if others := sorted(map(str, how.get("extensions", ()))):
        found, remedy = (
            f"its Gaussians use the extension {', '.join(others)}",
            "Export them uncompressed, or as a .ply.",
        )
        raise InputError(path, found, f"{_NAME} alone", remedy)
    if (kernel := how.get("kernel", "ellipse")) != "ellipse":
        raise InputError(path, f"the kernel of its Gaussians is {kernel}", "ellipse", "Export the scene as a .ply.")
    if (projection := how.get("projection", "perspective")) != "perspective":
        found = f"the projection of its Gaussians is {projection}"
        raise InputError(path, found, "perspective", "Export the scene as a .ply.")
    if (colours := how.get("colorSpace", _SRGB)) != _SRGB:
        linear = " (linear light)" if colours == "lin_rec709_display" else ""
        remedy = "Export the scene with sRGB colours: its colours must be blended as they are stored."
        raise InputError(path, f"the colour space of its Gaussians is {colours}{linear}", _SRGB, remedy)


def _require_similarity(path: Path, index: int, matrix: np.ndarray) -> None:
    """Raises InputError where the world of a node is more than a rotation, one positive scale and a shift."""
    axes = matrix[:3, :3]
    sizes = np.linalg.norm(axes, axis=0)
    if not np.isfinite(matrix).all() or not sizes.min() > 0:
        what = "has numbers that are not finite" if not np.isfinite(matrix).all() else "scales an axis by 0"
    elif sizes.max() > (1 + _UNEQUAL) * sizes.min():
        what = f"scales its axes unequally, by {', '.join(f'{size:.6g}' for size in sizes)}"
    elif np.abs(axes.T @ axes - np.diag(sizes**2)).max() > 2 * _UNEQUAL * sizes.max() ** 2:
        what = "shears its axes"
    elif np.linalg.det(axes) < 0:
        what = "mirrors its axes"
    elif not np.allclose(matrix[3], [0, 0, 0, 1]):
        what = "has a matrix whose last row is not 0, 0, 0, 1"
    else:
        return
    remedy = "Apply that transform to the Gaussians in the program that wrote the file, and export again."
    raise InputError(path, f"its node {index} {what}", "a rotation, one positive scale and a shift", remedy)


def _matrix(node: Any) -> np.ndarray:
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    matrix, turn = np.eye(4), Rotation.from_quat(np.asarray(node.get("rotation", (0, 0, 0, 1)), np.float64))
    matrix[:3, :3] = turn.as_matrix() * np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _arrays(path: Path, column: Callable[[str, int], np.ndarray], primitive: Any) -> dict[str, np.ndarray]:
    """The fields of `Gaussians` out of a primitive's attributes."""
    attributes = primitive["attributes"]
    harmonics = [f"{_NAME}:SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
    there = [name in attributes for name in harmonics]
    if (bands := sum(there)) not in COEFFICIENT_COUNTS or not all(there[:bands]):
        found = f"it has {bands} coefficients of harmonics"
        raise InputError(path, found, "all of degree 0, and of each higher degree up to 3 all or none", _REMEDY)
    names = {"means": "POSITION"} | {name: f"{_NAME}:{name.upper()}" for name in ("rotation", "scale", "opacity")}
    sizes = {"means": 3, "rotation": 4, "scale": 3, "opacity": 1} | dict.fromkeys(harmonics[:bands], 3)
    if missing := [names[name] for name in names if names[name] not in attributes]:
        raise InputError(path, f"its Gaussians have no attribute {', '.join(missing)}", _WANTED, _REMEDY)
    found = {name: column(names.get(name, name), attributes[names.get(name, name)]) for name in sizes}
    for name, size in sizes.items():
        if found[name].shape != (len(found["means"]), size):
            rows, columns = found[name].shape
            what = f"its attribute {names.get(name, name)} has {rows} rows of {columns} numbers"
            raise InputError(path, what, f"{len(found['means'])} of {size}", _REMEDY)
    with np.errstate(all="ignore"):  # what is not finite then is told by its name
        alpha = found["opacity"][:, 0].astype(np.float64)
        arrays = {"means": found["means"], "log_scales": np.log(found["scale"], dtype=np.float64)}
        arrays |= {"quaternions": np.roll(found["rotation"], 1, axis=1), "opacity_logits": np.log(alpha / (1 - alpha))}
    arrays["sh"] = np.stack([found[name] for name in harmonics[:bands]], axis=1)
    return {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}


def _column(
    path: Path, file: BinaryIO, told: Any, name: str, index: int, start: int, length: int
) -> Float[np.ndarray, "n c"]:
    """(N, components) float32 of an attribute's accessor. Nothing is read, and no room made, beyond the binary
    chunk."""
    accessor = told["accessors"][index]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InputError(path, f"the numbers of {name} are sparse", "all of them", _REMEDY)
    view, count = told["bufferViews"][accessor["bufferView"]], int(accessor["count"])
    kind, size = np.dtype(_READ[accessor["componentType"]]), _COMPONENTS[accessor["type"]]
    row = kind.itemsize * size
    stride = int(view.get("byteStride", row))
    offset = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    needed = (count - 1) * stride + row if count else 0
    if view["buffer"] != 0 or "uri" in told["buffers"][0]:
        found = f"the numbers of {name} lie in another file"
        raise InputError(path, found, "all in the .glb itself", "Export it as one .glb file, or as a .ply.")
    if count < 0 or stride < row or offset < 0 or offset + needed > length:
        found = f"{name} has {count} rows of {stride} bytes from {offset} on, in {length}"
        raise InputError(path, found, _WANTED, _REMEDY)
    file.seek(start + offset)
    array = np.ndarray((count, size), kind, file.read(needed), strides=(stride, kind.itemsize))
    if kind.kind == "f":
        return array.astype(np.float32)
    if accessor.get("normalized") is True:
        return np.maximum(array.astype(np.float32) / np.iinfo(kind).max, -1)
    if name not in _WHOLE:
        found = f"the whole numbers of {name} are not normalised"
        raise InputError(path, found, "normalised ones, or floats", _REMEDY)
    return array.astype(np.float32)
