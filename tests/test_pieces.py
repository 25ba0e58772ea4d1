"""Which regions are pieces of one thing, and what a text selects then."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import make_field, rows_of_a_kind, shares

from jsecon import QueryRules, Regions, query_anchored, query_region, query_several
from jsecon.query.match import is_piece


def test_a_piece_is_near_the_text_and_shares_gaussians_with_what_was_chosen():
    rng = np.random.default_rng(0)
    for _ in range(20):
        similarity, known = rng.normal(size=9).astype(np.float32), rng.random(9) < 0.8
        overlap = rng.random((9, 9)).astype(np.float32)
        chosen = np.arange(9) == np.where(known, similarity, -9).argmax()
        chosen[rng.integers(9)] = True
        best, middle = similarity[known].max(), np.median(similarity[known])
        near = known & (similarity >= middle + 0.5 * (best - middle)) & (best > middle)
        wanted = near & (overlap[chosen].max(0) >= 0.7)
        got = is_piece(similarity, known, chosen, overlap, threshold=0.5, min_overlap=0.7)
        np.testing.assert_array_equal(got, wanted)
    nothing = np.zeros(9, bool)
    assert not np.asarray(is_piece(similarity, nothing, chosen, overlap)).any()
    assert not np.asarray(
        is_piece(np.zeros(9, np.float32), ~nothing, chosen, overlap)
    ).any()  # no best above the middle


@pytest.fixture(scope="module")
def broken(scene, cameras):
    """A field whose text names regions 0 and 1 (cosine 0.9), which share Gaussians: halves of one thing."""
    field, _ = make_field(scene, cameras)
    overlap = np.eye(5, dtype=np.float32)
    overlap[0, 1] = overlap[1, 0] = 0.4
    return with_other(field, overlap, regions=Regions(rows_of_a_kind(), field.regions.pixel_counts))


def with_other(field, overlap, **changes):
    return dataclasses.replace(field, votes=dataclasses.replace(field.votes, overlap=overlap), **changes)


@pytest.mark.parametrize("retrieval", ["cosine", "apart"])
def test_a_text_finds_a_thing_with_its_pieces_but_no_other_of_its_kind(broken, retrieval):
    text = broken.regions.embeddings[0]
    found = query_anchored(broken, text, rules=QueryRules(retrieval=retrieval))
    np.testing.assert_allclose(found.similarity, shares(broken, [0, 1]), atol=1e-6)
    np.testing.assert_array_equal(found.mask, shares(broken, [0, 1]) >= 0.5)
    assert int(found.region) == 0
    alone = query_anchored(broken, text, rules=QueryRules(retrieval=retrieval, piece_threshold=None))
    np.testing.assert_allclose(alone.similarity, shares(broken, [0]), atol=1e-6)
    for other in (with_other(broken, np.eye(5, dtype=np.float32)), with_other(broken, None)):  # apart; not known
        got = query_anchored(other, text, rules=QueryRules(retrieval=retrieval))
        np.testing.assert_array_equal(got.similarity, alone.similarity)
    by_code = [query_anchored(field, text, by="code").mask for field in (broken, other)]
    np.testing.assert_array_equal(*by_code)
    none = query_anchored(broken, text, rules=QueryRules(retrieval=retrieval, retrieval_threshold=2.0))
    assert int(none.region) == -1
    assert not np.asarray(none.mask).any()


def test_several_regions_take_their_pieces_with_them(broken):
    text = broken.regions.embeddings[:1]
    apart = with_other(broken, np.eye(5, dtype=np.float32))
    for field, options, regions in (
        (broken, {"all_of_kind": False}, [0, 1]),
        (broken, {"all_of_kind": False, "piece_threshold": 1.0}, [0]),
        (apart, {"all_of_kind": False}, [0]),
        (apart, {"kind_threshold": 0.8}, [0, 1]),
        (broken, {"kind_threshold": 0.99}, [0, 1]),
        (apart, {"kind_threshold": 0.99}, [0]),
    ):
        found = query_several(field, text, rules=QueryRules(**{"all_of_kind": True} | options))
        np.testing.assert_allclose(found.similarity, shares(field, regions), atol=1e-6, err_msg=str(options))


def test_texts_by_vmap_are_the_loop(broken):
    texts = jnp.asarray(broken.regions.embeddings)

    def ask(text):
        return query_anchored(broken, text).similarity

    np.testing.assert_allclose(jax.jit(jax.vmap(ask))(texts), np.stack([ask(t) for t in texts]), rtol=1e-6)


def test_a_region_takes_its_pieces_with_it_where_that_is_asked_for(broken):
    """As a text would whose embedding is the region's own."""
    unknown = with_other(broken, None)
    for field, nearness, regions in (
        (broken, None, [0]),
        (broken, 1.0, [0]),
        (broken, 0.5, [0, 1]),
        (unknown, 0.5, [0]),
    ):
        found = query_region(field, 0, rules=QueryRules(piece_threshold=nearness, alike_threshold=None))
        np.testing.assert_allclose(found.similarity, shares(broken, regions), atol=1e-6)
        assert int(found.region) == 0
    assert int(query_region(broken, 99, rules=QueryRules(piece_threshold=0.5, alike_threshold=None)).region) == -1
