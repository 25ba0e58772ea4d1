"""Gaussians as a binary glTF 2.0 file (.glb) with Khronos' extension KHR_gaussian_splatting.

Format: KhronosGroup/glTF, specification/2.0 and extensions/2.0/Khronos/KHR_gaussian_splatting. Sizes are linear,
opacities between 0 and 1, quaternions xyzw of length 1; one attribute for each coefficient of the harmonics, in the
order and with the signs of INRIA's layout. Viewers without the extension show COLOR_0, a cloud of coloured points.
"""

import json
import math
import struct
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError
from jsecon.files import written_whole
from jsecon.splat.sh import C0
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Array, Gaussians

_NAME = "KHR_gaussian_splatting"
_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""from a .ply's x right, y down, z forward to glTF's x left, y up, z forward"""
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0


def save_glb(
    path: str | Path,
    gaussians: Gaussians,
    *,
    codes: Float[Array, "n d"] | None = None,
    regions: Int[Array, " n"] | None = None,
) -> None:
    """Writes Gaussians in float32, turned to glTF's axes: (x, y, z) becomes (-x, -y, z), y up.

    `codes` become the application's attributes _CODE_0, _CODE_1 ..., four numbers in each; `regions` (-1 = none)
    _REGION. Raises InputError where there is no Gaussian, which glTF has no form for, and where the folder cannot be
    written.
    """
    if not gaussians.count:
        raise InputError(path, "no Gaussians", "at least one in a .glb", "Write a .ply, which may be empty.")
    attributes = _attributes(gaussians)
    if codes is not None:
        table = np.asarray(codes)
        attributes |= {f"_CODE_{n // 4}": table[:, n : n + 4] for n in range(0, table.shape[1], 4)}
    if regions is not None:
        attributes["_REGION"] = np.asarray(regions)[:, None]
    views, accessors, parts, offset = [], [], [], 0
    for name, array in attributes.items():
        kind = np.dtype(np.uint8 if name == "COLOR_0" else "<f4")
        data = np.ascontiguousarray(array, kind)
        accessor = {"bufferView": len(views), "count": len(data), "type": _KINDS[data.shape[1]]}
        if name == "POSITION":
            accessor |= {"min": data.min(0).tolist(), "max": data.max(0).tolist()}
        number = {"componentType": _FLOAT} if kind == "<f4" else {"componentType": _BYTE, "normalized": True}
        accessors.append(accessor | number)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": data.nbytes, "target": _VERTICES})
        parts.append(data.tobytes())
        offset += data.nbytes
    splats = {_NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    primitive = {"mode": _POINTS, "attributes": dict(zip(attributes, range(len(views)))), "extensions": splats}
    told = {"asset": {"version": "2.0", "generator": "jsecon"}, "extensionsUsed": [_NAME]}
    told |= {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    told |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": offset}]}
    text = json.dumps(told, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with written_whole(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", offset, b"BIN\0"))
        file.writelines(parts)


def _attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """What the extension stores of each Gaussian, (N, components)."""
    turned = jax.tree.map(lambda a: np.asarray(a, np.float64), transform_gaussians(gaussians, _AXES))
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
