"""The tiles in batches of like list length, and images cut to tiles and put together again."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from jsecon.splat.tiles import TileLists, grid
from jsecon.types import Array

BATCH = 64
"""tiles walked side by side; speed only"""


@dataclasses.dataclass(frozen=True)
class Batches:
    """Tiles sorted by list length, in batches of BATCH; the last is filled up with empty tiles."""

    tiles: Array
    """(batches, BATCH) tile ids; `number` = an empty tile outside the image."""
    starts: Array
    """(number + 1,) where a tile's list begins."""
    lengths: Array
    """(number + 1,) its length."""
    across: int
    number: int
    tile: int

    def corners(self, tiles: Array, dtype) -> tuple[Array, Array]:
        """x and y of the tiles' upper left corners, px."""
        return (tiles % self.across * self.tile).astype(dtype), (tiles // self.across * self.tile).astype(dtype)


def make_batches(lists: TileLists, width: int, height: int, *, shares: int = 1) -> Batches:
    """The batches of an image. With `shares` > 1 their number is a multiple of it, and they are dealt out to and fro
    so that each run of batches / shares batches has like work; slots are in that order."""
    across, down = grid(width, height, lists.tile)
    number = across * down
    # Longest first.
    order = jnp.argsort(-lists.lengths).astype(jnp.int32)
    rounds = -(-number // (BATCH * shares))
    order = jnp.concatenate([order, jnp.full(rounds * shares * BATCH - number, number, jnp.int32)])
    dealt = np.arange(rounds * shares).reshape(rounds, shares)
    dealt[1::2] = dealt[1::2, ::-1]
    empty = jnp.zeros(1, jnp.int32)
    return Batches(
        order.reshape(rounds * shares, BATCH)[dealt.T.reshape(-1)],
        jnp.concatenate([lists.starts, empty]),
        jnp.concatenate([lists.lengths, empty]),
        across,
        number,
        lists.tile,
    )


def to_image(batched: Float[Array, "k b d p"], batches: Batches, width: int, height: int) -> Float[Array, "h w d"]:
    """(batches, BATCH, D, pixels) -> (H, W, D)."""
    down, tile, channels = batches.number // batches.across, batches.tile, batched.shape[2]
    slots = batches.tiles.reshape(-1)
    place = jnp.zeros(batches.number + 1, jnp.int32).at[slots].set(lax.iota(jnp.int32, slots.shape[0]))[:-1]
    tiles = batched.reshape(slots.shape[0], channels, tile, tile)[place]
    image = tiles.reshape(down, batches.across, channels, tile, tile).transpose(0, 3, 1, 4, 2)
    return image.reshape(down * tile, batches.across * tile, channels)[:height, :width]


def to_tiles(image: Array, tile: int) -> Array:
    """(H, W, ...) -> (tiles + 1, tile * tile, ...), zero outside the image; the last tile is the empty one."""
    height, width, *rest = image.shape
    across, down = grid(width, height, tile)
    padding = [(0, down * tile - height), (0, across * tile - width)] + [(0, 0)] * len(rest)
    tiles = jnp.pad(image, padding).reshape(down, tile, across, tile, *rest)
    tiles = jnp.moveaxis(tiles, 2, 1).reshape(across * down, tile * tile, *rest)
    return jnp.concatenate([tiles, jnp.zeros_like(tiles[:1])])
