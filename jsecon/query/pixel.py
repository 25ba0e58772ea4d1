"""Which region lies under a pixel of a frame: the votes of the Gaussians that make up that pixel, by their weights."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError
from jsecon.language.membership import ROWS, vote_shares, votes_of_rows
from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.project import project
from jsecon.types import Array, Camera, Gaussians, LanguageField

MIN_SHARE = 0.05
"""a region that makes up less of a pixel than this is no answer to what lies there: the pixel is background"""


def pixel_weights(
    gaussians: Gaussians, camera: Camera, x: int, y: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Ids (M,) front to back and weights alpha T (M,) of the Gaussians that make up pixel (column x, row y) of a view.

    By the definition of the image (jsecon.splat.render), without tiles: O(N) for one pixel, where a render is O(N) too
    and would have to carry every region as a channel. Host code; columns that are mapped are read in blocks.
    """
    mapped = any(isinstance(column, np.memmap) for column in jax.tree.leaves(gaussians))
    rows, found = ROWS if mapped else max(gaussians.count, 1), []
    for first in range(0, gaussians.count, rows):
        block = jax.tree.map(lambda a, own=slice(first, first + rows): jnp.asarray(a[own]), gaussians)
        alpha, depths = (np.asarray(a) for a in _alphas(block, camera, x + 0.5, y + 0.5))
        own = np.flatnonzero(alpha)
        found.append((own + first, alpha[own], depths[own]))
    ids, alpha, depths = (np.concatenate(column) for column in zip(*found)) if found else np.zeros((3, 0))
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


def region_shares_at(field: LanguageField, frame: int, x: int, y: int) -> Float[np.ndarray, " r"]:
    """(R,) how much of pixel (column x, row y) of frame `frame` each region makes up: the rendered shares p_nr,

        sum_n w_n p_nr

    with w the weights alpha T of the Gaussians there. Each is at most the pixel's alpha.
    Raises InputError for a frame or a pixel that the field does not have.
    """
    frames, width, height = field.cameras.world_to_camera.shape[0], field.cameras.width, field.cameras.height
    if not 0 <= frame < frames:
        raise InputError("frame", str(frame), f"0 to {frames - 1}", "Frames are numbered in the order of their names.")
    if not (0 <= x < width and 0 <= y < height):
        remedy = f"Give x and y in the frames as the run used them, {width}x{height}."
        known = f"column 0 to {width - 1}, row 0 to {height - 1}"
        raise InputError("pixel", f"column {x}, row {y} is outside the frame", known, remedy)
    return region_shares_seen(field, jax.tree.map(jnp.asarray, field.cameras)[frame], x, y)


def region_shares_seen(field: LanguageField, camera: Camera, x: int, y: int) -> Float[np.ndarray, " r"]:
    """`region_shares_at` for a camera that is none of the field's."""
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
    """The region that makes up most of pixel (column x, row y) of frame `frame`; -1 where none makes up `min_share`.

    See `region_shares_at`, also for what it raises.
    """
    shares = region_shares_at(field, frame, x, y)
    return int(shares.argmax()) if shares.size and shares.max() >= min_share else -1
