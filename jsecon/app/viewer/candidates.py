"""What else an answer might be: the regions nearest to what was asked, each with a picture; and the region that a ray
meets."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.app.ask import with_phrases
from jsecon.app.pictures import Renderer
from jsecon.app.viewer.static_page import main_regions
from jsecon.query.match import RETRIEVALS, answers, evidence, scene_residuals, words_of
from jsecon.query.pixel import MIN_SHARE, region_shares_seen
from jsecon.query.render import HIDDEN_LOGIT
from jsecon.query.several import ROUNDING, parts_of_question
from jsecon.query.similarity import similarities
from jsecon.types import Camera, LanguageField

SIDE = 1025
"""px of the view that looks along a ray, which meets the middle of its middle pixel"""
MARGIN = 0.3
"""around a region in its picture, in parts of its size"""


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A region that an answer might be."""

    region: int
    score: float
    """similarity with what was asked."""
    frame: int
    """that shows most of it."""


def candidates(field: LanguageField, embedder: Any, thing: str | int, count: int = 6) -> list[Candidate]:
    """The `count` regions nearest to a text or a region, the nearest first, as queries weigh them (`evidence`).

    For a text the nearest wanted part of `parts_of_question` counts, and a region as near to an unwanted one is left
    out; for a region what sets both apart from the scene, itself left out. Raises InputError for a text that the
    embedder doesn't understand.
    """
    if field.regions.count == 0:
        return []
    table, pixels = jnp.asarray(field.regions.embeddings), jnp.asarray(field.regions.pixels)
    if isinstance(thing, str):
        field = with_phrases(field, embedder)
        words, retrieval = words_of(field, RETRIEVALS[0])
        wanted, unwanted = parts_of_question(thing)
        texts = jnp.asarray(embedder.embed_text(wanted + unwanted))
        each = [_answers(table, text, jnp.asarray(field.canonical), words, pixels, retrieval) for text in texts]
        near, known = np.stack([found for found, _ in each]), np.array(each[0][1])
        score = near[: len(wanted)].max(0)
        known &= score > near[len(wanted) :].max(0, initial=-np.inf) + ROUNDING
    else:
        score, known = (np.array(a) for a in _likeness(table, pixels, min(thing, field.regions.count - 1)))
        known[thing : thing + 1] = False
    weighed = np.where(known, np.where(score > 0, score * np.asarray(_evidence(pixels)), score), -np.inf)
    order = [r for r in np.argsort(-weighed, kind="stable")[:count] if known[r]]
    frames = np.asarray(field.regions.pixels).argmax(1)
    return [Candidate(int(r), float(score[r]), int(frames[r])) for r in order]


_answers, _evidence = jax.jit(answers, static_argnames="retrieval"), jax.jit(evidence)


@jax.jit
def _likeness(embeddings, pixels, region):
    apart, known = scene_residuals(embeddings, pixels)
    found, measured = similarities(apart, apart[region])
    return jnp.where(measured, found, 0.0), known & measured


class Pictures:
    """Pictures of a field's frames and regions, as its Gaussians show them."""

    def __init__(self, field: LanguageField):
        self.renderer, self.regions = Renderer(field.gaussians, field.cameras), main_regions(field)
        self._means = np.asarray(field.gaussians.means)
        self._poses = np.asarray(field.cameras.world_to_camera)
        self._lens = [np.asarray(a) for a in (field.cameras.fx, field.cameras.fy, field.cameras.cx, field.cameras.cy)]

    def region(self, region: int, frame: int) -> UInt8[np.ndarray, "h w 3"]:
        """The part of a frame that shows a region's Gaussians; all of it where it has none there."""
        photo = self.renderer.photo(frame)
        height, width = photo.shape[:2]
        points = self._means[self.regions == region] @ self._poses[frame, :3, :3].T + self._poses[frame, :3, 3]
        points = points[points[:, 2] > 1e-6]
        fx, fy, cx, cy = (a[frame] for a in self._lens)
        u, v = fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        if not inside.any():
            return photo
        (left, right), (upper, lower) = (np.quantile(a[inside], (0.03, 0.97)) for a in (u, v))
        half = max(right - left, lower - upper, 16) * (0.5 + MARGIN)
        x, y = (left + right) / 2, (upper + lower) / 2
        rows = slice(int(max(y - half, 0)), int(min(y + half, height)) + 1)
        return photo[rows, int(max(x - half, 0)) : int(min(x + half, width)) + 1]


def region_along(
    field: LanguageField,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    *,
    focal: float,
    seen: Bool[np.ndarray, " n"],
) -> int:
    """The region that makes up most of the pixel that a ray meets, among the Gaussians `seen` (N,); -1 where none makes
    up `MIN_SHARE`. `focal`: px of the view that the ray belongs to. World units, as the field's."""
    forward = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    aside = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    aside /= np.linalg.norm(aside)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([aside, np.cross(forward, aside), forward])
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(origin, np.float64)
    lens = (np.asarray(x, np.float32) for x in (focal, focal, SIDE / 2, SIDE / 2))
    camera = Camera(pose.astype(np.float32), *lens, width=SIDE, height=SIDE)
    logits = jnp.where(jnp.asarray(seen), field.gaussians.opacity_logits, HIDDEN_LOGIT)
    gaussians = dataclasses.replace(field.gaussians, opacity_logits=logits)
    shares = region_shares_seen(dataclasses.replace(field, gaussians=gaussians), camera, SIDE // 2, SIDE // 2)
    return int(shares.argmax()) if shares.size and shares.max() >= MIN_SHARE else -1
