"""What every baseline learns from: one set of Gaussians, the masks of each frame, and how a tracker joined them."""

from __future__ import annotations

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jsecon.splat.plan import ViewPlan, prepare_views
from jsecon.types import Array, Camera, Gaussians

_SLOTS = 8
_ROWS = 2048
_INVISIBLE = -100.0
"""logit of an opacity far below 1/255"""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Evidence:
    """A scene as the baselines see it; a pytree."""

    gaussians: Gaussians
    cameras: Camera
    """batch of T: the views that may be learnt from."""
    masks: Array
    """(T, H, W) int32 rows of `embeddings`, -1 = none; a row belongs to one frame."""
    embeddings: Array
    """(M, E) float32 unit, one per mask."""
    frame: Array
    """(M,) int32 the frame of each mask."""
    tracks: Array
    """(T, H, W) int32 the same regions under a tracker's ids, alike in all frames; -1 = none."""


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of unit length; zero rows stay zero."""
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.where(length > 0, rows / np.where(length > 0, length, 1), 0).astype(np.float32)


def local_masks(evidence: Evidence) -> tuple[Int[np.ndarray, "t h w"], Int[np.ndarray, "t k"]]:
    """The masks counted from 0 in each frame (T, H, W), -1 = none; and the rows (T, K) that the counts stand for, -1
    past a frame's last. K is a multiple of 8: scenes share their compiled programs."""
    masks, frame = np.asarray(evidence.masks), np.asarray(evidence.frame)
    rows = [np.flatnonzero(frame == t) for t in range(len(masks))]
    names = np.full((len(masks), _SLOTS * -(-max(1, max(map(len, rows), default=1)) // _SLOTS)), -1, np.int32)
    local = np.full(masks.shape, -1, np.int32)
    for t, here in enumerate(rows):
        names[t, : len(here)] = here
        place = np.full(len(frame) + 1, -1, np.int32)
        place[here] = np.arange(len(here))
        local[t] = place[masks[t]]
    return local, names


def with_room(gaussians: Gaussians) -> Gaussians:
    """The Gaussians, and behind them invisible ones up to a multiple of 2,048: scenes share their compiled programs.

    The first rows of what is drawn at random for all rows are those drawn for the Gaussians alone (jax's threefry).
    """
    count = gaussians.count
    filled = jax.tree.map(lambda a: np.pad(a, ((0, -count % _ROWS), *[(0, 0)] * (a.ndim - 1)), mode="edge"), gaussians)
    filled.opacity_logits[count:] = _INVISIBLE
    return jax.tree.map(jnp.asarray, filled)


def view_plans(evidence: Evidence) -> ViewPlan:
    """The plans of all views of the Gaussians `with_room`, stacked on a leading axis: the geometry is frozen, so each
    is made once."""
    gaussians, cameras = with_room(evidence.gaussians), jax.tree.map(jnp.asarray, evidence.cameras)
    plans = prepare_views(gaussians, cameras, max_bytes=sys.maxsize)
    assert plans is not None
    return plans


def only(plan: ViewPlan, mask: Array) -> ViewPlan:
    """The plan of the same view with the Gaussians of `mask` (N,) alone: the others' opacity is zero."""
    return dataclasses.replace(plan, splats=plan.splats.at[:, 5].multiply(mask.astype(plan.splats.dtype)))
