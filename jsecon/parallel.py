"""All cores: the views, or one view's strips, spread over jax's local devices.

A CPU is one device to jax unless the program says otherwise before jax starts (`process.prepare_process`); the command
line does. The library only uses what it finds.

One view over all devices, under jit: `render(..., mesh=host_mesh())`. Many views: `accumulate_over_views`, one view on
each device, which needs no exchange and so scales better, and over several processes too. Work that is no program of
jax, frame by frame: `map_over_processes`. Each works with any number of devices, and compiles once for all of them.
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
from jsecon.types import Array

AXIS = "devices"
"""the mesh's one axis"""
MESH_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""`compiler_options` of jax.jit for a program over a host's mesh. Without them XLA's CPU backend also cuts the kernels
of each device into parts for the threads of all, and such kernels take up to three times as long: projecting 111,785
Gaussians 7.4 instead of 2.6 ms. Programs of one device are better off with the parts."""

LANES = 8
"""of `accumulate_over_views`: the sums that views are added up in side by side"""
_LANES_BYTES = 1 << 30
"""that the sums of all lanes at once may take, where there are more than two"""
_AHEAD = 2
"""steps that are dispatched before one is done"""
_TREE = "__tree__"
_PIECE = 1 << 26
"""bytes that `allgather_bytes` sends at once"""


def host_mesh() -> Mesh | None:
    """All of this process's devices for one view's tiles, or None where there is but one. A constant to jit."""
    devices = jax.local_devices()
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,)) if len(devices) > 1 else None


def map_over_devices(local: Callable, dealt: Any, common: Any, mesh: Mesh, *, total: bool = False) -> Any:
    """`local(index of the device, dealt, common)` on every device of `mesh`, each with its equal part of the arrays
    `dealt` along their leading axes, and the whole of `common`. The results are joined along their leading axes, or
    added up where `total`."""

    def run(dealt, common):
        out = local(jax.lax.axis_index(AXIS), dealt, common)
        return jax.lax.psum(out, AXIS) if total else out

    part, whole = PartitionSpec(AXIS), PartitionSpec()
    # The carries of a walk start as constants, which the check of varying axes would have to be told of one by one.
    spread = jax.shard_map(run, mesh=mesh, in_specs=(part, whole), out_specs=whole if total else part, check_vma=False)
    return spread(dealt, common)


def map_rows(local: Callable, rows: Any, common: Any, mesh: Mesh | None) -> Any:
    """`local(rows, common)`, row by row independent in every array of `rows` and of the result, each device taking an
    equal part of them; the last part is filled up with zeros, which `local` must bear."""
    if mesh is None:
        return local(rows, common)
    count = jax.tree.leaves(rows)[0].shape[0]
    fill = lambda a: jnp.pad(a, [(0, -count % mesh.size)] + [(0, 0)] * (a.ndim - 1))
    out = map_over_devices(lambda _, rows, common: local(rows, common), jax.tree.map(fill, rows), common, mesh)
    return jax.tree.map(lambda a: a[:count], out)


def concurrent_lanes(views: int, state_bytes: int) -> int:
    """How many lanes of `accumulate_over_views` this process works on at a time: no more than there are devices, the
    same number in every turn, and above two no more than _LANES_BYTES hold, each with a state of `state_bytes`."""
    world = jax.process_count()
    own = -(-_lane_count(views) // world)
    devices = min(sum(device.process_index == p for device in jax.devices()) for p in range(world))
    turns = -(-own // max(1, min(devices, own, max(2, _LANES_BYTES // max(state_bytes, 1)))))
    return -(-own // turns)


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
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Any, Any]:
    """Accumulates `state, out = step(state, common, view, *static)` over the leading axis of `views`. Returns the
    state, and each view's `out`, stacked, in NumPy. With `prepare`, the step gets `prepare(common, view, *static)` in
    place of the view, from a program of its own, which states of other sizes share.

    View t is added up in lane t mod LANES, and `merge`, whose neutral state is `start`, joins the lanes in their order.
    So the number of devices and of processes (up to LANES) changes no bit of the sum. A device works on one lane at a
    time (`concurrent_lanes`); all run one program, which jax compiles once. `step` is a pure function, traced under
    shard_map. Host code; dispatch is asynchronous. `progress(done, total)` is called as views finish.

    Over several processes (`jax.distributed.initialize`), each given the same arguments, process p of P takes lanes p,
    p + P, ...; all end with the same result.
    """
    rank, world = jax.process_index(), jax.process_count()
    common, start, views = jax.tree.map(np.asarray, (common, start, views))
    count = jax.tree.leaves(views)[0].shape[0]
    lanes = _lane_count(count)
    width = concurrent_lanes(count, sum(leaf.nbytes for leaf in jax.tree.leaves(start)))
    mesh = Mesh(np.array(jax.local_devices()[:width]), (AXIS,), axis_types=(AxisType.Auto,))
    whole, rows = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))
    # Where half of the cores and more have no lane, XLA cuts the kernels of the others for them.
    crowded = width > 1 and jax.local_device_count() < 2 * width
    # XLA reads NumPy's memory in place where it is aligned as its own is: all devices share one copy.
    common = jax.tree.map(lambda a: np.asarray(jax.device_put(a, may_alias=True)), common)
    common = jax.device_put(common, whole)
    merged = jax.device_put(start, may_alias=False)  # joining takes it
    outs: list[Any] = []  # of all views, once a step has told their shape
    dispatched: deque[tuple[list[int], Any]] = deque()
    done = 0

    def keep(most: int) -> None:
        """Takes over what the steps gave, but for the last `most`, which may still run."""
        while len(dispatched) > most:
            chosen, out = dispatched.popleft()
            out = jax.tree.map(np.asarray, out)
            if not outs:
                outs.append(jax.tree.map(lambda a: np.zeros((count, *a.shape[1:]), a.dtype), out))
            there = np.array(chosen) < count
            for of_all, part in zip(jax.tree.leaves(outs), jax.tree.leaves(out), strict=True):
                of_all[np.array(chosen)[there]] = part[there]

    for turn in range(0, -(-lanes // world), width):
        own = [rank + world * (turn + place) for place in range(width)]
        states = jax.tree.map(lambda a: np.broadcast_to(a, (width, *a.shape)), start)
        states = jax.device_put(states, rows, may_alias=False)  # a step takes it
        for first in range(0, count, lanes):
            chosen = [min(first + lane, count) if lane < lanes else count for lane in own]
            if min(chosen) == count:
                continue
            wave = jax.tree.map(lambda a, chosen=chosen: a[np.minimum(chosen, count - 1)], views)
            there, wave = jax.device_put((np.array(chosen) < count, wave), rows)
            if prepare is not None:
                wave = _prepare[crowded](wave, common, prepare, static, mesh)
            states, out = _advance[crowded](states, (there, wave), common, step, static, mesh)
            dispatched.append((chosen, out))
            keep(_AHEAD)
            done += sum(t < count for t in chosen)
            if progress is not None:
                jax.block_until_ready(states)
                progress(min(done * world, count), count)
        keep(0)
        for place in range(width):
            state = jax.tree.map(lambda a, place=place: np.asarray(a.addressable_data(place))[0], states)
            for part in [state] if world == 1 else _of_all(state):
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
        most = int(np.bincount(rank_of, minlength=world).max())
        mine = np.flatnonzero(rank_of == rank)
        for of_all in jax.tree.leaves(outs):
            own_rows = np.zeros((most, *of_all.shape[1:]), of_all.dtype)
            own_rows[: len(mine)] = of_all[mine]
            for p, part in enumerate(process_allgather(own_rows)):
                theirs = np.flatnonzero(rank_of == p)
                of_all[theirs] = part[: len(theirs)]
    return merged, outs[0]


def _prepare_lanes(wave: Any, common: Any, prepare: Callable, static: tuple, mesh: Mesh) -> Any:
    """`prepare` of each lane's view of the wave."""

    def local(_, wave, common):
        prepared = prepare(common, jax.tree.map(lambda a: a[0], wave), *static)
        return jax.tree.map(lambda a: a[None], prepared)

    return map_over_devices(local, wave, common, mesh)


