"""Both cores: the views, or one view's strips, spread over jax's local devices.

A CPU is one device to jax unless the program says otherwise before jax starts (`process.prepare_process`); the command
line does. The library only uses what it finds.

One view over both devices, under jit: `render(..., mesh=host_mesh())`. Many views: `spread_over_devices`, one view a
device, which shares nothing and so scales better, and over several processes too.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import AxisType, Mesh, PartitionSpec

AXIS = "devices"
"""the mesh's one axis"""
MESH_OPTIONS = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
"""`compiler_options` of jax.jit for a program over a host's mesh. Without them XLA's CPU backend also cuts the kernels
of each device into parts for the threads of all, and such kernels take up to three times as long: projecting 111,785
Gaussians 7.4 instead of 2.6 ms. Programs of one device are better off with the parts."""


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
    """Accumulates `state, out = step(state, common, view, *static)` over the leading axis of `views`, view t on device
    t mod D; returns the state and each view's `out`, in the views' order.

    `start` is the neutral state of `merge`, which joins the devices' states pairwise in device order. At most `most`
    devices are used: jax compiles anew for each. Host code; dispatch is asynchronous, so the devices work side by side.
    `progress(done, total)` is called as views finish.

    Over several processes (`jax.distributed.initialize`), each given the same arguments, process p of P takes views p,
    p + P, ...; all end with the same result.
    """
    rank, world = jax.process_index(), jax.process_count()
    count = jax.tree.leaves(views)[0].shape[0]
    own = range(rank, count, world)
    # The first device is not named, nor is any in what is returned: arrays bound to one have programs of their own.
    devices = [None, *jax.local_devices()[1 : len(own)][: None if most is None else most - 1]]
    common, start, views = jax.tree.map(np.asarray, (common, start, views))
    shared = [jax.device_put(common, device) for device in devices]
    states = [jax.device_put(start, device, may_alias=False) for device in devices]  # each its own: a step takes it
    outs = []
    for first in range(0, len(own), len(devices)):
        wave = own[first : first + len(devices)]
        for index, t in enumerate(wave):
            view = jax.device_put(jax.tree.map(lambda a, t=t: a[t], views), devices[index])
            states[index], out = step(states[index], shared[index], view, *static)
            outs.append(out)
        if progress is not None:
            jax.block_until_ready(states)
            progress(min((first + len(wave)) * world, count), count)
    total = states[0]
    for state in states[1:]:
        total = merge(total, _unbound(state))
    total, outs = _unbound((total, outs))
    if world == 1:
        return total, outs
    parts = process_allgather(total)
    total = jax.tree.map(lambda a: jnp.asarray(a[0]), parts)
    for p in range(1, world):
        total = merge(total, jax.tree.map(lambda a, p=p: jnp.asarray(a[p]), parts))
    blank = jax.eval_shape(lambda *given: step(*given, *static)[1], start, common, jax.tree.map(lambda a: a[0], views))
    outs += [jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), blank)] * (-(-count // world) - len(own))
    parts = process_allgather(jax.tree.map(lambda *rows: jnp.stack(rows), *outs))
    return total, [jax.tree.map(lambda a, t=t: jnp.asarray(a[t % world, t // world]), parts) for t in range(count)]
