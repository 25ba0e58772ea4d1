"""Runs work on all cores: views, or the strips of one view, are spread over jax's local devices.

A CPU is one device to jax unless the program asks for more before jax starts (`process.prepare_process`), as the
command line does. The library only uses the devices that it has.

One view on all devices, under jit: `render(..., mesh=host_mesh())`. Many views: `accumulate_over_views`, one view on
each device, which needs no exchange and so scales better, also over several processes. Work on the host, frame by
frame: `map_over_processes`. Each works with any number of devices, and compiles once for all of them.
"""

import io
import json
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jsecon.files import pack_tree, unpack_tree
from jsecon.types import Array, Progress

AXIS = "devices"
"""name of the only axis of the mesh"""
MESH_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""`compiler_options` of jax.jit for a program on a host's mesh. Without them XLA's CPU backend also cuts the kernels of
each device into parts for the threads of all, and such kernels take up to three times as long: projecting 111,785
Gaussians 7.4 instead of 2.6 ms. Programs on one device are faster with the parts."""

LANES = 8
"""number of partial sums of `accumulate_over_views`"""
_LANES_BYTES = 1 << 30
"""bytes of the states of all lanes at once, if there are more than two"""
_AHEAD = 2
"""steps that are dispatched before one is done"""
_TREE = "__tree__"
_PIECE = 1 << 26
"""bytes of one exchange of `_allgather_bytes`"""


def host_mesh(most: int | None = None) -> Mesh | None:
    """Makes a mesh of this process's devices for the strips of one view. It is a constant to jit.

    Args:
      most: Maximum number of devices, by default all.

    Returns:
      The mesh, or None for a single device.
    """
    devices = jax.local_devices()[:most]
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,)) if len(devices) > 1 else None


def map_over_devices(local: Callable, dealt: Any, common: Any, mesh: Mesh, *, total: bool = False) -> Any:
    """Runs a function on every device of a mesh."""

    def run(dealt, common):
        out = local(jax.lax.axis_index(AXIS), dealt, common)
        return jax.lax.psum(out, AXIS) if total else out

    part, replicated = PartitionSpec(AXIS), PartitionSpec()
    # The check of varying axes would need a declaration for each carry of a walk, as they start as constants.
    shard = jax.shard_map(
        run, mesh=mesh, in_specs=(part, replicated), out_specs=replicated if total else part, check_vma=False
    )
    return shard(dealt, common)


def map_rows(local: Callable, rows: Any, common: Any, mesh: Mesh | None) -> Any:
    """Runs a function that treats rows independently, each device with an equal part of them."""
    if mesh is None:
        return local(rows, common)
    count = jax.tree.leaves(rows)[0].shape[0]

    def pad(a):
        return jnp.pad(a, [(0, -count % mesh.size)] + [(0, 0)] * (a.ndim - 1))

    out = map_over_devices(lambda _, rows, common: local(rows, common), jax.tree.map(pad, rows), common, mesh)
    return jax.tree.map(lambda a: a[:count], out)


def concurrent_lanes(views: int, state_bytes: int) -> int:
    """Computes how many lanes of `accumulate_over_views` this process works on at a time."""
    world = jax.process_count()
    lanes = -(-_lane_count(views) // world)
    devices = min(sum(device.process_index == p for device in jax.devices()) for p in range(world))
    turns = -(-lanes // max(1, min(devices, lanes, max(2, _LANES_BYTES // max(state_bytes, 1)))))
    return -(-lanes // turns)


def _lane_count(views: int) -> int:
    return max(1, min(views, max(LANES, jax.process_count())))


def accumulate_over_views(
    step: Callable,
    start: Any,
    merge: Callable[[Any, Any], Any],
    common: Any,
    views: Any,
    *,
    prepare: Callable | None = None,
    static: tuple = (),
    progress: Progress | None = None,
) -> tuple[Any, Any]:
    """Accumulates a state over views, several at a time. A host function; dispatch is asynchronous.

    View t is added up in lane t mod LANES, and the lanes are merged in order, so the number of devices and of processes
    (up to LANES) changes no bit of the sum. A device works on one lane at a time (`concurrent_lanes`); all run one
    program, which jax compiles once. Over several processes (`jax.distributed.initialize`) that make the same call,
    process p of P takes lanes p, p + P, ...; all end with the same result.
    """
    rank, world = jax.process_index(), jax.process_count()
    common, start, views = jax.tree.map(np.asarray, (common, start, views))
    count = jax.tree.leaves(views)[0].shape[0]
    lanes = _lane_count(count)
    width = concurrent_lanes(count, sum(leaf.nbytes for leaf in jax.tree.leaves(start)))
    mesh = Mesh(np.array(jax.local_devices()[:width]), (AXIS,), axis_types=(AxisType.Auto,))
    replicated, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    # If half of the cores or more have no lane, XLA cuts the kernels of the others for them.
    crowded = width > 1 and jax.local_device_count() < 2 * width
    # XLA reads NumPy's memory in place if it is aligned like its memory: all devices share one copy.
    common = jax.tree.map(lambda a: np.asarray(jax.device_put(a, may_alias=True)), common)
    common = jax.device_put(common, replicated)
    merged = None
    outs: list[Any] = []  # of all views, once the first step has given their shape
    dispatched: deque[tuple[list[int], Any]] = deque()
    done = 0

    def collect(most: int) -> None:
        """Stores the outputs of all dispatched steps but the last `most`, which may still run."""
        while len(dispatched) > most:
            chosen, out = dispatched.popleft()
            out = jax.tree.map(np.asarray, out)
            if not outs:
                outs.append(jax.tree.map(lambda a: np.zeros((count, *a.shape[1:]), a.dtype), out))
            is_view = np.array(chosen) < count
            for of_all, part in zip(jax.tree.leaves(outs), jax.tree.leaves(out), strict=True):
                of_all[np.array(chosen)[is_view]] = part[is_view]

    for turn in range(0, -(-lanes // world), width):
        my_lanes = [rank + world * (turn + place) for place in range(width)]
        states = jax.tree.map(lambda a: np.broadcast_to(a, (width, *a.shape)), start)
        states = jax.device_put(states, rows, may_alias=False)  # a step donates it
        for first in range(0, count, lanes):
            chosen = [min(first + lane, count) if lane < lanes else count for lane in my_lanes]
            if min(chosen) == count:
                continue
            wave = jax.tree.map(lambda a, chosen=chosen: a[np.minimum(chosen, count - 1)], views)
            is_view, wave = jax.device_put((np.array(chosen) < count, wave), rows)
            if prepare is not None:
                wave = _prepare[crowded](wave, common, prepare, static, mesh)
            states, out = _advance[crowded](states, (is_view, wave), common, step, static, mesh)
            dispatched.append((chosen, out))
            collect(_AHEAD)
            done += sum(t < count for t in chosen)
            if progress is not None:
                jax.block_until_ready(states)
                progress(min(done * world, count), count)
        collect(0)
        for place in range(width):
            state = jax.tree.map(lambda a, place=place: np.asarray(a.addressable_data(place))[0], states)
            for part in [state] if world == 1 else _states_of_all(state):
                if merged is None:
                    merged = jax.device_put(part, may_alias=lanes == 1)  # merging donates it
                else:
                    merged = merge(merged, jax.device_put(part, may_alias=True))
        del states
    if not outs:  # a process without views
        view = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), views)
        if prepare is not None:
            view = jax.eval_shape(lambda *inputs: prepare(*inputs, *static), common, view)
        blank = jax.eval_shape(lambda *inputs: step(*inputs, *static)[1], start, common, view)
        outs.append(jax.tree.map(lambda a: np.zeros((count, *a.shape), a.dtype), blank))
    if world > 1:
        rank_of = np.arange(count) % lanes % world
        leaves = jax.tree.leaves(outs)
        for p, part in enumerate(allgather_tree([leaf[rank_of == rank] for leaf in leaves])):
            for leaf, rows_of_p in zip(leaves, part, strict=True):
                leaf[rank_of == p] = rows_of_p
    return merged, outs[0]


def _prepare_lanes(wave: Any, common: Any, prepare: Callable, static: tuple, mesh: Mesh) -> Any:
    """`prepare` of each lane's view of the wave."""

    def local(_, wave, common):
        prepared = prepare(common, jax.tree.map(lambda a: a[0], wave), *static)
        return jax.tree.map(lambda a: a[None], prepared)

    return map_over_devices(local, wave, common, mesh)


