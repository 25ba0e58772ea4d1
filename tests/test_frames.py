"""Photographs that are added to a field by `Scene.add` and the command line: poses, labels, what is refused."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
from balls import ring_of_balls
from capture_files import refused, run_cli
from conftest import cameras_of, gaussians_at, look_at

from jsecon import load_capture, open_scene, render_rgb
from jsecon.association.frame_superpixels import SceneSuperpixels, label_by_regions, one_hot
from jsecon.poses.resection import MIN_INLIERS, pose_finder


def centre(pose):
    return -pose[:3, :3].T @ pose[:3, 3]


@pytest.fixture(scope="module")
def bumpy_wall():
    """(gaussians, cameras, pictures): a wall of coloured blobs of different depths, seen from an arc."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1.5, 1.5, (4000, 2)), rng.uniform(-0.3, 0.3, (4000, 1))], 1)
    points[:, 2] = 0.3 * np.sin(3 * points[:, 0]) * np.cos(2 * points[:, 1]) + 0.05 * points[:, 2]
    sh = rng.uniform(-1.7, 1.7, (4000, 1, 3))
    scene = gaussians_at(points, rng.uniform(0.02, 0.06, (4000, 1)), sh=sh)
    angles = np.linspace(-0.5, 0.5, 5)
    poses = np.stack([look_at((2.2 * np.sin(a), 0.3 * a, -2.2 * np.cos(a))) for a in angles])
    cameras = cameras_of(poses, (200, 200, 98, 76), 200, 150)
    frames = [np.asarray(render_rgb(scene, camera).features) for camera in cameras]
    return scene, cameras, [(np.clip(frame, 0, 1) * 255).astype(np.uint8) for frame in frames]


def test_a_photograph_finds_its_pose_by_those_of_the_field(bumpy_wall):
    scene, cameras, pictures = bumpy_wall
    others = np.array([0, 1, 3, 4])
    find_pose = pose_finder(scene, cameras[others], [pictures[t] for t in others])
    found, inliers = find_pose(pictures[2])
    assert inliers >= 2 * MIN_INLIERS
    pose, true = (np.asarray(c.world_to_camera, np.float64) for c in (found, cameras[2]))
    assert np.degrees(np.arccos(np.clip((np.trace(pose[:3, :3] @ true[:3, :3].T) - 1) / 2, -1, 1))) < 0.2
    assert np.linalg.norm(centre(pose) - centre(true)) < 0.01
    moved = np.asarray(cameras.world_to_camera).copy()  # the photograph was taken where the world begins
    moved[:, :3, 3] += moved[:, :3, :3] @ centre(true)
    own = dataclasses.replace(scene, means=np.asarray(scene.means) - centre(true).astype(np.float32))
    cameras_there = dataclasses.replace(cameras[others], world_to_camera=moved[others])
    there, _ = pose_finder(own, cameras_there, [pictures[t] for t in others])(pictures[2])
    assert np.linalg.norm(centre(np.asarray(there.world_to_camera, np.float64))) < 0.01
    zoomed = cv2.resize(pictures[2][15:135, 20:180], (200, 150))  # another lens: 1.25 times the focal length
    found, _ = find_pose(zoomed)
    assert float(found.fx) == pytest.approx(250, rel=0.02)
    assert np.linalg.norm(centre(np.asarray(found.world_to_camera, np.float64)) - centre(true)) < 0.05


def test_photographs_of_another_place_have_no_pose(bumpy_wall):
    scene, cameras, pictures = bumpy_wall
    noise = np.random.default_rng(1).integers(0, 256, (150, 200, 3), np.uint8)
    find_pose = pose_finder(scene, cameras, pictures)
    for photo in (cv2.GaussianBlur(noise, (0, 0), 2), np.full_like(noise, 90)):
        found, inliers = find_pose(photo)
        assert found is None
        assert inliers < MIN_INLIERS