def _advance_lanes(states: Any, wave: tuple[Array, Any], common: Any, step: Callable, static: tuple, mesh: Mesh):
    """Each lane's state after its view of the wave, and what its step gave; the same where it has none."""

    def local(_, dealt, common):
        state, (there, view) = jax.tree.map(lambda a: a[0], dealt)
        taken = lambda: step(state, common, view, *static)
        if mesh.size == 1:  # with no view there is no wave
            found = taken()
        else:
            blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(taken)[1])
            found = jax.lax.cond(there, taken, lambda: (state, blank))
        return jax.tree.map(lambda a: a[None], found)

    return map_over_devices(local, (states, wave), common, mesh)


# where lanes leave cores idle, and where they do not
_prepare = [jax.jit(_prepare_lanes, static_argnums=(2, 3, 4), compiler_options=o) for o in (None, MESH_OPTIONS)]
_advance = [
    jax.jit(_advance_lanes, static_argnums=(3, 4, 5), donate_argnums=0, compiler_options=options)
    for options in (None, MESH_OPTIONS)
]


def _of_all(state: Any) -> list[Any]:
    """Every process's, in their order."""
    parts = process_allgather(state)
    return [jax.tree.map(lambda a, p=p: np.asarray(a[p]), parts) for p in range(jax.process_count())]


