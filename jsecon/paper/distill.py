"""Distillation: the codes of the regions become codes of the Gaussians.

With the geometry fixed the rendered map is linear in the features, F_p = sum_i w_ip f_i, and the target of a pixel is
the code l_r(p) of its region. The paper minimises L = sum_p |F_p - l_r(p)| by Adam (`distill_l1`). The
votes W_ir = sum of w_ip over the pixels of r hold all that a closed form needs (`distill_votes`):

    mode      l_r of the largest W_ir
    mean      sum_r W_ir l_r, the minimum of the weighted squared error
    median    the weighted median of each number, the minimum of L for a Gaussian taken alone
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, Integer, Shaped

from jsecon.errors import require, require_one_of, require_shape
from jsecon.numerics import is_traced, normalize, require_labels, safe_norm
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.plan import ViewPlan, plan_view, prepare_views, render_plan
from jsecon.types import Array, Camera, Gaussians, Key, Votes

_ROWS = 8192
"""Gaussians reduced at a time: (rows, K, d) is the largest array of a reduction, 134 MB at K = 8, d = 512"""
MIN_LABELLED = 0.5
"""Smallest labelled share of a Gaussian's weight. With masks of a few objects alone, the walls around them would
otherwise carry the objects' codes (demo, one-step mIoU 0.24)."""


def distill_votes(votes: Votes, region_codes: Float[Array, "r d"], reduce: str = "mode") -> Float[Array, "n d"]:
    """Computes the codes of Gaussians from their strongest votes and the codes of the regions. Pure.

    Args:
      votes: Votes of N Gaussians.
      region_codes: (R, d) codes of the regions.
      reduce: "mode", "mean" or "median". Of a whole interval of medians it is the value closest to the mode.

    Returns:
      (N, d) unit codes. A zero code (unknown) has a Gaussian without votes, with votes that are not finite, with at
      least half of its weight on regions without a code, or with less than MIN_LABELLED of it on labelled pixels.

    Raises:
      ValueError: Shapes disagree, or the reduction is unknown.
    """
    require_one_of("reduce", reduce, _REDUCTIONS, "'mode' is the default.")
    expected = votes.num_regions, "d"
    require_shape("region_codes", region_codes, expected, "Pass one code per region, in the regions' order.")
    if votes.num_regions == 0 or votes.regions.shape[1] == 0:
        return jnp.zeros((votes.regions.shape[0], region_codes.shape[1]), region_codes.dtype)
    codes = _distill_votes(votes.regions, votes.weights, jnp.asarray(region_codes), reduce)
    return jnp.where((votes.labelled >= MIN_LABELLED * votes.total)[:, None], codes, 0.0)


@functools.partial(jax.jit, static_argnames="reduce")
def _distill_votes(regions: Array, weights: Array, codes: Array, reduce: str) -> Array:
    units = normalize(codes)
    known = jnp.any(units != 0, axis=-1)

    def one(row):
        ids, weight = row
        is_finite = jnp.all(jnp.isfinite(weight))
        largest = jnp.max(weight)
        weight = jnp.where((ids >= 0) & (weight > 0), weight / jnp.where(largest > 0, largest, 1.0), 0.0)
        ids = jnp.clip(ids, 0, codes.shape[0] - 1)
        code = _REDUCTIONS[reduce](units[ids], weight)
        with_code = 2 * jnp.sum(jnp.where(known[ids], weight, 0.0)) > jnp.sum(weight)
        return jnp.where(is_finite & with_code, normalize(code), 0.0)

    return jax.lax.map(one, (regions, weights), batch_size=_ROWS)


def _mean(values: Array, weight: Array) -> Array:
    return jnp.sum(jnp.where(weight[:, None] > 0, weight[:, None] * values, 0.0), axis=0)


def _mode(values: Array, weight: Array) -> Array:
    return values[jnp.argmax(weight)]


def _median(values: Array, weight: Array) -> Array:
    # A value is a median if at most half of the weight lies below it and at most half above. K is small: comparing all
    # pairs vectorises, where a sort along an axis of 8 does not.
    half = 0.5 * jnp.sum(weight) * (1 + 1e-5)  # sums of K weights in float32 are no surer: so near, both halves tie
    low, high = jnp.full(values.shape[1:], jnp.inf, values.dtype), jnp.full(values.shape[1:], -jnp.inf, values.dtype)
    for value, value_weight in zip(values, weight, strict=True):
        below = jnp.sum(jnp.where(values < value, weight[:, None], 0.0), axis=0)
        above = jnp.sum(jnp.where(values > value, weight[:, None], 0.0), axis=0)
        optimal = (below <= half) & (above <= half) & (value_weight > 0)
        low, high = jnp.where(optimal, jnp.minimum(low, value), low), jnp.where(optimal, jnp.maximum(high, value), high)
    return jnp.clip(_mode(values, weight), low, high)


_REDUCTIONS = {"mean": _mean, "median": _median, "mode": _mode}


class _Distillation(NamedTuple):
    """What `distill_l1` trains. A loss is NaN for a view that overflowed the capacity."""

    codes: Float[Array, "n d"]
    """Unit; zero for Gaussians that no labelled pixel sees, unless `init` gives them a code."""
    losses: Float[Array, " steps"]
    """Before each step."""


