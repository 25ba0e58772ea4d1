"""A complete small field made by the library itself: the 64 Gaussians of `scene`, five regions, votes of four views."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.app.records import Answer, Query
from jsecon.field.evidence import region_votes
from jsecon.field.membership import LABELLED_PART, SEEN_PART
from jsecon.paper.distill import distill_votes
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.render import render
from jsecon.types import Camera, Codes, Gaussians, LanguageField, Regions, Selection, Votes
from jsecon.vision.colours import ColourEmbedder

REGIONS = 5


def unit_rows(rng, rows, size):
    x = rng.normal(size=(rows, size)).astype(np.float32)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def crowded(rng, rows, size, common):
    """Unit rows about a common direction, as CLIP's are."""
    x = common * unit_rows(rng, 1, size) + unit_rows(rng, rows, size)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def true_regions(scene):
    """(N,) region of each Gaussian: five slabs of like numbers, from below to above."""
    return np.argsort(np.argsort(np.asarray(scene.means)[:, 1])) * REGIONS // scene.means.shape[0]


def labels_of(scene, cameras, members):
    """(T, H, W) int16: the region that makes up most of each pixel, -1 where alpha is below 0.3."""
    onehot = jnp.asarray(np.eye(REGIONS, dtype=np.float32)[members])
    capacity = plan_capacity(scene, cameras)
    labels = []
    for view in range(cameras.world_to_camera.shape[0]):
        shares = np.asarray(render(scene, cameras[view], onehot, capacity=capacity).features)
        labels.append(np.where(shares.sum(-1) > 0.3, shares.argmax(-1), -1))
    return np.stack(labels).astype(np.int16)


_made = {}


def make_field(scene, cameras, *, dim=12):
    """(field, (T, H, W) labels), made once per process for each scene and size."""
    key = id(scene), id(cameras), dim
    if key not in _made:
        _made[key] = scene, cameras, *_make_field(scene, cameras, dim)  # the scene keeps its id
    return _made[key][2], _made[key][3].copy()


def colour_field(scene, cameras) -> LanguageField:
    """A field whose texts are colours, as `jsecon run` without models makes it."""
    return dataclasses.replace(make_field(scene, cameras, dim=ColourEmbedder().dim)[0], embedder=ColourEmbedder().name)


def rows_of_a_kind() -> np.ndarray:
    """(5, 12) unit: 0 and 1 are two of a kind (cosine 0.9), 2 a little like them (0.3), 3 and 4 something else."""
    axes = np.eye(12, dtype=np.float32)
    rows = np.stack([axes[0], 0.9 * axes[0] + 0.435 * axes[1], 0.3 * axes[0] + 0.954 * axes[2], axes[3], axes[4]])
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _make_field(scene, cameras, dim):
    rng = np.random.default_rng(5)
    scene, cameras = jax.tree.map(jnp.asarray, (scene, cameras))
    labels = labels_of(scene, cameras, true_regions(scene))
    votes = region_votes(scene, cameras, jnp.asarray(labels), REGIONS, top=3)
    embeddings = unit_rows(rng, REGIONS, dim)
    if dim == ColourEmbedder().dim:  # regions that texts of colours name
        embeddings += ColourEmbedder().embed_text(["red", "green", "blue", "orange", "pink"])
        embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    embeddings.flags.writeable = False  # several tests share it
    left, sizes, _ = np.linalg.svd(embeddings, full_matrices=False)
    table = left * sizes  # unit rows with the cosines of the embeddings
    pixels = np.stack([(labels == r).sum((1, 2)) for r in range(REGIONS)]).astype(np.int32)
    names = tuple(f"frame_{t}" for t in range(len(labels)))
    given = scene, votes, Regions(embeddings, pixels), cameras, unit_rows(rng, 4, dim), np.eye(4), names
    words, codes = np.zeros((0, dim), np.float32), Codes(distill_votes(votes, table), table, None)
    field = LanguageField(*given, "random", '{"made by": "a test"}', unrelated_words=words, codes=codes)
    return field, labels


class KnownTexts:
    """An embedder of the texts of `rows`, text -> embedding; `more` are further attributes."""

    name = "known"

    def __init__(self, rows, **more):
        self.rows, self.dim = rows, len(next(iter(rows.values())))
        self.canonical_phrases = np.zeros((0, self.dim), np.float32)
        vars(self).update(more)

    def embed_text(self, texts):
        return np.stack([self.rows[text] for text in texts])


def seen_of(votes):
    """(N, K) float64 what each vote is a share of."""
    total = np.repeat(np.asarray(votes.total, np.float64)[:, None], votes.regions.shape[1], 1)
    if votes.weight_where_region_visible is None:
        return total
    least = np.maximum(LABELLED_PART * np.asarray(votes.labelled, np.float64)[:, None], SEEN_PART * total)
    return np.maximum(np.asarray(votes.weight_where_region_visible, np.float64), least)


def shares_of(votes, regions):
    """(N,) float64: the part that lies on the regions of the weight in the views that show them, or of all weight."""
    inside = np.isin(np.asarray(votes.regions), regions)
    weight = np.where(inside, np.asarray(votes.weights, np.float64), 0).sum(1)
    seen = np.where(inside & (np.asarray(votes.views) > 0)[:, None], seen_of(votes), 0).max(1, initial=0)
    return np.divide(weight, seen, out=np.zeros_like(weight), where=seen > 0).clip(max=1)


def shares(field, regions):
    return shares_of(field.votes, regions)


def votes_of(regions, weights, count: int, **own) -> Votes:
    """Votes of Gaussians that three views show, on some of `count` regions (N, K), all labelled; and `own` columns."""
    weights = np.asarray(weights, np.float32)
    total, views = weights.sum(1), np.full(len(weights), 3, np.int32)
    votes = Votes(np.asarray(regions, np.int32), weights, total, total, total, views, np.int32(0), count)
    return dataclasses.replace(votes, **own)


def lone_votes(regions, count: int) -> Votes:
    """Votes of Gaussians, each with all of its weight on one of `count` regions."""
    return votes_of(np.int32(regions)[:, None], np.ones((len(regions), 1)), count)


def answer_of(field, text, mask, similarity=None, *, region=0, score=0.5) -> Answer:
    """An answer by votes; Gaussians inside have the similarity 1 by default."""
    mask, share = np.array(mask, bool), np.array(mask if similarity is None else similarity, np.float32)
    return Answer(Query(text), "votes", mask, Selection(mask, share, np.int32(region), np.float32(score)), field)


def field_of(votes: Votes, regions: Regions, **own) -> LanguageField:
    """A field of votes and regions, and of its `own` parts; else its Gaussians mean nothing."""
    count = votes.regions.shape[0]
    zeros = np.zeros((count, 3), np.float32)
    gaussians = Gaussians(zeros, zeros, np.ones((count, 4), np.float32), zeros[:, 0], zeros[:, None])
    one = np.ones(1, np.float32)
    camera = Camera(np.eye(4)[None], one, one, one, one, 4, 4)
    made = LanguageField(gaussians, votes, regions, camera, np.zeros((0, 8)), np.eye(4), ("a",))
    return dataclasses.replace(made, **own)
