import numpy as np
import pytest
from balls import HEIGHT, WIDTH, ious
from test_consensus import few_superpixels as few_superpixels, world as world  # fixtures

from jsecon.association import frame_superpixels as association
from jsecon.association.frame_superpixels import superpixels
from jsecon.paper.tracker import GeometricTracker


@pytest.fixture(scope="module")
def tracker(world):
    gaussians, cameras, _, _, proposals = world
    return GeometricTracker(gaussians, cameras, proposals)


def prompts_at(truth, t):
    return truth[t][None] == np.arange(1, 4)[:, None, None]


def test_follows_each_ball_around_the_ring(world, tracker):
    (_, _, frames, truth, _), start = world, 10
    labels = tracker(frames, start, prompts_at(truth, start))
    np.testing.assert_array_equal(labels[start], truth[start] - 1)
    assert np.nanmin(ious(labels, truth, 3)) > 0.9
    order = np.asarray([2, 0, 1])  # of the prompts: it only renames
    turned = tracker(frames, start, prompts_at(truth, start)[order])
    np.testing.assert_array_equal(np.append(order, -1)[turned], labels)
    for none in (np.zeros((0, HEIGHT, WIDTH), bool), np.zeros((1, HEIGHT, WIDTH), bool)):
        assert (tracker(frames, start, none) == -1).all()


def test_where_a_frame_proposes_nothing_or_a_merger_the_gaussians_find_the_ball(world, monkeypatch):
    gaussians, cameras, frames, truth, proposals = world
    worse = list(proposals)
    worse[13] = np.zeros((0, HEIGHT, WIDTH), bool)
    worse[14] = (truth[14] >= 0)[None]  # everything is one region
    monkeypatch.setattr(association, "SUPERPIXELS_PER_FRAME", 300)
    tracker = GeometricTracker(gaussians, cameras, lambda t: worse[t])
    scores = ious(tracker(frames, 12, prompts_at(truth, 12)), truth, 3)
    assert np.nanmin(scores[[13, 14]]) > 0.5
    assert np.nanmean(np.delete(scores, [13, 14], axis=0)) > 0.9  # and the track goes on behind them


def test_bad_arguments_are_refused(world, tracker):
    _, _, frames, truth, _ = world
    with pytest.raises(ValueError, match="prompts"):
        tracker(frames, 0, prompts_at(truth, 0)[:, 1:])


@pytest.mark.parametrize("count", [1, 20, 200])
def test_superpixels_cover_the_frame_and_respect_the_masks(count):
    rng = np.random.default_rng(count)
    frame = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    masks = np.zeros((2, 60, 80), bool)
    masks[0, 10:40, 10:50] = True
    masks[1, 20:50, 30:70] = True
    labels = superpixels(frame, masks, count=count)
    areas = np.bincount(labels.ravel())
    assert (areas >= 12).all()
    for mask in masks:  # a superpixel lies in or out of a mask, but for the slivers that it took in
        inside = np.bincount(labels[mask], minlength=len(areas)) / areas
        assert np.mean((inside < 0.05) | (inside > 0.95)) > 0.5
        assert inside.max() > 0.95
    assert superpixels(frame, masks[:0], count=count).shape == (60, 80)
