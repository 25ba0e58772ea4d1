"""What a fit may put right about its frames beside the scene: where each camera stood, and how bright its picture is.

A pose's correction is a twist of the camera's own frame, exp(twist) world_to_camera, zero at rest; an exposure's one is
an affine map of rendered colours to the frame's, the identity at rest, which holds gains, white balance and an offset.
Each view has its own row, which moves when that view is taken, by Adam with the row's own moments.
"""

import dataclasses
import math
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int

from jsecon.types import Array, Camera, record

POSES_WEIGHT, COLOURS_WEIGHT = 1e-3, 1e-3
"""of the squared corrections (radians, shares of the extent; parts of the colour range) in a view's loss: they only
decide what the frames leave open"""
_TERMS = 9
"""of the series of sin and cos in squared angles up to 1, right to float64"""


@record
class Corrections:
    """Of T views; or one row of them, of one view."""

    twists: Any
    """(T, 6) rotation, radians, then translation, world units, both along the camera's axes; zero at rest"""
    colours: Any
    """(T, 3, 4) of the rendered rgb and 1 to the frame's rgb, in [0, 1]; the identity and no offset at rest"""


@record
class CorrectionState:
    """Corrections under way."""

    now: Corrections
    first_moment: Corrections
    """Adam's running mean of the gradient"""
    second_moment: Corrections
    """Adam's running mean of its square"""


@dataclasses.dataclass(frozen=True)
class RefineOptions:
    """What is corrected, and how fast. Rates are Adam's step each time that a view is taken, and decay log-linearly."""

    poses: bool = True
    exposure: bool = True
    pose_rate: float = 3e-3
    """radians, and shares of the cameras' extent, at the first step"""
    colour_rate: float = 1e-2
    """of each of the affine map's numbers, at the first step"""
    last: float = 0.03
    """of the rates at the last step, as a share of the first"""

    def rates(self, done: float, extent: float) -> Corrections:
        """Of one view's row; zero of what is not refined."""
        decay = self.last**done
        pose, colour = self.poses * self.pose_rate * decay, self.exposure * self.colour_rate * decay
        return Corrections(np.repeat(np.array([pose, pose * extent], np.float32), 3), np.float32(colour))


def identity_corrections(views: int) -> Corrections:
    """None at all, of so many views."""
    return Corrections(np.zeros((views, 6), np.float32), np.tile(np.eye(3, 4, dtype=np.float32), (views, 1, 1)))


def init_corrections(views: int) -> CorrectionState:
    """Before the first step."""
    rest = identity_corrections(views)
    zeros = jax.tree.map(np.zeros_like, rest)
    return CorrectionState(rest, zeros, zeros)


def _series(squared: Array, first: int) -> Array:
    """The sum over k of (-squared)^k / (2 k + first)!."""
    total = jnp.zeros_like(squared)
    for k in reversed(range(_TERMS)):
        total = total * -squared + 1 / math.factorial(2 * k + first)
    return total


def se3_exp(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The rigid motion of a twist (rotation, radians; translation): smooth everywhere, zero included, and right to the
    last digits (Lynch and Park 2017, eq. 3.88)."""
    x, y, z = twist[0], twist[1], twist[2]
    squared = x * x + y * y + z * z
    small = squared < 1
    # Each branch sees only numbers that it bears: sqrt has no gradient at 0, and the series ends.
    near, far = jnp.where(small, squared, 0.0), jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(far)
    sine, versine = jnp.sin(angle) / angle, 2 * jnp.sin(angle / 2) ** 2 / far
    closed = sine, versine, (1 - sine) / far
    a, b, c = (jnp.where(small, _series(near, n), by_angle) for n, by_angle in zip((1, 2, 3), closed))
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    identity = jnp.eye(3, dtype=twist.dtype)
    square = twist[:3, None] * twist[None, :3] - squared * identity  # of cross
    rotation = identity + a * cross + b * square
    moved = ((identity + b * cross + c * square) * twist[3:]).sum(1)
    last = jnp.eye(4, dtype=twist.dtype)[3:]
    return jnp.concatenate([jnp.concatenate([rotation, moved[:, None]], axis=1), last])


def corrected_camera(camera: Camera, twist: Float[Array, "6"]) -> Camera:
    """A camera moved by a twist of its own frame: exp(twist) world_to_camera."""
    motion, pose = se3_exp(twist), camera.world_to_camera
    # Multiply-and-sum: exact float32 on every backend.
    moved = (motion[:, :, None] * pose[None, :, :].astype(motion.dtype)).sum(1)
    return dataclasses.replace(camera, world_to_camera=moved)


def apply_exposure(image: Float[Array, "h w 3"], colour: Float[Array, "3 4"]) -> Float[Array, "h w 3"]:
    """The rendered colours as the view's exposure shows them; not clamped."""
    r, g, b = image[..., 0], image[..., 1], image[..., 2]
    return jnp.stack([row[0] * r + row[1] * g + row[2] * b + row[3] for row in colour], axis=-1)


def correction_penalty(own: Corrections, extent: Float[Array, ""]) -> Float[Array, ""]:
    """What one view's corrections add to its loss; translations count by the extent where there is any."""
    shift = own.twists[3:] / jnp.where(extent > 0, extent, 1.0)
    poses = jnp.sum(own.twists[:3] ** 2) + jnp.sum(shift**2)
    return POSES_WEIGHT * poses + COLOURS_WEIGHT * jnp.sum((own.colours - jnp.eye(3, 4)) ** 2)


_ADAM = optax.scale_by_adam(eps=1e-15)


def update_corrections(
    refined: CorrectionState, view: Int[Array, ""], gradient: Corrections, taken: Int[Array, ""], rate: Corrections
) -> CorrectionState:
    """Adam's step of one view's row, which was `taken` so many times before."""
    own = jax.tree.map(lambda a: a[view], refined)
    moments: Any = optax.ScaleByAdamState(*cast(Any, (taken, own.first_moment, own.second_moment)))
    change, moments = _ADAM.update(cast(Any, gradient), moments)
    now = jax.tree.map(lambda p, u, r: p - r * u, own.now, change, rate)
    return jax.tree.map(lambda a, row: a.at[view].set(row), refined, CorrectionState(now, moments.mu, moments.nu))
