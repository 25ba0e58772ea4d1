"""Answers that rest on evidence: what a wall hides, what no view saw, pieces that stand apart, shades of a colour."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cameras_of, gaussians_at, look_at
from small_field import field_of, lone_votes

import jsecon
from jsecon import Regions, normalise_votes, save_field
from jsecon.app import cli
from jsecon.vision.colours import PALETTE, ColourEmbedder
from jsecon.vision.unrelated_words import embed_unrelated_words

FRIDGE, WALL, SOFA = 0, 1, 2
COLOURS = ColourEmbedder()


def sheet(x, half, step, thing):
    """Means of a square of Gaussians across the x axis, and what they are of."""
    y, z = np.meshgrid(*[np.arange(-half, half + step / 2, step)] * 2)
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], 1), np.full(y.size, thing)


@pytest.fixture(scope="module")
def two_rooms():
    """A fridge before a wall, a sofa behind it in the next room; three cameras in each room see that room alone, but
    for what the wall lets through."""
    sheets = [sheet(-0.3, 0.3, 0.1, FRIDGE), sheet(0.0, 0.8, 0.1, WALL), sheet(0.3, 0.3, 0.1, SOFA)]
    means, thing = (np.concatenate(column) for column in zip(*sheets))
    scene = gaussians_at(means, 0.05, logit=2.5)  # the sheets overlap: about a hundredth passes
    sides = [(-2.0, y, 0.1) for y in (-0.3, 0.0, 0.3)] + [(2.0, y, 0.1) for y in (-0.3, 0.0, 0.3)]
    cameras = cameras_of([look_at(eye) for eye in sides], (40, 40, 16, 16), 32, 32)
    one_hot = jnp.asarray(np.eye(3, dtype=np.float32)[thing])
    images = [np.asarray(jsecon.render(scene, cameras[t], one_hot).features) for t in range(6)]
    labels = np.stack([np.where(image.sum(-1) > 0.5, image.argmax(-1), -1) for image in images]).astype(np.int32)
    return scene, cameras, labels, thing


@pytest.mark.parametrize("masks", ["all", "of the fridge alone", "of the fridge in one view"])
def test_what_a_wall_hides_is_not_part_of_what_stands_before_it(two_rooms, masks):
    scene, cameras, labels, thing = two_rooms
    labels = labels.copy()
    if masks == "of the fridge alone":
        labels[labels != FRIDGE] = -1
    if masks == "of the fridge in one view":
        labels[1:][labels[1:] == FRIDGE] = -1
    votes = jsecon.region_votes(scene, cameras, jnp.asarray(labels), 3, by_view=True)
    hidden = np.asarray(votes.dense())[thing == SOFA, FRIDGE]
    assert hidden.max() > 0  # the wall lets a trace through
    pixels = np.stack([(labels == r).sum((1, 2)) for r in range(3)])
    regions = Regions(np.eye(3, dtype=np.float32), pixels)
    field = field_of(normalise_votes(votes, regions), regions)
    chosen = np.asarray(jsecon.query_region(field, FRIDGE).mask)
    assert chosen[thing == FRIDGE].mean() > 0.9
    assert not chosen[thing == SOFA].any()


def ask(file, out, *options):
    """The figures of the one answer of a query at the middle of the first frame."""
    asked = ["query", file, "--at", "#0", 25, 19, "--views", 0, "--out", out, *options]
    assert cli.main([str(word) for word in asked]) == 0
    return json.loads(next(out.glob("*.json")).read_text())


def test_a_thing_in_two_pieces_stays_whole_and_what_is_dropped_is_told(scene, cameras, tmp_path, capsys):
    rng = np.random.default_rng(0)
    places = np.repeat([[0, 0, 0], [1, 0, 0], [0, 30, 0]], [32, 26, 6], 0)  # two pieces, and six strays far away
    means = places + np.where(np.arange(64)[:, None] < 58, 0.05, 8) * rng.normal(size=(64, 3))
    gaussians = dataclasses.replace(scene, means=np.asarray(means, np.float32))
    own = {"gaussians": gaussians, "cameras": cameras, "names": tuple(f"frame_{t}" for t in range(4))}
    regions = Regions(np.eye(1, 8, dtype=np.float32), np.full((1, 4), 500))
    save_field(tmp_path / "field.safetensors", field_of(lone_votes(np.zeros(64), 1), regions, **own))
    told = ask(tmp_path / "field.safetensors", tmp_path / "out")
    assert told["count"] == 58
    assert told["outliers"] == {"dropped": 6, "selected": 64}
    printed = capsys.readouterr().out
    assert "6 of 64" in printed
    assert "--keep-outliers" in printed
    kept = ask(tmp_path / "field.safetensors", tmp_path / "kept", "--keep-outliers")
    assert (kept["count"], kept["outliers"]["dropped"]) == (64, 0)
    assert "--keep-outliers" not in capsys.readouterr().out


def painted(wall, things):
    """Regions of a frame that a wall fills but for a row of lit things, and their pixels."""
    rng = np.random.default_rng(0)
    frame = np.tile(np.asarray(wall, np.float64), (90, 160, 1))
    masks = np.zeros((len(things) + 1, 90, 160), bool)
    for k, colour in enumerate(things):
        masks[k, 60:75, 15 * k : 15 * k + 14] = True
        frame[masks[k]] = np.outer(np.linspace(0.7, 1.1, masks[k].sum()), colour)
    masks[-1] = ~masks.any(0)
    frame = np.clip(frame + rng.normal(0, 4, frame.shape), 0, 255).astype(np.uint8)
    return COLOURS.embed_regions(frame, masks), masks.sum((1, 2))


THINGS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white")
SHADES = {
    "red": ("dark red", "burgundy", "crimson", "maroon", "light red"),
    "yellow": ("dark yellow", "light yellow", "mustard"),
    "green": ("dark green", "light green"),
    "blue": ("dark blue", "light blue", "navy", "sky"),
    "pink": ("dark pink", "light pink"),
    "brown": ("dark brown", "light brown"),
    "black": ("charcoal",),
    "white": ("ivory", "cream"),
    "gray": ("dark grey",),
}


@pytest.mark.parametrize("family", SHADES)
def test_a_bare_colour_word_names_the_shades_that_fill_a_room(family):
    for shade in SHADES[family]:
        embeddings, pixels = painted(PALETTE[shade], [PALETTE[name] for name in THINGS if name != family])
        count = len(embeddings)
        votes, regions = lone_votes(np.arange(count), count), Regions(embeddings, np.repeat(pixels[:, None], 10, 1))
        own = {"canonical_phrases": COLOURS.canonical_phrases, "unrelated_words": embed_unrelated_words(COLOURS)}
        rules = jsecon.QueryRules(min_rank=0.0)  # all colours but one are there, so most other words match as well
        text = jnp.asarray(COLOURS.embed_text([family])[0])
        found = jsecon.query_anchored(field_of(votes, regions, **own), text, rules=rules)
        assert int(found.region) == count - 1, shade
        assert float(found.score) > 0.14, shade