def _advance_lanes(states: Any, wave: tuple[Array, Any], common: Any, step: Callable, static: tuple, mesh: Mesh):
    """Each lane's state after its view of the wave, and the output of its step; the same state if it has no view."""

    def local(_, dealt, common):
        state, (is_view, view) = jax.tree.map(lambda a: a[0], dealt)

        def take_step():
            return step(state, common, view, *static)

        if mesh.size == 1:  # without a view there is no wave
            result = take_step()
        else:
            blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(take_step)[1])
            result = jax.lax.cond(is_view, take_step, lambda: (state, blank))
        return jax.tree.map(lambda a: a[None], result)

    return map_over_devices(local, (states, wave), common, mesh)


# for lanes that leave cores idle, and for lanes that do not
_prepare = [jax.jit(_prepare_lanes, static_argnums=(2, 3, 4), compiler_options=o) for o in (None, MESH_OPTIONS)]
_advance = [
    jax.jit(_advance_lanes, static_argnums=(3, 4, 5), donate_argnums=0, compiler_options=options)
    for options in (None, MESH_OPTIONS)
]


def _states_of_all(state: Any) -> list[Any]:
    """The states of all processes, in their order."""
    parts = process_allgather(state)
    return [jax.tree.map(lambda a, p=p: np.asarray(a[p]), parts) for p in range(jax.process_count())]


