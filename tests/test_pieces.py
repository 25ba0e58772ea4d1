"""How far regions overlap, which of them are pieces of one thing, and what a text selects then."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import make_field, shares

from jsecon.query.anchored import query_anchored
from jsecon.query.pieces import is_piece, with_overlap
from jsecon.query.several import query_several
from jsecon.types import Regions, Votes


def cast(count: int, regions: int = 6, seed: int = 0, shown: bool = True) -> Votes:
    """Random votes of `count` Gaussians on their 4 strongest of some regions, the last of which nobody votes for."""
    rng = np.random.default_rng(seed)
    ids = np.argsort(rng.random((count, regions - 1)), 1)[:, :4].astype(np.int32)
    ids[rng.random(ids.shape) < 0.3] = -1
    weights = np.where(ids >= 0, rng.random(ids.shape), 0).astype(np.float32)
    total = (weights.sum(1) + rng.random(count)).astype(np.float32)
    seen = np.where(ids >= 0, rng.random(ids.shape) * 2, 0).astype(np.float32) if shown else None
    return Votes(ids, weights, weights.sum(1), total, total, np.ones(count, np.int32), 0, regions, shown=seen)


def expected(votes: Votes) -> np.ndarray:
    """(R, R) in float64, from the definition."""
    share = np.zeros((len(votes.total), votes.num_regions))
    seen = np.broadcast_to(votes.total[:, None], votes.regions.shape) if votes.shown is None else votes.shown
    for n, k in zip(*np.nonzero((votes.regions >= 0) & (seen > 0) & np.isfinite(votes.weights) & np.isfinite(seen))):
        share[n, votes.regions[n, k]] = min(float(votes.weights[n, k]) / float(seen[n, k]), 1.0)
    both = np.stack([np.minimum(share, share[:, [r]]).sum(0) for r in range(votes.num_regions)])
    either = np.stack([np.maximum(share, share[:, [r]]).sum(0) for r in range(votes.num_regions)])
    return np.divide(both, either, out=np.zeros_like(both), where=either > 0)


@pytest.mark.parametrize(("count", "shown"), [(1, True), (200, False), (40_000, True)])
def test_overlap_is_the_stated_sum(count, shown):
    votes = cast(count, shown=shown)
    found = np.asarray(with_overlap(votes).overlap)
    np.testing.assert_allclose(found, expected(votes), rtol=2e-5, atol=1e-6)
    np.testing.assert_array_equal(found, found.T)
    assert found[5].max() == 0
    assert found.max() <= 1


def test_overlap_without_gaussians_or_regions_and_with_numbers_that_are_not_finite():
    assert not np.asarray(with_overlap(cast(0)).overlap).any()
    none = dataclasses.replace(
        cast(5), regions=np.full((5, 1), -1), weights=np.zeros((5, 1)), num_regions=0, shown=None
    )
    assert with_overlap(none).overlap.shape == (0, 0)
    votes = cast(300)
    votes.weights[:50, 0], votes.shown[50:60, 1] = np.nan, np.inf
    np.testing.assert_allclose(with_overlap(votes).overlap, expected(votes), rtol=2e-5, atol=1e-6)
    huge = dataclasses.replace(votes, weights=votes.weights * 1e30, shown=votes.shown * 1e30)
    np.testing.assert_allclose(with_overlap(huge).overlap, with_overlap(votes).overlap, rtol=1e-5)


def test_overlap_under_jit_is_eager_and_under_vmap_a_loop():
    several = [with_overlap(cast(100, seed=seed)) for seed in range(3)]
    stacked = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *(cast(100, seed=s) for s in range(3)))
    traced = jax.jit(jax.vmap(with_overlap))(stacked)
    np.testing.assert_allclose(traced.overlap, np.stack([v.overlap for v in several]), rtol=1e-6)


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
        got = is_piece(similarity, known, chosen, overlap, nearness=0.5, least=0.7)
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
    axes = np.eye(12, dtype=np.float32)
    rows = np.stack([axes[0], 0.9 * axes[0] + 0.435 * axes[1], 0.3 * axes[0] + 0.954 * axes[2], axes[3], axes[4]])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    overlap = np.eye(5, dtype=np.float32)
    overlap[0, 1] = overlap[1, 0] = 0.4
    return with_other(field, overlap, regions=Regions(rows, field.regions.pixels))


def with_other(field, overlap, **changes):
    return dataclasses.replace(field, votes=dataclasses.replace(field.votes, overlap=overlap), **changes)


@pytest.mark.parametrize("retrieval", ["cosine", "contrast"])
def test_a_text_finds_a_thing_with_its_pieces_but_no_other_of_its_kind(broken, retrieval):
    text = broken.regions.embeddings[0]
    found = query_anchored(broken, text, retrieval=retrieval)
    np.testing.assert_allclose(found.similarity, shares(broken, [0, 1]), atol=1e-6)
    np.testing.assert_array_equal(found.mask, shares(broken, [0, 1]) >= 0.5)
    assert int(found.region) == 0
    alone = query_anchored(broken, text, retrieval=retrieval, piece_nearness=None)
    np.testing.assert_allclose(alone.similarity, shares(broken, [0]), atol=1e-6)
    for other in (with_other(broken, np.eye(5, dtype=np.float32)), with_other(broken, None)):  # apart; not known
        got = query_anchored(other, text, retrieval=retrieval)
        np.testing.assert_array_equal(got.similarity, alone.similarity)
    by_code = [query_anchored(field, text, by="code").mask for field in (broken, other)]
    np.testing.assert_array_equal(*by_code)
    none = query_anchored(broken, text, retrieval=retrieval, retrieval_threshold=2.0)
    assert int(none.region) == -1
    assert not np.asarray(none.mask).any()


def test_several_regions_take_their_pieces_with_them(broken):
    text = broken.regions.embeddings[:1]
    apart = with_other(broken, np.eye(5, dtype=np.float32))
    for field, options, regions in (
        (broken, {"several": False}, [0, 1]),
        (apart, {"several": False}, [0]),
        (apart, {"nearness": 0.8}, [0, 1]),
        (broken, {"nearness": 0.99}, [0, 1]),
        (apart, {"nearness": 0.99}, [0]),
    ):
        found = query_several(field, text, **options)
        np.testing.assert_allclose(found.similarity, shares(field, regions), atol=1e-6, err_msg=str(options))


def test_texts_by_vmap_are_the_loop(broken):
    texts = jnp.asarray(broken.regions.embeddings)
    ask = lambda text: query_anchored(broken, text).similarity
    np.testing.assert_allclose(jax.jit(jax.vmap(ask))(texts), np.stack([ask(t) for t in texts]), rtol=1e-6)
