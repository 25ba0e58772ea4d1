"""Hand-written gradient of compositing with respect to splats and features.

It goes front to back like the image: with G the cotangent, dL/dalpha_i = T_i <G, f_i> - (S - S_i) / (1 - alpha_i),
where S_i is the running sum of w <G, f> up to i and S its total, known from the image. No memory per pair is needed.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.numerics import FULL_PRECISION, MAX_ALPHA
from jsecon.splat.fusion import compute_once
from jsecon.splat.scan import (
    ATTRIBUTES,
    MAX_BATCH_BACKWARD,
    blend_weights,
    cumulative,
    make_batches,
    make_table,
    pixel_centres,
    scan_tiles,
    to_tiles,
)
from jsecon.splat.strips import map_strips, split_into_strips
from jsecon.splat.tiles import TileLists
from jsecon.types import Array


def composite_vjp(
    splats: Float[Array, "n 6"],
    features: Float[Array, "n d"],
    lists: TileLists,
    image: Float[Array, "h w d"],
    transmittance: Float[Array, "h w"],
    cotangent: Float[Array, "h w d"],
    cotangent_transmittance: Float[Array, "h w"],
    mesh: Mesh | None = None,
) -> tuple[Array, Array]:
    """Computes the gradients of `composite` with respect to splats (N, 6) and features (N, D).

    The transmittance is 1 - sum of w: its cotangent acts as minus the cotangent of a channel of ones.

    Args:
      splats: (N, 6) as in `ViewPlan`.
      features: (N, D).
      lists: Tile lists, cut to their visible lengths.
      image: Result of `composite`.
      transmittance: Result of `composite`.
      cotangent: Gradient of the image.
      cotangent_transmittance: Gradient of the transmittance.
      mesh: Devices that hold the strips, or None.
    """
    width, channels = cotangent.shape[1:]
    total = (image * cotangent).sum(-1) - (1 - transmittance) * cotangent_transmittance
    packed = jnp.concatenate([cotangent, cotangent_transmittance[..., None], total[..., None]], -1)

    x, y = (centres - lists.tile / 2 for centres in pixel_centres(lists.tile, splats.dtype))
    # All sums over a tile's pixels are moments of one quantity, h = alpha dL/dalpha, about the tile's centre.
    monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])

    def local(strip, divided, table):
        lists, (packed,) = divided
        batches = make_batches(lists, width, strip, MAX_BATCH_BACKWARD)
        in_tiles = to_tiles(packed, lists.tile)

        def one_batch(gradient, tiles):
            values = jnp.moveaxis(in_tiles[tiles], -1, 1)  # pixels innermost on both sides: the faster product
            local, along_transmittance, final = values[:, :channels], values[:, channels], values[:, channels + 1]
            corners = batches.corners(tiles, table.dtype)

            def body(transmittance, state, chunk):
                before, gradient = state
                weight, transmittance = compute_once(chunk.always, blend_weights, transmittance, chunk.alpha)
                along = _along(chunk.columns, local) - along_transmittance[:, None]
                slope, before = compute_once(chunk.always, _slopes, weight, chunk.alpha, along, before, final)
                moments = jnp.einsum("bcp,mp->bcm", slope, monomials, precision=FULL_PRECISION)
                by_attribute = _attribute_gradient(moments, chunk.attributes, corners, lists.tile / 2)
                by_feature = jnp.einsum("bcp,bdp->bcd", weight, local, precision=FULL_PRECISION)
                rows = jnp.concatenate([by_attribute, by_feature], axis=-1)
                return transmittance, (before, gradient.at[chunk.ids].add(rows))

            state = (jnp.zeros_like(final), gradient)
            return scan_tiles(table, lists, batches, tiles, body, state)[0][1], None

        start = jnp.zeros((splats.shape[0], ATTRIBUTES + channels), splats.dtype)
        return lax.scan(one_batch, start, batches.tiles)[0]

    strips = split_into_strips(packed, lists.tile, 1 if mesh is None else mesh.size)
    gradient = map_strips(local, (lists, strips), make_table(splats, features), mesh, total=True)
    return gradient[:, :ATTRIBUTES], gradient[:, ATTRIBUTES:]


def _along(features: Array, cotangent: Array) -> Array:
    """(B, CHUNK, D), (B, D, pixels) -> (B, CHUNK, pixels), the sum over the channels."""
    if features.shape[-1] > 8:  # fewer are summed in one kernel
        return jnp.einsum("bcd,bdp->bcp", features, cotangent, precision=FULL_PRECISION)
    terms = [features[..., d, None] * cotangent[:, None, d] for d in range(features.shape[-1])]
    return sum(terms[1:], terms[0])


def _slopes(weight: Array, alpha: Array, along: Array, before: Array, final: Array) -> tuple[Array, Array]:
    """Alpha dL/dalpha of a chunk (B, CHUNK, pixels), and the running sum of w <G, f> behind it (B, pixels)."""
    share = weight * along
    until, after = cumulative(jnp.add, before, share)
    rest = final[:, None] - (until + share)
    live = (weight > 0) & (alpha < MAX_ALPHA)
    return jnp.where(live, share - rest * (alpha / (1 - alpha)), 0.0), after


def _attribute_gradient(moments: Array, attributes: Array, corners: tuple[Array, Array], half: float) -> Array:
    """(B, CHUNK, 6) gradient from the six moments of h = alpha dL/dalpha about the tile's centre."""
    m, mx, my, mxx, mxy, myy = (moments[..., k] for k in range(6))
    x, y, l11, l21, l22, opacity = (attributes[..., k] for k in range(6))
    # moments about the Gaussian's centre
    sx, sy = corners[0][:, None] + half - x, corners[1][:, None] + half - y
    dx, dy = mx + sx * m, my + sy * m
    dxx, dxy = mxx + 2 * sx * mx + sx * sx * m, mxy + sx * my + sy * mx + sx * sy * m
    dyy = myy + 2 * sy * my + sy * sy * m
    # alpha = o exp(-(u^2 + v^2)), u = l11 dx + l21 dy, v = l22 dy
    u = l11 * dx + l21 * dy
    return jnp.stack(
        [
            2 * l11 * u,
            2 * (l21 * u + l22 * l22 * dy),
            -2 * (l11 * dxx + l21 * dxy),
            -2 * (l11 * dxy + l21 * dyy),
            -2 * l22 * dyy,
            jnp.where(opacity > 0, m / jnp.where(opacity > 0, opacity, 1.0), 0.0),
        ],
        axis=-1,
    )
