import numpy as np
import pytest
from balls import HEIGHT, WIDTH, ious, ring_of_balls
from conftest import look_at
from mask_overlaps import iou_matrix

from jsecon.association.consensus import clean_tracks
from jsecon.association.scene import superpixels
from jsecon.paper.algorithm1 import masklets
from jsecon.paper.tracker import GeometricTracker
from jsecon.types import Camera
from jsecon.vision.protocols import Tracker


@pytest.fixture(scope="module")
def world():
    return ring_of_balls()


@pytest.fixture(scope="module")
def tracker(world):
    gaussians, cameras, _, _, proposals = world
    return GeometricTracker(gaussians, cameras, proposals, superpixels_per_frame=60)


def prompts_at(truth, t):
    return truth[t][None] == np.arange(1, 4)[:, None, None]


@pytest.mark.parametrize("start", [10, 12])
def test_follows_each_ball_around_the_ring(world, tracker, start):
    _, _, frames, truth, _ = world
    assert isinstance(tracker, Tracker)
    labels = tracker(frames, start, prompts_at(truth, start))
    assert labels.shape == truth.shape
    assert labels.dtype == np.int16
    np.testing.assert_array_equal(labels[start], truth[start] - 1)
    assert np.nanmin(ious(labels, truth, 3)) > 0.9


def test_order_of_prompts_only_renames(world, tracker):
    _, _, frames, truth, _ = world
    prompts = prompts_at(truth, 12)
    order = np.asarray([2, 0, 1])
    plain, turned = tracker(frames, 12, prompts), tracker(frames, 12, prompts[order])
    np.testing.assert_array_equal(np.append(order, -1)[turned], plain)


def test_each_prompt_alone_and_no_prompt(world, tracker):
    _, _, frames, truth, _ = world
    for b in range(3):
        labels = tracker(frames, 12, prompts_at(truth, 12)[b : b + 1])
        alone = ious(np.where(labels == 0, b, -1), truth, 3)[:, b]
        assert np.nanmin(alone) > 0.9
    assert (tracker(frames, 1, np.zeros((0, HEIGHT, WIDTH), bool)) == -1).all()
    assert (tracker(frames, 1, np.zeros((1, HEIGHT, WIDTH), bool)) == -1).all()


def test_prompts_that_overlap_go_to_the_first(world, tracker):
    _, _, frames, truth, _ = world
    ball = truth[0] == 1
    labels = tracker(frames, 0, np.stack([ball, ball | (truth[0] == 2)]))
    np.testing.assert_array_equal(labels[0], np.where(ball, 0, np.where(truth[0] == 2, 1, -1)))


def test_where_a_frame_proposes_nothing_or_a_merger_the_gaussians_find_the_ball(world):
    gaussians, cameras, frames, truth, proposals = world
    worse = list(proposals)
    worse[13] = np.zeros((0, HEIGHT, WIDTH), bool)
    worse[14] = (truth[14] >= 0)[None]  # everything is one region
    tracker = GeometricTracker(gaussians, cameras, lambda t: worse[t], superpixels_per_frame=300)
    scores = ious(tracker(frames, 12, prompts_at(truth, 12)), truth, 3)
    assert np.nanmin(scores[[13, 14]]) > 0.5
    assert np.nanmean(np.delete(scores, [13, 14], axis=0)) > 0.9  # and the track goes on behind them


def test_a_frame_that_looks_away_stays_empty(world):
    gaussians, cameras, frames, truth, proposals = world
    poses = np.array(cameras.world_to_camera)
    poses[4] = look_at((0.0, -1.0, -2.2), (0.0, -1.0, -9.0))
    away = Camera(poses, cameras.fx, cameras.fy, cameras.cx, cameras.cy, width=WIDTH, height=HEIGHT)
    tracker = GeometricTracker(gaussians, away, proposals, superpixels_per_frame=60)
    labels = tracker(frames, 12, prompts_at(truth, 12))
    assert (labels[4] == -1).all()
    assert np.nanmin(np.delete(ious(labels, truth, 3), 4, axis=0)) > 0.85


def test_masklets_over_the_tracker_find_the_three_balls_and_the_floor(world, tracker):
    _, _, frames, truth, proposals = world
    labels = masklets(frames, lambda frame, t: proposals[t], tracker)
    settled = tracker.consistent(frames, labels)
    np.testing.assert_array_equal(tracker.consistent(frames, settled), settled)
    assert settled.max() == 3
    for label in range(4):
        best = max(iou_matrix((truth == label).reshape(1, -1), (settled == r).reshape(1, -1))[0, 0] for r in range(4))
        assert best > 0.9


def test_consistent_gives_a_rare_part_to_its_owner_and_keeps_the_rest(world, tracker):
    _, _, frames, truth, _ = world
    labels = truth.copy()
    labels[3][(truth[3] == 1) & (np.arange(WIDTH) < WIDTH // 2)] = 4  # half a ball, in one frame only
    settled = tracker.consistent(frames, labels)
    np.testing.assert_array_equal(settled, truth)
    np.testing.assert_array_equal(tracker.consistent(frames, truth), truth)
    assert clean_tracks(settled).max() == 3
    unsigned = labels.astype(np.uint8)
    np.testing.assert_array_equal(tracker.consistent(frames, unsigned), tracker.consistent(frames, labels * 1))
    nothing = np.full_like(truth, -1)
    np.testing.assert_array_equal(tracker.consistent(frames, nothing), nothing)


def test_bad_arguments_are_refused(world, tracker):
    gaussians, cameras, frames, truth, proposals = world
    with pytest.raises(ValueError, match="prompts"):
        tracker(frames, 0, prompts_at(truth, 0)[:, 1:])
    with pytest.raises(ValueError, match="superpixels_per_frame"):
        GeometricTracker(gaussians, cameras, proposals, superpixels_per_frame=0)


@pytest.mark.parametrize("count", [1, 20, 200])
def test_atoms_cover_the_frame_and_respect_the_masks(count):
    rng = np.random.default_rng(count)
    frame = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    masks = np.zeros((2, 60, 80), bool)
    masks[0, 10:40, 10:50] = True
    masks[1, 20:50, 30:70] = True
    atoms = superpixels(frame, masks, count=count)
    areas = np.bincount(atoms.ravel())
    assert (areas >= 12).all()
    for mask in masks:  # an atom lies in or out of a mask, but for the slivers that it took in
        inside = np.bincount(atoms[mask], minlength=len(areas)) / areas
        assert np.mean((inside < 0.05) | (inside > 0.95)) > 0.5
        assert inside.max() > 0.95
    assert superpixels(frame, masks[:0], count=count).shape == (60, 80)
