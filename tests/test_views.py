"""Scenes without photographs: their up axis, their planned views, and a run and a question on one."""

import dataclasses
import json

import numpy as np
import pytest
from capture_files import small_capture, transforms, write_text_model
from conftest import gaussians_at
from scipy.spatial.transform import Rotation

import jsecon
from jsecon.app.cli import main
from jsecon.splat.transform import transform_gaussians
from jsecon.views import plan
from jsecon.views.frame import scene_frame, surface_points
from jsecon.views.plan import place_cameras

BALLS = {"red": (0.8, 0.1, 0.1), "blue": (0.1, 0.2, 0.8), "green": (0.1, 0.6, 0.15)}
CENTRES = np.array([(-1.2, -0.8, 0.4), (1.0, 0.2, 0.4), (-0.2, 1.1, 0.4)])
SPACING = 0.16


def sheet(corner, first, second):
    """Points of a rectangle, `SPACING` apart."""
    counts = [round(np.linalg.norm(side) / SPACING) + 1 for side in (first, second)]
    a, b = np.meshgrid(*(np.linspace(0, 1, count) for count in counts), indexing="ij")
    return np.asarray(corner) + a.reshape(-1, 1) * np.asarray(first) + b.reshape(-1, 1) * np.asarray(second)


def scene_of(parts):
    """Gaussians of parts (points, colour, size); z is up."""
    count = [len(points) for points, _, _ in parts]
    colours = np.concatenate([np.tile(colour, (n, 1)) for n, (_, colour, _) in zip(count, parts)])
    sizes = np.concatenate([np.full(n, size) for n, (_, _, size) in zip(count, parts)])
    means, sh = np.concatenate([points for points, _, _ in parts]), (colours - 0.5) / 0.28209479
    return gaussians_at(means, sizes[:, None], logit=4, sh=sh[:, None])


def ball_points(centre):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(400, 3))
    return centre + 0.32 * points / np.linalg.norm(points, axis=1, keepdims=True)


def balls():
    return [(ball_points(centre), colour, 0.04) for centre, colour in zip(CENTRES, BALLS.values())]


@pytest.fixture(scope="module")
def room():
    """A floor of 6 x 5, walls of 2.4, and three balls on the floor."""
    grey = (0.55, 0.55, 0.5)
    x, y, z = np.diag([6.0, 5.0, 2.4])
    corner = np.array([-3.0, -2.5, 0.0])
    walls = [sheet(corner, x, z), sheet(corner, y, z), sheet(corner + y, x, z), sheet(corner + x, y, z)]
    parts = [(sheet(corner, x, y), (0.4, 0.35, 0.3), 0.1), *((wall, grey, 0.1) for wall in walls)]
    return scene_of([*parts, *balls()])


@pytest.fixture(scope="module")
def object_alone():
    return scene_of(balls())


