"""Fits Gaussians to a capture's frames: Adam on the photometric loss (Kerbl et al. 2023), as its schedule says.

The state between chunks of steps is a record of arrays, so a fit can be stopped after any chunk and gone on with, to
the same result.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any, Literal, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, Int, PRNGKeyArray, UInt8

from jsecon.errors import InputError, require
from jsecon.fit.growth import compact, copies, grown, halves, noise, opacities, pressure, rows_for, with_free_rows
from jsecon.fit.photometric import photometric_loss
from jsecon.fit.schedule import LearningRates, Schedule, rates_at, resized, resized_frame
from jsecon.numerics import finite
from jsecon.parallel import AXIS, MESH_OPTIONS, host_mesh, over_rows
from jsecon.splat.capacity import default_capacity, enough_capacity
from jsecon.splat.render import render
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Array, Camera, Capture, Gaussians, record


@record
class FitState:
    """All that a fit needs to go on."""

    gaussians: Gaussians
    """as fitted so far; rows may be free (growth.py)"""
    first_moment: Gaussians
    """Adam's running mean of the gradient"""
    second_moment: Gaussians
    """Adam's running mean of its square"""
    votes: Array
    """(N,) alpha T times the pixel's mean absolute error, over the pixels of the last views"""
    done: Array
    """() share of the fit that is done"""
    pace: Array
    """() share of the fit that a step is"""
    seconds: Array
    """() spent so far"""
    started: Array
    """() Gaussians at the start"""
    losses: Array
    """(steps,) loss of each step's view before the step"""


