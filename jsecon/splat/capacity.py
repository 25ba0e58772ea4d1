"""How many (block, Gaussian) pairs the tile lists of a view have room for: from the sizes alone, or planned."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jsecon.splat.project import project
from jsecon.splat.strips import BLOCK, Strip
from jsecon.splat.tiles import TILE, pair_counts, round_up_to_words, tile_grid
from jsecon.types import Array, Camera, Gaussians

PER_GAUSSIAN, PER_BLOCK = 2, 256
"""pairs that a capacity allows for by default, see `default_capacity`"""


@functools.partial(jax.jit, static_argnums=2)
def _pairs_in_view(gaussians: Gaussians, camera: Camera, strips: int) -> Array:
    """(2,) the pairs of the image as one strip, and of all strips, were each as long as the longest: one program for
    whoever asks for either."""
    splats = project(gaussians, camera)

    def longest(count: int) -> Array:
        counts = [pair_counts(splats, camera.width, camera.height, strip=Strip(k, count)) for k in range(count)]
        return count * jnp.stack([pairs.astype(jnp.float32).sum() for pairs in counts]).max()

    return jnp.stack([longest(1), longest(strips)])


def round_capacity(pairs: int) -> int:
    """`pairs` rounded up to an eighth of a power of two; below 16,384 to a power of two, at least 4,096.

    A compilation takes seconds, 3,000 pairs of room too much 0.3 ms of a forward render: small scenes share programs.
    """
    small = max(4096, 1 << (max(pairs, 1) - 1).bit_length())
    if small <= 16384:
        return small
    step = 2 ** (pairs.bit_length() - 4)
    return -(-pairs // step) * step


def default_capacity(count: int, width: int, height: int, *, strips: int = 1) -> int:
    """(block, Gaussian) pairs to allow for where nothing but the sizes is known: `count` Gaussians, the image, px.

    PER_GAUSSIAN pairs for each Gaussian and PER_BLOCK for each block of the image, never more than all Gaussians in
    all blocks, rounded up. Measured in all views of seven scenes, 1,000 to 1,000,000 Gaussians at 112x200 to
    1944x1260, a view needs less than N + 330 for each block (benchmarks/results.md); time hardly follows the capacity,
    memory by about 110 bytes for each pair.
    """
    across, down = tile_grid(width, height, BLOCK * TILE)
    blocks = across * -(-down // strips)
    each = min(count * blocks, -(-PER_GAUSSIAN * count // strips) + PER_BLOCK * blocks)
    return round_capacity(strips * each)


def enough_capacity(capacity: int, overflow: Int[Array, " strips"]) -> int:
    """A capacity that holds what overflowed `capacity`, in powers of two for each strip: views share programs."""
    each = round_up_to_words(-(-capacity // overflow.shape[0])) + int(overflow.max())
    return overflow.shape[0] << (each - 1).bit_length()


def plan_capacity(gaussians: Gaussians, cameras: Camera, *, margin: float = 1.25, devices: int | None = None) -> int:
    """The number of (block, Gaussian) pairs to allow for, so that no view of `cameras` (one, or a batch) overflows,
    also where `devices` of them share it (by default all of this process's).

    For scenes that overflow the default inside jit, and to save memory: nothing else needs it. It projects every view,
    10 ms for 100,000 Gaussians. Host code: needs concrete arrays. Rounded up (`round_capacity`). `margin` leaves room
    for Gaussians that still move.
    """
    local = jax.local_device_count()
    strips = local if devices is None else devices
    given, which = (local, 0) if strips == 1 else (strips, 1)
    views = cameras if cameras.world_to_camera.ndim == 3 else jax.tree.map(lambda a: jnp.asarray(a)[None], cameras)
    pairs = max(
        (float(_pairs_in_view(gaussians, views[t], given)[which]) for t in range(views.world_to_camera.shape[0])),
        default=0.0,
    )
    return round_capacity(int(np.ceil(pairs * margin * (1 + 1e-6))))  # the sum is a float32
