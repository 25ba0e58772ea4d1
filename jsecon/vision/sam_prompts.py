"""What SAM's automatic mask generator asks: a grid of points, over the frame and over crops of it (REFERENCE G.1)."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from jsecon.errors import require


class Crop(NamedTuple):
    """A part of the frame, px, half open."""

    left: int
    top: int
    right: int
    bottom: int
    layer: int
    """0: the whole frame; k: one of 4^k."""

    @property
    def area(self) -> int:
        """px^2."""
        return (self.right - self.left) * (self.bottom - self.top)


def point_grid(side: int) -> Float32[np.ndarray, "p 2"]:
    """(side^2, 2) points (x, y) in 0..1, the centres of side x side cells, x fastest."""
    require(side >= 1, "side", got=side, expected="at least 1", remedy="SAM's own is 32.")
    line = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2).astype(np.float32)


def crops_of(height: int, width: int, layers: int, overlap: float) -> list[Crop]:
    """The whole frame, then 2^k x 2^k crops of it for each layer k up to `layers`, column by column.

    Neighbours overlap by `overlap` of the frame's shorter side, times 2 / 2^k.
    """
    crops = [Crop(0, 0, width, height, 0)]
    for layer in range(1, layers + 1):
        number = 2**layer
        common = int(overlap * min(height, width) * 2 / number)
        long = [math.ceil((common * (number - 1) + length) / number) for length in (width, height)]
        starts = [[(size - common) * i for i in range(number)] for size in long]
        for left, top in itertools.product(*starts):
            crops.append(Crop(left, top, min(left + long[0], width), min(top + long[1], height), layer))
    return crops
