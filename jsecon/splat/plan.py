"""Plans of views: what repeated renderings of frozen geometry share, so that they skip projection and sorting.

`_make_plan` and `_composite_plan` are pure. `plan_view`, `prepare_views` and `render_plan` drive them: outside of a
trace they call compiled programs, and plan again if the capacity overflows.
"""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import sequential_vmap
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.numerics import NEAR, all_finite, is_traced
from jsecon.parallel import MESH_OPTIONS, map_rows
from jsecon.programs import stored_jit
from jsecon.splat.capacity import default_capacity, enough_capacity, round_capacity
from jsecon.splat.composite import rasterize
from jsecon.splat.project import Projection, check_gaussians, project
from jsecon.splat.strips import map_strips
from jsecon.splat.tiles import TileLists, tile_lists
from jsecon.types import Array, Camera, Gaussians, Leaf, Rendering, record, static


@record
class ViewPlan:
    """Splats and tile lists of one view: a pytree, so it passes through jit and vmap stacks it."""

    splats: Leaf
    """(N, 6) centre x, y (px), whitening l11, l21, l22 (1/px, times sqrt(1/2)), opacity; zero if invisible."""
    depths: Leaf
    """(N,) z in the camera, world units; zero if invisible."""
    camera_is_finite: Leaf
    """() bool: if false, renderings are NaN."""
    lists: TileLists
    """Gaussians that reach each tile, front to back."""
    width: int = static()
    """px."""
    height: int = static()
    """px."""
    mesh: Mesh | None = static(default=None)
    """Devices that hold its strips, or None."""

    @property
    def overflow(self) -> Array:
        """() int32 pairs beyond the capacity; 0 means that renderings of the plan are exact."""
        return self.lists.overflow.sum(-1)


def _make_plan(
    gaussians: Gaussians, camera: Camera, capacity: int, near: float | Array = NEAR, mesh: Mesh | None = None
) -> ViewPlan:
    """Projects and lists one view with a fixed capacity. Pure; arguments as for `plan_view`."""
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, camera))
    projection = map_rows(lambda rows, view: project(rows, view[0], near=view[1]), gaussians, (camera, near), mesh)
    lists = _view_lists(projection, camera.width, camera.height, capacity, mesh)
    columns = [projection.means_px, projection.whitening * math.sqrt(0.5), projection.opacities[:, None]]
    # An invisible Gaussian is in no list; its row is zeroed so that no non-finite number reaches a gradient.
    splats = jnp.where(projection.visible[:, None], jnp.concatenate(columns, axis=1), 0.0)
    depths = jnp.where(projection.visible, projection.depths, 0.0)
    finite = all_finite(*jax.tree.leaves(camera))
    return ViewPlan(splats, depths, finite, lists, camera.width, camera.height, mesh)


def _view_lists(projection: Projection, width: int, height: int, capacity: int, mesh: Mesh | None) -> TileLists:
    """Makes the tile lists of all strips, which share the capacity. Without gradient; under vmap views run in turn."""
    per_strip = capacity if mesh is None else -(-capacity // mesh.size)

    def local(strip, divided, projection):
        del divided
        return tile_lists(projection, width, height, capacity=per_strip, strip=strip)

    lists = sequential_vmap(lambda p: map_strips(local, (), p, mesh))
    return lists(jax.tree.map(lax.stop_gradient, projection))


# of one device, and over a mesh
_make_plan_compiled: list[Any] = [
    stored_jit(_make_plan, static_argnums=(2, 4), small_kernels=True),
    jax.jit(_make_plan, static_argnums=(2, 4), compiler_options=MESH_OPTIONS),
]


def plan_view(
    gaussians: Gaussians,
    camera: Camera,
    *,
    capacity: int | None = None,
    near: float | Array = NEAR,
    mesh: Mesh | None = None,
) -> ViewPlan:
    """Projects and lists one view once, for any number of `render_plan(plan, features)`.

    Differentiable like `render`. To differentiate only features, make the plan outside of the differentiated function:
    then no gradient of the geometry is computed.

    Args:
      gaussians: Scene of N Gaussians; its `sh` may be None.
      camera: One camera.
      capacity: Number of (block, Gaussian) pairs, see `render`. By default, outside of a trace, the call waits for the
        view's overflow and plans again with enough capacity if there is any.
      near: Near plane, world units.
      mesh: Devices of this process, each of which plans and keeps its strip of the image; None uses one.

    Returns:
      The plan; `overflow` is 0 if its renderings are exact.

    Raises:
      ValueError: Shapes disagree.
    """
    check_gaussians(gaussians, camera, colour=False)
    size = capacity
    if size is None:
        strips = 1 if mesh is None else mesh.size
        size = default_capacity(gaussians.means.shape[0], camera.width, camera.height, strips=strips)
    # Colour has no influence: Gaussians with and without it share one program.
    no_sh = np.zeros((gaussians.means.shape[0], 0, 3), gaussians.means.dtype)
    geometry = dataclasses.replace(gaussians, sh=no_sh)
    if is_traced((geometry, camera, near)):
        return _make_plan(geometry, camera, size, near, mesh)
    compiled = _make_plan_compiled[mesh is not None]
    plan = compiled(geometry, camera, size, near, mesh)
    if capacity is None and (overflow := np.asarray(plan.lists.overflow)).any():
        plan = compiled(geometry, camera, enough_capacity(size, overflow), near, mesh)
    return plan


def prepare_views(
    gaussians: Gaussians, cameras: Camera, *, capacity: int | None = None, max_bytes: int = 1 << 30
) -> ViewPlan | None:
    """Plans all views of a batch.

    Args:
      gaussians: Scene of N Gaussians; its `sh` may be None.
      cameras: Batch of T cameras.
      capacity: Number of (block, Gaussian) pairs of a view, see `plan_view`.
      max_bytes: Memory limit of all plans together; above it they are not kept.

    Returns:
      The plans stacked on a leading axis (`jax.tree.map(lambda a: a[t], plans)` is the plan of view t), outside of a
      trace with lists cut to the longest; or None if they exceed the limit.
    """
    make = functools.partial(plan_view, gaussians, capacity=capacity)
    views, first = cameras.world_to_camera.shape[0], make(cameras[0])
    if is_traced(first):
        return None if views * _bytes(first) > max_bytes else lax.map(make, cameras)
    plans, largest = [], 0
    for t in range(views):
        plans.append(_cut_lists(first if t == 0 else make(cameras[t])))
        largest = max(largest, _bytes(plans[-1]))
        if views * largest > max_bytes:
            return None
    length = round_capacity(max(plan.lists.gaussians.shape[0] for plan in plans))
    return jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *(_cut_lists(plan, length) for plan in plans))


