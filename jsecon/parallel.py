"""Both cores: the views, or one view's strips, spread over jax's local devices.

A CPU is one device to jax unless the program says otherwise before jax starts (`process.prepare_process`); the command
line does. The library only uses what it finds.

One view over both devices, under jit: `render(..., mesh=host_mesh())`. Many views: `spread_over_devices`, one view a
device, which shares nothing and so scales better, and over several processes too. What is no program of jax, frame by
frame: `dealt_out`.
"""

import functools
import io
import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import AxisType, Mesh, PartitionSpec

from jsecon.files import packed, unpacked

AXIS = "devices"
"""the mesh's one axis"""
MESH_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""`compiler_options` of jax.jit for a program over a host's mesh. Without them XLA's CPU backend also cuts the kernels
of each device into parts for the threads of all, and such kernels take up to three times as long: projecting 111,785
Gaussians 7.4 instead of 2.6 ms. Programs of one device are better off with the parts."""

_LEAST_LANES = 2
"""of `spread_over_devices`"""
_TREE = "__tree__"
_PIECE = 1 << 26
"""bytes that `exchanged` sends at once"""


def host_mesh() -> Mesh | None:
    """All of this process's devices for one view's tiles, or None where there is but one. A constant to jit."""
    devices = jax.local_devices()
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,)) if len(devices) > 1 else None


def over_devices(local: Callable, dealt: Any, common: Any, mesh: Mesh, *, total: bool = False) -> Any:
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


def over_rows(local: Callable, rows: Any, common: Any, mesh: Mesh | None) -> Any:
    """`local(rows, common)`, row by row independent in every array of `rows` and of the result, each device taking an
    equal part of them; the last part is filled up with zeros, which `local` must bear."""
    if mesh is None:
        return local(rows, common)
    count = jax.tree.leaves(rows)[0].shape[0]
    fill = lambda a: jnp.pad(a, [(0, -count % mesh.size)] + [(0, 0)] * (a.ndim - 1))
    out = over_devices(lambda _, rows, common: local(rows, common), jax.tree.map(fill, rows), common, mesh)
    return jax.tree.map(lambda a: a[:count], out)


def _unbound(arrays: Any) -> Any:
    """The same numbers on the first device, by jax's leave to move them; on a CPU the same memory."""
    return jax.tree.map(lambda a: jax.device_put(np.asarray(a), may_alias=True), arrays)


def spread_over_devices(
    step: Callable,
    start: Any,
    merge: Callable[[Any, Any], Any],
    common: Any,
    views: Any,
    *,
    static: tuple = (),
    most: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Any, list[Any]]:
    """Accumulates `state, out = step(state, common, view, *static)` over the leading axis of `views`, view t in lane
    t mod L; returns the state and each view's `out`, in the views' order.

    There are as many lanes as devices, of all processes, and two at least: one device and two, one process and two, add
    up in the same order, to the same bits. `start` is the neutral state of `merge`, which joins the lanes' states in
    their order. At most `most` devices are used: jax compiles anew for each. Host code; dispatch is asynchronous, so
    the devices work side by side. `progress(done, total)` is called as views finish.

    Over several processes (`jax.distributed.initialize`), each given the same arguments, process p of P takes views p,
    p + P, ...; all end with the same result.
    """
    rank, world = jax.process_index(), jax.process_count()
    count = jax.tree.leaves(views)[0].shape[0]
    own = range(rank, count, world)
    local = min(sum(device.process_index == p for device in jax.devices()) for p in range(world))
    local = max(1, min(local, -(-count // world), local if most is None else most))
    lanes = max(_LEAST_LANES, world * local)
    # The first device is not named, nor is any in what is returned: arrays bound to one have programs of their own.
    devices = [None, *jax.local_devices()[1:local]]
    common, start, views = jax.tree.map(np.asarray, (common, start, views))
    shared = [jax.device_put(common, device) for device in devices]
    place = {lane: (lane // world) % local for lane in range(rank, lanes, world)}
    states = {
        lane: jax.device_put(start, devices[at], may_alias=False) for lane, at in place.items()
    }  # a step takes it
    outs = []
    for first in range(0, len(own), local):
        wave = own[first : first + local]
        for t in wave:
            lane = t % lanes
            view = jax.device_put(jax.tree.map(lambda a, t=t: a[t], views), devices[place[lane]])
            states[lane], out = step(states[lane], shared[place[lane]], view, *static)
            outs.append(out)
        if progress is not None:
            jax.block_until_ready(states)
            progress(min((first + len(wave)) * world, count), count)
    found, outs = _unbound((list(states.values()), outs))
    if world > 1:
        parts = [process_allgather(state) for state in found]
        found = [jax.tree.map(lambda a, p=p: jnp.asarray(a[p]), part) for part in parts for p in range(world)]
        blank = jax.eval_shape(lambda *a: step(*a, *static)[1], start, common, jax.tree.map(lambda a: a[0], views))
        outs += [jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), blank)] * (-(-count // world) - len(own))
        rows = process_allgather(jax.tree.map(lambda *rows: jnp.stack(rows), *outs))
        outs = [jax.tree.map(lambda a, t=t: jnp.asarray(a[t % world, t // world]), rows) for t in range(count)]
    return functools.reduce(merge, found), outs


def dealt_out(
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
    parts = [parcel_read(part) for part in exchanged(parcel(found))]
    return [parts[t % world][t // world] for t in range(count)]


def keep_own_programs() -> None:
    """Lets this process, one of several, keep its compiled programs on disk, if it has a folder for them.

    jax leaves that to the first (jax/_src/compiler.py, `_cache_write`). But a program is kept for its device, and every
    process has its own: the others would compile all of theirs at every run.
    """
    from jax._src import distributed

    jax.local_devices()  # from here on jax knows the process by its devices' number
    distributed.global_state.process_id = 0


def parcel(tree: Any) -> bytes:
    """A tree of arrays, plain values, dicts, lists and tuples as one string of bytes, without pickle."""
    arrays: dict[str, np.ndarray] = {}
    description = json.dumps(packed(tree, "root", arrays, lambda kind: None)).encode()
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **{_TREE: np.frombuffer(description, np.uint8)}, **arrays)
    return stream.getvalue()


def parcel_read(held: bytes) -> Any:
    """The tree of a `parcel`."""
    with np.load(io.BytesIO(held)) as file:
        arrays = {name: file[name] for name in file.files}
    return unpacked(json.loads(arrays.pop(_TREE).tobytes()), arrays, lambda name: dict)


def exchanged(own: bytes) -> list[bytes]:
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
