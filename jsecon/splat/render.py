"""Renders features, colour and depth of one view. Differentiable in every array, in reverse mode."""

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.numerics import NEAR
from jsecon.programs import stored_jit
from jsecon.splat.plan import plan_view, render_plan
from jsecon.splat.project import check_gaussians
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Array, Camera, Gaussians, Rendering


def render(
    gaussians: Gaussians,
    camera: Camera,
    features: Float[Array, "n d"],
    *,
    background: Array | None = None,
    capacity: int | None = None,
    near: float = NEAR,
    depth: bool = False,
    mesh: Mesh | None = None,
) -> Rendering:
    """Renders per-Gaussian features into one view: the sum of alpha T f over the Gaussians, front to back.

    The image equals the brute-force sum over all Gaussians; tiles and chunks affect only speed. It works under jit,
    grad, and vmap over cameras and feature sets, and is differentiable in every array. Only reverse mode works (grad,
    vjp, jacrev): jax.jvp and jax.jacfwd raise TypeError. For frozen geometry, call `plan_view` once and `render_plan`.

    Tile lists have a static capacity. Outside of a trace, a view that needs more is planned again with enough. Inside
    of a trace (jit, grad, vmap) that is impossible: `Rendering.overflow` counts the pairs that are missing, and 0 means
    that the image is exact.

    Non-finite inputs disable the affected Gaussians; a non-finite feature gives NaN in the pixels that its Gaussian
    touches. Neither has a gradient or affects another's. A camera that is not finite gives NaN everywhere.

    Args:
      gaussians: Scene of N Gaussians. Its `sh` has no influence and may be None.
      camera: One camera.
      features: (N, D), in the dtype of the Gaussians.
      background: (D,), added with weight 1 - alpha.
      capacity: Number of (block, Gaussian) pairs; by default `default_capacity`, a multiple of what scenes need, so
        that one program serves all views of a size. A given capacity is used as it is (`plan_capacity`).
      near: Near plane, world units.
      depth: Whether to render the expected z-depth sum(w z) / sum(w) in the same pass (`Rendering.depth`).
      mesh: Devices of this process to divide the work among (`jsecon.host_mesh()`), in value and gradient; None uses
        one device. A CPU has several devices only if `jsecon.process.prepare_process()` runs before jax starts. A jit
        around the call is faster with `compiler_options=jsecon.parallel.MESH_OPTIONS`.

    Returns:
      Features (H, W, D), alpha and overflow.

    Raises:
      ValueError: Shapes disagree.
    """
    plan = plan_view(gaussians, camera, capacity=capacity, near=near, mesh=mesh)
    # Outside of a trace these are two programs: all renderings of scenes of this size share the first.
    return render_plan(plan, features, background=background, depth=depth)


def render_rgb(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Array | None = None,
    capacity: int | None = None,
    near: float = NEAR,
    depth: bool = False,
    mesh: Mesh | None = None,
) -> Rendering:
    """Renders colour from spherical harmonics.

    Args:
      gaussians: Scene of N Gaussians.
      camera: One camera.
      background: (3,) colour, added with weight 1 - alpha.
      capacity: Number of (block, Gaussian) pairs, see `render`.
      near: Near plane, world units.
      depth: Whether to render depth in the same pass, see `render`.
      mesh: Devices of this process to divide the work among, see `render`; None uses one.

    Returns:
      Features (H, W, 3), not clamped above 1, alpha and overflow.

    Raises:
      ValueError: Shapes disagree.
    """
    check_gaussians(gaussians, camera)
    rgb = _colours(gaussians, camera)
    options = {"capacity": capacity, "near": near, "depth": depth, "mesh": mesh}
    return render(gaussians, camera, rgb, background=background, **options)


_colours = stored_jit(colours_from_sh)


def render_depth(
    gaussians: Gaussians, camera: Camera, *, capacity: int | None = None, near: float = NEAR
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Renders the expected z-depth sum(w z) / sum(w).

    Args:
      gaussians: Scene of N Gaussians; its `sh` may be None.
      camera: One camera.
      capacity: Number of (block, Gaussian) pairs, see `render`.
      near: Near plane, world units.

    Returns:
      Depth (H, W) in world units, 0 where no Gaussian is rendered, and alpha (H, W), the sum of alpha T; NaN if pairs
      overflowed the capacity.

    Raises:
      ValueError: Shapes disagree.
    """
    no_features = jnp.zeros((gaussians.means.shape[0], 0), jnp.asarray(gaussians.means).dtype)
    return _nan_on_overflow(render(gaussians, camera, no_features, capacity=capacity, near=near, depth=True))


@jax.jit
def _nan_on_overflow(rendering: Rendering) -> tuple[Array, Array]:
    def mask(image):
        return jnp.where(rendering.overflow > 0, jnp.nan, image)

    return mask(rendering.depth), mask(rendering.alpha)