@pytest.fixture(scope="module", autouse=True)
def few_candidates():
    """A sixth of the views that are looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "PLACES", 4)
        patch.setattr(plan, "ORBIT_YAWS", 8)
        patch.setattr(plan, "VIEWS_AT_ONCE", 48)
        yield


@pytest.fixture(scope="module")
def around(object_alone):
    """Planned views of the object."""
    return place_cameras(object_alone, views=6, width=160, height=120)


def moved(gaussians, seed, scale=None):
    """The scene turned, scaled (by default at random) and shifted at random; and the similarity."""
    rng = np.random.default_rng(seed)
    similarity = np.eye(4)
    factor = np.exp(rng.uniform(-2, 2))
    similarity[:3, :3] = Rotation.random(random_state=seed).as_matrix() * (scale or factor)
    similarity[:3, 3] = rng.normal(size=3) * 20
    return transform_gaussians(gaussians, similarity), similarity


@pytest.mark.parametrize("seed", range(4))
def test_the_frame_turns_scales_and_moves_with_the_scene(room, seed):
    there, similarity = moved(room, seed)
    size = np.cbrt(np.linalg.det(similarity[:3, :3]))
    first, second = (scene_frame(surface_points(scene)) for scene in (room, there))
    np.testing.assert_allclose(first.axes[2], [0, 0, 1], atol=0.01)
    np.testing.assert_allclose(second.axes[2], similarity[:3, :3] @ first.axes[2] / size, atol=0.01)
    np.testing.assert_allclose(second.centre, similarity[:3, :3] @ first.centre + similarity[:3, 3], atol=0.02 * size)
    np.testing.assert_allclose(np.sort(second.half), np.sort(first.half) * size, rtol=0.03)
    assert first.sure
    assert second.sure


def walls_of(length, width, height):
    """Points of a floor and four walls of a room."""
    x, y, z = np.diag([length, width, height])
    return [sheet(np.zeros(3), *sides) for sides in ((x, y), (x, z), (y, z))] + [sheet(y, x, z), sheet(x, y, z)]


PLACES = {
    "wall larger than the floor": (walls_of(6.0, 2.0, 4.0)[:2], 0.3),
    "room higher than wide": (walls_of(3.0, 3.0, 5.0), 0.3),
    "ceiling": ([*walls_of(4.0, 3.0, 2.5), sheet([0.0, 0.0, 2.5], [4.0, 0.0, 0.0], [0.0, 3.0, 0.0])], 0.3),
    "no floor": ([sheet([-2.0, 0.0, -1.0], [6.0, 0.0, 0.0], [0.0, 0.0, 3.0])], 0.0),
}
"""points of planes, and the height of what lies before them"""


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("seed", range(2))
def test_up_is_right_where_the_largest_plane_is_no_floor(place, seed):
    planes, height = PLACES[place]
    things = [ball_points([x, y, height]) for x, y in ((0.8, 0.6), (2.2, 1.2), (1.4, 1.0))]
    if place == "no floor":  # a board on the wall, and things to both sides of it
        board = sheet([1.0, -0.2, -0.5], [0.5, -1.0, 0.0], [0.0, 0.0, 1.5])
        things = [board, ball_points([1.0, -0.6, 0.2]), ball_points([1.2, 0.8, -0.2])]
    points = np.concatenate([*planes, *things])
    turn = Rotation.random(random_state=seed).as_matrix()
    for scale, rotation in ((1.0, np.eye(3)), (7.0, turn)):
        frame = scene_frame(scale * points @ rotation.T + scale)
        up = rotation.T @ frame.axes[2]
        assert up[2] > 0.98 or (place == "no floor" and up[2] < -0.98)
        assert not (frame.sure and place == "no floor")


def block(draw, low, high, count=500):
    """Points in a box."""
    return draw.uniform(low, high, (count, 3))


def table(draw, tops):
    """Points of a table without a floor, twelve times as large as tables are: a board, legs, and things on it."""
    x, y, z = np.diag([18.0, 10.0, 8.0])
    legs = [block(draw, [a, b, 0], [a + 0.6, b + 0.6, 8], 300) for a in (0.4, 17) for b in (0.4, 9)]
    things = [block(draw, [3 + 3.5 * k, 4, 8], [5 + 3.5 * k, 6, 8 + top]) for k, top in enumerate(tops)]
    return np.concatenate([sheet(z, x, y), sheet(z - [0.0, 0.0, 0.3], x, y), *legs, *things])


def corridor(draw, tops):
    """Points of a corridor whose walls are three times as large as its floor, and of things on the floor."""
    things = [block(draw, [2 + 3 * k, 0.6, 0], [2.8 + 3 * k, 1.4, top]) for k, top in enumerate(tops)]
    return np.concatenate([*walls_of(14.0, 2.0, 6.0), *things])


@pytest.mark.parametrize("make", [table, corridor])
@pytest.mark.parametrize("seed", range(3))
def test_up_is_right_where_gravity_alone_tells(make, seed):
    """A table has things on one side and legs on the other; a corridor's floor is the smallest of its planes."""
    draw = np.random.default_rng(seed)
    points = make(draw, draw.uniform(0.8, 3.0, 4))
    turn = Rotation.random(random_state=seed).as_matrix()
    frame = scene_frame(points @ turn.T)
    np.testing.assert_allclose(frame.axes[2], turn[:, 2], atol=0.03)
    assert frame.sure


@pytest.mark.parametrize("seed", range(3))
def test_up_is_right_in_a_room_whose_floaters_rest_on_nothing(seed):
    """As in a fitted scene: most things are pieces of walls and what a fit leaves in the air."""
    draw = np.random.default_rng(seed)
    things = [block(draw, [0.6 + k, 1, 0], [1 + k, 1.4, 0.4]) for k in range(3)]
    corners = [draw.uniform([0.3, 0.3, 0.5], [3.5, 2.5, 1.4]) for _ in range(7)]
    floaters = [block(draw, corner, corner + 0.1, 60) for corner in corners]
    turn = Rotation.random(random_state=seed).as_matrix()
    frame = scene_frame(np.concatenate([*walls_of(4.0, 3.0, 2.0), *things, *floaters]) @ turn.T)
    np.testing.assert_allclose(frame.axes[2], turn[:, 2], atol=0.03)


