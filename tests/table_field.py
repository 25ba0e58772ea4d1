"""A field of things on a table without any rendering: clusters of Gaussians, each a region with the colour of its name.

World: z up; the cameras look along y, x is to the right.
"""

import numpy as np
from conftest import gaussians_at

from experiments.rooms.capture import look_at
from jsecon.types import Camera, LanguageField, Regions, Votes
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


def table_field(things=THINGS, *, source_from_scene=None, directions=((0.0, -2.0, 0.8),)):
    """(field, embedder). The cameras stand at `directions` and look at the origin."""
    draw = np.random.default_rng(3)
    embedder = ColourEmbedder()
    points = [np.array(center) + np.array(half) * draw.uniform(-1, 1, (120, 3)) for _, center, half in things]
    count = 120 * len(things)
    means = np.concatenate(points).astype(np.float32)
    gaussians = gaussians_at(means, 2e-3)
    member = np.repeat(np.arange(len(things), dtype=np.int32), 120)[:, None]
    ones = np.ones(count, np.float32)
    views = np.full(count, len(directions), np.int32)
    overlap = np.eye(len(things), dtype=np.float32)
    weights = np.ones((count, 1), np.float32)
    votes = Votes(
        member,
        weights,
        ones,
        ones,
        ones,
        views,
        np.int32(0),
        len(things),
        weight_where_region_visible=weights,
        overlap=overlap,
    )
    embeddings = np.asarray(embedder.embed_text([name for name, _, _ in things]), np.float32)
    pixels = np.full((len(things), len(directions)), 900, np.int32)
    poses = np.stack([look_at(np.array(eye), np.zeros(3)) for eye in directions])
    flat = np.full(len(directions), 50.0, np.float32)
    field = LanguageField(
        gaussians=gaussians,
        votes=votes,
        regions=Regions(embeddings, pixels),
        cameras=Camera(poses, flat, flat, flat, flat * 0.8, 100, 80),
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.eye(4) if source_from_scene is None else source_from_scene,
        names=tuple(f"frame_{t}" for t in range(len(directions))),
        embedder=embedder.name,
        unrelated_words=np.asarray(embedder.unrelated_words, np.float16),
    )
    return field, embedder
