"""load_capture finds the format; options are checked; views that cannot overlap are told, others never."""

import dataclasses

import numpy as np
import pytest
from capture_files import refused, small_capture, transforms, write_transforms
from scipy.optimize import linprog

from jsecon.data.capture import check_views_overlap, load_capture
from jsecon.data.colmap import write_colmap
from jsecon.data.coordinates import camera_jumps
from jsecon.data.frames import evenly_spaced
from jsecon.types import Camera

CAPTURE = small_capture()


def test_formats_are_detected(tmp_path):
    write_colmap(CAPTURE, tmp_path / "colmap")
    write_transforms(CAPTURE, tmp_path / "nerfstudio")
    (tmp_path / "nerfstudio/transforms.json").rename(tmp_path / "nerfstudio/transforms_train.json")
    for path in ("colmap", "nerfstudio/transforms_train.json"):
        loaded = load_capture(tmp_path / path)
        np.testing.assert_array_equal(loaded.frames, CAPTURE.frames)
    (tmp_path / "nerfstudio/images").rename(tmp_path / "elsewhere")
    with refused("nerfstudio", "without poses", "transforms_train.json"):
        load_capture(tmp_path / "nerfstudio")
    with refused("nowhere", "no such file or folder"):
        load_capture(tmp_path / "nowhere")
    write_transforms(CAPTURE, tmp_path / "colmap", {**transforms(CAPTURE), "frames": []})
    assert len(load_capture(tmp_path / "colmap").points) == len(CAPTURE.points)


@pytest.mark.parametrize("options", [
    {"downscale": 0.5}, {"downscale": float("nan")}, {"long_side": 0}, {"frames": 0}, {"holdout": 1},
    {"holdout": -8},
])  # fmt: skip
def test_options_are_checked(tmp_path, options):
    write_colmap(CAPTURE, tmp_path)
    with refused(*options):
        load_capture(tmp_path, **options)


def test_frames_are_taken_by_name(tmp_path):
    write_colmap(CAPTURE, tmp_path)
    names = CAPTURE.names[3], CAPTURE.names[1]
    loaded = load_capture(tmp_path, only=names, holdout=None)
    assert loaded.names == names[::-1]  # in the capture's order
    np.testing.assert_array_equal(loaded.frames, CAPTURE.frames[[1, 3]])
    np.testing.assert_allclose(loaded.cameras.world_to_camera, CAPTURE.cameras.world_to_camera[[1, 3]], atol=1e-6)
    with refused("no frame called nothing among the 5"):
        load_capture(tmp_path, only=["nothing", names[0]])
    with refused("no frame called ..."):
        load_capture(tmp_path, only=[])


def test_options_and_progress(tmp_path):
    write_colmap(CAPTURE, tmp_path)
    calls = []
    loaded = load_capture(tmp_path, downscale=1.5, frames=4, holdout=None, progress=lambda *call: calls.append(call))
    assert loaded.frames.shape == (4, 11, 16, 3)
    np.testing.assert_allclose(loaded.cameras.fx, CAPTURE.cameras.fx[[0, 1, 3, 4]] / 1.5)
    np.testing.assert_allclose(loaded.cameras.fy, CAPTURE.cameras.fy[[0, 1, 3, 4]] * 11 / 16)
    assert not loaded.held_out.any()
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    same = load_capture(tmp_path, long_side=16, frames=4)
    np.testing.assert_array_equal(same.frames, loaded.frames)
    assert load_capture(tmp_path, long_side=100).frames.shape == CAPTURE.frames.shape
    single = load_capture(tmp_path, frames=1)
    assert not single.held_out.any()
    assert any("only one" in note for note in single.notes)


@pytest.mark.parametrize("count", [1, 2, 7, 50])
@pytest.mark.parametrize("wanted", [1, 2, 3, 7, 49, 100, None])
def test_spread(count, wanted):
    chosen = evenly_spaced(count, wanted)
    assert len(chosen) == min(count, wanted or count)
    assert chosen[0] == 0
    assert len(chosen) == 1 or chosen[-1] == count - 1
    gaps = np.diff(chosen)
    assert len(gaps) == 0 or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)


def with_cameras(poses, **more):
    count = len(poses)
    one = np.ones(count, np.float32)
    cameras = Camera(np.asarray(poses, np.float32), 20 * one, 20 * one, 12 * one, 8 * one, width=24, height=16)
    changes = {"cameras": cameras, "names": CAPTURE.names[:count], "points": np.zeros((0, 3), np.float32), **more}
    return dataclasses.replace(CAPTURE, **changes)


