"""Where an answer is, and a text that nothing answers; test_object_shapes.py has the boxes of known points."""

import numpy as np
import pytest
from table_field import table_field

import jsecon
from jsecon import InputError, Scene


def test_two_objects_of_a_name_are_counted_and_have_no_place_together():
    scene = Scene(*table_field())
    assert scene.ask("red mug").as_dict()["objects"] == 2
    left = scene.locate("the leftmost red mug")
    same = jsecon.locate(scene.field, "the leftmost red mug", scene.embedder)
    np.testing.assert_array_equal(same.center, left.place.center)
    np.testing.assert_allclose(left.place.center[:2], [-0.5, 0], atol=0.02)
    np.testing.assert_allclose(2 * left.place.half_size, 0.1, rtol=0.25)
    assert left.as_dict()["place"]["extent"] == pytest.approx(list(2 * left.place.half_size), abs=1e-5)
    nothing = scene.ask("the red mug on the dark blue box")
    assert nothing.as_dict()["place"] is None
    with pytest.raises(InputError, match=r"red mug.*dark blue box"):
        _ = nothing.place
