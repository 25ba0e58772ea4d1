"""Where an answer is: boxes of known points, turned and shifted; and a text that nothing answers."""

import dataclasses

import numpy as np
import pytest
from conftest import gaussians_at
from scipy.spatial.transform import Rotation
from small_field import answer_of
from table_field import table_field
from test_object_shapes import SIZE, brick

import jsecon
from jsecon import InputError, Scene


@pytest.fixture(scope="module")
def answer(field):
    """A brick of 64 small Gaussians, turned, of which all are selected."""
    turn = Rotation.from_euler("zyx", [40, 25, 10], degrees=True)
    means = brick(turn, np.array([1.0, 2.0, 3.0]), 64)[:64]
    field = dataclasses.replace(field, gaussians=gaussians_at(means, 1e-3))
    return answer_of(field, "brick", np.ones(64)), turn, means


def test_the_oriented_box_is_that_of_the_brick(answer):
    asked, turn, means = answer
    place = asked.place
    np.testing.assert_allclose(asked.points.mean(0), means.mean(0), atol=0.02)
    np.testing.assert_allclose(2 * place.half_size, SIZE, rtol=0.25)
    np.testing.assert_allclose(place.axes.T @ place.axes, np.eye(3), atol=1e-6)
    assert np.linalg.det(place.axes) == pytest.approx(1)
    assert np.abs(np.diagonal(place.axes.T @ turn.as_matrix())).min() > 0.9
    assert (place.low >= means.min(0) - 0.01).all()
    assert (place.high <= means.max(0) + 0.01).all()
    assert asked.as_dict()["place"]["extent"] == pytest.approx(list(2 * place.half_size), abs=1e-5)


def test_two_objects_of_a_name_are_counted_and_have_no_place_together():
    scene = Scene(*table_field())
    assert scene.ask("red mug").as_dict()["objects"] == 2
    left = scene.locate("the leftmost red mug")
    same = jsecon.locate(scene.field, "the leftmost red mug", scene.embedder)
    np.testing.assert_array_equal(same.center, left.place.center)
    np.testing.assert_allclose(left.place.center[:2], [-0.5, 0], atol=0.02)
    nothing = scene.ask("the red mug on the dark blue box")
    assert nothing.as_dict()["place"] is None
    with pytest.raises(InputError, match=r"red mug.*dark blue box"):
        _ = nothing.place
