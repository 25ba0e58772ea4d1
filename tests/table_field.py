"""A field of things on a table without any rendering: clusters of Gaussians, each a region with the colour of its name.

World: z up; the cameras look along y, x is to the right.
"""

import dataclasses

import numpy as np
from conftest import gaussians_at
from small_field import lone_votes

from experiments.rooms.capture import look_at
from jsecon.types import Camera, LanguageField, Regions, UpAxis
from jsecon.vision.colours import ColourEmbedder

THINGS = (
    ("red mug", (-0.5, 0.0, 0.05), (0.05, 0.05, 0.05)),
    ("red mug", (0.5, 0.1, 0.05), (0.05, 0.05, 0.05)),
    ("dark green bottle", (0.0, 0.0, 0.15), (0.04, 0.04, 0.15)),
    ("white plate", (0.0, -0.5, 0.01), (0.12, 0.12, 0.01)),
    ("orange ball", (0.0, -0.5, 0.07), (0.05, 0.05, 0.05)),
    ("dark blue box", (0.0, 0.6, 0.1), (0.2, 0.1, 0.1)),
)
"""name, middle and half size, m"""
UP = UpAxis((0.0, 0.0, 1.0), "what the test says")
"""up of the table, which one camera that looks down does not tell"""


def table_field(things=THINGS, *, source_from_scene=None, directions=((0.0, -2.0, 0.8),), up=None):
    """(field, embedder). The cameras stand at `directions` and look at the origin."""
    draw = np.random.default_rng(3)
    embedder = ColourEmbedder()
    points = [np.array(center) + np.array(half) * draw.uniform(-1, 1, (120, 3)) for _, center, half in things]
    gaussians = gaussians_at(np.concatenate(points).astype(np.float32), 2e-3)
    votes = lone_votes(np.repeat(np.arange(len(things)), 120), len(things))
    overlap, views = np.eye(len(things), dtype=np.float32), np.full(gaussians.count, len(directions), np.int32)
    shown = {"weight_where_region_visible": votes.weights, "overlap": overlap, "views": views}
    embeddings = np.asarray(embedder.embed_text([name for name, _, _ in things]), np.float32)
    pixels = np.full((len(things), len(directions)), 900, np.int32)
    poses = np.stack([look_at(np.array(eye), np.zeros(3)) for eye in directions])
    flat = np.full(len(directions), 50.0, np.float32)
    field = LanguageField(
        gaussians=gaussians,
        votes=dataclasses.replace(votes, **shown),
        regions=Regions(embeddings, pixels),
        cameras=Camera(poses, flat, flat, flat, flat * 0.8, 100, 80),
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.eye(4) if source_from_scene is None else source_from_scene,
        names=tuple(f"frame_{t}" for t in range(len(directions))),
        embedder=embedder.name,
        up=up,
        unrelated_words=np.asarray(embedder.unrelated_words, np.float16),
    )
    return field, embedder
