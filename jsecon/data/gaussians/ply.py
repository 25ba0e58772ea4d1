"""Gaussians and point clouds as .ply files, in the layout of INRIA's 3D Gaussian Splatting and its relatives'."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jsecon.data.gaussians.ply_file import ply_error, property_types, read_vertices, vertex_blocks
from jsecon.errors import InputError, require_shape
from jsecon.files import atomic_write
from jsecon.numerics import is_finite_and_bounded
from jsecon.splat.project import check_gaussians, unusable_rows
from jsecon.splat.transform import float32_rounding, transform_blocks, transform_gaussians_float64
from jsecon.types import Array, Gaussians

SH_DC = 0.5 / np.sqrt(np.pi)
"""the constant basis function of spherical harmonics: rgb = 0.5 + SH_DC f_dc"""
GREY = 128
"""colour of points whose file has none"""
_POSITION, _OPACITY, _RGB = ("x", "y", "z"), ("opacity",), ("red", "green", "blue")
_DC, _SCALE = (tuple(f"{kind}_{axis}" for axis in range(3)) for kind in ("f_dc", "scale"))
_ROTATION = tuple(f"rot_{axis}" for axis in range(4))
_FILTERS = ("filter_3D", "filter_3d")
"""standard deviation of Mip-Splatting's 3D filter, world units: of its own training, and of other programs"""
_ROWS = 1 << 18
"""Gaussians read at a time"""
ROUNDED_WRITTEN, MAX_READ_ROUNDING = 0.02, 0.25
"""of a Gaussian's largest standard deviation, by which float32 may round its place: on writing, else it is written in
float64, and on reading"""
_COARSE = ("i1", "u1", "i2", "u2", "f2", "f4")
"""types of which float32 holds every number"""
_SIZES = {"means": 3, "log_scales": 3, "quaternions": 4}
_REST_COUNTS = (0, 9, 24, 45)
_WANTED = "3D Gaussians in INRIA's layout (x y z, f_dc_0..2, opacity, scale_0..2, rot_0..3)"


@np.errstate(over="ignore", invalid="ignore")  # what float32 does not hold is infinite, which no reader takes
def _columns(vertices: np.ndarray, names: tuple[str, ...] | list[str], dtype: type = np.float32) -> np.ndarray:
    fields = vertices.dtype.names or ()
    if len({vertices.dtype[name] for name in fields}) == 1:
        # One type throughout, as in nearly every file: a plain table, read along its rows (twice as fast).
        table = vertices.view(vertices.dtype[0]).reshape(len(vertices), len(fields))
        return table[:, [fields.index(name) for name in names]].astype(dtype)
    result = np.empty((len(vertices), len(names)), dtype)
    for column, name in enumerate(names):
        result[:, column] = vertices[name]
    return result


