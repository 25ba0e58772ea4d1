"""Both cores: work over the views, spread over jax's local devices.

A CPU is one device to jax unless the program says otherwise before jax starts
(XLA_FLAGS=--xla_force_host_platform_device_count=2); the command line does. The library only uses what it finds.
"""

from collections.abc import Callable
from typing import Any

import jax


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
