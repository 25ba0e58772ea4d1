"""The surfaces of frames with depth."""

import numpy as np
import pytest
from conftest import cameras_of

from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.surfaces import Surface, surfaces_from_depth


def corridor(height=60, width=80, focal=40.0):
    """z-depths of a corridor seen along its floor: floor and ceiling 1 m off, a wall 8 m away; and who is where."""
    rows = np.mgrid[:height, :width][0] + 0.5 - height / 2
    floor = focal / np.maximum(np.abs(rows), 1e-6)
    depth = np.minimum(floor, 8.0).astype(np.float32)
    return depth, np.where(floor >= 8.0, 2, np.where(rows > 0, 0, 1))


def camera_points(depth, camera):
    """Points of z-depths in camera axes."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)]
    return np.stack(rays, -1) * depth[..., None].astype(np.float64)


@pytest.fixture(scope="module")
def seen():
    """Two views of the corridor, their depths stored in steps of 4 cm."""
    depth, which = corridor()
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.1
    noise = np.random.default_rng(0).uniform(-0.02, 0.02, (2, *depth.shape))
    depths = (0.04 * np.round((depth + noise) / 0.04)).astype(np.float32)
    cameras = cameras_of(poses, (40, 40, 40, 30), 80, 60)
    clouds = [camera_points(d, cameras[t]) - poses[t, :3, 3] for t, d in enumerate(depths)]
    return depths, cameras, np.concatenate(clouds).reshape(-1, 3)[::2], which


def test_pixels_take_the_normals_of_the_joint_cloud(seen):
    depths, cameras, cloud, which = seen
    wanted = np.array([[0, -1.0, 0], [0, 1, 0], [0, 0, -1]])[which]
    surfaces = surfaces_from_depth(depths, cameras, cloud)
    for t in range(2):
        found = surfaces(t)
        assert found.points.shape == found.normals.shape == (60, 80, 3)
        assert (np.einsum("hwk,hwk->hw", found.points, found.normals) <= 1e-6).all()
        cosines = np.abs((found.normals * wanted).sum(-1))
        assert np.mean(cosines > np.cos(np.radians(15))) > 0.85
    none = surfaces_from_depth(np.stack([np.zeros((60, 80), np.float32), depths[1]]), cameras, cloud)
    assert none(0) is None
    assert none(1) is not None


def test_a_floor_seen_along_is_one_region_and_parts_from_the_wall(seen):
    depths, cameras, cloud, which = seen
    frame = np.full((60, 80, 3), 150, np.uint8)
    masks = ClassicalSegmenter(surfaces=surfaces_from_depth(depths, cameras, cloud))(frame, 0)
    for k in range(3):
        thing = which == k
        iou = (masks & thing).sum((1, 2)) / (masks | thing).sum((1, 2))
        assert iou.max() > 0.8
    np.testing.assert_array_equal(ClassicalSegmenter(surfaces=lambda t: None)(frame, 0), ClassicalSegmenter()(frame, 0))
    with pytest.raises(ValueError, match="surface"):
        ClassicalSegmenter(surfaces=lambda t: Surface(np.ones((4, 4, 3)), np.ones((4, 4, 3))))(frame, 0)
