"""Gaussians written as a text of OpenUSD (.usda): one ParticleField3DGaussianSplat for each object, on the host."""

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float, Int

from jsecon.files import atomic_write
from jsecon.read.splats.ply import needs_float64, usable_blocks
from jsecon.splat.sh import C0
from jsecon.types import Array, Gaussians

_ROWS = 1 << 12
"""Gaussians of a piece of text."""


def save_usda(
    path: Path,
    gaussians: Gaussians,
    ids: Mapping[str, Int[Array, " n"]],
    similarity: Float[Array, "4 4"] | None,
    names: Sequence[str] = (),
) -> None:
    """Writes Gaussians as prims below /scene: object_<id>_<name> for each id of "object_id", and rest for the others.

    A prim's customData has the ids and the name, and labels of Gaussians never change within one. Positions that
    float32 would not hold are relative to the translation of /scene.
    """
    objects = np.asarray(ids["object_id"]) if "object_id" in ids else np.full(gaussians.count, -1)
    origin = np.zeros(3)
    if needs_float64(gaussians, similarity):
        origin = np.median(next(usable_blocks(path, gaussians, similarity))[1].means, axis=0)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('#usda 1.0\n(\n    defaultPrim = "scene"\n)\n\ndef Xform "scene"\n{\n')
        file.write(f"    double3 xformOp:translate = ({', '.join(map(repr, origin.tolist()))})\n")
        file.write('    uniform token[] xformOpOrder = ["xformOp:translate"]\n')
        for number in np.unique(objects):
            rows = np.flatnonzero(objects == number)
            own = {name: int(column[rows[0]]) for name, column in ids.items()}
            name = names[int(number)] if 0 <= number < len(names) else ""
            word = re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_")
            prim = "rest" if number < 0 else f"object_{number:03d}{'_' * bool(word)}{word}"
            data = [f"int {key} = {value}" for key, value in own.items()]
            data += [f"string name = {json.dumps(name, ensure_ascii=False)}"]
            file.write(f'\n    def ParticleField3DGaussianSplat "{prim}" (\n        customData = {{\n')
            file.writelines(f"            {line}\n" for line in data)
            file.write("        }\n    )\n    {\n")
            part = jax.tree.map(lambda a, rows=rows: np.asarray(a[rows]), gaussians)
            columns = [block for _, block in usable_blocks(path, part, similarity)]
            part = jax.tree.map(lambda *blocks: np.concatenate(blocks), *columns)
            file.writelines(_attributes(dataclasses.replace(part, means=part.means - origin)))
            file.write("    }\n")
        file.write("}\n")


def _attributes(part: Gaussians) -> Iterator[str]:
    """Yields the text of the attributes of a prim."""
    unit = part.quaternions / np.linalg.norm(part.quaternions, axis=1, keepdims=True)
    reach = 3 * np.exp(part.log_scales).max(1, keepdims=True)
    extent = np.stack([(part.means - reach).min(0), (part.means + reach).max(0)])
    degree = math.isqrt(part.sh.shape[1]) - 1
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-part.opacity_logits.astype(np.float64)))
    harmonics = "radiance:sphericalHarmonics"
    yield from _array("float3[] extent", extent)
    yield from _array("point3f[] positions", np.asarray(part.means))
    yield from _array("quatf[] orientations", unit)
    yield from _array("float3[] scales", np.exp(part.log_scales))
    yield from _array("float[] opacities", opacities)
    yield from _array("color3f[] primvars:displayColor", np.clip(0.5 + C0 * part.sh[:, 0], 0, 1))
    yield f"        uniform int {harmonics}Degree = {degree}\n"
    size = f"(\n            elementSize = {part.sh.shape[1]}\n        )"
    yield from _array(f"float3[] {harmonics}Coefficients", part.sh.reshape(-1, 3), size)


def _array(name: str, rows: np.ndarray, more: str = "") -> Iterator[str]:
    """Yields the text of an array of float32 numbers or tuples, in pieces."""
    yield f"        {name} = ["
    row = "%.9g" if rows.ndim == 1 else f"({', '.join(['%.9g'] * rows.shape[1])})"
    for first in range(0, len(rows), _ROWS):
        numbers = np.asarray(rows[first : first + _ROWS], np.float32)
        yield ", " * bool(first) + ", ".join([row] * len(numbers)) % tuple(numbers.ravel().tolist())
    yield f"]{' ' * bool(more)}{more}\n"
