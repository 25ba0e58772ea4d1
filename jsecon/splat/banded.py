"""A picture of a scene that need not fit into memory: its bands (bands.py) composited one after the other.

The readable twin is `render_rgb`; equal to it up to float32's rounding, which here and there takes a pixel's last
weight, of at most 0.01, to the other side of the transmittance at which it stops.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from jsecon.numerics import FULL_PRECISION, MIN_TRANSMITTANCE, NEAR
from jsecon.splat.bands import MOST_HELD, Bounds, band_size, bands, block_bounds
from jsecon.splat.fusion import materialize
from jsecon.splat.project import Projection
from jsecon.splat.sh import colours_from_sh
from jsecon.splat.tiles import TILE, TileLists, tile_grid, tile_lists
from jsecon.splat.walk import blend_weights, make_batches, make_table, to_tiles, walk
from jsecon.types import Array, Camera, Gaussians


def render_in_blocks(
    gaussians: Gaussians,
    camera: Camera,
    *,
    bounds: Bounds | None = None,
    near: float = NEAR,
    most_held: int = MOST_HELD,
) -> Float[np.ndarray, "h w 3"]:
    """The features of `render_rgb` of N Gaussians in memory-mapped columns, (H, W, 3).

    `bounds`: the scene's `block_bounds`, which are made where they are not given. Memory: `most_held` visible splats,
    150 bytes each at the peak, and a band with its harmonics. One device, host code. Numbers must be finite. Raises
    ValueError on shapes that disagree.
    """
    camera = jax.tree.map(np.asarray, camera)
    size = band_size(gaussians.count, camera.width, camera.height)
    across, down = tile_grid(camera.width, camera.height, TILE)
    left = to_tiles(jnp.ones((camera.height, camera.width), jnp.float32), TILE)  # what is outside the image has stopped
    image = jnp.zeros((left.shape[0], 3, left.shape[1]), jnp.float32)
    is_open = lambda: np.asarray(still_open(left)).reshape(down, across)
    bounds = block_bounds(gaussians) if bounds is None else bounds
    for band in bands(gaussians, bounds, camera, is_open, near=near, size=size, most_held=most_held):
        splats, lists = listed(band.splats, camera.width, camera.height, size)
        rows = np.resize(band.ids, size)
        part = jax.tree.map(lambda a, rows=rows: np.asarray(a)[rows], gaussians)
        image, left = _composite_band(splats, _colours(part, camera), lists, image, left, camera.width)
    tiles = np.asarray(image)[:-1].reshape(down, across, 3, TILE, TILE).transpose(0, 3, 1, 4, 2)
    return tiles.reshape(down * TILE, across * TILE, 3)[: camera.height, : camera.width]


_colours = jax.jit(colours_from_sh)


@jax.jit
def still_open(left: Float[Array, "t p"]) -> Array:
    """(tiles,) whether a pixel has not stopped, of the transmittance (tiles + 1, pixels) that is left."""
    return left[:-1].max(1) > MIN_TRANSMITTANCE


@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def listed(projection: Projection, width: int, height: int, capacity: int) -> tuple[Array, TileLists]:
    """The splats of a band (S, 6), as in a plan, and their tile lists."""
    columns = projection.means_px, projection.whitening * math.sqrt(0.5), projection.opacities[:, None]
    splats = jnp.where(projection.visible[:, None], jnp.concatenate(columns, axis=1), 0.0)
    return splats, tile_lists(projection, width, height, capacity=capacity)


@functools.partial(jax.jit, static_argnums=5)
def _composite_band(
    splats: Array, rgb: Array, lists: TileLists, image: Array, left: Array, width: int
) -> tuple[Array, Array]:
    """(tiles + 1, 3, pixels) the image with the band, and (tiles + 1, pixels) the transmittance behind it. Tiles that
    have stopped are passed over."""
    lists = dataclasses.replace(lists, lengths=jnp.where(still_open(left), lists.lengths, 0))
    batches, table = make_batches(lists, width), make_table(splats, rgb)

    def one_batch(carry, ids_of_tiles):
        image, left = carry

        def body(transmittance, inner, chunk):
            total, _ = inner
            weight, transmittance = materialize(chunk.always, blend_weights, transmittance, chunk.alpha)
            total = total + jnp.einsum("bkp,bkd->bdp", weight, chunk.columns, precision=FULL_PRECISION)
            return transmittance, (total, transmittance)

        start = left[ids_of_tiles]
        (total, behind), _ = walk(table, lists, batches, ids_of_tiles, body, (image[ids_of_tiles], start), start)
        return (image.at[ids_of_tiles].set(total), left.at[ids_of_tiles].set(behind)), None

    return lax.scan(one_batch, (image, left), batches.tiles)[0]
