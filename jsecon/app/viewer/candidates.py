"""Other regions that an answer might be, and the region that a ray meets."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.app.scene import choose_shades
from jsecon.field.regions import mean_residuals
from jsecon.field.similarity import similarities
from jsecon.query.answer import ROUNDING
from jsecon.query.expressions import parse_query
from jsecon.query.pointing import MIN_SHARE, region_shares_seen
from jsecon.query.render import HIDDEN_LOGIT
from jsecon.query.rules import RULES
from jsecon.query.scores import region_similarities, unrelated_words, view_count_weight
from jsecon.types import Camera, LanguageField

RAY_VIEW_SIDE = 1025
"""side of the view that looks along a ray, px; the ray meets the centre of its middle pixel"""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A region that an answer might be.

    Attributes:
      region: Its id.
      score: Its similarity with the query.
      frame: Index of the frame that shows most of it.
    """

    region: int
    score: float
    frame: int


def candidates(field: LanguageField, embedder: Any, query: str | int, count: int = 6) -> list[Candidate]:
    """Finds the regions that are most similar to a text or a region, as queries weigh them (`view_count_weight`).

    Args:
      field: The field (`Scene.text_field`).
      embedder: Its embedder.
      query: A text, of whose alternatives the most similar one counts; regions that match a text behind "but not"
        better are left out. Or the id of a region, which is compared by what sets regions apart from the scene.
      count: Maximum number of candidates.

    Returns:
      The candidates, best first.

    Raises:
      InputError: The embedder has no words for the text.
    """
    if field.regions.count == 0 or (isinstance(query, int) and query >= field.regions.count):
        return []
    table = jnp.asarray(field.regions.embeddings)
    weight = np.asarray(_view_count_weight(jnp.asarray(field.regions.pixel_counts)))
    if isinstance(query, str):
        words = unrelated_words(field)
        weight = np.ones_like(weight) if words is None else weight  # the plain cosine ranks without weights
        included, excluded = (choose_shades(field, embedder, texts, RULES, every=True) for texts in parse_query(query))
        texts = jnp.asarray(embedder.embed_text(included + excluded))
        matches = [_similarities(table, text, words, RULES.retrieval) for text in texts]
        scores = np.stack([score for score, _ in matches])
        score = scores[: len(included)].max(0)
        known = matches[0][1] & (score > scores[len(included) :].max(0, initial=-np.inf) + ROUNDING)
    else:
        score, known = (np.array(a) for a in _region_similarity(table, query))
        known[query : query + 1] = False
    weighted = np.where(known, np.where(score > 0, score * weight, score), -np.inf)
    order = [r for r in np.argsort(-weighted, kind="stable")[:count] if known[r]]
    frames = np.asarray(field.regions.pixel_counts).argmax(1)
    return [Candidate(int(r), float(score[r]), int(frames[r])) for r in order]


_similarities = jax.jit(region_similarities, static_argnames="retrieval")
_view_count_weight = jax.jit(view_count_weight)


@jax.jit
def _region_similarity(embeddings, region):
    """Returns cosines of all regions with one, by what sets them apart from the mean, and where they are known."""
    residuals, known = mean_residuals(embeddings)
    cosines, measured = similarities(residuals, residuals[region])
    return jnp.where(measured, cosines, 0.0), known & measured


def region_along(
    field: LanguageField,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    *,
    focal: float,
    visible: Bool[np.ndarray, " n"],
) -> int:
    """Finds the region that a ray meets.

    Args:
      field: The field.
      origin: Origin of the ray in the field's world.
      direction: Direction of the ray.
      focal: Focal length of the view that the ray belongs to, px.
      visible: Gaussians that the ray can meet.

    Returns:
      The region that makes up most of the pixel on the ray, or -1 if no region has `MIN_SHARE` of it.
    """
    forward = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(origin, np.float64)
    intrinsics = (np.asarray(x, np.float32) for x in (focal, focal, RAY_VIEW_SIDE / 2, RAY_VIEW_SIDE / 2))
    camera = Camera(pose.astype(np.float32), *intrinsics, width=RAY_VIEW_SIDE, height=RAY_VIEW_SIDE)
    logits = jnp.where(jnp.asarray(visible), field.gaussians.opacity_logits, HIDDEN_LOGIT)
    gaussians = dataclasses.replace(field.gaussians, opacity_logits=logits)
    field = dataclasses.replace(field, gaussians=gaussians)
    shares = region_shares_seen(field, camera, RAY_VIEW_SIDE // 2, RAY_VIEW_SIDE // 2)
    return int(shares.argmax()) if shares.size and shares.max() >= MIN_SHARE else -1
