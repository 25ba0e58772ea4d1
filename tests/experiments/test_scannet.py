"""ScanNet: the three class sets on the twin's vertices; lost poses; label files that do not fit."""

import json
import shutil

import numpy as np
import pytest
from capture_files import refused
from twin_files import scannet_twin

from experiments.datasets.scannet import CLASS_SETS, NYU40, SCANNET_SCENES, load_scannet
from jsecon.data.ply_file import read_vertices
from jsecon.demo import make_room, room_cameras

SCENE = SCANNET_SCENES[0]


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return scannet_twin(tmp_path_factory.mktemp("scannet"))


@pytest.mark.parametrize("size", [19, 15, 10])
def test_every_class_set(twin, size):
    scene = load_scannet(twin, SCENE, classes=size, every=1)
    labels = read_vertices(twin / SCENE / f"{SCENE}_vh_clean_2.labels.ply")["label"]
    told = json.loads((twin / "twin.json").read_text())["scenes"][SCENE]
    assert len(scene.queries) == size == len(CLASS_SETS[size])
    assert scene.pairs == told["pairs"][str(size)]
    for nyu, found in zip(labels, scene.point_classes, strict=True):
        expected = CLASS_SETS[size].index(nyu) if nyu in CLASS_SETS[size] else -1
        assert found == expected
    assert set(CLASS_SETS[10]) < set(CLASS_SETS[15]) < set(CLASS_SETS[19]) == set(NYU40)


def test_frames_without_pose_are_left_out_and_counted(twin):
    scene = load_scannet(twin, SCENE, every=1)
    assert scene.capture.names == ("0", "1", "2", "3", "5")
    assert "1 of 6 frames have no pose" in " ".join(scene.capture.notes)
    cameras = room_cameras(make_room(3, num_objects=6), views=6, width=64, height=48)
    kept = [0, 1, 2, 3, 5]
    np.testing.assert_allclose(scene.capture.cameras.world_to_camera, cameras.world_to_camera[kept], atol=1e-6)
    np.testing.assert_allclose(scene.capture.cameras.cx, 32)
    assert scene.points.shape == scene.point_colors.shape


def test_what_does_not_fit_is_told(twin, tmp_path):
    root = shutil.copytree(twin, tmp_path / "copy")
    with refused("classes", "20", "19, 15 or 10"):
        load_scannet(root, SCENE, classes=20)
    mesh = root / SCENE / f"{SCENE}_vh_clean_2.ply"
    labels = root / SCENE / f"{SCENE}_vh_clean_2.labels.ply"
    kept = labels.read_bytes()
    labels.write_bytes(mesh.read_bytes())
    with refused(labels, "without label"):
        load_scannet(root, SCENE)
    other = scannet_other(tmp_path)
    labels.write_bytes(other)
    with refused(labels, "labels for the vertices"):
        load_scannet(root, SCENE)
    labels.write_bytes(kept)
    (root / SCENE / "pose" / "0.txt").write_text("1 2 3")
    with refused("0.txt", "4x4"):
        load_scannet(root, SCENE)


def scannet_other(folder):
    """The label file of another scan."""
    from experiments.datasets.twins import write_scannet_twin

    size = {"views": 3, "width": 48, "height": 40, "num_objects": 4, "fine_m": 0.03, "coarse_m": 0.2}
    write_scannet_twin(folder / "other", SCENE, 9, **size)
    return (folder / "other" / SCENE / f"{SCENE}_vh_clean_2.labels.ply").read_bytes()
