"""Truth on real captures: connected parts of instance ids, and outlines drawn by hand."""

import dataclasses
import json

import numpy as np
from conftest import cameras_of, capture_of

from experiments.datasets import bonsai_outlines, named_objects


def test_an_id_in_two_places_is_two_objects():
    """Two views, one beside the other, of a plane at 1 m; no depth in a corner of the first."""
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    poses[1, 1, 3] = 0.02
    depths = np.ones((2, 40, 40), np.float32)
    depths[0, 36:, 36:] = 0
    cameras = cameras_of(poses, (40, 40, 20, 20), 40, 40)
    flat_capture = capture_of(np.zeros((2, 40, 40, 3)), cameras, np.ones(2, bool), depths)
    ids = np.zeros((2, 40, 40), np.int16)
    ids[:, :, :10] = ids[:, :, 30:] = 1
    ids[0, 20, 12] = 1  # a speck: of the part next to it
    ids[1, 5, 5] = -1
    parts = named_objects.connected_parts(flat_capture, ids, voxel=0.1)
    assert len(np.unique(parts[parts >= 0])) == 3
    assert parts[1, 5, 5] == parts[0, 39, 39] == -1  # no id, no depth
    for t in range(2):
        left, middle, right = parts[t, 20, 3], parts[t, 20, 20], parts[t, 20, 35]
        np.testing.assert_array_equal(parts[t][2:35, :10][ids[t][2:35, :10] == 1], left)
        np.testing.assert_array_equal(parts[t][:, 13:30], middle)
        np.testing.assert_array_equal(parts[t][:30, 30:], right)
    assert parts[0, 20, 12] == parts[1, 20, 3]


def test_outlines_do_not_overlap_and_are_many():
    names = tuple(json.loads(bonsai_outlines.OUTLINES.read_text())["frames"])
    cameras, count = cameras_of([np.eye(4)] * len(names), (1, 1, 1, 1), 400, 266), len(names)
    capture = capture_of(np.zeros((count, 266, 400, 3)), cameras, np.ones(count, bool))
    things = bonsai_outlines.outlines(dataclasses.replace(capture, names=names))
    assert len([thing for thing, frames in things.items() if len(frames) >= 2]) >= 6
    for t in range(8):
        here = np.stack([frames[t] for frames in things.values() if t in frames])
        assert here.any((1, 2)).all()
        assert here.sum(0).max() == 1
    assert len(things["purple cloth"]) == 8
    assert min(mask.mean() for mask in things["purple cloth"].values()) > 0.1
