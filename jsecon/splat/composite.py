"""Front-to-back alpha compositing of tile lists, and its transpose, the gradient with respect to the features.

The tiles of a batch are scanned together (scan.py), one batch after another. Each device scans one strip.
"""

import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from jsecon.numerics import FULL_PRECISION, MIN_TRANSMITTANCE
from jsecon.splat.fusion import compute_once
from jsecon.splat.scan import CHUNK, Batches, blend_weights, make_batches, make_table, scan_tiles, to_tiles
from jsecon.splat.strips import join_strips, map_strips, split_into_strips
from jsecon.splat.tiles import TileLists
from jsecon.types import Array

MAX_RECOMPUTED = 6
"""Number of channels above which the weights of a chunk are stored instead of recomputed for each channel."""


def composite(
    splats: Float[Array, "n 6"],
    features: Float[Array, "n d"],
    lists: TileLists,
    width: int,
    height: int,
    mesh: Mesh | None = None,
) -> tuple[Float[Array, "h w d"], Float[Array, "h w"], Int[Array, " tiles"]]:
    """Composites features (N, D): the sum of alpha T f.

    Returns:
      Image (H, W, D) in the dtype of the splats, final transmittance (H, W), and (tiles,) int32 the visible length of
      each list: lists cut there have the same image and the same gradient.
    """
    channels = features.shape[1] + 1
    # Wide features are gathered from their array: a table with them would be written again in every render.
    separate = channels > MAX_RECOMPUTED

    def local(strip, lists, common):
        (table, features), batches = common, make_batches(lists, width, strip)

        def body(transmittance, total, chunk):
            if separate:
                chunk = chunk._replace(columns=jnp.concatenate([features[chunk.ids], chunk.columns], axis=-1))
            else:
                return _add_recomputed(transmittance, total, chunk)
            weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
            for k in range(CHUNK):
                total = total + weight[:, None, k] * chunk.columns[:, k, :, None]
            return transmittance, total

        def one_batch(tiles):
            total = jnp.zeros((tiles.shape[0], channels, batches.tile**2), table.dtype)
            return scan_tiles(table, lists, batches, tiles, body, total)

        totals, seen = lax.map(one_batch, batches.tiles)
        image = _to_image(totals, batches, width)[None]
        by_tile = jnp.zeros(batches.number + 1, jnp.int32).at[batches.tiles].set(seen)[:-1]
        return image[..., :-1], 1 - image[..., -1], by_tile

    # A last channel of ones sums the weights: the final transmittance is 1 minus them.
    ones = jnp.ones_like(splats[:, :1])
    table = make_table(splats, ones) if separate else make_table(splats, features, ones)
    image, transmittance, seen = map_strips(local, lists, (table, features if separate else None), mesh)
    return join_strips(image, lists.tile, height), join_strips(transmittance, lists.tile, height), seen


def _to_image(batched: Array, batches: Batches, width: int) -> Array:
    """Arranges batches (batches, B, D, pixels) as the image (rows, W, D) of the strip."""
    down, tile, channels = batches.number // batches.across, batches.tile, batched.shape[2]
    slots = batches.tiles.reshape(-1)
    place = jnp.zeros(batches.number + 1, jnp.int32).at[slots].set(lax.iota(jnp.int32, slots.shape[0]))[:-1]
    tiles = batched.reshape(slots.shape[0], channels, tile, tile)[place]
    image = tiles.reshape(down, batches.across, channels, tile, tile).transpose(0, 3, 1, 4, 2)
    return image.reshape(down * tile, batches.across * tile, channels)[:, :width]


def _add_recomputed(transmittance: Array, total: Array, chunk) -> tuple[Array, Array]:
    """Adds a chunk with the recurrence in the kernel of each channel: cheaper than stored weights for few channels."""
    left = jnp.broadcast_to(transmittance[:, None], total.shape)
    for k in range(CHUNK):
        weight = left * chunk.alpha[:, None, k]
        left = left - weight
        total = total + jnp.where(left > MIN_TRANSMITTANCE, weight, 0.0) * chunk.columns[:, k, :, None]
    for k in range(CHUNK):
        transmittance = transmittance - transmittance * chunk.alpha[:, k]
    return transmittance, total


def composite_features_vjp(
    splats: Float[Array, "n 6"], lists: TileLists, cotangent: Float[Array, "h w d"], mesh: Mesh | None = None
) -> Float[Array, "n d"]:
    """Computes the gradient (N, D) with respect to the features alone: W^T cotangent."""
    width, channels = cotangent.shape[1:]

    def local(strip, divided, table):
        lists, (image,) = divided
        batches, cotangents = make_batches(lists, width, strip), to_tiles(image, lists.tile)

        def one_batch(gradient, tiles):
            values = jnp.moveaxis(cotangents[tiles], -1, 1)  # pixels innermost on both sides: the faster product

            def body(transmittance, gradient, chunk):
                weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
                rows = jnp.einsum("bcp,bdp->bcd", weight, values, precision=FULL_PRECISION)
                return transmittance, gradient.at[chunk.ids].add(rows)

            return scan_tiles(table, lists, batches, tiles, body, gradient)[0], None

        return lax.scan(one_batch, jnp.zeros((splats.shape[0], channels), splats.dtype), batches.tiles)[0]

    strips = split_into_strips(cotangent, lists.tile, 1 if mesh is None else mesh.size)
    return map_strips(local, (lists, strips), make_table(splats), mesh, total=True)
