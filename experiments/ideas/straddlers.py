"""Gaussians that lie half in a region, cut in two where its border runs through them, before anything is lifted.

A Gaussian of which the share s lies in a region is cut by a plane: the part inside has the mass s, its truncated normal
has the moments (with c = Phi^-1(s), lambda = phi(c) / s, and S u / sigma its covariance along the plane's normal u)

    mean + lambda S u / sigma,  S - (1 - k) (S u)(S u)^T / sigma^2,  k = 1 - c lambda - lambda^2

and the part outside likewise, mirrored. Where the border runs is read off the views: with J the Jacobian of the
projection, the weights w of the pixels p and the share s_v there,

    J S u / sigma phi(c) W = sum_p w_p (1[p in the region] - s_v) p

which is solved for S u / sigma by least squares over the views.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from jsecon.splat.plan import ViewPlan, plan_view, render_plan
from jsecon.types import Array, Camera, Gaussians

STRADDLES = 0.15, 0.85
"""shares of a Gaussian's first region between which it is cut"""
LEAST_WEIGHT = 3.0
"""px, of a Gaussian in all views"""
STEADY = 1e-2
"""of the least squares, in units of their own trace: what no view shows of the border is 0"""
THINNEST = 0.05
"""k, at least"""
UNIT = 100.0
"""px, of the images of positions: numbers near 1"""


@jax.jit
def _weights_onto(plan: ViewPlan, images: Array) -> Array:
    """(N, D) sum of the weights over images (H, W, D): the transpose of rendering."""
    blank = jnp.zeros((plan.splats.shape[0], images.shape[-1]), images.dtype)
    return jax.vjp(lambda features: render_plan(plan, features).features, blank)[1](images)[0]


def across(
    gaussians: Gaussians, cameras: Camera, labels: Int[np.ndarray, "t h w"], region: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """S u / sigma phi(c) (N, 3) of each Gaussian for the border of its `region` (N,), world units."""
    count, regions = gaussians.count, int(labels.max()) + 1
    means, every = np.asarray(gaussians.means, np.float64), np.arange(gaussians.count)
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    rows, columns = np.mgrid[: labels.shape[1], : labels.shape[2]] + 0.5
    for t, image in enumerate(labels):
        camera = jax.tree.map(jnp.asarray, cameras[t])
        inside = image[..., None] == np.arange(regions)
        x, y = (columns - camera.width / 2) / UNIT, (rows - camera.height / 2) / UNIT
        places = [np.ones_like(x), x, y]
        given = np.concatenate([np.stack(places, -1), *(inside * p[..., None] for p in places)], axis=-1)
        cast = np.asarray(_weights_onto(plan_view(gaussians, camera), jnp.asarray(given, jnp.float32)), np.float64)
        whole, own = cast[:, :3], np.stack([cast[every, 3 + k * regions + region] for k in range(3)], axis=1)
        share = own[:, :1] / np.maximum(whole[:, :1], 1e-9)
        leaning = UNIT * (own - share * whole)[:, 1:]
        pose = np.asarray(camera.world_to_camera, np.float64)
        local = means @ pose[:3, :3].T + pose[:3, 3]
        depth = np.maximum(local[:, 2], 1e-6)
        jacobian = np.zeros((count, 2, 3))
        for k, focal in enumerate((float(camera.fx), float(camera.fy))):
            jacobian[:, k, k], jacobian[:, k, 2] = focal / depth, -focal * local[:, k] / depth**2
        jacobian = jacobian @ pose[:3, :3]
        seen = (whole[:, 0] > 1e-3) & (np.bincount(image[image >= 0], minlength=regions)[region] > 0)
        normal += np.where(seen[:, None, None], np.einsum("nij,nik,n->njk", jacobian, jacobian, whole[:, 0]), 0.0)
        right += np.where(seen[:, None], np.einsum("nij,ni->nj", jacobian, leaning), 0.0)
    steady = STEADY * np.trace(normal, axis1=1, axis2=2) / 3 + 1e-9
    return np.linalg.solve(normal + steady[:, None, None] * np.eye(3), right[..., None])[..., 0]


def split(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Int[np.ndarray, "t h w"],
    region: Int[np.ndarray, " n"],
    share: Float[np.ndarray, " n"],
    total: Float[np.ndarray, " n"],
) -> Gaussians:
    """The scene with each straddler in two, whose `share` (N,) in its first `region` (N,) lies within STRADDLES and
    whose weight `total` (N,) counts; first the Gaussians that stay as they are, then inner parts, then outer ones."""
    cut = (share > STRADDLES[0]) & (share < STRADDLES[1]) & (total >= LEAST_WEIGHT)
    lean = across(gaussians, cameras, labels, np.maximum(region, 0))
    cut &= np.isfinite(lean).all(1) & (np.linalg.norm(lean, axis=1) > 0)
    own = jax.tree.map(np.asarray, gaussians)
    few = jax.tree.map(lambda a: a[cut], own)
    turn = Rotation.from_quat(few.quaternions.astype(np.float64), scalar_first=True).as_matrix()
    covariance = turn @ (np.exp(2.0 * few.log_scales.astype(np.float64))[:, :, None] * turn.transpose(0, 2, 1))
    lean = lean[cut]
    away = np.linalg.solve(covariance + 1e-12 * np.eye(3), lean[..., None])[..., 0]
    lean = lean / np.sqrt(np.maximum((away * lean).sum(1, keepdims=True), 1e-30))  # S u / sigma
    opacity = 1 / (1 + np.exp(-few.opacity_logits.astype(np.float64)))

    def part(side: int, mass: np.ndarray) -> Gaussians:
        middle = norm.ppf(mass)
        mills = norm.pdf(middle) / mass
        thin = np.clip(1 - middle * mills - mills**2, THINNEST, 1.0)
        cov = covariance - (1 - thin)[:, None, None] * lean[:, :, None] * lean[:, None, :]
        variances, axes = np.linalg.eigh(cov)
        axes[np.linalg.det(axes) < 0, :, 0] *= -1
        left = np.clip(opacity * mass / np.sqrt(thin), 1e-4, 0.99)
        return dataclasses.replace(
            few,
            means=(few.means + side * mills[:, None] * lean).astype(np.float32),
            log_scales=(0.5 * np.log(np.maximum(variances, 1e-12))).astype(np.float32),
            quaternions=Rotation.from_matrix(axes).as_quat(scalar_first=True).astype(np.float32),
            opacity_logits=np.log(left / (1 - left)).astype(np.float32),
        )

    parts = jax.tree.map(lambda a: a[~cut], own), part(1, share[cut]), part(-1, 1 - share[cut])
    return jax.tree.map(lambda *a: jnp.asarray(np.concatenate(a)), *parts)
