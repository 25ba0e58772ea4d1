"""Parts of a scene and what of them answers a text, against NumPy."""

import dataclasses

import numpy as np
import pytest
from small_field import KnownTexts, field_of, lone_votes, unit_rows

from jsecon import QueryRules, Scene, query_anchored
from jsecon.query.match import MIN_REGION_RATIO, PART_SCORE, _part_scores, parts_fallback
from jsecon.query.outliers import best_cluster
from jsecon.types import Parts, Regions
from jsecon.vision.protocols import Logits


def made_parts(seed=0, count=200, parts=30, dim=16):
    rng = np.random.default_rng(seed)
    units = unit_rows(rng, parts, dim)
    units[3] = 0  # lies in no mask
    return Parts(rng.integers(-1, parts, count).astype(np.int32), units, rng.random(parts).astype(np.float32))


def scores_in_numpy(parts, text, words):
    units = parts.embeddings.astype(np.float64)
    known = units.any(1)
    direction = text / np.linalg.norm(text) - words.astype(np.float64).mean(0)
    cosine = units @ direction / np.maximum(np.linalg.norm(direction), 1e-30)
    middle, best = np.median(cosine[known]), cosine[known].max()
    scores = np.where(known, (cosine - middle) / (best - middle), 0)
    return np.where(parts.part >= 0, scores[np.maximum(parts.part, 0)], 0)


def test_part_scores_are_the_stated_ones():
    parts = made_parts()
    rng = np.random.default_rng(1)
    texts, words = unit_rows(rng, 3, 16), unit_rows(rng, 4, 16)
    for text in texts:
        scores = _part_scores(parts, text, words, retrieval="contrast")
        np.testing.assert_allclose(scores, scores_in_numpy(parts, text.astype(np.float64), words), atol=1e-4)
        assert float(np.max(scores)) == pytest.approx(1)
    plain = _part_scores(parts, texts[0], None, retrieval="contrast")
    np.testing.assert_allclose(plain, scores_in_numpy(parts, texts[0], np.zeros((1, 16))), atol=1e-4)
    for same in (np.ones((1, 16), np.float32) / 4, np.zeros((1, 16), np.float32)):  # all parts are equally near
        none = Parts(np.zeros(5, np.int32), same, np.ones(1, np.float32))
        np.testing.assert_array_equal(_part_scores(none, texts[0], None, retrieval="contrast"), np.zeros(5))


def test_the_best_cluster_stays_and_specks_do_not_rule():
    rng = np.random.default_rng(0)
    means = np.concatenate([c + 0.1 * rng.normal(size=(n, 3)) for c, n in ((0, 300), (5, 200), (9, 15))])
    scores = np.repeat([0.6, 0.55, 0.5], [300, 200, 15])
    kept = best_cluster(np.ones(515, bool), scores, means)
    assert kept[:300].mean() > 0.95
    assert not kept[300:].any()
    assert not best_cluster(np.zeros(515, bool), scores, means).any()
    few = np.arange(515) < 5
    np.testing.assert_array_equal(best_cluster(few, scores, means), few)
    means[0] = np.nan
    assert not best_cluster(np.ones(515, bool), scores, means)[0]


@pytest.fixture(scope="module")
def unheld():
    """A field whose regions show four of five things, parts that show all five, and the directions of the things: the
    Gaussians lie in five clusters far apart, a part each but the last, which has two."""
    rng = np.random.default_rng(3)
    directions = unit_rows(rng, 5, 12)
    thing = np.repeat(np.arange(5), 40)
    centres = np.array([[0, 0, 0], [20, 0, 0], [0, 20, 0], [0, 0, 20], [20, 20, 0]])
    means = (centres[thing] + 0.1 * rng.normal(size=(200, 3))).astype(np.float32)
    part = thing.astype(np.int32)
    part[-20:] = 5
    weight = np.array([30, 30, 30, 30, 20, 10], np.float32)
    embeddings = directions[[0, 1, 2, 3, 4, 4]] + 0.05 * rng.normal(size=(6, 12))
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    parts = Parts(part, embeddings.astype(np.float32), weight)
    votes = lone_votes(np.minimum(thing, 3), 4)  # the fifth thing is of the fourth region
    regions = Regions(directions[:4], np.full((4, 2), 500, np.int32))
    field = field_of(votes, regions, parts=parts, canonical_phrases=across(directions)[:1])
    gaussians = dataclasses.replace(field.gaussians, means=means)
    return dataclasses.replace(field, gaussians=gaussians), directions, thing


