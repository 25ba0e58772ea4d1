"""Point clouds as files, on the host: .las and .laz, .e57, .pcd, .xyz, and a .ply without Gaussians.

`READERS` is the table of formats. A reader takes the file, and returns its points in float64 and in its order, with
colours: those of the file, else its intensities as greys. Packages of the extra formats decode them: laspy, pye57 and
pypcd4, and pyproj the names of coordinate reference systems.
"""

import contextlib
import dataclasses
import itertools
import math
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, UInt8

from jsecon.errors import InputError
from jsecon.files import atomic_write, read_lines, reading
from jsecon.read.registry import Reader, decoding
from jsecon.read.splats.ply import read_vertices
from jsecon.read.splats.writing import write_vertices
from jsecon.splat.points import gaussians_from_points, voxel_means
from jsecon.types import Gaussians

MAX_GAUSSIANS = 200_000
"""Gaussians of a cloud: 24 views of 400x300 px have 14 pixels for each."""
_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_INTENSITIES = ("intensity", "scalar_intensity", "reflectance")
_NUMBERS = re.compile(r"(?:[-+]?(?:nan|[\d.]+(?:e[-+]?\d+)?)(?:[\s,;]+|$)){3,}")
"""a line of a text with a point"""
FIRST_CLASS, LAST_CLASS = 64, 255
"""classes of LAS that its users may define, in points of 8 bits for the class"""


class _PointCloud(NamedTuple):
    """P points of a file."""

    points: np.ndarray
    """(P, 3) float64, in the world of the file."""
    colors: np.ndarray
    """(P, 3) uint8."""


@np.errstate(invalid="ignore")  # of numbers that are none
def _cloud(columns: Mapping[str, np.ndarray]) -> _PointCloud:
    """Makes a cloud of the columns of a file."""
    columns = {re.sub("^cartesian|^color", "", name.lower()): column for name, column in columns.items()}
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its points have no {', '.join(missing)}, expected a point cloud with x y z")
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return _PointCloud(points, _colours(columns, len(points)))


def _colours(columns: Mapping[str, np.ndarray], count: int) -> UInt8[np.ndarray, "p 3"]:
    """The colours of points: as they are, or packed into one number (PCL), of 8 or 16 bits or shares; or greys."""
    if "rgb" in columns and columns["rgb"].dtype.itemsize == 4:
        packed = np.ascontiguousarray(columns["rgb"]).view(np.uint32)
        return (packed[:, None] >> np.array([16, 8, 0], np.uint32)).astype(np.uint8)
    for names in _COLOURS:
        values = np.array([columns[name] for name in names if name in columns])
        if len(values) == 3 and values.any() and not (values < 0).any():  # others are normals
            shares = values.dtype.kind == "f" and np.nanmax(values) <= 1
            top = 1 if shares else 255 if np.nanmax(values) <= 255 else 65535
            return np.rint(np.clip(np.nan_to_num(values) * (255 / top), 0, 255)).astype(np.uint8).T
    for name in _INTENSITIES:
        if name in columns and columns[name].any():
            low, high = np.nanquantile(columns[name], [0.01, 0.99])
            shares = (np.nan_to_num(columns[name].astype(np.float64)) - low) / max(high - low, 1e-30)
            return np.repeat(np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8)[:, None], 3, axis=1)
    return np.full((count, 3), 128, np.uint8)


def _require_counts(path: Path) -> None:
    """Checks that a .las or .laz can hold what it claims: decoders take memory for all of it, or end the process."""
    data = np.memmap(path, np.uint8, "r").data
    minor, points_at, records = struct.unpack_from("<25xB70xII", data)
    counts = [records, struct.unpack_from("<I", data, 243)[0] if minor >= 4 else 0]
    if (laszip := bytes(data[:points_at]).find(b"laszip encoded")) >= 0:
        place = struct.unpack_from("<q", data, points_at)[0]
        place = struct.unpack_from("<q", data, len(data) - 8)[0] if place == -1 else place  # unknown before the end
        chunk = struct.unpack_from("<I", data, laszip + 64)[0]
        counts += [struct.unpack_from("<4xI", data, place)[0], chunk if 1 << 22 < chunk < 2**32 - 1 else 0]
    if max(counts) > len(data):
        raise ValueError(f"it claims {max(counts)} records")


def _read_las(path: Path) -> _PointCloud:
    with decoding(path, "laspy") as laspy:
        _require_counts(path)
        las = laspy.read(path)
        if len(las.points) < las.header.point_count:
            raise EOFError
        names = {*las.point_format.dimension_names} & {*_COLOURS[0], *_INTENSITIES}
        return _cloud({name: np.asarray(las[name]) for name in (*names, *"xyz")})


def _read_e57(path: Path) -> _PointCloud:
    """Reads all scans of a .e57, each moved by its pose."""
    with decoding(path, "pye57") as pye57, pye57.E57(str(path)) as file:
        options = {"colors": True, "intensity": True, "ignore_missing_fields": True}
        clouds = [_cloud(file.read_scan(n, **options)) for n in range(file.scan_count)]
        return _PointCloud(*map(np.concatenate, zip(*clouds)))


def _read_pcd(path: Path) -> _PointCloud:
    with decoding(path, "pypcd4") as pypcd4:
        cloud = pypcd4.PointCloud.from_path(path)
        if len(cloud.pc_data) < cloud.metadata.points:
            raise EOFError
        return _cloud({name: cloud.pc_data[name] for name in cloud.pc_data.dtype.names})


