import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.association.consensus import clean_tracks
from jsecon.paper.algorithm1 import masklets


def squares(frames=5, size=40, *, step=3):
    """A moving 12x12 square (object 0), a still one (object 1), and everything else (object 2), as true labels."""
    truth = np.full((frames, size, size), 2, np.int16)
    for t in range(frames):
        truth[t, 24:36, 6:18] = 1
        truth[t, 4:16, 4 + step * t : 16 + step * t] = 0
    return truth


def frames_of(truth):
    return np.zeros((*truth.shape, 3), np.uint8)


def segmenter(truth, order=None):
    """Proposes the true objects, in a given order."""

    def segment(frame, index):
        ids = np.unique(truth[index])
        return truth[index][None] == (ids if order is None else order(ids))[:, None, None]

    return segment


def tracker(truth):
    """Follows a prompt to the true object under most of it; counts its calls."""
    calls = []

    def track(frames, index, prompts):
        calls.append((index, len(prompts)))
        labels = np.full(truth.shape, -1, np.int16)
        for b, prompt in enumerate(prompts):
            labels[truth == np.bincount(truth[index][prompt]).argmax()] = b
        return labels

    track.calls = calls
    return track


def track_still(frames, index, prompts):
    """Nothing moves: a prompt is the mask of every frame."""
    labels = np.full(frames.shape[:3], -1, np.int16)
    for b, prompt in enumerate(prompts):
        labels[:, prompt] = b
    return labels


def canonical(labels):
    """Labels renumbered by first appearance, so that partitions can be compared."""
    ids, first = np.unique(labels, return_index=True)
    name = {i: n for n, i in enumerate(ids[np.argsort(first)])}
    return np.vectorize(name.get)(labels)


@pytest.mark.parametrize("enters_late", [False, True])
def test_finds_each_object_once_where_it_enters_and_progress_counts_frames(enters_late):
    truth, told = squares(), []
    if enters_late:
        truth[3:, 30:38, 30:38] = 3
    track = tracker(truth)
    order = np.random.default_rng(0).permutation  # of proposals: it only renames
    labels = masklets(frames_of(truth), segmenter(truth, order), track, progress=lambda *count: told.append(count))
    np.testing.assert_array_equal(canonical(labels), canonical(truth))
    expected = [(0, 3), (3, 1)] if enters_late else [(0, 3)]
    assert track.calls[: len(expected)] == expected
    assert enters_late or len(track.calls) == 1  # what is tracked is not prompted again
    assert told == [(t, 5) for t in range(1, 6)]
    assert masklets(frames_of(truth), segmenter(truth), track, max_masklets=2).max() == 1


def test_the_iou_threshold_decides_what_is_new():
    truth = squares(frames=3, step=0)
    shifted = np.roll(truth, 3, axis=2)  # IoU of the squares with themselves: 9 / 15 = 0.6

    def segment(frame, index):
        return (truth if index == 0 else shifted)[index][None] == np.arange(2)[:, None, None]

    for threshold, calls in ((0.5, [(0, 2)]), (0.59, [(0, 2)]), (0.61, [(0, 2), (1, 2), (2, 2)])):
        track = tracker(truth)
        masklets(frames_of(truth), segment, track, iou_threshold=threshold)
        assert track.calls == calls


@pytest.mark.parametrize(("in_halves", "regions"), [({2}, 3), ({0, 1}, 3), (set(range(6)), 4)])
def test_halves_are_joined_unless_most_frames_have_them(in_halves, regions):
    truth = squares(frames=6, step=0)
    square = truth == 1
    half = square.copy()
    half[:, :, 12:] = False

    def segment(frame, index):
        parts = [half[index], square[index] & ~half[index]] if index in in_halves else [square[index]]
        return np.stack([truth[index] == 0, truth[index] == 2, *parts])

    labels = masklets(frames_of(truth), segment, track_still)
    assert len(np.unique(labels[labels >= 0])) == regions
    np.testing.assert_array_equal(labels[2] == labels[2, 30, 8], (square if regions == 3 else half)[2])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int16, np.int64])
def test_labels_of_any_integer_type_are_taken(kind):
    truth = squares()
    plain = masklets(frames_of(truth), segmenter(truth), tracker(truth))
    track = tracker(truth)
    largest = np.iinfo(kind).max if kind in (np.uint8, np.uint16) else -1  # an unsigned image has no -1

    def unsigned(frames, index, prompts):
        labels = track(frames, index, prompts)
        return np.where(labels < 0, largest, labels).astype(kind)

    np.testing.assert_array_equal(masklets(frames_of(truth), segmenter(truth), unsigned), plain)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_clean_tracks(seed):
    rng = np.random.default_rng(seed)
    labels = rng.choice([-1, -1, 0, 1, 2, 5], (4, 6, 6), p=[0.2, 0.2, 0.3, 0.2, 0.08, 0.02]).astype(np.int16)
    clean, number = clean_tracks(labels, 6)
    np.testing.assert_array_equal(clean_tracks(clean, 6)[0], clean)
    np.testing.assert_array_equal(np.append(number, -1)[labels][clean >= 0], clean[clean >= 0])
    ids = np.unique(clean[clean >= 0])
    np.testing.assert_array_equal(ids, np.arange(len(ids)))  # numbered without gaps, in order of appearance
    assert list(np.argsort([np.flatnonzero((clean == i).any((1, 2)))[0] for i in ids], kind="stable")) == list(ids)
    for old in (0, 1, 2, 5):
        areas = (labels == old).sum((1, 2))
        enough = areas >= 1
        new = clean[labels == old]
        assert (new >= 0).sum() == (areas[enough].sum() if enough.sum() >= 2 else 0)
        assert len(np.unique(new[new >= 0])) <= 1


def test_bad_shapes_are_refused():
    truth = squares()
    good = {"frames": frames_of(truth), "segment": segmenter(truth), "track": tracker(truth)}
    for match, wrong in (
        ("frames", {"frames": frames_of(truth)[0]}),
        ("segment", {"segment": lambda frame, index: np.ones((1, 3, 3), bool)}),
        ("track", {"track": lambda frames, index, prompts: np.zeros((1, 40, 40), np.int16)}),
    ):
        with pytest.raises(ValueError, match=match):
            masklets(**(good | wrong))
