"""Nearest neighbours: against a slow twin, with equal places and places that are no numbers."""

import numpy as np

from experiments.tables.neighbours import nearest_neighbours


def test_the_nearest_are_the_nearest_but_oneself():
    means = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    away = np.linalg.norm(means[:, None] - means[None], axis=-1) + 99 * np.eye(60)
    found = nearest_neighbours(means, count=7)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(np.sort(found, 1), np.sort(np.argsort(away, axis=1)[:, :7], 1))
