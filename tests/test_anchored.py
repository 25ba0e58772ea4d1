"""The anchored query, by votes and by codes, against NumPy; the region under a pixel against a rendering."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import REGIONS, field_of, lone_votes, make_field, shares, unit_rows

from jsecon.errors import InputError
from jsecon.field.evidence import region_votes
from jsecon.field.membership import _add_visible_weight, normalise_votes, vote_shares
from jsecon.paper.queries import CODE_THRESHOLD, select_by_code
from jsecon.query.answer import (
    match_region,
    match_regions,
    query_anchored,
    query_region,
    query_several,
    select_gaussians,
)
from jsecon.query.classes import query_classes
from jsecon.query.pointing import region_at, region_shares_seen
from jsecon.query.rules import RULES, QueryRules
from jsecon.splat.render import render
from jsecon.types import Regions, Votes


def select(field, match, by, rules=RULES, threshold=None):
    """The Gaussians of matched regions, "votes" or "code"."""
    if by == "code":
        return select_by_code(field, match, CODE_THRESHOLD if threshold is None else threshold)
    return select_gaussians(
        field, match, rules if threshold is None else dataclasses.replace(rules, min_share=threshold)
    )


def ask(field, text, by, rules=RULES, threshold=None):
    return select(field, match_regions(field, jnp.asarray(text)[None], rules), by, rules, threshold)


def ask_region(field, region, by, threshold=None):
    return select(field, match_region(field, region), by, threshold=threshold)


@pytest.fixture(scope="module")
def made(scene, cameras):
    return make_field(scene, cameras)


@pytest.fixture(scope="module")
def field(made):
    return made[0]


def exact_cosine(a, b):
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    length = np.linalg.norm(a, axis=1) * np.linalg.norm(b)
    return np.divide(a @ b, length, out=np.zeros(len(a)), where=length > 0)


@pytest.mark.parametrize("shown", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_region_has_the_same_members_however_it_is_asked_for(made, shown):
    """By text, by its number, by a pixel, by class, with all of its kind, and as one of several texts. (Long: votes of
    an old field, whose shares test_shares has.)"""
    field, labels = made
    cast = region_votes(field.gaussians, field.cameras, jnp.asarray(labels), REGIONS, top=3, by_view=True)
    texts = np.eye(REGIONS, 12, dtype=np.float32)
    regions = Regions(texts, field.regions.pixel_counts)
    votes = normalise_votes(cast, regions)
    votes = votes if shown else dataclasses.replace(votes, weight_where_region_visible=None)
    field = dataclasses.replace(field, regions=regions, votes=votes)
    under = {}
    for view, y, x in np.random.default_rng(0).permutation(np.argwhere(labels >= 0)):
        if len(under) < REGIONS and labels[view, y, x] not in under:
            found = region_at(field, int(view), int(x), int(y))
            under |= {found: query_region(field, found)} if found == labels[view, y, x] else {}
    classes, _ = query_classes(field, texts)
    votes_for = np.stack([shares(field, [r]) >= 0.5 for r in range(REGIONS)])
    assert set(under) == set(range(REGIONS))
    for region, text in enumerate(texts):
        expected = np.asarray(query_anchored(field, text).mask)
        np.testing.assert_array_equal(expected, votes_for[region])
        assert 0 < expected.sum() < 40
        others = query_several(field, text[None], np.delete(texts, region, 0))
        for way, selection in {
            "number": query_region(field, region),
            "pixel": under[region],
            "--all": query_several(field, text[None]),
            "one": query_several(field, text[None], rules=QueryRules()),
            "but not": others,
        }.items():
            np.testing.assert_array_equal(selection.mask, expected, err_msg=way)
        np.testing.assert_array_equal(query_classes(field, text[None])[0] == 0, expected)
        alone = votes_for.sum(0) <= 1  # what two regions have is of the class that it answers better
        np.testing.assert_array_equal((np.asarray(classes) == region)[alone], expected[alone])
        assert alone.mean() > 0.9


@pytest.mark.parametrize("region", range(REGIONS))
def test_a_text_like_a_region_finds_it_and_its_gaussians(field, region):
    text = field.regions.embeddings[region] + 0.1 * unit_rows(np.random.default_rng(region), 1, 12)[0]
    got = query_anchored(field, text)
    assert int(got.region) == region
    cosine = exact_cosine(field.regions.embeddings[[region]], text)[0]
    by_cosine = query_anchored(field, text, rules=QueryRules(retrieval="cosine"))
    assert float(by_cosine.score) == pytest.approx(cosine, abs=1e-6)
    share = shares(field, [region])
    np.testing.assert_allclose(got.similarity, share, atol=1e-6)
    np.testing.assert_array_equal(got.mask, share >= 0.5)
    by_code = ask(field, text, "code")
    cosine = exact_cosine(field.codes.gaussians, field.codes.regions[region])
    np.testing.assert_allclose(by_code.similarity, cosine, atol=1e-6)
    np.testing.assert_array_equal(by_code.mask, cosine >= 0.9)


def test_a_region_asked_for_by_its_number_is_the_same(field):
    for by in ("votes", "code"):
        asked = ask_region(field, 2, by)
        found = ask(field, field.regions.embeddings[2], by)
        np.testing.assert_array_equal(asked.mask, found.mask)
        np.testing.assert_array_equal(asked.similarity, found.similarity)
        assert int(asked.region) == 2
        assert float(asked.score) == 1
        for absent in (-1, REGIONS, 10_000, jnp.asarray(-1)):
            nothing = ask_region(field, absent, by)
            assert not nothing.mask.any()
            assert int(nothing.region) == -1
            assert float(nothing.score) == 0


def test_nothing_passes_a_min_score_that_no_region_reaches(field):
    text = unit_rows(np.random.default_rng(9), 1, 12)[0]
    words = unit_rows(np.random.default_rng(10), 30, 12)
    worded = dataclasses.replace(field, unrelated_words=words)
    directions = {"cosine": text, "contrast": text - words.mean(0)}
    for by, (retrieval, direction) in itertools.product(("votes", "code"), directions.items()):
        best_of = functools.partial(ask, worded, text, by)
        rules = functools.partial(QueryRules, retrieval=retrieval)
        best = float(best_of(rules(min_score=-1.0)).score)
        assert np.abs(exact_cosine(field.regions.embeddings, direction) - best).min() < 1e-6
        assert int(best_of(rules(min_score=best - 1e-4)).region) >= 0
        nothing = best_of(rules(min_score=best + 1e-4), -1.0)
        assert int(nothing.region) == -1
        assert not nothing.mask.any()
        assert float(nothing.score) == pytest.approx(best, abs=1e-6)  # how close it was is still told


def test_jit_and_vmap_over_texts_equal_the_loop(field):
    texts = unit_rows(np.random.default_rng(4), 7, 12)
    for by in ("votes", "code"):
        together = jax.jit(jax.vmap(lambda text, by=by: ask(field, text, by)))(texts)
        for index, text in enumerate(texts):
            alone = ask(field, text, by)
            np.testing.assert_array_equal(together.mask[index], alone.mask)
            np.testing.assert_allclose(together.similarity[index], alone.similarity, atol=1e-7)
            assert int(together.region[index]) == int(alone.region)


def test_regions_that_are_alike_count_as_one(field):
    embeddings = np.array(field.regions.embeddings)
    pixels = np.array(field.regions.pixel_counts)
    embeddings[4], pixels[4] = embeddings[1], pixels[1]  # of two that are as well known the first is the anchor
    twin = dataclasses.replace(field, regions=Regions(embeddings, pixels))
    alone = query_anchored(twin, embeddings[1], rules=QueryRules(duplicate_cosine=None))
    both = query_anchored(twin, embeddings[1])
    np.testing.assert_allclose(alone.similarity, shares(field, [1]), atol=1e-6)
    np.testing.assert_allclose(both.similarity, shares(field, [1, 4]), atol=1e-6)
    np.testing.assert_allclose(query_region(twin, 4).similarity, shares(field, [4]), atol=1e-6)
    pointed = query_region(twin, 4, rules=QueryRules(duplicate_cosine=0.9, fragment_score=None))
    np.testing.assert_allclose(pointed.similarity, both.similarity, atol=1e-6)
    unlike = query_anchored(twin, embeddings[1], rules=QueryRules(duplicate_cosine=1.5))
    np.testing.assert_allclose(unlike.similarity, alone.similarity, atol=1e-6)  # the anchor itself always counts


@pytest.mark.parametrize("by", ["votes", "code"])
@pytest.mark.parametrize("threshold", [-2.0, 0.0, 0.5])
def test_what_was_never_seen_is_never_selected(field, by, threshold):
    unseen = np.arange(64) % 2 == 0
    names = "labelled", "total", "views", "max_pixel_weight"
    gone = {name: np.where(unseen, 0, np.asarray(getattr(field.votes, name))) for name in names}
    gone["regions"] = np.where(unseen[:, None], -1, field.votes.regions)
    gone["weights"] = np.where(unseen[:, None], 0, field.votes.weights)
    votes = dataclasses.replace(field.votes, **gone)
    codes = dataclasses.replace(field.codes, gaussians=np.where(unseen[:, None], 0, field.codes.gaussians))
    hidden = dataclasses.replace(field, **({"codes": codes} if by == "code" else {"votes": votes}))
    assert not np.asarray(ask_region(hidden, 1, by, threshold).mask)[unseen].any()


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
    known = dataclasses.replace(plain, votes=_add_visible_weight(votes, plain.regions))
    text = jnp.eye(2, 8)[0]
    assert np.asarray(query_anchored(plain, text).mask).tolist() == [False, False, False]  # 4 of 10
    found = query_anchored(known, text)
    assert np.asarray(found.mask).tolist() == [True, False, False]
    np.testing.assert_allclose(found.similarity, [0.8, 0.2, 0], rtol=1e-6)
    np.testing.assert_allclose(query_several(known, text[None], rules=QueryRules()).similarity, found.similarity)
    both = query_several(known, jnp.eye(2, 8), rules=QueryRules())
    np.testing.assert_allclose(both.similarity, [0.45, 0.55, 0], rtol=1e-6)  # the views that show either


def test_numbers_that_are_not_finite_never_select(field):
    nan, inf = np.nan, np.inf
    codes = np.array(field.codes.gaussians)
    codes[0], codes[1], codes[2], codes[3] = nan, inf, 1e30 * codes[2], 1e-30 * codes[3]
    broken = dataclasses.replace(field, codes=dataclasses.replace(field.codes, gaussians=codes))
    for region in range(REGIONS):
        got, sound = ask_region(broken, region, "code"), ask_region(field, region, "code")
        assert not got.mask[:2].any()
        np.testing.assert_array_equal(got.mask[2:], sound.mask[2:])
    weights, total = np.array(field.votes.weights), np.array(field.votes.total)
    weights[0], total[1], weights[2], weights[3] = nan, nan, inf, weights[3] * 1e30
    total[3] *= 1e30
    labelled = np.array(field.votes.labelled)
    labelled[3] *= 1e30
    votes = dataclasses.replace(field.votes, weights=weights, total=total, labelled=labelled)
    broken = dataclasses.replace(field, votes=votes)
    for region in range(REGIONS):
        got, sound = query_region(broken, region), query_region(field, region)
        assert not got.mask[:3].any()
        np.testing.assert_array_equal(got.mask[3:], sound.mask[3:])
        np.testing.assert_allclose(got.similarity[3:], sound.similarity[3:], rtol=1e-5)


@pytest.mark.parametrize("by", ["votes", "code"])
def test_broken_texts_and_regions_select_nothing(field, by):
    for text in (np.zeros(12), np.full(12, np.nan), np.r_[np.inf, np.zeros(11)]):
        got = ask(field, text.astype(np.float32), by, QueryRules(min_score=-1.0))
        assert int(got.region) == -1
        assert not got.mask.any()
        assert float(got.score) == 0
    embeddings = np.array(field.regions.embeddings)
    text = embeddings[1].copy()
    embeddings[0], embeddings[1] = np.nan, 0  # neither can be retrieved
    lost = dataclasses.replace(field, regions=Regions(embeddings, field.regions.pixel_counts))
    got = ask(lost, text, by, QueryRules(min_score=-1.0))
    assert int(got.region) in (2, 3, 4)
    for value in (0.0, np.nan):
        table = np.array(field.codes.regions)
        table[1] = value
        lost = dataclasses.replace(field, codes=dataclasses.replace(field.codes, regions=table))
        assert not ask_region(lost, 1, "code", -1.0).mask.any()
    assert not ask_region(field, 1, by, np.nan).mask.any()


def test_a_field_without_regions_answers_nothing(field):
    columns = np.full((64, 0), -1, np.int32), np.zeros((64, 0), np.float32), *np.zeros((3, 64), np.float32)
    empty = dataclasses.replace(
        field,
        votes=Votes(*columns, np.ones(64, np.int32), np.int32(0), 0),
        regions=Regions(np.zeros((0, 12), np.float32), np.zeros((0, 4), np.int32)),
        codes=None,
    )
    for got in (query_anchored(empty, np.ones(12, np.float32)), query_region(empty, 0)):
        assert got.mask.shape == (64,)
        assert not got.mask.any()
        assert int(got.region) == -1
    assert region_at(empty, 0, 20, 20) == -1


def test_wrong_arguments_are_told(field):
    with pytest.raises(ValueError, match=r"12.*random"):
        query_anchored(field, np.ones(11, np.float32))
    for region in (1.5, np.asarray(1.0)):
        with pytest.raises(ValueError, match="an integer"):
            query_region(field, region)


def test_an_opaque_stack_stops_where_the_renderer_stops(field):
    """Eight opaque Gaussians behind one another, two at one depth: order, ties and the stop at T = 1e-4."""
    depths = np.array([0.3, 0.1, 0.1, 0.4, 0.2, 0.6, 0.5, 0.7], np.float32)
    towards = np.asarray(field.cameras.world_to_camera[0])[2, :3]
    chosen = jax.tree.map(lambda a: np.array(a)[:8], field.gaussians)
    chosen = dataclasses.replace(
        chosen,
        means=depths[:, None] * towards,
        log_scales=np.full((8, 3), -2.0, np.float32),
        opacity_logits=np.array([2, 3, 4, 5, 4, 6, 6, 5], np.float32),
    )
    expected = np.asarray(render(jax.tree.map(jnp.asarray, chosen), field.cameras[0], jnp.eye(8)).features)
    y, x = np.unravel_index(expected.sum(-1).argmax(), expected.shape[:2])
    regions = Regions(np.eye(8, dtype=np.float32), np.full((8, 1), 9))
    own = field_of(lone_votes(np.arange(8), 8), regions, gaussians=chosen)  # each Gaussian is a region of its own
    got = region_shares_seen(own, field.cameras[0], int(x), int(y))
    np.testing.assert_allclose(got, expected[y, x], atol=2e-6)
    assert (got > 0).sum() < 8


def test_the_region_under_a_pixel_is_the_labelled_one(field, made):
    """And shares of the regions there are the shares of votes rendered as features, the definition."""
    labels = made[1]
    dense = dataclasses.replace(field.votes, weights=vote_shares(field.votes)).dense()
    rendered = [np.asarray(render(field.gaussians, field.cameras[view], dense).features) for view in range(4)]
    agree = []
    for view, y, x in np.random.default_rng(0).permutation(np.argwhere(labels >= 0))[:40]:
        shares = region_shares_seen(field, field.cameras[int(view)], int(x), int(y))
        np.testing.assert_allclose(shares, rendered[view][y, x], atol=1e-5)
        found = region_at(field, int(view), int(x), int(y))
        assert found == (shares.argmax() if shares.max() >= 0.05 else -1)
        agree.append(found == labels[view, y, x])
    assert np.mean(agree) > 0.8
    assert (labels[0, 0, 0] == -1) == (region_at(field, 0, 0, 0) == -1)


@pytest.mark.parametrize(
    ("frame", "x", "y", "match"),
    [(4, 0, 0, "0 to 3"), (-1, 0, 0, "0 to 3"), (0, 48, 0, "0 to 47"), (0, 0, 40, "0 to 39"), (0, -1, 0, "0 to 47")],
)
def test_pixels_that_are_not_there_are_told(field, frame, x, y, match):
    with pytest.raises(InputError, match=match):
        region_at(field, frame, x, y)
