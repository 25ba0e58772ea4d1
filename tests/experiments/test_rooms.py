"""The demo room: exact geometry, true names, and files that read back as an ordinary capture."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from conftest import look_at

from experiments.datasets.plain_room import make_room
from experiments.rooms import room_capture, write_room
from experiments.rooms.raycast import trace_rays
from experiments.rooms.room import Part
from experiments.rooms.shapes import (
    blocks_segment,
    box,
    contains,
    cut,
    ellipsoid,
    first_hit,
    frustum,
    normals,
    place,
    ray_interval,
    rotation,
)
from jsecon import Camera, load_capture
from jsecon.read.masks.labels import load_lerf_labels
from jsecon.read.masks.masks import load_labels

# Solids against their own definitions, written out, sampled densely along random rays.

TURN = rotation(0.4, -0.7, 1.1)
SOLIDS = {
    "ellipsoid": (ellipsoid(0.3, 0.2, 0.4), lambda x, y, z: (x / 0.3) ** 2 + (y / 0.2) ** 2 + (z / 0.4) ** 2 <= 1),
    "bowl": (ellipsoid(0.3, 0.3, 0.2, below=0.05, above=-0.1),
             lambda x, y, z: ((x**2 + y**2) / 0.09 + z**2 / 0.04 <= 1) & (z <= 0.05) & (z >= -0.1)),
    "widening": (frustum(0.1, 0.35, 0.3), lambda x, y, z: (np.hypot(x, y) <= 0.1 + z / 1.2) & (z >= 0) & (z <= 0.3)),
    "cone": (frustum(0.3, 0.0, 0.3), lambda x, y, z: (np.hypot(x, y) <= 0.3 - z) & (z >= 0) & (z <= 0.3)),
    "box": (box(0.4, 0.2, 0.3), lambda x, y, z: (abs(x) <= 0.2) & (abs(y) <= 0.1) & (z >= 0) & (z <= 0.3)),
    "half": (cut(ellipsoid(0.3, 0.3, 0.3), (0.6, 0.8, 0.0), 0.1),
             lambda x, y, z: (x**2 + y**2 + z**2 <= 0.09) & (0.6 * x + 0.8 * y <= 0.1)),
}  # fmt: skip


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("turned", [False, True])
def test_interval_is_the_definition_along_a_ray(name, turned):
    solid, inside = SOLIDS[name]
    centre = np.array([0.3, -0.2, 0.5]) if turned else np.zeros(3)
    axes = TURN if turned else np.eye(3)
    rng = np.random.default_rng(3)
    rays = 400
    origin = (rng.normal(size=(3, rays)) * 1.5).astype(np.float32)
    direction = (centre[:, None] + rng.uniform(-0.3, 0.3, (3, rays)) - origin).astype(np.float32)
    direction[:, :40] = np.eye(3)[:, rng.integers(0, 3, 40)]  # along the axes: the degenerate cases of slabs and cones
    origin[:, :40] = rng.uniform(-0.3, 0.3, (3, 40)) + centre[:, None]
    enter, leave = ray_interval(place(solid, centre, axes), origin, direction)
    t = np.linspace(-1.0, 2.5, 1501)
    points = origin[..., None].astype(np.float64) + direction[..., None].astype(np.float64) * t
    local = np.einsum("ji,jrt->irt", np.asarray(axes, np.float64), points - centre[:, None, None])
    truth = inside(*local)
    got = (t >= enter[:, None]) & (t <= leave[:, None])
    clear = (np.abs(t - enter[:, None]) > 2e-4) & (np.abs(t - leave[:, None]) > 2e-4)
    assert truth.any(1).sum() > 100
    np.testing.assert_array_equal(got[clear], truth[clear])


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_point_out_of_the_solid(name):
    solid = place(SOLIDS[name][0], (0.1, 0.0, -0.2), TURN)
    rng = np.random.default_rng(1)
    origin = 2.0 * rng.normal(size=(3, 500)).astype(np.float32)
    origin /= np.linalg.norm(origin, axis=0)
    direction = solid.bound[:3, None] + rng.uniform(-0.1, 0.1, (3, 500)).astype(np.float32) - origin
    t = first_hit(solid, None, origin, direction)
    hit = np.isfinite(t)
    points, rays = (origin + t * direction)[:, hit], direction[:, hit]
    normal = normals(solid, None, points)
    assert hit.sum() > 200
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, atol=1e-5)
    assert ((normal * rays).sum(0) < 1e-3).all()
    assert not contains(solid, points + 1e-3 * normal).any()
    assert contains(solid, points - 1e-3 * normal, margin=1e-4).mean() > 0.98  # all but the sharpest edges


def test_a_ray_meets_the_sphere_where_its_equation_says():
    centre, r = np.array([0.1, 0.05, 0.3]), 0.2
    eye = np.array([1.4, -0.3, 0.6])
    room = make_room(0, num_objects=2)
    ball = Part(place(ellipsoid(r, r, r), centre), None, 0, np.full(3, 0.5, np.float32))
    ball = dataclasses.replace(room.objects[0], parts=(ball,))
    room = dataclasses.replace(room, objects=(ball,), furniture=())
    pose = look_at(eye, centre, up=(0, 0, 1))
    depth, index = trace_rays(room, Camera(pose, 200.0, 200.0, 40.5, 40.5, 81, 81))
    distance = np.linalg.norm(centre - eye)
    y, x = np.mgrid[:81, :81] + 0.5
    rays = np.stack([(x - 40.5) / 200, (y - 40.5) / 200, np.ones_like(x)])
    angle, edge = np.arctan2(np.hypot(rays[0], rays[1]), 1), np.arcsin(r / distance)
    sure = np.abs(angle - edge) > 1e-5
    np.testing.assert_array_equal((index == 0)[sure], (angle < edge)[sure])
    d = rays / np.linalg.norm(rays, axis=0)
    along = distance * d[2] - np.sqrt(np.maximum(r**2 - distance**2 * (1 - d[2] ** 2), 0))
    inner = angle < 0.97 * edge
    np.testing.assert_allclose(depth[inner], (along * d[2])[inner], atol=5e-6)


def test_a_hollow_is_seen_into_and_lit_from_above_only():
    outer, hollow = frustum(0.1, 0.1, 0.2), place(frustum(0.09, 0.09, 0.21), (0, 0, 0.01))
    origin, direction = np.float32([[0, 1], [0, 0], [1, 0.1]]), np.float32([[0, -1], [0, 0], [-1, 0]])
    # the cup's floor, not its rim; its wall from outside
    np.testing.assert_allclose(first_hit(outer, hollow, origin, direction), [0.99, 0.9], atol=2e-6)
    floor = np.float32([[0, 0, 0]] * 2 + [[0.011] * 3])
    ends = np.float32([[0, 1, 0.05], [0, 0, 0], [1, 0.1, 0.1]])  # above; beside; before the wall
    np.testing.assert_array_equal(blocks_segment(outer, hollow, floor, ends), [False, True, False])
    normal = normals(outer, hollow, np.array([[0.0, 0.09, 0.1], [0, 0, 0], [0.01, 0.1, 0.1]], np.float32))
    np.testing.assert_allclose(normal.T, [[0, 0, 1], [-1, 0, 0], [1, 0, 0]], atol=1e-5)


# The capture.


def test_written_room_reads_back_as_an_ordinary_capture(tmp_path):
    capture, instances = room_capture(make_room(0), views=10, width=96, height=72, points=400)
    names = make_room(0).names
    folder = tmp_path / "room"
    write_room(folder, make_room(9, num_objects=2), views=12, width=16, height=12, points=20)  # an earlier, longer one
    write_room(folder, make_room(0), views=10, width=96, height=72, points=400)
    read = load_capture(folder, holdout=5)
    assert read.names == capture.names
    np.testing.assert_array_equal(read.frames, capture.frames)
    np.testing.assert_array_equal(read.held_out, capture.held_out)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), read.cameras, capture.cameras)
    np.testing.assert_allclose(read.points, capture.points, atol=1e-6)
    np.testing.assert_array_equal(read.point_colors, capture.point_colors)

    labels = load_labels(folder / "masks", read.names, (72, 96)).labels
    np.testing.assert_array_equal(labels, instances)

    labelled = load_lerf_labels(folder / "label")
    assert [frame.name for frame in labelled] == ["frame_00001", "frame_00006"]
    for frame, view in zip(labelled, (0, 5)):
        shown = {name for k, name in enumerate(names) if (instances[view] == k).sum() >= 40}
        assert set(frame.objects) == shown
        assert shown
        for name, (mask, _) in frame.objects.items():
            np.testing.assert_array_equal(mask, instances[view] == names.index(name))
    scene = json.loads((folder / "scene.json").read_text())
    assert scene["seed"] == 0
    assert list(scene["objects"].values()) == list(names)
    assert len(list((folder / "images").iterdir())) == 10
