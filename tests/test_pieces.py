"""Which regions are pieces of one thing, and what a text selects then."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_field import make_field, rows_of_a_kind, shares

from jsecon import QueryRules, Regions, query_anchored, query_region
from jsecon.query.match import MIN_FRAGMENT_OVERLAP, regions_with

EMBEDDINGS = np.eye(9, dtype=np.float32)


def test_a_fragment_is_near_the_text_and_shares_gaussians_with_the_best_region():
    rng = np.random.default_rng(0)
    rules = QueryRules(duplicate_cosine=None)
    for _ in range(20):
        similarity, known = rng.normal(size=9).astype(np.float32), rng.random(9) < 0.8
        overlap = np.where(rng.random((9, 9)) < 0.5, 0.0, rng.random((9, 9))).astype(np.float32)
        first = np.where(known, similarity, -9).argmax()
        best, middle = similarity[known].max(), np.median(similarity[known])
        near = known & (similarity >= middle + 0.5 * (best - middle)) & (best > middle)
        expected = near & (overlap[first] >= MIN_FRAGMENT_OVERLAP)
        expected[first] = True
        got = regions_with(jnp.asarray(first), similarity, known, EMBEDDINGS, overlap, rules)
        np.testing.assert_array_equal(got, expected)
    alone = np.arange(9) == first
    for values, usable in ((similarity, np.zeros(9, bool)), (np.zeros(9, np.float32), np.ones(9, bool))):
        got = regions_with(jnp.asarray(first), values, usable, EMBEDDINGS, overlap, rules)
        np.testing.assert_array_equal(got, alone)


@pytest.fixture(scope="module")
def broken(scene, cameras):
    """A field whose text names regions 0 and 1 (cosine 0.9), which share Gaussians: halves of one thing."""
    field, _ = make_field(scene, cameras)
    overlap = np.eye(5, dtype=np.float32)
    overlap[0, 1] = overlap[1, 0] = 0.4
    return with_other(field, overlap, regions=Regions(rows_of_a_kind(), field.regions.pixel_counts))


def with_other(field, overlap, **changes):
    return dataclasses.replace(field, votes=dataclasses.replace(field.votes, overlap=overlap), **changes)


@pytest.mark.parametrize("retrieval", ["cosine", "contrast"])
@pytest.mark.parametrize(("overlaps", "options", "regions"), [
    ("known", {}, [0, 1]), ("known", {"fragment_score": None}, [0]), ("known", {"fragment_score": 1.0}, [0]),
    ("apart", {}, [0]), ("unknown", {}, [0]),
    ("apart", {"all_of_class": True, "same_class_score": 0.8}, [0, 1]),
    ("known", {"all_of_class": True, "same_class_score": 0.99}, [0, 1]),
    ("apart", {"all_of_class": True, "same_class_score": 0.99}, [0]),
])  # fmt: skip
def test_a_text_finds_a_thing_with_its_pieces_but_no_other_of_its_kind(broken, retrieval, overlaps, options, regions):
    overlap = {"known": broken.votes.overlap, "apart": np.eye(5, dtype=np.float32), "unknown": None}[overlaps]
    field = with_other(broken, overlap)
    found = query_anchored(field, field.regions.embeddings[0], rules=QueryRules(retrieval=retrieval, **options))
    np.testing.assert_allclose(found.similarity, shares(field, regions), atol=1e-6)
    np.testing.assert_array_equal(found.mask, shares(field, regions) >= 0.5)
    assert int(found.region) == 0
    if "all_of_class" not in options:  # a region that stands for a text takes its pieces with it
        found = query_region(field, 0, rules=QueryRules(duplicate_cosine=None, **options))
        np.testing.assert_allclose(found.similarity, shares(field, regions), atol=1e-6)
