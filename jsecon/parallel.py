"""Both cores: the views, or one view's batches of tiles, spread over jax's local devices.

A CPU is one device to jax unless the program says otherwise before jax starts
(XLA_FLAGS=--xla_force_host_platform_device_count=2); the command line does. The library only uses what it finds.

One view over both devices, under jit: `render(..., mesh=host_mesh())`. Many views: `spread_over_devices`, one view a
device, which shares nothing and so scales better.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec

AXIS = "batches"
"""the mesh's one axis: batches of tiles"""


def host_mesh() -> Mesh | None:
    """All of this process's devices for one view's tiles, or None where there is but one. A constant to jit."""
    devices = jax.local_devices()
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,)) if len(devices) > 1 else None


def over_batches(
    local: Callable, batches: jax.Array, common: tuple, mesh: Mesh | None, *, total: bool = False
) -> jax.Array:
    """`local(share of batches, *common)` on every device of `mesh`, the shares' results joined along their leading
    axis, or added up where `total`. On one device, without a mesh, `local(batches, *common)`."""
    if mesh is None:
        return local(batches, *common)

    def run(batches, *common):
        out = local(batches, *common)
        return jax.lax.psum(out, AXIS) if total else out

    # The carries of a walk start as constants, which the check of varying axes would have to be told of one by one.
    sharded = PartitionSpec(AXIS)
    return jax.shard_map(
        run,
        mesh=mesh,
        in_specs=(sharded, *(PartitionSpec() for _ in common)),
        out_specs=PartitionSpec() if total else sharded,
        check_vma=False,
    )(batches, *common)


def spread_over_devices(
    step: Callable,
    start: Any,
    merge: Callable[[Any, Any], Any],
    common: Any,
    views: Any,
    *,
    static: tuple = (),
    progress: Callable[[int, int], None] | None = None,
) -> Any:
    """Accumulates `state = step(state, common, view, *static)` over the leading axis of `views`, view t on device t
    mod D.

    `start` is the neutral state of `merge`, which joins the devices' states pairwise in device order. Host code;
    dispatch is asynchronous, so the devices work side by side. `progress(done, total)` is called as views finish.
    """
    leaves = jax.tree.leaves(views)
    count = leaves[0].shape[0]
    devices = jax.local_devices()[: max(1, min(count, jax.local_device_count()))]
    shared = [jax.device_put(common, device) for device in devices]
    states = [jax.tree.map(lambda a, d=device: jax.device_put(a, d).copy(), start) for device in devices]
    waves = range(0, count, len(devices))
    for first in waves:
        wave = range(first, min(first + len(devices), count))
        for index, t in enumerate(wave):
            view = jax.device_put(jax.tree.map(lambda a, t=t: a[t], views), devices[index])
            states[index] = step(states[index], shared[index], view, *static)
        if progress is not None:
            jax.block_until_ready(states)
            progress(wave.stop, count)
    total = states[0]
    for state in states[1:]:
        total = merge(total, jax.device_put(state, devices[0]))
    return total
