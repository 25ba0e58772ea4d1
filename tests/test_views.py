"""Scenes without photographs: their up axis, their planned views, and a run and a question on one."""

import dataclasses
import json

import jax
import laspy
import numpy as np
import pytest
from balls import sphere
from capture_files import compute_stage, context_of, inria, refused, small_capture, transforms, write_text_model
from conftest import gaussians_at
from point_files import OFFSET, las
from scipy.spatial.transform import Rotation

import jsecon
from jsecon.app.cli import main
from jsecon.splat.sh import C0
from jsecon.splat.transform import transform_gaussians
from jsecon.views import placing
from jsecon.views.frame import inner_scene, scene_frame, surface_points
from jsecon.views.placing import frames_by_need, place_cameras

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
    return sphere(np.random.default_rng(3), centre, 0.32, 400)


def balls():
    return [(ball_points(centre), colour, 0.04) for centre, colour in zip(CENTRES, BALLS.values())]


@pytest.fixture(scope="module")
def room():
    """A floor of 6 x 5, walls of 2.4, and three balls on the floor."""
    floor, *walls = (points - (3.0, 2.5, 0.0) for points in walls_of(6.0, 5.0, 2.4))
    grey = [(wall, (0.55, 0.55, 0.5), 0.1) for wall in walls]
    return scene_of([(floor, (0.4, 0.35, 0.3), 0.1), *grey, *balls()])


@pytest.fixture(scope="module")
def object_alone():
    return scene_of(balls())


