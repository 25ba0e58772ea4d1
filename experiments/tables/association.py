"""Regions from the masks of single frames: by the ids of a tracker from disk, or by consensus of the views."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baselines.evidence import Evidence, unit
from jsecon.association.consensus import track_masks
from jsecon.association.frame_superpixels import SceneSuperpixels

ROWS = 64
"""The number of regions is padded to a multiple of this, so that scenes share compiled programs."""

COVERED = 0.5
"""Share of a region in a view that must lie in masks, since only masks have embeddings."""


@dataclasses.dataclass(frozen=True)
class Association:
    """Regions with the same ids in all frames, and their embeddings."""

    labels: np.ndarray
    """(T, H, W) int32 region, -1 = none."""
    embeddings: np.ndarray
    """(R, E) unit; mean of the embeddings of a region's masks, weighted by pixels (phi_bar)."""
    uniform_embeddings: np.ndarray
    """(R, E) The same with equal weights of views."""
    pixel_counts: np.ndarray
    """(R, T) int32 pixels in each view."""


def associated(levels: Sequence[Evidence], labels: np.ndarray) -> Association:
    """Embeds the regions of label images.

    Args:
      levels: Masks and embeddings of each level.
      labels: (T, H, W) region ids, -1 where a pixel belongs to no region.

    Returns:
      The regions. A mask weighs by the pixels that it shares with a region, in views where masks cover at least COVERED
      of the region. A region without such a view has no embedding.
    """
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
    centre: float = 0.0,
    **how: Any,
) -> Association:
    """Associates masks by jsecon's consensus of the views.

    Args:
      levels: Masks and embeddings of each level.
      frames: (T, H, W, 3) uint8.
      seed: Seed of the clustering.
      centre: As for `SceneSuperpixels`.
      **how: Options of `track_masks`.

    Returns:
      The regions.
    """
    given = jax.tree.map(jnp.asarray, (levels[0].gaussians, levels[0].cameras))
    scene = SceneSuperpixels(*given, lambda t: proposals(levels, t), centre_pixel_weight=centre)
    return associated(levels, track_masks(frames, scene, seed=seed, **how).labels)


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


class Shared:
    """Values that several methods of a setting need, computed once. Each method that uses one is charged its cost."""

    def __init__(self):
        self._kept: dict[Any, tuple[Any, float]] = {}
        self._borrowed: dict[Any, float] = {}

    def get(self, key: Any, compute: Callable[[], Any]) -> Any:
        """The value of `key`, computed at the first call."""
        if key not in self._kept:
            began = time.perf_counter()
            value = jax.block_until_ready(compute())
            self._kept[key] = value, time.perf_counter() - began
            self._borrowed.setdefault(key, 0.0)
        else:
            self._borrowed.setdefault(key, self._kept[key][1])
        return self._kept[key][0]

    def settle(self) -> float:
        """Seconds that other methods spent on the values used since the last call."""
        seconds = sum(self._borrowed.values())
        self._borrowed = {}
        return seconds
