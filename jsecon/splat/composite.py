"""Front-to-back alpha compositing of tile lists, and its hand-written gradients.

Tiles of like length are batched; a batch walks down its lists in chunks of Gaussians and leaves early once every list
has ended or every pixel has stopped. Inside a chunk a scan carries the transmittance, vectorised over the batch's
pixels. Materialising cumulative products instead was measured 3 to 5 times slower (DESIGN section 3), and unrolling the
scan twice as slow: XLA then computes the chain of transmittances anew for every output that needs it.

The gradient walks front to back as well: with G = cotangent, dL/dalpha_i = T_i <G, f_i> - (S - S_i) / (1 - alpha_i),
where S_i is the running sum of w <G, f> up to i and S its total, known from the image. Nothing is stored per pair.
"""

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.splat.tiles import TileLists, grid
from jsecon.types import Array

# `splats` (N, 6) throughout: centre x, y (px), l11, l21, l22 (1/px, times sqrt(1/2)), opacity; see splats.py.

# Speed only; measured on the garden scene (benchmarks/).
BATCH = 64
CHUNK = 32
WIDE = 8
"""from this many channels on, a chunk's weights are kept and multiplied with its features as one matrix product"""


@dataclasses.dataclass(frozen=True)
class Batches:
    """Tiles sorted by list length, in batches of BATCH; the last is filled up with empty tiles."""

    tiles: Array
    """(batches, BATCH) tile ids; `number` = an empty tile outside the image."""
    starts: Array
    lengths: Array
    across: int
    number: int
    tile: int

    def pixels(self, tiles: Array, dtype) -> tuple[Array, Array]:
        """(BATCH, tile * tile) x and y of the pixel centres."""
        local = jnp.arange(self.tile) + 0.5
        x = (tiles % self.across * self.tile)[:, None] + jnp.tile(local, self.tile)[None]
        y = (tiles // self.across * self.tile)[:, None] + jnp.repeat(local, self.tile)[None]
        return x.astype(dtype), y.astype(dtype)


def make_batches(lists: TileLists, width: int, height: int) -> Batches:
    across, down = grid(width, height, lists.tile)
    number = across * down
    lengths = lists.starts[1:] - lists.starts[:-1]
    order = jnp.argsort(-lengths).astype(jnp.int32)
    count = -(-number // BATCH)
    order = jnp.concatenate([order, jnp.full(count * BATCH - number, number, jnp.int32)]).reshape(count, BATCH)
    empty = jnp.zeros(1, jnp.int32)
    return Batches(
        order,
        jnp.concatenate([lists.starts[:-1], empty]),
        jnp.concatenate([lengths, empty]),
        across,
        number,
        lists.tile,
    )


def alphas(attributes: Array, x: Array, y: Array):
    """Alpha of one Gaussian a tile (BATCH, 6) at the tiles' pixels (BATCH, P), and what its gradient needs."""
    a = attributes[:, :, None]
    dx, dy = x - a[:, 0], y - a[:, 1]
    u, v = a[:, 2] * dx + a[:, 3] * dy, a[:, 4] * dy
    unclamped = a[:, 5] * jnp.exp(-(u * u + v * v))
    alpha = jnp.where(unclamped >= MIN_ALPHA, jnp.minimum(unclamped, MAX_ALPHA), 0.0)
    return alpha, unclamped


def advance(transmittance: Array, alpha: Array) -> tuple[Array, Array]:
    """(weight, next transmittance). A pixel that has stopped keeps its final transmittance with a minus sign."""
    weight = alpha * jnp.maximum(transmittance, 0.0)
    left = transmittance - weight
    stop = left <= MIN_TRANSMITTANCE
    return jnp.where(stop, 0.0, weight), jnp.where(stop, -jnp.abs(transmittance), left)


def chunk(table: Array, lists: TileLists, start: Array, length: Array, first: Array):
    """Ids (CHUNK, BATCH), attributes (CHUNK, BATCH, 6) of the next CHUNK Gaussians; opacity 0 past a list's end."""
    index = first + jnp.arange(CHUNK)[:, None]
    inside = index < length[None]
    ids = lists.gaussians[jnp.minimum(start[None] + index, lists.gaussians.shape[0] - 1)]
    attributes = table[ids]
    opacity = jnp.where(inside, attributes[..., 5], 0.0)
    return ids, jnp.concatenate([attributes[..., :5], opacity[..., None]], axis=-1)


def walk(body, state, length: Array, transmittance_of):
    """Applies `body(first, state)` chunk by chunk until the longest list ends or every pixel has stopped."""
    longest = length.max()

    def unfinished(carry):
        first, state = carry
        return (first < longest) & (transmittance_of(state).max() > 0)

    def step(carry):
        first, state = carry
        return first + CHUNK, body(first, state)

    return lax.while_loop(unfinished, step, (jnp.int32(0), state))[1]


def _to_image(batched: Array, batches: Batches, width: int, height: int) -> Array:
    """(batches, BATCH, P, D) -> (H, W, D)."""
    down = batches.number // batches.across
    tile, channels = batches.tile, batched.shape[-1]
    slots = batches.tiles.reshape(-1)
    place = jnp.zeros(batches.number + 1, jnp.int32).at[slots].set(jnp.arange(slots.shape[0], dtype=jnp.int32))[:-1]
    image = batched.reshape(slots.shape[0], tile, tile, channels)[place].reshape(
        down, batches.across, tile, tile, channels
    )
    image = image.transpose(0, 2, 1, 3, 4).reshape(down * tile, batches.across * tile, channels)
    return image[:height, :width]


def to_tiles(image: Array, tile: int) -> Array:
    """(H, W, ...) -> (tiles + 1, tile * tile, ...), zero outside the image; the last tile is the empty one."""
    height, width, *rest = image.shape
    across, down = grid(width, height, tile)
    padding = [(0, down * tile - height), (0, across * tile - width)] + [(0, 0)] * len(rest)
    tiles = jnp.pad(image, padding).reshape(down, tile, across, tile, *rest)
    tiles = jnp.moveaxis(tiles, 2, 1).reshape(across * down, tile * tile, *rest)
    return jnp.concatenate([tiles, jnp.zeros_like(tiles[:1])])


def composite(
    splats: Float[Array, "n 6"], features: Float[Array, "n d"], lists: TileLists, width: int, height: int
) -> tuple[Float[Array, "h w d"], Float[Array, "h w"]]:
    """Features (H, W, D) = sum of alpha T f, and final transmittance (H, W)."""
    batches = make_batches(lists, width, height)
    channels, dtype = features.shape[1], splats.dtype
    narrow = channels < WIDE

    def one_batch(tiles):
        start, length = batches.starts[tiles], batches.lengths[tiles]
        x, y = batches.pixels(tiles, dtype)

        def body(first, state):
            ids, attributes = chunk(splats, lists, start, length, first)
            rows = features[ids]
            if narrow:

                def step(carry, item):
                    transmittance, total = carry
                    alpha, _ = alphas(item[0], x, y)
                    weight, transmittance = advance(transmittance, alpha)
                    return (transmittance, total + weight[None] * item[1].T[:, :, None]), None

                return lax.scan(step, state, (attributes, rows))[0]

            def step(transmittance, item):
                alpha, _ = alphas(item, x, y)
                weight, transmittance = advance(transmittance, alpha)
                return transmittance, weight

            transmittance, weights = lax.scan(step, state[0], attributes)
            return transmittance, state[1] + jnp.einsum("cbp,cbd->dbp", weights, rows)

        initial = (jnp.ones_like(x), jnp.zeros((channels, *x.shape), dtype))
        transmittance, total = walk(body, initial, length, lambda state: state[0])
        return jnp.concatenate([jnp.moveaxis(total, 0, -1), jnp.abs(transmittance)[..., None]], axis=-1)

    image = _to_image(lax.map(one_batch, batches.tiles), batches, width, height)
    return image[..., :-1], image[..., -1]


def composite_features_vjp(
    splats: Float[Array, "n 6"], lists: TileLists, cotangent: Float[Array, "h w d"]
) -> Float[Array, "n d"]:
    """Gradient with respect to the features alone: W^T cotangent. No gradient of the geometry is computed."""
    height, width, channels = cotangent.shape
    batches = make_batches(lists, width, height)
    cotangents = to_tiles(cotangent, lists.tile)
    dtype = splats.dtype

    def one_batch(gradient, tiles):
        start, length = batches.starts[tiles], batches.lengths[tiles]
        x, y = batches.pixels(tiles, dtype)
        local = cotangents[tiles]

        def body(first, state):
            transmittance, gradient = state
            ids, attributes = chunk(splats, lists, start, length, first)

            def step(transmittance, item):
                alpha, _ = alphas(item, x, y)
                weight, transmittance = advance(transmittance, alpha)
                return transmittance, weight

            transmittance, weights = lax.scan(step, transmittance, attributes)
            return transmittance, gradient.at[ids].add(jnp.einsum("cbp,bpd->cbd", weights, local))

        state = walk(body, (jnp.ones_like(x), gradient), length, lambda state: state[0])
        return state[1], None

    return lax.scan(one_batch, jnp.zeros((splats.shape[0], channels), dtype), batches.tiles)[0]


def composite_vjp(
    splats: Float[Array, "n 6"],
    features: Float[Array, "n d"],
    lists: TileLists,
    image: Float[Array, "h w d"],
    transmittance: Float[Array, "h w"],
    cotangent: Float[Array, "h w d"],
    cotangent_transmittance: Float[Array, "h w"],
) -> tuple[Array, Array]:
    """Gradients with respect to the splats (N, 6) and the features (N, D). `image` and `transmittance` are what
    `composite` returned.

    The transmittance is 1 - sum of w, so its cotangent joins the others as minus a channel of constant feature 1.
    """
    height, width, channels = cotangent.shape
    batches = make_batches(lists, width, height)
    total = (image * cotangent).sum(-1) - (1 - transmittance) * cotangent_transmittance
    packed = to_tiles(
        jnp.concatenate([cotangent, cotangent_transmittance[..., None], total[..., None]], -1), lists.tile
    )
    dtype = splats.dtype
    half = lists.tile / 2
    local_x = (jnp.tile(jnp.arange(lists.tile) + 0.5, lists.tile) - half).astype(dtype)
    local_y = (jnp.repeat(jnp.arange(lists.tile) + 0.5, lists.tile) - half).astype(dtype)
    # All sums over a tile's pixels are moments of one quantity h = alpha dL/dalpha about the tile's centre.
    moments = jnp.stack([jnp.ones_like(local_x), local_x, local_y, local_x**2, local_x * local_y, local_y**2], axis=-1)

    def one_batch(gradient, tiles):
        start, length = batches.starts[tiles], batches.lengths[tiles]
        x, y = batches.pixels(tiles, dtype)
        centre_x, centre_y = x[:, 0] - 0.5 + half, y[:, 0] - 0.5 + half
        local, along_transmittance, final = packed[tiles][..., :-2], packed[tiles][..., -2], packed[tiles][..., -1]

        def body(first, state):
            transmittance, before, gradient = state
            ids, attributes = chunk(splats, lists, start, length, first)
            along = jnp.einsum("cbd,bpd->cbp", features[ids], local) - along_transmittance[None]

            def step(carry, item):
                transmittance, before = carry
                alpha, unclamped = alphas(item[0], x, y)
                weight, after = advance(transmittance, alpha)
                live = (weight > 0) & (unclamped <= MAX_ALPHA)
                before = before + weight * item[1]
                slope = jnp.maximum(transmittance, 0.0) * item[1] - (final - before) / (1 - alpha)
                return (after, before), (weight, jnp.where(live, slope * unclamped, 0.0))

            (transmittance, before), (weights, h) = lax.scan(step, (transmittance, before), (attributes, along))
            by_feature = jnp.einsum("cbp,bpd->cbd", weights, local)
            by_attribute = _attribute_gradient(jnp.einsum("cbp,pk->cbk", h, moments), attributes, centre_x, centre_y)
            return transmittance, before, gradient.at[ids].add(jnp.concatenate([by_attribute, by_feature], axis=-1))

        state = walk(body, (jnp.ones_like(x), jnp.zeros_like(x), gradient), length, lambda state: state[0])
        return state[2], None

    gradient = lax.scan(one_batch, jnp.zeros((splats.shape[0], 6 + channels), dtype), batches.tiles)[0]
    return gradient[:, :6], gradient[:, 6:]


def _attribute_gradient(moments: Array, attributes: Array, centre_x: Array, centre_y: Array) -> Array:
    """(CHUNK, BATCH, 6) gradient from the six moments of h about the tile's centre."""
    m, mx, my, mxx, mxy, myy = (moments[..., k] for k in range(6))
    x, y, l11, l21, l22, opacity = (attributes[..., k] for k in range(6))
    # moments about the Gaussian's centre
    sx, sy = centre_x[None] - x, centre_y[None] - y
    dx, dy = mx + sx * m, my + sy * m
    dxx, dxy, dyy = (
        mxx + 2 * sx * mx + sx * sx * m,
        mxy + sx * my + sy * mx + sx * sy * m,
        myy + 2 * sy * my + sy * sy * m,
    )
    # h = alpha dL/dalpha; alpha = o exp(-(u^2 + v^2)), u = l11 dx + l21 dy, v = l22 dy
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
