"""Per-view corrections of camera pose and exposure, optimised together with the scene. Pure functions.

The correction of a pose is a twist in the frame of the camera: exp(twist) world_to_camera, zero for no correction. The
correction of an exposure is an affine map from rendered colours to the colours of the frame (gains, white balance,
offset). Each view has a row, which Adam moves when that view is drawn, with separate moments.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.types import Array, record

_TERMS = 24
"""Terms of the power series of a rigid motion: exact to float64 for rotations of up to 3 radians."""


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


def se3_exp(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Computes the rigid motion of a twist of up to 3 radians: the exponential of its matrix, by its power series."""
    x, y, z, a, b, c = twist
    zero = jnp.zeros_like(x)
    matrix = jnp.stack([zero, -z, y, a, z, zero, -x, b, -y, x, zero, c, zero, zero, zero, zero]).reshape(4, 4)
    identity = jnp.eye(4, dtype=twist.dtype)

    def next_power(n, motion):  # Horner's rule, from the last term
        return identity + (matrix[:, :, None] * motion[None]).sum(1) / (_TERMS - n)

    return jax.lax.fori_loop(0, _TERMS, next_power, identity)
