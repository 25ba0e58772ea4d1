"""What the views that show a region see of each Gaussian, and what that changes in a query."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jsecon.query.anchored import query_anchored
from jsecon.query.several import query_several
from jsecon.query.showing import with_shown
from jsecon.types import Camera, Gaussians, LanguageField, Regions, Votes

VIEWS, REGIONS, VOTES = 7, 5, 3


def cast(count: int, seed: int = 0) -> tuple[Votes, Regions]:
    """Votes of `count` Gaussians in 7 views on 5 regions, of which 3 and 4 are alike and 2 was never embedded."""
    rng = np.random.default_rng(seed)
    by_view = rng.random((VIEWS, count)).astype(np.float32) * (rng.random((VIEWS, count)) < 0.8)
    pixels = rng.integers(1, 50, (REGIONS, VIEWS)) * (rng.random((REGIONS, VIEWS)) < 0.5)
    regions = np.argsort(rng.random((count, REGIONS)), 1)[:, :VOTES].astype(np.int32)
    regions[rng.random((count, VOTES)) < 0.3] = -1
    weights = np.where(regions >= 0, rng.random((count, VOTES)), 0).astype(np.float32)
    embeddings = np.eye(REGIONS, 8, dtype=np.float32)
    embeddings[2] = 0
    embeddings[4] = embeddings[3]
    total = by_view.sum(0)
    votes = Votes(regions, weights, weights.sum(1), total, by_view.max(0), (by_view > 0).sum(0), 0, REGIONS, by_view)
    return votes, Regions(embeddings, pixels)


def expected(votes: Votes, regions: Regions) -> np.ndarray:
    """(N, K) by loops in float64."""
    shows = np.asarray(regions.pixels) > 0
    shows[3] = shows[4] = shows[3] | shows[4]
    by_view = np.asarray(votes.by_view, np.float64)
    of_region = np.stack([by_view[row].sum(0) for row in shows], 1)
    place = np.asarray(votes.regions)
    return np.where(place >= 0, np.take_along_axis(of_region, np.maximum(place, 0), 1), 0.0)


@pytest.mark.parametrize("count", [1, 16_385, 40_000])
def test_equals_the_sums_over_the_views_that_show_the_region(count):
    votes, regions = cast(count)
    found = with_shown(votes, regions)
    assert found.by_view is None
    np.testing.assert_allclose(found.shown, expected(votes, regions), rtol=1e-5, atol=1e-6)
    assert (np.asarray(found.shown) <= np.asarray(votes.total)[:, None] * (1 + 1e-5)).all()


def test_jit_is_eager_and_no_gaussians_or_regions_are_no_error():
    votes, regions = cast(300)
    traced = jax.jit(with_shown)(jax.tree.map(jnp.asarray, votes), jax.tree.map(jnp.asarray, regions))
    np.testing.assert_allclose(traced.shown, with_shown(votes, regions).shown, rtol=1e-6)
    assert with_shown(cast(0)[0], regions).shown.shape == (0, VOTES)
    none = dataclasses.replace(votes, regions=np.full((300, 1), -1), weights=np.zeros((300, 1)), num_regions=0)
    found = with_shown(none, Regions(np.zeros((0, 8)), np.zeros((0, VIEWS), int)))
    assert not np.asarray(found.shown).any()


def test_votes_without_views_or_of_other_views_are_refused():
    votes, regions = cast(10)
    with pytest.raises(ValueError, match=r"by_view=True"):
        with_shown(with_shown(votes, regions), regions)
    with pytest.raises(ValueError, match="same regions in the same views"):
        with_shown(votes, dataclasses.replace(regions, pixels=regions.pixels[:, 1:]))


def field_of(votes: Votes, regions: Regions) -> LanguageField:
    count = votes.regions.shape[0]
    zeros = np.zeros((count, 3), np.float32)
    gaussians = Gaussians(zeros, zeros, np.ones((count, 4), np.float32), zeros[:, 0], zeros[:, None])
    one = np.ones(1, np.float32)
    camera = Camera(np.eye(4)[None], one, one, one, one, 4, 4)
    codes = np.ones((count, 2), np.float32)
    table, canonical = np.ones((regions.count, 2), np.float32), np.zeros((0, 8))
    return LanguageField(gaussians, codes, votes, regions, table, None, camera, canonical, np.eye(4), ("a",))


def test_a_view_that_lost_the_region_says_nothing_against_it():
    """Gaussian 0 lies in region 0, which three of ten views lost; 1 lies beside it, labelled or not; 2 was glimpsed."""
    by_view = np.ones((10, 3), np.float32)
    by_view[:, 2] = 0
    regions = np.array([[0, 1], [1, 0], [-1, -1]], np.int32)
    weights = np.array([[4.0, 0.5], [4.5, 1.0], [0, 0]], np.float32)
    shows = np.array([[1] * 5 + [0] * 5, [1] * 10])
    total = by_view.sum(0)
    views = (by_view > 0).sum(0)
    votes = Votes(regions, weights, weights.sum(1), total, total, views, 0, 2, by_view)
    plain = field_of(votes, Regions(np.eye(2, 8, dtype=np.float32), shows))
    known = dataclasses.replace(plain, votes=with_shown(votes, plain.regions))
    text = jnp.eye(2, 8)[0]
    assert np.asarray(query_anchored(plain, text).mask).tolist() == [False, False, False]  # 4 of 10
    found = query_anchored(known, text)
    assert np.asarray(found.mask).tolist() == [True, False, False]
    np.testing.assert_allclose(found.similarity, [0.8, 0.2, 0], rtol=1e-6)
    in_full = query_anchored(known, text, unlabelled_weight=1.0)
    np.testing.assert_array_equal(in_full.similarity, query_anchored(plain, text).similarity)
    np.testing.assert_allclose(query_several(known, text[None], several=False).similarity, found.similarity)
    both = query_several(known, jnp.eye(2, 8), several=False)
    np.testing.assert_allclose(both.similarity, [0.45, 0.55, 0], rtol=1e-6)  # the views that show either
