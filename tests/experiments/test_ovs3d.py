"""3D-OVS: the twin comes back; folders count the sorted images; classes that are missing, extra or empty."""

import shutil

import cv2
import numpy as np
import pytest
from capture_files import refused, ring_poses
from twin_files import ovs3d_twin, rooms_instances

from experiments.datasets.ovs3d import OVS3D_PAIRS, box_of, load_ovs3d, read_poses_bounds, write_poses_bounds
from experiments.datasets.plain_room import make_room


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return ovs3d_twin(tmp_path_factory.mktemp("ovs3d"))


@pytest.fixture
def copy(twin, tmp_path):
    return shutil.copytree(twin, tmp_path / "copy")


def test_every_field_comes_back(twin):
    scene = load_ovs3d(twin, "bed")
    room = make_room(1, num_objects=6)
    instances = rooms_instances(1, scene.capture.cameras)
    assert scene.queries == tuple(sorted(room.names))
    assert len(scene.frames) == 3
    assert scene.pairs == 18
    assert [scene.capture.names[t] for t in np.flatnonzero(scene.capture.held_out)] == [f.name for f in scene.frames]
    for frame in scene.frames:
        assert tuple(frame.objects) == scene.queries
        for name, (mask, boxes) in frame.objects.items():
            true = instances[int(frame.name)] == room.names.index(name)
            assert (mask != true).sum() <= 2
            np.testing.assert_array_equal(boxes, box_of(mask))


def test_poses_without_a_model(copy):
    """The same cameras from poses_bounds.npy, at the images' size; no points."""
    before = load_ovs3d(copy, "bed").capture
    shutil.rmtree(copy / "bed" / "sparse")
    after = load_ovs3d(copy, "bed").capture
    np.testing.assert_allclose(after.cameras.world_to_camera, before.cameras.world_to_camera, atol=2e-6)
    for name in ("fx", "fy", "cx", "cy"):
        np.testing.assert_allclose(getattr(after.cameras, name), getattr(before.cameras, name), rtol=1e-5)
    assert after.names == before.names
    assert len(after.points) == 0
    np.testing.assert_array_equal(after.held_out, before.held_out)


def test_poses_bounds_round_trip(tmp_path):
    poses, sizes = ring_poses(5), np.tile([30.0, 40.0, 35.5], (5, 1))
    bounds = np.random.default_rng(0).uniform(1, 9, (5, 2))
    write_poses_bounds(tmp_path / "poses_bounds.npy", poses, sizes, bounds)
    again = read_poses_bounds(tmp_path / "poses_bounds.npy")
    for found, given in zip(again, (poses, sizes, bounds), strict=True):
        np.testing.assert_allclose(found, given, atol=1e-12)
    matrix = np.load(tmp_path / "poses_bounds.npy")[1, :15].reshape(3, 5)
    axes = matrix[:, :3]  # down, right, backwards: the camera looks along minus the third
    np.testing.assert_allclose(np.cross(axes[:, 1], axes[:, 0]), -axes[:, 2], atol=1e-12)
    np.testing.assert_allclose(-axes[:, 2], -matrix[:, 3] / 3, atol=1e-12)  # the ring looks at the origin
    np.save(tmp_path / "poses_bounds.npy", np.zeros((5, 15)))
    with refused("(N, 17)"):
        read_poses_bounds(tmp_path / "poses_bounds.npy")


def test_a_missing_or_misnamed_mask_is_told(copy):
    place = copy / "bed" / "segmentations" / "02"
    assert place.is_dir()
    mask = next(place.glob("*.png"))
    kept = mask.read_bytes()
    mask.unlink()
    with refused(place, f"no mask of {mask.stem}"):
        load_ovs3d(copy, "bed")
    mask.with_name("no such thing.png").write_bytes(kept)
    with refused(f"no mask of {mask.stem}", "no such thing, which classes.txt does not name"):
        load_ovs3d(copy, "bed")


def test_a_folder_that_is_no_image_is_told(copy):
    segmentations = copy / "bed" / "segmentations"
    (segmentations / "02").rename(segmentations / "77")
    with refused("a folder called 77", "6 images"):
        load_ovs3d(copy, "bed")


def test_an_empty_mask_keeps_its_pair(copy):
    place = copy / "bed" / "segmentations" / "02"
    mask = next(place.glob("*.png"))
    cv2.imwrite(str(mask), np.zeros((48, 64), np.uint8))
    scene = load_ovs3d(copy, "bed")
    found, boxes = next(frame for frame in scene.frames if frame.name == "02").objects[mask.stem]
    assert not found.any()
    assert boxes.shape == (0, 4)
    assert scene.pairs == 18


def test_fewer_frames_than_generated_are_refused(copy):
    shutil.rmtree(copy / "bed" / "segmentations" / "02")
    with refused("12 (frame, query) pairs", "18"):
        load_ovs3d(copy, "bed")
    (copy / "twin.json").unlink()
    with refused("12 (frame, query) pairs", "30"):
        load_ovs3d(copy, "bed")
    assert OVS3D_PAIRS["bench"] == 35
