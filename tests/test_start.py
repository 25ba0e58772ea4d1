"""Starts from points and from depth, against brute force and against a scene whose answer is known."""

import dataclasses

import numpy as np
import pytest
from conftest import cameras_of, capture_of
from hypothesis import given, settings, strategies as st

from jsecon import InputError
from jsecon.fit.start import points_from_depth, starting_gaussians
from jsecon.splat.points import gaussians_from_points
from jsecon.splat.sh import C0


def brute_distances(points, neighbours=3):
    distance = np.linalg.norm(points[:, None].astype(np.float64) - points[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    nearest = np.sort(distance, axis=1)[:, : min(neighbours, len(points) - 1)]
    return np.sqrt(np.maximum((nearest**2).mean(axis=1), 1e-7))


@settings(deadline=None, max_examples=20)
@given(st.integers(2, 40), st.integers(0, 1000))
def test_gaussians_from_points_hold_the_colour_opacity_and_scale(count, seed):
    rng = np.random.default_rng(seed)
    points, colors = rng.standard_normal((count, 3)), rng.integers(0, 256, (count, 3)).astype(np.uint8)
    points[: count // 3] = points[0]  # duplicates
    gaussians = gaussians_from_points(points, colors, opacity=0.3, sh_degree=2)
    assert gaussians.sh.shape == (count, 9, 3)
    np.testing.assert_allclose(0.5 + C0 * gaussians.sh[:, 0], colors / 255, atol=1e-6)
    assert not gaussians.sh[:, 1:].any()
    np.testing.assert_allclose(1 / (1 + np.exp(-gaussians.opacity_logits)), 0.3, rtol=1e-6)
    distances = brute_distances(points)
    np.testing.assert_allclose(np.exp(gaussians.log_scales), np.repeat(distances[:, None], 3, 1), rtol=1e-5)
    np.testing.assert_array_equal(gaussians.quaternions, np.tile([1, 0, 0, 0], (count, 1)))
    capped = gaussians_from_points(points, colors, max_scale=0.2, scale=0.5)
    np.testing.assert_allclose(np.exp(capped.log_scales[:, 0]), np.minimum(0.5 * distances, 0.2), rtol=1e-5)
    alone = gaussians_from_points(points[:1], colors[:1])
    np.testing.assert_allclose(np.exp(alone.log_scales), np.sqrt(1e-7), rtol=1e-5)


def wall_capture(height=24, width=32, views=3):
    """Cameras that look along z at the plane z = 2 from different places; each third of the wall has its own colour."""
    focal = 30.0
    frames, depths, poses = [], [], []
    for t in range(views):
        centre = np.array([0.3 * t - 0.3, 0.1 * t, -0.2 * t])
        pose = np.eye(4)
        pose[:3, 3] = -centre
        depth = np.full((height, width), 2.0 - centre[2], np.float32)
        x = (np.arange(width) + 0.5 - width / 2) / focal * depth[0, 0] + centre[0]
        third = np.clip(np.floor((x + 1.2) / 0.8), 0, 2).astype(int)
        frames.append(np.broadcast_to(np.eye(3)[third] * 200, (height, width, 3)).astype(np.uint8))
        depths.append(depth)
        poses.append(pose)
    depths[0][:4] = 0  # unknown
    cameras = cameras_of(poses, (focal, focal, width / 2, height / 2), width, height)
    return capture_of(frames, cameras, np.arange(views) == views - 1, np.array(depths))


def test_points_from_depth_lie_on_the_wall_and_agree_between_views():
    capture = wall_capture()
    found = points_from_depth(capture, voxel=0.2)
    np.testing.assert_allclose(found.points[:, 2], 2.0, atol=1e-5)
    # The view from another place puts the same colours on the same part of the wall.
    inside = (np.abs((found.points[:, 0] + 1.2) % 0.8 - 0.4) < 0.25) & (np.abs(found.points[:, 0]) < 1)
    third = np.clip(np.floor((found.points[:, 0] + 1.2) / 0.8), 0, 2).astype(int)
    assert inside.sum() > 10
    np.testing.assert_array_equal(found.colors[inside].argmax(axis=1), third[inside])
    assert (found.colors[inside].max(axis=1) == 200).all()


def test_depth_points_are_at_most_so_many_and_need_depth():
    capture = wall_capture()
    for voxel in (0.0, 1e-3):
        assert 40 <= len(points_from_depth(capture, voxel=voxel, max_points=50).points) <= 50
    assert points_from_depth(capture, voxel=0.5, max_points=50).voxel == 0.5
    for match, depths in (("no depth", None), ("no pixel", np.zeros_like(capture.depths))):
        with pytest.raises(InputError, match=match):
            points_from_depth(dataclasses.replace(capture, depths=depths), voxel=0.1)
    with pytest.raises(ValueError, match="voxel"):
        points_from_depth(capture)


def test_a_start_takes_depth_before_sparse_points_and_says_so():
    capture = wall_capture()
    points = np.random.default_rng(0).standard_normal((60, 3)).astype(np.float32)
    sparse = dataclasses.replace(capture, points=points, point_colors=np.zeros((60, 3), np.uint8))
    assert "depth frames" in starting_gaussians(sparse)[1]
    gaussians, origin = starting_gaussians(dataclasses.replace(sparse, depths=None))
    assert origin == "60 sparse points of the capture"
    np.testing.assert_array_equal(gaussians.means, points)


def test_a_capture_of_few_points_gets_others_between_them_on_their_wall_in_its_colours():
    capture = dataclasses.replace(wall_capture(240, 320), depths=None)
    known = np.random.default_rng(0).uniform((-1.5, -1, 2), (1.5, 1, 2), (60, 3)).astype(np.float32)
    capture = dataclasses.replace(capture, points=known, point_colors=np.full((60, 3), 90, np.uint8))
    gaussians, origin = starting_gaussians(capture)
    assert 200 < gaussians.count <= 1000 * 3 * 240 * 320 / 1e6
    assert "put between them" in origin
    points, colors = gaussians.means[60:], 255 * (0.5 + C0 * gaussians.sh[60:, 0])
    np.testing.assert_allclose(points[:, 2], 2, atol=1e-5)
    thirds = np.clip(np.floor((points[:, 0] + 1.2) / 0.8), 0, 2).astype(int)
    right = (np.abs(colors - np.eye(3)[thirds] * 200) < 1).all(1)
    assert right.mean() >= 0.9  # a column of pixels lies on a border
    hidden = np.ones(np.shape(capture.frames)[:3], bool)
    for changes in ({"ignored": hidden}, {"points": -known}):  # no pixel that counts, no point before a camera
        assert starting_gaussians(dataclasses.replace(capture, **changes))[0].count == 60
