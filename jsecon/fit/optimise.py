"""Fits Gaussians to a capture's frames: Adam on the photometric loss with the learning rates of Kerbl et al. 2023.

The number of Gaussians stays what it was at the start. The state between chunks of steps is a record of arrays, so a
fit can be stopped after any chunk and gone on with, to the same result.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int, PRNGKeyArray, UInt8

from jsecon.errors import InputError, require
from jsecon.fit.photometric import photometric_loss, psnr
from jsecon.numerics import finite
from jsecon.splat.capacity import default_capacity, enough_capacity
from jsecon.splat.render import render_rgb
from jsecon.types import Array, Camera, Capture, Gaussians, record


@record
class LearningRates:
    """Step sizes of Adam per group, for fits of hundreds to a few thousand steps.

    Positions are in units of the cameras' extent. All decay log-linearly over the fit.
    """

    means: Any = 2e-3
    """at the first step, times the extent"""
    means_last: Any = 2e-5
    """at the last step, times the extent"""
    log_scales: Any = 2e-2
    quaternions: Any = 1e-2
    opacity_logits: Any = 5e-2
    colors: Any = 1.5e-2
    """of the constant band of the spherical harmonics; the higher bands take a twentieth"""
    rest_last: Any = 0.3
    """what the other rates have decayed to at the last step, log-linearly too, as a share of their first"""


@record
class FitState:
    """All that a fit needs to go on."""

    gaussians: Gaussians
    """as fitted so far"""
    first_moment: Gaussians
    """Adam's running mean of the gradient"""
    second_moment: Gaussians
    """Adam's running mean of its square"""
    step: Array
    """() int32 steps done"""
    losses: Array
    """(steps,) float32 loss of each step's view before the step; NaN where it has not been taken"""


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


def start_state(gaussians: Gaussians, steps: int) -> FitState:
    """The state before the first of `steps` steps."""
    gaussians = jax.tree.map(lambda a: np.asarray(a, np.float32), gaussians)
    zeros = jax.tree.map(np.zeros_like, gaussians)
    return FitState(gaussians, zeros, zeros, np.zeros((), np.int32), np.full(steps, np.nan, np.float32))


_ADAM, _RATES = optax.scale_by_adam(eps=1e-15), LearningRates()


