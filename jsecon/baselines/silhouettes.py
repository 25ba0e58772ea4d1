"""How the silhouettes of groups of Gaussians, each group rendered alone, lie on a view's masks: all groups in one walk.

Alone, a group is occluded by nothing but itself, so that its transmittance at a pixel is the product of its own
1 - alpha, in any order. One walk down the lists adds up the logarithms for every group, where rendering each of them
would walk the view once a group.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from jsecon.splat.batches import make_batches, to_tiles
from jsecon.splat.plan import ViewPlan
from jsecon.splat.walk import make_table, walk
from jsecon.types import Array


@functools.partial(jax.jit, static_argnames=("groups", "slots"))
def silhouette_overlaps(
    plan: ViewPlan,
    group_of: Int[Array, " n"],
    ids: Int[Array, "h w"],
    threshold: float | Float[Array, ""],
    *,
    groups: int,
    slots: int,
) -> tuple[Float[Array, "groups slots"], Float[Array, " groups"], Float[Array, " slots"]]:
    """Pixels (groups, slots) in which a group's alpha, rendered alone, is above `threshold` and that carry a mask's id;
    pixels (groups,) of each silhouette; pixels (slots,) of each mask.

    group_of (N,): 0 .. groups-1, -1 = none; ids (H, W): 0 .. slots-1, -1 = none. The same as rendering each group with
    the others deleted, for a threshold below 0.99: a render stops earlier only where alpha is at least that.
    """
    batches = make_batches(plan.lists, plan.width)
    table = make_table(plan.splats)
    masks = to_tiles(ids + 1, plan.lists.tile) - 1
    inside = to_tiles(jnp.ones(ids.shape, bool), plan.lists.tile)

    def one_batch(logs, tiles):
        def body(transmittance, logs, chunk):
            group = group_of[chunk.ids]
            row = jnp.where(group >= 0, group, groups)  # out of range: dropped
            return transmittance, logs.at[row, tiles[:, None]].add(jnp.log1p(-chunk.alpha), mode="drop")

        return walk(table, plan.lists, batches, tiles, body, logs)[0], None

    start = jnp.zeros((groups, *masks.shape), plan.splats.dtype)
    logs, _ = lax.scan(one_batch, start, batches.tiles)
    shown = ((logs < jnp.log1p(-jnp.asarray(threshold, start.dtype))) & inside).reshape(groups, -1).astype(start.dtype)
    of_mask = (masks.reshape(-1, 1) == jnp.arange(slots)).astype(start.dtype)
    return shown @ of_mask, shown.sum(1), of_mask.sum(0)
