"""Relations between objects: properties of the predicates, the grammar, and answers of 0, 1 or several objects."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from table_field import THINGS, table_field

import jsecon
from jsecon import InputError, ObjectShapes, Regions, Scene, save_field
from jsecon.app import cli
from jsecon.query.expressions import ANCHORED_ORDERS, RELATIONS
from jsecon.query.relations import Viewpoint, between_scores, order_values, pair_scores

CORNERS = np.stack(np.meshgrid(*[np.linspace(-1, 1, 3)] * 3), -1).reshape(-1, 3)
PLACES = st.tuples(*[st.floats(-2, 2, width=32)] * 3)
PAIRS = [name for name in RELATIONS if name not in ("between", *ANCHORED_ORDERS)]
SIDES = st.tuples(*[st.floats(0.125, 0.5, width=32)] * 3)


def brick(center, half, turn=0.0):
    """An upright box that is turned about z, with points on a grid in it."""
    axes = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    points = np.array(center) + (CORNERS * half) @ axes.T
    columns = center, axes, half, points.min(0), points.max(0), points
    return ObjectShapes(*(np.asarray(column, np.float32)[None] for column in columns), np.array([27]))


def looking(eye=(0.0, -9.0, 1.0), turn=0.0):
    forward = np.array([-np.sin(turn), np.cos(turn), 0], np.float32)
    return Viewpoint(np.asarray(eye, np.float32), forward, np.array([0, 0, 1], np.float32))


def scores(a, b, view=None):
    table = {name: float(pair_scores(name, a, b, view or looking())[0, 0]) for name in PAIRS}
    return table | {"gap": float(pair_scores("nearest to", a, b, looking())[0, 0])}


@settings(max_examples=15, deadline=None)
@given(PLACES, PLACES, SIDES, SIDES, st.floats(0.1, 50.0), st.floats(-3, 3), PLACES)
def test_scores_stand_any_scene_that_is_moved_turned_and_scaled(a, b, half_a, half_b, scale, turn, shift):
    c, s = np.cos(turn), np.sin(turn)
    about_up = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def moved(place):
        return scale * (about_up @ np.array(place)) + shift

    here = scores(brick(a, half_a), brick(b, half_b))
    other = brick(moved(a), scale * np.array(half_a), turn), brick(moved(b), scale * np.array(half_b), turn)
    there = scores(*other, looking(moved((0.0, -9.0, 1.0)), turn))
    assert all(0 <= here[name] <= 1 for name in PAIRS)
    for name in PAIRS:
        if name not in ("in", "on", "above", "below", "under", "next to"):  # a point on a footprint's edge may tip over
            assert there[name] == pytest.approx(here[name], abs=0.02), name
    assert there["gap"] == pytest.approx(scale * here["gap"], rel=1e-3, abs=scale * 1e-4)


@settings(max_examples=15, deadline=None)
@given(PLACES, PLACES, SIDES, SIDES)
def test_directions_are_antisymmetric(a, b, half_a, half_b):
    one, other = brick(a, half_a), brick(b, half_b)
    forth, back = scores(one, other), scores(other, one)
    for name, opposite in (("left of", "right of"), ("in front of", "behind"), ("above", "below")):
        assert forth[name] == pytest.approx(back[opposite], abs=1e-5)
        assert min(forth[name], forth[opposite]) < 0.5
    for name in ("near", "far from", "touching", "next to", "gap"):
        assert forth[name] == pytest.approx(back[name], abs=1e-5)


@settings(max_examples=15, deadline=None)
@given(SIDES, SIDES, st.lists(st.floats(0, 10, width=32), min_size=2, max_size=2))
def test_near_falls_with_the_distance(half_a, half_b, distances):
    one = brick((0, 0, 0), half_a)
    close, far = (scores(one, brick((d, 0, 0), half_b)) for d in sorted(distances))
    assert far["near"] <= close["near"] + 1e-6
    assert far["far from"] >= close["far from"] - 1e-6
    assert far["touching"] <= close["touching"] + 1e-6


def test_relations_of_known_places():
    table = brick((0, 0, 0.35), (0.5, 0.4, 0.02))
    mug = brick((0.1, 0, 0.43), (0.05, 0.05, 0.06))
    crate = brick((0, 0, 0.1), (0.15, 0.15, 0.1))
    ball = brick((0.3, 0.02, 0.42), (0.05, 0.05, 0.05))
    true = {
        ("mug", "table"): {"on", "above", "touching", "near"},
        ("crate", "table"): {"under", "below", "near"},
        ("ball", "mug"): {"right of", "near"},
        ("mug", "crate"): {"above", "near"},
    }
    shapes = {"table": table, "mug": mug, "crate": crate, "ball": ball}
    for (a, b), names in true.items():
        got = scores(shapes[a], shapes[b])
        assert all(got[name] >= 0.5 for name in names), (a, b, got)
        assert not [
            name for name in ("on", "in", "behind", "left of", "far from") if got[name] >= 0.5 and name not in names
        ]
    bowl = brick((0, 0, 0.05), (0.12, 0.12, 0.05))
    egg = scores(brick((0, 0, 0.06), (0.04, 0.04, 0.04)), bowl)
    assert egg["in"] > 0.5 > egg["on"]
    middle, ends = brick((0, 0, 0), (0.1, 0.1, 0.1)), (brick((-1, 0, 0), (0.1,) * 3), brick((1, 0.1, 0), (0.1,) * 3))
    assert between_scores(middle, *ends)[0, 0, 0] > 0.9 > 0.1 > between_scores(ends[0], middle, ends[1])[0, 0, 0]


def test_what_crosses_beneath_is_under_and_what_passes_beside_is_not():
    """A lintel over a long beam: each has few of its points over or under the other."""
    beam, lintel = brick((0, 0, 0.03), (0.35, 0.03, 0.03)), brick((0.04, 0.02, 0.16), (0.02, 0.12, 0.02))
    assert scores(beam, lintel)["under"] > 0.5
    assert scores(lintel, beam)["above"] > 0.5
    assert scores(lintel, beam)["next to"] < 0.5
    assert scores(beam, brick((0.04, 0.2, 0.16), (0.02, 0.12, 0.02)))["under"] < 0.5


def test_predicates_are_batched():
    one, other = brick((0, 0, 0), (0.1,) * 3), brick((1, 0, 0), (0.2,) * 3)
    both = jax.tree.map(lambda *columns: np.concatenate(columns), one, other)
    for relation in PAIRS:
        table = pair_scores(relation, both, both, looking())
        for n, a in enumerate((one, other)):
            for k, b in enumerate((one, other)):
                np.testing.assert_allclose(table[n, k], pair_scores(relation, a, b, looking())[0, 0], rtol=1e-6)
    values = order_values(both, looking())
    assert values["largest"].argmin() == values["tallest"].argmin() == values["rightmost"].argmin() == 1


@pytest.fixture(scope="module")
def scene():
    return Scene(*table_field(), up=(0, 0, 1))  # one camera that looks down does not tell


def test_one_object_and_what_it_was_compared_with(scene):
    answer = scene.relate("the red mug left of the dark green bottle")
    assert answer.objects[0].regions == (0,)
    assert answer.as_dict()["relation"]["objects"][0]["center"] == pytest.approx([-0.5, 0, 0.05], abs=0.02)
    assert not answer.question
    assert [found.regions for found in answer.used] == [(2,)]
    assert answer.objects[0].conditions["left of dark green bottle"] > 0.5
    assert answer.mask.sum() == len(answer.objects[0].rows) > 100
    assert "mean of the cameras" in answer.viewpoint
    assert scene.relate("the red mug near the dark blue box").viewpoint == ""


@pytest.mark.parametrize(("text", "regions"), [
    ("the red mug right of the dark green bottle", [1]), ("the orange ball on the white plate", [4]),
    ("the white plate under the orange ball", [3]), ("the dark green bottle between the red mugs", [2]),
    ("the dark blue box behind the dark green bottle", [5]), ("the leftmost red mug", [0]),
    ("the second red mug from the left", [1]), ("the red mug nearest to the dark blue box", [1]),
    ("the red mug farthest from the dark blue box", [0]), ("two red mugs", [0, 1]), ("all red mugs", [0, 1]),
    ("the red mug left of the dark green bottle and far from the dark blue box", [0]),
    ("the orange ball on the white plate in front of the dark green bottle", [4]),
    ("the dark blue box on the white plate", []), ("third red mug from the left", []),
])  # fmt: skip
def test_answers_of_no_one_and_several_objects(scene, text, regions):
    answer = scene.relate(text)
    assert sorted(r for found in answer.objects for r in found.regions) == regions
    assert bool(answer.reason) == (not regions)
    assert json.dumps(answer.as_dict())


def test_an_open_question_is_asked_and_a_near_miss_is_named(scene):
    answer = scene.relate("the red mug")
    assert answer.count == 2
    assert answer.question.startswith("2 'red mug': the one near the ") or "the left one" in answer.question
    none = scene.relate("the orange ball on the dark blue box")
    assert none.count == 0
    assert "not on dark blue box" in none.reason
    assert "'pink'" in scene.relate("the pink vase on the white plate").reason.replace("pink vase", "pink")
    three = scene.relate("three red mugs")
    assert "the text says 3 and 2 match" in three.reason


def test_orange_means_the_orange_thing_where_there_is_a_dark_orange_one_too():
    """With regions whose colours are only near to the words', as those of frames are."""
    field, embedder = table_field((*THINGS, ("dark orange bowl", (0.8, -0.6, 0.05), (0.05, 0.05, 0.05))))
    seen = np.array(field.regions.embeddings)
    seen[4], seen[6] = seen[4] + 0.5 * embedder.embed_text(["yellow"])[0], seen[6] + 0.3 * seen[4]
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    field = dataclasses.replace(field, regions=Regions(seen, field.regions.pixel_counts))
    scene = Scene(field, embedder, up=(0, 0, 1))
    for text, region in (("all orange balls", 4), ("all dark orange bowls", 6)):
        assert [found.regions for found in scene.relate(text).objects] == [(region,)]


