"""Protocols: means over the classes that occur against a confusion matrix, OpenGaussian's selections, memberships of
all views, and all silhouettes in one walk against each group rendered alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from balls import ring_of_balls
from hypothesis import given, settings, strategies as st
from small_field import unit_rows

from experiments.baselines.leaves import silhouette_overlaps
from experiments.protocols.opengaussian import most_similar_text, select_leaf, select_text, without_stragglers
from experiments.protocols.points import evaluate_points, point_class_means
from jsecon import InputError, plan_view, selection_mask


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 7))
def test_against_a_confusion_matrix(seed, count, classes):
    rng = np.random.default_rng(seed)
    truth, found = rng.integers(-1, classes, (2, count))
    if (truth < 0).all():
        truth[0] = 0
    ious, told = evaluate_points(found, truth, [f"class {k}" for k in range(classes)])
    table = np.zeros((classes + 1, classes + 1))
    for t, f in zip(truth, found, strict=True):
        table[t, f] += 1  # -1 is the last row and column
    present = np.flatnonzero(table[:-1].sum(1))
    both = table[present, present]
    recall = both / table[present].sum(1)
    union = table[present].sum(1) + table[:-1, present].sum(0) - both
    assert ious == pytest.approx({f"class {k}": iou for k, iou in zip(present, both / union)})
    assert told["miou"] == pytest.approx((both / union).mean())
    assert told["macc"] == pytest.approx(recall.mean())
    assert told["accuracy"] == pytest.approx((found == truth)[truth >= 0].mean())
    assert (told["miou"], told["macc"]) == pytest.approx(point_class_means(found, truth))
    assert told["missing"] == table[:-1, -1].sum()


def test_faint_points_and_denominators():
    truth, found = np.array([0, 0, 1, 1, 2, -1]), np.array([0, -1, 1, 0, 2, 2])
    opacities = np.array([0.9, 0.9, 0.9, 0.9, 0.05, 0.9])
    ious, told = evaluate_points(found, truth, "abc", opacities=opacities, expected_classes=2)
    assert ious == pytest.approx({"a": 1 / 3, "b": 1 / 2})
    assert told["missing"] == 1
    with pytest.raises(InputError, match="2 classes among 4 counted points"):
        evaluate_points(found, truth, "abc", opacities=opacities, expected_classes=3)
    with pytest.raises(InputError, match="at least one"):
        evaluate_points(found, np.full(6, -1), "abc")
    with pytest.raises(ValueError, match="classes up to 2"):
        evaluate_points(found, truth, "ab")


def test_each_gaussian_has_one_text_or_none():
    rng = np.random.default_rng(0)
    features, texts = 3 * unit_rows(rng, 500, 16), unit_rows(rng, 5, 16)
    features[:3] = 0
    features[3, 2] = np.nan
    labels, cosines = most_similar_text(jnp.asarray(features), jnp.asarray(texts))
    assert (labels[:4] == -1).all()
    exact = features[4:].astype(np.float64) @ texts.T.astype(np.float64)
    np.testing.assert_array_equal(labels[4:], exact.argmax(1))
    masks = np.stack([np.asarray(select_text(labels, cosines, q).mask) for q in range(5)])
    np.testing.assert_array_equal(masks.sum(0), np.asarray(labels) >= 0)
    with pytest.raises(ValueError, match="one space"):
        most_similar_text(jnp.asarray(features), jnp.asarray(texts[:, :3]))


def test_the_best_leaf_takes_near_siblings_along():
    features = np.zeros((8, 3), np.float32)
    features[[1, 2, 5, 6]] = [[1, 0.1, 0], [1, 0.3, 0], [1, 0.4, 0], [0, 0, 1]]
    codes = np.zeros((8, 2), np.float32)
    codes[2] = 0.5, 0.5  # near to leaf 1
    leaf_of = np.array([0, 1, 1, 2, 5, 6, -1])
    text = np.array([1, 0, 0], np.float32)
    found = select_leaf(features, codes, leaf_of, text, siblings=4)
    np.testing.assert_array_equal(found.mask, [0, 1, 1, 1, 0, 0, 0])  # 5 is no sibling, 6 too far away
    assert int(found.region) == 1
    codes[2] = 2.0
    np.testing.assert_array_equal(select_leaf(features, codes, leaf_of, text, siblings=4).mask, [0, 1, 1, 0, 0, 0, 0])
    nothing = select_leaf(np.zeros_like(features), codes, leaf_of, text, siblings=4)
    assert not np.asarray(nothing.mask).any()
    assert int(nothing.region) == -1


def test_stragglers_and_giants_go():
    rng = np.random.default_rng(1)
    means = np.concatenate([rng.normal(0, 0.1, (200, 3)), [[5, 5, 5]]])
    scales = np.full((201, 3), np.log(0.01))
    scales[7, 1] = np.log(0.2)
    kept = without_stragglers(means, scales, np.ones(201, bool))
    assert not kept[200]
    assert not kept[7]
    assert kept.sum() > 150
    few = np.arange(201) < 50
    np.testing.assert_array_equal(without_stragglers(means, scales, few), few)


GROUPS, SLOTS = 8, 4


def test_overlaps_are_those_of_each_group_rendered_alone():
    gaussians, cameras, _, truth, _ = ring_of_balls()
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, cameras[3]))
    draw = np.random.default_rng(0)
    # Groups that occlude themselves, some Gaussians of none, one group of nobody.
    group_of = np.where(draw.random(gaussians.count) < 0.1, -1, np.arange(gaussians.count) * 7 // gaussians.count)
    plan, ids = plan_view(gaussians, camera), truth[3] - (truth[3] == 2)
    for threshold in (0.8, 0.3):
        both, area, pixels = silhouette_overlaps(
            plan, jnp.asarray(group_of), jnp.asarray(ids), threshold, groups=GROUPS, slots=SLOTS
        )
        for group in range(GROUPS):
            alone = np.asarray(selection_mask(gaussians, camera, jnp.asarray(group_of == group), threshold=threshold))
            # A pixel whose alpha is the threshold to the last bits may fall to either side.
            np.testing.assert_allclose(area[group], alone.sum(), atol=1)
            np.testing.assert_allclose(both[group], [(alone & (ids == k)).sum() for k in range(SLOTS)], atol=1)
        assert np.asarray(area[:7]).min() > 20
        assert area[7] == 0
    np.testing.assert_array_equal(pixels, [(ids == k).sum() for k in range(SLOTS)])
