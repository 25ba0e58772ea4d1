"""Simulated vision: each fault does what its number says, at the rate it says, and nothing else."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from experiments.simulated_vision.embeddings import PAIRWISE_COSINE, SimulatedEmbedder, load_text_space, made_text_space
from experiments.simulated_vision.masks import LEVELS, Faults, simulated_masks
from jsecon.vision.protocols import Embedder

NONE = Faults(split=0, merge=0, miss=0, jitter_px=0, lose=0, swap=0, object_noise=0, view_noise=0)
CLASSES = ("cup", "dog", "hat", "jar", "key", "map")


def boxes(frames=12, objects=6):
    """Objects of 8x10 px side by side, two of them touching: (T, 24, 84)."""
    labels = np.full((frames, 24, 84), -1, np.int16)
    for k in range(objects):
        left = 4 + 13 * k - (3 if k == 1 else 0)
        labels[:, 6:16, left : left + 10] = k
    return labels


def only(**faults):
    return dataclasses.replace(NONE, **faults)


@pytest.fixture(scope="module")
def space():
    return made_text_space([*CLASSES, *(f"word {i}" for i in range(300))], dim=256)


@pytest.fixture(scope="module")
def frames():
    return np.random.default_rng(0).integers(0, 256, (12, 24, 84, 3)).astype(np.uint8)


def test_without_faults_the_masks_are_the_truth_and_of_nothing_nothing():
    labels = boxes()
    found = simulated_masks(labels, NONE)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_array_equal(found.origin, np.arange(6))
    nothing = np.full((3, 8, 8), -1, np.int16)
    found = simulated_masks(nothing, LEVELS["high"])
    np.testing.assert_array_equal(found.labels, nothing)
    assert len(found.origin) == 0
    for wrong, named in ((only(split=1.5), r"Faults\.split"), (only(parts=1), "parts")):
        with pytest.raises(ValueError, match=named):
            simulated_masks(labels, wrong)


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(sorted(LEVELS)), st.integers(0, 1000))
def test_same_seed_same_masks_and_origin_is_the_majority(level, seed):
    labels = boxes()
    found, again = (simulated_masks(labels, LEVELS[level], seed=seed) for _ in range(2))
    np.testing.assert_array_equal(found.labels, again.labels)
    np.testing.assert_array_equal(found.origin, again.origin)
    assert sorted(set(found.labels[found.labels >= 0])) == list(range(len(found.origin)))
    for r, k in enumerate(found.origin):
        shown = labels[found.labels == r]
        assert (shown == k).sum() == np.bincount(shown + 1).max()


def test_split_cuts_every_mask_and_keeps_its_pixels():
    labels = boxes()
    found = simulated_masks(labels, only(split=1, parts=3))
    np.testing.assert_array_equal(found.labels >= 0, labels >= 0)
    np.testing.assert_array_equal(found.origin, np.tile(range(6), 3))
    for t in range(len(labels)):
        for k in range(6):
            ids, pixels = np.unique(found.labels[t][labels[t] == k], return_counts=True)
            assert len(ids) == 3
            assert pixels.argmax() == 0  # the largest part keeps the object's own id, the smallest number


def test_merge_joins_touching_objects_alone():
    labels = boxes()
    # Every other object stands 3 px from its neighbour; take those away, so that 0 and 1 have nobody but each other.
    labels[np.isin(labels, (2, 4))] = -1
    found = simulated_masks(labels, only(merge=0.5)).labels
    assert (found[np.isin(labels, (3, 5))] == found[labels == 3].min()).sum() == (labels == 3).sum()
    merged = [len(np.unique(found[t][np.isin(labels[t], (0, 1))])) == 1 for t in range(12)]
    assert 0.2 < np.mean(merged) < 0.8  # one of two chosen, with probability a half
    assert (found[labels < 0] == -1).all()


def test_masks_are_missed_at_the_rate_and_borders_jitter_within_it():
    labels = boxes(frames=60)
    found = simulated_masks(labels, only(miss=0.3)).labels
    changed = [(found[t] != labels[t])[labels[t] == k].any() for t in range(60) for k in range(6)]
    assert abs(np.mean(changed) - 0.3) < 0.08
    assert set(np.unique(found[found != labels])) == {-1}
    labels[labels > 0] = -1  # near ones would overwrite each other
    found = simulated_masks(labels, only(jitter_px=2)).labels
    areas = {int((image >= 0).sum()) for image in found}
    assert len(areas) > 1
    assert areas <= {(10 - 2 * r) ** 2 for r in range(3)} | {100 + 40 * r + 2 * r * (r - 1) for r in (1, 2)}


def test_lost_objects_go_on_under_a_new_id_or_not_at_all_and_swapped_ones_trade_theirs():
    labels = boxes()
    found = simulated_masks(labels, only(lose=1, gone=0))
    np.testing.assert_array_equal(np.sort(found.origin), np.repeat(range(6), 2))
    np.testing.assert_array_equal(found.origin[found.labels][labels >= 0], labels[labels >= 0])
    for k in range(6):
        ids = [int(found.labels[t][labels[t] == k][0]) for t in range(12)]
        (change,) = np.flatnonzero(np.diff(ids)) + 1
        assert 3 <= change < 9
    gone = simulated_masks(labels, only(lose=0.5, gone=1)).labels
    assert sum(not (gone[-1] == k).any() for k in range(6)) == 3
    assert all((gone[0] == k).any() for k in range(6))
    swapped = simulated_masks(labels, only(swap=1)).labels
    np.testing.assert_array_equal(swapped[:3], labels[:3])
    last = [int(swapped[-1][labels[-1] == k][0]) for k in range(6)]
    assert sorted(last) == list(range(6))
    assert all(last[k] != k and last[last[k]] == k for k in range(6))


@pytest.mark.parametrize("kind", ["made", "real"])
def test_spaces_have_the_stated_statistics(kind, request):
    if kind == "made":
        space = made_text_space([str(i) for i in range(1203)])
        variance = np.linalg.svd(space.vectors - space.vectors.mean(0), compute_uv=False) ** 2
        assert 85 < variance.sum() ** 2 / (variance**2).sum() < 120
    else:
        folder = request.getfixturevalue("shared") / "text"
        space = load_text_space(folder / "clip_vitb32_lvis.npy", folder / "lvis_names.json")
        assert "armchair" in space.names
    np.testing.assert_allclose(np.linalg.norm(space.vectors, axis=1), 1, atol=1e-5)
    gram = space.vectors @ space.vectors.T
    assert abs(gram[~np.eye(len(gram), dtype=bool)].mean() - PAIRWISE_COSINE) < 0.005


@pytest.mark.parametrize("level", sorted(LEVELS))
def test_images_meet_texts_as_clip_has_it(level, space, frames):
    """A cosine of 0.2 to 0.35 with the text that fits, lower with others; alike for one object in its views."""
    big = np.repeat(np.repeat(boxes(), 4, 1), 4, 2)  # 1,600 px an object
    pictures = np.repeat(np.repeat(frames, 4, 1), 4, 2)
    embedder = SimulatedEmbedder(pictures, big, CLASSES, space, LEVELS[level])
    assert isinstance(embedder, Embedder)
    found = np.stack([embedder.embed_regions(p, big[t] == np.arange(6)[:, None, None]) for t, p in enumerate(pictures)])
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-5)
    cosines = found @ embedder.embed_text(list(CLASSES)).T
    fits = np.diagonal(cosines, axis1=1, axis2=2)
    assert 0.2 < fits.mean() < 0.35
    assert fits.mean() - cosines[:, ~np.eye(6, dtype=bool)].mean() > 0.04
    alike = (found[:1] * found[1:]).sum(-1).mean()
    unlike = (found[:, :1] * found[:, 1:]).sum(-1).mean()
    assert alike > unlike + 0.1
