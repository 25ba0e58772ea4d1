"""Strips of an image, one per device: strip k of n holds the rows of blocks k, k + n, k + 2 n and so on.

Each device lists and composites one strip independently. Neighbouring rows go to different devices, which balances the
work.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from jax.sharding import Mesh

from jsecon.parallel import map_over_devices
from jsecon.types import Array

BLOCK = 4
"""Edge of a block in tiles; the BLOCK * BLOCK bits of a (block, Gaussian) pair fit into half a word."""


@dataclasses.dataclass(frozen=True)
class Strip:
    """Strip `index` of `count`."""

    index: int | Array = 0
    count: int = 1

    def tile_row(self, row: Array) -> Array:
        """Finds the row of tiles in the image of a row of tiles in the strip."""
        return (row // BLOCK * self.count + self.index) * BLOCK + row % BLOCK


FULL_IMAGE = Strip()
"""The image as one strip."""


def tile_rows(height: int, tile: int, count: int) -> int:
    """Counts the rows of tiles of each of `count` strips; with several strips a multiple of BLOCK."""
    return -(-height // tile) if count == 1 else -(-height // (BLOCK * tile * count)) * BLOCK


def map_strips(local: Callable, divided: Any, common: Any, mesh: Mesh | None, *, total: bool = False) -> Any:
    """Computes `local(strip, divided, common)` on every device of a mesh, each with its strip.

    Args:
      local: Pure function.
      divided: Arrays that are divided among the devices along their leading axes.
      common: Arrays that every device gets entirely.
      mesh: Devices, or None for one strip, the whole image.
      total: Whether to add up the results instead of joining them along their leading axes.
    """
    if mesh is None:
        return local(FULL_IMAGE, divided, common)

    def run(index, *arrays):
        return local(Strip(index, mesh.size), *arrays)

    return map_over_devices(run, divided, common, mesh, total=total)
