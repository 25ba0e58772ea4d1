"""Several regions and composite questions, against NumPy."""

import dataclasses

import jax
import numpy as np
import pytest
from small_field import KnownTexts, rows_of_a_kind, shares, unit_rows
from table_field import table_field

from jsecon import InputError, QueryRules, Regions, Scene
from jsecon.query.answer import query_several


@pytest.fixture(scope="module")
def field(field):
    return dataclasses.replace(field, regions=Regions(rows_of_a_kind(), field.regions.pixel_counts))


def test_unwanted_regions_are_left_out_unless_the_wanted_text_fits_them_better(field):
    wanted, other = field.regions.embeddings[:1], field.regions.embeddings[1:2]
    got = query_several(field, wanted, other)  # region 1 is nearer to the unwanted text, region 0 to the wanted one
    np.testing.assert_allclose(got.similarity, shares(field, [0]), atol=1e-6)
    same = query_several(field, wanted, wanted)
    assert int(same.region) == -1
    assert not same.mask.any()
    with pytest.raises(ValueError, match="match_regions"):
        query_several(field, np.zeros((1, 5), np.float32))
    both = query_several(field, field.regions.embeddings[3:5], rules=QueryRules())
    np.testing.assert_allclose(both.similarity, shares(field, [3, 4]), atol=1e-6)


def test_jit_and_vmap_over_texts_equal_the_loop(field):
    texts = unit_rows(np.random.default_rng(4), 5, 12)
    together = jax.jit(jax.vmap(lambda text: query_several(field, text[None], texts[:1])))(texts)
    for index, text in enumerate(texts):
        alone = query_several(field, text[None], texts[:1])
        np.testing.assert_array_equal(together.mask[index], alone.mask)
        assert int(together.region[index]) == int(alone.region)


def test_a_question_put_to_a_field(field):
    chair, stool = field.regions.embeddings[:2]
    phrases = unit_rows(np.random.default_rng(8), 4, 12)
    asked = Scene(field, KnownTexts({"chair": chair, "stool": stool}, canonical_phrases=phrases))
    but = asked.ask("chair but not stool", outliers=False)
    np.testing.assert_array_equal(but.mask, shares(field, [0]) >= 0.5)
    with pytest.raises(InputError, match="by votes"):
        asked.ask("chair but not stool", by="code")


SHADES = ("dark blue vase", "light blue kettle", "red mug", "dark green bottle", "white plate")


@pytest.fixture(scope="module")
def shades():
    """A table without anything of the typical blue, but with a dark and a light blue thing; its embedder."""
    places = ((-0.6, 0.0, 0.1), (0.6, 0.0, 0.1), (0.0, 0.6, 0.05), (0.0, -0.6, 0.1), (0.0, 0.0, 0.05))
    return table_field([(name, place, (0.05, 0.05, 0.05)) for name, place in zip(SHADES, places)])


@pytest.mark.parametrize(("text", "several", "things"), [
    ("blue", True, {0, 1}), ("Blue thing", True, {0, 1}), ("dark blue", True, {0}),
    ('"blue" but not "dark blue"', False, {1}), ('"white" or "light blue" but not "blue"', False, {4}),
    ("pink", True, set()), ("purple thing", True, set()),
])  # fmt: skip
def test_a_bare_colour_is_answered_by_its_shades(shades, text, several, things):
    field, embedder = shades
    scene = Scene(field, embedder)
    answer = scene.relate(text) if several else scene.ask(text)
    assert set(np.flatnonzero(answer.selection.mask) // 120) == things


def test_one_shade_answers_where_one_thing_is_asked_for_and_relations_count_them(shades):
    asked = Scene(*shades)
    best = int(asked.ask("blue").selection.region)
    assert best in (0, 1)
    assert set(np.flatnonzero(asked.ask("blue").selection.mask) // 120) == {best}
    assert asked.ask("how many blue things").count == 2
    assert [o.regions for o in asked.ask("the blue thing left of the red mug").objects] == [(0,)]
