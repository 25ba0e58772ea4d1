"""Nearest neighbours: against a slow twin, with equal places and places that are no numbers."""

import numpy as np
import pytest

from experiments.tables.neighbours import nearest_neighbours


def test_the_nearest_are_the_nearest_but_oneself():
    means = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    away = np.linalg.norm(means[:, None] - means[None], axis=-1) + 99 * np.eye(60)
    found = nearest_neighbours(means, count=7)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(np.sort(found, 1), np.sort(np.argsort(away, axis=1)[:, :7], 1))


def test_many_in_one_place_and_places_that_are_no_numbers():
    means = np.zeros((40, 3), np.float32)
    means[30:] = np.arange(30)[:, None].repeat(3, 1).reshape(10, 9)[:, :3]
    means[5], means[6, 1] = np.nan, np.inf
    found = nearest_neighbours(means, count=4)
    assert (found != np.arange(40)[:, None])[np.isfinite(means).all(1)].all()
    assert not np.isin(found, (5, 6))[np.isfinite(means).all(1)].any()
    np.testing.assert_array_equal(found[5], 5)
    for few in (0, 1, 2, 3):
        assert nearest_neighbours(means[:few], count=4).shape == (few, max(min(4, few - 1), 1))
    with pytest.raises(ValueError, match="at least 1"):
        nearest_neighbours(means, count=0)
