"""Point clouds written by other programs' libraries, apart from any reader."""

import laspy
import numpy as np
import pye57
import pypcd4
import pyproj
from splat_files import write_ply

OFFSET = np.array([1e6, 5.5e6, 100.0])
COLOURS = ("red", "green", "blue")


def points_of(count: int = 60, offset=OFFSET) -> tuple[np.ndarray, np.ndarray]:
    """Points on multiples of 1 mm, and colours of 8 bits."""
    rng = np.random.default_rng(count)
    return rng.integers(-9000, 9000, (count, 3)) / 1000 + offset, rng.integers(0, 256, (count, 3)).astype(np.uint8)


def las(path, points, colours=None, epsg: int | None = 25832, version: str = "1.4") -> None:
    header = laspy.LasHeader(version=version, point_format=(7 if version == "1.4" else 3))
    header.offsets, header.scales = np.floor(points.min(0)), np.full(3, 0.001)
    if epsg:
        header.add_crs(pyproj.CRS.from_epsg(epsg))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.gps_time, data.classification = np.arange(len(points)), np.full(len(points), 2)
    if colours is not None:
        data.red, data.green, data.blue = colours.T.astype(np.uint16) * 257
    data.write(str(path))


def e57(path, points, colours=None) -> None:
    """Two scans, each with a pose of its own, of float32 coordinates."""
    with pye57.E57(str(path), mode="w") as file:
        for rows in np.array_split(np.arange(len(points)), 2):
            near = points[rows] - OFFSET
            columns = {f"cartesian{axis}": column for axis, column in zip("XYZ", near.T)}
            if colours is not None:
                columns |= {f"color{name.title()}": colours[rows, n] for n, name in enumerate(COLOURS)}
            file.write_scan_raw(columns, translation=OFFSET)


def pcd(path, points, colours=None, encoding: str = "binary") -> None:
    columns, kinds, names = [*points.T], [np.float64] * 3, [*"xyz"]
    if colours is not None:
        packed = colours.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        columns, kinds, names = [*columns, packed.astype(np.uint32)], [*kinds, np.uint32], [*names, "rgb"]
    pypcd4.PointCloud.from_points(columns, names, kinds).save(path, pypcd4.Encoding(encoding))


def text(path, points, colours=None, mark: str = " ", header: str = "") -> None:
    table = points if colours is None else np.column_stack([points, colours])
    form = ["%.3f"] * 3 + ["%d"] * (table.shape[1] - 3)
    np.savetxt(path, table, form, mark, header=header, comments="//")


def ply(path, points, colours=None) -> None:
    columns = dict(zip("xyz", points.T)) | ({} if colours is None else dict(zip(COLOURS, colours.T)))
    write_ply(path, columns, types=dict.fromkeys("xyz", "double") | dict.fromkeys(COLOURS, "uchar"))


WRITERS = {
    "a.las": las,
    "old.las": lambda *a: las(*a, version="1.2"),
    "a.laz": las,
    "a.e57": e57,
    "ascii.pcd": lambda *a: pcd(*a, encoding="ascii"),
    "binary.pcd": pcd,
    "compressed.pcd": lambda *a: pcd(*a, encoding="binary_compressed"),
    "a.xyz": text,
    "named.txt": lambda *a: text(*a, mark=",", header="X,Y,Z" + ",R,G,B" * (len(a) > 2 and a[2] is not None)),
    "points.ply": ply,
}
"""name -> what writes a file of this name from points and colours"""
