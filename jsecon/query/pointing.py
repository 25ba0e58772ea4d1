"""What is pointed at in a frame: the region under a pixel, and the Gaussians of a box or a mask. Host code.

The region under a pixel is that of the Gaussians that make it up, by their weights. Of an outline in one frame or
several, its rendering weights decide on the Gaussians that the frames see. The field's regions, which all views made,
decide on the others, such as the far side of a mug.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.errors import InputError, require
from jsecon.field.columns import row_slices, votes_of_rows
from jsecon.field.evidence import region_votes
from jsecon.field.membership import SHARE_THRESHOLD, inside_fraction, vote_shares
from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.project import project
from jsecon.types import Array, Camera, Gaussians, LanguageField, Selection

MIN_SHARE = 0.05
"""Smallest part of a pixel that a region must make up; the pixel is background otherwise."""
OUTSIDE, INSIDE, UNKNOWN = 0, 1, 2
"""Values of an outline's pixels; a box only knows its outside."""
PRIOR_PX = 4.0
"""Weight of the regions against that of the outline, px."""


def _pixel_weights(
    gaussians: Gaussians, camera: Camera, x: int, y: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Composites one pixel: the ids of the Gaussians that make it up, front to back, and their weights alpha T.

    Without tiles it is O(N), where a render would have to carry every region as a channel. The columns may be
    memory-mapped.
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
    return ids[seen], alpha[seen] * before


@jax.jit
def _alphas(gaussians: Gaussians, camera: Camera, x: Array | float, y: Array | float) -> tuple[Array, Array]:
    splats = project(gaussians, camera)
    dx, dy = x - splats.means_px[:, 0], y - splats.means_px[:, 1]
    u, v = splats.whitening[:, 0] * dx + splats.whitening[:, 1] * dy, splats.whitening[:, 2] * dy
    alpha = splats.opacities * jnp.exp(-0.5 * (u * u + v * v))
    counts = splats.visible & (alpha >= MIN_ALPHA)
    return jnp.where(counts, jnp.minimum(alpha, MAX_ALPHA), 0.0), splats.depths


def region_at(field: LanguageField, frame: int | str, x: int, y: int) -> int:
    """Finds the region that makes up most of a pixel: the largest sum_n w_n p_nr.

    The weights w of the Gaussians there are alpha T, and p are their vote shares. The sum is at most the pixel's alpha.

    Args:
      field: The field.
      frame: Index or name of the frame.
      x: Column of the pixel.
      y: Row of the pixel.

    Returns:
      The region, or -1 for background.

    Raises:
      InputError: The field does not have the frame or the pixel.
    """
    frame, width, height = frame_index(field, frame), field.cameras.width, field.cameras.height
    if not (0 <= x < width and 0 <= y < height):
        remedy = f"Give x and y in the frames as the run used them, {width}x{height}."
        known = f"column 0 to {width - 1}, row 0 to {height - 1}"
        raise InputError("pixel", f"column {x}, row {y} is outside the frame", known, remedy)
    ids, weights = _pixel_weights(field.gaussians, jax.tree.map(jnp.asarray, field.cameras)[frame], x, y)
    if not len(ids) or not field.regions.count:
        return -1
    votes = votes_of_rows(field.votes, np.resize(ids, 1 << (len(ids) - 1).bit_length()))  # few sizes to compile for
    regions = votes.regions[: len(ids)]
    share = np.nan_to_num(np.asarray(vote_shares(votes))[: len(ids)].astype(np.float64))
    shares = np.zeros(field.regions.count)
    np.add.at(shares, np.where(regions >= 0, regions, 0), share * weights[:, None])
    return int(shares.argmax()) if shares.max() >= MIN_SHARE else -1


def lift(
    field: LanguageField,
    masks: Bool[np.ndarray, "k h w"] | Int[np.ndarray, "k h w"],
    frames: Sequence[int | str],
    *,
    threshold: float = SHARE_THRESHOLD,
) -> Selection:
    """Selects the Gaussians of one object that is outlined in K frames of a field.

    With a_n and b_n the weight of Gaussian n on pixels inside and outside of the masks (`region_votes`), and p_n its
    share of the regions that lie in the masks by at least half of what the frames see of them, its share is

        (a_n + PRIOR_PX p_n) / (a_n + b_n + PRIOR_PX)

    If no region lies there, the outline alone decides.

    Args:
      field: The field.
      masks: (K, H, W) bool, or integers of OUTSIDE, INSIDE and UNKNOWN.
      frames: Index or name of each frame; held-out frames count too.
      threshold: Smallest share of a selected Gaussian.

    Returns:
      The selection. `region` is the region that lies in the masks with most of its weight, or -1; `score` its part
      inside.

    Raises:
      InputError: The field does not have a frame, or the masks have no pixel inside.
      ValueError: The masks have another size.
    """
    index = [frame_index(field, frame) for frame in frames]
    size = field.cameras.height, field.cameras.width
    masks = np.asarray(masks).astype(np.int32)
    valid = bool(np.isin(masks, (OUTSIDE, INSIDE, UNKNOWN)).all())
    fit = len(index) > 0 and masks.shape == (len(index), *size) and valid
    remedy = f"Give one mask per frame, {size[1]} wide and {size[0]} high, of the frames as the run used them."
    require(fit, "masks", f"{masks.shape} with {len(index)} frames", f"({len(index)}, {size[0]}, {size[1]})", remedy)
    if not (masks != OUTSIDE).any():
        raise InputError("masks", "no pixel inside", "an outline of a thing", "Mark the thing's pixels.")
    gaussians, cameras = jax.tree.map(jnp.asarray, (field.gaussians, field.cameras))
    cast = region_votes(gaussians, cameras[np.asarray(index)], jnp.asarray(masks), UNKNOWN + 1, top=UNKNOWN + 1)
    weight = np.asarray(cast.dense())
    outside, inside, unknown = weight[:, OUTSIDE], weight[:, INSIDE], weight[:, UNKNOWN]
    within = _regions_within(field, inside + unknown, outside)
    chosen = within >= 0.5
    known = np.asarray(inside_fraction(field.votes, jnp.asarray(chosen)).fraction)
    prior = PRIOR_PX if chosen.any() else 1e-9
    share = (inside + prior * known) / (inside + outside + prior)
    region = int(within.argmax()) if chosen.any() else -1
    score = float(within.max(initial=0.0))
    finite = np.isfinite(share)
    mask = finite & (share >= threshold)
    similarity = np.where(finite, share, 0.0).astype(np.float32)
    return Selection(*map(jnp.asarray, (mask, similarity, np.int32(region), np.float32(score))))


def _regions_within(field: LanguageField, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """(R,) part of each region's weight in the frames that lies inside."""
    regions = np.asarray(field.votes.regions)
    share = np.where(regions >= 0, np.nan_to_num(np.asarray(vote_shares(field.votes))), 0.0)
    place, totals = np.maximum(regions, 0).ravel(), []
    for weight in (inside, outside):
        totals.append(np.bincount(place, (share * weight[:, None]).ravel(), field.regions.count))
    return totals[0] / np.maximum(totals[0] + totals[1], 1e-9)


def frame_index(field: LanguageField, frame: int | str) -> int:
    """Finds a frame by its name, or by its index, an integer or "#10"; raises InputError if there is no such frame."""
    names, index = field.names, frame
    if isinstance(frame, str):
        for name in (frame, Path(frame).stem):
            if name in names:
                return names.index(name)
        digits = re.fullmatch(r"#([0-9]{1,9})", frame)
        index = int(digits[1]) if digits else -1
    if isinstance(index, int | np.integer) and 0 <= index < len(names):
        return int(index)
    known = f"a name ({names[0]} ... {names[-1]}) or a place, #0 to #{len(names) - 1}" if names else ""
    remedy = "report.html of the run shows the frames."
    raise InputError(f"frame {frame}", "no such frame in the field", known, remedy)
