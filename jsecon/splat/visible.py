"""Views of a scene that need not fit into memory. Host code.

The geometry of one Gaussian takes 44 bytes. The columns are read block by block, and only the Gaussians that a view can
see are kept: what is rendered of them equals what is rendered of all.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.numerics import NEAR
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.project import check_gaussians, project
from jsecon.splat.render import render
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Array, Camera, Gaussians

ROWS = 1 << 18
"""Gaussians of a block."""
HIDDEN_LOGIT = -30.0
"""Opacity logit of hidden Gaussians: an opacity of 1e-13 is culled in projection, and every number stays finite."""


def hide(gaussians: Gaussians, mask: Bool[np.ndarray, " n"]) -> Gaussians:
    """Makes some Gaussians transparent; all columns but that of the opacities are shared."""
    logits = np.where(mask, np.float32(HIDDEN_LOGIT), np.asarray(gaussians.opacity_logits))
    return dataclasses.replace(gaussians, opacity_logits=logits)


def visible_part(
    gaussians: Gaussians, camera: Camera, *, near: float = NEAR, least: int = 0
) -> tuple[Int[np.ndarray, " m"], Gaussians]:
    """Finds the ids (ascending) of the Gaussians that a view can see, and reads their geometry, in black.

    Transparent Gaussians follow, up to `padded_size(M)`, or `least`.
    """
    check_gaussians(gaussians, camera)
    geometry = dataclasses.replace(gaussians, sh=np.zeros((gaussians.count, 0, 3), np.float32))
    blocks = [np.zeros(0, np.int64)]
    for first in range(0, gaussians.count, ROWS):
        block = jax.tree.map(lambda a, first=first: np.asarray(a[first : first + ROWS], np.float32), geometry)
        blocks.append(first + np.flatnonzero(np.asarray(_is_visible(block, camera, near))))
    ids = np.concatenate(blocks)
    size = max(padded_size(len(ids)), least)

    def fill(a):
        return np.zeros((size - len(ids), *a.shape[1:]), np.float32)

    part = jax.tree.map(lambda a: np.concatenate([np.asarray(a[ids], np.float32), fill(a)]), geometry)
    part.opacity_logits[len(ids) :] = -np.inf
    return ids, dataclasses.replace(part, sh=np.zeros((size, 1, 3), np.float32))


def points_in_view(cameras: Camera, points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, "t p"]:
    """Tells which points each of T cameras has in its picture, whatever may hide them."""
    shown = []
    for camera in jax.tree.map(np.asarray, cameras):
        x, y, z = camera.world_to_camera[:3, :3] @ points.T + camera.world_to_camera[:3, 3:]
        z = np.where(z > 0, z, np.nan)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        shown.append((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
    return np.array(shown, bool).reshape(len(shown), len(points))


@functools.partial(jax.jit, static_argnums=2)
def _is_visible(gaussians: Gaussians, camera: Camera, near: float) -> Array:
    return project(gaussians, camera, near=near).visible


def padded_size(count: int) -> int:
    """Rounds a count up to an eighth of a power of two, at least 4,096, so that views share compiled programs."""
    step = max(4096, 1 << max(count.bit_length() - 4, 0))
    return max(-(-count // step), 1) * step


def render_in_blocks(gaussians: Gaussians, camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Renders the features of `render_rgb` of N finite Gaussians, many or in memory-mapped columns."""
    camera = jax.tree.map(np.asarray, camera)
    ids, visible = visible_part(gaussians, camera)
    colours = np.zeros((visible.count, 3), np.float32)
    for first in range(0, len(ids), ROWS):
        rows = ids[first : first + ROWS]
        part = jax.tree.map(lambda a, rows=rows: np.asarray(a[rows]), gaussians)
        colours[first : first + len(rows)] = _colours(part, camera)
    if not len(ids):
        return np.zeros((camera.height, camera.width, 3), np.float32)
    capacity = plan_capacity(visible, camera, margin=1.0, devices=1)  # of the default's room most would be empty
    return np.asarray(render(visible, camera, jnp.asarray(colours), capacity=capacity).features)


_colours = jax.jit(colours_from_sh)
