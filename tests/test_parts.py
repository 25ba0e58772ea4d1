"""Parts of a scene and what of them answers a text, against NumPy."""

import dataclasses

import jax
import numpy as np
import pytest
from small_field import field_of, make_field, unit_rows

from jsecon.app.ask import ask_each, ask_text
from jsecon.language import field as field_file
from jsecon.language.field import load_field, save_field
from jsecon.query.anchored import query_anchored
from jsecon.query.parts import HELD, THING, answering_parts, part_nearness, parts_instead, query_parts
from jsecon.types import Parts, Regions, Votes
from jsecon.vision.protocols import Logits


def made_parts(seed=0, count=200, parts=30, dim=16):
    rng = np.random.default_rng(seed)
    units = unit_rows(rng, parts, dim)
    units[3] = 0  # lies in no mask
    return Parts(rng.integers(-1, parts, count).astype(np.int32), units, rng.random(parts).astype(np.float32))


def nearness_in_numpy(parts, text, canonical):
    units, weight = parts.embeddings.astype(np.float64), parts.weight.astype(np.float64)
    known = units.any(1)
    cone = canonical.astype(np.float64).mean(0)
    cone /= np.linalg.norm(cone)
    across = text / np.linalg.norm(text)
    across = across - (across @ cone) * cone
    mean = known.sum() / (known.sum() + 1) * (weight[known, None] * units[known]).sum(0) / weight[known].sum()
    apart = units - mean
    cosine = apart @ across / np.maximum(np.linalg.norm(apart, axis=1) * np.linalg.norm(across), 1e-30)
    middle, best = np.median(cosine[known]), cosine[known].max()
    near = np.where(known, (cosine - middle) / (best - middle), 0)
    return np.where(parts.part >= 0, near[np.maximum(parts.part, 0)], 0)


def test_nearness_is_the_stated_one_compiled_and_over_many_texts():
    parts = made_parts()
    rng = np.random.default_rng(1)
    texts, canonical = unit_rows(rng, 3, 16), unit_rows(rng, 4, 16)
    many = jax.vmap(part_nearness, (None, 0, None))(parts, texts, canonical)
    for text, row in zip(texts, many):
        expected = nearness_in_numpy(parts, text.astype(np.float64), canonical)
        np.testing.assert_allclose(row, expected, atol=1e-4)
        np.testing.assert_allclose(part_nearness(parts, text, canonical), row, atol=1e-5)
    assert float(np.max(many)) == pytest.approx(1)


def test_parts_that_are_all_equally_near_answer_nothing():
    parts = Parts(np.zeros(4, np.int32), np.ones((1, 3), np.float32) / 3**0.5, np.ones(1, np.float32))
    near = part_nearness(parts, np.array([1, 0, 0], np.float32), np.zeros((0, 3), np.float32))
    np.testing.assert_array_equal(near, np.zeros(4))


def test_a_scene_whose_parts_lie_in_no_mask():
    bare = Parts(np.zeros(5, np.int32), np.zeros((1, 2), np.float32), np.zeros(1, np.float32))
    near = part_nearness(bare, np.ones(2, np.float32), np.zeros((0, 2), np.float32))
    np.testing.assert_array_equal(near, np.zeros(5))


def test_a_neighbour_of_the_same_region_is_left_out_and_a_second_thing_stays():
    """Four blobs of one selection: the thing (near 1), its neighbour (0.6), a second one of the kind (0.8), and what
    touches the thing without answering (0.2)."""
    rng = np.random.default_rng(0)
    centres = np.array([[0, 0, 0], [3, 0, 0], [9, 0, 0], [0.3, 0, 0]])
    means = np.concatenate([c + 0.1 * rng.normal(size=(200, 3)) for c in centres]).astype(np.float32)
    nearness = np.repeat([1.0, 0.6, 0.8, 0.2], 200).astype(np.float32)
    kept = answering_parts(np.ones(800, bool), nearness, means)
    share = kept.reshape(4, 200).mean(1)
    assert share[0] > 0.95
    assert share[2] > 0.95
    np.testing.assert_array_equal(share[[1, 3]], 0)


