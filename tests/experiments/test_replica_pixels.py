"""Things of a flat: which views show them, and where they are asked and judged."""

import dataclasses

import numpy as np
import pytest
from experiments.test_bonsai_outlines import seen_by
from small_field import REGIONS, make_field

from experiments import replica_pixels
from experiments.bonsai_outlines import Asked
from jsecon.vision.colours import ColourEmbedder


def test_a_thing_is_asked_where_it_is_largest_and_judged_in_other_views_held_out(scene, cameras):
    field, _ = make_field(scene, cameras, dim=ColourEmbedder().dim)
    capture = dataclasses.replace(seen_by(field.cameras, field.names), held_out=np.array([False, True, True, True]))
    instances = np.full((4, 40, 48), -1)
    instances[:, :10] = 0
    instances[2, :20] = 0  # most of it
    instances[1, 30:] = 1  # in one view alone
    instances[:, 25, :5] = 2  # less than 1 %
    found = replica_pixels.things(capture, instances, 8)
    assert list(found) == [0]
    assert list(found[0]) == [2, 1, 3]
    np.testing.assert_array_equal(found[0][2], instances[2] == 0)
    assert list(replica_pixels.things(capture, instances, 1)[0]) == [2, 1]


def test_the_pixel_finds_what_the_best_region_does(scene, cameras):
    field, labels = make_field(scene, cameras, dim=ColourEmbedder().dim)
    asked = Asked(field, seen_by(field.cameras, field.names))
    for region in range(REGIONS):
        truth = {t: labels[t] == region for t in range(4) if (labels[t] == region).sum() > 60}
        found = replica_pixels.judge(asked, truth)
        assert {len(rows) for rows in found.values()} == {len(truth) - 1}
        means = {way: np.mean([row[0] for row in rows]) for way, rows in found.items()}
        assert means["best region"] >= means["pixel"] > 0.1


def test_a_region_is_as_steady_as_single_masks_are_like_it():
    labels = np.full((3, 4, 4), -1)
    labels[0, :2], labels[1, :1], labels[2, 2:] = 5, 5, 6
    masks = [labels[t][None] == np.array([5, -1])[:, None, None] for t in range(3)]
    masks[1] = np.ones((1, 4, 4), bool)
    assert replica_pixels.steadiness(labels, 5, masks.__getitem__) == pytest.approx((1 + 0.25) / 2)
    assert replica_pixels.steadiness(labels, 7, masks.__getitem__) == 0
    cell = lambda steady, value: {"things": {"1": {"steady": steady, "pixel": value}}}
    cells = dict(enumerate((cell(0.2, "a"), cell(0.5, "b"), cell(0.4, "c"), cell(0.9, "d"))))
    assert replica_pixels.steadiest(cells)["1"]["pixel"] == "b"  # of the first three
