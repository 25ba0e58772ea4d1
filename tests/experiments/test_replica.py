"""Replica: frames, poses, depth, vertices and classes of the twin come back; the two forms of semantics agree."""

import json
import shutil

import cv2
import numpy as np
import pytest
from capture_files import refused
from twin_files import replica_twin

from experiments.datasets.mesh import SURROUNDINGS
from experiments.datasets.plain_room import make_room
from experiments.datasets.replica import REPLICA_SCENES, load_replica, vertex_classes
from experiments.rooms import room_cameras


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return replica_twin(tmp_path_factory.mktemp("replica"))


@pytest.fixture
def copy(twin, tmp_path):
    return shutil.copytree(twin, tmp_path / "copy")


def test_every_field_comes_back(twin):
    scene = load_replica(twin, "room0", every=1)
    told = json.loads((twin / "twin.json").read_text())["scenes"]["room0"]
    cameras = room_cameras(make_room(2, num_objects=6), views=6, width=75, height=43)
    np.testing.assert_allclose(scene.capture.cameras.world_to_camera, cameras.world_to_camera, atol=1e-6)
    for name in ("fx", "cx", "cy"):
        np.testing.assert_allclose(getattr(scene.capture.cameras, name), getattr(cameras, name), rtol=1e-6)
    assert scene.capture.depths.shape == (6, 43, 75)
    assert not scene.capture.held_out.any()
    assert scene.queries == tuple(told["queries"])
    assert set(np.unique(scene.point_classes)) <= set(range(-1, len(scene.queries)))
    assert scene.pairs == told["pairs"] == len(np.unique(scene.point_classes[scene.point_classes >= 0]))
    # Vertices lie on the surfaces that the depth frames show, and carry the class that their pixel shows.
    truth = [cv2.imread(str(twin / "truth" / "room0" / f"frame{t:06d}.png"), -1).astype(int) - 1 for t in range(6)]
    classes = told["objects"]
    assert classes[-4:] == list(SURROUNDINGS)
    agree = seen = 0
    pose = scene.capture.cameras.world_to_camera[0].astype(np.float64)
    local = scene.points @ pose[:3, :3].T + pose[:3, 3]
    u, v = (local[:, k] / local[:, 2] * cameras.fx[0] + (cameras.cx, cameras.cy)[k][0] for k in range(2))
    inside = (local[:, 2] > 0) & (u >= 0) & (u < 75) & (v >= 0) & (v < 43)
    for n in np.flatnonzero(inside):
        row, column = int(v[n]), int(u[n])
        if abs(scene.capture.depths[0, row, column] - local[n, 2]) < 0.01:
            name = classes[truth[0][row, column]]
            seen += 1
            agree += scene.point_classes[n] == (scene.queries.index(name) if name in scene.queries else -1)
    assert seen > 300
    assert agree / seen > 0.97


def test_every_nth_frame(twin):
    scene = load_replica(twin, "room0", every=3)
    assert scene.capture.names == ("frame000000", "frame000003")
    assert not scene.capture.held_out.any()


def test_what_is_missing_or_unknown_is_told(copy):
    with refused("classes no such class", "own table"):
        load_replica(copy, "room0", classes=("table", "no such class"))
    (copy / "room0" / "results" / "depth000003.png").unlink()
    with refused("no depth000003.png"):
        load_replica(copy, "room0", every=3)
    (copy / "room0" / "results" / "frame000005.jpg").unlink()
    with refused("5 frames beside the poses", "6"):
        load_replica(copy, "room0")


def test_fewer_classes_than_generated_are_refused(copy):
    with refused("classes that occur"):
        load_replica(copy, "room0", classes=("table",))
    (copy / "twin.json").unlink()
    assert load_replica(copy, "room0", classes=("table", "wall")).pairs == 2
    assert len(REPLICA_SCENES) == 8


def test_a_vertex_takes_the_class_of_its_first_face():
    faces = np.array([[0, 1, 2, 3], [2, 3, 4, 5], [6, 6, 6, 6]])
    found = vertex_classes(9, faces, np.array([7, 8, 9]), {7: 40, 8: 50, 9: -2})
    np.testing.assert_array_equal(found, [40, 40, 40, 40, 50, 50, -1, -1, -1])
    assert (vertex_classes(3, faces[:0], np.zeros(0, int), {}) == -1).all()
