"""One optimisation step of a fit: training view, loss, gradients and Adam, on all devices of this process."""

import dataclasses
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, cast

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float

from jsecon.errors import InputError
from jsecon.fit.corrections import CorrectionRates, Corrections, CorrectionState, se3_exp
from jsecon.fit.growth import pad_rows, pad_with_free_rows
from jsecon.fit.photometric import photometric_loss
from jsecon.fit.resize import resize_frame, resize_mask, scale_cameras
from jsecon.parallel import AXIS, MESH_OPTIONS, map_rows
from jsecon.splat.capacity import default_capacity, enough_capacity
from jsecon.splat.plan import plan_view, render_plan
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Array, Camera, Capture, Gaussians, Leaf, record

DEPTH_WEIGHT = 0.2
"""Weight of the mean relative depth error in the loss, for captures with depth."""
_ADAM = optax.scale_by_adam(eps=1e-15)


@record
class LearningRates:
    """Step sizes of Adam for each group of parameters. All decay log-linearly over the fit."""

    means: Any = 5e-4
    """First step size of the positions, in units of the cameras' extent."""
    means_last: Any = 5e-6
    """Last step size of the positions, in the same unit."""
    log_scales: Any = 2e-2
    quaternions: Any = 1e-2
    opacity_logits: Any = 5e-2
    colors: Any = 1.5e-2
    """Step size of the constant band of the spherical harmonics; higher bands take a twentieth."""
    rest_last: Any = 0.3
    """Last step size of all other groups, as a share of their first."""


def _rates_at(done: Array, rates: LearningRates, gaussians: Gaussians, extent: Array, degree: Array) -> Gaussians:
    """Computes the step size of each array when the share `done` of the fit is done. Pure.

    Args:
      done: Share of the fit that is done.
      rates: Step sizes over the fit.
      gaussians: Scene, for the number of its spherical harmonics.
      extent: Cameras' extent, world units.
      degree: Highest degree of the spherical harmonics that learns: the rate of higher coefficients is zero.
    """
    band = np.floor(np.sqrt(np.arange(gaussians.sh.shape[1]))).astype(np.int32)
    sh = jnp.where(band <= degree, jnp.where(band == 0, rates.colors, rates.colors / 20), 0.0)
    # Log-linear; written so that a rate of 0 (frozen positions) stays 0.
    decay = jnp.where(rates.means > 0, rates.means_last / jnp.where(rates.means > 0, rates.means, 1.0), 0.0)
    means, rest = extent * rates.means * decay**done, rates.rest_last**done
    return Gaussians(
        means, rest * rates.log_scales, rest * rates.quaternions, rest * rates.opacity_logits, rest * sh[None, :, None]
    )


@record
class _TrainingView:
    """One view that a step fits to."""

    camera: Leaf
    """Camera of the view."""
    frame: Leaf
    """(H, W, 3) uint8."""
    depth: Leaf
    """(H, W) float32 z-depth, world units, 0 = unknown; or None."""
    ignored: Leaf
    """(H, W) bool: pixels without influence; or None."""


class _TrainingViews:
    """Training frames of a capture at one size, each resized when a step first takes it. Host code."""

    def __init__(self, capture: Capture, size: float = 1.0):
        """Takes the training frames of a capture, at a share of their size. Raises InputError if there is none."""
        self.frame_indices = np.flatnonzero(~np.asarray(capture.held_out))
        if not len(self.frame_indices):
            raise InputError("capture", "every frame held out", "frames to fit to", "Hold out fewer frames.")
        self._capture = capture
        # NumPy arrays: indexing them compiles no program.
        cameras = jax.tree.map(lambda a: np.asarray(a, np.float32), capture.cameras[self.frame_indices])
        self.extent = np.asarray(cameras_extent(cameras), np.float32)
        self.cameras = cameras if size == 1.0 else scale_cameras(cameras, size)
        self._views: dict[int, _TrainingView] = {}

    def __getitem__(self, index: int) -> _TrainingView:
        """Returns a view by its position among the training frames."""
        if index not in self._views:
            self._views[index] = self._resized(index)
        return self._views[index]

    def _resized(self, index: int) -> _TrainingView:
        capture, t = self._capture, self.frame_indices[index]
        size = self.cameras.width, self.cameras.height
        depth = ignored = None
        if capture.depths is not None:
            depth = np.asarray(capture.depths[t], np.float32)
            if not (np.isfinite(depth) & (depth >= 0)).all():  # a copy, else the depth itself
                depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
            depth = depth if depth.shape == size[::-1] else _shrink_depth(depth, size)
        if capture.ignored is not None:
            ignored = resize_mask(np.asarray(capture.ignored[t]), self.cameras)
        frame = resize_frame(np.asarray(capture.frames[t]), self.cameras)
        return _TrainingView(self.cameras[index], frame, depth, ignored)


