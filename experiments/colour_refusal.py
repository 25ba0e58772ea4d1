"""Three states of colours: whether texts of what is in made-up rooms are found, and texts of what is not are absent.

    python -m experiments.colour_refusal [--seeds FIRST LAST] [--quick]

Rooms of 3 to 40 things in some of the vocabulary's colours, ray traced with true masks. Nothing is fitted: each thing
is a region with the mean embedding of its masks, and a cube of Gaussians of its own, so that queries and the catalogue
run as on any field. A colour is present if a visible thing has it. It is absent if its embedding, and that of
each of its shades, has a cosine below NEAR with the name of every thing. Beside the states stand the rows that the
catalogue names with a probability of at least a half, and how many of these names a query selects.

The margins of `jsecon.query.rules` were chosen on the rooms 0 to 53; the default seeds are others.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import results
from experiments.rooms.capture import room_cameras
from experiments.rooms.raycast import render_views
from experiments.rooms.room import OBJECT_GAP_M, Room, build_room, footprint_radius, place_object, scatter_circles
from experiments.rooms.shapes import SHAPES
from jsecon import Scene
from jsecon.field.regions import region_embeddings
from jsecon.numerics import cosine_matrix
from jsecon.types import Gaussians, LanguageField, UpAxis, Votes
from jsecon.vision.colours import BASIC, PALETTE, VOCABULARY, ColourEmbedder

COLOURS = "red orange yellow green blue purple pink brown turquoise teal cyan magenta violet olive navy maroon"
COLOURS += " beige lime gold crimson salmon lavender indigo"
"""Colours that are asked for where a room lacks them."""
NEAR = 0.8
"""Cosine from which two names are about one colour."""
COUNTS = (3, 5, 8, 12, 20, 30, 40)
"""Numbers of things in a room, in turn."""
THING_SHAPES = ("ball", "box", "cup", "vase", "bowl", "bottle")
LAYER, LAYER_M = 8, 0.3
"""Things on one layer, and the distance of layers, m: a table has no room for 40."""
MIN_PIXELS = 60
"""Pixels of all views together from which a thing counts as visible."""
PAINT_NOISE = 8.0
"""Standard deviation of a thing's colour from that of its name, of 255."""
SCALE = 16
"""Factor on the pixels of the small frames, whose things would else count as barely seen (`view_count_weight`)."""
STATES = ("found", "unsure", "absent")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, int] = (2000, 2056)
    """First seed of the rooms, and the one after the last."""
    views: int = 4
    size: tuple[int, int] = (96, 72)
    """Width and height of the frames, px."""
    quick: bool = False
    """Ask seven rooms."""
    out: str = ""


