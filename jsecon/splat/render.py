"""Rendering: D-channel features, colour, depth, of one view; differentiable in every array."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require
from jsecon.numerics import NEAR, finite
from jsecon.splat.contain import splat_contained
from jsecon.splat.project import check_shapes, project
from jsecon.splat.sh import colours_from_sh
from jsecon.splat.splats import splats_of
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Array, Camera, Gaussians, Rendering


def is_traced(tree) -> bool:
    """Whether any leaf of `tree` is being traced (jit, grad, vmap)."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def default_capacity(gaussians: Gaussians, camera: Camera) -> int:
    """(tile, Gaussian) pairs to allow for: planned from the data; under a trace, where there is none, it must be
    given."""
    require(
        not is_traced((gaussians, camera)),
        "capacity",
        got=None,
        expected="a static int inside jit, grad or vmap",
        remedy="Pass capacity=jsecon.plan_capacity(gaussians, cameras), and check Rendering.overflow == 0.",
    )
    return plan_capacity(gaussians, camera, margin=1.0)


def render(
    gaussians: Gaussians,
    camera: Camera,
    features: Float[Array, "n d"],
    *,
    background: Array | None = None,
    capacity: int | None = None,
    near: float = NEAR,
) -> Rendering:
    """Renders per-Gaussian `features` (N, D) into one view: sum over the depth-sorted Gaussians of alpha T f.

    Exact by definition (DESIGN section 5): equal to the brute-force sum over all Gaussians, whatever the tiling.
    Differentiable in every array, under jit, grad, and vmap over cameras and over feature sets. Outside a trace the
    capacity is planned from the data; inside one pass the static `capacity` (see `plan_capacity`): pairs that do not
    fit are counted in `.overflow`, never dropped unsaid. Gaussians with NaN or infinite numbers are hidden, and a
    feature that is not finite makes NaN of the pixels that its Gaussian touches; neither has a gradient, nor spoils
    another's (`sound.count_non_finite` counts them). A camera that is not finite sees NaN.

    `background` (D,) is added with weight 1 - alpha. Raises ValueError on shapes that disagree.
    """
    check_shapes(gaussians, camera)
    require(
        features.ndim == 2 and features.shape[0] == gaussians.means.shape[0],
        "features",
        got=features.shape,
        expected=f"({gaussians.means.shape[0]}, D)",
        remedy="Give one row of features a Gaussian.",
    )
    if capacity is None:
        capacity = default_capacity(gaussians, camera)
        return _render_compiled(gaussians, camera, features, background, capacity, near)
    return _render(gaussians, camera, features, background, capacity, near)


def _render(gaussians, camera, features, background, capacity, near) -> Rendering:
    gaussians, camera, features = jax.tree.map(jnp.asarray, (gaussians, camera, features))
    if gaussians.means.shape[0] == 0:
        image, alpha = (
            jnp.zeros((camera.height, camera.width, *rest), gaussians.means.dtype)
            for rest in ((features.shape[1],), ())
        )
        image = image if background is None else image + jnp.reshape(background, (1, 1, -1))
        return Rendering(image, alpha, jnp.int32(0))
    splats, lists = splats_of(gaussians, camera, capacity=capacity, near=near)
    image, transmittance = splat_contained(splats, features.astype(splats.dtype), lists, camera.width, camera.height)
    # A camera that is not finite touches every pixel.
    sound = finite(*jax.tree.leaves(camera))
    image, transmittance = (jnp.where(sound, a, jnp.nan) for a in (image, transmittance))
    if background is not None:
        image = image + transmittance[..., None] * jnp.reshape(background, (1, 1, -1))
    return Rendering(image, 1 - transmittance, lists.overflow)


_render_compiled = jax.jit(_render, static_argnums=(4, 5))


def render_rgb(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Array | None = None,
    capacity: int | None = None,
    near: float = NEAR,
) -> Rendering:
    """Renders colour from spherical harmonics: features (H, W, 3), not clamped above 1. See `render`."""
    check_shapes(gaussians, camera)
    if capacity is None:
        capacity = default_capacity(gaussians, camera)
        return _render_rgb_compiled(gaussians, camera, background, capacity, near)
    return _render_rgb(gaussians, camera, background, capacity, near)


def _render_rgb(gaussians, camera, background, capacity, near):
    return _render(gaussians, camera, colours_from_sh(gaussians, camera), background, capacity, near)


_render_rgb_compiled = jax.jit(_render_rgb, static_argnums=(3, 4))


def render_depth(
    gaussians: Gaussians, camera: Camera, *, capacity: int | None = None, near: float = NEAR
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Expected z-depth (H, W) = sum(w z) / sum(w), world units, 0 where nothing is covered; and alpha (H, W)."""
    depths = project(gaussians, camera, near=near).depths
    depths = jnp.where(jnp.isfinite(depths), depths, 0.0)
    rendering = render(gaussians, camera, depths[:, None], capacity=capacity, near=near)
    covered = rendering.alpha > 0
    return jnp.where(
        covered, rendering.features[..., 0] / jnp.where(covered, rendering.alpha, 1.0), 0.0
    ), rendering.alpha