def test_a_wrong_up_axis_is_never_sure():
    """A crate has six sides, and things that float have none."""
    draw = np.random.default_rng(0)
    crate = draw.uniform(-1, 1, (4000, 3))
    crate[np.arange(4000), np.arange(4000) % 3] = np.where(np.arange(4000) % 2 == 0, -1, 1)
    floating = np.concatenate([ball_points(centre) for centre in draw.uniform(-1, 1, (6, 3))])
    for points in (crate, floating):
        assert not scene_frame(points).sure


def test_the_up_axis_can_be_given(room):
    frame = scene_frame(surface_points(room), np.array([0.0, 2.0, 0.0]))
    np.testing.assert_allclose(frame.axes[2], [0, 1, 0])
    with pytest.raises(jsecon.InputError, match="direction"):
        scene_frame(surface_points(room), np.zeros(3))


def test_free_places_lie_in_the_room_away_from_its_things(room):
    points = surface_points(room)
    frame = scene_frame(points)
    places = plan._free_places(points, frame)
    assert len(places) == plan.PLACES
    assert (np.abs(places[:, 0]) < 3).all()
    assert (np.abs(places[:, 1]) < 2.5).all()
    distance = np.linalg.norm(places[:, None] - np.asarray(room.means), axis=2).min(1)
    assert (distance > 0.05 * frame.diagonal).all()


def test_greedy_cover_gains_at_each_step_the_most_that_any_view_would():
    rng = np.random.default_rng(0)
    weights = rng.exponential(0.2, (12, 40)) * (rng.random((12, 40)) < 0.3)
    importance = rng.random(40)
    chosen, share = plan._greedy_cover(weights, importance, 5)
    shown = weights / 0.3

    def value(rows):
        return importance @ np.log1p(shown[rows].sum(0))

    picked = []
    for view in chosen:
        assert value([*picked, view]) == pytest.approx(
            max(value([*picked, other]) for other in set(range(12)) - {*picked}), rel=1e-5
        )
        picked.append(int(view))
    assert share == pytest.approx(importance @ np.minimum(shown[picked].sum(0), 1) / importance.sum(), rel=1e-5)
    assert len(set(picked)) == 5


def test_a_room_is_seen_from_inside_and_an_object_from_around(room, object_alone, around):
    inside = place_cameras(room, views=8, width=160, height=120)
    assert inside.kind == "room"
    centres = np.asarray(inside.cameras.centres)
    assert (np.abs(centres[:, 0]) < 3).all()
    assert (np.abs(centres[:, 1]) < 2.5).all()
    assert around.kind == "object"
    assert (np.linalg.norm(np.asarray(around.cameras.centres) - around.frame.centre, axis=1) > 1).all()
    for scene, planned in ((room, inside), (object_alone, around)):
        alphas = [np.asarray(jsecon.render_rgb(scene, camera).alpha).mean() for camera in planned.cameras]
        assert min(alphas) > 0.03
        assert planned.coverage > 0.7


def test_no_view_looks_through_fog():
    """Wide Gaussians beside the balls fill the views from there, as floaters do in fitted scenes."""
    fog = np.random.default_rng(0).uniform([2.0, -1.5, 0], [3.2, 1.5, 2.5], (600, 3))
    scene = scene_of([*balls(), (fog, (0.5, 0.5, 0.5), 0.3)])

    def most_fog():
        cameras = place_cameras(scene, views=16, width=80, height=60, up=np.array([0, 0, 1.0])).cameras
        cameras, labels = cameras[np.arange(48) % 16], np.full((48, 60, 80), -1, np.int32)
        weights = np.asarray(jsecon.region_votes(scene, cameras, labels, 1, top=1, by_view=True).by_view)
        poses = np.asarray(cameras.world_to_camera)
        depth = poses[:, 2, :3] @ scene.means.T + poses[:, 2, 3:]
        wide = np.exp(scene.log_scales[:, 0]) * cameras.fx[:, None] > 0.1 * 80 * depth
        return ((weights * wide).sum(1) / weights.sum(1)).max()

    assert most_fog() < 0.45
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "FOG_SHARE", 2)
        assert most_fog() > 0.9