@pytest.fixture(scope="module", autouse=True)
def few_candidates():
    """A sixth of the views that are looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(placing, "PLACES", 4)
        patch.setattr(placing, "ORBIT_YAWS", 8)
        yield


@pytest.fixture(scope="module")
def around(object_alone):
    """Planned views of the object."""
    return place_cameras(object_alone, views=6, width=160, height=120)


def moved(gaussians, seed):
    """The scene turned, scaled and shifted at random; and the similarity."""
    rng = np.random.default_rng(seed)
    similarity = np.eye(4)
    factor = np.exp(rng.uniform(-2, 2))
    similarity[:3, :3] = Rotation.random(random_state=seed).as_matrix() * factor
    similarity[:3, 3] = rng.normal(size=3) * 20
    return transform_gaussians(gaussians, similarity), similarity


def walls_of(length, width, height):
    """Points of a floor and four walls of a room."""
    x, y, z = np.diag([length, width, height])
    return [sheet(np.zeros(3), *sides) for sides in ((x, y), (x, z), (y, z))] + [sheet(y, x, z), sheet(x, y, z)]


def block(draw, low, high, count=500):
    """Points in a box."""
    return draw.uniform(low, high, (count, 3))


def floor_things(height):
    return [ball_points([x, y, height]) for x, y in ((0.8, 0.6), (2.2, 1.2), (1.4, 1.0))]


def table(draw, tops):
    """A table with things of the heights `tops`, and legs."""
    things = [block(draw, [x, 0.4, 0], [x + 0.4, 0.8, top]) for x, top in zip((0.3, 1.0, 1.7, 2.4), tops)]
    legs = [block(draw, [x, y, -1.2], [x + 0.1, y + 0.1, 0], 150) for x in (0.1, 2.8) for y in (0.1, 1.3)]
    return [sheet([0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 1.5, 0.0]), *things, *legs]


def corridor(draw, tops):
    """A corridor, whose walls are three times as large as its floor, and things on the floor."""
    things = [block(draw, [2 + 3 * k, 0.6, 0], [2.8 + 3 * k, 1.4, top]) for k, top in enumerate(tops)]
    return [*walls_of(14.0, 2.0, 6.0), *things]


def room_with_floaters(draw, _):
    """As in a fitted scene: most things are pieces of walls and what a fit leaves in the air."""
    things = [block(draw, [0.6 + k, 1, 0], [1 + k, 1.4, 0.4]) for k in range(3)]
    corners = [draw.uniform([0.3, 0.3, 0.5], [3.5, 2.5, 1.4]) for _ in range(7)]
    return [*walls_of(4.0, 3.0, 2.0), *things, *(block(draw, corner, corner + 0.1, 60) for corner in corners)]


UPRIGHT = {
    "wall larger than the floor": lambda *_: walls_of(6.0, 2.0, 4.0)[:2] + floor_things(0.3),
    "room higher than wide": lambda *_: walls_of(3.0, 3.0, 5.0) + floor_things(0.3),
    "ceiling": lambda *_: [*walls_of(4.0, 3.0, 2.5), sheet([0, 0, 2.5], [4.0, 0, 0], [0, 3.0, 0]), *floor_things(0.3)],
    "table": table,
    "corridor": corridor,
    "room with floaters": room_with_floaters,
}
"""points of places, of a generator and heights"""


@pytest.mark.parametrize("place", UPRIGHT)
@pytest.mark.parametrize("seed", range(2))
def test_up_is_right_whatever_the_largest_plane_is(place, seed):
    draw = np.random.default_rng(seed)
    points = np.concatenate(UPRIGHT[place](draw, draw.uniform(0.8, 3.0, 4)))
    turn = Rotation.random(random_state=seed).as_matrix()
    for scale, rotation in ((1.0, np.eye(3)), (7.0, turn)):
        frame = scene_frame(scale * points @ rotation.T + scale)
        np.testing.assert_allclose(frame.axes[2], rotation[:, 2], atol=0.03)
        assert frame.sure or place not in ("table", "corridor")


def test_a_wrong_up_axis_is_never_sure_and_one_can_be_given(room):
    """A crate has six sides, things that float have none, and a wall with a board has no floor."""
    draw = np.random.default_rng(0)
    crate = draw.uniform(-1, 1, (4000, 3))
    crate[np.arange(4000), np.arange(4000) % 3] = np.where(np.arange(4000) % 2 == 0, -1, 1)
    floating = np.concatenate([ball_points(centre) for centre in draw.uniform(-1, 1, (6, 3))])
    wall, board = sheet([-2, 0, -1], [6, 0, 0], [0, 0, 3]), sheet([1, -0.2, -0.5], [0.5, -1, 0], [0, 0, 1.5])
    before_wall = np.concatenate([wall, board, ball_points([1.0, -0.6, 0.2]), ball_points([1.2, 0.8, -0.2])])
    for points in (crate, floating, before_wall):
        assert not scene_frame(points).sure
    np.testing.assert_allclose(scene_frame(surface_points(room), np.array([0.0, 2.0, 0.0])).axes[2], [0, 1, 0])


def test_a_room_is_seen_from_inside_and_an_object_from_around(room, object_alone, around):
    inside = place_cameras(room, views=8, width=160, height=120)
    assert inside.kind == "room"
    centres = np.asarray(inside.cameras.centres)
    assert (np.abs(centres[:, :2]) < [3, 2.5]).all()
    assert around.kind == "object"
    assert (np.linalg.norm(np.asarray(around.cameras.centres) - around.frame.centre, axis=1) > 1).all()
    for scene, planned in ((room, inside), (object_alone, around)):
        alphas = [np.asarray(jsecon.render_rgb(scene, camera).alpha).mean() for camera in planned.cameras]
        assert min(alphas) > 0.03
        assert planned.coverage > 0.7


def directions(draw, count):
    """Unit vectors above the horizon."""
    vectors = sphere(draw, 0.0, 1.0, count)
    vectors[:, 2] = np.abs(vectors[:, 2])
    return vectors


def far_houses(draw, count):
    """Eleven boxes around the scene."""
    house = draw.integers(0, 11, count)
    place = 28 * np.stack([np.cos(house), np.sin(house), 0 * house], axis=1)
    return place + draw.uniform([-1.5, -1.5, 0], [1.5, 1.5, 4], (count, 3))


SURROUNDINGS = {
    "half a shell": lambda draw, count: 55 * directions(draw, count),
    "far houses": far_houses,
    "haze at several distances": lambda draw, count: (
        directions(draw, count) * draw.choice([14, 25, 44], (count, 1)) * draw.uniform(0.8, 1.2, (count, 1))
    ),
}
"""points around a scene of 4 units, of a generator and a count"""


def test_frames_for_masks_are_those_that_show_what_others_do_not():
    outward, up = CENTRES * (1, 1, 0) / np.linalg.norm(CENTRES[:, :2], axis=1, keepdims=True), np.array([0, 0, 1.0])
    poses = [placing._look(centre - 1.5 * way, way, up) for centre, way in zip(CENTRES, outward)]  # each shows one ball
    away = placing._look(CENTRES[0] + (0, 0, 9), outward[0], up)
    cameras = placing._cameras(np.stack([*[poses[0]] * 12, poses[1], poses[2], away]), 40, 30)
    chosen = frames_by_need(scene_of(balls()), cameras)
    assert sorted(chosen[:3]) == [0, 12, 13]
    assert 14 not in chosen  # it shows nothing
    np.testing.assert_array_equal(frames_by_need(scene_of(balls()), cameras, limit=2), chosen[:2])


@pytest.mark.parametrize("place", SURROUNDINGS)
@pytest.mark.parametrize(("share", "seed"), [(0.02, 0), (0.13, 1), (0.6, 0)])
def test_far_surroundings_of_any_share_leave_the_frame_as_it_is(object_alone, place, share, seed):
    count = round(object_alone.count * share / (1 - share))
    points = SURROUNDINGS[place](np.random.default_rng(seed), count)
    far = gaussians_at(points, np.full((count, 1), (0.1, 3.0)[seed]), sh=object_alone.sh[:1])
    scene = jax.tree.map(lambda *parts: np.concatenate(parts), object_alone, far)
    there, similarity = moved(scene, seed)
    inner = inner_scene(there)
    assert inner[: object_alone.count].all()
    assert not inner[object_alone.count :].any()
    expected = scene_frame(surface_points(transform_gaussians(object_alone, similarity)))
    frame = scene_frame(surface_points(there))
    np.testing.assert_allclose(frame.axes, expected.axes, atol=1e-9)
    np.testing.assert_allclose(np.append(frame.centre, frame.half), np.append(expected.centre, expected.half))


def test_views_through_fog_alone_are_said_to_show_hardly_any_detail(around):
    draw = np.random.default_rng(0)
    scene = scene_of([(draw.uniform(-1, 1, (400, 3)), (0.5, 0.5, 0.5), 0.33)])
    (warning,) = place_cameras(scene, views=6, width=80, height=60).lack_of_detail()
    assert "views show hardly any detail" in warning
    assert around.lack_of_detail() == ()


@pytest.mark.parametrize(("change", "clause"), [
    (lambda g: {"opacity_logits": np.full(g.count, -9.0, np.float32)}, "visible"),
    (lambda g: {"means": np.zeros_like(g.means)}, "one place"),
    (lambda g: {"log_scales": np.full_like(g.log_scales, 5.0)}, "wide"),
], ids=["transparent", "one place", "fog"])  # fmt: skip
def test_a_scene_that_cannot_be_judged_is_refused(object_alone, change, clause):
    with pytest.raises(jsecon.InputError, match=clause):
        place_cameras(dataclasses.replace(object_alone, **change(object_alone)))


def test_a_cloud_without_photographs_answers_a_text_and_gets_its_labels(room, tmp_path):
    """At coordinates of a map, whose reference system goes with the answers."""
    cloud, out = tmp_path / "cloud.laz", tmp_path / "labelled.laz"
    points = np.asarray(room.means, np.float64) + OFFSET
    las(cloud, points, np.rint(255 * np.clip(0.5 + C0 * room.sh[:, 0], 0, 1)).astype(np.uint8))
    field = tmp_path / "field"
    assert main(["run", str(cloud), "--out", str(field), "--views", "8", "--long-side", "160"]) == 0
    assert main(["export", str(field), "--out", str(out)]) == 0
    told = json.loads((tmp_path / "labels.json").read_text())
    assert told["crs"] == "EPSG:25832"
    ball = next(row for row in told["objects"] if row["name"] == "red")
    np.testing.assert_allclose(ball["box"]["center"], points[-1200:-800].mean(0), atol=0.1)
    written, truth = laspy.read(out), np.zeros(len(points), bool)
    truth[-1200:-800] = True
    found = np.asarray(written.object_id) == ball["id"]
    assert (found & truth).sum() / (found | truth).sum() > 0.8
    np.testing.assert_allclose(written.xyz, points, rtol=0, atol=6e-4)
    assert main(["export", str(field), "--out", str(out), "--only", "red ball"]) == 0
    assert 300 < len(laspy.read(out).points) < 600


@pytest.fixture
def splat(object_alone, tmp_path):
    """The object where INRIA's training leaves it, in OUTPUT/point_cloud/iteration_7."""
    file = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    file.parent.mkdir(parents=True)
    jsecon.save_gaussians(file, object_alone)
    return file


