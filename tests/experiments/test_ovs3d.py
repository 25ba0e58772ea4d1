"""3D-OVS: the twin comes back; folders count the sorted images; classes that are missing, extra or empty."""

import shutil

import cv2
import numpy as np
import pytest
from capture_files import refused
from twin_files import ovs3d_twin, rooms_instances

from experiments.datasets.ovs3d import OVS3D_PAIRS, box_of, load_ovs3d
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


def test_a_missing_or_misnamed_mask_is_told(copy):
    place = copy / "bed" / "segmentations" / "02"
    assert place.is_dir()
    mask = next(place.glob("*.png"))
    kept = mask.read_bytes()
    mask.unlink()
    with refused(place, f"without a mask: {mask.stem}"):
        load_ovs3d(copy, "bed")
    mask.with_name("no such thing.png").write_bytes(kept)
    with refused(f"without a mask: {mask.stem}", "masks of no class: no such thing"):
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
