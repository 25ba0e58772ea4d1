"""The anchored query, by votes and by codes, against NumPy; the region under a pixel against a rendering."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY
from small_field import REGIONS, shares, unit_rows
from test_classes import made_field
from test_direct import exact_cosines

from jsecon.errors import InputError
from jsecon.field.evidence import region_votes
from jsecon.field.membership import normalise_votes, vote_shares
from jsecon.paper.queries import CODE_THRESHOLD, select_by_code
from jsecon.query.answer import (
    match_region,
    match_regions,
    query_anchored,
    query_region,
    query_several,
)
from jsecon.query.classes import query_classes
from jsecon.query.pointing import region_at
from jsecon.query.rules import QueryRules
from jsecon.splat.render import render
from jsecon.types import Codes, Regions


def by_code(field, region, threshold=CODE_THRESHOLD):
    return select_by_code(field, match_region(field, region), threshold)


def test_a_region_has_the_same_members_however_it_is_asked_for(made):
    """By text, by its number, by a pixel, by class, with all of its kind, and as one of several texts."""
    field, labels = made
    cast = region_votes(field.gaussians, field.cameras, jnp.asarray(labels), REGIONS, top=3, by_view=True)
    texts = np.eye(REGIONS, 12, dtype=np.float32)
    regions = Regions(texts, field.regions.pixel_counts)
    field = dataclasses.replace(field, regions=regions, votes=normalise_votes(cast, regions))
    under = {}
    for view, y, x in np.random.default_rng(0).permutation(np.argwhere(labels >= 0)):
        if len(under) < REGIONS and labels[view, y, x] not in under:
            found = region_at(field, int(view), int(x), int(y))
            under |= {found: query_region(field, found)} if found == labels[view, y, x] else {}
    classes, _ = query_classes(field, texts)
    votes_for = np.stack([shares(field, [r]) >= 0.5 for r in range(REGIONS)])
    assert set(under) == set(range(REGIONS))
    for region, text in enumerate(texts):
        found = query_anchored(field, text)
        expected = np.asarray(found.mask)
        assert int(found.region) == region
        np.testing.assert_array_equal(expected, votes_for[region])
        np.testing.assert_allclose(found.similarity, shares(field, [region]), atol=1e-6)
        near = by_code(field, region)
        cosine = np.nan_to_num(exact_cosines(field.codes.gaussians, field.codes.regions[region]))  # 0 of an unseen one
        np.testing.assert_allclose(near.similarity, cosine, atol=1e-6)
        np.testing.assert_array_equal(near.mask, cosine >= 0.9)
        assert 0 < expected.sum() < 40
        others = query_several(field, text[None], np.delete(texts, region, 0))
        for way, selection in {
            "number": query_region(field, region),
            "pixel": under[region],
            "all": query_several(field, text[None]),
            "one": query_several(field, text[None], rules=QueryRules()),
            "but not": others,
        }.items():
            np.testing.assert_array_equal(selection.mask, expected, err_msg=way)
        np.testing.assert_array_equal(query_classes(field, text[None])[0] == 0, expected)
        alone = votes_for.sum(0) <= 1  # what two regions have is of the class that it answers better
        np.testing.assert_array_equal((np.asarray(classes) == region)[alone], expected[alone])
        assert alone.mean() > 0.9


@pytest.mark.parametrize("count", [600, MANY])
def test_texts_together_select_by_votes_and_by_codes_as_float64(count):
    made, rng = made_field(count), np.random.default_rng(1)
    field = dataclasses.replace(
        made, codes=Codes(unit_rows(rng, count, 4), unit_rows(rng, made.regions.count, 4), None)
    )
    rules, asked = QueryRules(retrieval="cosine", duplicate_cosine=None, fragment_score=None), np.array([0, 3])

    @jax.jit
    @jax.vmap
    def similarities(text):
        coded = select_by_code(field, match_regions(field, text[None], rules), CODE_THRESHOLD)
        return query_anchored(field, text, rules=rules).similarity, coded.similarity

    for region, by_votes, coded in zip(asked, *similarities(field.regions.embeddings[asked])):
        np.testing.assert_allclose(by_votes, shares(field, [region]), atol=1e-6)
        np.testing.assert_allclose(coded, exact_cosines(field.codes.gaussians, field.codes.regions[region]), atol=1e-6)


def test_a_region_that_is_not_there_has_no_gaussians(field):
    for ask in (query_region, by_code):
        assert float(ask(field, 2).score) == 1
        for absent in (-1, REGIONS, 10_000, jnp.asarray(-1)):
            nothing = ask(field, absent)
            assert not nothing.mask.any()
            assert int(nothing.region) == -1
            assert float(nothing.score) == 0
    for region in (1.5, np.asarray(1.0)):
        with pytest.raises(ValueError, match="an integer"):
            query_region(field, region)


@pytest.mark.parametrize("retrieval", ["cosine", "contrast"])
def test_nothing_passes_a_min_score_that_no_region_reaches(field, retrieval):
    text = unit_rows(np.random.default_rng(9), 1, 12)[0]
    words = unit_rows(np.random.default_rng(10), 30, 12)
    worded = dataclasses.replace(field, unrelated_words=words)

    def best_of(least):
        return query_anchored(worded, text, rules=QueryRules(retrieval=retrieval, min_score=least, min_share=-1.0))

    best = float(best_of(-1.0).score)
    direction = text if retrieval == "cosine" else text - words.mean(0)
    assert np.abs(exact_cosines(field.regions.embeddings, direction) - best).min() < 1e-6
    assert int(best_of(best - 1e-4).region) >= 0
    nothing = best_of(best + 1e-4)
    assert int(nothing.region) == -1
    assert not nothing.mask.any()
    assert float(nothing.score) == pytest.approx(best, abs=1e-6)  # how close it was is still told


def test_the_region_under_a_pixel_is_the_labelled_one(field, made):
    """Its share is the largest of the shares of votes rendered as features, the definition."""
    labels = made[1]
    dense = dataclasses.replace(field.votes, weights=vote_shares(field.votes)).dense()
    rendered = [np.asarray(render(field.gaussians, field.cameras[view], dense).features) for view in range(4)]
    agree = []
    for view, y, x in np.random.default_rng(0).permutation(np.argwhere(labels >= 0))[:40]:
        shares = rendered[view][y, x]
        found = region_at(field, int(view), int(x), int(y))
        assert found == (shares.argmax() if shares.max() >= 0.05 else -1)
        agree.append(found == labels[view, y, x])
    assert np.mean(agree) > 0.8
    assert (labels[0, 0, 0] == -1) == (region_at(field, 0, 0, 0) == -1)


def test_broken_texts_and_regions_select_nothing(field):
    rules = QueryRules(min_score=-1.0)
    for text in (np.zeros(12), np.full(12, np.nan), np.r_[np.inf, np.zeros(11)]):
        got = query_anchored(field, text.astype(np.float32), rules=rules)
        assert int(got.region) == -1
        assert not got.mask.any()
        assert float(got.score) == 0
    with pytest.raises(ValueError, match=r"12.*random"):
        query_anchored(field, np.ones(11, np.float32))
    embeddings = np.array(field.regions.embeddings)
    text = embeddings[1].copy()
    embeddings[0], embeddings[1] = np.nan, 0  # neither can be retrieved
    lost = dataclasses.replace(field, regions=Regions(embeddings, field.regions.pixel_counts))
    assert int(query_anchored(lost, text, rules=rules).region) in (2, 3, 4)
    for value in (0.0, np.nan):
        table = np.array(field.codes.regions)
        table[1] = value
        lost = dataclasses.replace(field, codes=dataclasses.replace(field.codes, regions=table))
        assert not by_code(lost, 1, -1.0).mask.any()
    assert not query_region(field, 1, rules=QueryRules(min_share=np.nan)).mask.any()


@pytest.mark.parametrize(
    ("frame", "x", "y", "match"),
    [
        (4, 0, 0, "#0 to #3"),
        (-1, 0, 0, "#0 to #3"),
        (0, 48, 0, "0 to 47"),
        (0, 0, 40, "0 to 39"),
        (0, -1, 0, "0 to 47"),
    ],
)
def test_pixels_that_are_not_there_are_told(field, frame, x, y, match):
    with pytest.raises(InputError, match=match):
        region_at(field, frame, x, y)
    with pytest.raises(InputError, match="no such frame in the field"):
        region_at(dataclasses.replace(field, names=()), frame, x, y)
