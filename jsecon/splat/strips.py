"""An image dealt out in strips: strip k of n holds the rows of blocks k, k + n, k + 2 n and so on.

Each device lists and composites its own strip and needs nothing of another's; neighbouring rows are dealt to different
devices, so that all have like work.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax.sharding import Mesh

from jsecon.parallel import map_over_devices
from jsecon.types import Array

BLOCK = 4
"""edge of a block, tiles; the BLOCK * BLOCK bits of a (block, Gaussian) pair fit half a word"""


@dataclasses.dataclass(frozen=True)
class Strip:
    """Strip `index` of `count`."""

    index: int | Array = 0
    count: int = 1

    def first_row(self, rows: Array) -> Array:
        """Own rows of blocks before the image's row: where the rows [a, b) of the image begin and end among its own."""
        return (rows - self.index + self.count - 1) // self.count

    def block_row(self, own: Array) -> Array:
        """The image's row of blocks that its own row `own` is."""
        return own * self.count + self.index

    def tile_row(self, own: Array) -> Array:
        """The image's row of tiles that its own row of tiles `own` is."""
        return self.block_row(own // BLOCK) * BLOCK + own % BLOCK


FULL_IMAGE = Strip()
"""the image as one strip"""


def tile_rows(height: int, tile: int, count: int) -> int:
    """Rows of tiles of each of `count` strips of an image `height` px high."""
    return -(-height // tile) if count == 1 else -(-height // (BLOCK * tile * count)) * BLOCK


def split_into_strips(image: Array, tile: int, count: int) -> Array:
    """(H, W, ...) -> (count, rows of a strip, W, ...) in px, zero below the image."""
    height, *rest = image.shape
    rows = tile_rows(height, tile, count) * tile
    image = jnp.pad(image, [(0, count * rows - height)] + [(0, 0)] * len(rest))
    if count == 1:
        return image[None]
    return jnp.moveaxis(image.reshape(-1, count, BLOCK * tile, *rest), 1, 0).reshape(count, rows, *rest)


def join_strips(strips: Array, tile: int, height: int) -> Array:
    """`split_into_strips` undone: (count, rows, W, ...) -> (H, W, ...)."""
    count, rows, *rest = strips.shape
    if count == 1:
        return strips[0, :height]
    blocks = jnp.moveaxis(strips.reshape(count, -1, BLOCK * tile, *rest), 0, 1)
    return blocks.reshape(count * rows, *rest)[:height]


def map_strips(local: Callable, dealt: Any, common: Any, mesh: Mesh | None, *, total: bool = False) -> Any:
    """`local(strip, dealt, common)` for the strip of each device of `mesh`, see `map_over_devices`; without a mesh for
    the whole image."""
    if mesh is None:
        return local(FULL_IMAGE, dealt, common)
    return map_over_devices(
        lambda index, *rest: local(Strip(index, mesh.size), *rest), dealt, common, mesh, total=total
    )
