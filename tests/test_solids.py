"""Solids of objects: made-up things whose volume is known, and files for robots that agree with each other."""

import json
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from capture_files import run_cli
from conftest import cameras_of
from scipy.spatial.transform import Rotation
from table_field import table_field

from jsecon import object_shapes, save_field
from jsecon.query.solids import object_solid, object_surfaces
from jsecon.splat.points import gaussians_from_points


def surface(kind: str, count: int = 3000) -> np.ndarray:
    """Points on a box of 0.6 x 0.4 x 0.3, a cylinder of radius 0.2 and height 0.5, or a ball of radius 0.25."""
    draw = np.random.default_rng(0)
    if kind == "sphere":
        points = draw.normal(size=(count, 3))
        return 0.25 * points / np.linalg.norm(points, axis=1, keepdims=True)
    if kind == "cylinder":
        turn, height = draw.uniform(0, 2 * np.pi, count), draw.uniform(-0.25, 0.25, count)
        radius = np.where(np.arange(count) % 5 < 3, 0.2, 0.2 * np.sqrt(draw.uniform(0, 1, count)))
        height = np.where(radius < 0.2, np.sign(height) * 0.25, height)
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    points = draw.uniform(-1, 1, (count, 3))
    points[np.arange(count), draw.integers(0, 3, count)] = np.sign(draw.normal(size=count))
    return points * [0.3, 0.2, 0.15]


VOLUMES = {"box": 0.6 * 0.4 * 0.3, "cylinder": np.pi * 0.2**2 * 0.5, "sphere": 4 / 3 * np.pi * 0.25**3}


@pytest.mark.parametrize("kind", VOLUMES)
@pytest.mark.parametrize("lying", [False, True])
def test_the_primitive_and_the_volumes_are_those_of_the_thing(kind, lying):
    turn = Rotation.from_euler("xz", [90 if lying else 0, 30], degrees=True)
    turn = Rotation.from_euler("z", 20, degrees=True) * turn
    points = turn.apply(surface(kind)) + np.array([5, 6, 7])
    shape = object_shapes(points[::3], np.zeros(1000, int), np.array([0, 0, 1.0]))[0]
    hull, primitive = object_solid(points, shape).values()
    assert primitive["type"] == kind
    size, axes = primitive["size"], primitive["axes"]
    a, *others = size
    volume = {"box": np.prod(size), "cylinder": np.pi * a**2 * sum(others), "sphere": 4 / 3 * np.pi * a**3}[kind]
    assert [hull["volume"], volume] == pytest.approx([VOLUMES[kind]] * 2, rel=0.1)
    first, second, third = (hull["vertices"][hull["triangles"]] - shape.center).transpose(1, 0, 2)
    assert np.einsum("nk,nk->n", first, np.cross(second, third)).sum() / 6 == pytest.approx(hull["volume"], rel=1e-6)
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    if kind == "cylinder":
        assert abs(axes[:, 2] @ turn.apply([0, 0, 1])) > 0.999


def test_a_flat_thing_has_a_thin_hull():
    means = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [1, 1, 0]
    shape = object_shapes(means, np.zeros(50, int), np.array([0, 0, 1.0]))[0]
    assert all(0 < object_solid(points, shape)["hull"]["volume"] < 0.01 for points in (means, means[:0]))


def test_surfaces_are_those_of_the_pixels_that_show_an_object():
    means = np.mgrid[-10:11, -10:11, 0:2].reshape(3, -1).T * [0.1, 0.1, 1.0] + [0, 0, 2]
    means[means[:, 2] > 2.5, 0] += 1.0  # behind the right half of the near wall
    walls = gaussians_from_points(means, np.full(means.shape, 128, np.uint8), opacity=0.99)
    view = cameras_of(np.eye(4)[None], (50.0, 50.0, 50.0, 40.0), 100, 80)
    near, far = object_surfaces(walls, view, np.int64(means[:, 2] > 2.5))
    assert np.ptp(near, axis=0)[2] < 1e-3
    np.testing.assert_allclose([near[:, 0].max(), near[0, 2], far[:, 0].min(), far[0, 2]], [1.2, 2, 1.8, 3], atol=0.1)


def test_files_for_robots_agree_and_are_in_metres(tmp_path, capsys):
    field, _ = table_field(source_from_scene=np.diag([2.0, 2.0, 2.0, 1.0]))
    save_field(tmp_path / "field.safetensors", field)
    scaled = ["--scale-points", 0, 0, 0, 0, 0, 4, 1]  # a unit is 0.25 m, half of the field's own
    assert run_cli("measure", tmp_path, *scaled) == 0
    assert run_cli("export", tmp_path, "--shapes", tmp_path / "robot") == 0
    content = json.loads((tmp_path / "robot" / "shapes.json").read_text())
    assert (content["unit"], len(content["objects"])) == ("metres", 6)
    records = json.loads((tmp_path / "robot" / "labels.json").read_text())["objects"]
    model = ElementTree.fromstring((tmp_path / "robot" / "shapes.xml").read_text())
    messages = json.loads((tmp_path / "robot" / "shapes.yaml").read_text())["collision_objects"]
    text = (tmp_path / "robot" / "shapes.obj").read_text()
    corners = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("v ")], float)
    assert len(re.findall("^o ", text, re.MULTILINE)) == 6
    hulls = np.concatenate([item["hull"]["vertices"] for item in content["objects"]])
    np.testing.assert_allclose(corners, hulls, rtol=1e-6)
    for item, body, message in zip(content["objects"], model.iter("body"), messages, strict=True):
        record = records[item["id"]]
        np.testing.assert_allclose(item["box"]["size"], 0.25 * np.array(record["box"]["size"]), atol=1e-5)
        assert body.get("name") == message["id"] == f"{item['id']:03d} {record['name']}"
        position = list(message["primitive_poses"][0]["position"].values())
        assert [float(x) for x in body.get("pos").split()] == pytest.approx(position, abs=1e-6)
        primitive, size = body.find("geom"), item["primitive"]["size"]
        kind = item["primitive"]["type"]
        assert primitive.get("type") == kind
        half = {"box": [x / 2 for x in size], "sphere": size, "cylinder": [size[0], size[-1] / 2]}[kind]
        assert [float(x) for x in primitive.get("size").split()] == pytest.approx(half, rel=1e-6)
        assert sorted(message["primitives"][0]["dimensions"]) == pytest.approx(sorted(size))
    assert run_cli("export", tmp_path, "--shapes", tmp_path / "a.stl") == 2
    assert ".obj" in capsys.readouterr().err
