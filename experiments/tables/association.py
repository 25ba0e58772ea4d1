"""Regions from the masks of single frames: by the ids of a tracker from disk, or by consensus of the views."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.rivals.evidence import Evidence
from jsecon.association.algorithm1 import clean_masklets
from jsecon.association.consensus import consensus_masklets
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


def associated(levels: Sequence[Evidence], labels: np.ndarray) -> Association:
    """The regions of `labels` (T, H, W): a mask, of whichever level, counts for a region by the pixels that both hold,
    in the views where masks hold at least `COVERED` of the region's pixels. A region that is hardly in any mask has no
    embedding."""
    inside = np.concatenate([overlaps(labels, np.asarray(e.masks), len(e.embeddings)) for e in levels], axis=1)
    inside = np.pad(inside, ((0, -len(inside) % ROWS), (0, 0)))
    frame, embeddings = (np.concatenate([np.asarray(getattr(e, k)) for e in levels]) for k in ("frame", "embeddings"))
    pixels = np.stack([np.bincount(image[image >= 0], minlength=len(inside)) for image in labels], axis=1)
    covered = np.stack([inside[:, frame == t].sum(1) for t in range(len(labels))], axis=1)
    covered = np.where(covered >= COVERED * pixels * len(levels), covered, 0)
    inside = np.where(covered[:, frame] > 0, inside, 0)
    share = inside / np.maximum(covered[:, frame], 1)
    uniform = unit(share @ embeddings)
    return Association(labels.astype(np.int32), unit(inside @ embeddings), uniform, pixels.astype(np.int32))


def by_consensus(
    levels: Sequence[Evidence],
    frames: np.ndarray,
    *,
    seed: int,
    silent: bool = True,
    centre: float = 0.0,
    **how: Any,
) -> Association:
    """jsecon's own association, without tracks: the pixels of each frame go to groups of Gaussians that lie in one mask
    in most views; `silent` as for `mask_signatures`, `centre` as for `SceneViews`, `how` as for
    `consensus_masklets`."""
    given = jax.tree.map(jnp.asarray, (levels[0].gaussians, levels[0].cameras))
    scene = SceneViews(*given, lambda t: proposals(levels, t), centre=centre)
    return associated(levels, clean_masklets(consensus_masklets(frames, scene, silent=silent, seed=seed, **how)))


def proposals(levels: Sequence[Evidence], t: int) -> np.ndarray:
    """(M, H, W) bool: the masks of frame t, level by level."""
    rows = [np.flatnonzero(np.asarray(e.frame) == t) for e in levels]
    return np.concatenate([np.asarray(e.masks)[t][None] == own[:, None, None] for e, own in zip(levels, rows)])


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
