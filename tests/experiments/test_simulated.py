"""Simulated vision: each fault does what its number says, at the rate it says, and nothing else."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from experiments.simulated_vision.embeddings import PAIRWISE_COSINE, SimulatedEmbedder, load_text_space, made_text_space
from experiments.simulated_vision.masks import LEVELS, Faults, simulated_masks
from jsecon.errors import InputError
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


def test_without_faults_the_masks_are_the_truth():
    labels = boxes()
    found = simulated_masks(labels, NONE)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_array_equal(found.origin, np.arange(6))


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


def test_seeds_differ():
    labels = boxes()
    assert not np.array_equal(*(simulated_masks(labels, Faults(), seed=seed).labels for seed in (0, 1)))


@pytest.mark.parametrize("parts", [2, 3])
def test_split_cuts_every_mask_and_keeps_its_pixels(parts):
    labels = boxes()
    found = simulated_masks(labels, only(split=1, parts=parts)).labels
    np.testing.assert_array_equal(found >= 0, labels >= 0)
    for t in range(len(labels)):
        for k in range(6):
            ids, pixels = np.unique(found[t][labels[t] == k], return_counts=True)
            assert len(ids) == parts
            assert pixels.argmax() == 0  # the largest part keeps the object's own id, the smallest number
    np.testing.assert_array_equal(simulated_masks(labels, only(split=1, parts=parts)).origin, np.tile(range(6), parts))


def test_merge_joins_touching_objects_alone():
    labels = boxes()
    # Every other object stands 3 px from its neighbour; take those away, so that 0 and 1 have nobody but each other.
    labels[np.isin(labels, (2, 4))] = -1
    found = simulated_masks(labels, only(merge=0.5)).labels
    kept = np.isin(labels, (3, 5))
    assert (found[kept] == found[labels == 3].min()).sum() == (labels == 3).sum()
    merged = [len(np.unique(found[t][np.isin(labels[t], (0, 1))])) == 1 for t in range(12)]
    assert 0.2 < np.mean(merged) < 0.8  # one of two chosen, with probability a half
    assert (found[labels < 0] == -1).all()


@pytest.mark.parametrize("field", ["split", "miss"])
def test_shares_are_shares_of_the_masks(field):
    labels = boxes(frames=60)
    found = simulated_masks(labels, only(**{field: 0.3})).labels
    changed = [(found[t] != labels[t])[labels[t] == k].any() for t in range(60) for k in range(6)]
    assert abs(np.mean(changed) - 0.3) < 0.08
    if field == "miss":
        assert set(np.unique(found[found != labels])) == {-1}


@pytest.mark.parametrize("by", [1, 2, 3])
def test_jitter_moves_borders_by_at_most_so_many_pixels(by):
    labels = boxes()
    labels[labels > 0] = -1  # near ones would overwrite each other
    found = simulated_masks(labels, only(jitter_px=by)).labels
    areas = {int((found[t] >= 0).sum()) for t in range(12)}
    grown = {(10 - 2 * r) ** 2 for r in range(by + 1)} | {100 + 40 * r + 2 * r * (r - 1) for r in range(1, by + 1)}
    assert areas <= grown
    assert len(areas) > 1


def test_lost_objects_go_on_under_a_new_id_or_not_at_all():
    labels = boxes()
    found = simulated_masks(labels, only(lose=1, gone=0))
    assert len(found.origin) == 12
    np.testing.assert_array_equal(np.sort(found.origin), np.repeat(range(6), 2))
    np.testing.assert_array_equal(found.origin[found.labels][labels >= 0], labels[labels >= 0])
    for k in range(6):
        ids = [int(found.labels[t][labels[t] == k][0]) for t in range(12)]
        change = np.flatnonzero(np.diff(ids)) + 1
        assert len(change) == 1
        assert 3 <= change[0] < 9
    gone = simulated_masks(labels, only(lose=0.5, gone=1)).labels
    missing = [(gone[-1] == k).sum() == 0 for k in range(6)]
    assert sum(missing) == 3
    assert all((gone[0] == k).any() for k in range(6))


def test_swapped_objects_trade_ids_for_good():
    labels = boxes()
    found = simulated_masks(labels, only(swap=1)).labels
    np.testing.assert_array_equal(found[:3], labels[:3])
    last = [int(found[-1][labels[-1] == k][0]) for k in range(6)]
    assert sorted(last) == list(range(6))
    assert all(last[k] != k and last[last[k]] == k for k in range(6))
    assert (simulated_masks(labels, only(swap=1 / 3)).labels != labels)[-1].sum() == 200  # two objects of 100 px


def test_one_rate_leaves_the_other_draws():
    labels = boxes()
    split = simulated_masks(labels, only(split=0.3)).labels != labels
    both = simulated_masks(labels, only(split=0.3, miss=0.2)).labels
    assert ((both != labels) == (split | (both < 0)))[labels >= 0].all()


def test_masks_of_nothing_stay_nothing():
    nothing = np.full((3, 8, 8), -1, np.int16)
    found = simulated_masks(nothing, LEVELS["high"])
    np.testing.assert_array_equal(found.labels, nothing)
    assert len(found.origin) == 0


def test_rates_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"Faults\.split"):
        simulated_masks(boxes(2), only(split=1.5))
    with pytest.raises(ValueError, match="parts"):
        simulated_masks(boxes(2), only(parts=1))


def test_made_space_has_the_stated_statistics():
    vectors = made_text_space([str(i) for i in range(1203)]).vectors
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    gram = vectors @ vectors.T
    assert abs(gram[~np.eye(len(gram), dtype=bool)].mean() - PAIRWISE_COSINE) < 0.005
    variance = np.linalg.svd(vectors - vectors.mean(0), compute_uv=False) ** 2
    assert 85 < variance.sum() ** 2 / (variance**2).sum() < 120


def test_real_space_has_them_too(shared):
    space = load_text_space(shared / "text" / "clip_vitb32_lvis.npy", shared / "text" / "lvis_names.json")
    gram = space.vectors @ space.vectors.T
    assert abs(gram[~np.eye(len(gram), dtype=bool)].mean() - PAIRWISE_COSINE) < 0.005
    assert "armchair" in space.names


def test_spaces_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(InputError, match="made_text_space"):
        load_text_space(tmp_path / "no.npy", tmp_path / "no.json")
    np.save(tmp_path / "v.npy", np.ones((3, 8)))
    (tmp_path / "n.json").write_text(json.dumps(["a", "b"]))
    with pytest.raises(InputError, match="2 names"):
        load_text_space(tmp_path / "v.npy", tmp_path / "n.json")


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


def test_view_noise_falls_with_the_root_of_the_pixels(space, frames):
    labels = np.zeros((12, 24, 84), np.int16)
    embedder = SimulatedEmbedder(frames, labels, ("cup",), space, only(view_noise=1.0, reference_pixels=1600))
    clean = SimulatedEmbedder(frames, labels, ("cup",), space, NONE)

    def error(rows):
        mask = np.zeros((1, 24, 84), bool)
        mask[:, :rows, :] = True
        a, b = (np.stack([e.embed_regions(f, mask)[0] for f in frames]) for e in (embedder, clean))
        return np.tan(np.arccos((a * b).sum(-1))).mean()

    assert error(5) / error(20) == pytest.approx(2.0, rel=0.1)
    assert error(1) / error(20) == pytest.approx(4.0, rel=0.15)  # the cap


def test_a_mask_of_two_things_lies_between_them(space, frames):
    labels = boxes()
    embedder = SimulatedEmbedder(frames, labels, CLASSES, space, NONE)
    a, b, both, nothing = embedder.embed_regions(
        frames[0], np.stack([labels[0] == 0, labels[0] == 1, np.isin(labels[0], (0, 1)), labels[0] == 99])
    )
    assert both @ a > a @ b
    assert both @ b > a @ b
    assert not nothing.any()
    text = embedder.embed_text(["cup", "dog"])
    assert a @ text[0] > both @ text[0] > b @ text[0]


def test_embedding_is_the_same_again_and_refuses_what_it_does_not_know(space, frames):
    labels = boxes()
    first, second = (SimulatedEmbedder(frames, labels, CLASSES, space, Faults()) for _ in range(2))
    masks = labels[3] == np.arange(6)[:, None, None]
    np.testing.assert_array_equal(first.embed_regions(frames[3], masks), second.embed_regions(frames[3], masks))
    other = SimulatedEmbedder(frames, labels, CLASSES, space, Faults(), seed=1)
    assert not np.allclose(first.embed_regions(frames[3], masks), other.embed_regions(frames[3], masks))
    assert first.embed_text([]).shape == (0, 256)
    with pytest.raises(InputError, match="true labels"):
        first.embed_regions(255 - frames[0], masks)
    with pytest.raises(InputError, match="unicorn"):
        first.embed_text(["unicorn"])
    with pytest.raises(ValueError, match="classes"):
        SimulatedEmbedder(frames, labels, ("cup",), space, Faults())
