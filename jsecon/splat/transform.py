"""Transforms Gaussians between worlds by a similarity: rotation, scale and shift, colours included."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jsecon.errors import require
from jsecon.splat.sh import sh_basis
from jsecon.types import Array, Gaussians


@np.errstate(over="ignore", invalid="ignore")  # non-finite numbers stay so; callers check
def transform_gaussians(gaussians: Gaussians, similarity: Float[Array, "4 4"]) -> Gaussians:
    """Transforms Gaussians: positions, sizes, orientations and spherical harmonics. Host code (NumPy).

    A camera that is transformed too sees the same image. Means become float64, which worlds with large coordinates (map
    projections) need: float32 cannot represent millimetres there.

    Args:
      gaussians: N Gaussians.
      similarity: Matrix of x' = s R x + t, with R a rotation and s > 0; a ValueError for any other.
    """
    gaussians = jax.tree.map(np.asarray, gaussians)
    means, log_scales, turns, sh = gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.sh
    means = means.astype(np.float64)
    matrix = np.asarray(similarity, np.float64)
    if np.array_equal(matrix, np.eye(4)):
        return dataclasses.replace(gaussians, means=means)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = matrix[:3, :3] / scale if scale > 0 else np.zeros((3, 3))
    rigid = scale > 0 and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    similar = bool(rigid and np.allclose(matrix[3], [0, 0, 0, 1]))
    expected, remedy = "a rotation, one positive scale and a shift", "Remove shear, mirrors and unequal scales."
    require(similar, "similarity", matrix.tolist(), expected, remedy)
    turn = _product_matrix(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
    return Gaussians(
        means=means @ (scale * rotation.T) + matrix[:3, 3],
        log_scales=log_scales + np.asarray(np.log(scale), log_scales.dtype),
        quaternions=turns @ turn.astype(turns.dtype),
        opacity_logits=gaussians.opacity_logits,
        sh=None if sh is None else _sh_rotation(rotation, sh.shape[1]).astype(sh.dtype) @ sh,
    )


def float32_rounding(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """Measures what float32 would cost each float64 mean, in units of its Gaussian's largest standard deviation."""
    means = np.asarray(gaussians.means)
    moved = np.abs(means - means.astype(np.float32).astype(np.float64)).max(axis=1, initial=0.0)
    sizes = np.asarray(gaussians.log_scales, np.float64).max(axis=1, initial=-np.inf)
    sizes = np.exp(np.minimum(sizes, 700.0))  # the exponential of more is infinite
    return np.divide(moved, sizes, out=np.where(moved > 0, np.inf, 0.0), where=sizes > 0)


def _product_matrix(q: np.ndarray) -> np.ndarray:
    """(4, 4) matrix M of a quaternion (4,): r M is the Hamilton product q r, a rotation by r, then by q."""
    w, x, y, z = q
    return np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])


def _sh_rotation(rotation: np.ndarray, bands: int) -> np.ndarray:
    """(K, K) rotation of coefficients: the new ones at d give the value of the old ones at R^T d.

    Each degree is closed under rotation, so least squares over enough directions is exact.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    after = np.asarray(sh_basis(jnp.asarray(directions), bands), np.float64)
    before = np.asarray(sh_basis(jnp.asarray(directions @ rotation), bands), np.float64)
    return np.linalg.lstsq(after, before, rcond=None)[0]
