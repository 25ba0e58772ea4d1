"""How the vision without weights is measured against true instances."""

import cv2
import numpy as np
import pytest

from experiments import default_vision
from jsecon.fit.depth import points_from_depth
from jsecon.fit.start import gaussians_from_points
from jsecon.types import Camera, Capture


@pytest.fixture
def flat_capture():
    """Two views, one beside the other, of a plane at 1 m; no depth in a corner of the first."""
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    poses[1, 1, 3] = 0.02
    lens = [np.full(2, number, np.float32) for number in (40, 40, 20, 20)]
    depths = np.ones((2, 40, 40), np.float32)
    depths[0, 36:, 36:] = 0
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    frames = np.zeros((2, 40, 40, 3), np.uint8)
    cameras = Camera(poses, *lens, width=40, height=40)
    return Capture(frames, cameras, *nothing, np.zeros(2, bool), depths, np.eye(4), ("a", "b"))


def test_masklets_are_scored_by_outline_and_by_how_long_an_id_lasts():
    truth = np.full((3, 10, 10), -1, np.int32)
    truth[:, :5, :4], truth[:, 5:, :] = 0, 1
    assert default_vision.score(truth, truth) == (1.0, 1.0)
    renamed = truth.copy()
    renamed[2][truth[2] == 0] = 7  # object 0: the id lasts in two of three views
    assert default_vision.score(renamed, truth) == (1.0, pytest.approx((2 / 3 + 1) / 2))
    half = truth.copy()
    half[:, 5:, 5:] = -1  # object 1: half of it, in every view
    assert default_vision.score(half, truth) == (pytest.approx(0.75), 1.0)
    assert default_vision.score(np.full_like(truth, -1), truth) == (0.0, 0.0)


def test_an_id_in_two_places_is_two_objects(flat_capture):
    ids = np.zeros((2, 40, 40), np.int16)
    ids[:, :, :10] = ids[:, :, 30:] = 1
    ids[0, 20, 12] = 1  # a speck: of the part next to it
    ids[1, 5, 5] = -1
    parts = default_vision.connected_parts(flat_capture, ids, voxel=0.1)
    assert len(np.unique(parts[parts >= 0])) == 3
    assert parts[1, 5, 5] == parts[0, 39, 39] == -1  # no id, no depth
    for t in range(2):
        left, middle, right = parts[t, 20, 3], parts[t, 20, 20], parts[t, 20, 35]
        np.testing.assert_array_equal(parts[t][2:35, :10][ids[t][2:35, :10] == 1], left)
        np.testing.assert_array_equal(parts[t][:, 13:30], middle)
        np.testing.assert_array_equal(parts[t][:30, 30:], right)
    assert parts[0, 20, 12] == parts[1, 20, 3]


def test_optical_flow_carries_an_id_along():
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (60, 120, 3)).astype(np.uint8), (0, 0), 1.5)
    frames = np.stack([wide[:, t : t + 80] for t in (0, 3, 6)])
    single = np.full((3, 60, 80), -1, np.int32)
    for t, left in enumerate((40, 37, 34)):
        single[t, 20:40, left : left + 20] = t
    labels = default_vision.by_flow(frames, single)
    assert [np.unique(labels[t][single[t] >= 0]).tolist() for t in range(3)] == [[0]] * 3
    away = single.copy()
    away[2] = np.where(np.roll(single[2], -30, axis=1) >= 0, 2, -1)  # somewhere else: another thing
    assert np.unique(default_vision.by_flow(frames, away)[2]).tolist() == [-1, 3]


@pytest.mark.long
def test_a_stopped_measurement_goes_on(flat_capture, tmp_path, monkeypatch, capsys):
    """The cells that are there are read; what is measured is two views of a plane, half of it another colour."""
    truth = np.zeros((2, 40, 40), np.int32)
    truth[:, :, 20:] = 1
    flat_capture.frames[..., 0] = np.where(truth, 250, 20)
    seen = []

    def scene(folder):
        seen.append(folder)
        points = points_from_depth(flat_capture, voxel=0.05)
        return flat_capture, gaussians_from_points(points.points, points.colors), {"objects": truth}

    monkeypatch.setattr(default_vision, "replica", scene)
    options = default_vision.Options(seeds=(), capture=str(tmp_path), out=str(tmp_path / "out"))
    found = default_vision.main(options)
    assert len(seen) == 2  # Algorithm 1 after the others
    for cell in found["replica_apartment_0"].values():
        assert cell["objects"]["best_iou"] > 0.8
    file = tmp_path / "out" / "cells.jsonl"
    file.write_text("".join(line for line in file.open() if default_vision.FLOW not in line))
    again = default_vision.main(options)
    assert len(seen) == 3
    assert {way: cell["objects"] for way, cell in again["replica_apartment_0"].items()} == {
        way: cell["objects"] for way, cell in found["replica_apartment_0"].items()
    }
    assert "replica_apartment_0" in (tmp_path / "out" / "table.md").read_text()
