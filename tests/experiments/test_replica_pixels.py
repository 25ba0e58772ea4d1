"""Things of a flat: which views show them, and where they are asked and judged."""

import dataclasses

import numpy as np
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