def back_to_back() -> np.ndarray:
    """One camera at z = 1 that looks along z, one at z = -1 that looks along -z."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = np.diag([-1, 1, -1])
    poses[:, 2, 3] = -1
    return poses


def test_views_apart_are_told():
    with refused("2 views look apart"):
        check_views_overlap(with_cameras(back_to_back()))
    with refused("a single view"):
        check_views_overlap(with_cameras(np.eye(4)[None]))
    points = np.array([[0, 0, 5], [0, 0, -5], [50, 0, 0]], np.float32)
    with refused("no two of its", "3 sparse points"):
        check_views_overlap(with_cameras(back_to_back(), points=points))


def test_views_together_pass():
    check_views_overlap(CAPTURE)
    check_views_overlap(dataclasses.replace(CAPTURE, points=np.zeros((0, 3), np.float32)))
    check_views_overlap(with_cameras(np.tile(np.eye(4), (2, 1, 1))))
    check_views_overlap(with_cameras(np.eye(4)[None], depths=np.ones((1, 16, 24), np.float32)))
    face_to_face = back_to_back()
    face_to_face[:, 2, 3] = 1
    check_views_overlap(with_cameras(face_to_face))
    points = np.tile(np.float32([0, 0, -1]), (70000, 1))
    points[-1, 2] = 4
    check_views_overlap(with_cameras(np.tile(np.eye(4), (2, 1, 1)), points=points))


def half_spaces(camera):
    """(4, 3) and (4,): x lies in the frustum where normals @ x >= bounds."""
    corners = np.array([[0, 0], [24, 0], [24, 16], [0, 16]]) - [12, 8]
    rays = np.concatenate([corners / 20, np.ones((4, 1))], 1)
    normals = np.cross(rays, np.roll(rays, -1, axis=0))
    normals *= np.sign(normals @ [0, 0, 1])[:, None]
    rotation, translation = camera.world_to_camera[:3, :3].astype(float), camera.world_to_camera[:3, 3].astype(float)
    return normals @ rotation, -normals @ translation


def test_frusta_against_linear_programming():
    """200 random pairs: told apart exactly where no point satisfies all eight half-spaces."""
    rng = np.random.default_rng(5)
    answers = []
    for _ in range(200):
        poses = np.tile(np.eye(4), (2, 1, 1))
        for pose in poses:
            turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
            pose[:3, 3] = rng.normal(size=3) * 3
        capture = with_cameras(poses)
        planes = [half_spaces(capture.cameras[index]) for index in range(2)]
        normals, bounds = (np.concatenate(parts) for parts in zip(*planes))
        meets = linprog(np.zeros(3), -normals, -bounds, bounds=(None, None)).status == 0
        answers.append(meets)
        if meets:
            check_views_overlap(capture)
        else:
            with refused("look apart"):
                check_views_overlap(capture)
    assert 40 < sum(answers) < 190


def walk(count=40):
    """(T, 4, 4) poses on an arc, steps of a tenth to twice the usual, and their names."""
    along = np.cumsum(np.random.default_rng(0).uniform(0.1, 2.0, count)) / count
    centres = np.stack([np.cos(along), np.zeros(count), np.sin(along)], axis=1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(count, 3, 3)))[0]
    poses[:, :3, 3] = -np.einsum("tij,tj->ti", poses[:, :3, :3], centres)
    return poses, [f"frame_{t:03d}" for t in range(count)]


def test_poses_that_jump_are_told_and_frames_that_do_not_move_or_have_no_order_do_not_jump():
    poses, names = walk()
    assert camera_jumps(poses, names) == []
    order = np.random.default_rng(2).permutation(len(poses))
    assert camera_jumps(poses[order], names) == []
    assert camera_jumps(np.tile(np.eye(4), (9, 1, 1)), names) == []
    assert camera_jumps(poses[:1], names) == []
    poses[12:15, :3, 3] -= poses[12:15, :3, :3] @ [15 / 40, 0, 0]  # the centres move along x
    (note,) = camera_jumps(poses, names)
    assert "2 places" in note
    assert "frame_011 to frame_012, frame_014 to frame_015)" in note


def test_a_loaded_capture_says_where_its_poses_jump(tmp_path):
    poses = np.array(CAPTURE.cameras.world_to_camera)
    poses[-1, :3, 3] += 1000
    moved = dataclasses.replace(CAPTURE, cameras=dataclasses.replace(CAPTURE.cameras, world_to_camera=poses))
    write_transforms(moved, tmp_path)
    assert any("jumps in" in note for note in load_capture(tmp_path).notes)
