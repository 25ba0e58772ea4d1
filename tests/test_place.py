"""Where an answer is: boxes of known points, turned and shifted; and a text that nothing answers."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_field import make_field
from table_field import table_field

import jsecon
from jsecon import InputError, Selection
from jsecon.app.ask import Answer, ask_text, edit_answers
from jsecon.app.locate import locate_answer
from jsecon.app.server.scenes import Scene, SceneQuery

SIZE = np.array([0.5, 0.3, 0.1])


@pytest.fixture(scope="module")
def answer(scene, cameras):
    """A brick of 64 small Gaussians, turned, of which all are selected."""
    field, _ = make_field(scene, cameras)
    draw = np.random.default_rng(0)
    inside = draw.uniform(-0.5, 0.5, (64, 3))
    inside[:3] = np.eye(3) / 2  # a point on each face
    inside[32:] = -inside[:32]
    turn = Rotation.from_euler("zyx", [40, 25, 10], degrees=True)
    means = turn.apply(inside * SIZE) + np.array([1.0, 2.0, 3.0])
    gaussians = dataclasses.replace(
        field.gaussians, means=means.astype(np.float32), log_scales=np.full((64, 3), np.log(1e-3), np.float32)
    )
    every, share = np.ones(64, bool), np.ones(64, np.float32)
    selection = Selection(every, share, np.int32(0), np.float32(0.7))
    return dataclasses.replace(field, gaussians=gaussians), Answer("brick", "votes", selection, every, {}), turn, means


def test_the_oriented_box_is_that_of_the_brick(answer):
    field, asked, turn, means = answer
    place = locate_answer(field, asked)
    np.testing.assert_allclose(place.centroid, [1, 2, 3], atol=0.02)
    np.testing.assert_allclose(place.extent, SIZE, rtol=0.25)
    np.testing.assert_allclose(place.axes.T @ place.axes, np.eye(3), atol=1e-6)
    assert np.linalg.det(place.axes) == pytest.approx(1)
    assert np.abs(np.diagonal(place.axes.T @ turn.as_matrix())).min() > 0.9
    assert (place.low >= means.min(0) - 0.01).all()
    assert (place.high <= means.max(0) + 0.01).all()
    assert len(place.points) == 64
    told = place.as_dict()
    assert told["points"] == 64
    assert told["frame"] == "the capture's world"
    assert told["extent"] == pytest.approx(list(place.extent), abs=1e-5)


def test_it_is_in_the_world_of_the_capture(answer):
    field, asked, *_ = answer
    here = locate_answer(field, asked)
    source_from_scene = np.diag([2.0, 2.0, 2.0, 1.0])
    source_from_scene[:3, 3] = [5, 0, 0]
    there = locate_answer(dataclasses.replace(field, source_from_scene=source_from_scene), asked)
    np.testing.assert_allclose(there.centroid, 2 * here.centroid + [5, 0, 0], rtol=1e-4)
    np.testing.assert_allclose(there.extent, 2 * here.extent, rtol=1e-3)


def test_what_selects_nothing_has_no_place(answer):
    field, asked, *_ = answer
    with pytest.raises(InputError, match="no Gaussian is selected"):
        locate_answer(field, dataclasses.replace(asked, mask=np.zeros(64, bool)))


def test_two_objects_of_a_name_are_counted_and_have_no_place_together():
    field, embedder = table_field()
    mugs, box = (ask_text(field, embedder, text) for text in ("red mug", "dark blue box"))
    assert (mugs.objects, box.objects) == (2, 1)
    assert edit_answers(field, [mugs], invert=True)[0].objects == 1
    assert Scene("table", field, embedder).record(SceneQuery("red mug"))["objects"] == 2
    with pytest.raises(InputError, match="names 2 objects"):
        jsecon.locate(field, "red mug", embedder)
    left = jsecon.locate(field, "the leftmost red mug", embedder)
    np.testing.assert_allclose(left.center[:2], [-0.5, 0], atol=0.02)
    with pytest.raises(ValueError, match="no options"):
        jsecon.locate(field, "the leftmost red mug", embedder, by="code")
    with pytest.raises(InputError, match="names 0 objects"):
        jsecon.locate(field, "the red mug on the dark blue box", embedder)
    place = jsecon.locate(field, "dark blue box", embedder)
    np.testing.assert_allclose(place.center, locate_answer(field, box).center)
