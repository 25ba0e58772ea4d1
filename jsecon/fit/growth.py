"""Gaussians added where the picture is wrong, within arrays of a fixed size.

Rows whose Gaussian is too faint to be seen are free. Where Gaussians are wanted, they are drawn by their votes of the
error (the weight alpha T that each casts on a pixel, times how wrong the pixel is; arXiv 2511.04283 counts bad pixels
so), and each becomes two, the second in a free row. Faint Gaussians
thereby go where they are of use, and jax compiles anew only where the arrays become longer. NumPy, on the host: an
event in fifty steps.
"""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.splat.capacity import round_capacity
from jsecon.types import Array, Gaussians

MIN_OPACITY = 0.005
"""opacity below which a Gaussian is pruned (Kerbl et al. 2023)"""
AT_ONCE = 0.3
"""most that an event adds, as a share of the Gaussians there are"""
_FREE = {"opacity_logits": -20.0, "log_scales": -5.0, "quaternions": 1.0}
"""of a row without Gaussian: any numbers that are none to be seen"""
_APART, _NARROWER = 0.6, 0.8
"""of the longest standard deviation: how far the halves move to either side, and what is left of it; as 0.6^2 + 0.8^2
= 1, both together have the variance of the one"""


def in_use(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """(N,) bool: rows that hold a Gaussian which can be seen."""
    return np.asarray(gaussians.opacity_logits) >= math.log(MIN_OPACITY / (1 - MIN_OPACITY))


def drop_free_rows(gaussians: Gaussians) -> Gaussians:
    """Without the free rows."""
    keep = in_use(gaussians)
    return jax.tree.map(lambda a: np.asarray(a)[keep], gaussians)


def padded_row_count(count: int) -> int:
    """Rows that hold `count` Gaussians: few sizes, so that few programs are compiled."""
    return round_capacity(count)


def pad_rows(tree: Any, rows: int) -> Any:
    """Every array filled up to `rows` rows with zeros."""
    fill = lambda a: np.concatenate([a, np.zeros((rows - len(a), *a.shape[1:]), a.dtype)])
    return jax.tree.map(lambda a: fill(np.asarray(a)), tree)


def pad_with_free_rows(gaussians: Gaussians, rows: int) -> Gaussians:
    """Filled up to `rows` rows with free ones."""
    count, longer = gaussians.count, pad_rows(gaussians, rows)
    for name, value in _FREE.items():
        getattr(longer, name)[count:] = value
    return longer


def sample_rows(votes: Float[Array, " n"], count: int, rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """`count` different rows, each drawn in proportion to its votes among those left (Gumbel's top k); fewer where
    fewer have any."""
    with np.errstate(divide="ignore"):
        keys = np.log(np.asarray(votes, np.float64)) + rng.gumbel(size=len(votes))
    return np.argsort(-keys, kind="stable")[: min(count, int(np.count_nonzero(np.asarray(votes) > 0)))]


def split_in_two(gaussians: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Each Gaussian as two beside each other along its longest axis, which together have its mass and moments; their
    opacity is what gives its centre the alpha it had."""
    scales = np.asarray(gaussians.log_scales)
    rows, axis = np.arange(len(scales)), scales.argmax(axis=1)
    w, x, y, z = (np.asarray(gaussians.quaternions) / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)).T
    # The column of the rotation that is the longest axis.
    columns = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    offset = _APART * np.exp(scales[rows, axis])[:, None] * columns[axis, :, rows]
    narrower = scales.copy()
    narrower[rows, axis] += math.log(_NARROWER)
    opacity = opacities(gaussians)
    at_centre = math.exp(-((_APART / _NARROWER) ** 2) / 2)
    opacity = np.clip(np.minimum((1 - np.sqrt(1 - opacity)) / at_centre, opacity), 2 * MIN_OPACITY, 1 - MIN_OPACITY)
    logits = np.log(opacity / (1 - opacity)).astype(scales.dtype)
    both = [np.asarray(gaussians.means) + side * offset for side in (-1, 1)]
    given = {"log_scales": narrower, "opacity_logits": logits}
    one, other = (dataclasses.replace(gaussians, means=means.astype(scales.dtype), **given) for means in both)
    return one, other


def opacities(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """(N,) in (0, 1), float64."""
    return 1 / (1 + np.exp(-np.clip(np.asarray(gaussians.opacity_logits, np.float64), -30, 30)))


def grow(
    gaussians: Gaussians,
    moments: tuple[Gaussians, Gaussians],
    votes: Float[Array, " n"],
    target: int,
    most: int,
    seed: list[int],
) -> tuple[Gaussians, tuple[Gaussians, Gaussians]]:
    """The arrays with up to `target` Gaussians: as many as are wanted, drawn by their votes, are each divided in two.
    The moments of the two begin at zero. Where the rows do not suffice they are doubled, up to those of the `most` that
    there will ever be: for each number of rows jax compiles anew."""
    gaussians, moments = jax.tree.map(np.array, (gaussians, moments))
    seen = in_use(gaussians)
    count = int(seen.sum())
    add = min(max(target - count, 0), int(AT_ONCE * count) + 1)
    if count + add > len(seen):
        rows = max(padded_row_count(count + add), min(padded_row_count(most), padded_row_count(2 * len(seen))))
        gaussians = pad_with_free_rows(gaussians, rows)
        moments, votes = pad_rows((moments, np.asarray(votes)), rows)
        seen = in_use(gaussians)
    parents = sample_rows(np.where(seen, votes, 0.0), add, np.random.default_rng(seed))
    places = np.flatnonzero(~seen)[: len(parents)]
    one, other = split_in_two(jax.tree.map(lambda a: a[parents], gaussians))
    for part, where in ((one, parents), (other, places)):
        for whole, new in zip(jax.tree.leaves(gaussians), jax.tree.leaves(part), strict=True):
            whole[where] = new
        for whole in jax.tree.leaves(moments):
            whole[where] = 0
    return gaussians, moments
