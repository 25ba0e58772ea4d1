"""One step of a fit: a view's loss, its gradients, and Adam, on all devices of this process."""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jsecon.fit.corrections import CorrectionState, RefineOptions, update_corrections
from jsecon.fit.growth import pad_rows, pad_with_free_rows
from jsecon.fit.schedule import LearningRates, rates_at
from jsecon.fit.view import TrainingView, TrainingViews, view_loss
from jsecon.parallel import AXIS, MESH_OPTIONS, map_rows
from jsecon.splat.capacity import default_capacity, enough_capacity
from jsecon.types import Array, Gaussians

_ADAM = optax.scale_by_adam(eps=1e-15)


class TrainState(NamedTuple):
    """What a step moves."""

    gaussians: Gaussians
    first_moment: Gaussians
    second_moment: Gaussians
    votes: Array
    """(N,) see FitState."""
    refined: CorrectionState | None
    """the corrections of all frames, where they are refined"""


class StepConfig(NamedTuple):
    """How a step goes, beside its view."""

    degree: int
    """the highest of the spherical harmonics that learns"""
    count_votes: bool
    """Whether the step adds up the votes that growth follows."""
    rates: LearningRates
    refine: RefineOptions | None


def step(
    current: TrainState,
    view: TrainingView,
    numbers: dict[str, Any],
    capacity: int,
    mesh: Mesh | None,
    count_votes: bool,
) -> tuple[TrainState, Array, Array]:
    """One Adam step on one view. Returns what is current after it, the loss before it, the pairs that overflowed. Over
    a mesh, projection, compositing, loss and update are each shared out among its devices.

    `numbers`: the step, the view's frame, how often that was taken before, the share of the fit that is done, the
    degree, the extent, the rates, those of the corrections.
    """
    gaussians, first, second, votes, refined = current
    nothing = jnp.zeros((gaussians.count, 1 if count_votes else 0))
    own = None if refined is None else jax.tree.map(lambda a: a[numbers["frame"]], refined.now)
    fixed = {"view": view, "extent": numbers["extent"], "capacity": capacity, "mesh": mesh}

    def loss(gaussians, nothing, own):
        return view_loss(gaussians, nothing, own, **fixed)

    by = jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(gaussians, nothing, own)
    (_, (value, overflow)), (gradient, by_error, by_own) = by

    def update(rows, common):
        (gaussians, gradient, first, second), (step, rate) = rows, common
        moments: Any = optax.ScaleByAdamState(*cast(Any, (step, first, second)))
        change, moments = _ADAM.update(gradient, moments)
        return jax.tree.map(lambda p, u, r: p - r * u, gaussians, change, rate), moments.mu, moments.nu

    rate = rates_at(numbers["done"], numbers["rates"], gaussians, numbers["extent"], numbers["degree"])
    rows = gaussians, gradient, first, second
    gaussians, first, second = map_rows(update, rows, (numbers["step"], rate), mesh)
    if refined is not None:
        refined = update_corrections(refined, numbers["frame"], by_own, numbers["taken"], numbers["refine_rates"])
    after = TrainState(gaussians, first, second, votes + by_error.sum(1), refined)
    if mesh is not None:  # as it came: one program serves every step
        after = TrainState(*map(jax.lax.with_sharding_constraint, after, _places(mesh)))
    return after, value, overflow


# of one device, and over a mesh
step_compiled = [
    jax.jit(step, static_argnames=("capacity", "mesh", "count_votes"), compiler_options=options)
    for options in (None, MESH_OPTIONS)
]


def _places(mesh: Mesh) -> TrainState:
    """How what is current lies on the devices: each has its own rows of the scene, the moments and the votes, and all
    of the corrections. A scene that every device held whole would take as many times its memory, and every step would
    send all of it to each."""
    whole, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    return cast(TrainState, TrainState(*cast(Any, (rows, rows, rows, rows, whole))))


def put_on_devices(current: TrainState, mesh: Mesh | None) -> TrainState:
    """What is current, where the devices of a step want it; over a mesh filled up with free rows, so that each device
    has as many."""
    if mesh is None:
        return jax.device_put(current)
    rows = -(-current.gaussians.count // mesh.size) * mesh.size
    if rows > current.gaussians.count:
        others = current.first_moment, current.second_moment, current.votes
        first, second, votes = pad_rows(others, rows)
        current = TrainState(pad_with_free_rows(current.gaussians, rows), first, second, votes, current.refined)
    return TrainState(*map(jax.device_put, current, _places(mesh)))


def to_host(current: TrainState, rows: int) -> TrainState:
    """What is current as NumPy's arrays, without the rows that `put_on_devices` added to `rows`."""
    host = jax.tree.map(np.asarray, current)
    return jax.tree.map(lambda a: a[:rows], host._replace(refined=None))._replace(refined=host.refined)


class StepRunner:
    """Steps on the views of a capture: the programs that there are, and the room that views of a size need."""

    def __init__(self, views: TrainingViews, mesh: Mesh | None):
        self.views, self.mesh = views, mesh
        self._capacity: dict[tuple[int, float], int] = {}
        self._compiled: set[tuple] = set()

    def _shape(self, current: TrainState) -> tuple[int, float]:
        return current.gaussians.count, self.views.size

    def take(
        self, current: TrainState, view: int, number: int, done: float, way: StepConfig
    ) -> tuple[TrainState, Array, Array]:
        """`step`, the `number`-th, on that view."""
        views, cameras, strips = self.views, self.views.cameras, 1 if self.mesh is None else self.mesh.size
        fresh = default_capacity(current.gaussians.count, cameras.width, cameras.height, strips=strips)
        capacity = self._capacity.setdefault(self._shape(current), fresh)
        numbers = {
            "step": np.int32(number),
            "frame": np.int32(views.used[view]),
            "taken": np.int32(number // len(views.used)),
            "done": np.float32(done),
            "degree": np.int32(way.degree),
            "extent": views.extent,
            "rates": way.rates,
            "refine_rates": None if way.refine is None else way.refine.rates(done, float(views.extent)),
        }
        place = None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec())
        given = jax.device_put((views[view], numbers), place)
        run = step_compiled[self.mesh is not None]
        return run(current, *given, capacity=capacity, mesh=self.mesh, count_votes=way.count_votes)

    def compile(self, current: TrainState, view: int, number: int, done: float, way: StepConfig) -> None:
        """Makes the program of such a step, where there is none."""
        program = *self._shape(current), way.count_votes
        if program not in self._compiled:
            jax.block_until_ready(self.take(current, view, number, done, way))
            self._compiled.add(program)

    def widen(self, current: TrainState, overflow: int) -> None:
        """Gives room for `overflow` pairs more in views of this size."""
        shape = self._shape(current)
        self._capacity[shape] = enough_capacity(self._capacity[shape], np.array([overflow]))
