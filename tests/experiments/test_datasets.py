"""Data sets: the twins' files come back as they were generated; what is missing, misnamed or too few is refused."""

import json
import shutil

import cv2
import numpy as np
import pytest
from capture_files import refused
from twin_files import lerf_twin, ovs3d_twin, replica_twin, rooms_instances

from experiments.datasets.lerf_ovs import load_lerf_ovs
from experiments.datasets.mesh import SURROUNDINGS
from experiments.datasets.ovs3d import box_of, load_ovs3d
from experiments.datasets.plain_room import make_room
from experiments.datasets.replica import load_replica, vertex_classes
from experiments.rooms import room_cameras


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    """Folders of a twin of each data set."""
    writers = {"lerf": lerf_twin, "ovs3d": ovs3d_twin, "replica": replica_twin}
    return {name: write(tmp_path_factory.mktemp(name)) for name, write in writers.items()}


def edit(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_lerf_comes_back(twins):
    scene = load_lerf_ovs(twins["lerf"], "figurines")
    told = json.loads((twins["lerf"] / "twin.json").read_text())["scenes"]["figurines"]
    room, instances = make_room(0, num_objects=6), rooms_instances(0, scene.capture.cameras)
    assert scene.capture.names == tuple(f"frame_{n:05d}" for n in range(1, 7))
    np.testing.assert_array_equal(scene.capture.held_out, np.arange(6) % 3 == 0)
    assert [frame.name for frame in scene.frames] == told["frames"] == ["frame_00001", "frame_00004"]
    for frame in scene.frames:
        instance = instances[scene.capture.names.index(frame.name)]
        assert set(frame.objects) == {room.names[k] for k in range(6) if (instance == k).sum() >= 8}
        for name, (mask, boxes) in frame.objects.items():
            # COLMAP's float64 poses move the rays by a rounding: a pixel on an outline may change sides.
            assert (mask != (instance == room.names.index(name))).sum() <= 2
            np.testing.assert_array_equal(boxes, box_of(mask))
    assert scene.pairs == told["pairs"] == sum(len(frame.objects) for frame in scene.frames)
    assert set(scene.queries) == {name for frame in scene.frames for name in frame.objects}
    smaller = load_lerf_ovs(twins["lerf"], "figurines", downscale=2)
    assert (smaller.capture.cameras.width, smaller.frames[0].width) == (32, 64)


def test_lerfs_missing_labels_are_told_and_a_polygon_outside_keeps_its_pair(twins, tmp_path):
    folder = shutil.copytree(twins["lerf"], tmp_path / "lerf")
    first = folder / "label" / "figurines" / "frame_00001.json"
    category = json.loads(first.read_text())["objects"][0]["category"]

    def move(content):
        for entry in content["objects"]:
            if entry["category"] == category:
                entry["segmentation"] = [[900, 900], [950, 900], [950, 950]]

    def remove(content):
        content["objects"] = [entry for entry in content["objects"] if entry["category"] != category]

    edit(first, move)
    scene = load_lerf_ovs(folder, "figurines")
    assert not scene.frames[0].objects[category][0].any()
    assert scene.pairs == sum(len(frame.objects) for frame in scene.frames)
    edit(first, remove)
    with refused("(frame, query) pairs", "the protocol counts"):
        load_lerf_ovs(folder, "figurines")


def test_3d_ovs_comes_back(twins):
    scene = load_ovs3d(twins["ovs3d"], "bed")
    room, instances = make_room(1, num_objects=6), rooms_instances(1, scene.capture.cameras)
    assert scene.queries == tuple(sorted(room.names))
    assert (len(scene.frames), scene.pairs) == (3, 18)
    assert [scene.capture.names[t] for t in np.flatnonzero(scene.capture.held_out)] == [f.name for f in scene.frames]
    for frame in scene.frames:
        assert tuple(frame.objects) == scene.queries
        for name, (mask, boxes) in frame.objects.items():
            assert (mask != (instances[int(frame.name)] == room.names.index(name))).sum() <= 2
            rows, columns = np.nonzero(mask)
            np.testing.assert_array_equal(boxes, [[columns.min(), rows.min(), columns.max(), rows.max()]])


def test_replica_comes_back(twins):
    scene = load_replica(twins["replica"], "room0", every=1)
    told = json.loads((twins["replica"] / "twin.json").read_text())["scenes"]["room0"]
    cameras = room_cameras(make_room(2, num_objects=6), views=6, width=75, height=43)
    np.testing.assert_allclose(scene.capture.cameras.world_to_camera, cameras.world_to_camera, atol=1e-6)
    for name in ("fx", "cx", "cy"):
        np.testing.assert_allclose(getattr(scene.capture.cameras, name), getattr(cameras, name), rtol=1e-6)
    assert scene.capture.depths.shape == (6, 43, 75)
    assert not scene.capture.held_out.any()
    assert scene.queries == tuple(told["queries"])
    assert scene.pairs == told["pairs"] == len(np.unique(scene.point_classes[scene.point_classes >= 0]))
    # Vertices lie on the surfaces that the first depth frame shows, and carry the class that their pixel shows.
    truth = cv2.imread(str(twins["replica"] / "truth" / "room0" / "frame000000.png"), -1).astype(int) - 1
    classes = told["objects"]
    assert classes[-4:] == list(SURROUNDINGS)
    pose = scene.capture.cameras.world_to_camera[0].astype(np.float64)
    local = scene.points @ pose[:3, :3].T + pose[:3, 3]
    u, v = (local[:, k] / local[:, 2] * cameras.fx[0] + (cameras.cx, cameras.cy)[k][0] for k in range(2))
    agree = []
    for n in np.flatnonzero((local[:, 2] > 0) & (u >= 0) & (u < 75) & (v >= 0) & (v < 43)):
        row, column = int(v[n]), int(u[n])
        if abs(scene.capture.depths[0, row, column] - local[n, 2]) < 0.01:
            name = classes[truth[row, column]]
            agree.append(scene.point_classes[n] == (scene.queries.index(name) if name in scene.queries else -1))
    assert len(agree) > 300
    assert np.mean(agree) > 0.97
    assert load_replica(twins["replica"], "room0", every=3).capture.names == ("frame000000", "frame000003")


def test_a_vertex_takes_the_class_of_its_first_face():
    faces = np.array([[0, 1, 2, 3], [2, 3, 4, 5], [6, 6, 6, 6]])
    found = vertex_classes(9, faces, np.array([7, 8, 9]), {7: 40, 8: 50, 9: -2})
    np.testing.assert_array_equal(found, [40, 40, 40, 40, 50, 50, -1, -1, -1])
    assert (vertex_classes(3, faces[:0], np.zeros(0, int), {}) == -1).all()
