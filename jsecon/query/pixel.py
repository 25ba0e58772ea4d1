"""The region under a pixel: the votes of the Gaussians that make up the pixel, by their weights. Host code."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError
from jsecon.field.columns import row_slices, votes_of_rows
from jsecon.field.membership import vote_shares
from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.project import project
from jsecon.types import Array, Camera, Gaussians, LanguageField

MIN_SHARE = 0.05
"""Smallest part of a pixel that a region must make up; the pixel is background otherwise."""


class PixelWeights(NamedTuple):
    """The M Gaussians that make up a pixel, front to back."""

    ids: Int[np.ndarray, " m"]
    """Which Gaussians they are."""
    weights: Float[np.ndarray, " m"]
    """Their weights alpha T."""


def pixel_weights(gaussians: Gaussians, camera: Camera, x: int, y: int) -> PixelWeights:
    """Composites one pixel, without tiles: O(N), where a render would have to carry every region as a channel.

    Args:
      gaussians: Scene of N Gaussians; its columns may be memory-mapped.
      camera: The view.
      x: Column of the pixel.
      y: Row of the pixel.

    Returns:
      The Gaussians that make up the pixel.
    """
    columns: list[Any] = [np.zeros((3, 0))]
    for rows in row_slices(gaussians, gaussians.count):
        block = jax.tree.map(lambda a, rows=rows: jnp.asarray(a[rows]), gaussians)
        alpha, depths = (np.asarray(a) for a in _alphas(block, camera, x + 0.5, y + 0.5))
        hit = np.flatnonzero(alpha)
        columns.append((hit + rows.start, alpha[hit], depths[hit]))
    ids, alpha, depths = (np.concatenate(column) for column in zip(*columns))
    order = np.argsort(depths, kind="stable")  # ties in depth keep index order
    ids, alpha = ids[order].astype(np.int64), alpha[order]
    after = np.cumprod(1.0 - alpha.astype(np.float64))
    seen = after > MIN_TRANSMITTANCE
    before = np.concatenate([[1.0], after])[: seen.sum()]
    return PixelWeights(ids[seen], alpha[seen] * before)


@jax.jit
def _alphas(gaussians: Gaussians, camera: Camera, x: Array | float, y: Array | float) -> tuple[Array, Array]:
    splats = project(gaussians, camera)
    dx, dy = x - splats.means_px[:, 0], y - splats.means_px[:, 1]
    u, v = splats.whitening[:, 0] * dx + splats.whitening[:, 1] * dy, splats.whitening[:, 2] * dy
    alpha = splats.opacities * jnp.exp(-0.5 * (u * u + v * v))
    counts = splats.visible & (alpha >= MIN_ALPHA)
    return jnp.where(counts, jnp.minimum(alpha, MAX_ALPHA), 0.0), splats.depths


def region_shares_seen(field: LanguageField, camera: Camera, x: int, y: int) -> Float[np.ndarray, " r"]:
    """Computes how much of a pixel each region makes up: sum_n w_n p_nr, w the weights alpha T and p the vote shares.

    Args:
      field: Field of R regions.
      camera: The view.
      x: Column of the pixel.
      y: Row of the pixel.

    Returns:
      (R,), each at most the pixel's alpha.
    """
    ids, weights = pixel_weights(field.gaussians, camera, x, y)
    shares = np.zeros(field.regions.count)
    if not len(ids):
        return shares
    votes = votes_of_rows(field.votes, np.resize(ids, 1 << (len(ids) - 1).bit_length()))  # few sizes to compile for
    regions = votes.regions[: len(ids)]
    share = np.nan_to_num(np.asarray(vote_shares(votes))[: len(ids)].astype(np.float64))
    np.add.at(shares, np.where(regions >= 0, regions, 0), share * weights[:, None])
    return shares


def region_at(field: LanguageField, frame: int, x: int, y: int, *, min_share: float = MIN_SHARE) -> int:
    """Finds the region that makes up most of a pixel.

    Args:
      field: The field.
      frame: Index of the frame.
      x: Column of the pixel.
      y: Row of the pixel.
      min_share: Smallest part of the pixel that it must make up.

    Returns:
      The region, or -1 for background.

    Raises:
      InputError: The field does not have the frame or the pixel.
    """
    frames, width, height = field.cameras.world_to_camera.shape[0], field.cameras.width, field.cameras.height
    if not 0 <= frame < frames:
        raise InputError("frame", str(frame), f"0 to {frames - 1}", "Frames are numbered in the order of their names.")
    if not (0 <= x < width and 0 <= y < height):
        remedy = f"Give x and y in the frames as the run used them, {width}x{height}."
        known = f"column 0 to {width - 1}, row 0 to {height - 1}"
        raise InputError("pixel", f"column {x}, row {y} is outside the frame", known, remedy)
    shares = region_shares_seen(field, jax.tree.map(jnp.asarray, field.cameras)[frame], x, y)
    return int(shares.argmax()) if shares.size and shares.max() >= min_share else -1