def coloured_room(seed: int) -> Room:
    """A room of things in 2 to 12 of the vocabulary's colours; how many things there are follows from the seed."""
    draw, count = np.random.default_rng([seed, 23]), COUNTS[seed % len(COUNTS)]
    kinds = draw.permutation(VOCABULARY)[: max(2, min(int(draw.integers(2, 13)), count))]
    colours = [str(colour) for colour in draw.choice(kinds, count)]
    shapes = [str(shape) for shape in draw.choice(THING_SHAPES, count)]
    bodies = [SHAPES[shape](draw) for shape in shapes]
    radii, layers = [footprint_radius(body) for body in bodies], -(-count // LAYER)
    things: dict[int, Any] = {}
    for layer in range(layers):
        own = range(layer, count, layers)
        for k, spot in zip(own, scatter_circles(draw, [radii[k] for k in own], gap=0.4 * OBJECT_GAP_M)):
            paint = np.clip(np.array(PALETTE[colours[k]]) + draw.normal(0, PAINT_NOISE, 3), 0, 255)
            srgb = tuple(int(value) for value in paint)
            things[k] = place_object(draw, k, colours[k], shapes[k], srgb, bodies[k], (*spot, LAYER_M * layer))
    return build_room(draw, tuple(things[k] for k in range(count)), seed)


def room_field(room: Room, options: Options, embedder: ColourEmbedder) -> LanguageField:
    """The field of a room: a region of each thing, and a last one of what is around them."""
    width, height = options.size
    cameras = room_cameras(room, views=options.views, width=width, height=height)
    frames, instances, _ = render_views(room, cameras, coarser=8)
    count = len(room.objects) + 1
    labels = np.where(instances < 0, count - 1, instances)
    regions = region_embeddings(frames, labels, embedder.embed_regions, num_regions=count)
    regions = dataclasses.replace(regions, pixel_counts=SCALE * np.asarray(regions.pixel_counts))
    middles = np.array([*(item.centre for item in room.objects), (0, 0, -1)], np.float32)
    corners = 0.02 * np.stack(np.meshgrid(*[np.arange(3)] * 3), -1).reshape(-1, 3)
    means = (middles[:, None] + corners).reshape(-1, 3).astype(np.float32)
    member, ones = np.repeat(np.arange(count, dtype=np.int32), len(corners))[:, None], np.ones(len(means), np.float32)
    upright = np.tile(np.float32([1, 0, 0, 0]), (len(means), 1))
    gaussians = Gaussians(means, np.full_like(means, -5), upright, 3 * ones, np.zeros((len(means), 1, 3), np.float32))
    views, overlap = np.full(len(means), options.views, np.int32), np.eye(count, dtype=np.float32)
    one = ones[:, None]
    votes = Votes(
        member, one, ones, ones, ones, views, np.int32(0), count, weight_where_region_visible=one, overlap=overlap
    )
    names = tuple(f"frame_{view:05d}" for view in range(options.views))
    parts = {"embedder": embedder.name, "unrelated_words": np.asarray(embedder.unrelated_words, np.float16)}
    return LanguageField(
        gaussians, votes, regions, cameras, np.asarray(embedder.canonical_phrases), np.eye(4), names, **parts
    )


def absent_colours(names: Sequence[str], embedder: ColourEmbedder) -> list[str]:
    """The colours that things of these names lack."""
    present = np.asarray(embedder.embed_text(list(names)))

    def nearest(text: str) -> float:
        words = np.asarray(embedder.embed_text([text, *embedder.narrower(text)]))
        return float(np.asarray(cosine_matrix(words, present)).max())

    return [text for text in (f"{colour} thing" for colour in COLOURS.split()) if nearest(text) < NEAR]


def ask_room(seed: int, options: Options, embedder: ColourEmbedder) -> dict[str, list]:
    """Asks a room: the state of each present and each absent text, of bare terms with shades, and of each sure row."""
    room = coloured_room(seed)
    field = room_field(room, options, embedder)
    visible = np.asarray(field.regions.pixel_counts).sum(1) >= SCALE * MIN_PIXELS
    names = sorted({name for name, seen in zip(room.names, visible) if seen})
    bare = [basic for basic in BASIC if not any(name.split()[0] == basic for name in room.names)]
    shades = [basic for basic in bare if any(shade in name for name in names for shade in embedder.narrower(basic))]
    scene = Scene(dataclasses.replace(field, up=UpAxis((0.0, 0.0, 1.0), "the room")), embedder)
    listed = scene.objects()
    sure = [str(name) for name, share in zip(listed.names, listed.probability) if share >= 0.5]
    asked = {"present": names, "absent": absent_colours(room.names, embedder), "by shades": shades, "rows": sure}
    return {kind: [(text, scene.ask(text).state) for text in texts] for kind, texts in asked.items()}


def main(options: Options) -> dict:
    """Runs the experiment, prints and writes its table and returns the shares of the states."""
    embedder = ColourEmbedder()
    seeds = range(*options.seeds)[:7] if options.quick else range(*options.seeds)
    asked = {seed: ask_room(seed, options, embedder) for seed in seeds}
    metrics, rows = {}, []
    for count in (*COUNTS, None):
        own = [kinds for seed, kinds in asked.items() if count in (None, COUNTS[seed % len(COUNTS)])]
        for kind in asked[seeds[0]]:
            states = [state for kinds in own for _, state in kinds[kind]]
            shares = {state: states.count(state) / max(len(states), 1) for state in STATES}
            metrics[f"{count or 'all'} things, {kind}"] = shares | {"texts": len(states)}
            rows.append((count or "all", kind, len(states), *(f"{shares[state]:.3f}" for state in STATES)))
    table = results.table(("things", "texts", "number", *STATES), rows)
    refused = [(seed, text) for seed, kinds in asked.items() for text, state in kinds["present"] if state == "absent"]
    results.save(Path(options.out), options, metrics | {"present but absent": refused}, table)
    print(table, f"\nPresent but judged absent: {refused}")
    return metrics


if __name__ == "__main__":
    main(results.read_options(Options, "colour_refusal", __doc__, {"quick": True}))