def test_a_new_view_takes_the_regions_of_its_gaussians():
    """A mask of what no region holds opens one, and so does a small part of a region, if that is asked for."""
    gaussians, cameras, frames, truth, proposals = ring_of_balls()
    view = SceneSuperpixels(gaussians, cameras[:1], proposals[:1]).all(frames[:1])[0]
    owner = np.repeat([0, 1, 2, 3], [2500, 1500, 1500, 1500])[view.seen]
    all_known = np.zeros(len(owner), bool)

    def agreement(labels, expected):
        seen = truth[0] > 0
        return (labels == expected)[seen].mean()

    labels, new = label_by_regions(view, owner, one_hot(owner, 4), all_known)
    assert new == 0
    assert agreement(labels, truth[0]) > 0.95
    without = np.where(owner == 2, -1, owner)
    labels, new = label_by_regions(view, without, one_hot(without, 4), without < 0)
    assert new == 1
    assert agreement(labels, np.where(truth[0] == 2, 4, truth[0])) > 0.95
    merged = np.where(owner == 1, 0, owner)
    labels, new = label_by_regions(view, merged, one_hot(merged, 4), all_known)
    assert new == 0
    labels, new = label_by_regions(view, merged, one_hot(merged, 4), all_known, split=True)
    assert new == 1
    assert agreement(labels, np.where(truth[0] == 1, 4, truth[0])) > 0.95
    both = one_hot(merged, 4) + one_hot(np.where(owner == 1, 1, -1), 4)  # a frame before had split it
    labels, new = label_by_regions(view, merged, both, all_known, split=True)
    assert new == 0
    assert agreement(labels, truth[0]) > 0.95


@pytest.fixture
def field(room_run, tmp_path):
    """A copy of the folder of a run."""
    return shutil.copytree(room_run[1], tmp_path / "field")


def test_a_frame_that_was_forgotten_is_added_again(field, room):
    """By its pose: what it shows gets the same regions, and the others stay as they were."""
    scene = open_scene(field)
    name = list(scene.ledger.views)[2]
    less = scene.forget([name])
    assert name not in less.field.names
    grown = less.add(room, masks=room / "masks")
    assert grown.field.names == scene.field.names
    for a, b, exact in zip(grown.field.cameras, scene.field.cameras, [n != name for n in scene.field.names]):
        assert np.allclose(a.world_to_camera, b.world_to_camera, atol=0 if exact else 1e-5)
    t = scene.field.names.index(name)
    before, after = (np.asarray(s.field.regions.pixel_counts)[:, t] for s in (scene, grown))
    assert np.minimum(before, after[: len(before)]).sum() > 0.9 * before.sum()
    same = np.asarray(grown.field.votes.regions)[:, 0] == np.asarray(scene.field.votes.regions)[:, 0]
    assert same.mean() > 0.97
    with refused("already"):
        grown.add(room)


def test_ignored_pixels_of_a_new_frame_count_nowhere(field, room):
    scene = open_scene(field)
    name = list(scene.ledger.views)[2]
    less, capture = scene.forget([name]), load_capture(room)
    ignored = np.zeros(np.shape(capture.frames)[:3], bool)
    ignored[:, :, : ignored.shape[2] // 2] = True
    whole = less.add(capture, masks=room / "masks")
    part = less.add(dataclasses.replace(capture, ignored=ignored), masks=room / "masks")
    t = part.field.names.index(name)
    pixels = [np.asarray(s.field.regions.pixel_counts)[:, t].sum() for s in (part, whole)]
    weight = [np.asarray(s.field.votes.total, np.float64).sum() for s in (less, part, whole)]
    assert 0 < pixels[0] < pixels[1]
    assert 0.3 < (weight[1] - weight[0]) / (weight[2] - weight[0]) < 0.7


def test_the_command_line_forgets_and_adds(field, room, tmp_path, capsys):
    """Photographs that cannot be added are listed, and the field stays as it is."""
    file, name = field / "field.safetensors", open_scene(field).field.names[1]
    assert run_cli("forget", field, "--frames", name) == 0
    assert {path.name for path in field.iterdir()} == {"field.safetensors", "field.evidence", ".lock"}
    assert not any(name.encode() in path.read_bytes() for path in field.rglob("*") if path.is_file())
    before = {path: path.read_bytes() for path in field.rglob("*.safetensors")}
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 cut short")
    noise = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    cv2.imwrite(str(photos / "elsewhere.png"), cv2.resize(noise, (160, 120)))
    assert run_cli("add", field, photos) == 2
    printed = capsys.readouterr().err
    assert "broken.jpg" in printed
    assert "of its features agree" in printed
    assert {path: path.read_bytes() for path in field.rglob("*.safetensors")} == before
    assert run_cli("add", field, room, "--out", tmp_path / "more") == 0
    assert name in open_scene(tmp_path / "more").field.names
    assert file.read_bytes() == before[file]
    assert run_cli("doctor", field) == 0
    assert "picture" in capsys.readouterr().out
