"""Which way is up: gravity of the capture, the scene, or cameras of any roll; and what the answers say of it."""

import dataclasses

import numpy as np
import pytest
from conftest import gaussians_at
from scipy.spatial.transform import Rotation
from table_field import table_field

from jsecon import At, load_field, save_field
from jsecon.app.scene import Scene, pixel_of
from jsecon.errors import InputError
from jsecon.types import Camera, UpAxis
from jsecon.views.frame import _up_of_cameras, find_up_axis

ROLLS = {
    "level": lambda k: 0,
    "a quarter": lambda k: 90,
    "some a quarter": lambda k: 90 * (k % 3 == 0),
    "both quarters": lambda k: 90 * (-1) ** k,
    "an odd angle": lambda k: 37,
    "some an odd angle": lambda k: 52 * (k % 2),
}
PITCHES = 22, 28, 25, 18, 30, 26
"""degrees below the horizon, in turn"""


def cameras_around(roll, *, around=360.0, count=12, turn=None):
    """Cameras in a z-up world that look down a little, each rolled by roll(k), degrees; then the world is turned."""
    yaws = around * (np.arange(count) / count - 0.5)
    tilts = [-90 - PITCHES[k % 6] for k in range(count)]
    level = Rotation.from_euler("ZX", np.stack([yaws, tilts], axis=1), degrees=True)
    rolled = level * Rotation.from_euler("z", [[roll(k)] for k in range(count)], degrees=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = ((turn or Rotation.identity()) * rolled).inv().as_matrix()
    return Camera(poses, *(np.full(count, 50.0),) * 4, 100, 80)


@pytest.mark.parametrize("name", ROLLS)
def test_the_cameras_tell_up_however_they_are_rolled(name):
    for seed in (0, 1):
        turn = Rotation.random(random_state=seed)
        up = _up_of_cameras(cameras_around(ROLLS[name], turn=turn))
        assert np.degrees(np.arccos(min(1.0, up.axis @ turn.as_matrix()[:, 2]))) < 4
        assert up.sure == (name in ("level", "some a quarter"))
        assert ("level" in up.evidence) == (name == "level")


def test_one_camera_and_two_that_stand_head_to_foot_have_an_up():
    assert _up_of_cameras(cameras_around(ROLLS["level"], count=1)).axis[2] > 0.8
    for first in (np.eye(4), np.diag([-1.0, -1, 1, 1])):
        poses = np.stack([first, first @ np.diag([1.0, -1, -1, 1])])  # the second stands on its head
        up = np.array(_up_of_cameras(Camera(poses, *(np.ones(2),) * 4, 4, 4)).axis)
        np.testing.assert_allclose(np.linalg.norm(up), 1)
        assert abs(up[2]) < 1e-6  # across the optical axes


@pytest.mark.parametrize("around", [360.0, 150.0])
def test_cameras_that_may_stand_on_their_heads_are_not_sure(around):
    """They look as level ones that look up; without the scene nothing tells the two apart."""
    blank = gaussians_at(np.random.default_rng(0).normal(size=(400, 3)).astype(np.float32), 0.02)
    assert not find_up_axis(blank, cameras_around(lambda k: 180, around=around)).sure
    assert find_up_axis(blank, cameras_around(lambda k: 0, around=around)).sure


@pytest.mark.parametrize("roll", [-90, 180, 65])
def test_the_scene_tells_up_where_all_cameras_are_rolled_and_look_one_way(roll):
    """A table with things on it: what they rest on is below."""
    draw = np.random.default_rng(0)
    top = draw.uniform([-1, -1, 0], [1, 1, 0.004], (3000, 3))
    corners = [(-0.7, -0.6, 0.2), (0.4, 0.3, 0.45), (0.5, -0.7, 0.3), (-0.5, 0.5, 0.6), (-0.1, -0.2, 0.15)]
    things = [draw.uniform([x, y, 0], [x + 0.2, y + 0.2, height], (500, 3)) for x, y, height in corners]
    cameras = cameras_around(lambda k: roll, around=20.0)
    up = find_up_axis(gaussians_at(np.concatenate([top, *things]).astype(np.float32), 0.02), cameras)
    np.testing.assert_allclose(up.axis, [0, 0, 1], atol=0.05)
    assert up.evidence.startswith("the scene")
    blank = gaussians_at(draw.normal(size=(400, 3)).astype(np.float32), 0.02)
    assert not find_up_axis(blank, cameras).sure


@pytest.mark.parametrize("name", ["a quarter", "some an odd angle"])
def test_answers_about_a_table_are_the_same_from_rolled_cameras(name):
    around = [(2 * np.cos(a), 2 * np.sin(a), 0.8) for a in np.arange(12) * np.pi / 6]
    field, embedder = table_field(directions=around)
    rolls = Rotation.from_euler("z", [[ROLLS[name](k)] for k in range(12)], degrees=True).as_matrix()
    poses = field.cameras.world_to_camera.astype(np.float64).copy()
    poses[:, :3] = np.swapaxes(rolls, 1, 2) @ poses[:, :3]
    field = dataclasses.replace(field, cameras=dataclasses.replace(field.cameras, world_to_camera=poses))
    scene = Scene(field, embedder)
    answer = scene.ask("the orange ball on the white plate")
    assert answer.count == 1
    assert "up is from the cameras, with their roll taken out (not sure: jsecon run --up" in str(answer)
    assert answer.as_dict()["relation"]["up"]["axis"] == pytest.approx([0, 0, 1], abs=0.08)
    assert scene.objects().up == pytest.approx([0, 0, 1], abs=0.08)
    red = scene.ask("the red mug left of the dark green bottle", frame="frame_9")  # seen along y
    assert red.place.center[0] < 0
    measured = scene.measure("white plate", "orange ball")
    assert measured["angle"] > 80
    assert "not sure" in measured["up"]


def test_a_field_keeps_up_and_metres_and_an_older_one_has_neither(tmp_path):
    field, embedder = table_field()
    file = tmp_path / "field.safetensors"
    save_field(file, field)
    old = load_field(file)
    assert (old.up, old.metres_per_unit) == (None, None)
    assert Scene(old, embedder).measure("white plate", "orange ball")["unit"] == "capture units"
    for scale, unit in ((1.0, "metres"), (2.5, "capture units of 2.5 metres")):
        save_field(file, dataclasses.replace(field, up=UpAxis((0.0, 1.0, 0.0), "gravity"), metres_per_unit=scale))
        scene = Scene(load_field(file), embedder)
        assert scene.field.up == UpAxis((0.0, 1.0, 0.0), "gravity")
        assert scene.locate("orange ball").as_dict()["unit"] == unit
        told = scene.measure("white plate", "orange ball")
        assert told["unit"] == "metres"
        assert told["centers"] == pytest.approx(0.06 * scale, rel=0.2)
        assert told["up"] == "gravity"
    with pytest.raises(ValueError, match="a unit of"):
        save_field(file, dataclasses.replace(field, metres_per_unit=0.0))


@pytest.mark.parametrize(
    ("share", "pixel"), [((0.25, 0.5), (25, 40)), ((1, 0.999), (99, 79)), ((25.7, 40.2), (25, 40))]
)
def test_a_pixel_can_be_shares_of_the_frame(share, pixel):
    scene = Scene(*table_field())
    assert pixel_of(At(0, *share), 100, 80) == pixel
    with pytest.raises(InputError, match="of 100x80 px"):
        scene.ask(At(0, 0.001, 0.002))
