"""Gaussians carried from one world into another by a similarity: turned, scaled and shifted, colours included."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jsecon.errors import require
from jsecon.splat.sh import sh_basis
from jsecon.types import Array, Camera, Gaussians

ROWS = 1 << 18
"""Gaussians carried at a time"""


@np.errstate(over="ignore", invalid="ignore")  # what is not finite stays so, for the caller to tell
def transform_gaussians(gaussians: Gaussians, similarity: Float[Array, "4 4"]) -> Gaussians:
    """The Gaussians in the world that `similarity` (4, 4) leads to: x' = s R x + t, with R a rotation and s > 0.

    Positions, sizes, orientations and the spherical harmonics all follow, so a camera that is carried along sees the
    same image. Arrays keep their kind (NumPy, jax) and their type: float64 means (NumPy) are carried in float64. The
    identity returns the Gaussians as they are.

    Raises:
      ValueError: The matrix is no similarity.
    """
    matrix = np.asarray(similarity, np.float64)
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = matrix[:3, :3] / scale if scale > 0 else np.zeros((3, 3))
    rigid = scale > 0 and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    similar = bool(rigid and np.allclose(matrix[3], [0, 0, 0, 1]))
    expected, remedy = "a rotation, one positive scale and a shift", "Leave out shear, mirrors and unequal scales."
    require(similar, "similarity", matrix.tolist(), expected, remedy)
    xp = gaussians.means.__array_namespace__()
    like = lambda column, array: xp.asarray(array, column.dtype)
    means, turns, sh = gaussians.means, gaussians.quaternions, gaussians.sh
    with jax.default_matmul_precision("highest"):  # WHOLE, for NumPy arrays too
        return Gaussians(
            means=means @ like(means, scale * rotation.T) + like(means, matrix[:3, 3]),
            log_scales=gaussians.log_scales + like(gaussians.log_scales, np.log(scale)),
            quaternions=turns @ like(turns, _product_matrix(quaternion_from_matrix(rotation))),
            opacity_logits=gaussians.opacity_logits,
            sh=like(sh, _sh_rotation(rotation, sh.shape[1])) @ sh,
        )


def transform_gaussians_float64(gaussians: Gaussians, similarity: Float[Array, "4 4"]) -> Gaussians:
    """`transform_gaussians` on the host, with the means in float64 before and after: NumPy arrays.

    Use it into a world of large coordinates (a map projection's), where float32 holds no millimetres, and out of it.
    """
    host = jax.tree.map(np.asarray, gaussians)
    return transform_gaussians(dataclasses.replace(host, means=host.means.astype(np.float64)), similarity)


def float32_rounding(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """(N,) by how much float32 rounds each of the means, in units of the Gaussian's largest standard deviation."""
    means = np.asarray(gaussians.means)
    moved = np.abs(means - means.astype(np.float32).astype(np.float64)).max(axis=1, initial=0.0)
    sizes = np.asarray(gaussians.log_scales, np.float64).max(axis=1, initial=-np.inf)
    sizes = np.exp(np.minimum(sizes, 700.0))  # the exponential of more is infinite
    return np.divide(moved, sizes, out=np.where(moved > 0, np.inf, 0.0), where=sizes > 0)


def transform_axes(gaussians: Gaussians, axes: Float[Array, "4 4"]) -> Gaussians:
    """`transform_gaussians` between right-handed or left-handed axes: `axes` (4, 4) may also mirror.

    A Gaussian is its own mirror image along its axes, so that a mirrored one is a turned one.
    """
    matrix = np.asarray(axes, np.float64)
    if np.linalg.det(matrix[:3, :3]) > 0:
        return transform_gaussians(gaussians, matrix)
    flip = np.array([-1.0, 1.0, 1.0])
    directions = np.random.default_rng(0).normal(size=(8, 3))
    bands = gaussians.sh.shape[1]
    before, after = (np.asarray(sh_basis(jnp.asarray(d), bands), np.float64) for d in (directions, directions * flip))
    signs = np.sign((before * after).sum(0))  # each basis function is even or odd in x
    mirrored = dataclasses.replace(
        gaussians,
        means=gaussians.means * flip.astype(np.float32),
        quaternions=gaussians.quaternions * np.array([1, 1, -1, -1], np.float32),
        sh=gaussians.sh * signs.astype(np.float32)[:, None],
    )
    return transform_gaussians(mirrored, matrix @ np.diag([*flip, 1.0]))


def transform_blocks(
    gaussians: Gaussians, similarity: Float[Array, "4 4"] | None = None
) -> Iterator[tuple[slice, Gaussians]]:
    """`transform_gaussians_float64` of ROWS Gaussians after the other, and which they are: mapped columns need not fit
    into memory. Without a similarity they come as they are, NumPy."""
    for first in range(0, gaussians.count, ROWS):
        own = slice(first, min(first + ROWS, gaussians.count))
        part = jax.tree.map(lambda a, own=own: np.asarray(a[own]), gaussians)
        yield own, part if similarity is None else transform_gaussians_float64(part, similarity)


def recenter(
    gaussians: Gaussians, cameras: Camera, *, origin: Float[np.ndarray, "3"] | None = None
) -> tuple[Gaussians, Camera, Float[np.ndarray, "4 4"]]:
    """The same scene and cameras (one, or a batch) in a world whose origin lies at `origin`, by default the middle of
    the means; and the (4, 4) float64 shift that leads back.

    Float32 holds a coordinate of 1e6 m to 6 cm, and a camera beside it no better: such a scene (a map projection's
    coordinates, say) can't be rendered as it is. Positions and poses are shifted in float64 and returned in float32;
    the cameras keep what they see. Host code. Give it float64 arrays where there are any: what float32 rounded before
    stays rounded.
    """
    means = np.asarray(gaussians.means, np.float64)
    if origin is None:
        sound = means[np.isfinite(means).all(1)]
        origin = np.median(sound, axis=0) if len(sound) else np.zeros(3)
    poses = np.array(cameras.world_to_camera, np.float64)
    poses[..., :3, 3] += poses[..., :3, :3] @ origin
    back = np.eye(4)
    back[:3, 3] = origin
    moved = dataclasses.replace(gaussians, means=(means - origin).astype(np.float32))
    return moved, dataclasses.replace(cameras, world_to_camera=poses.astype(np.float32)), back


def quaternion_from_matrix(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit wxyz of a rotation matrix: an eigenvector (Bar-Itzhack 2000), stable at every angle."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, np.float64)
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(symmetric)[1][:, -1]


def _product_matrix(q: np.ndarray) -> np.ndarray:
    """(4, 4) M of a quaternion (4,): r M is the Hamilton product q r, which turns by r first, then by q."""
    w, x, y, z = q
    return np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])


def _sh_rotation(rotation: np.ndarray, bands: int) -> np.ndarray:
    """(K, K) that turns coefficients: the basis at d must give what the old one gave at R^T d.

    Each degree is closed under rotation, so that least squares over enough directions is exact.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    after = np.asarray(sh_basis(jnp.asarray(directions), bands), np.float64)
    before = np.asarray(sh_basis(jnp.asarray(directions @ rotation), bands), np.float64)
    return np.linalg.lstsq(after, before, rcond=None)[0]
