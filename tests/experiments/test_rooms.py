"""The demo room: exact geometry, true names, and files that read back as an ordinary capture."""

import dataclasses
import json
from collections import Counter

import cv2
import numpy as np
import pytest
from conftest import look_at

from experiments.datasets.plain_room import PALETTE, make_room
from experiments.rooms import render_views, room_cameras, room_capture, write_room
from experiments.rooms.raycast import trace_rays
from experiments.rooms.room import (
    ARCH_COLOUR,
    BEAM_COLOUR,
    CLUTTER_COLOURS,
    CROWDED_OBJECTS,
    REPEATED_COLOUR,
    TABLE_HALF,
    Part,
    crowded_room,
)
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

SEEDS = 0, pytest.param(1, marks=pytest.mark.long)


def alone(solid, hollow=None):
    """A room with nothing in it but one part."""
    room = make_room(0, num_objects=2)
    item = dataclasses.replace(room.objects[0], parts=(Part(solid, hollow, 0, np.full(3, 0.5, np.float32)),))
    return dataclasses.replace(room, objects=(item,), furniture=())


def pinhole(pose, focal=200.0, size=81):
    return Camera(np.asarray(pose, np.float32), focal, focal, size / 2, size / 2, size, size)


@pytest.fixture(scope="module")
def small():
    """(capture, instances, names) of 10 views of 96x72, every fifth held out."""
    return (*room_capture(make_room(0), views=10, width=96, height=72, points=400), make_room(0).names)


@pytest.fixture(scope="module")
def depths():
    room = make_room(0)
    cameras = room_cameras(room, views=10, width=96, height=72)
    return np.stack([trace_rays(room, cameras[k])[0] for k in range(10)])


# Solids against their own definitions, written out, sampled densely along random rays.