def cameras_extent(cameras: Camera) -> float:
    """1.1 times the largest distance of a camera's centre from their mean, world units (INRIA's `spatial_lr_scale`)."""
    centres = jax.tree.map(lambda a: np.asarray(a, np.float64), cameras).centres
    return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def view_order(key: PRNGKeyArray, views: int, first: int, last: int) -> Int[np.ndarray, " s"]:
    """The views of steps first..last-1: each round of `views` steps takes all of them once, in an order of `key`'s."""
    rounds = [np.asarray(_round(key, r, views)) for r in range(first // views, -(-last // views))]
    start = first % views
    return np.concatenate([np.zeros(0, np.int64), *rounds])[start : start + last - first]


@functools.partial(jax.jit, static_argnums=2)
def _round(key: PRNGKeyArray, index: Array | int, views: int) -> Array:
    return jax.random.permutation(jax.random.fold_in(key, index), views)


def start_state(gaussians: Gaussians) -> FitState:
    """The state before the first step."""
    count = np.asarray(gaussians.count)
    gaussians = with_free_rows(jax.tree.map(lambda a: np.asarray(a, np.float32), gaussians), rows_for(int(count)))
    zeros, zero = jax.tree.map(np.zeros_like, gaussians), np.zeros((), np.float64)
    return FitState(gaussians, zeros, zeros, zeros.opacity_logits, zero, zero, zero, count, np.zeros(0, np.float32))


_ADAM, _RATES, _SCHEDULE = optax.scale_by_adam(eps=1e-15), LearningRates(), Schedule()
AHEAD = 2
"""steps that are dispatched before one is done; each holds a scene and its moments"""
Current: TypeAlias = tuple[Gaussians, Gaussians, Gaussians, Array]
"""the Gaussians, Adam's moments, the votes"""
Growth: TypeAlias = Literal["votes", "mcmc", "none"]
How: TypeAlias = tuple[int, Growth, LearningRates]
"""the highest degree that learns, what the step does for growth, the learning rates"""


def _step(
    current: Current,
    camera: Camera,
    frame: UInt8[Array, "h w 3"],
    step: Array,
    done: Array,
    degree: Array,
    extent: Array,
    rates: LearningRates,
    capacity: int,
    mesh: Mesh | None,
    growth: Growth,
) -> tuple[Current, Array, Array]:
    """One Adam step on one view, the `step`-th. Returns what is current after it, the loss before it, the pairs that
    overflowed. Over a mesh, projection, compositing, loss and update are each shared out among its devices."""
    gaussians, *moments, votes = current
    target = frame.astype(jnp.float32) / 255.0

    def loss(gaussians: Gaussians, nothing: Array):
        colours = over_rows(colours_from_sh, gaussians, camera, mesh)
        rendering = render(gaussians, camera, jnp.concatenate([colours, nothing], 1), capacity=capacity, mesh=mesh)
        image, fourth = rendering.features[..., :3], rendering.features[..., 3:].sum(-1)
        value = photometric_loss(image, target, mesh)
        error = jax.lax.stop_gradient(jnp.abs(image - target).mean(-1))
        total = value + jnp.sum(error * fourth)
        return total + pressure(gaussians) if growth == "mcmc" else total, (value, rendering.overflow)

    # The votes are the gradient of a fourth channel that shows nothing: they cost no pass of their own.
    nothing = jnp.zeros((gaussians.count, 1 if growth == "votes" else 0))
    (_, (value, overflow)), (gradient, by_error) = jax.value_and_grad(loss, (0, 1), has_aux=True)(gaussians, nothing)

    def update(rows, common):
        (gaussians, gradient, first, second), (step, rate) = rows, common
        moments: Any = optax.ScaleByAdamState(*cast(Any, (step, first, second)))
        change, moments = _ADAM.update(gradient, moments)
        return jax.tree.map(lambda p, u, r: p - r * u, gaussians, change, rate), moments.mu, moments.nu

    rate = rates_at(done, rates, gaussians, extent, degree)
    moved, *moments = over_rows(update, (gaussians, gradient, *moments), (step, rate), mesh)
    if growth == "mcmc":
        moved = dataclasses.replace(moved, means=moved.means + noise(moved, rate.means, step))
    after = moved, *moments, votes + by_error.sum(1)
    if mesh is not None:  # as it came: one program serves every step
        after = jax.lax.with_sharding_constraint(after, _places(mesh))
    return after, value, overflow


def _places(mesh: Mesh) -> tuple:
    """Where a device finds what is current: the Gaussians and votes whole, of the moments its own rows."""
    whole, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    return whole, rows, rows, whole


def on_devices(current: Current, mesh: Mesh | None) -> Current:
    """What is current, where the devices of a step want it."""
    if mesh is None:
        return jax.device_put(current)
    return cast(Current, tuple(jax.device_put(part, place) for part, place in zip(current, _places(mesh), strict=True)))


# of one device, and over a mesh
_step_compiled = [
    jax.jit(_step, static_argnames=("capacity", "mesh", "growth"), compiler_options=options)
    for options in (None, MESH_OPTIONS)
]


class _Views:
    """The frames to fit to, read one at a time, at the size that is wanted now; and the room that a view needs."""

    def __init__(self, capture: Capture, mesh: Mesh | None):
        self.used, self.mesh, self.frames, self.capacity = np.flatnonzero(~capture.held_out), mesh, capture.frames, {}
        if not len(self.used):
            raise InputError("capture", "every frame held out", "frames to fit to", "Hold out fewer frames.")
        self.whole = jax.tree.map(lambda a: np.asarray(a, np.float32), capture.cameras[self.used])
        self.size, self.cameras = 1.0, self.whole  # in NumPy, to index them compiles nothing
        self.extent = np.asarray(cameras_extent(self.whole), np.float32)

    def put(self, tree: Any) -> Any:
        """On every device."""
        return jax.device_put(tree, None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec()))

    def at(self, size: float) -> None:
        """Takes the frames at that size."""
        if size != self.size:
            self.size, self.cameras = size, resized(self.whole, size)

    def step(self, current: Current, view: int, step: int, done: float, how: How) -> tuple:
        """`_step` on that view."""
        cameras, shape = self.cameras, (current[0].count, self.size)
        strips = 1 if self.mesh is None else self.mesh.size
        fresh = default_capacity(current[0].count, cameras.width, cameras.height, strips=strips)
        capacity = self.capacity.setdefault(shape, fresh)
        degree, growth, rates = how
        numbers = np.int32(step), np.float32(done), np.int32(degree), self.extent, rates
        frame = resized_frame(np.asarray(self.frames[self.used[view]]), cameras)
        given = self.put((cameras[view], frame, *numbers))
        return _step_compiled[self.mesh is not None](current, *given, capacity=capacity, mesh=self.mesh, growth=growth)

    def widen(self, current: Current, overflow: int) -> None:
        """Gives room for `overflow` pairs more in views of this size."""
        shape = current[0].count, self.size
        self.capacity[shape] = enough_capacity(self.capacity[shape], np.array([overflow]))


def _chunk(
    current: Current, views: _Views, order: np.ndarray, first: int, done: np.ndarray, how: How
) -> tuple[Current, list]:
    """A step on each view of `order`, taken again with more room where one overflowed; and their losses."""
    while True:
        after, losses, overflow = current, [], []
        for n, view in enumerate(order):
            after, loss, missing = views.step(after, int(view), first + n, float(done[n]), how)
            losses.append(loss)
            overflow.append(missing)
            if n >= AHEAD:
                jax.block_until_ready(losses[n - AHEAD])
        most = int(max(jax.device_get(overflow)))
        if not most:
            return after, jax.device_get(losses)
        views.widen(current, most)


def fit_gaussians(
    capture: Capture,
    *,
    key: PRNGKeyArray,
    steps: int | None = None,
    seconds: float | None = None,
    start: Gaussians | None = None,
    state: FitState | None = None,
    schedule: Schedule = _SCHEDULE,
    rates: LearningRates = _RATES,
    chunk: int = 50,
    on_checkpoint: Callable[[FitState], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Gaussians, Float[np.ndarray, " steps"]]:
    """Fits `start` (or goes on from `state`) to the frames that are not held out; returns the Gaussians and the losses.

    Either `steps` of one view each, to the same result on the same devices, or as many as `seconds` allow, without the
    time that jax takes to compile them the first time on a machine. All views are taken once before any comes again, in
    an order drawn by `key`; the background is black. After every `chunk` steps Gaussians are added as `schedule` says,
    and `on_checkpoint` is given the state. A chunk in which a view overflowed its tile lists is taken again with more
    room, so the result does not depend on the capacity. All devices of this process take part in every step.
    Raises ValueError where not exactly one of `steps` and `seconds`, or of `start` and `state`, is given, or the state
    is of another fit; InputError where every frame is held out or the numbers stop being finite.
    """
    given, exclusive = (steps, seconds), (steps is None) != (seconds is None)
    require(exclusive, "steps, seconds", given, "exactly one of the two", "A fit ends after so many of either.")
    given, exclusive = (start is not None, state is not None), (start is None) != (state is None)
    require(exclusive, "start, state", given, "exactly one of the two", "Give state to go on with a fit.")
    views = _Views(capture, host_mesh())
    state = start_state(start) if start is not None else state
    assert state is not None
    if steps is not None:
        own = abs(float(state.done) * steps - len(state.losses)) < 1e-6
        found = f"{len(state.losses)} steps, {float(state.done):.1%} of its fit"
        require(own, "state", found, f"a fit of {steps} steps", "Go on with the options of its start.")
    seed, compiled = int(jax.random.bits(key)), set()
    current = on_devices((state.gaussians, state.first_moment, state.second_moment, state.votes), views.mesh)
    while float(state.done) < 1:
        first, done = len(state.losses), float(state.done)
        pace = 1 / steps if steps is not None else float(state.pace) or 1e-4
        # A fit that is gone on with takes the same chunks.
        count = max(1, min(chunk - first % chunk, math.ceil((1 - done) / pace - 1e-6)))
        views.at(schedule.size(done))
        order, dones = view_order(key, len(views.used), first, first + count), done + pace * np.arange(count)
        how = schedule.degree(done), schedule.growth_at(done), rates
        if (program := (current[0].count, views.size, how[1])) not in compiled:  # here, which is not the fit's time
            jax.block_until_ready(views.step(current, int(order[0]), first, done, how))
            compiled.add(program)
        began = time.monotonic()
        current, taken = _chunk(current, views, order, first, dones, how)
        losses = np.concatenate([state.losses, np.asarray(taken, np.float32)])
        # A Gaussian that is not finite is invisible, so the loss alone would not tell.
        if not (np.isfinite(losses[-1]) and bool(_all_finite(current[0]))):
            found = f"numbers that are not finite after step {len(losses)}"
            remedy = "Check the start, the poses and the intrinsics, or lower the learning rates."
            raise InputError("fit", found, "a fit that converges", remedy)
        target = schedule.count(done, int(state.started))
        if target is not None and len(losses) % chunk == 0:
            gaussians, first_moment, second_moment, votes = jax.tree.map(np.asarray, current)
            moments, how = (first_moment, second_moment), (target, schedule.at_most, [seed, len(losses)])
            by, divide = (opacities(gaussians), copies) if schedule.growth == "mcmc" else (votes, halves)
            gaussians, moments = grown(gaussians, moments, by, *how, divide)
            current = on_devices((gaussians, *moments, np.zeros_like(votes, shape=gaussians.count)), views.mesh)
        spent = float(state.seconds) + time.monotonic() - began
        now = len(losses) / steps if steps is not None else min(spent / cast(float, seconds), 1.0)
        gaussians, first_moment, second_moment, votes = current
        state = FitState(
            gaussians=gaussians,
            first_moment=first_moment,
            second_moment=second_moment,
            votes=votes,
            done=np.asarray(now),
            pace=np.asarray((now - done) / count),
            seconds=np.asarray(spent),
            started=state.started,
            losses=losses,
        )
        if on_checkpoint:
            on_checkpoint(state)
        if progress:
            progress(*((len(losses), steps) if steps is not None else (round(spent), round(cast(float, seconds)))))
    return compact(state.gaussians), np.asarray(state.losses)


_all_finite = jax.jit(lambda gaussians: finite(*jax.tree.leaves(gaussians)))