def map_over_processes(
    count: int, rows: Callable[[Sequence[int]], Iterable[Any]], progress: Progress | None = None
) -> list[Any]:
    """Maps a host function over indices, each process with its part of them.

    Over several processes that make the same call (`jax.distributed.initialize`), process p of P computes
    p, p + P, ...; all end with all results. One process computes them all.
    """
    rank, world = jax.process_index(), jax.process_count()
    results = []
    for row in rows(range(rank, count, world)):
        results.append(row)
        if progress is not None:
            progress(min(len(results) * world, count), count)
    if world == 1:
        return results
    parts = allgather_tree(results)
    return [parts[t % world][t // world] for t in range(count)]


def allgather_tree(tree: Any) -> list[Any]:
    """Exchanges trees between the processes, without pickle: all call it, minutes apart if need be."""
    arrays: dict[str, np.ndarray] = {}
    description = json.dumps(pack_tree(tree, "root", arrays)).encode()
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **{_TREE: np.frombuffer(description, np.uint8)}, **arrays)
    return [_deserialize(data) for data in _allgather_bytes(stream.getvalue())]


def _deserialize(data: bytes) -> Any:
    """The tree in the bytes of one process."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    return unpack_tree(json.loads(arrays.pop(_TREE).tobytes()), arrays)


def _allgather_bytes(data: bytes) -> list[bytes]:
    """Exchanges bytes.

    It uses all_gather in pieces of at most _PIECE bytes, whose lengths are powers of two, as jax compiles for each
    length. (Gloo's psum_scatter fails if one process comes 30 s after the other: jax issue 40831.)
    """
    if jax.process_count() == 1:
        return [data]
    sizes = process_allgather(np.array(divmod(len(data), 1 << 31), np.int32))
    lengths = [int(high) * (1 << 31) + int(low) for high, low in sizes]
    parts = [bytearray() for _ in lengths]
    for begin in range(0, max(lengths), _PIECE):
        size = min(_PIECE, max(1 << 16, 1 << (max(lengths) - begin - 1).bit_length()))
        piece = np.zeros(size, np.uint8)
        mine = np.frombuffer(data[begin : begin + size], np.uint8)
        piece[: len(mine)] = mine
        for part, row, length in zip(parts, process_allgather(piece), lengths):
            part += row[: max(0, min(size, length - begin))].tobytes()
    return [bytes(part) for part in parts]
