"""The codes whose renderings have the least L1 error, held to the votes where the images leave them open.

With frozen geometry a rendering is linear in the codes, so that the rendered L1 is convex over codes of length at most
one. Adam on it (`distill.distill_l1`, the paper's path) steps as far for a Gaussian behind a wall, which the images
hardly determine, as for one in the open. Here

    minimise over |f_i| <= 1:   sum over labelled pixels p of |(W f)_p - G_p|_1  +  loyalty / 2 sum_i t_i |f_i - v_i|^2

with v_i the code that the Gaussian starts from (its votes') and t_i its weight on labelled pixels, so that a Gaussian's
evidence counts for as much whether it is seen by a million pixels or by a millionth of one. The minimum is unique. It
is found by the stochastic primal-dual hybrid gradient (Chambolle, Ehrhardt, Richtarik and Schoenlieb, SIAM J. Optim.
2018) with the diagonal steps of Pock and Chambolle (ICCV 2011): a view per step, each number's own step known from sums
of weights, and the duality gap bounds how far from the minimum it is.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int, PRNGKeyArray, UInt32

from jsecon.errors import require
from jsecon.numerics import is_traced, normalize, safe_norm
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.composite import composite_features_vjp
from jsecon.splat.plan import plan_view, plan_views, render_plan
from jsecon.types import Array, Camera, Gaussians

LOYALTY = 0.1
"""a code moves by |f - v| = net / loyalty, net in [0, 1] the share of its weight by which the images ask for a change
more than against it"""
BALANCE = 5.0
"""dual steps are this many times longer, primal ones shorter: speed only"""
CHECK = 4
"""sweeps between two looks at the duality gap, each of which costs a sweep"""

Key = PRNGKeyArray | UInt32[Array, "2"]


class Solution(NamedTuple):
    """What `solve_l1` found."""

    codes: Float[Array, "n d"]
    """unit codes; zero where the start's is and no labelled pixel sees the Gaussian."""
    loss: Float[Array, ""]
    """the rendered L1 of the codes before they are brought to unit length: mean over all T H W d numbers."""
    gap: Float[Array, ""]
    """duality gap over the objective, 0 at the minimum: the objective is at most this share above it."""
    sweeps: Int[Array, ""]
    """passes over the views that were taken."""
    converged: Bool[Array, ""]
    """the gap came down to the tolerance, and every view fitted the capacity."""


class _State(NamedTuple):
    codes: Array
    """(N, d) in the unit ball."""
    pull: Array
    """(N, d) W^T dual."""
    dual: Array
    """(T, H, W, d) in [-1, 1], 0 on pixels without label."""
    gap: Array
    loss: Array
    sweeps: Array


