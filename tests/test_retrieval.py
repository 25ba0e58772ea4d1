"""Which region answers a text: contrasts against NumPy in float64, and what they are for."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from small_field import field_of, make_field, unit_rows

from jsecon.app import cli
from jsecon.app.ask import ask_text
from jsecon.language.field import load_field, save_field
from jsecon.pipeline import networks
from jsecon.query.anchored import query_anchored
from jsecon.query.classes import query_classes
from jsecon.query.match import (
    CONTRAST_THRESHOLD,
    QUANTILE,
    RELATED,
    RETRIEVAL_THRESHOLD,
    contrasts as plain_contrasts,
    evidence,
)
from jsecon.query.several import query_several
from jsecon.query.similarity import similarities
from jsecon.types import Regions, Votes

SIZE = 12
contrasts = jax.jit(plain_contrasts)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def exact(embeddings, text, canonical, pixels):
    """The formula, for sound rows."""
    rows, weight = unit(embeddings.astype(np.float64)), pixels.sum(1).astype(np.float64)
    weight = weight if weight.sum() else np.ones(len(rows))
    apart = rows - len(rows) / (len(rows) + 1) * (weight @ rows) / weight.sum()
    across = unit(text.astype(np.float64))
    if len(canonical):
        cone = unit(unit(canonical.astype(np.float64)).sum(0))
        across = across - (across @ cone) * cone
    return unit(apart) @ unit(across)


@pytest.fixture
def parts():
    rng = np.random.default_rng(7)
    rows = unit_rows(rng, 7, SIZE), unit_rows(rng, 1, SIZE)[0], unit_rows(rng, 4, SIZE)
    return (*rows, rng.integers(0, 900, (7, 3)))


def test_equals_the_formula(parts):
    embeddings, text, canonical, pixels = parts
    got, known = contrasts(*parts)
    np.testing.assert_allclose(got, exact(*parts), atol=1e-6)
    np.testing.assert_allclose(got, plain_contrasts(*parts)[0], atol=1e-6)  # jit equals eager
    assert np.asarray(known).all()
    for phrases in (np.zeros((0, SIZE), np.float32), canonical[:1]):
        got, _ = contrasts(embeddings, text, phrases, pixels)
        np.testing.assert_allclose(got, exact(embeddings, text, phrases, pixels), atol=1e-6)
    got, _ = contrasts(embeddings, text, canonical, 0 * pixels)  # regions without pixels count alike
    np.testing.assert_allclose(got, exact(embeddings, text, canonical, 0 * pixels), atol=1e-6)


def test_of_a_single_region_without_phrases_it_is_the_cosine(parts):
    embeddings, text, _, pixels = parts
    got, _ = contrasts(embeddings[:1], text, np.zeros((0, SIZE), np.float32), pixels[:1])
    np.testing.assert_allclose(got, similarities(jnp.asarray(embeddings[:1]), jnp.asarray(text))[0], atol=1e-6)


@settings(deadline=None)
@given(seed=st.integers(0, 2**31), power=st.integers(-30, 30))
def test_lengths_do_not_count(seed, power):
    rng = np.random.default_rng(seed)
    embeddings, text, canonical = unit_rows(rng, 5, SIZE), unit_rows(rng, 1, SIZE)[0], unit_rows(rng, 4, SIZE)
    pixels, factor = rng.integers(0, 900, (5, 2)), np.float32(10.0**power)
    expected, _ = contrasts(embeddings, text, canonical, pixels)
    got, known = contrasts(embeddings * factor, text / factor, canonical * factor, pixels)
    assert np.asarray(known).all()
    np.testing.assert_allclose(got, expected, atol=2e-6)


def test_what_is_no_direction_is_left_out(parts):
    embeddings, text, canonical, pixels = parts
    rows = np.concatenate([embeddings, np.zeros((1, SIZE), np.float32), np.full((1, SIZE), np.nan, np.float32)])
    wider = np.concatenate([pixels, pixels[:2]])
    got, known = contrasts(rows, text, canonical, wider)
    np.testing.assert_array_equal(known, [True] * 7 + [False] * 2)
    np.testing.assert_allclose(got, np.append(exact(*parts), [0, 0]), atol=1e-6)
    phrases = np.concatenate([canonical, np.zeros((1, SIZE), np.float32), np.full((1, SIZE), np.inf, np.float32)])
    got, _ = contrasts(embeddings, text, phrases, pixels)
    np.testing.assert_allclose(got, exact(*parts), atol=1e-6)
    for bad in (np.zeros_like(text), np.full_like(text, np.nan), unit(unit(canonical).sum(0)).astype(np.float32)):
        got, known = contrasts(embeddings, bad, canonical, pixels)  # the last lies along the phrases' cone
        assert not np.asarray(known).any()
        np.testing.assert_array_equal(got, 0)
    got, known = contrasts(embeddings[:0], text, canonical, pixels[:0])
    assert got.shape == known.shape == (0,)


def test_regions_that_are_all_alike_are_all_as_near(parts):
    embeddings, text, canonical, pixels = parts
    same = np.repeat(embeddings[:1], 7, 0)
    got, known = contrasts(same, text, canonical, pixels)
    assert np.asarray(known).all()
    np.testing.assert_allclose(got, contrasts(same[:1], text, canonical, pixels[:1])[0][0], atol=1e-5)


def test_jit_and_vmap_over_texts_equal_the_loop_for_many_regions():
    rng = np.random.default_rng(3)
    embeddings, texts, canonical = unit_rows(rng, 400, SIZE), unit_rows(rng, 3, SIZE), unit_rows(rng, 4, SIZE)
    pixels = rng.integers(0, 900, (400, 2))
    together, known = jax.jit(jax.vmap(lambda text: contrasts(embeddings, text, canonical, pixels)))(texts)
    assert np.asarray(known).all()
    for got, text in zip(together, texts):
        np.testing.assert_allclose(got, contrasts(embeddings, text, canonical, pixels)[0], atol=1e-6)
        np.testing.assert_allclose(got, exact(embeddings, text, canonical, pixels), atol=5e-6)


def test_gradient_equals_central_differences(parts):
    embeddings, text, canonical, pixels = parts
    with jax.enable_x64(True):
        given = tuple(jnp.asarray(a, jnp.float64) for a in (embeddings, text, canonical))
        weights = jnp.asarray(np.random.default_rng(0).normal(size=7))

        def total(*given):
            return jnp.sum(weights * contrasts(*given, jnp.asarray(pixels))[0])

        for place, gradient in enumerate(jax.grad(total, (0, 1, 2))(*given)):
            step = np.random.default_rng(place).normal(size=given[place].shape) * 1e-6
            moved = [total(*(a + s * step if i == place else a for i, a in enumerate(given))) for s in (1, -1)]
            assert float(jnp.sum(gradient * step)) == pytest.approx(float(moved[0] - moved[1]) / 2, rel=1e-5)


def clip_like(rng, *, gap):
    """Eight objects' texts in a cone, the regions' embeddings across a gap from it with noise, and the phrases."""
    axes = np.linalg.qr(rng.normal(size=(SIZE * 8, SIZE * 8)))[0]
    texts = unit(axes[0] + 0.6 * axes[2:10])
    canonical = unit(axes[0] + 0.6 * axes[10:14])
    images = unit(texts + gap * axes[1] - 0.5 * axes[0] + 0.3 * rng.normal(size=(8, 1)) * axes[0])
    return (a.astype(np.float32) for a in (images, texts, canonical, unit(axes[0] + 0.6 * axes[14:22])))


def test_finds_across_a_gap_what_the_cosine_does_not():
    rng = np.random.default_rng(0)
    right = {"contrast": 0, "cosine": 0}
    passed = {"there": 0, "not there": 0}
    for _ in range(20):
        images, texts, canonical, absent = clip_like(rng, gap=2.0)
        pixels = rng.integers(100, 900, (8, 2))
        for k in range(8):
            got = np.asarray(contrasts(images, texts[k], canonical, pixels)[0])
            right["contrast"] += got.argmax() == k
            right["cosine"] += (images @ texts[k]).argmax() == k
            passed["there"] += got.max() >= CONTRAST_THRESHOLD
            passed["not there"] += (
                np.asarray(contrasts(images, absent[k], canonical, pixels)[0]).max() >= CONTRAST_THRESHOLD
            )
    assert right["contrast"] == 160 > 1.2 * right["cosine"]
    assert passed == {"there": 160, "not there": 0}


def test_a_query_finds_its_region_by_the_one_or_the_other(scene, cameras):
    field, _ = make_field(scene, cameras)
    images, texts, canonical, _ = clip_like(np.random.default_rng(2), gap=2.0)
    pixels = np.asarray(field.regions.pixels)
    clip = dataclasses.replace(field, regions=Regions(images[:5], pixels), canonical=canonical)
    differ = 0
    for text in texts[:5]:
        scores = {"cosine": images[:5] @ text, "contrast": exact(images[:5], text, canonical, pixels)}
        for retrieval, score in scores.items():
            got = query_anchored(clip, text, retrieval=retrieval)
            assert int(got.region) == score.argmax()
            assert float(got.score) == pytest.approx(score.max(), abs=1e-5)
        differ += scores["cosine"].argmax() != scores["contrast"].argmax()
    assert differ
    assert float(query_anchored(clip, texts[0]).score) == float(
        query_anchored(clip, texts[0], retrieval="contrast").score
    )
    low, high = (query_anchored(clip, -texts[0], retrieval="cosine", retrieval_threshold=t).region for t in (-1, None))
    assert int(low) >= 0 > int(high)  # without a threshold it is RETRIEVAL_THRESHOLD
    assert (images[:5] @ -texts[0]).max() < RETRIEVAL_THRESHOLD
    with pytest.raises(ValueError, match="contrast"):
        query_anchored(clip, texts[0], retrieval="nearest")


def test_evidence_is_of_views_and_counts_against_the_best_known_region():
    pixels = np.array([[400, 900, 0], [100, 100, 0], [0, 0, 0], [5000, 5000, 5000]])
    looks = np.array([2.0, 0.5, 0.0, 3.0])
    expected = looks / (looks + 2) / (3 / 5)
    np.testing.assert_allclose(evidence(jnp.asarray(pixels)), expected, rtol=1e-6)
    np.testing.assert_array_equal(evidence(jnp.zeros((3, 4), jnp.int32)), 1)
    np.testing.assert_array_equal(evidence(jnp.asarray([[7], [7]])), 1)  # one view: nothing to tell them apart by


def test_a_thing_that_fills_a_third_of_all_views_is_found_before_slivers_of_its_colour():
    """Kitchen fronts in light and shade, their embedding mixed; slivers that are purer; a wall and a floor."""
    rng = np.random.default_rng(2)
    red, dark, wall, floor = unit_rows(rng, 4, 64)
    fronts = unit(red + 0.5 * dark + 0.3 * wall)
    slivers = [unit(red + 0.12 * row) for row in unit_rows(rng, 3, 64)]
    embeddings = np.stack([fronts, wall, floor, *slivers]).astype(np.float32)
    views = 20
    pixels = np.zeros((6, views), np.int32)
    pixels[:3] = np.array([40_000, 50_000, 30_000])[:, None]
    for row, count in zip(pixels[3:], (2, 3, 4), strict=True):
        row[:count] = 700
    text, canonical = red.astype(np.float32), unit_rows(rng, 4, 64)
    plain, _ = contrasts(embeddings, text, canonical, pixels)
    assert int(jnp.argmax(plain)) > 2  # by the contrast alone a sliver wins
    votes = Votes(
        regions=np.arange(6, dtype=np.int32)[:, None],
        weights=np.ones((6, 1), np.float32),
        labelled=np.ones(6, np.float32),
        total=np.ones(6, np.float32),
        peak=np.ones(6, np.float32),
        views=np.full(6, 3, np.int32),
        overflow=np.zeros((), np.int32),
        num_regions=6,
    )
    field = dataclasses.replace(field_of(votes, Regions(embeddings, pixels)), canonical=canonical)
    one = query_anchored(field, jnp.asarray(text))
    assert int(one.region) == 0
    assert np.asarray(one.mask)[0]
    everything = np.asarray(query_several(field, jnp.asarray(text[None]), retrieval_threshold=0.2).mask)
    assert everything[0]
    assert everything[3:].any()
    assert not everything[1:3].any()


def exact_quantile(embeddings, text, words):
    """The share of words, without the tenth that is nearest to the text, that are less similar to their best region."""
    rows, words, text = (unit(np.asarray(a, np.float64)) for a in (embeddings, words, text))
    mean = words.mean(0)
    order = np.argsort(-(unit(words - mean) @ unit(text - mean)), kind="stable")[int(RELATED * len(words)) :]
    scores = (unit(words - mean) @ rows.T).max(1)[order]
    return np.mean(scores < (rows @ unit(text - mean)).max())


@pytest.fixture
def worded(scene, cameras):
    """A field of five regions with 61 unrelated words, and texts."""
    rng = np.random.default_rng(3)
    field, _ = make_field(scene, cameras)
    return dataclasses.replace(field, reference=unit_rows(rng, 61, SIZE)), unit_rows(rng, 200, SIZE)


def test_a_text_is_refused_by_its_quantile_among_unrelated_words(worded):
    field, texts = worded
    ask = lambda text: query_anchored(field, text)
    together = jax.jit(jax.vmap(ask))(texts[:40])
    for k, text in enumerate(texts[:40]):
        expected = exact_quantile(field.regions.embeddings, text, field.reference)
        found = ask(text)
        assert float(found.quantile) == pytest.approx(expected, abs=1e-6)
        assert (int(found.region) >= 0) == (expected >= QUANTILE)
        assert bool(found.mask.any()) <= (expected >= QUANTILE)
        assert float(together.quantile[k]) == pytest.approx(expected, abs=1e-6)
        np.testing.assert_array_equal(together.mask[k], found.mask)
        loose, strict = (query_anchored(field, text, quantile=q) for q in (expected - 1e-3, expected + 1e-3))
        assert int(loose.region) >= 0 > int(strict.region)
        assert float(query_several(field, text[None]).quantile) == pytest.approx(expected, abs=1e-6)
    assert int(query_anchored(field, texts[0], quantile=0.0).region) >= 0
    by_threshold = query_anchored(field, texts[0], retrieval_threshold=-1.0, quantile=1.0)
    assert int(by_threshold.region) >= 0  # a threshold that is given decides


def test_of_unrelated_texts_about_one_minus_the_quantile_is_answered(worded):
    field, texts = worded
    shares = np.asarray(jax.vmap(lambda text: query_anchored(field, text).quantile)(texts))
    for q in (0.5, 0.8, 0.9):
        assert np.mean(shares >= q) == pytest.approx(1 - q, abs=0.1)


def test_unrelated_words_that_tell_nothing_refuse_nothing_and_no_words_fall_back(worded):
    field, texts = worded
    tied = dataclasses.replace(field, reference=np.repeat(field.reference[:1], 9, 0))
    itself = query_anchored(tied, field.reference[0])  # of equal words none is less similar, and the text is no text
    assert float(itself.quantile) == 1 or np.isnan(float(itself.quantile))
    empty = dataclasses.replace(field, reference=field.reference[:0])
    old = dataclasses.replace(field, reference=None)
    for text in texts[:8]:
        contrast = query_anchored(field, text, retrieval="contrast", retrieval_threshold=CONTRAST_THRESHOLD)
        for bare in (empty, old):
            found = query_anchored(bare, text)
            assert np.isnan(float(found.quantile))
            assert float(found.score) == float(contrast.score)
            np.testing.assert_array_equal(found.mask, contrast.mask)
    nan = query_anchored(field, np.full(SIZE, np.nan, np.float32))
    assert int(nan.region) == -1
    assert np.isnan(float(nan.quantile))
    known = field.reference[7]
    assert float(query_anchored(field, known).quantile) == pytest.approx(
        exact_quantile(field.regions.embeddings, known, field.reference), abs=1e-6
    )
    one = dataclasses.replace(
        field_of(
            Votes(
                regions=np.zeros((4, 1), np.int32),
                weights=np.ones((4, 1), np.float32),
                labelled=np.ones(4, np.float32),
                total=np.ones(4, np.float32),
                peak=np.ones(4, np.float32),
                views=np.full(4, 3, np.int32),
                overflow=np.zeros((), np.int32),
                num_regions=1,
            ),
            Regions(field.reference[:1] * 0.5, np.full((1, 1), 900)),
        ),
        canonical=np.zeros((0, SIZE), np.float32),
        reference=field.reference,
    )
    assert float(query_anchored(one, field.reference[0]).quantile) == 1  # nothing is nearer to it than itself
    none = dataclasses.replace(one, regions=Regions(np.zeros((0, SIZE), np.float32), np.zeros((0, 1), np.int32)))
    assert int(query_anchored(none, texts[0]).region) == -1


def test_a_list_of_classes_is_compared_in_deviations_of_each_text(worded):
    field = worded[0]
    hub = unit(unit(np.asarray(field.regions.embeddings)).sum(0)).astype(np.float32)  # a little like every region
    names = np.stack([hub, *np.asarray(field.regions.embeddings)[:2]])
    words = np.asarray(field.reference, np.float64).mean(0)
    similar = unit(np.asarray(field.regions.embeddings, np.float64)) @ unit(names - words).T
    weight = np.asarray(evidence(field.regions.pixels), np.float64)[:, None]
    weight = weight / weight.sum()
    mean = (weight * similar).sum(0)
    table = (similar - mean) / np.sqrt((weight * (similar - mean) ** 2).sum(0))
    label, likeness = query_classes(field, names, quantile=0.0)
    shares = np.zeros((len(label), len(table)))
    votes = field.votes
    rows = np.repeat(np.arange(len(label)), votes.regions.shape[1])
    np.add.at(shares, (rows, np.asarray(votes.regions).ravel()), np.asarray(votes.weights).ravel())
    seen = shares.sum(1) > 0
    expected = shares[seen] @ table / shares[seen].sum(1, keepdims=True)
    np.testing.assert_allclose(np.asarray(likeness)[seen], expected, atol=1e-4)
    assert query_classes(field, names, quantile=1.0)[0].max() >= -1
    nothing = query_classes(field, np.zeros((2, SIZE), np.float32))
    assert (np.asarray(nothing[0]) == -1).all()


def test_the_command_line_says_the_quantile_and_what_an_old_field_lacks(worded, tmp_path, monkeypatch, capsys):
    field, texts = worded
    shares = [exact_quantile(field.regions.embeddings, text, field.reference) for text in texts]
    rows = {"seen": texts[int(np.argmax(shares))], "unseen": texts[int(np.argmin(shares))]}

    class Words:
        canonical = field.canonical
        embed_text = staticmethod(lambda asked: np.stack([rows[text] for text in asked]))

    monkeypatch.setattr(networks, "field_embedder", lambda *a, **k: Words())

    def asked(name, *options):
        assert cli.main(["query", str(tmp_path / name), "seen", "unseen", "--out", str(tmp_path), *options]) == 0
        told = [json.loads((tmp_path / f"{text}.json").read_text()) for text in ("seen", "unseen")]
        return told, capsys.readouterr().out

    save_field(tmp_path / "new.npz", dataclasses.replace(field, reference=field.reference.astype(np.float16)))
    assert np.asarray(load_field(tmp_path / "new.npz").reference).dtype == np.float16
    (seen, unseen), out = asked("new.npz")
    assert seen["quantile"] == pytest.approx(max(shares), abs=0.02)  # of words in float16
    assert unseen["quantile"] == pytest.approx(min(shares), abs=0.02)
    assert seen["region"] is not None
    assert unseen["region"] is None
    assert f"more similar than {int(100 * seen['quantile'])} % of unrelated words" in out
    assert "earlier version" not in out
    assert asked("new.npz", "--quantile", "0")[0][1]["region"] is not None
    beyond = ["query", str(tmp_path / "new.npz"), "seen", "--out", str(tmp_path), "--quantile", "1.5"]
    assert cli.main(beyond) == 2
    assert "--quantile" in capsys.readouterr().err

    save_field(tmp_path / "old.npz", dataclasses.replace(field, reference=None))
    (seen, unseen), out = asked("old.npz")
    assert seen["quantile"] is unseen["quantile"] is None
    assert out.count("earlier version") == 1
    contrast = query_anchored(dataclasses.replace(field, reference=None), rows["seen"])
    assert seen["score"] == pytest.approx(float(contrast.score), abs=1e-5)

    class Templated(Words):
        templates = ("a photo of a {}.",)
        reference = -np.asarray(field.reference)

    assert ask_text(field, Templated(), "seen").quantile != ask_text(field, Words(), "seen").quantile