def _shrink_depth(depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mean depth over each pixel of a smaller frame; 0 if a part is unknown or several surfaces meet there."""

    def shrink(a):
        return cv2.resize(a, size, interpolation=cv2.INTER_AREA).astype(np.float64)

    mean, square, known = shrink(depth), shrink(depth.astype(np.float64) ** 2), shrink(np.float32(depth > 0))
    one_surface = square - mean**2 <= (0.05 * mean) ** 2  # depths spread by more belong to several surfaces
    return np.where((known > 0.999) & one_surface, mean, 0).astype(np.float32)


def cameras_extent(cameras: Camera) -> float:
    """Computes the extent of cameras as INRIA: 1.1 times the largest distance of a centre from their mean."""
    centres = jax.tree.map(lambda a: np.asarray(a, np.float64), cameras).centres
    return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def _view_loss(
    gaussians: Any,
    vote_channel: Array,
    correction: Corrections | None,
    view: _TrainingView,
    extent: Array,
    capacity: int | None = None,
    mesh: Mesh | None = None,
) -> tuple[Array, tuple[Array, Array]]:
    """Computes the loss of one view. Pure.

    It is the photometric loss of the rendering, plus DEPTH_WEIGHT times the mean of |rendered - known| / known depth
    over the pixels of the view (zero where the depth is unknown or little is rendered), plus the squared corrections
    (radians and shares of the extent; shares of the colour range). Ignored pixels have no gradient and no votes.

    Args:
      gaussians: Scene of N Gaussians.
      vote_channel: (N, 1) zeros. Its gradient is the votes: the weights alpha T of each Gaussian times the mean
        absolute error of the pixels.
      correction: Corrections of this view, or None.
      view: Camera, frame, depth and ignored pixels.
      extent: Cameras' extent, world units.
      capacity: Number of (block, Gaussian) pairs, see `render`.
      mesh: Devices to divide the work among, or None.

    Returns:
      The value to descend; and the loss without votes, and the number of pairs that overflowed.
    """
    camera = view.camera if correction is None else corrected_camera(view.camera, correction.twists)
    colours = map_rows(colours_from_sh, gaussians, camera, mesh)
    # The votes are the gradient of a fourth channel of zeros: they need no separate pass.
    features = jnp.concatenate([colours, vote_channel], axis=1)
    plan = plan_view(gaussians, camera, capacity=capacity, mesh=mesh)
    # Features that are not finite end the fit in any case.
    rendering = render_plan(plan, features, depth=view.depth is not None, finite=True)
    image, votes = rendering.features[..., :3], rendering.features[..., 3]
    image = image if correction is None else apply_exposure(image, correction.colours)
    target = view.frame.astype(image.dtype) / 255.0
    if view.ignored is not None:  # both show the rendering there: exact, as SSIM's windows reach across the border
        ignored, rendered = view.ignored[..., None], jax.lax.stop_gradient(image)
        image, target = jnp.where(ignored, rendered, image), jnp.where(ignored, rendered, target)
    value = photometric_loss(image, target, mesh)
    if view.depth is not None and rendering.depth is not None:
        known = (view.depth > 0) & (rendering.alpha > 0.5)
        relative = jnp.abs(rendering.depth - view.depth) / jnp.where(known, view.depth, 1.0)
        value = value + DEPTH_WEIGHT * jnp.mean(jnp.where(known, relative, 0.0))
    if correction is not None:
        # Decides what the frames leave open; without extent the cameras share one place.
        shift = correction.twists[3:] / jnp.where(extent > 0, extent, 1.0)
        poses = jnp.sum(correction.twists[:3] ** 2) + jnp.sum(shift**2)
        value = value + 1e-3 * poses + 1e-3 * jnp.sum((correction.colours - jnp.eye(3, 4)) ** 2)
    error = jax.lax.stop_gradient(jnp.abs(image - target).mean(-1))
    return value + jnp.sum(error * votes), (value, rendering.overflow)


def corrected_camera(camera: Camera, twist: Float[Array, "6"]) -> Camera:
    """Moves a camera by a twist in its frame: exp(twist) world_to_camera."""
    motion, pose = se3_exp(twist), camera.world_to_camera
    # Multiply-and-sum: exact float32 on every backend.
    moved = (motion[:, :, None] * pose[None, :, :].astype(motion.dtype)).sum(1)
    return dataclasses.replace(camera, world_to_camera=moved)


def apply_exposure(image: Float[Array, "h w 3"], colour: Float[Array, "3 4"]) -> Float[Array, "h w 3"]:
    """Applies the colour map of a view to rendered colours, without clamping."""
    r, g, b = image[..., 0], image[..., 1], image[..., 2]
    return jnp.stack([row[0] * r + row[1] * g + row[2] * b + row[3] for row in colour], axis=-1)


@record
class TrainState:
    """Arrays that a step updates."""

    gaussians: Leaf
    """Scene so far; rows may be free (growth.py)."""
    first_moment: Leaf
    """Adam's running mean of the gradient, as Gaussians."""
    second_moment: Leaf
    """Adam's running mean of the squared gradient, as Gaussians."""
    votes: Leaf
    """(N,) sum of alpha T times the mean absolute error of the pixel, over the views since the last growth."""
    corrections: Leaf = None
    """CorrectionState of all frames of the capture; None if they are not refined."""


@record
class _StepInputs:
    """Numbers of a step; traced, so that one program serves all steps."""

    step: Leaf
    """() int32 index of the step."""
    frame: Leaf
    """() int32 index of the frame in the capture."""
    visits: Leaf
    """() int32 number of earlier steps on this frame."""
    done: Leaf
    """() float32 share of the fit that is done."""
    degree: Leaf
    """() int32 highest degree of the spherical harmonics that learns; it may exceed the scene's."""
    extent: Leaf
    """() float32 cameras' extent, world units."""
    rates: Leaf
    """LearningRates."""
    correction_rates: Leaf
    """Corrections of one view, or None."""


def _step(
    state: TrainState, view: _TrainingView, inputs: _StepInputs, capacity: int, mesh: Mesh | None
) -> tuple[TrainState, Array, Array]:
    """Takes one Adam step on one view. Pure.

    Over a mesh, projection, compositing, loss and update are each divided among its devices.

    Returns:
      The state after the step, the loss before it, and the number of pairs that overflowed `capacity`.
    """
    # Always counted: a program without them would save 5 % of a step and cost its own compilation.
    vote_channel = jnp.zeros((state.gaussians.count, 1))
    corrections = state.corrections
    correction = None if corrections is None else jax.tree.map(lambda a: a[inputs.frame], corrections.current)

    def loss(gaussians, vote_channel, correction):
        return _view_loss(gaussians, vote_channel, correction, view, inputs.extent, capacity, mesh)

    gradients = jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(state.gaussians, vote_channel, correction)
    (_, (value, overflow)), (gradient, vote_gradient, correction_gradient) = gradients

    def update(rows, common):
        return _adam(*rows, *common)

    rate = _rates_at(inputs.done, inputs.rates, state.gaussians, inputs.extent, inputs.degree)
    rows = state.gaussians, gradient, state.first_moment, state.second_moment
    gaussians, first, second = map_rows(update, rows, (inputs.step, rate), mesh)
    if corrections is not None:
        before = jax.tree.map(lambda a: a[inputs.frame], corrections)
        moments = before.first_moment, before.second_moment
        row = _adam(before.current, correction_gradient, *moments, inputs.visits, inputs.correction_rates)
        corrections = jax.tree.map(lambda a, new: a.at[inputs.frame].set(new), corrections, CorrectionState(*row))
    after = TrainState(gaussians, first, second, state.votes + vote_gradient[:, 0], corrections)
    if mesh is not None:  # the same shardings as before: one program serves every step
        after = jax.lax.with_sharding_constraint(after, _shardings(mesh))
    return after, value, overflow


def _adam(parameters: Any, gradient: Any, first: Any, second: Any, steps: Array, rates: Any) -> tuple[Any, Any, Any]:
    """Parameters and moments after one step of Adam; `steps` is the number of earlier ones."""
    moments: Any = optax.ScaleByAdamState(*cast(Any, (steps, first, second)))
    direction, moments = _ADAM.update(gradient, moments)
    return jax.tree.map(lambda p, u, r: p - r * u, parameters, direction, rates), moments.mu, moments.nu


# of one device, and over a mesh
_step_compiled = [jax.jit(_step, static_argnums=(3, 4), compiler_options=options) for options in (None, MESH_OPTIONS)]


def _shardings(mesh: Mesh) -> TrainState:
    """Says how the state lies on the devices.

    Rows of the scene, the moments and the votes are divided among them: copies would take as many times the memory and
    be exchanged at every step. Corrections are replicated.
    """
    replicated, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    return TrainState(rows, rows, rows, rows, replicated)


def put_on_devices(state: TrainState, mesh: Mesh | None) -> TrainState:
    """Moves a state to the devices of a mesh, or to the first device.

    It is padded with free rows so that all devices have the same number.
    """
    if mesh is None:
        return jax.device_put(state)
    rows = -(-state.gaussians.count // mesh.size) * mesh.size
    if rows > state.gaussians.count:
        first, second, votes = pad_rows((state.first_moment, state.second_moment, state.votes), rows)
        state = TrainState(pad_with_free_rows(state.gaussians, rows), first, second, votes, state.corrections)
    return jax.device_put(state, _shardings(mesh))


def _correction_steps(rates: CorrectionRates, done: float, extent: np.ndarray) -> Corrections:
    """Step sizes of one view when the share `done` of the fit is done; they fall log-linearly to 3 %."""
    pose, colour = (rate * 0.03**done for rate in rates)
    return Corrections(np.repeat(np.array([pose, pose * float(extent)], np.float32), 3), np.float32(colour))


class StepRunner:
    """Runs steps on the training frames of a capture.

    Each number of rows and size of the frames has a program of its own and its own capacity of the tile lists.

    Attributes:
      frames: Number of training frames.
    """

    def __init__(self, capture: Capture, mesh: Mesh | None, rates: LearningRates, refine: CorrectionRates | None):
        """Prepares steps on `mesh`. Raises InputError if every frame is held out."""
        self._capture, self._mesh, self._rates, self._refine = capture, mesh, rates, refine
        self._by_size: dict[float, _TrainingViews] = {}
        self._capacity: dict[tuple[int, float], int] = {}
        self._programs: dict[tuple[int, float, int], Future] = {}
        self._compiler = ThreadPoolExecutor(2)
        self.frames = len(self._views(1.0).frame_indices)

    def _views(self, size: float) -> _TrainingViews:
        """Returns the training frames at a share of their full size."""
        if size not in self._by_size:
            self._by_size[size] = _TrainingViews(self._capture, size)
        return self._by_size[size]

    def compile(self, state: TrainState, size: float) -> Future:
        """Starts to compile the program for the rows of `state` in another thread, unless that has begun."""
        count, cameras = state.gaussians.count, self._views(size).cameras
        strips = 1 if self._mesh is None else self._mesh.size
        initial = default_capacity(count, cameras.width, cameras.height, strips=strips)
        capacity = self._capacity.setdefault((count, size), initial)
        program = count, size, capacity
        if program not in self._programs:
            arguments = state, *self._arguments(size, 0, 0, 0.0, 0), capacity, self._mesh
            jitted = _step_compiled[self._mesh is not None]
            self._programs[program] = self._compiler.submit(lambda: jitted.lower(*arguments).compile())
        return self._programs[program]

    def run_step(
        self, state: TrainState, size: float, view: int, index: int, done: float, degree: int
    ) -> tuple[TrainState, Array, Array]:
        """Takes one step, see `_step`.

        Args:
          state: State before the step.
          size: Size of the frame, as a share of its full size.
          view: Position of the view among the training frames.
          index: Number of earlier steps.
          done: Share of the fit that is done, in [0, 1].
          degree: Highest degree of the spherical harmonics that learns.
        """
        program = self.compile(state, size).result()
        return program(state, *self._arguments(size, view, index, done, degree))

    def _arguments(self, size: float, view: int, index: int, done: float, degree: int) -> tuple:
        views, refine = self._views(size), self._refine
        inputs = _StepInputs(
            step=np.int32(index),
            frame=np.int32(views.frame_indices[view]),
            visits=np.int32(index // len(views.frame_indices)),
            done=np.float32(done),
            degree=np.int32(degree),
            extent=views.extent,
            rates=self._rates,
            correction_rates=None if refine is None else _correction_steps(refine, done, views.extent),
        )
        sharding = None if self._mesh is None else NamedSharding(self._mesh, PartitionSpec())
        return jax.device_put((views[view], inputs), sharding)

    def widen(self, state: TrainState, size: float, overflow: int) -> None:
        """Raises the capacity of views at a size by the number of pairs that found no room."""
        shape = state.gaussians.count, size
        self._capacity[shape] = enough_capacity(self._capacity[shape], np.array([overflow]))