def distill_l1(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Shaped[Array, "t h w"],
    region_codes: Float[Array, "r d"],
    *,
    steps: int,
    key: Key,
    init: Float[Array, "n d"] | None = None,
) -> _Distillation:
    """Distills as the paper does (LangSplat, train.py): Adam on the rendered L1, with rate 0.0025.

    One view a step, all views before any repeats, in an order drawn from `key`. The geometry is fixed.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T cameras.
      labels: (T, H, W) integer region ids, -1 for none. Inside a trace ids of R and more count as -1.
      region_codes: (R, d) codes of the regions.
      steps: Number of steps.
      key: Random key of the order of views and of random codes.
      init: (N, d) codes to start from, such as those of `distill_votes`; None takes random ones of length 0.01, which
        turn within tens of steps. LangSplat's zeros are a trap: the gradient through `f / (|f| + 1e-9)` at zero is 1e9
        times too large, Adam's second moment remembers it for about 15,000 steps, and until then a code hardly moves
        from the corner of the cube that its first step took it to.

    Returns:
      The codes and the losses.

    Raises:
      ValueError: Shapes disagree, or labels are no integers; outside a trace also for a NaN and labels of R and more.
    """
    require_labels(labels, len(region_codes))
    views, shape, dtype = labels.shape[0], (gaussians.count, region_codes.shape[1]), region_codes.dtype
    expected = (*cameras.world_to_camera.shape[:-2], cameras.height, cameras.width)
    require_shape("labels", labels, expected, "Pass the labels and the cameras of the same views at the same size.")
    sizes = f"{views} views, {steps} steps, {len(region_codes)} regions"
    some = min(views, steps, len(region_codes)) > 0
    require(some, "distill_l1", sizes, "at least one of each", "Give what is to be distilled.")
    order_key, init_key = jax.random.split(key)
    if init is None:
        features = 0.01 * normalize(jax.random.normal(init_key, shape, dtype))
    else:
        require_shape("init", init, shape, "Give one row per Gaussian, of the regions' code size.")
        features = jnp.asarray(init, dtype)
    rounds = jax.random.split(order_key, -(-steps // views))
    order = jax.vmap(lambda k: jax.random.permutation(k, views))(rounds).reshape(-1)[:steps].astype(jnp.int32)
    # Regions in multiples of 256, the last without a code: scenes share their compiled programs.
    table = jnp.pad(jnp.asarray(region_codes), ((0, -len(region_codes) % 256), (0, 0)))
    plans, capacity = prepare_views(gaussians, cameras), None
    if plans is None and not is_traced((gaussians, cameras)):
        capacity = plan_capacity(gaussians, cameras, margin=1.0)
    trained, losses = _descend(features, gaussians, cameras, labels, table, plans, order, capacity)
    if not is_traced(losses):
        remedy = "Remove the Gaussians and region codes that are not finite."
        finite = not bool(jnp.isnan(losses).any())
        require(finite, "distill_l1", "a loss that is NaN", "finite Gaussians and codes", remedy)
    codes = normalize(trained)
    if init is None:
        # What never moved was never seen: a random code would be a wrong answer, a zero code is "unknown".
        codes = jnp.where(jnp.any(trained != features, axis=1, keepdims=True), codes, 0.0)
    return _Distillation(codes, losses)


def rendered_l1(
    features: Float[Array, "n d"], plan: ViewPlan, labels: Integer[Array, "h w"], region_codes: Float[Array, "r d"]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Computes the paper's loss of one view, the mean over all H W d numbers of |F m - G m|, and the overflow.

    F renders f / (|f| + 1e-9), as LangSplat does, without background or renormalisation, G has the unit code of each
    pixel's region, and m is 1 on labelled pixels, so unlabelled ones (no region from 0 to R - 1, or a zero code) count
    in the denominator alone.
    """
    ids = jnp.clip(labels, 0, len(region_codes) - 1)
    known = jnp.any(region_codes != 0, axis=-1)
    mask = ((labels >= 0) & (labels < len(region_codes)) & known[ids])[..., None]
    # safe_norm has a zero gradient at zero, which leaves 1e9 times the rendering's there, as in LangSplat.
    units = features / (safe_norm(features)[:, None] + 1e-9)
    rendering = render_plan(plan, units)
    return jnp.mean(jnp.where(mask, jnp.abs(rendering.features - region_codes[ids]), 0.0)), rendering.overflow


def _optimizer() -> Any:
    import optax  # late: a field is read without it

    # 3DGS's and LangSplat's eps: gradients per Gaussian are means over all pixels, far below the usual 1e-8.
    return optax.adam(0.0025, eps=1e-15)


@functools.partial(jax.jit, static_argnames="capacity")
def _descend(features, gaussians, cameras, labels, region_codes, plans, order, capacity) -> tuple[Array, Array]:
    """Takes a step for each view of an order (steps,); returns the features and the loss before each step."""
    optimizer, codes = _optimizer(), normalize(region_codes)

    def loss(features, view):
        if plans is None:
            plan = plan_view(gaussians, cameras[view], capacity=capacity)
        else:
            plan = jax.tree.map(lambda a: a[view], plans)
        return rendered_l1(features, plan, labels[view], codes)

    def step(state, view):
        features, moments = state
        (value, overflow), gradient = jax.value_and_grad(loss, has_aux=True)(features, view)
        updates, moments = optimizer.update(gradient, moments)
        return (features + updates, moments), jnp.where(overflow > 0, jnp.nan, value)

    (features, _), losses = jax.lax.scan(step, (features, optimizer.init(features)), order)
    return features, losses
