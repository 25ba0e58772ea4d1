"""Relations between objects: properties of the predicates, the grammar, and answers of 0, 1 or several objects."""

import csv
import dataclasses
import json

import jax
import numpy as np
import pytest
from capture_files import run_cli
from hypothesis import given, settings, strategies as st
from table_field import THINGS, UP, table_field

from jsecon import InputError, ObjectShapes, Regions, Scene, open_scene, save_field
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
def test_scores_follow_a_scene_that_is_moved_turned_and_scaled_and_are_antisymmetric(
    a, b, half_a, half_b, scale, turn, shift
):
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
    back = scores(brick(b, half_b), brick(a, half_a))
    for name, opposite in (("left of", "right of"), ("in front of", "behind"), ("above", "below")):
        assert here[name] == pytest.approx(back[opposite], abs=1e-5)
        assert min(here[name], here[opposite]) < 0.5
    for name in ("near", "far from", "touching", "next to", "gap"):
        assert here[name] == pytest.approx(back[name], abs=1e-5)


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
    # A lintel over a long beam: each has few of its points over or under the other.
    beam, lintel = brick((0, 0, 0.03), (0.35, 0.03, 0.03)), brick((0.04, 0.02, 0.16), (0.02, 0.12, 0.02))
    assert scores(beam, lintel)["under"] > 0.5 > scores(lintel, beam)["next to"]
    assert scores(beam, brick((0.04, 0.2, 0.16), (0.02, 0.12, 0.02)))["under"] < 0.5
    middle, ends = brick((0, 0, 0), (0.1, 0.1, 0.1)), (brick((-1, 0, 0), (0.1,) * 3), brick((1, 0.1, 0), (0.1,) * 3))
    assert between_scores(middle, *ends)[0, 0, 0] > 0.9 > 0.1 > between_scores(ends[0], middle, ends[1])[0, 0, 0]


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
    return Scene(*table_field(up=UP))


def test_any_object_has_its_name_in_the_answer(scene):
    answer = scene.ask("what is on the white plate?")
    assert [found.regions for found in answer.objects] == [(4,)]
    assert "orange" in answer.objects[0].phrase
    assert f"1 object ({answer.objects[0].phrase})" in str(answer)
    assert scene.ask("is there anything on the orange ball?").count == 0


def test_an_order_counts_what_it_chooses_from(scene):
    assert scene.ask("the left of the two red mugs").reason == ""
    assert "says 3 and 2 match" in scene.ask("the left one of the three red mugs").reason


def test_metres_need_a_scene_in_metres(scene):
    for text in ("the red mug within 1 m of the dark blue box", "red mugs at least 30 cm from the orange ball"):
        with pytest.raises(InputError, match="in metres is not known"):
            scene.ask(text)
    field, embedder = table_field(source_from_scene=np.diag([4.0, 4.0, 4.0, 1.0]), up=UP)
    known = Scene(dataclasses.replace(field, metres_per_unit=0.5), embedder)
    near = {cm: known.ask(f"red mugs within {cm} cm of the dark blue box").count for cm in (20, 95, 400)}
    assert near == {20: 0, 95: 1, 400: 2}


@pytest.mark.parametrize(("text", "regions"), [
    ("the white plate under the orange ball", [3]), ("the dark green bottle between the red mugs", [2]),
    ("the dark blue box behind the dark green bottle", [5]), ("the leftmost red mug", [0]),
    ("the second red mug from the left", [1]), ("the red mug nearest to the dark blue box", [1]),
    ("the red mug farthest from the dark blue box", [0]), ("two red mugs", [0, 1]), ("all red mugs", [0, 1]),
    ("the red mug left of the dark green bottle and far from the dark blue box", [0]),
    ("the orange ball on the white plate in front of the dark green bottle", [4]),
    ("the dark blue box on the white plate", []), ("third red mug from the left", []),
    ("the right red mug", [1]), ("the front red mug", [0]), ("the back red mug", [1]),
    ("the orange ball smaller than the dark blue box", [4]), ("the orange ball larger than the dark blue box", []),
    ("the left of the two red mugs", [0]), ("the red mug within 0.47 units of the dark blue box", [1]),
    ("the red mug at least 0.47 units from the dark blue box", [0]),
    ("red mugs within 2 units of the orange ball", [0, 1]),
])  # fmt: skip
def test_answers_of_no_one_and_several_objects(scene, text, regions):
    answer = scene.relate(text)
    assert sorted(r for found in answer.objects for r in found.regions) == regions
    assert bool(answer.reason) == (not regions)
    assert json.dumps(answer.as_dict())


def test_one_object_and_what_it_was_compared_with(scene):
    answer = scene.relate("the red mug left of the dark green bottle")
    assert answer.objects[0].regions == (0,)
    assert [found.regions for found in answer.used] == [(2,)]
    assert answer.objects[0].conditions["left of dark green bottle"] > 0.5
    assert answer.as_dict()["relation"]["objects"][0]["center"] == pytest.approx([-0.5, 0, 0.05], abs=0.02)
    assert "mean of the cameras" in answer.viewpoint


def test_an_open_question_is_asked_and_a_near_miss_is_named(scene):
    assert scene.relate("the red mug").question.startswith("which of 2 'red mug' is meant, from left")
    for text, reason in (
        ("the orange ball on the dark blue box", "no 'orange ball' is on dark blue box"),
        ("the pink vase on the white plate", "'pink"),
        ("three red mugs", "the text says 3 and 2 match"),
    ):
        assert reason in scene.relate(text).reason


