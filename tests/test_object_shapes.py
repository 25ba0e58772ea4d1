"""Boxes and points of objects: known bricks, turned and shifted far away, with strays."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jsecon import object_shapes

SIZE = np.array([0.5, 0.3, 0.2])


def brick(turn, shift, count=4000):
    """Points in a brick, and two strays far above it."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * SIZE
    return turn.apply(np.concatenate([points, [[0, 0, 9.0], [0, 0, 9.1]]])) + shift


@pytest.mark.parametrize("shift", [0.0, 5e6])
def test_an_upright_box_is_that_of_a_brick_that_was_turned_about_the_up_axis(shift):
    turn = Rotation.from_euler("z", 40, degrees=True)
    means = np.concatenate([brick(turn, shift), brick(turn, shift + 2.0), np.full((5, 3), np.nan)])
    labels = np.concatenate([np.zeros(4002, int), np.ones(4002, int), np.full(5, -1)])
    shapes = object_shapes(means, labels, np.array([0, 0, 2.0]))
    assert len(shapes) == 2
    assert shapes.count.tolist() == [4002, 4002]
    np.testing.assert_allclose(shapes.center - shift, [[0, 0, 0], [2, 2, 2]], atol=0.02)
    np.testing.assert_allclose(2 * shapes.half_size, [SIZE, SIZE], rtol=0.08)
    np.testing.assert_allclose(shapes.axes[:, :, 2], [[0, 0, 1]] * 2)
    assert np.abs(shapes.axes[:, :, 0] @ turn.apply([1, 0, 0])).min() > 0.99
    np.testing.assert_allclose(np.linalg.det(shapes.axes), 1)


def test_without_an_up_axis_the_box_follows_the_points():
    turn = Rotation.from_euler("zyx", [40, 25, 10], degrees=True)
    shapes = object_shapes(brick(turn, 0.0)[:-2], np.zeros(4000, int))
    np.testing.assert_allclose(2 * shapes.half_size[0], SIZE, rtol=0.08)
    assert np.abs(np.diagonal(shapes.axes[0].T @ turn.as_matrix())).min() > 0.99


def test_spreads_make_boxes_larger_and_few_points_are_repeated():
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    spreads = np.broadcast_to(0.1 * np.eye(3), (2, 3, 3))
    shapes = object_shapes(points, np.zeros(2, int), np.array([0, 0, 1.0]), spreads=spreads)
    np.testing.assert_allclose(shapes.half_size[0], [0.6, 0.1, 0.1], atol=0.02)
    assert shapes.points.shape == (1, 256, 3)
    assert {tuple(point) for point in shapes.points[0]} == {(0, 0, 0), (1, 0, 0)}
    with pytest.raises(ValueError, match="no Gaussian"):
        object_shapes(points, np.array([0, 2]))
