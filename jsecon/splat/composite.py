"""Front-to-back alpha compositing of tile lists, and its transpose: the gradient with respect to the features.

A batch's tiles are walked together (walk.py), batch after batch; over several devices, each walks its strip.
"""

import jax.numpy as jnp
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float, Int

from jsecon.numerics import FULL_PRECISION, MIN_TRANSMITTANCE
from jsecon.splat.fusion import materialize
from jsecon.splat.strips import join_strips, map_strips, split_into_strips
from jsecon.splat.tiles import TileLists
from jsecon.splat.walk import CHUNK, blend_weights, make_batches, make_table, to_image, to_tiles, walk
from jsecon.types import Array

WIDE = 6
"""from this many channels on, a chunk's weights are computed once and kept; below, anew for each channel"""


def composite(
    splats: Float[Array, "n 6"],
    features: Float[Array, "n d"],
    lists: TileLists,
    width: int,
    height: int,
    mesh: Mesh | None = None,
) -> tuple[Float[Array, "h w d"], Float[Array, "h w"], Int[Array, " tiles"]]:
    """Features (H, W, D) = sum of alpha T f in the splats' dtype (bfloat16 `features` are read as such), final
    transmittance (H, W), and how far down each tile's list anything is seen: lists cut there composite to the same, and
    have the same gradient."""
    channels = features.shape[1] + 1
    # Wide features are gathered as they are: a table of them would be written anew in every render.
    apart = channels > WIDE or features.dtype != splats.dtype

    def local(strip, lists, common):
        (table, features), batches = common, make_batches(lists, width, strip)

        def body(transmittance, total, chunk):
            if apart:
                given = features[chunk.ids].astype(table.dtype)
                chunk = chunk._replace(columns=jnp.concatenate([given, chunk.columns], axis=-1))
            if channels <= WIDE:
                return _summed_anew(transmittance, total, chunk)
            weight, transmittance = materialize(chunk.always, blend_weights, transmittance, chunk.alpha)
            for k in range(CHUNK):
                total = total + weight[:, None, k] * chunk.columns[:, k, :, None]
            return transmittance, total

        def one_batch(tiles):
            total = jnp.zeros((tiles.shape[0], channels, batches.tile**2), table.dtype)
            return walk(table, lists, batches, tiles, body, total)

        totals, seen = lax.map(one_batch, batches.tiles)
        image = to_image(totals, batches, width)[None]
        by_tile = jnp.zeros(batches.number + 1, jnp.int32).at[batches.tiles].set(seen)[:-1]
        return image[..., :-1], 1 - image[..., -1], by_tile

    # A last channel of ones sums the weights: the final transmittance is what they leave of 1.
    ones = jnp.ones_like(splats[:, :1])
    table = make_table(splats, ones) if apart else make_table(splats, features, ones)
    image, transmittance, seen = map_strips(local, lists, (table, features if apart else None), mesh)
    return join_strips(image, lists.tile, height), join_strips(transmittance, lists.tile, height), seen


def _summed_anew(transmittance: Array, total: Array, chunk) -> tuple[Array, Array]:
    """The recurrence written out inside the kernel of each channel: for few channels cheaper than storing weights."""
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
    """Gradient with respect to the features alone: W^T cotangent. No gradient of the geometry is computed."""
    width, channels = cotangent.shape[1:]

    def local(strip, dealt, table):
        lists, (image,) = dealt
        batches, cotangents = make_batches(lists, width, strip), to_tiles(image, lists.tile)

        def one_batch(gradient, tiles):
            values = jnp.moveaxis(cotangents[tiles], -1, 1)  # pixels innermost on both sides: the faster product

            def body(transmittance, gradient, chunk):
                weight, transmittance = materialize(chunk.always, blend_weights, transmittance, chunk.alpha)
                own = jnp.einsum("bcp,bdp->bcd", weight, values, precision=FULL_PRECISION)
                return transmittance, gradient.at[chunk.ids].add(own)

            return walk(table, lists, batches, tiles, body, gradient)[0], None

        return lax.scan(one_batch, jnp.zeros((splats.shape[0], channels), splats.dtype), batches.tiles)[0]

    strips = split_into_strips(cotangent, lists.tile, 1 if mesh is None else mesh.size)
    return map_strips(local, (lists, strips), make_table(splats), mesh, total=True)
