"""The tiles of a strip in batches of like list length, and strips cut to tiles and put together again."""

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from jsecon.splat.strips import WHOLE, Strip
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
    strip: Strip

    def corners(self, tiles: Array, dtype) -> tuple[Array, Array]:
        """x and y of the tiles' upper left corners in the image, px."""
        x, y = tiles % self.across, self.strip.tile_row(tiles // self.across)
        return (x * self.tile).astype(dtype), (y * self.tile).astype(dtype)


def make_batches(lists: TileLists, width: int, strip: Strip = WHOLE) -> Batches:
    """The batches of one strip's lists, the longest first."""
    number = lists.lengths.shape[0]
    order = jnp.argsort(-lists.lengths).astype(jnp.int32)
    order = jnp.concatenate([order, jnp.full(-number % BATCH, number, jnp.int32)])
    empty = jnp.zeros(1, jnp.int32)
    return Batches(
        order.reshape(-1, BATCH),
        jnp.concatenate([lists.starts, empty]),
        jnp.concatenate([lists.lengths, empty]),
        -(-width // lists.tile),
        number,
        lists.tile,
        strip,
    )


def to_image(batched: Float[Array, "k b d p"], batches: Batches, width: int) -> Float[Array, "h w d"]:
    """(batches, BATCH, D, pixels) -> (rows, W, D), all rows of the strip's tiles."""
    down, tile, channels = batches.number // batches.across, batches.tile, batched.shape[2]
    slots = batches.tiles.reshape(-1)
    place = jnp.zeros(batches.number + 1, jnp.int32).at[slots].set(lax.iota(jnp.int32, slots.shape[0]))[:-1]
    tiles = batched.reshape(slots.shape[0], channels, tile, tile)[place]
    image = tiles.reshape(down, batches.across, channels, tile, tile).transpose(0, 3, 1, 4, 2)
    return image.reshape(down * tile, batches.across * tile, channels)[:, :width]


def to_tiles(image: Array, tile: int) -> Array:
    """(H, W, ...) -> (tiles + 1, tile * tile, ...), zero outside the image; the last tile is the empty one."""
    height, width, *rest = image.shape
    across, down = grid(width, height, tile)
    padding = [(0, down * tile - height), (0, across * tile - width)] + [(0, 0)] * len(rest)
    tiles = jnp.pad(image, padding).reshape(down, tile, across, tile, *rest)
    tiles = jnp.moveaxis(tiles, 2, 1).reshape(across * down, tile * tile, *rest)
    return jnp.concatenate([tiles, jnp.zeros_like(tiles[:1])])
