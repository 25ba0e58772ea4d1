"""LERF-OVS: the twin's files come back as they were generated; frames by name; what is missing is told."""

import json
import shutil

import cv2
import numpy as np
import pytest
from capture_files import refused
from twin_files import lerf_twin, rooms_instances

from experiments.datasets.lerf_ovs import LERF_FRAMES, LERF_PAIRS, load_lerf_ovs
from experiments.datasets.plain_room import make_room


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return lerf_twin(tmp_path_factory.mktemp("lerf"))


@pytest.fixture
def copy(twin, tmp_path):
    return shutil.copytree(twin, tmp_path / "copy")


def test_every_field_comes_back(twin):
    scene = load_lerf_ovs(twin, "figurines")
    told = json.loads((twin / "twin.json").read_text())["scenes"]["figurines"]
    room = make_room(0, num_objects=6)
    instances = rooms_instances(0, scene.capture.cameras)
    assert scene.capture.names == tuple(f"frame_{n:05d}" for n in range(1, 7))
    np.testing.assert_array_equal(scene.capture.held_out, np.arange(6) % 3 == 0)
    assert [frame.name for frame in scene.frames] == told["frames"] == ["frame_00001", "frame_00004"]
    pairs = 0
    for frame in scene.frames:
        instance = instances[scene.capture.names.index(frame.name)]
        shown = {room.names[k] for k in range(6) if (instance == k).sum() >= 8}
        assert set(frame.objects) == shown
        for name, (mask, boxes) in frame.objects.items():
            true = instance == room.names.index(name)
            # COLMAP's float64 poses move the rays by a rounding: a pixel on an outline may change sides.
            assert (mask != true).sum() <= 2
            rows, columns = np.nonzero(mask)
            np.testing.assert_array_equal(boxes, [[columns.min(), rows.min(), columns.max(), rows.max()]])
            pairs += 1
    assert scene.pairs == told["pairs"] == pairs
    assert scene.twin
    assert (scene.dataset, scene.name) == ("lerf", "figurines")
    assert set(scene.queries) == {name for frame in scene.frames for name in frame.objects}
    for t, name in enumerate(scene.capture.names):
        truth = cv2.imread(str(twin / "truth" / "figurines" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        owners = truth.astype(int) - 1  # objects, then the room around them: nothing is of nobody
        assert owners.min() >= 0
        assert (np.where(owners < len(room.names), owners, -1) != instances[t]).sum() <= 2


def test_frames_belong_to_labels_by_name(copy):
    """Without another frame's image in the model, positions shift; the labels stay with their frames."""
    before = load_lerf_ovs(copy, "figurines")
    for file in (copy / "label" / "figurines").glob("*.json"):
        content = json.loads(file.read_text())
        assert content["info"]["name"] == f"{file.stem}.jpg"
    scene = load_lerf_ovs(copy, "figurines", downscale=2)
    assert (scene.capture.cameras.width, scene.frames[0].width) == (32, 64)
    np.testing.assert_array_equal(scene.capture.held_out, before.capture.held_out)


def test_what_is_missing_or_misnamed_is_told(copy):
    labels = copy / "label" / "figurines"
    (labels / "frame_00004.json").rename(labels / "frame_00005.json")
    with refused(labels, "no label of frame_00004"):  # its info still says frame_00004.jpg ...
        content = json.loads((labels / "frame_00005.json").read_text())
        content["info"]["name"] = "frame_00005.jpg"
        (labels / "frame_00005.json").write_text(json.dumps(content))
        load_lerf_ovs(copy, "figurines")
    content["info"]["name"] = "frame_00099.jpg"
    told = json.loads((copy / "twin.json").read_text())
    told["scenes"]["figurines"]["frames"][1] = "frame_00099"
    (copy / "twin.json").write_text(json.dumps(told))
    (labels / "frame_00005.json").write_text(json.dumps(content))
    with refused(labels, "frame_00099", "not among the 6 frames"):
        load_lerf_ovs(copy, "figurines")


def test_fewer_pairs_than_generated_are_refused(copy):
    file = copy / "label" / "figurines" / "frame_00001.json"
    content = json.loads(file.read_text())
    category = content["objects"][0]["category"]
    content["objects"] = [entry for entry in content["objects"] if entry["category"] != category]
    file.write_text(json.dumps(content))
    with refused("(frame, query) pairs", "the protocol counts"):
        load_lerf_ovs(copy, "figurines")


def test_a_polygon_outside_the_image_keeps_its_pair(copy):
    file = copy / "label" / "figurines" / "frame_00001.json"
    content = json.loads(file.read_text())
    category = content["objects"][0]["category"]
    for entry in content["objects"]:
        if entry["category"] == category:
            entry["segmentation"] = [[900, 900], [950, 900], [950, 950]]
    file.write_text(json.dumps(content))
    scene = load_lerf_ovs(copy, "figurines")
    assert not scene.frames[0].objects[category][0].any()
    assert scene.pairs == load_lerf_ovs(copy, "figurines").pairs == sum(len(f.objects) for f in scene.frames)


def test_real_scenes_are_held_to_the_published_frames(copy):
    (copy / "twin.json").unlink()
    with refused("no label of frame_00041"):
        load_lerf_ovs(copy, "figurines")
    assert set(LERF_FRAMES) == set(LERF_PAIRS)
    assert sum(map(len, LERF_FRAMES.values())) == 22