def test_the_nearest_cluster_stays_even_where_none_is_near_and_specks_do_not_rule():
    rng = np.random.default_rng(0)
    means = np.concatenate([c + 0.1 * rng.normal(size=(n, 3)) for c, n in ((0, 300), (5, 200), (9, 15))])
    nearness = np.repeat([0.6, 0.55, 0.7], [300, 200, 15])
    kept = answering_parts(np.ones(515, bool), nearness, means)
    assert kept[:300].mean() > 0.95
    assert not kept[300:500].any()
    assert not answering_parts(np.zeros(515, bool), nearness, means).any()
    few = np.arange(515) < 5
    np.testing.assert_array_equal(answering_parts(few, nearness, means), few)
    means[0] = np.nan
    assert not answering_parts(np.ones(515, bool), nearness, means)[0]


class Embedder:
    def __init__(self, rows):
        self.rows = rows

    def embed_text(self, texts):
        return np.stack([self.rows[text] for text in texts])


def test_all_that_answers_leaves_out_parts_that_do_not(scene, cameras):
    """Of the Gaussians of a region, half lie in a part that looks like another region."""
    field, _ = make_field(scene, cameras)
    rows = np.asarray(field.regions.embeddings)
    embedder = Embedder({"it": rows[0], "other": rows[1]})
    before = ask_text(field, embedder, "it", several=True, outliers=False)
    members = np.flatnonzero(before.mask)
    half = members[np.asarray(field.gaussians.means)[members, 0] > np.median(field.gaussians.means[members, 0])]
    part = np.full(scene.count, 1, np.int32)
    part[members], part[half] = 0, 2
    parts = Parts(part, rows[[0, 1, 2]], np.ones(3, np.float32))
    with_parts = dataclasses.replace(field, parts=parts)
    after = ask_text(with_parts, embedder, "it", several=True, outliers=False)
    assert after.mask.any()
    assert not after.mask[half].any()
    assert (np.asarray(after.selection.similarity)[half] <= 0.25).all()
    np.testing.assert_array_equal(ask_text(with_parts, embedder, "it", outliers=False).mask, before.mask)
    with pytest.raises(ValueError, match="--parts"):
        query_parts(field, before.selection, rows[:1])


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
    embeddings = unit_rows_near(directions[[0, 1, 2, 3, 4, 4]], rng)
    field = dataclasses.replace(field_of_rows_of(means, thing, directions[:4]), canonical=across(directions)[:1])
    return dataclasses.replace(field, parts=Parts(part, embeddings, weight)), directions, thing


def unit_rows_near(rows, rng):
    rows = rows + 0.05 * rng.normal(size=rows.shape)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def field_of_rows_of(means, thing, embeddings):
    """Votes give each Gaussian the region of its thing, and the fifth thing to the fourth region."""
    count, regions = len(means), len(embeddings)
    own = np.minimum(thing, regions - 1).astype(np.int32)[:, None]
    one = np.ones(count, np.float32)
    votes = Votes(own, one[:, None], one, one, one, np.ones(count, np.int32), np.zeros((), np.int32), regions)
    field = field_of(votes, Regions(embeddings, np.full((regions, 2), 500, np.int32)))
    return dataclasses.replace(field, gaussians=dataclasses.replace(field.gaussians, means=means))


def across(directions):
    """Unit rows at right angles to all directions."""
    return np.linalg.svd(directions)[2][len(directions) :].astype(np.float32)


def pooled_in_numpy(field, mask, text):
    """The contrast of the Gaussians of `mask`, by the rule of `parts_instead` written out."""
    parts, total = field.parts, np.zeros(len(text))
    for p in range(len(parts.weight)):
        own = parts.part == p
        total += parts.weight[p] * (mask & own).sum() / own.sum() * parts.embeddings[p].astype(np.float64)
    rows = np.concatenate([parts.embeddings, (total / np.linalg.norm(total))[None]]).astype(np.float64)
    mean = len(rows) / (len(rows) + 1) * (parts.weight[:, None] * rows[:-1]).sum(0) / parts.weight.sum()
    apart = rows[-1] - mean
    return apart @ text / np.linalg.norm(apart) / np.linalg.norm(text)


