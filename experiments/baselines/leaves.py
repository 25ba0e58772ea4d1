"""The leaves of OpenGaussian's codebook: the k-means that makes them, and how their silhouettes lie on a view's masks.

k-means (yanmin-wu/OpenGaussian, scene/kmeans_quantize.py): coarse over all Gaussians, fine within each root.

Silhouettes: alone, a group of Gaussians is occluded by nothing but itself, so that its transmittance at a pixel is the
product of its own 1 - alpha, in any order. One walk down the lists adds up the logarithms for every group, where
rendering each of them would walk the view once per group.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from jsecon.splat.plan import ViewPlan
from jsecon.splat.scan import make_batches, make_table, scan_tiles, to_tiles
from jsecon.types import Array

LLOYD = 5
"""rounds of each k-means"""
_GROUPS = 64
"""groups are counted in multiples of this, so that few shapes are compiled"""


@jax.jit
def assign_to_centres(
    points: Float[Array, "n d"], centres: Float[Array, "k d"]
) -> tuple[Int[Array, " n"], Float[Array, "k d"]]:
    """Assignment (N,) and centres (K, D) after five rounds of k-means; an empty centre stays where it is."""

    def assign(centres):
        squares = jnp.sum(points**2, 1)[:, None] - 2 * points @ centres.T + jnp.sum(centres**2, 1)[None]
        return jnp.argmin(squares, axis=1)

    def one(_, centres):
        return cluster_means(points, assign(centres), centres)

    centres = jax.lax.fori_loop(0, LLOYD, one, centres)
    return assign(centres), centres


def cluster_means(
    points: Float[Array, "n d"], of: Int[Array, " n"], before: Float[Array, "k d"]
) -> Float[Array, "k d"]:
    """Mean of the points of each cluster; `before` for an empty one."""
    count = jax.ops.segment_sum(jnp.ones(len(points)), of, len(before))[:, None]
    summed = jax.ops.segment_sum(points, of, len(before))
    return jnp.where(count > 0, summed / jnp.maximum(count, 1), before)


def split_roots(
    units: Float[Array, "n d"], root_of: Int[Array, " n"], number: Int[np.ndarray, " k"], leaves: int
) -> Int[Array, " n"]:
    """(N,) root * leaves + cluster: k-means of the features within each root, from the features farthest apart."""
    exact, roots = np.asarray(units, np.float64), np.asarray(root_of)
    result = np.zeros(len(exact), np.int32)
    for root in np.unique(roots):
        members = np.flatnonzero(roots == root)
        points = exact[members]
        chosen = [int(np.argmax(((points - points.mean(0)) ** 2).sum(1)))]
        gap = ((points - points[chosen[0]]) ** 2).sum(1)
        while len(chosen) < min(number[root], len(points)):
            chosen.append(int(gap.argmax()))
            gap = np.minimum(gap, ((points - points[chosen[-1]]) ** 2).sum(1))
        centres = points[chosen]
        for _ in range(LLOYD):
            of = ((points[:, None] - centres[None]) ** 2).sum(-1).argmin(1)
            centres = np.stack([points[of == k].mean(0) if (of == k).any() else c for k, c in enumerate(centres)])
        result[members] = root * leaves + of
    return jnp.asarray(result)


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

        return scan_tiles(table, plan.lists, batches, tiles, body, logs)[0], None

    start = jnp.zeros((groups, *masks.shape), plan.splats.dtype)
    logs, _ = lax.scan(one_batch, start, batches.tiles)
    shown = ((logs < jnp.log1p(-jnp.asarray(threshold, start.dtype))) & inside).reshape(groups, -1).astype(start.dtype)
    of_mask = (masks.reshape(-1, 1) == jnp.arange(slots)).astype(start.dtype)
    return shown @ of_mask, shown.sum(1), of_mask.sum(0)


def view_overlaps(
    views: tuple[ViewPlan, Int[Array, "t h w"]],
    group_of: Int[Array, " n"],
    threshold: float,
    *,
    groups: int,
    slots: int,
) -> tuple[Float[np.ndarray, "t groups slots"], Float[np.ndarray, "t groups"], Float[np.ndarray, "t slots"]]:
    """`silhouette_overlaps` of each view, by its plan and ids."""
    both, area, pixels = _of_views(views, group_of, threshold, _GROUPS * -(-groups // _GROUPS), slots)
    return np.asarray(both)[:, :groups], np.asarray(area)[:, :groups], np.asarray(pixels)


@functools.partial(jax.jit, static_argnums=(2, 3, 4))
def _of_views(views, group_of, threshold, groups, slots):
    def one(view):
        return silhouette_overlaps(view[0], group_of, view[1], threshold, groups=groups, slots=slots)

    return lax.map(one, views)
