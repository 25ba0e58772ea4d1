"""Gaussians written as a .ply, or as a text of OpenUSD (.usda); and vertices of any kind as a .ply. On the host."""

import dataclasses
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

from jsecon.errors import InputError, require_shape
from jsecon.files import atomic_write
from jsecon.read.splats.ply import BLOCK_ROWS, DC, OPACITY, POSITION, ROTATION, SCALE, TYPES, require_drawable
from jsecon.splat.project import check_gaussians
from jsecon.splat.sh import C0
from jsecon.splat.transform import float32_rounding, transform_gaussians
from jsecon.types import Array, Gaussians

_ROWS = 1 << 12
"""Gaussians of a piece of text."""


def save_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    *,
    ids: Mapping[str, Int[Array, " n"]] = MappingProxyType({}),
    names: Sequence[str] = (),
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians as a .ply (INRIA's layout, exact) or a .usda.

    A .ply is written in blocks: memory-mapped arrays need not fit into memory. A .usda is a text of OpenUSD
    with a ParticleField3DGaussianSplat for each object.

    Args:
      path: The file; its suffix names the format.
      gaussians: N Gaussians.
      ids: Integers of each Gaussian by name, such as "object_id", -1 for none: properties of a .ply. A .usda has a prim
        for each "object_id".
      names: Names of the objects by id, for a .usda.
      similarity: (4, 4) transform into the world of the file.

    Raises:
      ValueError: Shapes disagree.
      InputError: The format cannot be written, a Gaussian cannot be drawn, or the folder cannot be written.
    """
    path = Path(path)
    require_writable_format(path)
    check_gaussians(gaussians)
    for name, column in ids.items():
        require_shape(name, column, (gaussians.count,), "Give one id per Gaussian.")
    if not gaussians.count and path.suffix.lower() != ".ply":
        raise InputError(path, "there are no Gaussians to write", remedy="Write a .ply, which may be empty.")
    if path.suffix.lower() == ".usda":
        _save_usda(path, gaussians, ids, similarity, names)
    else:
        _save_ply(path, gaussians, ids, similarity)


def require_writable_format(path: Path, points: bool = False) -> None:
    """Checks that `save_gaussians`, or `save_point_cloud`, can write a file, which need not exist."""
    known = (".las", ".laz", ".ply") if points else (".ply", ".usda")
    if path.suffix.lower() not in known:
        command = f"npx @playcanvas/splat-transform {path.stem}.ply {path.stem}.glb"
        remedy = f"Write {path.stem}.ply. To make a .glb, .spz or .sog of it, run: {command}"
        raise InputError(path, f"its name ends in {path.suffix or 'no suffix'}", " or ".join(known), remedy)


def _transform_blocks(
    gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None
) -> Iterator[tuple[slice, Gaussians]]:
    """Transforms Gaussians in blocks of BLOCK_ROWS rows; memory-mapped columns need not fit into memory.

    Yields:
      The rows of each block, and its Gaussians (NumPy); without a similarity they are copied.
    """
    for first in range(0, gaussians.count, BLOCK_ROWS):
        rows = slice(first, min(first + BLOCK_ROWS, gaussians.count))
        part = jax.tree.map(lambda a, rows=rows: np.asarray(a[rows]), gaussians)
        yield rows, part if similarity is None else transform_gaussians(part, similarity)


def _usable_blocks(
    path: Path, gaussians: Gaussians, similarity: Float[Array, "4 4"] | None
) -> Iterator[tuple[slice, Gaussians]]:
    """Yields the rows of a block, and its Gaussians in the (4, 4) transformed world of the file that is written.

    The Gaussians may be memory-mapped. A Gaussian that cannot be drawn is an error: `load_gaussians` would refuse it.
    """
    for rows, block in _transform_blocks(gaussians, similarity):
        require_drawable(path, block, rows.start, "Remove these Gaussians first.")
        yield rows, block


def _save_ply(
    path: Path,
    gaussians: Gaussians,
    ids: Mapping[str, Int[Array, " n"]],
    similarity: Float[Array, "4 4"] | None,
) -> None:
    """Writes Gaussians in INRIA's layout: binary little endian float32, normals zero, f_rest channel-major.

    Float32 Gaussians come back bit by bit. Positions are written in float64 if float32 would not hold them (coordinates
    of a map projection). Ids are further properties, int32, which other readers skip.
    """
    rest_names = (f"f_rest_{index}" for index in range(3 * (gaussians.sh.shape[1] - 1)))
    names = (*POSITION, "nx", "ny", "nz", *DC, *rest_names, *OPACITY, *SCALE, *ROTATION)
    is_double = _needs_float64(gaussians, similarity)
    kinds = [(name, "<f8" if is_double and name in POSITION else "<f4") for name in names]
    blocks = (
        _table(block, is_double, {name: np.asarray(column[rows]) for name, column in ids.items()})
        for rows, block in _usable_blocks(path, gaussians, similarity)
    )
    write_vertices(path, gaussians.count, [*kinds, *((name, "<i4") for name in ids)], blocks)


def write_vertices(path: Path, count: int, kinds: Sequence[tuple[str, str]], blocks: Iterable[np.ndarray]) -> None:
    """Writes a .ply of vertices: names and NumPy's little endian types of their properties, and blocks of rows."""
    words = {kind: word for word, kind in reversed(TYPES.items())}  # the old ones, which all programs know
    properties = [f"property {words[kind[1:]]} {name}" for name, kind in kinds]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header\n"]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        file.writelines(block.tobytes() for block in blocks)  # tofile hides a full disk


def _needs_float64(gaussians: Gaussians, similarity: Float[Array, "4 4"] | None) -> bool:
    """Whether float32 would round centres by over 0.02 of the largest standard deviation of 1 in 100 Gaussians.

    `similarity` is applied first. False for float32 centres without it.
    """
    if similarity is None and gaussians.means.dtype != np.float64:
        return False
    bare = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    far = sum(int((float32_rounding(block) > 0.02).sum()) for _, block in _transform_blocks(bare, similarity))
    return far > 0.01 * gaussians.count


def _table(block: Gaussians, is_double: bool, ids: Mapping[str, np.ndarray]) -> np.ndarray:
    """The rows of a file."""
    sh = np.asarray(block.sh, np.float32)
    count = len(sh)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (sh.shape[1] - 1))
    normals, opacity = np.zeros((count, 3)), np.asarray(block.opacity_logits)[:, None]
    columns = [normals, sh[:, 0], rest, opacity, block.log_scales, block.quaternions]
    others = np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1)
    last = [(name, "<i4") for name in ids]
    kinds = [("means", "<f8" if is_double else "<f4", 3), ("others", "<f4", others.shape[1]), *last]
    rows = np.empty(count, kinds)
    rows["means"], rows["others"] = block.means, others
    for name, column in ids.items():
        rows[name] = column
    return rows