def _read_xyz(path: Path) -> _PointCloud:
    """Reads a text with a point in each line: columns as a header names them, else x y z, intensity, red green blue."""
    lines = [line.lower().strip(" /#\t\r\n") for line in itertools.islice(read_lines(path), 50)]
    first = next((n for n, line in enumerate(lines) if _NUMBERS.fullmatch(line)), None)
    if first is None:
        raise ValueError("none of its first lines has three numbers")
    mark = next((mark for mark in ",;" if mark in lines[first]), None)
    table = np.loadtxt(path, delimiter=mark, skiprows=first, ndmin=2, encoding="utf-8-sig")
    names = re.split(r"[\s,;]+", lines[first - 1]) if first else []
    if len(names) != table.shape[1] or not {*"xyz"} <= {*names}:
        names = [*"xyz", *(["intensity"] if table.shape[1] in (4, 7) else []), *"rgb"]
    return _cloud(dict(zip(names, table.T)))


def _read_point_ply(path: Path) -> _PointCloud:
    """Reads a .ply of points."""
    vertices = read_vertices(path)
    return _cloud({name: vertices[name] for name in vertices.dtype.names or ()})


READERS = (
    Reader("LAS", (".las", ".laz"), _read_las),
    Reader("E57", (".e57",), _read_e57),
    Reader("PCD", (".pcd",), _read_pcd),
    Reader("XYZ", (".xyz", ".txt"), _read_xyz),
    Reader("PLY of points", (".ply",), _read_point_ply),
)


def load_point_cloud(path: Path) -> _PointCloud:
    """Reads a point cloud of any of these formats."""
    reader = next((reader for reader in READERS if reader.fits(path)), None)
    with reading(path, remedy="Export the file again, as a .laz for example."):
        if reader is None:
            raise ValueError(f"{path.suffix or 'no suffix'} is none of .las, .laz, .e57, .pcd, .xyz, .txt and .ply")
        cloud = reader.read(path)
        if not np.isfinite(cloud.points).all(axis=1).any():
            raise ValueError("it has no points with finite coordinates")
    return cloud


def gaussians_of_cloud(path: Path, most: int = MAX_GAUSSIANS) -> tuple[Gaussians, tuple[str, ...]]:
    """Makes Gaussians of a cloud, and notes: round, opaque ones, no larger than three times the median.

    Means are float64. Of more than `most` points it takes the mean of each voxel.
    """
    points, colors = load_point_cloud(path)
    known = np.isfinite(points).all(axis=1)
    points, colors, notes = points[known], colors[known], ()
    if len(points) > most:
        means, colors, voxel = voxel_means(points - points[0], colors, most)
        notes = (f"{len(points):,} points of {path.name} became {len(means):,} Gaussians, one per {voxel:.3g} units.",)
        points = means + points[0]
    gaussians = gaussians_from_points(points - points[0], colors, opacity=0.95, scale=0.6)
    sizes = np.minimum(gaussians.log_scales, np.median(gaussians.log_scales) + math.log(3))
    return dataclasses.replace(gaussians, means=points, log_scales=sizes), notes


def read_crs(path: Path) -> str:
    """Reads which coordinate reference system a cloud is in: "EPSG:25832", or a WKT without a code; "" for unknown."""
    crs = None
    if path.suffix.lower() in (".las", ".laz"):
        with decoding(path, "laspy") as laspy, laspy.open(path) as file:
            crs = file.header.parse_crs()
    elif path.suffix.lower() == ".e57":
        with decoding(path, "pye57") as pye57, pye57.E57(str(path)) as file:
            text = file.root["coordinateMetadata"].value() if file.root.isDefined("coordinateMetadata") else ""
        with decoding(path, "pyproj") as pyproj, contextlib.suppress(pyproj.exceptions.CRSError):
            crs = pyproj.CRS.from_user_input(text) if text else None
    code = crs and crs.to_epsg()
    return f"EPSG:{code}" if code else crs.to_wkt() if crs else ""


def save_point_cloud(
    path: Path, source: Path, rows: Int[np.ndarray, " m"], ids: Mapping[str, Int[np.ndarray, " m"]]
) -> None:
    """Writes rows of the points of a file with ids of each, int32.

    From .las to .las all columns stay as they are, bit for bit. A class above -1 becomes the classification
    FIRST_CLASS + class where points have 8 bits for it.
    """
    if not len(rows):
        raise InputError(source, "none of its points lies near the Gaussians", remedy="Check its world.")
    if path.suffix.lower() == ".ply":
        points, colors = load_point_cloud(source)
        kinds = [(axis, "<f8") for axis in "xyz"] + [(name, "<u1") for name in _COLOURS[0]]
        kinds += [(name, "<i4") for name in ids]
        table = np.rec.fromarrays([*points[rows].T, *colors[rows].T, *ids.values()], dtype=kinds)
        return write_vertices(path, len(rows), kinds, [table])
    if source.suffix.lower() not in (".las", ".laz"):
        raise InputError(path, f"the points of {source.name} are no {path.suffix}", remedy="Write a .ply.")
    with decoding(source, "laspy") as laspy:
        las = laspy.read(source)
        las.points = las.points[rows]
        old = {*las.point_format.extra_dimension_names}
        las.add_extra_dims([laspy.ExtraBytesParams(name, np.int32) for name in ids if name not in old])
        for name, column in ids.items():
            las[name] = column
        classes = FIRST_CLASS + ids.get("class_id", np.array(-1))
        if las.point_format.id > 5:
            fits = (classes >= FIRST_CLASS) & (classes <= LAST_CLASS)
            las.classification = np.where(fits, classes, las.classification)
    with atomic_write(path) as temporary:
        las.write(str(temporary), do_compress=path.suffix.lower() == ".laz")
