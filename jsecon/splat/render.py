"""Rendering: D-channel features, colour, depth, of one view; differentiable in every array."""

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.errors import require_shape
from jsecon.numerics import NEAR, is_traced
from jsecon.splat.plan import plan_view, render_plan, require_background
from jsecon.splat.project import check_shapes
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
    """Renders per-Gaussian `features` (N, D) into one view: sum over the depth-sorted Gaussians of alpha T f.

    Exact by definition: equal to the brute-force sum over all Gaussians, whatever the tiling.
    Differentiable in every array, under jit, grad, and vmap over cameras and over feature sets. With frozen geometry,
    `plan_view` once and `render_plan`.

    The tile lists have room for a static number of (block, Gaussian) pairs, by default `default_capacity`: a multiple
    of what scenes need, from the sizes alone, so one program serves all views of a size. A view that needs more is
    rendered again with enough room outside a trace. Inside one (jit, grad, vmap) that cannot be: what did not fit is
    counted in `.overflow`, never dropped unsaid; 0 there means that the image is exact. Such a scene takes an explicit
    `capacity` (`plan_capacity`), which is taken as it is, in and outside of a trace.

    Gaussians with NaN or infinite numbers are hidden, and a feature that is not finite makes NaN of the pixels that its
    Gaussian touches; neither has a gradient, nor spoils another's (`project.count_non_finite` counts them). A camera
    that is not finite sees NaN.

    `mesh` (`jsecon.parallel.host_mesh()`) spreads the work over several devices of this process, in value and
    gradient: a program that calls `jsecon.process.prepare_process()` before jax starts has all cores of a CPU that way.
    A jit of your own around it is faster with `compiler_options=jsecon.parallel.MESH_OPTIONS`. Without it, one device.

    Features in bfloat16 are read as such, which halves what a wide walk gathers, and summed in the Gaussians' dtype,
    that of the image: the error is that of rounding the features (experiments/retired.md), the time the
    same on a CPU. `background` (D,) is added with weight 1 - alpha. With `depth` the same pass also gives `.depth`, the
    expected z-depth sum(w z) / sum(w). Raises ValueError on shapes that disagree.
    """
    check_shapes(gaussians, camera)
    require_shape("features", features, (gaussians.count, "D"), "Give one row of features per Gaussian.")
    require_background(background, features.shape[1])
    if gaussians.means.shape[0] == 0:
        image = jnp.zeros((camera.height, camera.width, features.shape[1]), gaussians.means.dtype)
        alpha = jnp.zeros(image.shape[:2], image.dtype)
        image = image if background is None else image + jnp.reshape(background, (1, 1, -1))
        return Rendering(image, alpha, jnp.int32(0), alpha if depth else None)
    plan = plan_view(gaussians, camera, capacity=capacity, near=near, mesh=mesh)
    # Outside a trace two programs: whatever else is rendered of a scene of this size shares the first.
    return render_plan(plan, features, background=background, depth=depth)


def render_rgb(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Array | None = None,
    capacity: int | None = None,
    near: float = NEAR,
    mesh: Mesh | None = None,
) -> Rendering:
    """Renders colour from spherical harmonics: features (H, W, 3), not clamped above 1. See `render`."""
    check_shapes(gaussians, camera)
    colours = colours_from_sh if is_traced((gaussians, camera)) else _colours_compiled
    rgb = colours(gaussians, camera)
    return render(gaussians, camera, rgb, background=background, capacity=capacity, near=near, mesh=mesh)


_colours_compiled = jax.jit(colours_from_sh)


def render_depth(
    gaussians: Gaussians, camera: Camera, *, capacity: int | None = None, near: float = NEAR
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Expected z-depth (H, W) = sum(w z) / sum(w), world units, 0 where nothing is covered; and alpha (H, W). NaN where
    pairs overflowed the capacity, which has no other place here (see `render`)."""
    nothing = jnp.zeros((gaussians.means.shape[0], 0), jnp.asarray(gaussians.means).dtype)
    return _unless_overflow(render(gaussians, camera, nothing, capacity=capacity, near=near, depth=True))


@jax.jit
def _unless_overflow(rendering: Rendering) -> tuple[Array, Array]:
    mark = lambda image: jnp.where(rendering.overflow > 0, jnp.nan, image)
    return jax.tree.map(mark, (rendering.depth, rendering.alpha))
