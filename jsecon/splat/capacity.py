"""Capacity of tile lists: the number of (block, Gaussian) pairs that they have room for."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jsecon.numerics import NEAR
from jsecon.splat.project import project
from jsecon.splat.strips import BLOCK, Strip
from jsecon.splat.tiles import TILE, WORD, pair_counts, tile_grid
from jsecon.types import Array, Camera, Gaussians


@functools.partial(jax.jit, static_argnums=2)
def _pairs_in_view(gaussians: Gaussians, camera: Camera, strips: int, near: float | Array) -> Array:
    """() pairs of an image in strips that are all as long as the longest."""
    splats = project(gaussians, camera, near=near)
    counts = [pair_counts(splats, camera.width, camera.height, strip=Strip(k, strips)) for k in range(strips)]
    return strips * jnp.stack([pairs.astype(jnp.float32).sum() for pairs in counts]).max()


def round_capacity(pairs: int) -> int:
    """Rounds a number of pairs up to an eighth of a power of two, so that small scenes share programs.

    Up to 16,384 it is a power of two, at least 4,096: a compilation takes seconds, 3,000 unneeded pairs cost a forward
    render 0.3 ms.
    """
    small = max(4096, 1 << (max(pairs, 1) - 1).bit_length())
    if small <= 16384:
        return small
    step = 2 ** (pairs.bit_length() - 4)
    return -(-pairs // step) * step


def default_capacity(count: int, width: int, height: int, *, strips: int = 1) -> int:
    """Estimates the number of pairs of all strips together from sizes alone.

    It allows 2 pairs per Gaussian and 256 per block, at most all Gaussians in all blocks. In all views of seven scenes
    (1,000 to 1,000,000 Gaussians, 112x200 to 1944x1260) a view needs less than N pairs and 330 per block
    (benchmarks/results.md). Time hardly depends on the capacity; memory grows by 110 bytes per pair.
    """
    across, down = tile_grid(width, height, BLOCK * TILE)
    blocks = across * -(-down // strips)
    per_strip = min(count * blocks, -(-2 * count // strips) + 256 * blocks)
    return round_capacity(strips * per_strip)


def enough_capacity(capacity: int, overflow: Int[Array, " strips"]) -> int:
    """Enlarges a capacity of all strips together by the pairs of each strip that found no room.

    The result is a power of two per strip, so that views share programs.
    """
    per_strip = -(-capacity // (overflow.shape[0] * WORD)) * WORD + int(overflow.max())
    return overflow.shape[0] << (per_strip - 1).bit_length()


def plan_capacity(
    gaussians: Gaussians, cameras: Camera, *, margin: float = 1.25, devices: int | None = None, near: float = NEAR
) -> int:
    """Measures the capacity with which no view overflows. Host code; needs concrete arrays.

    It is needed for scenes that overflow the default inside of jit, and to save memory. It projects every view, which
    takes 10 ms for 100,000 Gaussians.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: One camera or a batch.
      margin: Factor for Gaussians that still move.
      devices: Number of devices that share a view; by default all devices of this process.
      near: Near plane, world units.

    Returns:
      Number of pairs, rounded up (`round_capacity`).
    """
    strips = jax.local_device_count() if devices is None else devices
    views = cameras if cameras.world_to_camera.ndim == 3 else jax.tree.map(lambda a: jnp.asarray(a)[None], cameras)
    pairs = max((float(_pairs_in_view(gaussians, view, strips, near)) for view in views), default=0.0)
    return round_capacity(int(np.ceil(pairs * margin * (1 + 1e-6))))  # the sum is a float32