def test_the_ends_of_a_beam_whose_middle_is_hidden_are_one_object():
    ends = [("purple beam", (x, 0.3, 0.03), (0.15, 0.03, 0.03)) for x in (-0.16, 0.16)]
    scene = Scene(*table_field((*THINGS, *ends, ("purple ball", (0.9, -0.7, 0.05), (0.05, 0.05, 0.05)))))
    answer = scene.relate("how many purple things")
    assert sorted(found.regions for found in answer.objects) == [(6, 7), (8,)]


def test_directions_follow_the_frame_and_cameras_around_take_the_fullest_frame():
    around = [(0.0, -2.0, 0.8), (0.0, 2.0, 0.8), (2.0, 0.0, 0.8)]
    field, embedder = table_field(directions=around)
    scene = Scene(field, embedder)
    text = "the red mug left of the dark green bottle"
    for frame, region in (("frame_0", 0), ("frame_1", 1)):
        answer = scene.relate(text, frame=frame)
        assert answer.objects[0].regions == (region,)
        assert answer.viewpoint == f"as seen from {frame}"
    assert "as seen from frame_" in scene.relate(text).viewpoint
    given = Scene(field, embedder, up=(0, 0, 1)).relate(text, frame=1)
    assert given.objects[0].regions == (1,)


