"""Gaussians and point clouds as .ply files, in the layout of INRIA's 3D Gaussian Splatting."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jsecon.data.ply_file import bad_ply, read_vertices, vertex_blocks
from jsecon.errors import require_shape
from jsecon.files import written_whole
from jsecon.numerics import sane
from jsecon.splat.transform import transformed_blocks
from jsecon.types import Array, Gaussians

SH_DC = 0.5 / np.sqrt(np.pi)
"""the constant basis function of spherical harmonics: rgb = 0.5 + SH_DC f_dc"""
GREY = 128
"""colour of points whose file has none"""
_POSITION, _OPACITY = ("x", "y", "z"), ("opacity",)
_DC, _SCALE = (tuple(f"{kind}_{axis}" for axis in range(3)) for kind in ("f_dc", "scale"))
_ROTATION = tuple(f"rot_{axis}" for axis in range(4))
_GAUSSIAN = (*_POSITION, *_DC, *_OPACITY, *_SCALE, *_ROTATION)
_ROWS = 1 << 18
"""Gaussians read at a time"""
_SIZES = {"means": 3, "log_scales": 3, "quaternions": 4}
_REST_COUNTS = (0, 9, 24, 45)
_WANTED = "3D Gaussians in INRIA's layout (x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3)"


@np.errstate(over="ignore", invalid="ignore")  # what float32 does not hold is infinite, which no reader takes
def _columns(vertices: np.ndarray, names: tuple[str, ...] | list[str]) -> np.ndarray:
    fields = vertices.dtype.names or ()
    if len({vertices.dtype[name] for name in fields}) == 1:
        # One type throughout, as in nearly every file: a plain table, read along its rows (twice as fast).
        table = vertices.view(vertices.dtype[0]).reshape(len(vertices), len(fields))
        return table[:, [fields.index(name) for name in names]].astype(np.float32)
    result = np.empty((len(vertices), len(names)), np.float32)
    for column, name in enumerate(names):
        result[:, column] = vertices[name]
    return result


def load_ply(path: str | Path) -> Gaussians:
    """Gaussians from a .ply in INRIA's layout (graphdeco-inria/gaussian-splatting, gaussian_model.py), binary or ascii;
    N may be 0.

    The degree of the spherical harmonics follows from the number of f_rest properties (0, 9, 24, 45; channel-major).
    Other properties (normals, OpenGaussian's ins_feat, Gaussian Grouping's obj_dc) are ignored. Read in blocks: a
    binary file is never in memory as a whole beside the arrays. Raises InputError on a
    compressed file, missing properties, a file cut short, numbers that are not finite (but infinite opacity logits,
    opacities of exactly 0 or 1, are kept), and zero quaternions.
    """
    path = Path(path)
    count, names, blocks = vertex_blocks(path, _ROWS)
    if missing := [name for name in _GAUSSIAN if name not in names]:
        remedy = "A plain point cloud or a 2D Gaussian file won't do: export 3D Gaussians as an uncompressed PLY."
        raise bad_ply(path, f"no properties {', '.join(missing)}", _WANTED, remedy)
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{index}" for index in range(rest)]
    if rest not in _REST_COUNTS or any(name not in names for name in rest_names):
        wanted = "0, 9, 24 or 45 of them, counted from f_rest_0 (spherical harmonics of degree 0 to 3)"
        raise bad_ply(path, f"{rest} properties f_rest", wanted)
    arrays = {name: np.empty((count, size), np.float32) for name, size in _SIZES.items()}
    arrays |= {"opacity_logits": np.empty(count, np.float32), "sh": np.empty((count, 1 + rest // 3, 3), np.float32)}
    first = 0
    for vertices in blocks:
        own, first = slice(first, first + len(vertices)), first + len(vertices)
        arrays["means"][own] = _columns(vertices, _POSITION)
        arrays["log_scales"][own] = _columns(vertices, _SCALE)
        arrays["quaternions"][own] = _columns(vertices, _ROTATION)
        arrays["opacity_logits"][own] = _columns(vertices, _OPACITY)[:, 0]
        arrays["sh"][own, 0] = _columns(vertices, _DC)
        others = _columns(vertices, rest_names).reshape(len(vertices), 3, rest // 3)
        arrays["sh"][own, 1:] = others.transpose(0, 2, 1)
    return sound(path, arrays)


def sound(path: Path, arrays: Mapping[str, np.ndarray]) -> Gaussians:
    """The Gaussians of a file's float32 arrays, by their fields. Raises InputError on numbers that are not finite (but
    infinite opacity logits, opacities of exactly 0 or 1, are kept), and on zero quaternions."""
    clean = "Remove these Gaussians (SuperSplat drops them on loading), or train again."
    for name, array in arrays.items():
        wrong = np.isnan(array) if name == "opacity_logits" else ~np.isfinite(array)
        rows = np.asarray(wrong.any(axis=tuple(range(1, wrong.ndim))))
        if rows.any():
            found = f"{rows.sum()} Gaussians of {len(rows)} whose {name} are not finite (the first: {rows.argmax()})"
            raise bad_ply(path, found, "finite numbers", clean)
    zero = (arrays["quaternions"] == 0).all(axis=1)
    if zero.any():
        found = f"{zero.sum()} Gaussians of {len(zero)} without rotation (the first: {zero.argmax()})"
        raise bad_ply(path, found, "quaternions that are not 0", clean)
    return Gaussians(**{name: jnp.asarray(array) for name, array in arrays.items()})


def save_ply(
    path: str | Path,
    gaussians: Gaussians,
    *,
    rgb: Float[Array, "n 3"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians in INRIA's layout: binary little endian float32, normals zero, f_rest channel-major.

    Written in blocks, so that mapped columns need not fit into memory; `similarity` (4, 4) carries each block into
    another world (`transform_gaussians`).

    Float32 Gaussians come back bit by bit from `load_ply`. `rgb` (0..1) replaces the spherical harmonics by one
    colour a Gaussian, for showing codes or similarities; viewers such as SuperSplat open either. A selection is
    written by giving its subset. Raises InputError where the folder cannot be written.
    """
    count = gaussians.count
    if rgb is not None:
        require_shape("rgb", rgb, (count, 3), "Give one colour per Gaussian.")
    rest_names = (f"f_rest_{index}" for index in range(0 if rgb is not None else 3 * (gaussians.sh.shape[1] - 1)))
    names = (*_POSITION, "nx", "ny", "nz", *_DC, *rest_names, *_OPACITY, *_SCALE, *_ROTATION)
    properties = (f"property float {name}" for name in names)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header\n"]
    with written_whole(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for own, part in transformed_blocks(gaussians, similarity):
            colours = part.sh if rgb is None else ((np.asarray(rgb[own], np.float64) - 0.5) / SH_DC)[:, None]
            file.write(_table(part, np.asarray(colours, np.float32)).tobytes())  # tofile would not tell a full disk


def _table(part: Gaussians, sh: np.ndarray) -> np.ndarray:
    """A row of the file for each Gaussian."""
    count = len(sh)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (sh.shape[1] - 1))
    normals, opacity = np.zeros((count, 3)), np.asarray(part.opacity_logits)[:, None]
    columns = [part.means, normals, sh[:, 0], rest, opacity, part.log_scales, part.quaternions]
    return np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1).astype("<f4", copy=False)


def load_points_ply(path: str | Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Points and colours of a plain point cloud (nerfstudio's ply_file_path).

    Colours are red green blue in 8 or 16 bits, or in float (0..1, or 0..255 where any is above 1); mid grey where there
    are none. Raises InputError on a damaged file, or one without x y z.
    """
    path = Path(path)
    vertices = read_vertices(path)
    names = vertices.dtype.names or ()
    if missing := [name for name in _POSITION if name not in names]:
        raise bad_ply(path, f"no properties {', '.join(missing)}", "a point cloud with x y z")
    points = _columns(vertices, _POSITION)
    if not sane(points):
        raise bad_ply(path, "points with NaN, infinite or absurd coordinates", "finite points")
    channels = ("red", "green", "blue")
    if not all(name in names for name in channels):
        return points, np.full((len(points), 3), GREY, np.uint8)
    colours = np.stack([vertices[name] for name in channels], axis=-1)
    if colours.dtype.kind == "f":
        scale = 255 if np.nanmax(colours, initial=0) <= 1 else 1
        colours = np.clip(np.nan_to_num(colours) * scale, 0, 255).round()
    elif colours.dtype.itemsize == 2:
        colours = colours // 257
    return points, colours.astype(np.uint8)