@pytest.fixture(scope="module")
def posed(around):
    """A capture whose cameras look at the object from around."""
    names = tuple(f"a{n}" for n in range(len(around.cameras)))
    return dataclasses.replace(small_capture(len(names)), cameras=around.cameras, names=names)


def views_of(splat, **options):
    """The capture of renders that a run makes of a splat, its notes, and what the run plans."""
    result, stage = compute_stage(context_of(splat, splat.parent / "out", long_side=160, **options), "load")
    return result.value, " ".join(result.notes), stage.task


@pytest.mark.parametrize("kind", ["cameras.json", "transforms.json", "sparse"])
def test_poses_beside_or_above_a_splat_take_the_place_of_planned_views(splat, posed, object_alone, tmp_path, kind):
    """nerfstudio's splat is in the world that it trained in, turned and made smaller; its poses are not, and may be of
    a world that an applied_transform made of the source's."""
    up = None
    if kind == "cameras.json":
        (tmp_path / kind).write_text(json.dumps(inria(posed)))
    elif kind == "sparse":
        write_text_model(posed, tmp_path / "sparse" / "0")
    else:
        applied = np.eye(4)[[0, 2, 1, 3]] * [[1], [1], [-1], [1]]
        turn = np.eye(4)[[2, 0, 1, 3]]
        trained = np.diag([0.4, 0.4, 0.4, 1]) @ turn
        content = transforms(
            posed, applied_transform=applied[:3].tolist(), orientation_override="none", ply_file_path="a.ply"
        )
        (tmp_path / kind).write_text(json.dumps(content))
        told = {"transform": (turn @ applied)[:3].tolist(), "scale": 0.4}
        (splat.parent / "dataparser_transforms.json").write_text(json.dumps(told))
        jsecon.save_gaussians(splat, object_alone, similarity=trained)
        up = turn[:3, 2]
    capture, notes, how = views_of(splat)
    assert kind in how
    assert "WARNING" not in notes
    assert f"6 views at poses of {tmp_path}" in notes
    assert capture.names == posed.names
    for frame, camera in zip(capture.frames, posed.cameras):
        image = np.asarray(jsecon.render_rgb(object_alone, camera).features)
        assert np.abs(frame / 255 - np.clip(image, 0, 1)).mean() < 0.005
    assert up is None or np.allclose(capture.up.axis, up)