def solve_l1(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Int[Array, "t h w"],
    region_codes: Float[Array, "r d"],
    start: Float[Array, "n d"],
    *,
    loyalty: float = LOYALTY,
    sweeps: int = 24,
    tolerance: float = 1e-3,
    key: Key | None = None,
    capacity: int | None = None,
) -> Solution:
    """Unit codes (N, d) of least rendered L1, held to those of `start` (N, d), such as `distill_votes` gives.

    labels (T, H, W), -1 = none; region_codes (R, d), a zero row = a region without code, whose pixels count as
    unlabelled. At most `sweeps` passes over the views (rounded up to a multiple of `CHECK`), fewer where the relative
    duality gap falls to `tolerance` before. `key` draws the order of the views. What no labelled pixel sees keeps its
    start. Memory: T H W d numbers of the dual beside the plans (`splat.plan.PLAN_BYTES`).

    Pure; `capacity` as for `render`: a view that does not fit makes gap and loss NaN and `converged` false. Raises
    ValueError on shapes that disagree, a loyalty that is not above zero and, outside jit, a capacity that is too small.
    """
    views, count = labels.shape[0], gaussians.means.shape[0]
    require(
        cameras.world_to_camera.shape[:-2] == (views,) and labels.shape[1:] == (cameras.height, cameras.width),
        "solve_l1",
        f"labels {labels.shape}",
        f"one (H, W) = ({cameras.height}, {cameras.width}) image per camera",
        "Pass the labels and the cameras of the same views at the same size.",
    )
    require(
        start.shape == (count, region_codes.shape[1]) and views > 0 and region_codes.shape[0] > 0,
        "solve_l1",
        f"start {start.shape}, region codes {region_codes.shape}, {views} views",
        f"a start of {count} rows of the regions' code size, a region, a view",
        "Start from distill_votes(votes, region_codes).",
    )
    require(
        loyalty > 0 and sweeps >= 1,
        "solve_l1",
        f"loyalty={loyalty}, sweeps={sweeps}",
        "loyalty > 0 and sweeps >= 1",
        "A small loyalty, such as 0.01, follows the images almost alone.",
    )
    arrays: Any = jax.tree.map(jnp.asarray, (gaussians, cameras, labels, region_codes, start))
    rounds = -(-sweeps // CHECK)
    solve = functools.partial(_solve, *arrays, loyalty, tolerance, jax.random.key(0) if key is None else key, rounds)
    found = solve(capacity)
    if not is_traced(found.gap):
        if capacity is None and bool(jnp.isnan(found.gap)):
            found = solve(plan_capacity(gaussians, cameras, margin=1.0))
        require(
            not bool(jnp.isnan(found.gap)),
            "solve_l1",
            f"capacity={capacity}, too small for a view, or NaN",
            "every view within the capacity, finite Gaussians and codes",
            "Leave capacity out, and check the Gaussians with jsecon.numerics.finite.",
        )
    return found


@functools.partial(jax.jit, static_argnames="capacity")
def _solve(gaussians, cameras, labels, region_codes, start, loyalty, tolerance, key, rounds, capacity) -> Solution:
    views, codes = labels.shape[0], normalize(region_codes)
    known = jnp.any(codes != 0, axis=-1)
    anchor = normalize(start)
    make = lambda camera: plan_view(gaussians, camera, capacity=capacity)
    plans = plan_views(gaussians, cameras, capacity=capacity)

    def view(t):
        """Plan of a view, its targets and where they count."""
        plan = make(cameras[t]) if plans is None else jax.tree.map(lambda a: a[t], plans)
        ids = jnp.clip(labels[t], 0, codes.shape[0] - 1)
        return plan, codes[ids], ((labels[t] >= 0) & known[ids])[..., None]

    def weigh(carry, t):
        plan, _, mask = view(t)
        weight = composite_features_vjp(plan.splats, plan.lists, mask.astype(anchor.dtype))
        total, largest, overflow = carry
        return (total + weight, jnp.maximum(largest, weight), overflow + plan.overflow), None

    nothing = jnp.zeros_like(anchor[:, :1])
    (total, largest, overflow), _ = lax.scan(weigh, (nothing, nothing, jnp.int32(0)), jnp.arange(views))
    seen = total > 0
    # Dimensionless: z / largest is in [-1, 1] for a weight of any size, and so is total / (views largest).
    inverse = jnp.where(seen, 1 / jnp.where(seen, largest, 1.0), 0.0) / (BALANCE * views)
    hold = loyalty * total * inverse

    def step(state: _State, t):
        plan, target, mask = view(t)
        error = render_plan(plan, state.codes).features - target
        dual = jnp.where(mask, jnp.clip(state.dual[t] + BALANCE * error, -1.0, 1.0), 0.0)
        change = composite_features_vjp(plan.splats, plan.lists, dual - state.dual[t])
        pull = state.pull + change
        moved = state.codes - inverse * (pull + views * change)
        moved = _into_ball((moved + hold * anchor) / (1 + hold))
        moved = jnp.where(seen, moved, anchor)
        return state._replace(codes=moved, pull=pull, dual=state.dual.at[t].set(dual)), None

    def look(state: _State) -> _State:
        """The gap, from a pull that is summed anew: the running one gathers rounding."""

        def add(carry, t):
            pull, loss, linear = carry
            plan, target, mask = view(t)
            error = jnp.where(mask, render_plan(plan, state.codes).features - target, 0.0)
            pull = pull + composite_features_vjp(plan.splats, plan.lists, state.dual[t])
            return (pull, loss + jnp.abs(error).sum(), linear + (state.dual[t] * target).sum()), None

        zero = jnp.zeros((), anchor.dtype)
        (pull, loss, linear), _ = lax.scan(add, (jnp.zeros_like(anchor), zero, zero), jnp.arange(views))
        held = loyalty * total
        best = _into_ball(anchor - pull * jnp.where(seen, 1 / jnp.where(seen, held, 1.0), 0.0))
        value = lambda f: (0.5 * held * (f - anchor) ** 2).sum()
        primal = loss + value(state.codes)
        gap = primal - ((pull * best).sum() + value(best) - linear)
        return state._replace(pull=pull, gap=gap / jnp.maximum(primal, jnp.finfo(primal.dtype).tiny), loss=loss)

    def sweep(_, state: _State) -> _State:
        order = jax.random.permutation(jax.random.fold_in(key, state.sweeps), views)
        state = lax.scan(step, state, order)[0]
        return state._replace(sweeps=state.sweeps + 1)

    def round_(state: _State) -> _State:
        return look(lax.fori_loop(0, CHECK, sweep, state))

    infinite = jnp.asarray(jnp.inf, anchor.dtype)
    dual = jnp.zeros((*labels.shape, anchor.shape[1]), anchor.dtype)
    state = _State(anchor, jnp.zeros_like(anchor), dual, infinite, infinite, jnp.int32(0))
    unfinished = lambda s: (s.sweeps < rounds * CHECK) & ~(s.gap <= tolerance) & (overflow == 0)
    state = lax.while_loop(unfinished, round_, state)
    whole = overflow == 0
    loss = jnp.where(whole, state.loss / dual.size, jnp.nan)
    gap = jnp.where(whole, state.gap, jnp.nan)
    return Solution(normalize(state.codes), loss, gap, state.sweeps, gap <= tolerance)


def _into_ball(rows: Array) -> Array:
    """Rows of length above one brought back to it."""
    return rows / jnp.maximum(safe_norm(rows, keepdims=True), 1.0)
