"""Frees compiled programs before a long experiment runs out of memory maps."""

import gc
from pathlib import Path

import jax


def clear_programs(*, above: int = 25_000) -> None:
    """Frees jax's compiled programs if the process has more than `above` memory maps, which Linux counts.

    Linux allows a process 65,530 of them and XLA takes several a program: one that sees scene after scene, each with
    sizes of its own, ends in "Unable to allocate section memory". Programs are compiled again, or read from disk, when
    they are next called.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > above:
        jax.clear_caches()
        gc.collect()
