"""Every Gaussian's class: against sums written out in float64, and where there is nothing to say."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY
from small_field import field_of, seen_of, unit_rows, votes_of

from jsecon import QueryRules, Regions
from jsecon.query import classes

SIZE, REGIONS, KEPT = 12, 6, 3
query_classes = functools.partial(classes.query_classes, standardise=False)
"""test_retrieval has the standardised one"""


def made_field(count, *, regions=REGIONS, seed=0):
    """A field of made-up votes: `KEPT` different regions a Gaussian, the last of them none for every fourth."""
    rng = np.random.default_rng(seed)
    ids = np.argsort(rng.random((count, regions)), axis=1)[:, :KEPT].astype(np.int32)
    weights = -np.sort(-rng.uniform(0.1, 9, (count, KEPT)), axis=1).astype(np.float32)
    ids[::4, -1], weights[::4, -1] = -1, 0
    shown = np.where(ids >= 0, weights * rng.uniform(1, 3, weights.shape), 0).astype(np.float32)
    votes = votes_of(ids, weights, regions, total=weights.sum(1) + 1, weight_where_region_visible=shown)
    known = Regions(unit_rows(rng, regions, SIZE), rng.integers(1, 900, (regions, 2)).astype(np.int32))
    return field_of(votes, known, canonical_phrases=unit_rows(rng, 4, SIZE))


def exact(field, similarity, least):
    """The formula in float64 from (R, Q) similarities, one Gaussian after the other; and its share
    (N, Q) of each class's regions."""
    votes, found, parts = field.votes, [], []
    similarity = np.asarray(similarity, np.float64)
    speaks, best = similarity.max(1) >= least, similarity.argmax(1)
    for ids, weights, shown in zip(*(np.asarray(a) for a in (votes.regions, votes.weights, seen_of(votes)))):
        share = {r: float(w) / float(s) for r, w, s in zip(ids, weights, shown) if r >= 0}
        own = [[(float(w), float(s)) for r, w, s in zip(ids, weights, shown) if r >= 0 and speaks[r] and best[r] == q]
               for q in range(similarity.shape[1])]  # fmt: skip
        parts.append([sum(w for w, _ in row) / max(s for _, s in row) if row else 0 for row in own])
        share = {r: p for r, p in share.items() if speaks[r]} or share
        found.append(sum(p * similarity[r] for r, p in share.items()) / sum(share.values()))
    return np.array(found), np.array(parts)


@pytest.mark.parametrize("retrieval", ["contrast", "cosine"])
@pytest.mark.parametrize("count", [600, MANY])
def test_equals_the_formula(retrieval, count):
    field, texts = made_field(count), unit_rows(np.random.default_rng(1), 5, SIZE)
    known = field.regions
    similarity = known.embeddings @ texts.T
    if retrieval == "contrast":
        field = dataclasses.replace(field, unrelated_words=unit_rows(np.random.default_rng(6), 20, SIZE))
        directions = texts - field.unrelated_words.astype(np.float64).mean(0)
        similarity = known.embeddings @ (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    least = float(np.sort(similarity.max(1))[2]) - 1e-4  # two regions are none of the classes
    options = {"rules": QueryRules(retrieval=retrieval, min_score=least)}
    labels, found = query_classes(field, texts, every=True, **options)
    expected, part = exact(field, similarity, least)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    first, second = np.sort(expected, axis=1)[:, -1], np.sort(expected, axis=1)[:, -2]
    clear = first - second > 1e-5
    np.testing.assert_array_equal(np.asarray(labels)[clear], expected.argmax(1)[clear])
    assert clear.mean() > 0.99
    none, _ = query_classes(field, texts, **options)
    sure = clear & (np.abs(part - 0.5) > 1e-5).all(1)
    wanted = np.where((part >= 0.5).any(1), np.where(part >= 0.5, expected, -2).argmax(1), -1)
    np.testing.assert_array_equal(np.asarray(none)[sure], wanted[sure])
    assert 0 < (np.asarray(none) < 0).mean() < 0.9
    assert (none != labels)[np.asarray(none) >= 0].any()


@pytest.mark.parametrize("count", [600, MANY])
def test_jit_and_vmap_over_sets_of_texts_equal_the_loop(count):
    field = made_field(count)
    sets = unit_rows(np.random.default_rng(2), 6, SIZE).reshape(2, 3, SIZE)
    labels, found = jax.jit(jax.vmap(lambda texts: query_classes(field, texts)))(sets)
    for texts, own, likeness in zip(sets, labels, found):
        alone = query_classes(field, texts)
        np.testing.assert_allclose(likeness, alone[1], atol=1e-6)
        assert (np.asarray(own) == np.asarray(alone[0])).mean() > 0.999  # ties within rounding


def test_gradient_equals_central_differences(x64):
    field = jax.tree.map(lambda a: a.astype(np.float64) if a.dtype == np.float32 else a, made_field(40))
    weights = np.random.default_rng(3).normal(size=(40, 5))
    total = jax.jit(lambda texts: jnp.sum(weights * query_classes(field, texts)[1]))
    texts = unit_rows(np.random.default_rng(4), 5, SIZE).astype(np.float64)
    step = np.random.default_rng(5).normal(size=texts.shape) * 1e-6
    slope = float(jnp.sum(jax.grad(total)(jnp.asarray(texts)) * step))
    assert slope == pytest.approx(float(total(texts + step) - total(texts - step)) / 2, rel=1e-5)


def test_what_is_not_known_has_no_class_and_is_nobodys():
    """A view that nobody has, votes that are not finite, a region and texts without a direction; no regions."""
    field, texts = made_field(60), unit_rows(np.random.default_rng(1), 3, SIZE)
    lost = np.array(field.regions.embeddings)
    lost[4] = 0
    regions, weights, views = (np.array(a) for a in (field.votes.regions, field.votes.weights, field.votes.views))
    views[0] = 0
    regions[1], weights[2, 0], weights[3, 0] = -1, np.nan, np.inf
    known = Regions(lost, field.regions.pixel_counts)
    votes = dataclasses.replace(field.votes, regions=regions, weights=weights, views=views)
    ask = {"rules": QueryRules(retrieval="cosine", min_score=-1.0), "every": True}
    labels, found = query_classes(dataclasses.replace(field, regions=known, votes=votes), texts, **ask)
    np.testing.assert_array_equal(labels[:4], -1)
    np.testing.assert_array_equal(found[:4], 0)
    ids = np.where(field.votes.regions == 4, -1, field.votes.regions)
    without = dataclasses.replace(field.votes, regions=ids, weights=np.where(ids >= 0, field.votes.weights, 0))
    expected, same = query_classes(dataclasses.replace(field, votes=without), texts, **ask)
    np.testing.assert_array_equal(labels[4:], expected[4:])
    np.testing.assert_allclose(found[4:], same[4:], atol=1e-6)
    opposite = np.concatenate([-lost.sum(0, keepdims=True), np.zeros((1, SIZE), np.float32)]).astype(np.float32)
    labels, _ = query_classes(field, opposite, rules=QueryRules(retrieval="cosine"), every=True)
    assert not np.asarray(labels).any()  # the worst of texts is nearer than none
    assert (np.asarray(query_classes(field, opposite[1:])[0]) == -1).all()
    empty = dataclasses.replace(field, regions=Regions(lost[:0], field.regions.pixel_counts[:0]))
    assert (np.asarray(query_classes(empty, texts)[0]) == -1).all()
    for wrong in (texts[:, :5], texts[:0]):
        with pytest.raises(ValueError, match="query_classes"):
            query_classes(field, wrong)
