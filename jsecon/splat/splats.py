"""One view's splats and their tile lists: the step that every walk over the tiles begins with."""

import math

import jax.numpy as jnp

from jsecon.numerics import NEAR
from jsecon.splat.differentiate import view_lists
from jsecon.splat.project import project
from jsecon.splat.tiles import TileLists
from jsecon.types import Array, Camera, Gaussians


def splats_of(
    gaussians: Gaussians, camera: Camera, *, capacity: int, near: float | Array = NEAR
) -> tuple[Array, TileLists]:
    """(N, 6) attributes as `composite.Splats` holds them, and the tile lists of one view."""
    projection = project(gaussians, camera, near=near)
    lists = view_lists(projection, camera.width, camera.height, capacity=capacity)
    columns = [projection.means_px, projection.whitening * math.sqrt(0.5), projection.opacities[:, None]]
    # An invisible Gaussian is in no list; its row is zeroed so that nothing non-finite reaches a gradient.
    return jnp.where(projection.visible[:, None], jnp.concatenate(columns, axis=1), 0.0), lists
