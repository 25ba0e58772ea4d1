"""Normals of a cloud, and the surfaces of frames with depth."""

import numpy as np
import pytest

from jsecon.types import Camera
from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.surfaces import Surface, _cloud_normals, surfaces_from_depth


def corridor(height=60, width=80, focal=40.0):
    """z-depths of a corridor seen along its floor: floor and ceiling 1 m off, a wall 8 m away; and who is where."""
    rows = np.mgrid[:height, :width][0] + 0.5 - height / 2
    floor = focal / np.maximum(np.abs(rows), 1e-6)
    depth = np.minimum(floor, 8.0).astype(np.float32)
    return depth, np.where(floor >= 8.0, 2, np.where(rows > 0, 0, 1))


def camera_of(height, width, focal, poses):
    lens = [np.full(len(poses), number, np.float32) for number in (focal, focal, width / 2, height / 2)]
    return Camera(np.asarray(poses, np.float32), *lens, width=width, height=height)


def camera_points(depth, camera):
    """Points of z-depths in camera axes."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)]
    return np.stack(rays, -1) * depth[..., None].astype(np.float64)


def angles(found, wanted):
    return np.degrees(np.arccos(np.clip(np.abs((found * wanted).sum(-1)), 0, 1)))


def test_normals_of_a_sphere_and_of_a_box_s_edge():
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    assert np.percentile(angles(_cloud_normals(2 + 3 * sphere), sphere), 99) < 6
    flat = rng.uniform(-1, 1, (4000, 2))
    x, y = flat.T
    edge = np.where(x[:, None] < 0, np.stack([x, y, 0 * x], 1), np.stack([0 * x, y, x], 1))
    wanted = np.where(x[:, None] < 0, [0, 0, 1.0], [1.0, 0, 0])
    noisy = edge + rng.normal(0, 0.005, edge.shape)
    off = angles(_cloud_normals(noisy), wanted)
    assert np.median(off) < 4
    assert np.percentile(off[np.abs(x) > 0.1], 98) < 15  # the crease stays sharp
    np.testing.assert_allclose(np.linalg.norm(_cloud_normals(noisy[:3]), axis=1), 1)


def test_a_plane_has_no_steps_however_steeply_it_is_seen():
    depth, which = corridor()
    camera = camera_of(60, 80, 40.0, [np.eye(4)])[0]
    points = camera_points(depth, camera).astype(np.float32)
    normals = np.array([[0, -1, 0], [0, 1, 0], [0, 0, -1]], np.float32)[which]
    surface = Surface(points, normals)
    for axis, size in ((0, 60), (1, 80)):
        near = np.arange(size - 1)
        off = surface.off_plane(axis, near, near + 1)
        same = np.take(which, near, axis) == np.take(which, near + 1, axis)
        assert off[same].max() < 1e-3
    jump = points.copy()
    jump[:, 40:] *= 0.8  # nearer by a fifth
    off = Surface(jump, normals).off_plane(1, np.array([39]), np.array([40]))
    np.testing.assert_allclose(off[which[:, 39] == 2], 0.25, atol=0.01)


@pytest.fixture(scope="module")
def seen():
    """Two views of the corridor, their depths stored in steps of 4 cm."""
    depth, which = corridor()
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.1
    depths = np.stack([depth, depth])
    rng = np.random.default_rng(0)
    depths = (0.04 * np.round((depths + rng.uniform(-0.02, 0.02, depths.shape)) / 0.04)).astype(np.float32)
    cameras = camera_of(60, 80, 40.0, poses)
    clouds = [camera_points(d, cameras[t]) - poses[t, :3, 3] for t, d in enumerate(depths)]
    return depths, cameras, np.concatenate(clouds).reshape(-1, 3)[::2], which


def test_pixels_take_the_normals_of_the_joint_cloud(seen):
    depths, cameras, cloud, which = seen
    wanted = np.array([[0, -1.0, 0], [0, 1, 0], [0, 0, -1]])[which]
    surfaces = surfaces_from_depth(depths, cameras, cloud)
    for t in range(2):
        found = surfaces(t)
        assert found.points.shape == found.normals.shape == (60, 80, 3)
        assert found.points.dtype == found.normals.dtype == np.float32
        assert (np.einsum("hwk,hwk->hw", found.points, found.normals) <= 1e-6).all()
        off = angles(found.normals, wanted)
        assert np.mean(off < 15) > 0.85
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
