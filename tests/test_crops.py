"""Views of regions that are embedded: the choice and their number against loops, and what both go by."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.field.regions import choose_crops, crop_geometry, views_needed
from jsecon.types import Camera, Regions


def chosen_by_loops(pixels, cut, directions, most):
    chosen = []
    while len(chosen) < most:
        best, largest = None, 0.0
        for view in range(len(pixels)):
            cosines = [max(sum(a * b for a, b in zip(directions[view], directions[c])), 0.0) for c in chosen]
            gain = math.sqrt(pixels[view]) * (1 - cut[view] / 2) * (1 - max((c**8 for c in cosines), default=0.0) / 2)
            if view not in chosen and gain > largest:
                best, largest = view, gain
        if best is None:
            break
        chosen.append(best)
    return chosen


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_the_choice_equals_loops_and_grows_by_one_view_at_a_time(seed, most):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 900, (4, 6)) * (rng.random((4, 6)) < 0.7)
    cut, directions = rng.random((4, 6)), rng.normal((0, 0, 2), size=(4, 6, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found = choose_crops(pixels, cut, directions, most)
    for row, *region in zip(found, pixels, cut, directions):
        assert set(np.flatnonzero(row)) == set(chosen_by_loops(*region, most))
    assert (found <= choose_crops(pixels, cut, directions, most + 1)).all()
    np.testing.assert_array_equal(choose_crops(pixels, cut, directions, 6), pixels > 0)
    of_each = choose_crops(pixels, cut, directions, np.array([most, 0, 2, 6]))
    for row, most_of_one, *region in zip(of_each, (most, 0, 2, 6), pixels, cut, directions):
        assert set(np.flatnonzero(row)) == set(chosen_by_loops(*region, most_of_one))


def test_a_region_needs_as_many_views_as_its_views_scatter():
    rng = np.random.default_rng(0)
    places = np.array([(r, t) for r in (0, 1, 2, 4) for t in range(1 if r == 2 else 6)], np.int32)
    spread = np.array([0.01, 0.2, 0.3, 0, 0.05])[places[:, 0]]
    rows = np.eye(5, 40)[places[:, 0]] + spread[:, None] * rng.normal(size=(len(places), 40))
    regions = Regions(np.zeros((5, 40)), np.ones((5, 6), np.int32), places, rows)
    means = {r: rows[places[:, 0] == r].mean(0) for r in (0, 1, 2, 4)}
    apart = np.mean([np.sum((mean - np.mean(list(means.values()), axis=0)) ** 2) for mean in means.values()])
    variance = [np.var(rows[places[:, 0] == r], axis=0, ddof=1).sum() for r in (0, 1, 4)]
    needed = views_needed(regions, scatter=0.1)
    np.testing.assert_array_equal(needed[[0, 1, 4]], np.ceil(np.array(variance) / (0.1 * apart)))
    assert needed[0] == 1
    assert needed[1] > 6
    assert not needed[[2, 3]].any()  # one view, and none, say nothing of scatter
    alone = Regions(np.zeros((1, 40)), np.ones((1, 6)), places[:6], rows[:6])
    np.testing.assert_array_equal(views_needed(alone), [6])  # nothing to be told from


def test_geometry_of_regions_by_their_pixels():
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 4, (2, 6, 9)).astype(np.int16)
    labels[labels == 2] = -1
    labels[1][labels[1] == 3] = -1
    angle = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    focal = np.array([7.0, 8.0])
    cameras = Camera(np.stack([np.eye(4), pose]), focal, focal + 1, focal - 3, focal - 4, width=9, height=6)
    pixels, cut, directions = crop_geometry(labels, cameras, 4)
    for t, image in enumerate(labels):
        for r in range(4):
            places = [(i, j) for i in range(6) for j in range(9) if image[i, j] == r]
            assert pixels[r, t] == len(places)
            if not places:
                assert cut[r, t] == 0
                assert not directions[r, t].any()
                continue
            border = sum(i in (0, 5) or j in (0, 8) for i, j in places)
            assert cut[r, t] == pytest.approx(min(border / math.sqrt(len(places)), 1))
            v, u = np.mean(places, axis=0) + 0.5
            towards = cameras.world_to_camera[t][:3, :3] @ directions[r, t]
            expected = [(u - cameras.cx[t]) / cameras.fx[t], (v - cameras.cy[t]) / cameras.fy[t], 1.0]
            np.testing.assert_allclose(towards / towards[2], expected, atol=1e-6)
            assert np.linalg.norm(directions[r, t]) == pytest.approx(1)
    with pytest.raises(ValueError, match="labels"):
        crop_geometry(labels[:1], cameras, 4)
