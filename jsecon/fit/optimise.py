"""Fits Gaussians to a capture's frames: Adam on the photometric loss (Kerbl et al. 2023), as its schedule says.

The state between chunks of steps is a record of arrays, so a fit can be stopped after any chunk and gone on with, to
the same result.
"""

import functools
import math
import time
from collections.abc import Callable
from typing import cast

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jsecon.errors import InputError, require
from jsecon.fit.corrections import CorrectionState, RefineOptions, init_corrections
from jsecon.fit.growth import drop_free_rows, grow, pad_with_free_rows, padded_row_count
from jsecon.fit.schedule import LearningRates, Schedule
from jsecon.fit.step import StepConfig, StepRunner, TrainState, put_on_devices, to_host
from jsecon.fit.view import TrainingViews
from jsecon.parallel import host_mesh
from jsecon.types import Array, Capture, Gaussians, record


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
    refined: CorrectionState | None = None
    """corrections of the capture's T frames, or None where nothing is refined"""


def view_order(key: PRNGKeyArray, views: int, first: int, last: int) -> Int[np.ndarray, " s"]:
    """The views of steps first..last-1: each round of `views` steps takes all of them once, in an order of `key`'s."""
    rounds = [np.asarray(_round(key, r, views)) for r in range(first // views, -(-last // views))]
    start = first % views
    return np.concatenate([np.zeros(0, np.int64), *rounds])[start : start + last - first]


@functools.partial(jax.jit, static_argnums=2)
def _round(key: PRNGKeyArray, index: Array | int, views: int) -> Array:
    return jax.random.permutation(jax.random.fold_in(key, index), views)


def init_fit_state(gaussians: Gaussians, refined: int | None = None, *, at_least: int = 0) -> FitState:
    """The state before the first step, with rows for `at_least` Gaussians; `refined` is the number of frames that
    corrections are kept of."""
    count = np.asarray(gaussians.count)
    rows = padded_row_count(max(int(count), at_least))
    gaussians = pad_with_free_rows(jax.tree.map(lambda a: np.asarray(a, np.float32), gaussians), rows)
    zeros, zero = jax.tree.map(np.zeros_like, gaussians), np.zeros((), np.float64)
    corrections = None if refined is None else init_corrections(refined)
    numbers = zero, zero, zero, count, np.zeros(0, np.float32)
    return FitState(gaussians, zeros, zeros, zeros.opacity_logits, *numbers, corrections)


_RATES, _SCHEDULE = LearningRates(), Schedule()
AT_ONCE = 1 << 16
"""Gaussians that a fit has rows for from its start; where more are allowed, for half of them"""
AHEAD = 2
"""steps that are dispatched before one is done; each holds a scene and its moments"""


def _chunk(
    current: TrainState, steps: StepRunner, order: np.ndarray, first: int, done: np.ndarray, way: StepConfig
) -> tuple[TrainState, list]:
    """A step on each view of `order`, taken again with more room where one overflowed; and their losses."""
    while True:
        after, losses, overflow = current, [], []
        for n, view in enumerate(order):
            after, loss, missing = steps.take(after, int(view), first + n, float(done[n]), way)
            losses.append(loss)
            overflow.append(missing)
            if n >= AHEAD:
                jax.block_until_ready(losses[n - AHEAD])
        most = int(max(jax.device_get(overflow)))
        if not most:
            return after, jax.device_get(losses)
        steps.widen(current, most)


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
    refine: RefineOptions | None = None,
    chunk: int = 50,
    on_checkpoint: Callable[[FitState], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Gaussians, Float[np.ndarray, " steps"]]:
    """Fits `start` (or goes on from `state`) to the frames that are not held out; returns the Gaussians and the losses.

    Either `steps` of one view each, to the same result on the same devices, or as many as `seconds` allow, without the
    time that jax takes to compile them the first time on a machine. With `refine` each view's pose or exposure is
    corrected on the way (corrections.py; FitState.refined). All views are taken once before any comes again, in
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
    views, mesh = TrainingViews(capture), host_mesh()
    taking = StepRunner(views, mesh)
    if start is not None:
        # A doubling is one more program to compile, which takes as long as hundreds of steps over free rows.
        divisor = 1 if schedule.max_gaussians <= AT_ONCE else 2
        room = schedule.max_gaussians // divisor if schedule.grows(start.count) else 0
        state = init_fit_state(start, None if refine is None else len(capture.names), at_least=room)
    assert state is not None
    given, alike = state.refined is not None, (state.refined is None) == (refine is None)
    require(alike, "state with corrections", given, f"{refine is not None}", "Go on with the options of its start.")
    if steps is not None:
        own = abs(float(state.done) * steps - len(state.losses)) < 1e-6
        found = f"{len(state.losses)} steps, {float(state.done):.1%} of its fit"
        require(own, "state", found, f"a fit of {steps} steps", "Go on with the options of its start.")
    seed = int(jax.random.bits(key))
    fitted = TrainState(state.gaussians, state.first_moment, state.second_moment, state.votes, state.refined)
    current = put_on_devices(fitted, mesh)
    while float(state.done) < 1:
        first, done = len(state.losses), float(state.done)
        pace = 1 / steps if steps is not None else float(state.pace) or 1e-4
        # A fit that is gone on with takes the same chunks.
        count = max(1, min(chunk - first % chunk, math.ceil((1 - done) / pace - 1e-6)))
        views.at(schedule.size(done))
        order, dones = view_order(key, len(views.used), first, first + count), done + pace * np.arange(count)
        count_votes = schedule.grows(int(state.started)) and done <= schedule.growth_end
        way = StepConfig(schedule.degree(done), count_votes, rates, refine)
        taking.compile(current, int(order[0]), first, done, way)  # which is not the fit's time
        began = time.monotonic()
        current, taken = _chunk(current, taking, order, first, dones, way)
        losses = np.concatenate([state.losses, np.asarray(taken, np.float32)])
        host = to_host(current, state.gaussians.count)
        # A Gaussian that is not finite is invisible, so the loss alone would not tell.
        moved = jax.tree.leaves((losses[-1], host.gaussians, host.refined))
        if not all(np.isfinite(array).all() for array in moved):
            found = f"numbers that are not finite after step {len(losses)}"
            remedy = "Check the start, the poses and the intrinsics, or lower the learning rates."
            raise InputError("fit", found, "a fit that converges", remedy)
        target = schedule.count(done, int(state.started))
        if target is not None and len(losses) % chunk == 0:
            host = _grown(host, schedule, target, [seed, len(losses)])
            current = put_on_devices(host, mesh)
        spent = float(state.seconds) + time.monotonic() - began
        now = len(losses) / steps if steps is not None else min(spent / cast(float, seconds), 1.0)
        state = FitState(
            gaussians=host.gaussians,
            first_moment=host.first_moment,
            second_moment=host.second_moment,
            votes=host.votes,
            done=np.asarray(now),
            pace=np.asarray((now - done) / count),
            seconds=np.asarray(spent),
            started=state.started,
            losses=losses,
            refined=host.refined,
        )
        if on_checkpoint:
            on_checkpoint(state)
        if progress:
            progress(*((len(losses), steps) if steps is not None else (round(spent), round(cast(float, seconds)))))
    return drop_free_rows(state.gaussians), np.asarray(state.losses)


def _grown(current: TrainState, schedule: Schedule, target: int, seed: list[int]) -> TrainState:
    """With up to `target` Gaussians, on the host; the votes are counted anew."""
    moments = current.first_moment, current.second_moment
    gaussians, moments = grow(current.gaussians, moments, current.votes, target, schedule.max_gaussians, seed)
    return TrainState(gaussians, *moments, np.zeros_like(current.votes, shape=gaussians.count), current.refined)