def test_the_ground_tells_what_is_up_where_cameras_look_one_way_and_down():
    field, embedder = table_field((*THINGS, ("light grey floor", (0.0, 0.0, -0.01), (1.5, 1.5, 0.001))))
    np.testing.assert_allclose(Scene(field, embedder).objects().up, [0, 0, 1], atol=0.02)
    np.testing.assert_allclose(jsecon.objects(field, None, embedder).up, [0, 0, 1], atol=0.02)
    np.testing.assert_allclose(jsecon.objects(field, None, embedder, up=(0, 2, 0)).up, [0, 1, 0], atol=1e-9)
    around = table_field(directions=[(0.0, -2.0, 0.8), (2.0, 0.0, 0.8)])
    np.testing.assert_allclose(Scene(*around).objects().up, [0, 0, 1], atol=1e-3)


def test_measures_are_in_the_captures_world():
    source_from_scene = np.diag([2.0, 2.0, 2.0, 1.0])
    source_from_scene[:3, 3] = [500_000, 5_000_000, 7]
    field, embedder = table_field(source_from_scene=source_from_scene)
    told = Scene(field, embedder).measure("the leftmost red mug", "the dark green bottle")
    assert told["centers"] == pytest.approx(2 * np.hypot(0.5, 0.1), rel=0.05)
    assert told["surfaces"] == pytest.approx(2 * 0.41, rel=0.08)
    assert told["gap"] == pytest.approx(2 * 0.41, rel=0.1)
    assert told["angle"] == pytest.approx(np.degrees(np.arctan2(0.1, 0.5)), abs=2)
    assert told["unit"] == "capture units"
    with pytest.raises(InputError, match="names 2 objects"):
        Scene(field, embedder).measure("the red mug", "the dark green bottle")


