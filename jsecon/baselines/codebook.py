"""The k-means of OpenGaussian's codebook: coarse over all Gaussians, fine within each root (REFERENCE D.3)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.types import Array

LLOYD = 5
"""rounds of each k-means"""


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
