"""Real spherical harmonics of colour, degrees 0 to 3, in the order and signs of INRIA's layout. Pure functions."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require
from jsecon.numerics import normalize
from jsecon.splat.fusion import compute_once, opaque_true
from jsecon.types import Array, Camera, Gaussians

C0 = 0.28209479177387814
"""The constant basis function."""
COEFFICIENT_COUNTS = (1, 4, 9, 16)
"""Number of coefficients up to degree 0, 1, 2 and 3."""


def sh_basis(directions: Float[Array, "n 3"], coefficients: int) -> Float[Array, "n k"]:
    """Evaluates the first 1, 4, 9 or 16 basis functions at unit directions."""
    require(
        coefficients in COEFFICIENT_COUNTS, "coefficients", coefficients, "1, 4, 9 or 16", "Pad sh to a whole degree."
    )
    return jnp.stack(_basis(directions[:, 0], directions[:, 1], directions[:, 2], coefficients), axis=-1)


def _basis(x: Array, y: Array, z: Array, coefficients: int) -> list:
    xx, yy, zz = x * x, y * y, z * z
    basis = [jnp.full_like(x, C0)]
    if coefficients > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if coefficients > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if coefficients > 9:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return basis


@jax.custom_vjp
def _colours(directions: Array, sh: Array) -> Array:
    """Sums sh (N, K, 3) times the basis at unit `directions`, one column at a time; returns (N, 3).

    For stacked columns XLA's CPU backend tests in the innermost loop which basis function a number belongs to.
    """
    basis = compute_once(opaque_true(sh[0, 0, 0]), lambda d: _basis(d[:, 0], d[:, 1], d[:, 2], sh.shape[1]), directions)

    def colour(c):
        return sum((b * sh[:, k, c] for k, b in enumerate(basis[1:], start=1)), basis[0] * sh[:, 0, c])

    return jnp.stack([colour(c) for c in range(3)], axis=-1)


def _colours_backward(residuals: tuple[Array, Array], bar: Array) -> tuple[Array, Array]:
    directions, sh = residuals
    coefficients = sh.shape[1]
    always, columns = opaque_true(sh[0, 0, 0]), [directions[:, i] for i in range(3)]
    by_basis = compute_once(always, lambda sh, bar: [(sh[:, k] * bar).sum(1) for k in range(coefficients)], sh, bar)

    def evaluate(x, y, z):
        return _basis(x, y, z, coefficients)

    def along(x, y, z, by):
        return jnp.stack(jax.vjp(evaluate, x, y, z)[1](by), axis=-1)

    basis = compute_once(always, lambda d: sh_basis(d, coefficients), directions)
    return compute_once(always, along, *columns, by_basis), basis[:, :, None] * bar[:, None]


_colours.defvjp(lambda directions, sh: (_colours(directions, sh), (directions, sh)), _colours_backward)


@functools.partial(jax.jit, inline=True)
def colours_from_sh(gaussians: Gaussians, camera: Camera) -> Float[Array, "n 3"]:
    """Computes the colours of N Gaussians as a camera sees them. Reverse mode only.

    They are 0.5 + sum over the basis, clamped at 0 (with gradient zero there) but not above. NaN, with gradient zero,
    if a coefficient is not finite.
    """
    coefficients = gaussians.sh.shape[1]
    require(
        coefficients in COEFFICIENT_COUNTS,
        "gaussians.sh",
        gaussians.sh.shape,
        "(N, 1, 4, 9 or 16, 3)",
        "Pad sh to a whole degree.",
    )
    finite = jnp.isfinite(gaussians.sh).all((1, 2))[:, None]
    sh = jnp.where(finite[:, :, None], gaussians.sh, 0.0)
    if coefficients == 1 or not len(sh):
        rgb = C0 * sh[:, 0]
    else:
        away = gaussians.means - camera.centres[None]
        # A mean that is not finite is replaced: its Gaussian is hidden, and its gradient must not reach the camera.
        away = jnp.where(jnp.isfinite(away).all(1, keepdims=True), away, 0.0)
        rgb = _colours(normalize(away), sh)
    return jnp.where(finite, jnp.maximum(rgb + 0.5, 0.0), jnp.nan)
