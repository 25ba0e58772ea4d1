"""Photometric fit of Gaussians to the frames of a capture, by Adam and a schedule (Kerbl et al. 2023). Host code.

Time is the share of the fit that is done, in [0, 1], so that fits limited by steps and by minutes behave alike.

The state between chunks of steps is a record of arrays: a fit can stop after any chunk and resume to the same result.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import cast

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jsecon.errors import InputError, require
from jsecon.fit.corrections import CorrectionRates, Corrections, CorrectionState
from jsecon.fit.growth import drop_free_rows, grow, pad_with_free_rows
from jsecon.fit.step import LearningRates, StepRunner, TrainState, put_on_devices
from jsecon.parallel import host_mesh
from jsecon.splat.capacity import round_capacity
from jsecon.splat.strips import BLOCK
from jsecon.splat.tiles import TILE
from jsecon.types import Array, Capture, Gaussians, Leaf, Progress, record

GROWTH_START, GROWTH_END = 0.05, 0.5
"""Shares of the fit between which the number of Gaussians rises linearly."""


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Schedule of a fit. Raises ValueError if the ends of its frame sizes are out of order."""

    sizes: tuple[tuple[float, float], ...] = ((0.5, 0.5), (1.0, 1.0))
    """Pairs of a frame size and the share of the fit at which it ends. Smaller frames cost less and move large things
    first (arXiv 2503.18402)."""
    max_gaussians: int = 100_000
    """Number of Gaussians after growth. A start with as many or more keeps its number: 0 means no growth.
    More make each step slower: bonsai at 400x266 after two minutes has 28.6 dB with 50,000, 28.8 with 100,000 and 28.2
    with 200,000 (experiments/retired.md)."""

    def __post_init__(self) -> None:
        """Checks the sizes."""
        ends = [end for _, end in self.sizes]
        ordered = ends == sorted(ends) and ends[-1:] == [1.0] and all(0 < size <= 1 for size, _ in self.sizes)
        require(ordered, "sizes", self.sizes, "sizes in (0, 1] with rising ends, the last 1", "((1, 1),) is one size.")

    def _size(self, done: float) -> float:
        """Returns the size of the frames, as a share of their full size."""
        return next(size for size, end in self.sizes if done < end or end == 1.0)

    def _next_size(self, done: float) -> float | None:
        """Returns the size of the frames that follows, or None if the present size is the last."""
        return next((later for (_, end), (later, _) in pairwise(self.sizes) if done < end), None)

    def _count(self, done: float, start: int) -> int | None:
        """Returns the number of Gaussians to grow to from `start`, or None outside of the growth phase."""
        if not GROWTH_START <= done <= GROWTH_END or self.max_gaussians <= start:
            return None
        share = (done - GROWTH_START) / (GROWTH_END - GROWTH_START)
        return round(start + share * (self.max_gaussians - start))


_RATES, _SCHEDULE = LearningRates(), Schedule()


@record
class FitState:
    """State of a fit between two chunks of steps."""

    train: Leaf
    """TrainState."""
    done: Array
    """() share of the fit that is done."""
    pace: Array
    """() share of the fit that one step takes."""
    seconds: Array
    """() time spent so far."""
    started: Array
    """() number of Gaussians at the start."""
    losses: Array
    """(steps,) loss of the view of each step, before the step."""


