"""Masks of single frames brought together over the frames: by a tracker's ids from disk, by the paper's Algorithm 1, or
by consensus of the views."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.rivals.evidence import Evidence
from jsecon.association.algorithm1 import clean_masklets, masklets
from jsecon.association.consensus import consensus_masklets
from jsecon.association.tracker import GeometricTracker
from jsecon.association.views import SceneViews

ROWS = 64
"""regions are counted in multiples of this, the last without pixels and embedding: scenes share compiled programs"""

COVERED = 0.5
"""part of a region that must lie in masks: what a group of Gaussians claims beside them has not been embedded"""


@dataclasses.dataclass(frozen=True)
class Association:
    """Regions that are alike in all frames, and what is known of each."""

    labels: np.ndarray
    """(T, H, W) int32 region, -1 = none."""
    embeddings: np.ndarray
    """(R, E) unit, of each region the mean of its masks' embeddings weighted by their pixels (phi_bar)."""
    uniform_embeddings: np.ndarray
    """(R, E) the same with each view counting alike."""
    pixels: np.ndarray
    """(R, T) int32."""


def associated(evidence: Evidence, labels: np.ndarray) -> Association:
    """The regions of `labels` (T, H, W): a mask counts for a region by the pixels that both hold, in the views where
    masks hold at least `COVERED` of the region's pixels. A region that is hardly in any mask has no embedding."""
    inside = overlaps(labels, np.asarray(evidence.masks), len(evidence.embeddings))
    inside = np.pad(inside, ((0, -len(inside) % ROWS), (0, 0)))
    frame, views = np.asarray(evidence.frame), range(len(labels))
    pixels = np.stack([np.bincount(image[image >= 0], minlength=len(inside)) for image in labels], axis=1)
    covered = np.stack([inside[:, frame == t].sum(1) for t in views], axis=1)
    covered = np.where(covered >= COVERED * pixels, covered, 0)
    inside = np.where(covered[:, frame] > 0, inside, 0)
    share = inside / np.maximum(covered[:, frame], 1)
    embeddings = np.asarray(evidence.embeddings)
    uniform = unit(share @ embeddings)
    return Association(labels.astype(np.int32), unit(inside @ embeddings), uniform, pixels.astype(np.int32))


def by_consensus(
    evidence: Evidence, frames: np.ndarray, *, seed: int, silent: bool = True, centre: float = 0.0, **how: Any
) -> Association:
    """jsecon's own association, without tracks: the pixels of each frame go to groups of Gaussians that lie in one mask
    in most views; `silent` as for `mask_signatures`, `centre` as for `SceneViews`, `how` as for
    `consensus_masklets`."""
    gaussians, cameras = jax.tree.map(jnp.asarray, (evidence.gaussians, evidence.cameras))
    scene = SceneViews(gaussians, cameras, lambda t: proposals(evidence, t), centre=centre)
    return associated(evidence, clean_masklets(consensus_masklets(frames, scene, silent=silent, seed=seed, **how)))


def by_algorithm1(evidence: Evidence, frames: np.ndarray, *, kappa: float) -> Association:
    """The paper's Algorithm 1 over the masks of the frames, followed through the Gaussians; kappa: `masklets`'
    iou_threshold."""
    gaussians, cameras = jax.tree.map(jnp.asarray, (evidence.gaussians, evidence.cameras))
    track = GeometricTracker(gaussians, cameras, lambda t: proposals(evidence, t))
    labels = masklets(frames, lambda _, t: proposals(evidence, t), track, iou_threshold=kappa)
    return associated(evidence, labels)


def proposals(evidence: Evidence, t: int) -> np.ndarray:
    """(M, H, W) bool: the masks of frame t."""
    rows = np.flatnonzero(np.asarray(evidence.frame) == t)
    return np.asarray(evidence.masks)[t][None] == rows[:, None, None]


def overlaps(labels: np.ndarray, masks: np.ndarray, count: int) -> np.ndarray:
    """(R, M) pixels that lie in both the region and the mask."""
    regions = int(labels.max(initial=-1)) + 1
    both = (labels >= 0) & (masks >= 0)
    joint = np.bincount(labels[both].astype(np.int64) * count + masks[both], minlength=regions * count)
    return joint.reshape(regions, count)


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of unit length; zero rows stay zero."""
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.where(length > 0, rows / np.where(length > 0, length, 1), 0).astype(np.float32)


class Shared:
    """What several methods of one setting need, computed once; its cost is charged to each that asks for it."""

    def __init__(self):
        self._kept: dict[Any, tuple[Any, float]] = {}
        self._borrowed: dict[Any, float] = {}

    def get(self, key: Any, compute: Callable[[], Any]) -> Any:
        """The value of `key`, which `compute` gives the first time."""
        if key not in self._kept:
            began = time.perf_counter()
            value = jax.block_until_ready(compute())
            self._kept[key] = value, time.perf_counter() - began
            self._borrowed.setdefault(key, 0.0)
        else:
            self._borrowed.setdefault(key, self._kept[key][1])
        return self._kept[key][0]

    def settle(self) -> float:
        """Seconds that others spent on what was asked for since the last call."""
        seconds = sum(self._borrowed.values())
        self._borrowed = {}
        return seconds
