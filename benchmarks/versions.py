"""The engine under several versions of jax, call by call in turn.

    python benchmarks/versions.py .venv/bin/python /tmp/newest/bin/python [--repeats 15]

Each interpreter runs a process of its own, of one jax device pinned to one core, which makes a call when it is told to:
so each call of one stands beside the same call of the others. Process time, the lowest of the repeats, which other work
disturbs less than the clock; and the error against float64. The scene is the garden where it is at hand, else made up.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from jsecon.process import prepare_process

HOME = Path(__file__).resolve().parent.parent


def calls() -> tuple[str, dict[str, Callable], Callable[[], float]]:
    """(the scene and versions, what is timed by name, the median error of a rendered feature)."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from scenes import ball, garden

    import jsecon
    from jsecon.splat.plan import plan_view, render_plan

    found = garden()
    gaussians, camera = ball(20_000, (0.005, 0.05), 320, 240, 300) if found is None else found[:2]
    rng = np.random.default_rng(1)
    features = {d: jnp.asarray(rng.normal(size=(gaussians.count, d)), jnp.float32) for d in (3, 32)}
    capacity = jsecon.plan_capacity(gaussians, camera, margin=1.0)
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, camera))

    def rendered(g, f):
        return jsecon.render(g, camera, f, capacity=capacity).features

    plan = plan_view(gaussians, camera, capacity=capacity)
    forward, planned = jax.jit(rendered), jax.jit(lambda plan, f: render_plan(plan, f).features)
    by_features = jax.jit(jax.grad(lambda f, plan: (render_plan(plan, f).features ** 2).sum()))
    by_all = jax.jit(jax.grad(lambda g, f: (rendered(g, f) ** 2).sum(), argnums=(0, 1)))

    def error() -> float:
        with jax.enable_x64(True):
            wide = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), jnp.float64), (gaussians, camera, features[3]))
            exact = np.asarray(jsecon.render(*wide, capacity=capacity).features)
        return float(np.median(np.abs(np.asarray(forward(gaussians, features[3])) - exact)))

    scene = "made-up 20k 320x240" if found is None else "garden 648x420"
    return (
        f"jax {jax.__version__}, Python {sys.version.split()[0]}, {scene}",
        {
            "forward, D = 3": lambda: forward(gaussians, features[3]),
            "forward, D = 32": lambda: forward(gaussians, features[32]),
            "planned forward, D = 3": lambda: planned(plan, features[3]),
            "planned forward and backward of features": lambda: by_features(features[3], plan),
            "forward and backward of everything": lambda: by_all(gaussians, features[3]),
        },
        error,
    )


def serve() -> None:
    """In a child: compiles all, tells it, then makes each call that is asked for."""
    os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=1"
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    prepare_process(keep_programs=False)
    import jax

    where, timed, error = calls()
    first = {}
    for name, call in timed.items():
        began = time.process_time()
        jax.block_until_ready(call())
        first[name] = time.process_time() - began
    print(json.dumps({"where": where, "first": first, "error": error()}), flush=True)
    for line in sys.stdin:
        began = time.process_time()
        jax.block_until_ready(timed[line.rstrip("\n")]())
        print(json.dumps(1e3 * (time.process_time() - began)), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pythons", nargs="*", metavar="PYTHON")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        serve()
        return 0
    environ = {**os.environ, "PYTHONPATH": str(HOME)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environ}
    children = [subprocess.Popen([python, __file__, "--serve"], **pipes) for python in asked.pythons]
    told = [json.loads(child.stdout.readline()) for child in children]
    lowest = {name: [float("inf")] * len(children) for name in told[0]["first"]}
    for _ in range(asked.repeats):
        for name, row in lowest.items():
            for k, child in enumerate(children):
                child.stdin.write(name + "\n")
                child.stdin.flush()
                row[k] = min(row[k], json.loads(child.stdout.readline()))
    for child in children:
        child.stdin.close()
        child.wait()
    print("| ms on one core |", *(f"{one['where']} |" for one in told))
    print("|---" * (len(children) + 1) + "|")
    for name, row in lowest.items():
        print(f"| {name} |", *(f"{value:.1f} |" for value in row))
    print("| all compiled, s |", *(f"{sum(one['first'].values()):.1f} |" for one in told))
    print("| median error of a unit feature |", *(f"{one['error']:.2g} |" for one in told))
    return 0


if __name__ == "__main__":
    sys.exit(main())
