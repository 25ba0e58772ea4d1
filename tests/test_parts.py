"""Parts of a scene and what of them answers a text, against NumPy."""

import dataclasses

import jax
import numpy as np
import pytest
from small_field import make_field, unit_rows

from jsecon.app.question import ask_text
from jsecon.query.parts import answering_parts, part_nearness, query_parts
from jsecon.types import Parts


def made_parts(seed=0, count=200, parts=30, dim=16):
    rng = np.random.default_rng(seed)
    units = unit_rows(rng, parts, dim)
    units[3] = 0  # lies in no mask
    return Parts(rng.integers(-1, parts, count).astype(np.int32), units, rng.random(parts).astype(np.float32))


def nearness_in_numpy(parts, text, canonical):
    units, weight = parts.embeddings.astype(np.float64), parts.weight.astype(np.float64)
    known = units.any(1)
    cone = canonical.astype(np.float64).mean(0)
    cone /= np.linalg.norm(cone)
    across = text / np.linalg.norm(text)
    across = across - (across @ cone) * cone
    mean = known.sum() / (known.sum() + 1) * (weight[known, None] * units[known]).sum(0) / weight[known].sum()
    apart = units - mean
    cosine = apart @ across / np.maximum(np.linalg.norm(apart, axis=1) * np.linalg.norm(across), 1e-30)
    middle, best = np.median(cosine[known]), cosine[known].max()
    near = np.where(known, (cosine - middle) / (best - middle), 0)
    return np.where(parts.part >= 0, near[np.maximum(parts.part, 0)], 0)


def test_nearness_is_the_stated_one_compiled_and_over_many_texts():
    parts = made_parts()
    rng = np.random.default_rng(1)
    texts, canonical = unit_rows(rng, 3, 16), unit_rows(rng, 4, 16)
    many = jax.vmap(part_nearness, (None, 0, None))(parts, texts, canonical)
    for text, row in zip(texts, many):
        expected = nearness_in_numpy(parts, text.astype(np.float64), canonical)
        np.testing.assert_allclose(row, expected, atol=1e-4)
        np.testing.assert_allclose(part_nearness(parts, text, canonical), row, atol=1e-5)
    assert float(np.max(many)) == pytest.approx(1)


def test_parts_that_are_all_equally_near_answer_nothing():
    parts = Parts(np.zeros(4, np.int32), np.ones((1, 3), np.float32) / 3**0.5, np.ones(1, np.float32))
    near = part_nearness(parts, np.array([1, 0, 0], np.float32), np.zeros((0, 3), np.float32))
    np.testing.assert_array_equal(near, np.zeros(4))


def test_a_scene_whose_parts_lie_in_no_mask():
    bare = Parts(np.zeros(5, np.int32), np.zeros((1, 2), np.float32), np.zeros(1, np.float32))
    near = part_nearness(bare, np.ones(2, np.float32), np.zeros((0, 2), np.float32))
    np.testing.assert_array_equal(near, np.zeros(5))


def test_a_neighbour_of_the_same_region_is_left_out_and_a_second_thing_stays():
    """Four blobs of one selection: the thing (near 1), its neighbour (0.6), a second one of the kind (0.8), and what
    touches the thing without answering (0.2)."""
    rng = np.random.default_rng(0)
    centres = np.array([[0, 0, 0], [3, 0, 0], [9, 0, 0], [0.3, 0, 0]])
    means = np.concatenate([c + 0.1 * rng.normal(size=(200, 3)) for c in centres]).astype(np.float32)
    nearness = np.repeat([1.0, 0.6, 0.8, 0.2], 200).astype(np.float32)
    kept = answering_parts(np.ones(800, bool), nearness, means)
    share = kept.reshape(4, 200).mean(1)
    assert share[0] > 0.95
    assert share[2] > 0.95
    np.testing.assert_array_equal(share[[1, 3]], 0)


def test_the_nearest_cluster_stays_even_where_none_is_near_and_specks_do_not_rule():
    rng = np.random.default_rng(0)
    means = np.concatenate([c + 0.1 * rng.normal(size=(n, 3)) for c, n in ((0, 300), (5, 200), (9, 15))])
    nearness = np.repeat([0.6, 0.55, 0.7], [300, 200, 15])
    kept = answering_parts(np.ones(515, bool), nearness, means)
    assert kept[:300].mean() > 0.95
    assert not kept[300:500].any()
    assert not answering_parts(np.zeros(515, bool), nearness, means).any()
    few = np.arange(515) < 5
    np.testing.assert_array_equal(answering_parts(few, nearness, means), few)
    means[0] = np.nan
    assert not answering_parts(np.ones(515, bool), nearness, means)[0]


class Embedder:
    def __init__(self, rows):
        self.rows = rows

    def embed_text(self, texts):
        return np.stack([self.rows[text] for text in texts])


def test_all_that_answers_leaves_out_parts_that_do_not(scene, cameras):
    """Of the Gaussians of a region, half lie in a part that looks like another region."""
    field, _ = make_field(scene, cameras)
    rows = np.asarray(field.regions.embeddings)
    embedder = Embedder({"it": rows[0], "other": rows[1]})
    before = ask_text(field, embedder, "it", several=True, outliers=False)
    members = np.flatnonzero(before.mask)
    half = members[np.asarray(field.gaussians.means)[members, 0] > np.median(field.gaussians.means[members, 0])]
    part = np.full(scene.count, 1, np.int32)
    part[members], part[half] = 0, 2
    parts = Parts(part, rows[[0, 1, 2]], np.ones(3, np.float32))
    with_parts = dataclasses.replace(field, parts=parts)
    after = ask_text(with_parts, embedder, "it", several=True, outliers=False)
    assert after.mask.any()
    assert not after.mask[half].any()
    assert (np.asarray(after.selection.similarity)[half] <= 0.25).all()
    np.testing.assert_array_equal(ask_text(with_parts, embedder, "it", outliers=False).mask, before.mask)
    with pytest.raises(ValueError, match="--parts"):
        query_parts(field, before.selection, rows[:1])
