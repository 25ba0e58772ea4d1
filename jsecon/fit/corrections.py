"""Per-view corrections of camera pose and exposure, optimised together with the scene. Pure functions.

The correction of a pose is a twist in the frame of the camera: exp(twist) world_to_camera, zero for no correction. The
correction of an exposure is an affine map from rendered colours to the colours of the frame (gains, white balance,
offset). Each view has a row, which Adam moves when that view is drawn, with separate moments.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jsecon.types import Array, Camera, record


@record
class Corrections:
    """Corrections of T views, or of one view without the leading axis."""

    twists: Any
    """(T, 6) rotation in radians, then translation in world units, along the axes of the camera; zero: no
    correction."""
    colours: Any
    """(T, 3, 4) map from rendered r, g, b and 1 to the frame's rgb in [0, 1]; identity and zero: no correction."""


@record
class CorrectionState:
    """Corrections and the moments of their optimiser."""

    current: Any
    """Corrections."""
    first_moment: Any
    """Adam's running mean of the gradient, in the same layout."""
    second_moment: Any
    """Adam's running mean of the squared gradient, in the same layout."""


class CorrectionRates(NamedTuple):
    """Adam's first steps per visit of a view; they fall log-linearly to 3 %. Zero keeps what it belongs to."""

    pose: float = 3e-3
    """Radians, and shares of the cameras' extent."""
    colour: float = 1e-2
    """Each number of a colour map."""


def identity_corrections(views: int) -> Corrections:
    """Makes corrections without effect (NumPy)."""
    return Corrections(np.zeros((views, 6), np.float32), np.tile(np.eye(3, 4, dtype=np.float32), (views, 1, 1)))


def _series(squared: Array, first: int) -> Array:
    """The sum over k of (-squared)^k / (2 k + first)!; nine terms are exact to float64 for squared angles up to 1."""
    total = jnp.zeros_like(squared)
    for k in reversed(range(9)):
        total = total * -squared + 1 / math.factorial(2 * k + first)
    return total


def se3_exp(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Computes the rigid motion of a twist (Lynch and Park 2017, eq. 3.88), smooth everywhere, zero included."""
    x, y, z = twist[0], twist[1], twist[2]
    squared = x * x + y * y + z * z
    small = squared < 1
    # Each branch gets only numbers that it can handle: sqrt has no gradient at 0, and the series ends.
    near = jnp.where(small, squared, 0.0)
    far = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(far)
    sine = jnp.sin(angle) / angle
    versine = 2 * jnp.sin(angle / 2) ** 2 / far
    closed_forms = sine, versine, (1 - sine) / far
    a, b, c = (jnp.where(small, _series(near, n), closed) for n, closed in zip((1, 2, 3), closed_forms))
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    identity = jnp.eye(3, dtype=twist.dtype)
    cross_squared = twist[:3, None] * twist[None, :3] - squared * identity
    rotation = identity + a * cross + b * cross_squared
    translation = ((identity + b * cross + c * cross_squared) * twist[3:]).sum(1)
    last_row = jnp.eye(4, dtype=twist.dtype)[3:]
    return jnp.concatenate([jnp.concatenate([rotation, translation[:, None]], axis=1), last_row])


def corrected_camera(camera: Camera, twist: Float[Array, "6"]) -> Camera:
    """Moves a camera by a twist in its frame: exp(twist) world_to_camera."""
    motion, pose = se3_exp(twist), camera.world_to_camera
    # Multiply-and-sum: exact float32 on every backend.
    moved = (motion[:, :, None] * pose[None, :, :].astype(motion.dtype)).sum(1)
    return dataclasses.replace(camera, world_to_camera=moved)


def apply_exposure(image: Float[Array, "h w 3"], colour: Float[Array, "3 4"]) -> Float[Array, "h w 3"]:
    """Applies the colour map of a view to rendered colours, without clamping."""
    r, g, b = image[..., 0], image[..., 1], image[..., 2]
    return jnp.stack([row[0] * r + row[1] * g + row[2] * b + row[3] for row in colour], axis=-1)
