"""Which region matches a text: similarities against NumPy in float64, evidence, and refusal."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY
from jax.test_util import check_grads
from small_field import KnownTexts, unit_rows

from jsecon import Regions, Scene, query_anchored, query_classes, query_region, query_several
from jsecon.field.similarity import similarities
from jsecon.query.match import compare_words, region_similarities, view_count_weight
from jsecon.query.rules import ABSENT, FOUND, FOUND_MARGIN, MIN_COSINE, MIN_MARGIN, UNSURE, QueryRules

SIZE = 12


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def exact(embeddings, text, words):
    """The formula by "contrast", for finite rows."""
    direction = unit(text.astype(np.float64)) - unit(words.astype(np.float64)).mean(0)
    return unit(embeddings.astype(np.float64)) @ unit(direction)


@pytest.fixture
def rows():
    """Embeddings of seven regions, a text, five words."""
    rng = np.random.default_rng(7)
    return unit_rows(rng, 7, SIZE), unit_rows(rng, 1, SIZE)[0], unit_rows(rng, 5, SIZE)


def test_equals_the_formula_and_rows_without_a_direction_are_unknown(rows):
    embeddings, text, words = rows
    plain = similarities(embeddings, text)[0]
    np.testing.assert_allclose(plain, similarities(jnp.asarray(embeddings), jnp.asarray(text))[0], atol=1e-6)
    np.testing.assert_array_equal(region_similarities(*rows, "cosine")[0], plain)
    np.testing.assert_array_equal(region_similarities(embeddings, text, None, "contrast")[0], plain)
    np.testing.assert_allclose(compare_words(embeddings, words, "cosine").similarity, words @ embeddings.T, atol=1e-6)
    more = np.concatenate([embeddings, np.zeros((1, SIZE), np.float32), np.full((1, SIZE), np.nan, np.float32)])
    got, known = region_similarities(more, text, words, "contrast")
    np.testing.assert_array_equal(known, [True] * 7 + [False] * 2)
    np.testing.assert_allclose(got, np.append(exact(*rows), [0, 0]), atol=1e-6)
    got, known = region_similarities(embeddings, np.full_like(text, np.nan), words, "contrast")
    assert not np.asarray(known).any()
    np.testing.assert_array_equal(got, 0)
    got, known = region_similarities(embeddings[:0], text, words, "contrast")
    assert got.shape == known.shape == (0,)


@pytest.mark.parametrize("count", [7, MANY])
def test_texts_together_have_the_similarities_of_float64(count):
    embeddings, texts, words = (unit_rows(np.random.default_rng(3), n, SIZE) for n in (count, 3, 4))
    found, known = jax.jit(jax.vmap(lambda text: region_similarities(embeddings, text, words, "contrast")))(texts)
    assert np.asarray(known).all()
    np.testing.assert_allclose(found, [exact(embeddings, text, words) for text in texts], atol=5e-6)


def test_gradient_equals_central_differences(rows, x64):
    given = tuple(jnp.asarray(a, jnp.float64) for a in rows)
    similar = jax.jit(lambda *given: region_similarities(*given, "contrast")[0])
    check_grads(similar, given, order=1, modes=["rev"], rtol=1e-5, atol=0, eps=1e-6)


def test_a_query_finds_its_region_by_the_one_or_the_other(worded):
    field, texts = worded
    embeddings, differ = field.regions.embeddings, 0
    like_one = unit(np.asarray(field.unrelated_words) + 2 * embeddings[0]).astype(np.float32)
    field = dataclasses.replace(field, unrelated_words=like_one)
    for text in texts[:10]:
        weight = np.asarray(view_count_weight(field.regions.pixel_counts))
        scores = {"cosine": embeddings @ text, "contrast": exact(embeddings, text, field.unrelated_words)}
        ranked = {
            "cosine": scores["cosine"],
            "contrast": np.where(scores["contrast"] > 0, weight, 1) * scores["contrast"],
        }
        for retrieval, score in scores.items():
            got = query_anchored(field, text, rules=QueryRules(retrieval=retrieval, min_rank=0.0))
            best = ranked[retrieval].argmax()
            assert int(got.region) == best
            assert float(got.score) == pytest.approx(score[best], abs=1e-5)
        differ += ranked["cosine"].argmax() != ranked["contrast"].argmax()
    assert differ
    with pytest.raises(ValueError, match="contrast"):
        QueryRules(retrieval="nearest")


def test_evidence_is_of_views_and_counts_against_the_best_known_region():
    pixels = np.array([[400, 900, 0], [100, 100, 0], [0, 0, 0], [5000, 5000, 5000]])
    looks = np.array([2.0, 0.5, 0.0, 3.0])
    expected = looks / (looks + 2) / (3 / 5)
    np.testing.assert_allclose(view_count_weight(jnp.asarray(pixels)), expected, rtol=1e-6)
    np.testing.assert_array_equal(view_count_weight(jnp.zeros((3, 4), jnp.int32)), 1)
    np.testing.assert_array_equal(view_count_weight(jnp.asarray([[7], [7]])), 1)  # one view: no difference


def exact_standing(embeddings, text, words, weight):
    """The share of words, without the tenth that is nearest to the text, that are less similar to their best region;
    and the margin of the text among the words by regions of some weights."""
    rows, words, text = (unit(np.asarray(a, np.float64)) for a in (embeddings, words, text))
    mean = words.mean(0)
    order = np.argsort(-(unit(words - mean) @ unit(text - mean)), kind="stable")[int(0.1 * len(words)) :]
    table = np.concatenate([unit(text - mean)[None], unit(words - mean)[order]]) @ rows.T
    best = np.where(table > 0, table * weight, table).argmax(1)
    heights = table[np.arange(len(table)), best] - table @ weight / weight.sum()
    largest = table.max(1)
    of_both = ((1, largest), (0.5, heights))
    margin = max(share * (of_all[0] - of_all[1:].mean()) / of_all[1:].std() for share, of_all in of_both)
    return np.mean(largest[1:] < largest[0]), margin


@pytest.fixture
def worded(field):
    """A field of five regions with 61 unrelated words, and texts."""
    rng = np.random.default_rng(3)
    return dataclasses.replace(field, unrelated_words=unit_rows(rng, 61, SIZE)), unit_rows(rng, 200, SIZE)


def test_a_text_is_found_unsure_or_absent_by_its_margin_among_unrelated_words(worded):
    field, texts = worded
    weight = np.asarray(view_count_weight(field.regions.pixel_counts), np.float64)

    def ask(text):
        return query_anchored(field, text)

    seen = set()
    asked = np.concatenate([texts[:20], field.regions.embeddings[:3]])
    together = jax.jit(jax.vmap(ask))(asked)
    for k, text in enumerate(asked):
        expected, margin = exact_standing(field.regions.embeddings, text, field.unrelated_words, weight)
        state = int(margin >= MIN_MARGIN) + int(margin >= FOUND_MARGIN)
        seen.add(state)
        found = ask(text)
        assert float(found.rank) == pytest.approx(expected, abs=1e-6)
        assert int(found.state) == int(together.state[k]) == state
        assert (int(found.region) >= 0) == (state > ABSENT)
        assert bool(found.mask.any()) <= (state > ABSENT)
        assert float(together.rank[k]) == pytest.approx(expected, abs=1e-6)
        np.testing.assert_array_equal(together.mask[k], found.mask)
        loose, strict = (
            query_anchored(field, text, rules=QueryRules(min_rank=q)) for q in (expected - 1e-3, expected + 1e-3)
        )
        assert int(loose.region) >= 0 > int(strict.region)
        assert int(loose.state) == max(state, UNSURE)
        assert float(query_several(field, text[None]).rank) == pytest.approx(expected, abs=1e-6)
    assert seen == {ABSENT, UNSURE, FOUND}
    answer = Scene(field, KnownTexts({"seen": text})).ask("seen").as_dict()
    assert answer["rank"] == pytest.approx(expected, abs=1e-5)
    assert int(query_anchored(field, texts[0], rules=QueryRules(min_rank=0.0)).region) >= 0
    by_threshold = query_anchored(field, texts[0], rules=QueryRules(min_score=-1.0, min_rank=1.0))
    assert int(by_threshold.region) >= 0  # a threshold that is given decides


def test_unrelated_words_that_tell_nothing_refuse_nothing_and_no_words_fall_back(worded):
    field, texts = worded
    tied = dataclasses.replace(field, unrelated_words=np.repeat(field.unrelated_words[:1], 9, 0))
    itself = query_anchored(tied, field.unrelated_words[0])  # no word is less similar
    assert float(itself.rank) == 1 or np.isnan(float(itself.rank))
    empty = dataclasses.replace(field, unrelated_words=field.unrelated_words[:0])
    old = dataclasses.replace(field, unrelated_words=None)
    for text in texts[:8]:
        cosine = query_anchored(field, text, rules=QueryRules(retrieval="cosine", min_score=MIN_COSINE))
        for bare in (empty, old):
            found = query_anchored(bare, text)
            assert np.isnan(float(found.rank))
            assert float(found.score) == float(cosine.score)
            np.testing.assert_array_equal(found.mask, cosine.mask)
    assert Scene(old, KnownTexts({"seen": text})).ask("seen").as_dict()["rank"] is None
    nan = query_anchored(field, np.full(SIZE, np.nan, np.float32))
    assert int(nan.region) == -1
    assert np.isnan(float(nan.rank))
    none = dataclasses.replace(field, regions=Regions(np.zeros((0, SIZE), np.float32), np.zeros((0, 1), np.int32)))
    for nothing in (query_anchored(none, texts[0]), query_region(none, 0)):
        assert not nothing.mask.any()
        assert int(nothing.region) == -1


def test_a_list_of_classes_is_compared_in_deviations_of_each_text(worded):
    field = worded[0]
    hub = unit(unit(np.asarray(field.regions.embeddings)).sum(0)).astype(np.float32)  # a little like every region
    names = np.stack([hub, *np.asarray(field.regions.embeddings)[:2]])
    words = np.asarray(field.unrelated_words, np.float64).mean(0)
    similar = unit(np.asarray(field.regions.embeddings, np.float64)) @ unit(names - words).T
    weight = np.asarray(view_count_weight(field.regions.pixel_counts), np.float64)[:, None]
    weight = weight / weight.sum()
    mean = (weight * similar).sum(0)
    table = (similar - mean) / np.sqrt((weight * (similar - mean) ** 2).sum(0))
    label, likeness = query_classes(field, names, rules=QueryRules(min_rank=0.0))
    shares = np.zeros((len(label), len(table)))
    votes = field.votes
    rows = np.repeat(np.arange(len(label)), votes.regions.shape[1])
    np.add.at(shares, (rows, np.asarray(votes.regions).ravel()), np.asarray(votes.weights).ravel())
    seen = shares.sum(1) > 0
    expected = shares[seen] @ table / shares[seen].sum(1, keepdims=True)
    np.testing.assert_allclose(np.asarray(likeness)[seen], expected, atol=1e-4)
    nothing = query_classes(field, np.zeros((2, SIZE), np.float32))
    assert (np.asarray(nothing[0]) == -1).all()