def test_odd_input_has_an_error_of_its_own(scene):
    with pytest.raises(InputError, match="no such frame"):
        scene.relate("the leftmost red mug", frame="nowhere")
    with pytest.raises(InputError, match="is no direction"):
        Scene(*table_field(), up=(0, 0, 0)).ask("the leftmost red mug")
    field, embedder = table_field()
    none = Regions(np.zeros((0, embedder.dim), np.float32), np.zeros((0, 1), np.int32))
    with pytest.raises(InputError, match="no regions"):
        Scene(dataclasses.replace(field, regions=none), embedder).ask("the leftmost red mug")
    with pytest.raises(InputError, match="colour"):
        scene.relate("the mug on the plate")
    answer = Scene(*table_field(THINGS[:1])).relate("the red mug left of the dark green bottle")
    assert "nothing to compare with" in answer.reason


def test_query_answers_expressions_and_says_so(tmp_path, capsys):
    field, _ = table_field()
    save_field(tmp_path / "field.safetensors", field)
    texts = "the leftmost red mug", "the dark blue box near", '"red mug" or "dark blue box"', "how many red mugs"
    line = ["query", str(tmp_path / "field.safetensors"), *texts, "--views", "0"]
    line += ["--from", "frame_0", "--out", str(tmp_path / "out")]
    assert cli.main([*line, "--up", "0", "0", "1"]) == 2
    told = capsys.readouterr()
    assert "read as 'red mug', leftmost, as seen from frame_0: 1 object (red mug)" in told.out
    assert "an object is missing" in told.err
    record = json.loads((tmp_path / "out" / "the-leftmost-red-mug.json").read_text())
    assert record["by"] == "relation"
    assert record["objects"] == len(record["relation"]["objects"]) == 1
    assert record["place"]["centroid"] == pytest.approx([-0.5, 0, 0.05], abs=0.02)
    records = [json.loads(file.read_text()) for file in (tmp_path / "out").glob("*.json")]
    assert sorted(record["by"] for record in records) == ["relation", "relation", "votes"]
    for option in (line[-4:-2], ["--up", "0", "0", "1"]):
        assert cli.main([*line[:2], "red mug", *option, *line[-2:]]) == 2
        assert f"{option[0]}: no text has a relation" in capsys.readouterr().err
