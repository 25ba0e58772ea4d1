"""Which regions are pieces of one thing, and what a text selects then."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_field import rows_of_a_kind, shares, unit_rows

from jsecon import QueryRules, Regions, query_anchored, query_region
from jsecon.query.match import MIN_FRAGMENT_OVERLAP, regions_with


def belongs(first, similarity, known, rows, overlap, rules):
    """The rule as it is stated, in float64."""
    best, middle = similarity[known].max(), np.median(similarity[known])

    def reaches(relative_score):
        return known & (similarity >= middle + relative_score * (best - middle)) & (best > middle)

    expected = np.arange(len(rows)) == first
    if rules.all_of_class:
        expected |= reaches(rules.same_class_score)
    expected |= reaches(rules.fragment_score) & (overlap[expected] >= MIN_FRAGMENT_OVERLAP).any(0)
    apart = rows - rows.sum(0, dtype=np.float64) / (known.sum() + 1)
    apart /= np.linalg.norm(apart, axis=1, keepdims=True)
    return expected | (known & (apart @ apart[first] >= rules.duplicate_cosine))


def test_fragments_duplicates_and_things_of_a_class_answer_with_the_best_region():
    rng = np.random.default_rng(0)
    class_rules = (QueryRules(all_of_class=True, same_class_score=score) for score in (0.3, 0.8))
    for rules in (QueryRules(), *class_rules):
        for _ in range(20):
            rows, known = unit_rows(rng, 9, 12), rng.random(9) < 0.8
            rows[0] = (rows[1] + 0.2 * rows[0]) / np.linalg.norm(rows[1] + 0.2 * rows[0])  # seen twice
            rows[~known] = 0
            similarity = (rows @ unit_rows(rng, 1, 12)[0]).astype(np.float32)
            overlap = np.where(rng.random((9, 9)) < 0.5, 0.0, rng.random((9, 9))).astype(np.float32)
            first = np.where(known, similarity, -9).argmax()
            got = regions_with(jnp.asarray(first), similarity, known, rows, overlap, rules)
            np.testing.assert_array_equal(got, belongs(first, similarity, known, rows, overlap, rules))
    alone, rules = np.arange(9) == first, QueryRules(duplicate_cosine=None)
    for values, usable in ((similarity, np.zeros(9, bool)), (np.zeros(9, np.float32), np.ones(9, bool))):
        got = regions_with(jnp.asarray(first), values, usable, rows, overlap, rules)
        np.testing.assert_array_equal(got, alone)


@pytest.fixture(scope="module")
def broken(field):
    """A field whose text names regions 0 and 1 (cosine 0.9), which share Gaussians: halves of one thing."""
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
