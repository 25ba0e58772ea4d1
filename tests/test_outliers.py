"""DBSCAN with scikit-learn's labels, and the outliers it removes from a selection."""

import time

import numpy as np
import pytest

from jsecon.query import outliers
from jsecon.query.outliers import remove_outliers, split_outliers


def test_one_component_is_seen_where_points_are_dense(monkeypatch):
    monkeypatch.setattr(outliers, "_default_eps", lambda points: 0.33)
    sphere = np.random.default_rng(0).normal(size=(4_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    strayed = np.append(sphere, [[1.5, 0, 0]], 0)
    for points, clusters, kept in ((sphere, 1, 4_000), (strayed, 1, 4_000), (sphere[:20], 0, 20)):
        mask, number = split_outliers(points, np.ones(len(points), bool))
        assert (number, mask.sum()) == (clusters, kept)


def two_blobs_and_strays(scale=1.0):
    rng = np.random.default_rng(0)
    blob = rng.normal(size=(300, 3)) * 0.1
    small = rng.normal(size=(100, 3)) * 0.1 + 4
    strays = rng.uniform(8, 30, (6, 3))
    return (scale * np.concatenate([blob, small, strays])).astype(np.float32)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_strays_go_and_eps_follows_the_scale(scale):
    points = two_blobs_and_strays(scale)
    everything = np.ones(len(points), bool)
    every = remove_outliers(points, everything, keep="all")
    assert every[:400].mean() > 0.97
    assert not every[400:].any()
    largest = remove_outliers(points, everything, keep="largest")
    np.testing.assert_array_equal(largest, every & (np.arange(len(points)) < 300))
    np.testing.assert_array_equal(remove_outliers(points, everything), every)  # a third of the largest has support
    weight = np.where(np.arange(len(points)) < 300, 1.0, 0.01)
    np.testing.assert_array_equal(remove_outliers(points, everything, weight=weight), largest)


def test_only_finite_centres_that_were_selected_are_looked_at():
    points = two_blobs_and_strays()
    points[303], points[304, 1] = np.nan, np.inf
    mask = np.arange(len(points)) >= 300
    mask[:150] = False
    kept = remove_outliers(points, mask)
    assert not kept[~mask].any()
    assert not kept[[303, 304]].any()
    assert kept[300:400].mean() > 0.93


@pytest.mark.parametrize("count", [0, 1, 5, 9])
def test_what_dbscan_cannot_tell_comes_back_as_it_is(count, monkeypatch):
    points = np.random.default_rng(0).normal(size=(40, 3)) * 100
    mask = np.arange(40) < count
    np.testing.assert_array_equal(remove_outliers(points, mask), mask)
    with monkeypatch.context() as patch:
        patch.setattr(outliers, "_default_eps", lambda points: 1e-3)
        assert remove_outliers(points, np.ones(40, bool)).all()  # no cluster
    turn = np.linspace(0, 6, 2_000)
    ring = np.stack([np.cos(turn), np.sin(turn), 0.1 * turn], axis=1)
    assert remove_outliers(ring, np.ones(2_000, bool)).all()  # one component
    same = np.concatenate([np.zeros((50, 3)), points[:20]])  # points on top of each other
    assert remove_outliers(same[:50], np.ones(50, bool)).all()
    assert remove_outliers(same, np.ones(70, bool))[:50].all()


@pytest.mark.long
def test_half_a_million_points_in_seconds():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[:200_000] = 0.3 * points[:200_000] + [3, 0, 0]
    points[200_000:250_000] = 0.02 * points[200_000:250_000] - [3, 0, 0]  # thousands of neighbours each
    points[:2_000] = rng.uniform(-30, 30, (2_000, 3))
    start = time.process_time()
    kept = remove_outliers(points, np.ones(500_000, bool), keep="largest")
    assert time.process_time() - start < 15  # about 2 s; scikit-learn runs out of memory on the dense ball's lists
    assert kept[250_000:].all()
    assert not kept[:250_000].any()


def test_options_out_of_range_are_told():
    points, mask = np.zeros((20, 3)), np.ones(20, bool)
    with pytest.raises(ValueError, match="remove_outliers"):
        remove_outliers(points, mask, keep="some")
