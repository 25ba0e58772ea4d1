"""The weight with which each Gaussian is seen at the one pixel that holds its centre, which is all that Occam's LGS and
VALA look at."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from jsecon.splat.batches import make_batches
from jsecon.splat.plan import ViewPlan
from jsecon.splat.stored import stored
from jsecon.splat.walk import make_table, walk, weights
from jsecon.types import Array


@jax.jit
def centre_weights(plan: ViewPlan) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """alpha T (N,) of each Gaussian at the pixel that its projected centre lies in, and that pixel (N,), row * width +
    column; -1, with weight 0, where it lies outside the image or the Gaussian is not visible.

    The same weights that a render composites with, picked out of the same walk over the tiles.
    """
    splats, lists = plan.splats, plan.lists
    batches, tile = make_batches(lists, plan.width), lists.tile
    table = make_table(splats)
    column, row = (jnp.floor(splats[:, k]).astype(jnp.int32) for k in range(2))
    inside = (splats[:, 5] > 0) & (column >= 0) & (column < plan.width) & (row >= 0) & (row < plan.height)

    def one_batch(found, tiles):
        corner_x, corner_y = (corner[:, None] for corner in batches.corners(tiles, splats.dtype))

        def body(transmittance, found, chunk):
            weight, transmittance = stored(chunk.always, weights, transmittance, chunk.alpha)
            x, y = (
                jnp.floor(chunk.attributes[..., k]).astype(jnp.int32) - corner.astype(jnp.int32)
                for k, corner in enumerate((corner_x, corner_y))
            )
            here = (x >= 0) & (x < tile) & (y >= 0) & (y < tile)
            pixel = jnp.where(here, y * tile + x, 0)
            own = jnp.take_along_axis(weight, pixel[..., None], axis=-1)[..., 0]
            return transmittance, found.at[chunk.ids].add(jnp.where(here, own, 0.0))

        return walk(table, lists, batches, tiles, body, found)[0], None

    found, _ = lax.scan(one_batch, jnp.zeros_like(splats[:, 0]), batches.tiles)
    return jnp.where(inside, found, 0.0), jnp.where(inside, row * plan.width + column, -1)