def test_the_parts_answer_what_no_region_holds(unheld):
    field, directions, thing = unheld
    text, score = directions[4], query_anchored(field, directions[4]).score
    found = parts_instead(field, text, score)
    selection = found.selection
    np.testing.assert_array_equal(selection.mask, thing == 4)
    assert int(selection.region) == -1
    assert found.there is None
    expected = pooled_in_numpy(field, thing == 4, text.astype(np.float64))
    assert float(selection.score) == pytest.approx(expected, abs=1e-5)
    near = np.asarray(part_nearness(field.parts, text, field.canonical))
    on_scale = np.interp(near, [0, THING, 1], [0, 0.5, 1])
    np.testing.assert_allclose(selection.similarity, on_scale, atol=1e-6)
    assert on_scale[thing != 4].max() < 0.5
    assert parts_instead(field, text, HELD * expected + 1e-4) is None  # a region that good holds it
    assert parts_instead(field, text, HELD * expected - 1e-4) is not None


def test_they_are_silent_where_a_region_answers_or_nothing_does(unheld):
    field, directions, _ = unheld
    for text in directions[:4]:
        assert parts_instead(field, text, query_anchored(field, text).score) is None
    assert parts_instead(field, across(directions)[1], 0.0) is None
    never = dataclasses.replace(field, parts=dataclasses.replace(field.parts, part=np.full(200, -1, np.int32)))
    assert parts_instead(never, directions[4], 0.0) is None
    with pytest.raises(ValueError, match="--parts"):
        parts_instead(dataclasses.replace(field, parts=None), directions[4], 0.0)


def test_a_higher_threshold_takes_fewer_and_a_probability_decides_where_there_is_one(unheld):
    field, directions, thing = unheld
    text = directions[4]
    strict = parts_instead(field, text, 0.0, similarity_threshold=0.999)
    assert 0 < np.asarray(strict.selection.mask).sum() < (thing == 4).sum()  # the nearer of its two parts
    likely, unlikely = Logits(20.0, -10.0), Logits(20.0, -40.0)
    assert parts_instead(field, text, 0.0, logits=likely).there > 0.9
    assert parts_instead(field, text, 0.0, logits=unlikely) is None


def test_a_text_that_no_region_answers_is_answered_by_parts_in_memory_and_in_blocks(unheld, tmp_path, monkeypatch):
    field, directions, thing = unheld
    embedder = Embedder({"fifth": directions[4], "first": directions[0]})
    answer = ask_text(field, embedder, "fifth")
    np.testing.assert_array_equal(answer.mask, thing == 4)
    assert "parts" in answer.skipped["regions"]
    np.testing.assert_array_equal(ask_text(field, embedder, "fifth", by="silhouette").selection.region, -1)
    plain = ask_text(field, embedder, "first")
    np.testing.assert_array_equal(plain.mask, thing == 0)
    assert "regions" not in plain.skipped
    alone = ask_text(dataclasses.replace(field, parts=None), embedder, "fifth")  # the region that it went to, whole
    np.testing.assert_array_equal(alone.mask, thing >= 3)
    save_field(tmp_path / "field.safetensors", field)
    monkeypatch.setattr(field_file, "MAPPED", 0)
    mapped = load_field(tmp_path / "field.safetensors", mapped=True)
    (found, first), refused = ask_each(mapped, embedder, texts=["fifth", "first"])
    assert not refused
    np.testing.assert_array_equal(np.sort(found.rows[found.mask]), np.flatnonzero(thing == 4))
    assert found.skipped == answer.skipped
    assert float(found.selection.score) == float(answer.selection.score)
    np.testing.assert_array_equal(np.sort(first.rows[first.mask]), np.flatnonzero(thing == 0))