TURN = rotation(0.4, -0.7, 1.1)
SOLIDS = {
    "ellipsoid": (ellipsoid(0.3, 0.2, 0.4), lambda x, y, z: (x / 0.3) ** 2 + (y / 0.2) ** 2 + (z / 0.4) ** 2 <= 1),
    "bowl": (ellipsoid(0.3, 0.3, 0.2, below=0.05, above=-0.1),
             lambda x, y, z: ((x**2 + y**2) / 0.09 + z**2 / 0.04 <= 1) & (z <= 0.05) & (z >= -0.1)),
    "cylinder": (frustum(0.2, 0.2, 0.4), lambda x, y, z: (np.hypot(x, y) <= 0.2) & (z >= 0) & (z <= 0.4)),
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


def test_sphere_has_its_exact_depth_and_silhouette():
    centre, r = np.array([0.1, 0.05, 0.3]), 0.2
    eye = np.array([1.4, -0.3, 0.6])
    camera = pinhole(look_at(eye, centre, up=(0, 0, 1)))
    room = alone(place(ellipsoid(r, r, r), centre))
    depth, index = trace_rays(room, camera)
    distance = np.linalg.norm(centre - eye)
    assert depth[40, 40] == pytest.approx(distance - r, abs=2e-6)
    y, x = np.mgrid[:81, :81] + 0.5
    rays = np.stack([(x - 40.5) / 200, (y - 40.5) / 200, np.ones_like(x)])
    angle = np.arctan2(np.hypot(rays[0], rays[1]), 1)
    edge = np.arcsin(r / distance)
    sure = np.abs(angle - edge) > 1e-5
    np.testing.assert_array_equal((index == 0)[sure], (angle < edge)[sure])
    # The depth of every ray of the ball, from the sphere's equation in float64.
    d = rays / np.linalg.norm(rays, axis=0)
    along = distance * d[2] - np.sqrt(np.maximum(r**2 - distance**2 * (1 - d[2] ** 2), 0))
    inner = angle < 0.97 * edge
    np.testing.assert_allclose(depth[inner], (along * d[2])[inner], atol=5e-6)


def test_a_hollow_is_seen_into_and_lit_from_above_only():
    outer, hollow = frustum(0.1, 0.1, 0.2), place(frustum(0.09, 0.09, 0.21), (0, 0, 0.01))
    down = pinhole(look_at((0.0, 0.0, 1.0), (0, 0, 0), up=(1, 0, 0)))
    depth, _ = trace_rays(alone(outer, hollow), down)
    assert depth[40, 40] == pytest.approx(0.99, abs=2e-6)  # the cup's floor, not its rim
    side = pinhole(look_at((1.0, 0.0, 0.1), (0, 0, 0.1), up=(0, 0, 1)))
    depth, _ = trace_rays(alone(outer, hollow), side)
    assert depth[40, 40] == pytest.approx(0.9, abs=2e-6)
    floor = np.array([[0.0], [0.0], [0.011]], np.float32)
    assert not blocks_segment(outer, hollow, floor, np.array([[0.0], [0.0], [1.0]], np.float32))[0]
    assert blocks_segment(outer, hollow, floor, np.array([[1.0], [0.0], [0.1]], np.float32))[0]
    assert not blocks_segment(outer, hollow, floor, np.array([[0.05], [0.0], [0.1]], np.float32))[
        0
    ]  # ends before the wall
    normal = normals(outer, hollow, np.array([[0.0, 0.09, 0.1], [0, 0, 0], [0.01, 0.1, 0.1]], np.float32))
    np.testing.assert_allclose(normal.T, [[0, 0, 1], [-1, 0, 0], [1, 0, 0]], atol=1e-5)


# The room.


@pytest.mark.parametrize("seed", SEEDS)
def test_names_are_unique_shapes_repeat_and_objects_stand_free_on_the_table(seed):
    room = make_room(seed)
    assert len(room.names) == len(set(room.names)) == 12
    assert {"dark green", "light green", "dark blue", "light blue"} <= {item.colour for item in room.objects}
    assert len({item.colour for item in room.objects}) == 12
    assert all(item.name == f"{item.colour} {item.shape}" for item in room.objects)
    assert sum(count >= 2 for count in Counter(item.shape for item in room.objects).values()) >= 3
    for k, item in enumerate(room.objects):
        assert (np.abs(item.centre[:2]) + item.radius < TABLE_HALF).all()
        for other in room.objects[:k]:
            assert np.linalg.norm(item.centre - other.centre) > item.radius + other.radius


@pytest.mark.parametrize("seed", SEEDS)
def test_colours_are_true_to_their_names(seed):
    """The mean colour of an object's pixels is nearest, in CIELAB, to the palette's colour of its own name."""
    room = make_room(seed)
    frames, instances, _ = render_views(room, room_cameras(room, views=3, width=128, height=96))
    lab = cv2.cvtColor(frames.astype(np.float32).reshape(-1, 1, 3) / 255, cv2.COLOR_RGB2LAB).reshape(*frames.shape)
    names = list(PALETTE)
    palette = cv2.cvtColor(np.float32(list(PALETTE.values()))[:, None] / 255, cv2.COLOR_RGB2LAB)[:, 0]
    for k, item in enumerate(room.objects):
        mean = lab[instances == k].mean(0)
        distance = np.linalg.norm(palette - mean, axis=1)
        assert names[distance.argmin()] == item.colour
        assert distance.min() < 25
    background = lab[instances < 0]
    assert np.percentile(np.hypot(background[:, 1], background[:, 2]), 99) < 25  # the room itself is near grey
    assert np.percentile(background[:, 0], 99) < 85


# The capture.


def test_surfaces_reproject_to_the_pixels_that_see_them(small, depths):
    """A pixel lifted by its depth falls on the same object at the same depth in each view, or is hidden there."""
    capture, instances, _ = small
    camera = capture.cameras
    y, x = (a.ravel() for a in np.mgrid[:72, :96])
    compared = 0
    for a, b in [(1, 1), (1, 2), (4, 3), (6, 8)]:
        z = depths[a].ravel()
        local = np.stack([(x + 0.5 - camera.cx[a]) / camera.fx[a] * z, (y + 0.5 - camera.cy[a]) / camera.fy[a] * z, z])
        pose_a, pose_b = (np.asarray(camera.world_to_camera[k], np.float64) for k in (a, b))
        world = pose_a[:3, :3].T @ (local - pose_a[:3, 3:])
        seen = pose_b[:3, :3] @ world + pose_b[:3, 3:]
        u, v = seen[0] / seen[2] * camera.fx[b] + camera.cx[b], seen[1] / seen[2] * camera.fy[b] + camera.cy[b]
        if a == b:
            np.testing.assert_allclose(u, x + 0.5, atol=1e-3)
            np.testing.assert_allclose(v, y + 0.5, atol=1e-3)
        inside = (seen[2] > 0) & (u >= 0) & (u < 96) & (v >= 0) & (v < 72)
        row, column = v[inside].astype(int), u[inside].astype(int)
        same = np.abs(depths[b][row, column] - seen[2][inside]) < 0.004
        agree = instances[b][row, column] == instances[a].ravel()[inside]
        assert agree[same].mean() > 0.985  # all but pixels on an edge
        # What is not at that depth is hidden by something nearer, there or in the next pixel: no surface lets through.
        nearest = cv2.erode(depths[b], np.ones((3, 3), np.uint8))
        assert (nearest[row, column] < seen[2][inside] + 0.05).all()
        compared += same.sum()
    assert compared > 5000


# The crowded room.


def test_a_crowded_room_holds_what_makes_it_hard():
    for seed in range(2):
        room = crowded_room(seed)
        counts = Counter(room.names)
        assert counts.pop("") == len(CLUTTER_COLOURS)
        assert {name: count for name, count in counts.items() if count > 1} == {
            next(name for name in counts if name.split()[0] == REPEATED_COLOUR): 2
        }
        assert {item.colour for item in room.objects} == {"", *CROWDED_OBJECTS, BEAM_COLOUR, ARCH_COLOUR}
        assert room.cloth
        lidded = [item for item in room.objects if item.shape in ("pot", "kettle")]
        assert len(lidded) == 2
        for item in lidded:  # parts of other colours
            tones = [part.albedo.sum() for part in item.parts]
            assert min(tones) < 0.2 * max(tones)
        standing = [item for item in room.objects if item.shape not in ("beam", "arch", "ball")]
        for k, a in enumerate(standing):
            for b in standing[k + 1 :]:
                assert np.hypot(*(a.centre - b.centre)[:2]) > a.radius + b.radius
    assert crowded_room(0).names != crowded_room(1).names


def test_labels_of_a_crowded_room_join_two_of_a_kind_and_leave_out_what_has_no_name(tmp_path):
    write_room(tmp_path, crowded_room(0), views=4, width=96, height=72, points=200, holdout=2)
    told = list(json.loads((tmp_path / "scene.json").read_text())["objects"].values())
    assert "" in told
    twice = next(name for name in told if told.count(name) == 2)
    for frame in load_lerf_labels(tmp_path / "label"):
        ids = cv2.imread(str(tmp_path / "masks" / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        assert "" not in frame.objects
        mask, boxes = frame.objects[twice]
        both = [k + 1 for k, name in enumerate(told) if name == twice]
        np.testing.assert_array_equal(mask, np.isin(ids, both))
        assert len(boxes) == sum((ids == k).any() for k in both)


def test_written_room_reads_back_as_an_ordinary_capture(tmp_path, small):
    capture, instances, names = small
    folder = tmp_path / "room"
    write_room(folder, make_room(9, num_objects=2), views=12, width=16, height=12, points=20)  # an earlier, longer one
    write_room(folder, make_room(0), views=10, width=96, height=72, points=400)
    read = load_capture(folder, holdout=5)
    assert read.names == capture.names
    np.testing.assert_array_equal(read.frames, capture.frames)
    np.testing.assert_array_equal(read.held_out, capture.held_out)
    np.testing.assert_allclose(read.cameras.world_to_camera, capture.cameras.world_to_camera, atol=1e-6)
    np.testing.assert_allclose(read.cameras.fx, capture.cameras.fx)
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
        for name, (mask, boxes) in frame.objects.items():
            truth = instances[view] == names.index(name)
            np.testing.assert_array_equal(mask, truth)
            rows, columns = np.nonzero(truth)
            np.testing.assert_array_equal(boxes, [[columns.min(), rows.min(), columns.max(), rows.max()]])

    scene = json.loads((folder / "scene.json").read_text())
    assert scene["seed"] == 0
    assert list(scene["objects"].values()) == list(names)
    assert len(list((folder / "images").iterdir())) == 10