def _rates(gaussians: Gaussians, rates: LearningRates, extent: Array, progress, step, band_every: Array) -> Gaussians:
    """One rate per array (one per band for sh), in the shape of Gaussians."""
    bands = gaussians.sh.shape[1]
    degree = np.floor(np.sqrt(np.arange(bands))).astype(np.int32)
    sh = jnp.where(degree <= step // band_every, jnp.where(degree == 0, rates.colors, rates.colors / 20), 0.0)
    # Log-linear; written so that a rate of 0 (frozen positions) stays 0.
    decay = jnp.where(rates.means > 0, rates.means_last / jnp.where(rates.means > 0, rates.means, 1.0), 0.0)
    means = extent * rates.means * decay**progress
    rest = rates.rest_last**progress
    return Gaussians(
        means, rest * rates.log_scales, rest * rates.quaternions, rest * rates.opacity_logits, rest * sh[None, :, None]
    )


@functools.partial(jax.jit, static_argnames="capacity")
def _step(
    current: tuple[Gaussians, optax.ScaleByAdamState],
    camera: Camera,
    frame: UInt8[Array, "h w 3"],
    extent: Array,
    rates: LearningRates,
    band_every: Array,
    total: Array,
    *,
    capacity: int,
):
    """One Adam step on one view. Returns the Gaussians and moments after it, the loss before it, the pairs that
    overflowed."""
    gaussians, moments = current
    target = frame.astype(jnp.float32) / 255.0

    def loss(gaussians):
        rendering = render_rgb(gaussians, camera, background=jnp.zeros(3), capacity=capacity)
        return photometric_loss(rendering.features, target), rendering.overflow

    (value, overflow), gradient = jax.value_and_grad(loss, has_aux=True)(gaussians)
    step = moments.count
    update, moments = _ADAM.update(gradient, moments)
    rate = _rates(gaussians, rates, extent, step / total, step, band_every)
    return (jax.tree.map(lambda p, u, r: p - r * u, gaussians, update, rate), moments), value, overflow


def _chunk(
    state: FitState, pictures: list, extent: Array, rates: LearningRates, band_every: int, capacity: int
) -> tuple[FitState, int]:
    """A step on each of `pictures`, (camera, frame) pairs; and the most pairs that overflowed in any of them."""
    steps = state.losses.shape[0]
    moments: Any = optax.ScaleByAdamState(*cast(Any, (state.step, state.first_moment, state.second_moment)))
    gaussians, losses, overflow = state.gaussians, [], []
    for camera, frame in pictures:
        (gaussians, moments), loss, missing = _step(
            (gaussians, moments), camera, frame, extent, rates, band_every, steps, capacity=capacity
        )
        losses.append(loss)
        overflow.append(missing)
    first, taken = int(state.step), np.array(state.losses)
    taken[first : first + len(losses)] = jax.device_get(losses)
    step = np.asarray(first + len(losses), np.int32)
    return FitState(gaussians, moments.mu, moments.nu, step, taken), int(max(jax.device_get(overflow)))


def _chunks(first: int, steps: int, chunk: int, switch: int) -> Iterator[tuple[int, int]]:
    """Ranges that end at multiples of `chunk` and at `switch`, so that a fit gone on with takes the same chunks."""
    while first < steps:
        last = min((first // chunk + 1) * chunk, steps, switch if first < switch else steps)
        yield first, last
        first = last


def _halved(cameras: Camera, frames: np.ndarray) -> tuple[Camera, np.ndarray]:
    """The views at half their size, each pixel the mean of four; an odd last row or column is left out."""
    height, width = frames.shape[1] // 2, frames.shape[2] // 2
    corners = [frames[:, i : 2 * height : 2, j : 2 * width : 2].astype(np.uint16) for i in (0, 1) for j in (0, 1)]
    mean = ((corners[0] + corners[1] + corners[2] + corners[3] + 2) // 4).astype(np.uint8)
    focal = cameras.fx / 2, cameras.fy / 2
    return Camera(cameras.world_to_camera, *focal, cameras.cx / 2, cameras.cy / 2, width, height), mean


def fit_gaussians(
    capture: Capture,
    *,
    steps: int,
    key: PRNGKeyArray,
    start: Gaussians | None = None,
    state: FitState | None = None,
    rates: LearningRates = _RATES,
    band_every: int | None = None,
    coarse: float = 0.5,
    chunk: int = 50,
    on_checkpoint: Callable[[FitState], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Gaussians, Float[np.ndarray, " steps"]]:
    """Fits `start` (or goes on from `state`) to the frames that are not held out; returns the Gaussians and the losses.

    One view a step, all views once before any comes again, in an order drawn by `key`; the first `coarse` of the steps
    on frames of half the size, which costs a quarter and moves what is large first. The degree of the spherical
    harmonics grows by one every `band_every` steps (by default 1000, in a short fit a quarter of it) up to what
    `start.sh` holds. The background is black. After every `chunk` steps `on_checkpoint` is given the state. A chunk in
    which a view overflowed its tile lists is taken again with more room, so the result does not depend on the capacity.
    Raises ValueError where not exactly one of `start` and `state` is given or the state is of another number of steps,
    InputError where every frame is held out or the numbers stop being finite.
    """
    given, exclusive = (start is not None, state is not None), (start is None) != (state is None)
    require(exclusive, "start, state", given, "exactly one of the two", "Give state to go on with a fit.")
    used = np.flatnonzero(~np.asarray(capture.held_out))
    if not len(used):
        raise InputError("capture", "every frame held out", "frames to fit to", "Hold out fewer frames.")
    begun = start_state(start, steps) if start is not None else state
    assert begun is not None
    require(0 <= coarse <= 1, "coarse", coarse, "between 0 and 1", "0 keeps the frames' size.")
    own = begun.losses.shape[0]
    require(own == steps, "state", f"a fit of {own} steps", f"{steps} steps", "Go on with the options of its start.")
    current: FitState = jax.device_put(begun)
    cameras = jax.tree.map(lambda a: np.asarray(a, np.float32), capture.cameras[used])  # whose items compile nothing
    extent = np.asarray(cameras_extent(cameras), np.float32)
    switch = int(coarse * steps)
    every = max(1, min(1000, steps // 4)) if band_every is None else band_every
    whole = cameras, np.asarray(capture.frames[used])
    sized, capacity = whole if switch == 0 else _halved(*whole), 0
    for first, last in _chunks(int(current.step), steps, chunk, switch):
        if first >= switch > 0:
            sized, capacity, switch = whole, 0, 0
        if capacity == 0:
            capacity = default_capacity(current.gaussians.count, sized[0].width, sized[0].height)
        views = view_order(key, len(used), first, last)
        pictures = [(sized[0][int(v)], sized[1][int(v)]) for v in views]
        while (taken := _chunk(current, pictures, extent, rates, every, capacity))[1]:
            capacity = enough_capacity(capacity, np.array([taken[1]]))
        current = taken[0]
        # A Gaussian that is not finite is invisible, so the loss alone would not tell.
        if not (np.isfinite(current.losses[last - 1]) and bool(_all_finite(current.gaussians))):
            found = f"numbers that are not finite after step {last}"
            remedy = "Check the start, the poses and the intrinsics, or lower the learning rates."
            raise InputError("fit", found, "a fit that converges", remedy)
        if on_checkpoint:
            on_checkpoint(current)
        if progress:
            progress(last, steps)
    return current.gaussians, np.asarray(current.losses)


_all_finite = jax.jit(lambda gaussians: finite(*jax.tree.leaves(gaussians)))


@jax.jit
def _psnr_of_photograph(image: Array, frame: UInt8[Array, "h w 3"]) -> Array:
    return psnr(jnp.clip(image, 0, 1), frame.astype(jnp.float32) / 255.0)


def evaluate_psnr(
    gaussians: Gaussians, capture: Capture, *, progress: Callable[[int, int], None] | None = None
) -> Float[np.ndarray, " f"]:
    """PSNR (dB) of each held-out frame, against the photographs; renderings clamped to [0, 1]."""
    chosen = np.flatnonzero(capture.held_out)
    gaussians, values = jax.device_put(gaussians), []
    for n, t in enumerate(chosen):
        image = render_rgb(gaussians, capture.cameras[int(t)]).features
        values.append(float(_psnr_of_photograph(image, np.asarray(capture.frames[t]))))
        if progress:
            progress(n + 1, len(chosen))
    return np.array(values)