def load_ply(path: str | Path, *, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """Reads Gaussians from a .ply in INRIA's layout (graphdeco-inria/gaussian-splatting, gaussian_model.py).

    The degree of the spherical harmonics follows from the number of f_rest properties (0, 9, 24, 45; channel-major).
    Also read, each as the program that wrote it draws it:

    - 2D Gaussians: without scale_2, or with -inf there, they are flat.
    - Mip-Splatting: `filter_3D` is fused into sizes and opacities, as its own create_fused_ply.py does.
    - Colours red, green, blue in place of f_dc (nerfstudio's --ply-color-mode rgb): whole numbers of 8 or 16 bits, or
      floats (0..1, or 0..255 where any is above 1).

    Other properties (normals, OpenGaussian's ins_feat, Gaussian Grouping's obj_dc) and other elements are passed over.
    Text, either order of bytes and any type of number are read. A binary file is read in blocks and never is in memory
    as a whole beside the arrays, unless it holds lists before its vertices or in them.

    Args:
      path: The .ply file.
      similarity: (4, 4) float64, see `load_gaussians`.

    Returns:
      Its Gaussians, float32; N may be 0.

    Raises:
      InputError: The file is compressed or cut short, a property is missing, a number is NaN or infinite (other than
        log scales of -inf and opacity logits of -inf and inf, which can be drawn), or a quaternion is zero; or float32
        does not hold the positions.
    """
    path = Path(path)
    return in_float32(path, read_ply(path), similarity)


def read_ply(path: Path) -> Gaussians:
    """What `load_ply` reads, as NumPy arrays. The means are float64 where the file has them finer than float32."""
    count, names, blocks = vertex_blocks(path, _ROWS)
    scales = _SCALE[:2] if "scale_2" not in names else _SCALE
    colours = _RGB if not any(name in names for name in _DC) and all(name in names for name in _RGB) else _DC
    if missing := [name for name in (*_POSITION, *colours, *_OPACITY, *scales, *_ROTATION) if name not in names]:
        remedy = "A plain point cloud won't do: export the trained Gaussians as an uncompressed .ply."
        raise ply_error(path, f"its vertices have no {', '.join(missing)}", _WANTED, remedy)
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = [f"f_rest_{index}" for index in range(rest)]
    if rest not in _REST_COUNTS or any(name not in names for name in rest_names):
        wanted = "0, 9, 24 or 45 of them, counted from f_rest_0 (spherical harmonics of degree 0 to 3)"
        remedy = "Export the file again, with harmonics of degree 3 or less."
        raise ply_error(path, f"its vertices have {rest} properties f_rest", wanted, remedy)
    filters = [name for name in _FILTERS if name in names][:1]
    types = property_types(path)
    fine = any(types[name] not in _COARSE for name in _POSITION)
    arrays: dict[str, np.ndarray] = {name: np.empty((count, size), np.float32) for name, size in _SIZES.items()}
    arrays["means"] = np.empty((count, 3), np.float64 if fine else np.float32)
    arrays |= {"opacity_logits": np.empty(count, np.float32), "sh": np.empty((count, 1 + rest // 3, 3), np.float32)}
    first, unit = 0, 1.0
    for vertices in blocks:
        own, first = slice(first, first + len(vertices)), first + len(vertices)
        arrays["means"][own] = _columns(vertices, _POSITION, arrays["means"].dtype.type)
        arrays["log_scales"][own, 2] = -np.inf
        arrays["log_scales"][own, : len(scales)] = _columns(vertices, scales)
        arrays["quaternions"][own] = _columns(vertices, _ROTATION)
        arrays["opacity_logits"][own] = _columns(vertices, _OPACITY)[:, 0]
        arrays["sh"][own, 0] = _columns(vertices, colours)
        others = _columns(vertices, rest_names).reshape(len(vertices), 3, rest // 3)
        arrays["sh"][own, 1:] = others.transpose(0, 2, 1)
        if filters:
            _fuse(path, {name: arrays[name][own] for name in arrays}, _columns(vertices, filters)[:, 0])
        if colours == _RGB:
            unit = max(unit, _unit(vertices))
    if colours == _RGB:
        arrays["sh"][:, 0] = (arrays["sh"][:, 0].astype(np.float64) / unit - 0.5) / SH_DC
    return drawable_gaussians(path, arrays)


def _unit(vertices: np.ndarray) -> float:
    """The number that stands for the brightest red, green or blue: of these vertices, where they are floats."""
    kinds = [vertices.dtype[name] for name in _RGB]
    if all(kind.kind == "f" for kind in kinds):
        return 255.0 if max(np.nanmax(vertices[name], initial=0) for name in _RGB) > 1 else 1.0
    return 65535.0 if max(kind.itemsize for kind in kinds) == 2 else 255.0


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def _fuse(path: Path, arrays: dict[str, np.ndarray], deviation: np.ndarray) -> None:
    """Widens Gaussians, in place, by a filter of the given standard deviations (M,): sizes become sqrt(s^2 + f^2),
    opacities shrink by the ratio of the volumes (Mip-Splatting, get_opacity_with_3D_filter)."""
    if not (np.isfinite(deviation) & (deviation >= 0)).all():
        raise ply_error(path, "numbers of filter_3D are negative or not finite", "standard deviations", "Train again.")
    before = arrays["log_scales"].astype(np.float64)
    after = 0.5 * np.logaddexp(2 * before, 2 * np.log(deviation.astype(np.float64))[:, None])
    shrink = np.exp(np.where(after == before, 0.0, before - after).sum(axis=1))
    opacity = shrink / (1 + np.exp(-arrays["opacity_logits"].astype(np.float64)))
    arrays["log_scales"][:] = after
    arrays["opacity_logits"][:] = np.log(opacity) - np.log1p(-opacity)


def drawable_gaussians(path: Path, arrays: Mapping[str, np.ndarray]) -> Gaussians:
    """The Gaussians of a file's arrays (NumPy), by their fields. Raises InputError where one of them cannot be drawn:
    see `unusable_rows`."""
    _require_usable(path, arrays, 0, "Remove these Gaussians (SuperSplat drops them on loading), or train again.")
    return Gaussians(**arrays)


def in_float32(path: Path, gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None) -> Gaussians:
    """A file's Gaussians (NumPy) on jax's device, carried by `similarity` in float64 first. Raises InputError where
    float32 then does not hold where they are."""
    if similarity is not None:
        gaussians = transform_gaussians_float64(gaussians, similarity)
    rounded = float32_rounding(gaussians)
    if len(rounded) and np.median(rounded) > MAX_READ_ROUNDING:
        place = ", ".join(f"{number:.10g}" for number in np.median(gaussians.means, axis=0))
        found = f"the Gaussians lie about ({place}), where float32 does not tell them apart"
        remedy = "Give load_gaussians a similarity that brings them near 0, as numpy.linalg.inv(capture.to_source)."
        raise ply_error(path, found, "coordinates nearer to 0", remedy)
    return jax.tree.map(jnp.asarray, gaussians)


def usable_blocks(
    path: str | Path, gaussians: Gaussians, similarity: Float[Array, "4 4"] | None
) -> Iterator[tuple[slice, Gaussians]]:
    """`transform_blocks` of Gaussians that are to be written to a file. Raises ValueError where their shapes
    disagree, and InputError where `load_gaussians` would refuse them."""
    check_gaussians(gaussians)
    for own, part in transform_blocks(gaussians, similarity):
        columns = {name: getattr(part, name) for name in (*_SIZES, "opacity_logits", "sh")}
        _require_usable(path, columns, own.start, "Remove these Gaussians first.")
        yield own, part


def _require_usable(path: str | Path, arrays: Mapping[str, np.ndarray], first: int, remedy: str) -> None:
    """Raises InputError where Gaussians, counted from `first`, cannot be drawn."""
    for name, array in arrays.items():
        rows = unusable_rows(name, array)
        if rows.any():
            what = "are not finite" if name != "quaternions" else "are not finite or zero"
            found = f"{name} of {rows.sum()} of {len(rows)} Gaussians {what} (the first: {first + rows.argmax()})"
            raise InputError(path, found, "numbers that can be drawn", remedy)


def save_ply(
    path: str | Path,
    gaussians: Gaussians,
    *,
    rgb: Float[Array, "n 3"] | None = None,
    similarity: Float[Array, "4 4"] | None = None,
) -> None:
    """Writes Gaussians in INRIA's layout: binary little endian float32, normals zero, f_rest channel-major.

    Written in blocks, so that mapped columns need not fit into memory; `similarity` (4, 4) carries each block into
    another world (`transform_gaussians_float64`). Positions are written in double precision where float32 would
    not hold them (in a map projection's coordinates, say), else in float.

    Float32 Gaussians come back bit by bit from `load_ply`. `rgb` (0..1) replaces the spherical harmonics by one
    colour a Gaussian, for showing codes or similarities; viewers such as SuperSplat open either. A selection is
    written by giving its subset. Raises ValueError where shapes disagree, InputError where a Gaussian cannot be drawn
    (`load_ply` would refuse it) and where the folder cannot be written.
    """
    check_gaussians(gaussians)
    count = gaussians.count
    if rgb is not None:
        require_shape("rgb", rgb, (count, 3), "Give one colour per Gaussian.")
    rest_names = (f"f_rest_{index}" for index in range(0 if rgb is not None else 3 * (gaussians.sh.shape[1] - 1)))
    names = (*_POSITION, "nx", "ny", "nz", *_DC, *rest_names, *_OPACITY, *_SCALE, *_ROTATION)
    double = needs_float64(gaussians, similarity)
    kinds = ("double" if double and name in _POSITION else "float" for name in names)
    properties = (f"property {kind} {name}" for kind, name in zip(kinds, names))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header\n"]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for own, part in usable_blocks(path, gaussians, similarity):
            colours = part.sh if rgb is None else ((np.asarray(rgb[own], np.float64) - 0.5) / SH_DC)[:, None]
            rows = _table(part, np.asarray(colours, np.float32), double)
            file.write(rows.tobytes())  # tofile would not tell a full disk


def needs_float64(gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None) -> bool:
    """Whether float32 rounds the means, where `similarity` carries them, by more than a reader should see: for more
    than 1 in 100 by ROUNDED_WRITTEN of their size."""
    if similarity is None and gaussians.means.dtype != np.float64:
        return False
    bare = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    far = sum(int((float32_rounding(part) > ROUNDED_WRITTEN).sum()) for _, part in transform_blocks(bare, similarity))
    return far > 0.01 * gaussians.count


def _table(part: Gaussians, sh: np.ndarray, double: bool) -> np.ndarray:
    """A row of the file for each Gaussian."""
    count = len(sh)
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (sh.shape[1] - 1))
    normals, opacity = np.zeros((count, 3)), np.asarray(part.opacity_logits)[:, None]
    columns = [part.means, normals, sh[:, 0], rest, opacity, part.log_scales, part.quaternions]
    table = np.concatenate([np.asarray(column, "<f4") for column in columns], axis=1).astype("<f4", copy=False)
    if not double:
        return table
    rows = np.empty(count, [("means", "<f8", 3), ("others", "<f4", table.shape[1] - 3)])
    rows["means"], rows["others"] = part.means, table[:, 3:]
    return rows


def load_point_cloud(path: str | Path) -> tuple[Float[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Points (float64) and colours of a plain point cloud (nerfstudio's ply_file_path).

    Colours are red green blue in 8 or 16 bits, or in float (0..1, or 0..255 where any is above 1); mid grey where there
    are none. Raises InputError on a damaged file, or one without x y z.
    """
    path = Path(path)
    vertices = read_vertices(path)
    names = vertices.dtype.names or ()
    if missing := [name for name in _POSITION if name not in names]:
        raise ply_error(path, f"its vertices have no {', '.join(missing)}", "a point cloud with x y z")
    points = _columns(vertices, _POSITION, np.float64)
    if not is_finite_and_bounded(points):
        raise ply_error(path, "its points have NaN, infinite or absurd coordinates", "finite points")
    if not all(name in names for name in _RGB):
        return points, np.full((len(points), 3), GREY, np.uint8)
    colours = np.stack([vertices[name] for name in _RGB], axis=-1)
    if colours.dtype.kind == "f":
        scale = 255 if np.nanmax(colours, initial=0) <= 1 else 1
        colours = np.clip(np.nan_to_num(colours) * scale, 0, 255).round()
    elif colours.dtype.itemsize == 2:
        colours = colours // 257
    return points, colours.astype(np.uint8)