def across(directions):
    """Unit rows at right angles to all directions."""
    return np.linalg.svd(directions)[2][len(directions) :].astype(np.float32)


def pooled_in_numpy(field, mask, text):
    """The cosine of the Gaussians of `mask`, by the rule of `parts_fallback` written out."""
    parts, total = field.parts, np.zeros(len(text))
    for p in range(len(parts.weight)):
        own = parts.part == p
        total += parts.weight[p] * (mask & own).sum() / own.sum() * parts.embeddings[p].astype(np.float64)
    return total @ text / np.linalg.norm(total) / np.linalg.norm(text)


def test_the_parts_answer_what_no_region_holds(unheld):
    field, directions, thing = unheld
    text, score = directions[4], query_anchored(field, directions[4]).score
    selection = parts_fallback(field, text, score, QueryRules())
    np.testing.assert_array_equal(selection.mask, thing == 4)
    assert int(selection.region) == -1
    assert selection.presence is None
    expected = pooled_in_numpy(field, thing == 4, text.astype(np.float64))
    assert float(selection.score) == pytest.approx(expected, abs=1e-5)
    near = np.asarray(_part_scores(field.parts, text, None, retrieval="contrast"))
    on_scale = np.interp(near, [0, PART_SCORE, 1], [0, 0.5, 1])
    np.testing.assert_allclose(selection.similarity, on_scale, atol=1e-6)
    assert on_scale[thing != 4].max() < 0.5
    strict = parts_fallback(field, text, 0.0, QueryRules(min_share=0.999))
    assert 0 < np.asarray(strict.mask).sum() < (thing == 4).sum()  # the nearer of its two parts
    likely, unlikely = (QueryRules(logits=Logits(20.0, bias)) for bias in (-10.0, -40.0))
    assert parts_fallback(field, text, 0.0, likely).presence > 0.9
    good, never = MIN_REGION_RATIO * expected, np.full(200, -1, np.int32)
    assert parts_fallback(field, text, good - 1e-4, QueryRules()) is not None
    nowhere = dataclasses.replace(field, parts=dataclasses.replace(field.parts, part=never))
    for where, asked, least, rules in (
        (field, text, good + 1e-4, QueryRules()),  # a region that good holds it
        *((field, other, query_anchored(field, other).score, QueryRules()) for other in directions[:4]),
        (field, across(directions)[1], 0.0, QueryRules()),
        (nowhere, text, 0.0, QueryRules()),
        (field, text, 0.0, unlikely),
    ):
        assert parts_fallback(where, asked, least, rules) is None
    with pytest.raises(ValueError, match="--parts"):
        parts_fallback(dataclasses.replace(field, parts=None), text, 0.0, QueryRules())


def test_a_text_that_no_region_answers_is_answered_by_parts(unheld):
    field, directions, thing = unheld
    embedder = KnownTexts({"fifth": directions[4], "first": directions[0]})
    answer = Scene(field, embedder).ask("fifth")
    np.testing.assert_array_equal(answer.mask, thing == 4)
    assert "parts" in answer.skipped["regions"]
    plain = Scene(field, embedder).ask("first")
    np.testing.assert_array_equal(plain.mask, thing == 0)
    assert "regions" not in plain.skipped
    alone = Scene(dataclasses.replace(field, parts=None), embedder).ask("fifth")  # the region that it went to, whole
    np.testing.assert_array_equal(alone.mask, thing >= 3)
