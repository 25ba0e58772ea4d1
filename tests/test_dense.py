"""Dense points by stereo between posed views, against a room whose surfaces are known; and random points."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial import KDTree

from jsecon.demo.capture import render_capture, room_cameras
from jsecon.demo.room import make_room
from jsecon.errors import InputError
from jsecon.fit.dense import dense_points, random_points
from jsecon.fit.depth import points_from_depth
from jsecon.fit.start import starting_gaussians


@functools.cache
def room():
    """Six neighbouring views of the demo's room with true depth; the third is held out."""
    made = make_room(0)
    cameras = room_cameras(made, views=45, width=200, height=150)[np.arange(6)]
    out = np.arange(6) == 2
    return render_capture(made, cameras, tuple(map(str, range(6))), out, points=2000)[0]


def without_depth(capture):
    return dataclasses.replace(capture, depths=None)


@functools.cache
def room_points(max_points=3000):
    return dense_points(without_depth(room()), max_points=max_points)


def seen_by(cameras, points):
    """(T, P) whether each point lies in each picture, and (T, P, 2) where."""
    local = np.einsum("tab,pb->tpa", cameras.world_to_camera[:, :3, :3], points)
    local = local + np.asarray(cameras.world_to_camera)[:, None, :3, 3]
    x = local[..., 0] / local[..., 2] * cameras.fx[:, None] + cameras.cx[:, None]
    y = local[..., 1] / local[..., 2] * cameras.fy[:, None] + cameras.cy[:, None]
    pixels = np.stack([x, y], axis=-1)
    return (local[..., 2] > 0) & (pixels >= 0).all(-1) & (pixels < [cameras.width, cameras.height]).all(-1), pixels


def off_the_surface(points, colors):
    """Distance of each point to the nearest point that any view truly sees, as a share of its distance to the first
    camera, and the difference of their colours (0 to 255)."""
    truth = points_from_depth(room(), voxel=1e-3, frames=np.arange(6))
    distance, nearest = KDTree(truth.points).query(points)
    far = np.linalg.norm(points - room().cameras.centres[0], axis=1)
    return distance / far, np.abs(colors.astype(int) - truth.colors[nearest]).max(axis=1)


def test_dense_points_lie_on_the_surfaces_and_have_their_colours():
    points, colors = room_points()
    assert points.dtype == np.float32
    assert colors.dtype == np.uint8
    assert 2000 < len(points) <= 3000
    error, shade = off_the_surface(points, colors)
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.05
    assert np.median(shade) < 10


def test_dense_points_cover_what_the_views_see():
    inside, pixels = seen_by(room().cameras, room_points()[0])
    filled = np.zeros((10, 8), bool)
    column, row = (pixels[1][inside[1]] // [20, 18.75]).astype(int).T
    filled[column, row] = True
    assert filled.mean() > 0.7


def test_the_same_points_come_every_time_and_no_more_than_asked_for():
    again, colors = dense_points(without_depth(room()), max_points=3000)
    np.testing.assert_array_equal(again, room_points()[0])
    np.testing.assert_array_equal(colors, room_points()[1])
    assert 300 < len(room_points(500)[0]) <= 500


def test_held_out_frames_are_not_looked_at():
    frames = np.array(room().frames)
    frames[2] = 0
    black = dataclasses.replace(without_depth(room()), frames=frames)
    np.testing.assert_array_equal(dense_points(black, max_points=3000)[0], room_points()[0])
    np.testing.assert_array_equal(random_points(black, 50)[1], random_points(room(), 50)[1])


def test_a_capture_without_points_is_matched_too():
    none = np.zeros((0, 3))
    bare = dataclasses.replace(
        without_depth(room()), points=none.astype(np.float32), point_colors=none.astype(np.uint8)
    )
    assert np.median(off_the_surface(*dense_points(bare, max_points=3000))[0]) < 0.01


def chosen(frames):
    """The room of these frames alone, none held out."""
    capture, frames = without_depth(room()), np.asarray(frames)
    return dataclasses.replace(
        capture,
        frames=capture.frames[frames],
        cameras=capture.cameras[frames],
        held_out=np.zeros(len(frames), bool),
        names=tuple(capture.names[t] for t in frames),
    )


def test_what_cannot_be_matched_is_refused():
    with pytest.raises(InputError, match=r"1 frames to match.*at least 3"):
        dense_points(chosen([0]), max_points=1000)
    blank = dataclasses.replace(without_depth(room()), frames=np.full_like(room().frames, 90))
    with pytest.raises(InputError, match=r"points that three views agree on.*texture"):
        dense_points(blank, max_points=1000)
    apart = chosen([0, 1, 3])
    poses = np.array(apart.cameras.world_to_camera)
    for t in range(3):  # each camera is moved away to the side, so that no two see the same
        poses[t, 0, 3] += 1000 * t
    apart = dataclasses.replace(apart, cameras=dataclasses.replace(apart.cameras, world_to_camera=poses))
    with pytest.raises(InputError, match="overlap"):
        dense_points(apart, max_points=1000)
    with pytest.raises(ValueError, match="max_points"):
        dense_points(without_depth(room()), max_points=3)


def test_random_points_lie_where_two_views_look():
    points, colors = random_points(room(), 500)
    assert points.shape == colors.shape == (500, 3)
    inside, pixels = seen_by(room().cameras, points)
    assert (inside[~room().held_out].sum(0) >= 2).all()
    kept = np.flatnonzero(~room().held_out)
    one = next(p for p in range(500) if inside[kept, p].sum() == 2)
    shades = [room().frames[t][tuple(pixels[t, one].astype(int)[::-1])] for t in kept if inside[t, one]]
    np.testing.assert_allclose(colors[one], np.mean(shades, axis=0), atol=1)
    np.testing.assert_array_equal(random_points(room(), 500)[0], points)
    near = np.linalg.norm(points - points.mean(0), axis=1)
    assert 0.1 < (near > 2 * np.median(near)).mean() < 0.5  # the background too
    with pytest.raises(InputError, match="overlap"):
        random_points(chosen([0]), 10)


def test_a_start_of_each_kind_says_where_it_comes_from():
    bare = without_depth(room())
    for start, capture, word in (
        ("auto", room(), "depth frames"),
        ("dense", room(), "depth frames"),
        ("auto", bare, "sparse points"),
        ("sparse", room(), "sparse points"),
        ("dense", bare, "stereo"),
        ("random", bare, "random"),
    ):
        gaussians, sentence = starting_gaussians(capture, start=start, sh_degree=1)
        assert word in sentence
        assert sentence.startswith(str(gaussians.count))
        assert gaussians.sh.shape[1:] == (4, 3)
