"""Front-to-back alpha compositing of tile lists: gradient, rule for vmap, and containment of non-finite features.

The tiles of a batch are scanned together (scan.py), one batch after another. Each device scans one strip.

The gradient (reverse mode only) is written by hand, front to back like the image. With G the cotangent, dL/dalpha_i =
T_i <G, f_i> - (S - S_i) / (1 - alpha_i), where S_i is the running sum of w <G, f> up to i and S its total, known from
the image: no memory per pair is needed. Symbolic zeros show whether the gradient of the geometry is needed, so that a
field that is distilled into frozen Gaussians does not compute it.

vmap: a batched loop with early exit runs as long as its slowest member. So the members of a batch are scanned one after
another. Pass several feature sets of one view as more channels instead.

Zero times NaN is NaN, so a non-finite feature would spread to its whole tile, and through the padding of lists to other
tiles. Such features are composited as zeros instead, and a second walk, only if there are any, marks their pixels.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap, sequential_vmap
from jax.sharding import Mesh
from jaxtyping import Float, Int

from jsecon.numerics import FULL_PRECISION, MAX_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.fusion import compute_once
from jsecon.splat.scan import (
    ATTRIBUTES,
    CHUNK,
    Batches,
    blend_weights,
    cumulative,
    make_batches,
    make_table,
    pixel_centres,
    scan_tiles,
    to_tiles,
)
from jsecon.splat.strips import BLOCK, map_strips, tile_rows
from jsecon.splat.tiles import TileLists
from jsecon.types import Array


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
    # Wide features are gathered from their array, as a table with them would be written again in every render; and the
    # weights of a chunk are stored instead of recomputed for each channel.
    separate = channels > 6

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
    return _join_strips(image, lists.tile, height), _join_strips(transmittance, lists.tile, height), seen


def _split_into_strips(image: Array, tile: int, count: int) -> Array:
    """Divides an image (H, W, ...) into strips (count, rows of a strip in px, W, ...), zero below the image."""
    height, *rest = image.shape
    rows = tile_rows(height, tile, count) * tile
    image = jnp.pad(image, [(0, count * rows - height)] + [(0, 0)] * len(rest))
    if count == 1:
        return image[None]
    return jnp.moveaxis(image.reshape(-1, count, BLOCK * tile, *rest), 1, 0).reshape(count, rows, *rest)


def _join_strips(strips: Array, tile: int, height: int) -> Array:
    """Joins strips (count, rows in px, W, ...) to an image (H, W, ...): the inverse of `_split_into_strips`."""
    count, rows, *rest = strips.shape
    if count == 1:
        return strips[0, :height]
    blocks = jnp.moveaxis(strips.reshape(count, -1, BLOCK * tile, *rest), 0, 1)
    return blocks.reshape(count * rows, *rest)[:height]


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


def _composite_features_vjp(
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

    strips = _split_into_strips(cotangent, lists.tile, 1 if mesh is None else mesh.size)
    return map_strips(local, (lists, strips), make_table(splats), mesh, total=True)


def _composite_vjp(
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

    The lists are cut to their visible lengths. The transmittance is 1 - sum of w: its cotangent acts as minus the
    cotangent of a channel of ones.
    """
    width, channels = cotangent.shape[1:]
    total = (image * cotangent).sum(-1) - (1 - transmittance) * cotangent_transmittance
    packed = jnp.concatenate([cotangent, cotangent_transmittance[..., None], total[..., None]], -1)

    x, y = (centres - lists.tile / 2 for centres in pixel_centres(lists.tile, splats.dtype))
    # All sums over a tile's pixels are moments of one quantity, h = alpha dL/dalpha, about the tile's centre.
    monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])

    def local(strip, divided, table):
        lists, (packed,) = divided
        batches = make_batches(lists, width, strip, most=32)  # gradients hold more arrays of a chunk at once
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

    strips = _split_into_strips(packed, lists.tile, 1 if mesh is None else mesh.size)
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


def _forward(width: int, height: int, mesh: Mesh | None) -> Callable:
    """`composite` of an image, which vmap calls for one member of a batch after another."""
    return sequential_vmap(functools.partial(composite, width=width, height=height, mesh=mesh))


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4, 5))
def _rasterize_finite(
    splats: Array, features: Array, lists: TileLists, width: int, height: int, mesh: Mesh | None
) -> tuple[Array, Array]:
    """Composites finite features."""
    return _forward(width, height, mesh)(splats, features, lists)[:2]


def _rasterize_forward(splats, features, lists, width, height, mesh):
    needs_geometry = splats.perturbed
    splats, features = splats.value, features.value
    lists = jax.tree.map(lambda leaf: leaf.value, lists, is_leaf=lambda leaf: hasattr(leaf, "perturbed"))
    image, transmittance, seen = _forward(width, height, mesh)(splats, features, lists)
    lists = dataclasses.replace(lists, lengths=seen)
    saved = (image, transmittance) if needs_geometry else None
    return (image, transmittance), (splats, features, lists, saved)


def _rasterize_backward(width, height, mesh, residual, cotangents):
    splats, features, lists, saved = residual
    symbolic = jax.custom_derivatives.SymbolicZero
    bars = [jnp.zeros(bar.shape, splats.dtype) if isinstance(bar, symbolic) else bar for bar in cotangents]
    if saved is None:
        gradient = sequential_vmap(functools.partial(_composite_features_vjp, mesh=mesh))(splats, lists, bars[0])
        return jnp.zeros_like(splats), gradient.astype(features.dtype), None
    vjp = sequential_vmap(functools.partial(_composite_vjp, mesh=mesh))
    by_splat, gradient = vjp(splats, features.astype(splats.dtype), lists, *saved, *bars)
    return by_splat, gradient.astype(features.dtype), None


_rasterize_finite.defvjp(_rasterize_forward, _rasterize_backward, symbolic_zeros=True)


def rasterize(
    splats: Array, features: Array, lists: TileLists, width: int, height: int, mesh: Mesh | None, *, finite: bool
) -> tuple[Array, Array]:
    """Composites features (N, D) of which some may be NaN or infinite; if all are `finite`, in half of the program.

    Returns:
      Image (H, W, D), NaN in exactly the pixels that a Gaussian with a non-finite feature touches, and final
      transmittance (H, W). Those pixels and features have gradient zero.
    """
    if finite:
        return cast(tuple[Array, Array], _rasterize_finite(splats, features, lists, width, height, mesh))
    known = jnp.isfinite(features)
    image, transmittance = _rasterize_finite(splats, jnp.where(known, features, 0.0), lists, width, height, mesh)
    bad = lax.stop_gradient(1.0 - known.all(1, keepdims=True).astype(splats.dtype))

    def mark(bad) -> Array:
        return rasterize(lax.stop_gradient(splats), bad, lists, width, height, mesh, finite=True)[0][..., 0] > 0

    touched = lax.cond(_any(bad), mark, lambda bad: jnp.zeros((height, width), bool), bad)
    return jnp.where(touched[..., None], jnp.nan, image), transmittance


@custom_vmap
def _any(bad: Array) -> Array:
    """() bool whether any is set; under vmap any of the whole batch, so that a conditional stays one."""
    return jnp.any(bad > 0)


@_any.def_vmap
def _(size: int, batched: list, bad: Array):
    del size, batched
    return _any(bad), False
