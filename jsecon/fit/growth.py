"""Densification: adds Gaussians where the image error is largest, within arrays of a fixed size. Host code (NumPy).

Rows whose Gaussian is too faint to be visible are free. Parents are drawn in proportion to their votes (the rendering
weight alpha T of each Gaussian times the error of the pixel; arXiv 2511.04283 counts bad pixels so). Each parent is
split in two, and its second half takes a free row. Faint Gaussians are relocated that way, and jax compiles again only
when the arrays become longer.
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jsecon.splat.capacity import round_capacity
from jsecon.types import Gaussians

MIN_OPACITY = 0.005
"""Opacity below which a Gaussian is pruned (Kerbl et al. 2023)."""
_OFFSET, _SHRINKAGE = 0.6, 0.8
"""Shift of the two halves along the longest axis, and the scale that is left of it, both in units of its standard
deviation. As 0.6^2 + 0.8^2 = 1, both halves together have the variance of their parent."""


def _in_use(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Finds the rows that hold a visible Gaussian."""
    return np.asarray(gaussians.opacity_logits) >= math.log(MIN_OPACITY / (1 - MIN_OPACITY))


def drop_free_rows(gaussians: Gaussians) -> Gaussians:
    """Removes the free rows (NumPy)."""
    keep = _in_use(gaussians)
    return jax.tree.map(lambda a: np.asarray(a)[keep], gaussians)


def pad_rows(tree: Any, rows: int) -> Any:
    """Pads every array (N, ...) of a tree with zeros to `rows` rows (NumPy)."""

    def fill(a):
        return np.concatenate([a, np.zeros((rows - len(a), *a.shape[1:]), a.dtype)])

    return jax.tree.map(lambda a: fill(np.asarray(a)), tree)


def pad_with_free_rows(gaussians: Gaussians, rows: int) -> Gaussians:
    """Pads Gaussians with invisible ones to `rows` rows (NumPy)."""
    padded = pad_rows(gaussians, rows)
    for name, value in {"opacity_logits": -20.0, "log_scales": -5.0, "quaternions": 1.0}.items():
        getattr(padded, name)[gaussians.count :] = value
    return padded


def _sample_rows(votes: Float[Any, " n"], count: int, rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """Draws rows without replacement, each in proportion to its votes (Gumbel top-k); fewer if fewer have votes."""
    with np.errstate(divide="ignore"):
        keys = np.log(np.asarray(votes, np.float64)) + rng.gumbel(size=len(votes))
    return np.argsort(-keys, kind="stable")[: min(count, int(np.count_nonzero(np.asarray(votes) > 0)))]


def _split_in_two(gaussians: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Splits each Gaussian into two halves along its longest axis.

    Both together have the mass and the moments of the parent. Their opacity gives the centre of the parent the alpha
    that it had.
    """
    scales = np.asarray(gaussians.log_scales)
    rows, axis = np.arange(len(scales)), scales.argmax(axis=1)
    rotations = Rotation.from_quat(gaussians.quaternions, scalar_first=True).as_matrix()
    offset = _OFFSET * np.exp(scales[rows, axis])[:, None] * rotations[rows, :, axis]
    log_scales = scales.copy()
    log_scales[rows, axis] += math.log(_SHRINKAGE)
    opacity = 1 / (1 + np.exp(-np.clip(np.asarray(gaussians.opacity_logits, np.float64), -30, 30)))
    at_centre = math.exp(-((_OFFSET / _SHRINKAGE) ** 2) / 2)
    opacity = np.minimum((1 - np.sqrt(1 - opacity)) / at_centre, opacity)
    opacity = np.clip(opacity, 2 * MIN_OPACITY, 1 - MIN_OPACITY)
    logits = np.log(opacity / (1 - opacity)).astype(scales.dtype)
    half = dataclasses.replace(gaussians, log_scales=log_scales, opacity_logits=logits)
    first, second = (np.asarray(gaussians.means) + side * offset for side in (-1, 1))
    return (
        dataclasses.replace(half, means=first.astype(scales.dtype)),
        dataclasses.replace(half, means=second.astype(scales.dtype)),
    )


def grow(
    gaussians: Gaussians,
    moments: tuple[Gaussians, Gaussians],
    votes: Float[Any, " n"],
    target: int,
    max_gaussians: int,
    seed: list[int],
) -> tuple[Gaussians, tuple[Gaussians, Gaussians]]:
    """Adds Gaussians by splitting parents that are drawn by their votes.

    Args:
      gaussians: N rows.
      moments: Adam's moments of the N rows; those of split Gaussians start at zero again.
      votes: (N,) image error that each Gaussian takes part in.
      target: Number of Gaussians to reach.
      max_gaussians: Number of Gaussians at the end of growth. If rows run out they are doubled, up to the rows of this
        number: jax compiles again for each number of rows.
      seed: Seed of the draw.
    """
    gaussians, moments = jax.tree.map(np.array, (gaussians, moments))
    used = _in_use(gaussians)
    count = int(used.sum())
    added = min(max(target - count, 0), int(0.3 * count) + 1)  # at most three tenths at once
    if count + added > len(used):
        doubled = min(round_capacity(max_gaussians), round_capacity(2 * len(used)))
        rows = max(round_capacity(count + added), doubled)
        gaussians = pad_with_free_rows(gaussians, rows)
        moments, votes = pad_rows((moments, np.asarray(votes)), rows)
        used = _in_use(gaussians)
    parents = _sample_rows(np.where(used, votes, 0.0), added, np.random.default_rng(seed))
    free = np.flatnonzero(~used)[: len(parents)]
    first, second = _split_in_two(jax.tree.map(lambda a: a[parents], gaussians))
    for half, rows in ((first, parents), (second, free)):
        for column, values in zip(jax.tree.leaves(gaussians), jax.tree.leaves(half), strict=True):
            column[rows] = values
        for column in jax.tree.leaves(moments):
            column[rows] = 0
    return gaussians, moments