@pytest.mark.parametrize(("change", "words"), [
    (lambda rows: {"cameras": []}, "'frames' is missing"),
    (lambda rows: [], "no frame"),
    (lambda rows: [{**row, "fx": None} for row in rows], "camera 0"),
    (lambda rows: [{**row, "rotation": [1, 2]} for row in rows], "camera 0"),
    (lambda rows: [*rows, "a4"], "camera 6"),
    (lambda rows: [{**row, "rotation": (2 * np.eye(3)).tolist()} for row in rows], "not rigid"),
], ids=["another file", "empty", "no focal length", "no rotation", "no camera", "scaled"])  # fmt: skip
def test_a_damaged_file_of_cameras_is_refused(splat, posed, change, words):
    """And what the file of cameras is called does not matter."""
    file = splat.parent / "poses.json"
    file.write_text(json.dumps(change(inria(posed))))
    with refused("poses.json", words):
        views_of(splat, cameras=file)


@pytest.mark.parametrize(("content", "words"), [
    (lambda posed: json.dumps(inria(posed, np.diag([-1.0, 1, -1, 1]))), "0% of which show 0% of point_cloud.ply"),
    (lambda posed: json.dumps(inria(posed)[:1]), "1 cameras"),
    (lambda posed: json.dumps(inria(posed))[:-9], "not JSON"),
], ids=["elsewhere", "one", "cut"])  # fmt: skip
def test_poses_that_do_not_show_the_splat_are_named_and_views_planned(splat, posed, tmp_path, content, words):
    (tmp_path / "cameras.json").write_text(content(posed))
    capture, notes, _ = views_of(splat)
    assert notes.startswith("WARNING: Views are planned")
    assert f"{tmp_path / 'cameras.json'}: " in notes
    assert words in notes
    assert capture.names == tuple(f"view_{n:03d}" for n in range(24))


def test_a_number_of_views_plans_them_although_poses_lie_beside(splat, posed, capsys):
    (splat.parent / "cameras.json").write_text(json.dumps(inria(posed)))
    assert main(["run", str(splat), "--out", str(splat.parent / "field"), "--dry-run"]) == 0
    assert "cameras.json" in capsys.readouterr().out
    capture, _, how = views_of(splat, views=3)
    assert "3 virtual views, planned" in how
    assert capture.names == ("view_000", "view_001", "view_002")
    capture, _, _ = views_of(splat, cameras=splat.parent / "cameras.json")
    assert capture.names == posed.names


@pytest.mark.parametrize(
    "option", [["--gaussians", "scene.ply"], ["--frames", "5"], ["--holdout", "4"], ["--downscale", "2"]]
)
def test_options_of_photographs_are_refused_for_a_scene_alone(room, tmp_path, capsys, monkeypatch, option):
    monkeypatch.chdir(tmp_path)
    jsecon.save_gaussians("scene.ply", room)
    assert main(["run", "scene.ply", *option, "--out", "field"]) == 2
    assert option[0] in capsys.readouterr().err
    assert not (tmp_path / "field").exists()
