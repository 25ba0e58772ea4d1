"""What benchmarks share: a row with its tolerance, calls timed in turn, and the table of the rows."""

import statistics
import time
from typing import NamedTuple

import jax


class Metric(NamedTuple):
    """One row of the contract."""

    key: str
    value: float
    unit: str
    direction: str
    """lower or higher is better"""
    tolerance: float
    """share by which the value may be worse than the baseline"""
    note: str = ""


def interleaved(functions: dict, repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Median ms of each call, taken in turn, and the seconds of each first call (compilation). A call that returns a
    number has timed itself."""
    compile_s, taken = {}, {name: [] for name in functions}
    for name, call in functions.items():
        start = time.perf_counter()
        jax.block_until_ready(call())
        compile_s[name] = time.perf_counter() - start
    for _ in range(repeats):
        for name, call in functions.items():
            start = time.perf_counter()
            out = jax.block_until_ready(call())
            taken[name].append(out if isinstance(out, float) else 1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in taken.items()}, compile_s


def show(rows: list[Metric]) -> None:
    """Prints what the rows were measured on, and the rows."""
    print(f"jax {jax.__version__}, {jax.local_device_count()} {jax.default_backend()} device(s)")
    print("| what | figure | unit | beside it |\n|---|---|---|---|")
    for row in rows:
        print(f"| {row.key} | {row.value:.3g} | {row.unit} | {row.note} |")