def _bytes(plan: ViewPlan) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(plan))


def _cut_lists(plan: ViewPlan, length: int | None = None) -> ViewPlan:
    """The plan in NumPy, its lists cut behind the last used entry, or padded to `length`."""
    plan = jax.tree.map(np.asarray, plan)
    used = int((plan.lists.starts + plan.lists.lengths).max(initial=0))
    ids = np.zeros(used if length is None else length, np.int32)
    ids[:used] = plan.lists.gaussians[:used]
    return dataclasses.replace(plan, lists=dataclasses.replace(plan.lists, gaussians=ids))


def _composite_plan(plan: ViewPlan, features: Array, background: Array | None, depth: bool, finite: bool) -> Rendering:
    """Renders features through a plan. Pure; arguments as for `render_plan`."""
    features = jnp.asarray(features).astype(plan.splats.dtype)
    columns = jnp.concatenate([features, plan.depths[:, None]], axis=1) if depth else features
    view = plan.splats, columns, plan.lists, plan.width, plan.height, plan.mesh
    image, transmittance = rasterize(*view, finite=finite)
    image, transmittance = (jnp.where(plan.camera_is_finite, a, jnp.nan) for a in (image, transmittance))
    alpha, expected_depth = 1 - transmittance, None
    if depth:
        covered = alpha > 0
        expected_depth = jnp.where(covered, image[..., -1] / jnp.where(covered, alpha, 1.0), 0.0)
        image = image[..., :-1]
    if background is not None:
        image = image + transmittance[..., None] * jnp.reshape(background, (1, 1, -1))
    return Rendering(image, alpha, plan.overflow, expected_depth)


_composite_plan_compiled: list[Any] = [
    stored_jit(_composite_plan, static_argnums=(3, 4)),
    jax.jit(_composite_plan, static_argnums=(3, 4), compiler_options=MESH_OPTIONS),
]


def render_plan(
    plan: ViewPlan,
    features: Float[Array, "n d"],
    *,
    background: Array | None = None,
    depth: bool = False,
    finite: bool = False,
) -> Rendering:
    """Renders per-Gaussian features through a plan: `render` without projection and sorting.

    Args:
      plan: Plan of one view; its devices are used.
      features: (N, D) numbers.
      background: (D,) numbers or one, added with weight 1 - alpha.
      depth: Whether to render the expected z-depth too.
      finite: Whether all features are known to be finite: a program that contains NaN takes twice as long to compile.
        Outside of a trace they are looked at.

    Returns:
      Features (H, W, D), alpha (H, W), overflow, and depth (H, W) in world units or None.

    Raises:
      ValueError: Shapes disagree.
    """
    require_shape("features", features, (plan.splats.shape[0], "D"), "Pass one row of features per Gaussian.")
    if background is not None:
        got, remedy = np.shape(background), "Pass one number per channel of the features, or one for all."
        require(got in ((), features.shape[1:]), "background", got, f"({features.shape[1]},)", remedy)
    traced = is_traced((plan, features, background))
    run = _composite_plan if traced else _composite_plan_compiled[plan.mesh is not None]
    if not traced and not depth and jax.default_backend() == "cpu":
        finite = finite or bool(np.isfinite(np.asarray(features)).all())
    return run(plan, features, background, depth, finite)
