"""Objects of a real scan with names: connected parts of its instance ids, named by the nearest named points."""

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jsecon.types import Capture

CLASSES = (
    "wall", "floor", "ceiling", "door", "blinds", "sofa", "rug", "table", "base-cabinet", "wall-cabinet", "window",
    "chair", "indoor-plant", "refrigerator", "picture",
)  # fmt: skip
"""Classes of replica_apartment_0 with enough named points."""
NEAR_M = 0.10
"""Largest distance between a Gaussian and the point that names it, m."""


def connected_parts(capture: Capture, ids: np.ndarray, *, voxel: float = 0.1, least: int = 10) -> np.ndarray:
    """Parts (T, H, W) int32 of ids (T, H, W), -1 = none: what hangs together in space, by the depths of all views.

    Voxels (edge in world units) that hold pixels of an id are joined with those of the same id among their 26
    neighbours. A part of fewer than `least` voxels, which is an outline's noise, goes to the nearest larger one of its
    id. Pixels without depth are -1.
    """
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    cells = []
    for t, (depth, image) in enumerate(zip(capture.depths, ids, strict=True)):
        camera = capture.cameras[t]
        row, column = np.nonzero((depth > 0) & (image >= 0))
        z = depth[row, column].astype(np.float64)
        x = (column + 0.5 - float(camera.cx)) / float(camera.fx) * z
        y = (row + 0.5 - float(camera.cy)) / float(camera.fy) * z
        world = (np.stack([x, y, z], 1) - poses[t, :3, 3]) @ poses[t, :3, :3]
        cells.append(np.column_stack([np.floor(world / voxel), image[row, column]]).astype(np.int64))
    lowest = np.min([own.min(0) for own in cells], axis=0)
    size = np.max([own.max(0) for own in cells], axis=0) - lowest + 1
    keys = [np.ravel_multi_index((own - lowest).T, size) for own in cells]
    known = np.unique(np.concatenate([np.unique(own) for own in keys]))
    place = np.stack(np.unravel_index(known, size), 1)
    place, name = place[:, :3].astype(np.float64), place[:, 3]
    pairs = cKDTree(place).query_pairs(1.75, output_type="ndarray")  # the diagonal of a voxel is 1.73
    pairs = pairs[name[pairs[:, 0]] == name[pairs[:, 1]]]
    joined = sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(known), len(known)))
    part = connected_components(joined, directed=False)[1]
    small = np.bincount(part)[part] < least
    for number in np.unique(name[small]):
        few, many = np.flatnonzero(small & (name == number)), np.flatnonzero(~small & (name == number))
        if len(many):
            part[few] = part[many[cKDTree(place[many]).query(place[few])[1]]]
    result = np.full(ids.shape, -1, np.int32)
    for t, own in enumerate(keys):
        result[t][(capture.depths[t] > 0) & (ids[t] >= 0)] = part[np.searchsorted(known, own)]
    return result


def names_of_objects(label: np.ndarray, name: np.ndarray, count: int, classes: int) -> np.ndarray:
    """(R,) the name that most of the points of each object have; -1 where none has any. `label` and `name` (P,) are the
    object and the name of each point, -1 = none."""
    known = (label >= 0) & (name >= 0)
    table = np.zeros((count, classes), int)
    np.add.at(table, (label[known], name[known]), 1)
    return np.where(table.any(1), table.argmax(1), -1)
