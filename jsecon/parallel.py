"""Runs work on all cores: views, or the strips of one view, are spread over jax's local devices.

A CPU is one device to jax unless the program asks for more before jax starts (`process.prepare_process`), as the
command line does. The library only uses the devices that it has.

One view on all devices, under jit: `render(..., mesh=host_mesh())`. Many views: `map_views`, one view on each core,
which needs no exchange and so scales better, also over several processes. Work on the host, frame by frame:
`map_over_processes`. Each works with any number of devices, and compiles once for all of them.
"""

import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import AxisType, Mesh, PartitionSpec

from jsecon.files import pack_tree, unpack_tree
from jsecon.process import VIEWS_AT_ONCE, cores
from jsecon.types import Progress

AXIS = "devices"
"""name of the only axis of the mesh"""
MESH_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""`compiler_options` of jax.jit for a program on a host's mesh. Without them XLA's CPU backend also cuts the kernels of
each device into parts for the threads of all, and such kernels take up to three times as long: projecting 111,785
Gaussians 7.4 instead of 2.6 ms. Programs on one device are faster with the parts."""


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


def map_views(count: int, view: Callable[[int], Any], progress: Progress | None = None) -> list[Any]:
    """Maps a host function over the indices of views, on the cores of all processes; see `map_over_processes`.

    Threads call it, so that one view's work on the host runs beside the compiled program of another. The first view is
    computed alone: threads that start together would each compile the same programs.
    """

    def on_cores(indices: Sequence[int]) -> Iterator[Any]:
        yield from map(view, indices[:1])
        pool = ThreadPoolExecutor(min(cores(), VIEWS_AT_ONCE))
        try:
            yield from pool.map(view, indices[1:])
        finally:
            pool.shutdown(cancel_futures=True)

    return map_over_processes(count, on_cores, progress)


def allgather_tree(tree: Any) -> list[Any]:
    """Exchanges trees between the processes, without pickle: all call it, minutes apart if need be."""
    arrays: dict[str, np.ndarray] = {}
    description = json.dumps(pack_tree(tree, "root", arrays)).encode()
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **{"__tree__": np.frombuffer(description, np.uint8)}, **arrays)
    return [_deserialize(data) for data in _allgather_bytes(stream.getvalue())]


def _deserialize(data: bytes) -> Any:
    """The tree in the bytes of one process."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    return unpack_tree(json.loads(arrays.pop("__tree__").tobytes()), arrays)


def _allgather_bytes(data: bytes) -> list[bytes]:
    """Exchanges bytes, in pieces of one size, as jax compiles for each.

    It uses all_gather: Gloo's psum_scatter fails if one process comes 30 s after the other (jax issue 40831).
    """
    if jax.process_count() == 1:
        return [data]
    size = 1 << 22
    my_size = np.array(divmod(len(data), size), np.int32)
    lengths = [int(pieces) * size + int(rest) for pieces, rest in process_allgather(my_size)]
    parts = [bytearray() for _ in lengths]
    for begin in range(0, max(lengths), size):
        mine = np.frombuffer(data[begin : begin + size], np.uint8)
        for part, row in zip(parts, process_allgather(np.pad(mine, (0, size - len(mine))))):
            part += row.tobytes()
    return [bytes(part[:length]) for part, length in zip(parts, lengths)]
