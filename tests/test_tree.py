"""Parts and unions: other cuts of a field's tree, and texts that name parts."""

import dataclasses

import numpy as np
import pytest
from small_field import KnownTexts, colour_field, make_field, unit_rows

from jsecon import InputError, Regions
from jsecon.app.records import Region
from jsecon.app.scene import Scene
from jsecon.field.tree import cut_field, node_members, part_objects
from jsecon.query.expressions import split_part
from jsecon.query.parts import match_parts
from jsecon.query.rules import ABSENT, FOUND, QueryRules
from jsecon.vision.colours import ColourEmbedder

TREE = np.array([5, 5, 6, -1, -1, 6, -1, 9, 9, 0], np.int32)
"""Regions 0 to 4; 5 is 0 and 1, 6 is that and 2; 9 is a part of 0, and 7 and 8 are parts of 9."""
TEXTS = ("mug", "plate", "bowl", "box", "ball", "handle", "rim", "lid")


@pytest.fixture(scope="module")
def field(scene, cameras):
    field = make_field(scene, cameras, dim=32)[0]
    rows, of_region = unit_rows(np.random.default_rng(3), len(TEXTS), 32), np.asarray(field.votes.regions)[:, 0]
    place = np.cumsum(of_region == 0) % 4
    leaf = np.where(of_region == 0, np.array([0, 9, 8, 7])[place], of_region).astype(np.int32)
    pixels = np.asarray(field.regions.pixel_counts)
    words = unit_rows(np.random.default_rng(4), 60, 32)
    return dataclasses.replace(
        field,
        regions=Regions(rows[:5], pixels),
        tree=TREE,
        leaf=leaf,
        part_regions=Regions(rows[[5, 6]], np.stack([pixels[0] // 2, pixels[0] // 4])),
        part_nodes=np.array([9, 8], np.int32),
        unrelated_words=words,
        codes=None,
    )


@pytest.fixture(scope="module")
def scene_of_parts(field):
    rows = unit_rows(np.random.default_rng(3), len(TEXTS), 32)
    texts = dict(zip(TEXTS, rows)) | {"lid of the mug": rows[2]}
    return Scene(field, KnownTexts(texts, vocabulary=TEXTS[:5]))


def dense(votes, count):
    """(N, count) float64 weights of each region."""
    table = np.zeros((len(votes.regions), count + 1))
    for region, weight in zip(np.asarray(votes.regions).T, np.asarray(votes.weights, np.float64).T):
        np.add.at(table, (np.arange(len(table)), region), weight)
    return table[:, :count]


def test_votes_of_unions_are_the_sums_of_their_regions(field):
    plain = dense(field.votes, 5)
    for level, tops in ((1, [5, 5, 6, 3, 4]), (2, [6, 6, 6, 3, 4]), (9, [6, 6, 6, 3, 4])):
        cut = cut_field(field, level)
        expected = np.zeros((len(plain), len(TREE)))
        for region, top in enumerate(tops):
            expected[:, top] += plain[:, region]
        np.testing.assert_allclose(dense(cut.votes, len(TREE)), expected, rtol=1e-6)
        assert (np.diff(np.asarray(cut.votes.weights), axis=1) <= 0).all()  # strongest first
        pixels = np.zeros((len(TREE), field.regions.pixel_counts.shape[1]), int)
        np.add.at(pixels, tops, np.asarray(field.regions.pixel_counts))
        np.testing.assert_array_equal(cut.regions.pixel_counts, pixels)
        total = np.asarray(field.regions.pixel_counts).sum(1)[:, None] * np.asarray(field.regions.embeddings)
        mean = total[:3].sum(0) if level > 1 else total[:2].sum(0)
        row = np.asarray(cut.regions.embeddings)[6 if level > 1 else 5]
        np.testing.assert_allclose(row, mean / np.linalg.norm(mean), atol=1e-5)
    assert cut_field(field, 0) is field


def test_parts_take_the_votes_of_their_region_on_their_gaussians(field):
    cut, plain = cut_field(field, -1), dense(field.votes, 5)
    of_parts, leaf = dense(cut.votes, len(TREE)), np.asarray(field.leaf)
    for node, under in ((9, (7, 9)), (8, (8,)), (0, None)):
        inside = ~np.isin(leaf, (7, 8, 9)) if under is None else np.isin(leaf, under)
        np.testing.assert_allclose(of_parts[:, node], np.where(inside, plain[:, 0], 0.0), rtol=1e-6)
    np.testing.assert_allclose(of_parts[:, 1:5], plain[:, 1:5], rtol=1e-6)
    np.testing.assert_allclose(of_parts.sum(1), plain.sum(1), rtol=1e-6)
    np.testing.assert_array_equal(part_objects(field), [0, 0])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("handle of the red mug", ("handle", "red mug")),
        ("The lid of a pot?", ("lid", "pot")),
        ("the mug's handle", ("handle", "mug")),
        ("where is the handle of the red mug?", ("handle", "red mug")),
        ("handle of the mug or lid of the pot", None),
        ('"lid of the pot"', None),
    ],
)
def test_which_texts_name_a_part(text, named):
    assert split_part(text) == named


def test_a_text_names_a_part_of_a_thing(scene_of_parts, field):
    for text, node in (("the handle of the mug", 9), ("rim of the mug", 8), ("the mug's rim", 8)):
        answer = scene_of_parts.ask(text)
        np.testing.assert_array_equal(answer.mask, node_members(field.tree, field.leaf, node))
        assert answer.state == "found"
        assert answer.objects[0].regions == (node,)
    for text, node in (("handle", 9), ("rim", 8)):  # of any thing, as no thing is called so
        np.testing.assert_array_equal(scene_of_parts.ask(text).mask, node_members(field.tree, field.leaf, node))
    assert int(scene_of_parts.ask("mug").selection.region) == 0
    assert scene_of_parts.ask("lid").state != "found"
    assert scene_of_parts.ask("handle or rim").by == "votes"
    every = scene_of_parts.ask("the parts of the mug")
    assert {one.regions for one in every.objects} == {(9,), (8,)}
    name = scene_of_parts.ask("lid of the mug")  # no such part: the text is the name of a thing
    assert name.by == "votes"
    assert int(name.selection.region) == 2


def test_a_thing_that_a_text_may_name_stands_before_the_part_that_is_most_of_it(field):
    """ "Teddy" may match body and head for certain and the teddy hardly: it is the teddy still. "Ear" is the ear."""
    most, little = unit_rows(np.random.default_rng(3), len(TEXTS), 32)[5:7, None]  # three quarters of region 0; one
    for text, region, nodes in ((most, -1, [9]), (most, 1, [9]), (most, 0, []), (little, 0, [8])):
        found, state = match_parts(field, text, QueryRules(), unless=region)
        assert found.tolist() == nodes
        assert state == (FOUND if nodes else ABSENT)


def test_a_part_without_a_word_of_the_embedder_is_a_name(scene, cameras, field):
    """Of colours "handle" says nothing: "handle of the red mug" asks for red, as "red mug" does."""
    colours = Scene(
        dataclasses.replace(
            colour_field(scene, cameras),
            **{name: getattr(field, name) for name in ("tree", "leaf", "part_nodes")},
            part_regions=Regions(np.eye(2, ColourEmbedder().dim, dtype=np.float32), field.part_regions.pixel_counts),
        )
    )
    named, plain = colours.ask("handle of the red mug"), colours.ask("red mug")
    assert plain.mask.any()
    np.testing.assert_array_equal(named.mask, plain.mask)


@pytest.mark.parametrize("node", [6, 9, 7])
def test_a_node_of_the_tree_selects_the_gaussians_under_it(scene_of_parts, field, node):
    """A union, a part, and a part of that."""
    answer = scene_of_parts.ask(Region(node))
    np.testing.assert_array_equal(answer.selection.mask, node_members(field.tree, field.leaf, node))
    assert (answer.count, answer.as_dict()["region"]) == (1, node)
    assert len(scene_of_parts.best_frames(answer, 1)) == 1
    assert "there is no region 10" in str(scene_of_parts.ask(Region(10)))


def test_levels_are_scenes_of_the_same_gaussians(scene_of_parts, field):
    assert scene_of_parts.at_level(0) is scene_of_parts
    union = scene_of_parts.at_level(1)
    both = union.ask(Region(5)).mask
    parts = [scene_of_parts.ask(Region(region)).mask for region in (0, 1)]
    assert (both & (parts[0] | parts[1])).sum() >= 0.95 * (parts[0] | parts[1]).sum()
    assert len(union.objects()) <= len(scene_of_parts.objects())
    with pytest.raises(InputError, match="level"):
        scene_of_parts.at_level(-2)
    flat = Scene(dataclasses.replace(field, tree=None, leaf=None, part_regions=None, part_nodes=None))
    with pytest.raises(InputError, match="no tree"):
        flat.at_level(1)
