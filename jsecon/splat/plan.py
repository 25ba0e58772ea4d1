"""A view's plan: what repeated renders of frozen geometry share, so that they skip projection and sorting."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.numerics import NEAR, all_finite, is_traced
from jsecon.parallel import MESH_OPTIONS, map_rows
from jsecon.splat.autodiff import rasterize_contained, view_lists
from jsecon.splat.capacity import default_capacity, enough_capacity, round_capacity
from jsecon.splat.project import check_shapes, project
from jsecon.splat.tiles import TileLists
from jsecon.types import Array, Camera, Gaussians, Leaf, Rendering, record, static

PLAN_BYTES = 1 << 30
"""most that the plans of all views may take together to be kept"""


@record
class ViewPlan:
    """The splats and tile lists of one view: a pytree, so it passes through jit and is stacked by vmap."""

    splats: Leaf
    """(N, 6) centre x, y (px), whitening l11, l21, l22 (1/px, times sqrt(1/2)), opacity; zero where invisible."""
    depths: Leaf
    """(N,) z in the camera, world units; zero where invisible."""
    sound: Leaf
    """() bool: the camera is finite; one that is not sees NaN."""
    lists: TileLists
    """which Gaussians reach which tile, front to back."""
    width: int = static()
    """px."""
    height: int = static()
    """px."""
    mesh: Mesh | None = static(default=None)
    """the devices that hold its strips, or None."""

    @property
    def overflow(self) -> Array:
        """() int32 pairs that did not fit the capacity; 0 means that renders of the plan are exact."""
        return self.lists.overflow.sum(-1)


def plan_view(
    gaussians: Gaussians,
    camera: Camera,
    *,
    capacity: int | None = None,
    near: float | Array = NEAR,
    mesh: Mesh | None = None,
) -> ViewPlan:
    """Projects and lists one view once, for any number of `render_plan(plan, features)`.

    Differentiable like `render`; where only features are to be differentiated, make the plan outside of what is, and
    no gradient of the geometry is computed. `capacity` and `mesh` as for `render`: outside a trace and without a
    capacity it waits for the view's overflow, and where there is any, plans again with enough. Over a mesh, each device
    plans its strip of the image (strips.py) and keeps it. Raises ValueError on shapes that disagree.
    """
    check_shapes(gaussians, camera)
    size = capacity
    if size is None:
        strips = 1 if mesh is None else mesh.size
        size = default_capacity(gaussians.means.shape[0], camera.width, camera.height, strips=strips)
    # Colour has no part in it: Gaussians with and without share one program.
    bare = dataclasses.replace(gaussians, sh=np.zeros((gaussians.means.shape[0], 0, 3), gaussians.means.dtype))
    if is_traced((bare, camera, near)):
        return _plan(bare, camera, size, near, mesh)
    plan = _plan_compiled[mesh is not None](bare, camera, size, near, mesh)
    if capacity is None and (overflow := np.asarray(plan.lists.overflow)).any():
        plan = _plan_compiled[mesh is not None](bare, camera, enough_capacity(size, overflow), near, mesh)
    return plan


def _plan(gaussians: Gaussians, camera: Camera, capacity: int, near: float | Array, mesh: Mesh | None) -> ViewPlan:
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, camera))
    projection = map_rows(lambda rows, view: project(rows, view[0], near=view[1]), gaussians, (camera, near), mesh)
    lists = view_lists(projection, camera.width, camera.height, capacity=capacity, mesh=mesh)
    columns = [projection.means_px, projection.whitening * math.sqrt(0.5), projection.opacities[:, None]]
    # An invisible Gaussian is in no list; its row is zeroed so that nothing non-finite reaches a gradient.
    splats = jnp.where(projection.visible[:, None], jnp.concatenate(columns, axis=1), 0.0)
    depths = jnp.where(projection.visible, projection.depths, 0.0)
    sound = all_finite(*jax.tree.leaves(camera))
    return ViewPlan(splats, depths, sound, lists, camera.width, camera.height, mesh)


# of one device, and over a mesh
_plan_compiled = [jax.jit(_plan, static_argnums=(2, 4), compiler_options=options) for options in (None, MESH_OPTIONS)]


def plan_views(
    gaussians: Gaussians, cameras: Camera, *, capacity: int | None = None, most_bytes: int = PLAN_BYTES
) -> ViewPlan | None:
    """The plans of all views of a batch (T), stacked on a leading axis: `jax.tree.map(lambda a: a[t], plans)` is that
    of view t. None where they would take more than `most_bytes` together: then each is to be made when it is wanted.

    Outside a trace the lists are cut to what the views need.
    """
    make = functools.partial(plan_view, gaussians, capacity=capacity)
    views, first = cameras.world_to_camera.shape[0], make(cameras[0])
    if is_traced(first):
        return None if views * _bytes(first) > most_bytes else lax.map(make, cameras)
    plans, largest = [], 0
    for t in range(views):
        plans.append(_cut(first if t == 0 else make(cameras[t])))
        largest = max(largest, _bytes(plans[-1]))
        if views * largest > most_bytes:
            return None
    length = round_capacity(max(plan.lists.gaussians.shape[0] for plan in plans))
    return jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *(_cut(plan, length) for plan in plans))


def _bytes(plan: ViewPlan) -> int:
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(plan))


def _cut(plan: ViewPlan, length: int | None = None) -> ViewPlan:
    """The plan in NumPy, its lists without what lies behind the last, or filled up to `length`."""
    plan = jax.tree.map(np.asarray, plan)
    used = int((plan.lists.starts + plan.lists.lengths).max(initial=0))
    ids = np.zeros(used if length is None else length, np.int32)
    ids[:used] = plan.lists.gaussians[:used]
    return dataclasses.replace(plan, lists=dataclasses.replace(plan.lists, gaussians=ids))


def render_plan(
    plan: ViewPlan, features: Float[Array, "n d"], *, background: Array | None = None, depth: bool = False
) -> Rendering:
    """Renders per-Gaussian `features` (N, D) through a plan: `render` without projection and sorting.

    Differentiable, under jit, grad and vmap, on the devices of the plan; features, `background` and `depth` as for
    `render`. Raises ValueError on shapes that disagree.
    """
    require_shape("features", features, (plan.splats.shape[0], "D"), "Give one row of features per Gaussian.")
    require_background(background, features.shape[1])
    traced = is_traced((plan, features, background))
    run = _render_plan if traced else _render_plan_compiled[plan.mesh is not None]
    return run(plan, features, background, depth)


def require_background(background: Array | None, channels: int) -> None:
    """Raises ValueError unless a background has one number for each channel of the features, or one for all."""
    if background is not None:
        got, remedy = np.shape(background), "Give one number for each channel of the features."
        require(got in ((), (channels,)), "background", got, f"({channels},)", remedy)


def _render_plan(plan: ViewPlan, features: Array, background: Array | None, depth: bool):
    features = jnp.asarray(features)
    if depth or features.dtype != jnp.bfloat16:
        features = features.astype(plan.splats.dtype)
    columns = jnp.concatenate([features, plan.depths[:, None]], axis=1) if depth else features
    image, transmittance = rasterize_contained(plan.splats, columns, plan.lists, plan.width, plan.height, plan.mesh)
    image, transmittance = (jnp.where(plan.sound, a, jnp.nan) for a in (image, transmittance))
    alpha, expected = 1 - transmittance, None
    if depth:
        covered = alpha > 0
        expected = jnp.where(covered, image[..., -1] / jnp.where(covered, alpha, 1.0), 0.0)
        image = image[..., :-1]
    if background is not None:
        image = image + transmittance[..., None] * jnp.reshape(background, (1, 1, -1))
    return Rendering(image, alpha, plan.overflow, expected)


_render_plan_compiled = [jax.jit(_render_plan, static_argnums=3, compiler_options=o) for o in (None, MESH_OPTIONS)]
