"""The hand-drawn outlines: what covers what, at the size of the frames; and how an answer is judged by them."""

import json

import numpy as np
import pytest
from small_field import REGIONS, make_field

from experiments import bonsai_outlines
from jsecon.types import Camera, Capture
from jsecon.vision.colours import ColourEmbedder


@pytest.fixture
def capture():
    names = tuple(json.loads(bonsai_outlines.SILHOUETTE_WEIGHTS.read_text())["frames"])
    count = len(names)
    poses, ones = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1)), np.ones(count, np.float32)
    return seen_by(Camera(poses, ones, ones, ones, ones, 400, 266), names)


def seen_by(cameras, names):
    frames = np.zeros((len(names), cameras.height, cameras.width, 3), np.uint8)
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    return Capture(frames, cameras, *nothing, np.ones(len(names), bool), None, np.eye(4), names)


def test_outlines_do_not_overlap_and_are_many(capture):
    things = bonsai_outlines.outlines(capture)
    assert len([thing for thing, frames in things.items() if len(frames) >= 2]) >= 6
    for t in range(8):
        here = np.stack([frames[t] for frames in things.values() if t in frames])
        assert here.any((1, 2)).all()
        assert here.sum(0).max() == 1
    assert len(things["purple cloth"]) == 8
    assert min(mask.mean() for mask in things["purple cloth"].values()) > 0.1


def test_the_innermost_pixel_is_the_farthest_from_the_border():
    mask = np.zeros((20, 30), bool)
    mask[2:13, 4:15] = True
    mask[2:4, 15:28] = True
    assert bonsai_outlines.innermost(mask) == (9, 7)
    assert bonsai_outlines.innermost(np.ones((5, 9), bool))[1] == 2  # the frame's own edge is a border


def test_a_thing_is_asked_in_one_frame_and_judged_in_the_others(scene, cameras):
    field, labels = make_field(scene, cameras, dim=ColourEmbedder().dim)
    asked = bonsai_outlines.Asked(field, seen_by(field.cameras, field.names))
    for region in range(REGIONS):
        truth = {t: labels[t] == region for t in range(4) if (labels[t] == region).sum() > 60}
        found = bonsai_outlines.judge(asked, truth, "red mug")
        assert len(found["pixel"]) == len(truth) * (len(truth) - 1)
        assert len(found["name"]) == len(found["best region"]) == len(truth)
        asked_for = asked.under(0, truth[0])
        assert asked_for == region
        by_region = np.mean(asked.judged(asked.region(region), truth), axis=0)
        assert np.mean([row[0] for row in found["best region"]]) >= by_region[0]
        assert by_region[0] > 0.15