def _save_usda(
    path: Path,
    gaussians: Gaussians,
    ids: Mapping[str, Int[Array, " n"]],
    similarity: Float[Array, "4 4"] | None,
    names: Sequence[str],
) -> None:
    """Writes Gaussians as prims below /scene: object_<id>_<name> for each id of "object_id", and rest for the others.

    A prim's customData has the ids and the name, and labels of Gaussians never change within one. Positions that
    float32 would not hold are relative to the translation of /scene.
    """
    objects = np.asarray(ids["object_id"]) if "object_id" in ids else np.full(gaussians.count, -1)
    origin = np.zeros(3)
    if _needs_float64(gaussians, similarity):
        origin = np.median(next(_usable_blocks(path, gaussians, similarity))[1].means, axis=0)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('#usda 1.0\n(\n    defaultPrim = "scene"\n)\n\ndef Xform "scene"\n{\n')
        file.write(f"    double3 xformOp:translate = ({', '.join(map(repr, origin.tolist()))})\n")
        file.write('    uniform token[] xformOpOrder = ["xformOp:translate"]\n')
        for number in np.unique(objects):
            rows = np.flatnonzero(objects == number)
            name = names[int(number)] if 0 <= number < len(names) else ""
            word = re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_")
            prim = "rest" if number < 0 else f"object_{number:03d}{'_' * bool(word)}{word}"
            data = [f"int {key} = {column[rows[0]]}" for key, column in ids.items()]
            data += [f"string name = {json.dumps(name, ensure_ascii=False)}"]
            file.write(f'\n    def ParticleField3DGaussianSplat "{prim}" (\n        customData = {{\n')
            file.writelines(f"            {line}\n" for line in data)
            file.write("        }\n    )\n    {\n")
            part = jax.tree.map(lambda a, rows=rows: np.asarray(a[rows]), gaussians)
            part = part if similarity is None else transform_gaussians(part, similarity)
            require_drawable(path, part, 0, "Remove these Gaussians first.")
            file.writelines(_attributes(dataclasses.replace(part, means=part.means - origin)))
            file.write("    }\n")
        file.write("}\n")


def _attributes(part: Gaussians) -> Iterator[str]:
    """Yields the text of the attributes of a prim."""
    unit = part.quaternions / np.linalg.norm(part.quaternions, axis=1, keepdims=True)
    reach = 3 * np.exp(part.log_scales).max(1, keepdims=True)
    extent = np.stack([(part.means - reach).min(0), (part.means + reach).max(0)])
    bands, harmonics = part.sh.shape[1], "radiance:sphericalHarmonics"
    yield from _array("float3[] extent", extent)
    yield from _array("point3f[] positions", np.asarray(part.means))
    yield from _array("quatf[] orientations", unit)
    yield from _array("float3[] scales", np.exp(part.log_scales))
    yield from _array("float[] opacities", expit(part.opacity_logits.astype(np.float64)))
    yield from _array("color3f[] primvars:displayColor", np.clip(0.5 + C0 * part.sh[:, 0], 0, 1))
    yield f"        uniform int {harmonics}Degree = {math.isqrt(bands) - 1}\n"
    size = f"(\n            elementSize = {bands}\n        )"
    yield from _array(f"float3[] {harmonics}Coefficients", part.sh.reshape(-1, 3), size)


def _array(name: str, rows: np.ndarray, more: str = "") -> Iterator[str]:
    """Yields the text of an array of float32 numbers or tuples, in pieces."""
    yield f"        {name} = ["
    row = "%.9g" if rows.ndim == 1 else f"({', '.join(['%.9g'] * rows.shape[1])})"
    for first in range(0, len(rows), _ROWS):
        numbers = np.asarray(rows[first : first + _ROWS], np.float32)
        yield ", " * bool(first) + ", ".join([row] * len(numbers)) % tuple(numbers.ravel().tolist())
    yield f"]{' ' * bool(more)}{more}\n"