def map_over_processes(
    count: int,
    rows: Callable[[Sequence[int]], Iterable[Any]],
    progress: Callable[[int, int], None] | None = None,
) -> list[Any]:
    """What `rows` yields for 0 .. count - 1, one after the other: trees of NumPy's arrays and plain values.

    Over several processes that all make the same call (`jax.distributed`), process p of P is asked for p, p + P, ...
    and all end with all rows; in one, it is asked for them all.
    """
    rank, world = jax.process_index(), jax.process_count()
    found = []
    for row in rows(range(rank, count, world)):
        found.append(row)
        if progress is not None:
            progress(min(len(found) * world, count), count)
    if world == 1:
        return found
    parts = [deserialize_tree(part) for part in allgather_bytes(serialize_tree(found))]
    return [parts[t % world][t // world] for t in range(count)]


def cache_worker_programs() -> None:
    """Lets this process, one of several, keep its compiled programs on disk, if it has a folder for them.

    jax leaves that to the first (jax/_src/compiler.py, `_cache_write`). But a program is kept for its device, and every
    process has its own: the others would compile all of theirs at every run.
    """
    from jax._src import distributed

    jax.local_devices()  # from here on jax knows the process by its devices' number
    distributed.global_state.process_id = 0


def serialize_tree(tree: Any) -> bytes:
    """A tree of arrays, plain values, dicts, lists and tuples as one string of bytes, without pickle."""
    arrays: dict[str, np.ndarray] = {}
    description = json.dumps(pack_tree(tree, "root", arrays, lambda kind: None)).encode()
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **{_TREE: np.frombuffer(description, np.uint8)}, **arrays)
    return stream.getvalue()


def deserialize_tree(held: bytes) -> Any:
    """The tree of a `serialize_tree`."""
    with np.load(io.BytesIO(held)) as file:
        arrays = {name: file[name] for name in file.files}
    return unpack_tree(json.loads(arrays.pop(_TREE).tobytes()), arrays, lambda name: dict)


def allgather_bytes(own: bytes) -> list[bytes]:
    """Of each process the bytes that it gave; all processes call it. They may come minutes apart.

    By all_gather, in pieces of at most `_PIECE` bytes, whose lengths are powers of two: jax compiles for each length.
    (Gloo's psum_scatter fails where one comes 30 s after the other: jax issue 40831.)
    """
    if jax.process_count() == 1:
        return [own]
    sizes = process_allgather(np.array(divmod(len(own), 1 << 31), np.int32))
    lengths = [int(high) * (1 << 31) + int(low) for high, low in sizes]
    parts = [bytearray() for _ in lengths]
    for begin in range(0, max(lengths), _PIECE):
        size = min(_PIECE, max(1 << 16, 1 << (max(lengths) - begin - 1).bit_length()))
        piece = np.zeros(size, np.uint8)
        held = np.frombuffer(own[begin : begin + size], np.uint8)
        piece[: len(held)] = held
        for part, row, length in zip(parts, process_allgather(piece), lengths):
            part += row[: max(0, min(size, length - begin))].tobytes()
    return [bytes(part) for part in parts]