def _view_order(key: PRNGKeyArray, views: int, first: int, last: int) -> Int[np.ndarray, " s"]:
    """Draws the views of the steps first .. last - 1; each round of `views` steps visits every view once."""
    rounds = [np.asarray(_round(key, r, views)) for r in range(first // views, -(-last // views))]
    offset = first % views
    return np.concatenate([np.zeros(0, np.int64), *rounds])[offset : offset + last - first]


@functools.partial(jax.jit, static_argnums=2)
def _round(key: PRNGKeyArray, index: Array | int, views: int) -> Array:
    return jax.random.permutation(jax.random.fold_in(key, index), views)


def _init_fit_state(gaussians: Gaussians, corrected_frames: int | None = None, *, min_rows: int = 0) -> FitState:
    """Makes the state before the first step.

    Args:
      gaussians: Initial scene.
      corrected_frames: Number of frames whose corrections are refined, or None.
      min_rows: Number of Gaussians to allocate rows for.
    """
    rows = round_capacity(max(gaussians.count, min_rows))
    scene = pad_with_free_rows(jax.tree.map(lambda a: np.asarray(a, np.float32), gaussians), rows)
    zeros, zero, corrections = jax.tree.map(np.zeros_like, scene), np.zeros((), np.float64), None
    if corrected_frames is not None:
        turns = np.zeros((corrected_frames, 6), np.float32)
        identity = Corrections(turns, np.tile(np.eye(3, 4, dtype=np.float32), (corrected_frames, 1, 1)))
        no_moments = jax.tree.map(np.zeros_like, identity)
        corrections = CorrectionState(identity, no_moments, no_moments)
    train = TrainState(scene, zeros, zeros, zeros.opacity_logits, corrections)
    return FitState(train, zero, zero, zero, np.asarray(gaussians.count), np.zeros(0, np.float32))


def fit_gaussians(
    capture: Capture,
    *,
    key: PRNGKeyArray,
    steps: int | None = None,
    seconds: float | None = None,
    start: Gaussians | FitState,
    schedule: Schedule = _SCHEDULE,
    rates: LearningRates = _RATES,
    refine: CorrectionRates | None = None,
    chunk: int = 50,
    on_checkpoint: Callable[[FitState], None] | None = None,
    progress: Progress | None = None,
) -> tuple[Gaussians, Float[np.ndarray, " steps"]]:
    """Fits Gaussians to the training frames of a capture.

    Each step takes one view; all views are visited once before any is visited again. The background is black. All
    devices of this process share every step. A chunk in which a view overflowed its tile lists is repeated with more
    capacity, so the result does not depend on the capacity.

    Args:
      capture: Frames and cameras.
      key: Key of the order of the views and of growth.
      steps: Number of steps; the same steps on the same devices give the same result.
      seconds: Time limit in place of `steps`, without compilation.
      start: Initial scene, or the state of a stopped fit.
      schedule: Sizes of the frames and number of Gaussians over time.
      rates: Learning rates.
      refine: Rates at which poses and exposures are corrected too (`TrainState.corrections`), or None.
      chunk: Number of steps between checkpoints; Gaussians are added only then.
      on_checkpoint: Called with the state after every chunk.
      progress: Called with the number of steps (or seconds) done and of all.

    Returns:
      The fitted Gaussians, and the loss of the view of each step, before the step.

    Raises:
      ValueError: Not exactly one of `steps` and `seconds`, or a limit that is not above 0 and finite.
      InputError: Every frame is held out, or the fit diverges.
    """
    limits = steps, seconds
    require(limits.count(None) == 1, "steps, seconds", limits, "exactly one of the two", "Choose one limit.")
    limit = cast(float, seconds if steps is None else steps)
    require(0 < limit < math.inf, "steps, seconds", limits, "a finite number above 0", "Choose a longer fit.")
    mesh = host_mesh(-(-capture.cameras.height // (BLOCK * TILE)))  # no strip is empty
    runner = StepRunner(capture, mesh, rates, refine)
    if isinstance(start, FitState):
        state = start
    else:
        # Each doubling costs a compilation, as long as hundreds of steps over free rows: larger fits allocate half.
        divisor = 1 if schedule.max_gaussians <= 1 << 16 else 2
        min_rows = schedule.max_gaussians // divisor if schedule.max_gaussians > start.count else 0
        state = _init_fit_state(start, None if refine is None else len(capture.names), min_rows=min_rows)
    seed = int(jax.random.bits(key))
    train = put_on_devices(state.train, mesh)
    while float(state.done) < 1:
        first, done, elapsed = len(state.losses), float(state.done), float(state.seconds)
        pace = 1 / steps if steps is not None else float(state.pace) or 1e-4
        # A resumed fit has the same chunks.
        count = max(1, min(chunk - first % chunk, math.ceil((1 - done) / pace - 1e-6)))
        size, order = schedule._size(done), _view_order(key, runner.frames, first, first + count)
        program, later = runner.compile(train, size), schedule._next_size(done)
        has_all_rows = train.gaussians.count >= schedule.max_gaussians
        if later is not None and has_all_rows and steps is not None:  # a fit with a time limit would lose steps
            runner.compile(train, later)
        program.result()  # compilation is not counted as time of the fit
        began = time.monotonic()
        shares = done + pace * np.arange(count)
        train, new_losses = _run_chunk(train, runner, size, order, first, shares)
        losses = np.concatenate([state.losses, np.asarray(new_losses, np.float32)])
        host = _to_host(train, state.train.gaussians.count)
        # A Gaussian that is not finite is invisible: the loss alone does not show it.
        arrays = jax.tree.leaves((losses[-1], host.gaussians, host.corrections))
        if not all(np.isfinite(array).all() for array in arrays):
            problem = f"the fit has numbers that are not finite after step {len(losses)}"
            remedy = "Check the initial points, the poses and the intrinsics, or lower the learning rates."
            raise InputError("", problem, remedy=remedy)
        target = schedule._count(done, int(state.started))
        if target is not None and len(losses) % chunk == 0:
            moments = host.first_moment, host.second_moment
            most, draw = schedule.max_gaussians, [seed, len(losses)]
            gaussians, moments = grow(host.gaussians, moments, host.votes, target, most, draw)
            no_votes = np.zeros(gaussians.count, host.votes.dtype)
            host = TrainState(gaussians, *moments, no_votes, host.corrections)
            train = put_on_devices(host, mesh)
        elapsed += time.monotonic() - began
        now = len(losses) / steps if steps is not None else min(elapsed / limit, 1.0)
        numbers = map(np.asarray, (now, (now - done) / count, elapsed))
        state = FitState(host, *numbers, started=state.started, losses=losses)
        if on_checkpoint:
            on_checkpoint(state)
        if progress:
            progress(len(losses) if steps is not None else round(elapsed), round(limit))
    return drop_free_rows(state.train.gaussians), np.asarray(state.losses)


def _to_host(state: TrainState, rows: int) -> TrainState:
    """Copies a state to NumPy arrays, without the rows beyond `rows` that `put_on_devices` added."""
    host = jax.tree.map(np.asarray, state)
    cut = jax.tree.map(lambda a: a[:rows], dataclasses.replace(host, corrections=None))
    return dataclasses.replace(cut, corrections=host.corrections)


def _run_chunk(
    state: TrainState,
    runner: StepRunner,
    size: float,
    order: np.ndarray,
    first: int,
    done: np.ndarray,
) -> tuple[TrainState, list]:
    """Takes a step on each view of `order`, repeated with more capacity if one overflowed; and returns their losses."""
    degree = int(done[0] / 0.1)  # of the spherical harmonics that learn
    while True:
        after, losses, overflow = state, [], []
        for n, view in enumerate(order):
            after, loss, missing = runner.run_step(after, size, int(view), first + n, float(done[n]), degree)
            losses.append(loss)
            overflow.append(missing)
            if n >= 2:  # every pending step holds a scene and its moments
                jax.block_until_ready(losses[n - 2])
        most = int(max(jax.device_get(overflow)))
        if not most:
            return after, jax.device_get(losses)
        runner.widen(state, size, most)