def test_directions_follow_the_frame_and_cameras_around_take_the_fullest_frame():
    around = [(0.0, -2.0, 0.8), (0.0, 2.0, 0.8), (2.0, 0.0, 0.8)]
    field, embedder = table_field(directions=around)
    scene = Scene(field, embedder)
    np.testing.assert_allclose(scene.objects().up, [0, 0, 1], atol=1e-3)
    text = "the red mug left of the dark green bottle"
    for frame, region in (("frame_0", 0), ("frame_1", 1)):
        answer = scene.relate(text, frame=frame)
        assert answer.objects[0].regions == (region,)
        assert answer.viewpoint == f"as seen from {frame}"
    assert "as seen from frame_" in scene.relate(text).viewpoint


def test_measures_are_in_the_captures_world():
    source_from_scene = np.diag([2.0, 2.0, 2.0, 1.0])
    source_from_scene[:3, 3] = [500_000, 5_000_000, 7]
    field, embedder = table_field(source_from_scene=source_from_scene)
    told = Scene(field, embedder).measure("the leftmost red mug", "the dark green bottle")
    assert told["centers"] == pytest.approx(2 * np.hypot(0.5, 0.1), rel=0.05)
    assert told["surfaces"] == pytest.approx(2 * 0.41, rel=0.08)
    assert told["angle"] == pytest.approx(np.degrees(np.arctan2(0.1, 0.5)), abs=2)
    with pytest.raises(InputError, match="names 2 objects"):
        Scene(field, embedder).measure("the red mug", "the dark green bottle")


def test_a_known_length_gives_metres_which_the_field_keeps(tmp_path, capsys):
    field, _ = table_field(source_from_scene=np.diag([2.0, 2.0, 2.0, 1.0]))
    save_field(tmp_path / "field.safetensors", field)
    plate, ball, bottle = "white plate", "orange ball", "dark green bottle"
    assert run_cli("measure", tmp_path, "--scale", plate, bottle, 0.52) == 0  # true: |(0, 0.5, 0.14)|
    assert run_cli("measure", tmp_path, plate, ball, bottle, "--out", tmp_path / "lengths.csv") == 0
    with (tmp_path / "lengths.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["a"], row["b"], row["unit"]) for row in rows[:2]] == [
        (plate, ball, "metres"), (plate, bottle, "metres")
    ]  # fmt: skip
    assert [float(row["centers"]) for row in rows] == pytest.approx([0.06, 0.52, np.hypot(0.5, 0.08)], rel=0.05)
    scene = open_scene(tmp_path)
    assert scene.ask("the orange ball within 0.1 m of the white plate").count == 1
    assert scene.measure((1, 2, 3), (1, 2, 5))["centers"] == pytest.approx(2 * scene.field.metres_per_unit)
    assert run_cli("measure", tmp_path, "--scale", plate, plate, 1.0) == 2
    assert "Give two places" in capsys.readouterr().err


def test_a_length_is_that_of_the_thing_that_a_query_selects():
    """A cloth is nearly white: "white plate" names the plate, which matches best, for a query and for a length."""
    field, embedder = table_field((*THINGS, ("white cloth", (0.3, 0.6, 0.01), (0.1, 0.1, 0.01))), up=UP)
    rows = np.array(field.regions.embeddings)
    rows[6] = 0.7 * rows[3] + 0.3 * np.asarray(embedder.embed_text(["light yellow"]))[0]
    rows[6] /= np.linalg.norm(rows[6])
    regions = Regions(rows, field.regions.pixel_counts)
    scene = Scene(dataclasses.replace(field, regions=regions), embedder)
    assert scene.ask("white plate").count == 1
    assert scene.relate("white plate").count == 2
    assert scene.measure("white plate", "orange ball")["centers"] == pytest.approx(0.06, abs=0.01)
    with pytest.raises(InputError, match="names 2 objects"):  # two that match alike
        scene.measure("red mug", "orange ball")


def test_odd_input_has_an_error_of_its_own(scene):
    field, embedder = table_field()
    none = Regions(np.zeros((0, embedder.dim), np.float32), np.zeros((0, 1), np.int32))
    with pytest.raises(InputError, match="no regions"):
        Scene(dataclasses.replace(field, regions=none), embedder).ask("the leftmost red mug")
    answer = Scene(*table_field(THINGS[:1])).relate("the red mug left of the dark green bottle")
    assert "nothing to compare with" in answer.reason


def test_everything_on_a_thing_and_on_that_is_added():
    tray = ("purple tray", (0.0, -0.5, -0.01), (0.2, 0.2, 0.01))
    scene = Scene(*table_field((*THINGS, tray), up=UP))
    tray, plate, ball = (scene.ask(name).mask for name in ("purple tray", "white plate", "orange ball"))
    answer = scene.ask("the purple tray with everything on it")
    np.testing.assert_array_equal(answer.mask, tray | plate | ball)
    assert answer.count == 3
    assert "with everything on it" in answer.reading
    np.testing.assert_array_equal(scene.ask("the white plate and what is on it").mask, plate | ball)
    alone = scene.ask("the dark blue box with everything on it")
    np.testing.assert_array_equal(alone.mask, scene.ask("dark blue box").mask)
    with pytest.raises(InputError, match="names no object"):
        scene.ask("everything on it")
