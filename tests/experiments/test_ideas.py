"""The experiments on single ideas: their parts on problems small enough for a test."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from balls import ring_of_balls
from hypothesis import given, settings, strategies as st
from scipy import sparse
from small_field import REGIONS, make_field, true_regions

from experiments import ablations, autoencoder, beyond, outliers, retrieval, thresholds
from experiments.ideas import scenes
from experiments.ideas.cover import CORE, core_and_cover
from experiments.ideas.state import State, agree, point_miou
from experiments.ideas.straddlers import across, split
from experiments.simulated_vision.embeddings import made_text_space
from experiments.simulated_vision.masks import SimulatedMasks
from jsecon.query.render import render_selection
from jsecon.query.silhouette import MIN_CANDIDATE_SHARE
from jsecon.types import Gaussians


@pytest.fixture
def two_objects():
    """Two objects of 30 Gaussians and 20 of the wall in six views; the tracker gave their masks each other's id in the
    last view. (sight, evidence, truth)"""
    truth = np.repeat([0, 1, -1], [30, 30, 20])
    votes, pixels = np.zeros((80, 12)), np.full((6, 2), 100)
    embeddings = np.zeros((6, 2, 3))
    for t in range(6):
        ids = (1, 0) if t == 5 else (0, 1)
        for k, r in enumerate(ids):
            votes[truth == k, 2 * t + r] = 1
            embeddings[t, r] = np.eye(3)[k]
    sight = scenes.Sight(
        SimulatedMasks(np.zeros((6, 1, 1), np.int16), np.arange(2)), embeddings, pixels, np.eye(3)[:2], np.eye(3)
    )
    return sight, scenes.Evidence(sparse.csr_matrix(votes), np.ones((80, 6)), np.ones(80), 0.0), truth


def test_ideas_answer_what_the_votes_say(two_objects):
    sight, proof, truth = two_objects
    ids, ok = np.tile([0, 1], 6), np.ones(12, bool)
    plain = State(sight, proof, ids, ok, 2)
    groups = plain.joined(plain.anchors(sight.texts))
    assert [list(g) for g in groups] == [[0], [1]]
    assert plain.anchors(sight.texts, sight.canonical).tolist() == [0, 1]
    np.testing.assert_allclose(plain.shares(groups)[0][[0, 30, 60]], [5 / 6, 1 / 6, 0])
    assert point_miou(plain.leads(groups), truth) == 1
    assert not any(u.any() for u in beyond.ambiguous(plain, groups))
    kept = beyond.consistent(sight, plain)
    assert not kept.ok[10:].any()
    assert kept.ok[:10].all()  # F drops the two masks that were swapped
    np.testing.assert_allclose(kept.posteriors(groups)[0][[0, 30, 60]], [1, 0, 0])
    agreed = State(sight, proof, agree(proof.votes, ids), ok, 2)
    np.testing.assert_allclose(agreed.shares(groups)[0][[0, 30, 60]], [1, 0, 0])
    assert [list(g) for g in beyond.by_gap(plain, sight.texts)] == [[0], [1]]


def test_point_miou_is_over_the_objects_that_points_belong_to():
    truth = np.array([0, 0, 1, -1])
    masks = [np.array([1, 0, 0, 1], bool), truth == 1, np.ones(4, bool)]
    assert point_miou(masks, truth) == pytest.approx((1 / 3 + 1) / 2)


@pytest.fixture(scope="module")
def field_and_labels(scene, cameras):
    return make_field(scene, cameras)


def test_higher_thresholds_select_less(field_and_labels):
    field, _ = field_and_labels
    texts = field.regions.embeddings
    asked = field.region_codes
    low, high = (thresholds.ask(field, "d=8", texts, asked, asked[:2], t) for t in (0.4, 0.7))
    assert len(low) == 6
    for name, masks in low.items():
        assert (high[name] <= masks).all()
        assert masks.any()


def test_outlier_options_only_take_away():
    points = outliers.made_points(3000)
    np.testing.assert_array_equal(points, outliers.made_points(3000))
    mask = np.arange(3000) % 3 == 0
    for clean in outliers.cleaners(points.astype(np.float32), outliers.Options()).values():
        assert (clean(mask) <= mask).all()


def one_round(votes, ids):
    """As one would write it for one Gaussian and one mask at a time."""
    regions, sides = ids.max() + 1, np.zeros((len(votes), ids.max() + 1))
    for n, row in enumerate(votes):
        cast = np.array([row[ids == r].sum() for r in range(regions)])
        if cast.any():
            sides[n, cast.argmax()] = 1
    result = ids.copy()
    for m in range(len(ids)):
        weight = votes[:, m] @ sides
        if weight.max() > weight[ids[m]]:
            result[m] = weight.argmax()
    return result


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_rounds_equal_the_plain_loops(seed, rounds):
    rng = np.random.default_rng(seed)
    votes = rng.integers(1, 9, (30, 12)) * (rng.random((30, 12)) < 0.3).astype(float)
    ids = rng.integers(0, 5, 12)
    expected = ids
    for _ in range(rounds):
        expected = one_round(votes, expected)
    np.testing.assert_array_equal(agree(sparse.csr_matrix(votes), ids, rounds=rounds), expected)


def test_a_mask_under_another_id_is_outvoted_and_right_ones_stay():
    """Two objects of ten Gaussians in five views, mask 2t + k of object k; the last view has them swapped."""
    votes = np.zeros((20, 10))
    for t in range(5):
        votes[:10, 2 * t], votes[10:, 2 * t + 1] = 1, 1
    ids = np.array([0, 1] * 4 + [1, 0])
    np.testing.assert_array_equal(agree(sparse.csr_matrix(votes), ids), [0, 1] * 5)
    np.testing.assert_array_equal(agree(sparse.csr_matrix(votes), np.array([0, 1] * 5)), [0, 1] * 5)
    np.testing.assert_array_equal(agree(sparse.csr_matrix(0 * votes), ids), ids)


@pytest.mark.long
def test_autoencoder_experiment_runs_and_a_rotation_of_full_rank_loses_nothing(tmp_path):
    options = dataclasses.replace(autoencoder.QUICK, texts=str(tmp_path), regions=(6,), latents=(6,), epochs=4)
    rows = autoencoder.main(dataclasses.replace(options, out=str(tmp_path / "out")))["rows"]
    by_kind = {row["coder"]: row for row in rows}
    assert set(by_kind) == {"none", "autoencoder", "rotation", "spread"}
    assert by_kind["rotation"]["reconstruction"] == pytest.approx(1, abs=1e-4)
    assert by_kind["rotation"]["retrieval"] >= by_kind["none"]["retrieval"] - 1e-9
    assert {f.name for f in (tmp_path / "out").iterdir()} == {"config.json", "metrics.json", "table.md", "figure.png"}
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["rows"] == rows


def test_embeddings_are_of_classes_of_their_own():
    space = made_text_space([f"word {i}" for i in range(30)])
    images, texts = autoencoder.embeddings_of(space, 10, 0, autoencoder.QUICK)
    assert images.shape == texts.shape == (10, 512)
    own = np.diag(images @ texts.T)
    assert own.mean() > (images @ texts.T).mean() + 0.05


def test_ablated_parts_change_what_they_should():
    """Two objects in six views; the tracker swaps their ids in the last one, where the masks are small."""
    truth = np.repeat([0, 1, -1], [30, 30, 20])
    votes, pixels = np.zeros((80, 12)), np.full((6, 2), 100)
    pixels[5] = 10
    embeddings = np.zeros((6, 2, 8), np.float32)
    for t in range(6):
        for k, r in enumerate((1, 0) if t == 5 else (0, 1)):
            votes[truth == k, 2 * t + r] = 1
            embeddings[t, r] = np.eye(8)[k]
    masks = SimulatedMasks(np.zeros((6, 1, 1), np.int16), np.arange(2))
    sight = scenes.Sight(masks, embeddings, pixels, np.eye(8, dtype=np.float32)[:2], np.eye(8, dtype=np.float32)[4:])
    proof = scenes.Evidence(sparse.csr_matrix(votes), np.ones((80, 6)), np.ones(80), 0.0)
    options = ablations.Options(latent=16)
    whole = ablations.built(sight, proof, options)
    even = ablations.built(sight, proof, options, weighting=False)
    apart = ablations.built(sight, proof, options, tracking=False)
    assert whole.table.shape == (2, 8)
    assert apart.table.shape == (12, 8)
    assert (whole.table @ whole.table.T)[0, 1] < (even.table @ even.table.T)[0, 1]  # the bad view weighs less
    means = np.random.default_rng(0).normal(size=(80, 3)).astype(np.float32)
    for way in ablations.QUERIES:
        found = ablations.selections(
            whole, sight.texts, way, dataclasses.replace(options, code_threshold=0.8, canonical_threshold=0.95)
        )
        assert ablations.scored(found, truth, means, dbscan=False) == (1.0, 1.0), way
    assert ablations.scored([np.zeros(80, bool)] * 2, truth, means, dbscan=True) == (0.0, 0.0)


def test_every_rule_of_retrieval_is_asked_for_what_is_there_and_what_is_not(field_and_labels):
    field, labels = field_and_labels
    frames = np.random.default_rng(0).integers(0, 255, (*labels.shape, 3), dtype=np.uint8)
    truth = true_regions(field.gaussians)
    scene = scenes.Scene("small", field.gaussians, field.cameras, frames, labels, REGIONS, seed=0, truth=truth)
    space = made_text_space([f"word {i}" for i in range(40)])
    options = retrieval.Options(levels=("low",), absent=30)
    asked = retrieval.ask(scene, "low", space, options)
    assert [(a.regions, a.rule) for a in asked] == [
        (r, rule) for r in ("tracks", "consensus") for rule in retrieval.RULES
    ]
    assert all(len(a.right) == len(a.best) == len(a.iou) == REGIONS and 25 <= len(a.absent) <= 30 for a in asked)
    rules, thresholds = retrieval.rows_of(asked, options)
    found = {(row["regions"], row["rule"]): row for row in rules}
    assert found["tracks", "contrast"]["low texts"] >= 0.8
    assert 1 == found["tracks", "contrast"]["low there or not"] >= found["tracks", "relevancy"]["low there or not"]
    for rule in retrieval.RULES:
        own = [row for row in thresholds if (row["regions"], row["rule"]) == ("tracks", rule)]
        refused = [row["low not there, refused"] for row in own]
        assert refused == sorted(refused)
        assert refused[-1] > 0
        assert own[0]["mIoU"] >= own[-1]["mIoU"]


def test_a_straddler_is_cut_where_the_border_runs(cameras):
    """One long Gaussian, of which what lies at x > 0.05 is the region in every view."""
    one = Gaussians(
        np.float32([[0.0, 0.0, 0.0]]),
        np.log(np.float32([[0.3, 0.1, 0.1]])),
        np.float32([[1.0, 0, 0, 0]]),
        np.float32([2.0]),
        np.zeros((1, 1, 3), np.float32),
    )
    labels = np.full((4, 40, 48), -1, np.int16)
    rows, columns = np.mgrid[:40, :48] + 0.5
    for t in range(4):  # the pixel's ray, cut with the plane through the middle that faces the camera
        pose = np.asarray(cameras.world_to_camera[t], np.float64)
        rays = np.stack([(columns - 25.5) / 45, (rows - 19.0) / 43, np.ones_like(rows)], -1)
        places = (rays * pose[2, 3] - pose[:3, 3]) @ pose[:3, :3]
        labels[t] = np.where(places[..., 0] > 0.05, 0, -1)
    first, share, total = np.zeros(1, int), np.array([0.43]), np.array([50.0])  # Phi(-0.05 / 0.3)
    lean = across(one, cameras, labels, first)[0]
    assert lean[0] > 0.9 * np.linalg.norm(lean)
    found = split(one, cameras, labels, first, share, total)
    assert found.count == 2
    inner, outer = np.asarray(found.means)
    assert inner[0] > 0.05 > outer[0]
    np.testing.assert_allclose(0.43 * inner + 0.57 * outer, 0, atol=0.02)  # mass and its centre stay
    assert np.exp(np.asarray(found.log_scales)).max() < 0.25
    whole = np.full(2, True)
    before, after = (
        np.asarray(render_selection(g, jax.tree.map(jnp.asarray, cameras[0]), jnp.asarray(whole[: g.count])).alpha)
        for g in (one, found)
    )
    assert after.sum() == pytest.approx(before.sum(), rel=0.1)
    assert split(one, cameras, labels, first, np.array([0.95]), total).count == 1
    assert split(one, cameras, labels, first, share, np.array([1.0])).count == 1


def test_a_cover_grows_from_the_core_and_spills_little():
    gaussians, cameras, *_ = ring_of_balls()
    away = np.linalg.norm(gaussians.means - np.float32([0.0, -0.3, 0.0]), axis=1)
    noise = np.random.default_rng(3).normal(size=len(away)) * 0.2
    share = np.clip(0.5 + (0.29 - away) / 0.1 + noise, 0, 1).astype(np.float32)
    found = np.asarray(core_and_cover(gaussians, cameras, share))
    assert found[share >= CORE].all()
    assert not found[share <= MIN_CANDIDATE_SHARE].any()
    assert found.sum() > (share >= CORE).sum()
    nobody = np.asarray(core_and_cover(gaussians, cameras, np.minimum(share, 0.5)))
    assert not nobody.any()  # no core to grow from
