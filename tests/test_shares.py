"""Votes made ready to be asked: which views show a region, how much of a Gaussian regions have, how far they overlap.

`small_field.shares_of` and `exact_overlap` are the definitions in float64.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from jax.test_util import check_grads
from scipy.stats import beta
from small_field import lone_votes, seen_of, shares_of

from jsecon.field.membership import (
    CORRELATION,
    _add_visible_weight,
    inside_fraction,
    inside_fraction_of_regions,
    membership_probability,
    normalise_votes,
    vote_shares,
    with_overlap,
)
from jsecon.types import Regions, Votes

VIEWS, REGIONS, KEPT = 7, 6, 3


def cast(count, *, regions=REGIONS, seed=0):
    """Votes of `count` Gaussians in 7 views on their 3 strongest of some regions; of these nobody votes for the last, 3
    and 4 are alike, 2 has no embedding."""
    rng = np.random.default_rng(seed)
    by_view = rng.random((VIEWS, count), np.float32) * (rng.random((VIEWS, count)) < 0.8)
    pixels = rng.integers(1, 50, (regions, VIEWS)) * (rng.random((regions, VIEWS)) < 0.5)
    ids = np.argsort(rng.random((count, regions - 1)), 1)[:, :KEPT].astype(np.int32)
    ids[rng.random(ids.shape) < 0.3] = -1
    weights = np.where(ids >= 0, rng.random(ids.shape, np.float32), 0) * by_view.sum(0)[:, None] / KEPT
    embeddings = np.eye(regions, regions + 2, dtype=np.float32)
    embeddings[2], embeddings[4] = 0, embeddings[3]
    views, peak = (by_view > 0).sum(0).astype(np.int32), by_view.max(0, initial=0)
    votes = Votes(
        ids, weights.astype(np.float32), weights.sum(1).astype(np.float32), by_view.sum(0), peak, views, np.int32(0),
        regions, by_view,
    )  # fmt: skip
    return votes, Regions(embeddings, pixels)


def known_votes(count, *, shown=True, **options):
    votes, regions = cast(count, **options)
    return _add_visible_weight(votes, regions) if shown else dataclasses.replace(votes, by_view=None)


def exact_shown(votes, regions):
    shows = np.asarray(regions.pixel_counts) > 0
    shows[3] = shows[4] = shows[3] | shows[4]
    of_region = np.stack([np.asarray(votes.by_view, np.float64)[row].sum(0) for row in shows], 1)
    place = np.asarray(votes.regions)
    return np.where(place >= 0, np.take_along_axis(of_region, np.maximum(place, 0), 1), 0.0)


def exact_overlap(votes):
    votes = jax.tree.map(np.asarray, votes)
    seen = seen_of(votes)
    ratio = np.divide(votes.weights, seen, out=np.zeros(votes.regions.shape), where=seen > 0)
    share = np.zeros((len(votes.total), votes.num_regions))
    n, k = np.nonzero(votes.regions >= 0)
    share[n, votes.regions[n, k]] = np.minimum(ratio[n, k], 1.0)
    both = np.stack([np.minimum(share, share[:, [r]]).sum(0) for r in range(votes.num_regions)])
    either = np.stack([np.maximum(share, share[:, [r]]).sum(0) for r in range(votes.num_regions)])
    return np.divide(both, either, out=np.zeros_like(both), where=either > 0)


@pytest.mark.parametrize("count", [0, 1, 400, MANY])
def test_shown_and_overlap_are_the_stated_sums_under_jit_as_eagerly(count):
    votes, regions = cast(count)
    found = _add_visible_weight(votes, regions)
    assert found.by_view is None
    np.testing.assert_allclose(found.weight_where_region_visible, exact_shown(votes, regions), rtol=1e-5, atol=1e-6)
    traced = jax.jit(_add_visible_weight)(*(jax.tree.map(jnp.asarray, tree) for tree in (votes, regions)))
    shown = found.weight_where_region_visible
    np.testing.assert_allclose(traced.weight_where_region_visible, shown, rtol=1e-6)
    overlap = np.asarray(with_overlap(found).overlap)
    np.testing.assert_allclose(overlap, exact_overlap(found), rtol=2e-5, atol=1e-6)
    np.testing.assert_array_equal(overlap, overlap.T)
    np.testing.assert_array_equal(normalise_votes(votes, regions).overlap, overlap)


def test_overlap_under_vmap_is_a_loop_and_leaves_out_numbers_that_are_not_finite():
    several = [known_votes(100, shown=False, seed=seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *several)
    traced = jax.jit(jax.vmap(with_overlap))(stacked)
    np.testing.assert_allclose(traced.overlap, np.stack([with_overlap(v).overlap for v in several]), rtol=1e-6)
    votes = known_votes(300)
    weights, shown = np.array(votes.weights), np.array(votes.weight_where_region_visible)
    weights[:50, 0], shown[50:60, 1] = np.nan, np.inf
    broken = dataclasses.replace(votes, weights=weights, weight_where_region_visible=shown)
    without = np.where(np.isfinite(weights) & np.isfinite(shown), votes.regions, -1)
    expected = with_overlap(dataclasses.replace(votes, regions=without)).overlap
    np.testing.assert_allclose(with_overlap(broken).overlap, expected, rtol=1e-6)
    none = {"regions": np.full((5, 1), -1), "weights": np.zeros((5, 1), np.float32), "num_regions": 0}
    assert with_overlap(dataclasses.replace(known_votes(5, shown=False), **none)).overlap.shape == (0, 0)


def test_votes_without_views_or_of_other_views_are_refused():
    votes, regions = cast(10)
    with pytest.raises(ValueError, match=r"by_view=True"):
        _add_visible_weight(_add_visible_weight(votes, regions), regions)
    with pytest.raises(ValueError, match="same regions in the same views"):
        _add_visible_weight(votes, dataclasses.replace(regions, pixel_counts=regions.pixel_counts[:, 1:]))


@pytest.mark.parametrize("shown", [False, True])
@pytest.mark.parametrize("count", [400, MANY])
def test_share_is_the_definition_under_jit_and_vmap(count, shown):
    votes = jax.tree.map(jnp.asarray, known_votes(count, shown=shown))
    chosen = np.random.default_rng(1).random((3, REGIONS)) < 0.5
    together = jax.jit(jax.vmap(inside_fraction, in_axes=(None, 0)))(votes, chosen)
    for n, one in enumerate(chosen):
        alone = inside_fraction(votes, one)
        np.testing.assert_array_equal(alone.fraction, together.fraction[n])
        np.testing.assert_array_equal(alone.known, np.asarray(alone.fraction) > 0)
        np.testing.assert_allclose(alone.fraction, shares_of(votes, np.flatnonzero(one)), atol=1e-6)


@pytest.mark.parametrize("shown", [False, True])
def test_the_share_of_a_few_regions_without_a_program_has_the_same_bits(shown):
    votes = known_votes(700, shown=shown)
    weights = np.array(votes.weights)
    weights[::50, 0] = np.nan
    votes = dataclasses.replace(votes, weights=weights, views=np.arange(700, dtype=np.int32) % 9)
    for regions in ([], [0], [2, 1], range(REGIONS)):
        expected = inside_fraction(jax.tree.map(jnp.asarray, votes), np.isin(np.arange(REGIONS), list(regions)))
        jax.tree.map(np.testing.assert_array_equal, inside_fraction_of_regions(votes, list(regions)), expected)


def test_numbers_that_are_not_finite_are_not_known_where_they_are_asked_for():
    votes = Votes(
        np.int32([[0, 1], [1, 0], [-1, 5], [1, 1], [0, -1]]),
        np.float32([[1e30, np.nan], [np.inf, 2], [3, 4], [1e-30, 0], [1, 0]]),
        *np.float32([[1] * 5, [1e30, 4, 1, 1e-30, np.nan], [1] * 5]), np.ones(5, np.int32), np.int32(0), 2,
    )  # fmt: skip
    first, second = (inside_fraction(votes, np.arange(2) == r) for r in range(2))
    np.testing.assert_array_equal(first.fraction, np.float32([1, 0.5, 0, 0, 0]))  # what is not chosen does not spread
    np.testing.assert_array_equal(first.known, [True, True, False, False, False])
    np.testing.assert_array_equal(second.fraction, np.float32([0, 0, 0, 1, 0]))
    np.testing.assert_array_equal(second.known, [False, False, False, True, False])
    np.testing.assert_array_equal(vote_shares(votes)[:2], np.float32([[1, np.nan], [np.nan, 0.5]]))
    unseen = dataclasses.replace(votes, views=np.zeros(5, np.int32))
    assert not np.asarray(inside_fraction(unseen, np.ones(2, bool)).known).any()
    none = dataclasses.replace(votes, regions=np.zeros((5, 0), np.int32), weights=np.zeros((5, 0), np.float32))
    assert not np.asarray(inside_fraction(none, np.ones(2, bool)).fraction).any()


COUNT, MANY = 3, 40


@st.composite
def votes_and_regions(draw):
    """Finite votes, of regions that views show as they like, and some of the regions. All are of one size and share
    their compiled programs."""

    def rows():
        return draw(arrays(np.float32, (COUNT, KEPT), elements=st.just(0.0) | st.floats(2.0**-80, 2.0**80, width=32)))

    ids = np.int32([draw(st.permutations(range(-KEPT, MANY)))[:KEPT] for _ in range(COUNT)]).clip(-1)
    weights, total = np.where(ids >= 0, rows(), 0), rows().max(1)
    views = draw(arrays(np.int32, COUNT, elements=st.integers(0, 3)))
    none = np.int32(0)
    votes = Votes(ids, weights, weights.sum(1), total, total, views, none, MANY, weight_where_region_visible=rows())
    return votes, draw(arrays(bool, MANY))


@settings(deadline=None)
@given(votes_and_regions())
def test_laws_of_the_share(drawn):
    votes, chosen = drawn
    share, known = (np.asarray(a) for a in inside_fraction(votes, chosen))
    assert ((share >= 0) & (share <= 1)).all()
    voted = (votes.regions >= 0) & chosen[votes.regions] & (seen_of(votes) > 0)
    np.testing.assert_array_equal(known, (votes.views > 0) & voted.any(1))
    assert not share[~known].any()
    # One region alone has the share of its vote.
    alone = np.asarray(jax.vmap(inside_fraction, (None, 0))(votes, np.eye(MANY, dtype=bool)).fraction)
    own = np.where((votes.regions >= 0) & (votes.views > 0)[:, None], vote_shares(votes), 0)
    np.testing.assert_array_equal(alone[votes.regions, np.arange(COUNT)[:, None]] * (votes.regions >= 0), own)
    # Neither the order of the votes nor the regions' numbers mean anything.
    turned = {name: getattr(votes, name)[:, ::-1] for name in ("regions", "weights", "weight_where_region_visible")}
    again = inside_fraction(dataclasses.replace(votes, **turned), chosen).fraction
    np.testing.assert_allclose(again, share, rtol=1e-6)
    renamed = np.where(votes.regions >= 0, MANY - 1 - votes.regions, -1)
    again = inside_fraction(dataclasses.replace(votes, regions=renamed), chosen[::-1]).fraction
    np.testing.assert_array_equal(again, share)


def test_gradient_equals_central_differences(x64):
    votes = jax.tree.map(lambda a: a.astype(np.float64) if a.dtype == np.float32 else a, known_votes(60))
    chosen = np.arange(REGIONS) % 2 == 0

    @jax.jit
    def share(weights, shown):
        return inside_fraction(
            dataclasses.replace(votes, weights=weights, weight_where_region_visible=shown), chosen
        ).fraction

    given = jnp.asarray(votes.weights), jnp.asarray(votes.weight_where_region_visible)
    check_grads(share, given, order=1, modes=["rev"], rtol=1e-4, atol=0, eps=1e-7)


def seen_in(views, total):
    return dataclasses.replace(lone_votes(0 * views, REGIONS), views=views, total=total)


def test_probability_equals_the_beta_distribution():
    rng = np.random.default_rng(0)
    share, views = rng.random(200).astype(np.float32), rng.integers(1, 60, 200).astype(np.int32)
    total = (views * rng.uniform(0.01, 40, 200)).astype(np.float32)
    looks = np.minimum(views, total.astype(np.float64))
    looks = looks / (1 + np.maximum(looks - 1, 0) * CORRELATION)
    expected = beta.sf(0.5, 1 + share * looks, 1 + (1 - share) * looks)
    np.testing.assert_allclose(membership_probability(share, seen_in(views, total)), expected, atol=2e-5)
    unknown = seen_in(np.array([0, 3], np.int32), np.float32([0, np.nan]))
    np.testing.assert_array_equal(membership_probability(np.float32([1, 1]), unknown), 0)
