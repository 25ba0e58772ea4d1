"""A scanned room: every pixel's surface named, and the views' surfaces fused to one quad mesh with an object per
face."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from experiments.rooms.room import TABLE_HEIGHT, Room
from jsecon.types import Capture

CEILING = "ceiling"
SURROUNDINGS = ("wall", "floor", CEILING, "table")
"""owners K, K + 1, ... of what is no object, K objects being 0 .. K - 1"""
ON_PLANE_M = 0.004
"""a point this near to a wall, the floor or the ceiling lies on it: depths are float32"""
STRIDES = (1, 2, 4, 8)
"""pixels between the corners of a quad: where the pixels are finer than the voxels, a wider one still joins several"""
MOST_VOXELS = 4
"""a quad longer than this many coarse voxels spans an edge of the view, not a surface"""


class Mesh(NamedTuple):
    """A quad mesh whose faces each belong to one object."""

    vertices: np.ndarray
    """(V,) structured: x y z nx ny nz f4, red green blue u1, as Replica's; normals zero."""
    faces: np.ndarray
    """(F, 4) vertex indices; a triangle repeats one."""
    face_owners: np.ndarray
    """(F,) int32."""
    vertex_owners: np.ndarray
    """(V,) int32 the owner of all faces at the vertex."""


def surfaces_of(
    room: Room, capture: Capture, instances: Int[np.ndarray, "t h w"]
) -> tuple[Float[np.ndarray, "t h w 3"], Int[np.ndarray, "t h w"]]:
    """World points of all pixels and their owners: objects, then `SURROUNDINGS`."""
    cameras, depths = capture.cameras, np.asarray(capture.depths, np.float64)
    rows, columns = np.mgrid[: depths.shape[1], : depths.shape[2]]
    owners = instances.astype(np.int32)
    points = np.empty((*depths.shape, 3))
    half, count = np.asarray(room.half, np.float64), len(room.objects)
    for t, depth in enumerate(depths):
        x = (columns + 0.5 - float(cameras.cx[t])) / float(cameras.fx[t]) * depth
        y = (rows + 0.5 - float(cameras.cy[t])) / float(cameras.fy[t]) * depth
        pose = np.asarray(cameras.world_to_camera[t], np.float64)
        world = (np.stack([x, y, depth], -1) - pose[:3, 3]) @ pose[:3, :3]
        gaps = [(half - np.abs(world[..., :2])).min(-1), world[..., 2] + TABLE_HEIGHT, room.ceiling - world[..., 2]]
        nearest = np.argmin(gaps, axis=0)
        named = np.where(np.min(gaps, axis=0) < ON_PLANE_M, count + nearest, count + SURROUNDINGS.index("table"))
        owners[t] = np.where(instances[t] >= 0, instances[t], named)
        points[t] = world
    return points, owners


def mesh_of(
    points: Float[np.ndarray, "t h w 3"],
    owners: Int[np.ndarray, "t h w"],
    colours: UInt8[np.ndarray, "t h w 3"],
    num_objects: int,
    *,
    fine: float,
    coarse: float,
) -> Mesh:
    """Fuses the views: one vertex per voxel and owner (edge `fine` m on objects, `coarse` around them), a face where
    four near pixels of one owner lie in at least three voxels."""
    flat, whose = points.reshape(-1, 3), owners.reshape(-1)
    edge = np.where(whose < num_objects, fine, coarse)[:, None]
    keys = np.concatenate([np.floor(flat / edge).astype(np.int64), whose[:, None]], axis=1)
    _, first, vertex = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    grid = vertex.reshape(owners.shape)

    def corners(image: np.ndarray) -> np.ndarray:
        found = []
        for s in STRIDES:
            parts = image[:, :-s:s, :-s:s], image[:, :-s:s, s::s], image[:, s::s, s::s], image[:, s::s, :-s:s]
            found.append(np.stack(parts, axis=3).reshape(-1, 4, *image.shape[3:]))
        return np.concatenate(found)

    quads, of_quads, places = corners(grid), corners(owners), corners(points)
    span = np.linalg.norm(places - places[:, :1], axis=-1).max(1)
    distinct = (np.diff(np.sort(quads, axis=1), axis=1) > 0).sum(1) + 1
    kept = (of_quads == of_quads[:, :1]).all(1) & (distinct >= 3) & (span < MOST_VOXELS * coarse)
    quads, face_owners = quads[kept], of_quads[kept, 0]
    _, once = np.unique(np.sort(quads, axis=1), axis=0, return_index=True)
    quads, face_owners = quads[np.sort(once)], face_owners[np.sort(once)]
    used, faces = np.unique(quads, return_inverse=True)
    chosen = first[used]
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    vertices = np.zeros(len(used), np.dtype(kinds + [(name, "u1") for name in ("red", "green", "blue")]))
    for column, name in enumerate("xyz"):
        vertices[name] = flat[chosen, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours.reshape(-1, 3)[chosen, column]
    return Mesh(vertices, faces.reshape(-1, 4), face_owners.astype(np.int32), whose[chosen].astype(np.int32))
