"""Real spherical harmonics of colour, degrees 0 to 3, in the order and signs of the INRIA layout."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require
from jsecon.numerics import normalize
from jsecon.splat.fusion import materialize, opaque_true
from jsecon.types import Array, Camera, Gaussians

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
      1.445305721320277, -0.5900435899266435)  # fmt: skip


COEFFICIENT_COUNTS = (1, 4, 9, 16)
"""numbers of coefficients that spherical harmonics of degree 0, 1, 2 and 3 have"""


def sh_basis(directions: Float[Array, "n 3"], bands: int) -> Float[Array, "n k"]:
    """The first `bands` (1, 4, 9 or 16) basis functions at unit `directions`."""
    require(bands in COEFFICIENT_COUNTS, "bands", bands, "1, 4, 9 or 16", "Pad sh to a whole degree.")
    return jnp.stack(_basis(directions[:, 0], directions[:, 1], directions[:, 2], bands), axis=-1)


def _basis(x: Array, y: Array, z: Array, bands: int) -> list:
    xx, yy, zz = x * x, y * y, z * z
    basis = [jnp.full_like(x, C0)]
    if bands > 1:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if bands > 4:
        basis += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if bands > 9:
        basis += [C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy),
                  C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy), C3[5] * z * (xx - yy),
                  C3[6] * x * (xx - 3 * yy)]  # fmt: skip
    return basis


@jax.custom_vjp
def _shown(directions: Array, sh: Array) -> Array:
    """(N, 3) sum over the bands of sh (N, K, 3) times the basis at unit `directions`. A column of numbers at a time:
    stacked, XLA's CPU backend asks of every number in the innermost loop which band it is of."""
    basis = materialize(opaque_true(sh[0, 0, 0]), lambda d: _basis(d[:, 0], d[:, 1], d[:, 2], sh.shape[1]), directions)
    colour = lambda c: sum((b * sh[:, k, c] for k, b in enumerate(basis[1:], start=1)), basis[0] * sh[:, 0, c])
    return jnp.stack([colour(c) for c in range(3)], axis=-1)


def _shown_backward(given: tuple[Array, Array], bar: Array) -> tuple[Array, Array]:
    directions, sh = given
    bands = sh.shape[1]
    always, columns = opaque_true(sh[0, 0, 0]), [directions[:, i] for i in range(3)]
    by_basis = materialize(always, lambda sh, bar: [(sh[:, k] * bar).sum(1) for k in range(bands)], sh, bar)
    of_bands = lambda x, y, z: _basis(x, y, z, bands)
    along = lambda x, y, z, by: jnp.stack(jax.vjp(of_bands, x, y, z)[1](by), axis=-1)
    basis = materialize(always, lambda d: sh_basis(d, bands), directions)
    return materialize(always, along, *columns, by_basis), basis[:, :, None] * bar[:, None]


_shown.defvjp(lambda directions, sh: (_shown(directions, sh), (directions, sh)), _shown_backward)


def colours_from_sh(gaussians: Gaussians, camera: Camera) -> Float[Array, "n 3"]:
    """RGB of each Gaussian as `camera` sees it: 0.5 + sum of bands, clamped at 0 (gradient masked there), not above.

    NaN, with gradient zero, where a coefficient is not finite. A mean that is not finite counts as seen from nowhere:
    its Gaussian is hidden anyway, and its gradient must not reach the camera.
    """
    bands = gaussians.sh.shape[1]
    require(
        bands in COEFFICIENT_COUNTS,
        "gaussians.sh",
        gaussians.sh.shape,
        "(N, 1, 4, 9 or 16, 3)",
        "Pad sh to a whole degree.",
    )
    sound = jnp.isfinite(gaussians.sh).all((1, 2))[:, None]
    sh = jnp.where(sound[:, :, None], gaussians.sh, 0.0)
    if bands == 1 or not len(sh):
        rgb = C0 * sh[:, 0]
    else:
        away = gaussians.means - camera.centres[None]
        away = jnp.where(jnp.isfinite(away).all(1, keepdims=True), away, 0.0)
        rgb = _shown(normalize(away), sh)
    return jnp.where(sound, jnp.maximum(rgb + 0.5, 0.0), jnp.nan)


def sh_from_rgb(rgb: Float[Array, "n 3"]) -> Float[Array, "n 1 3"]:
    """The degree-0 coefficients that show `rgb` from every side."""
    return ((rgb - 0.5) / C0)[:, None, :]