@pytest.mark.parametrize(("change", "clause"), [
    (lambda g: {"opacity_logits": np.full(g.count, -9.0, np.float32)}, "visible"),
    (lambda g: {"means": np.zeros_like(g.means)}, "one place"),
    (lambda g: {"log_scales": np.full_like(g.log_scales, 5.0)}, "wide"),
], ids=["transparent", "one place", "fog"])  # fmt: skip
def test_a_scene_that_cannot_be_judged_is_refused(object_alone, change, clause):
    with pytest.raises(jsecon.InputError, match=clause):
        place_cameras(dataclasses.replace(object_alone, **change(object_alone)))


def test_a_splat_without_photographs_answers_a_text(room, tmp_path, capsys):
    scene = tmp_path / "scene.ply"
    there, _ = moved(room, 5)
    jsecon.save_gaussians(scene, there)
    field = tmp_path / "field"
    assert main(["run", str(scene), "--out", str(field), "--views", "8", "--long-side", "160"]) == 0
    assert "of a room" in capsys.readouterr().out
    out = tmp_path / "answers"
    assert main(["query", str(field / "field.safetensors"), "red ball", "--out", str(out)]) == 0
    (answer,) = out.glob("*.ply")
    selected = {tuple(mean) for mean in np.round(np.asarray(jsecon.load_gaussians(answer).means), 3)}
    truth = {tuple(mean) for mean in np.round(np.asarray(there.means, np.float32)[-1200:-800], 3)}
    assert len(selected & truth) / len(selected | truth) > 0.8
    assert json.loads(next(out.glob("*.json")).read_text())["count"] == len(selected)


@pytest.mark.parametrize("kind", ["transforms", "colmap"])
def test_given_cameras_take_the_place_of_planned_views(object_alone, around, tmp_path, kind):
    """In the world of the scene's file, which is moved and 200 times larger; no image is needed."""
    there, similarity = moved(object_alone, 3, scale=200.0)
    jsecon.save_gaussians(tmp_path / "scene.ply", there)
    planned = around.cameras[:4]
    poses = np.array(planned.world_to_camera, np.float64) @ np.linalg.inv(similarity)
    poses[:, :3] /= np.linalg.norm(poses[:, :1, :3], axis=2, keepdims=True)
    given = dataclasses.replace(
        small_capture(4), cameras=dataclasses.replace(planned, world_to_camera=poses), names=("a0", "a1", "a2", "a3")
    )
    cameras = tmp_path / ("transforms.json" if kind == "transforms" else "sparse")
    if kind == "transforms":
        cameras.write_text(json.dumps(transforms(given)))
    else:
        write_text_model(given, cameras)
    out = tmp_path / "field"
    assert main(["run", str(tmp_path / "scene.ply"), "--cameras", str(cameras), "--out", str(out)]) == 0
    field = jsecon.load_field(out / "field.safetensors")
    assert field.names == ("a0", "a1", "a2", "a3")
    mine = jsecon.render_rgb(field.gaussians, field.cameras[1]).alpha
    assert np.abs(mine - jsecon.render_rgb(object_alone, planned[1]).alpha).mean() < 0.01


@pytest.mark.parametrize(
    "option", [["--gaussians", "scene.ply"], ["--frames", "5"], ["--holdout", "4"], ["--downscale", "2"]]
)
def test_options_of_photographs_are_refused_for_a_scene_alone(room, tmp_path, capsys, monkeypatch, option):
    monkeypatch.chdir(tmp_path)
    jsecon.save_gaussians("scene.ply", room)
    assert main(["run", "scene.ply", *option, "--out", "field"]) == 2
    assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "field").exists()


def test_an_up_axis_of_length_0_is_refused(room, tmp_path, capsys):
    jsecon.save_gaussians(tmp_path / "scene.ply", room)
    line = ["run", str(tmp_path / "scene.ply"), "--up", "0", "0", "0", "--out", str(tmp_path / "field")]
    assert main(line) == 2
    assert "--up: [0.0, 0.0, 0.0] is no direction" in capsys.readouterr().err


def test_poses_that_look_elsewhere_are_refused(object_alone, tmp_path, capsys):
    jsecon.save_gaussians(tmp_path / "scene.ply", object_alone)
    pose = np.eye(4)
    pose[:3, 3] = 1000
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose.tolist()} for k in range(2)]
    cameras = tmp_path / "poses.json"
    cameras.write_text(json.dumps({"w": 80, "h": 60, "fl_x": 60, "frames": frames}))
    asked = ["run", str(tmp_path / "scene.ply"), "--cameras", str(cameras), "--out", str(tmp_path / "field")]
    assert main(asked) == 2
    assert "poses.json" in capsys.readouterr().err
