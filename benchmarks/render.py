"""Rendering speed with its error beside it.

    python benchmarks/render.py [--repeats 9] [--gate] [--update]

Each row is a ratio of medians, its calls taken in turn in one run, so that the machine's speed cancels; milliseconds
stand beside it. Where ../shared/limit and g++ are at hand, the hand-laid AVX-512 compositor takes the same tile lists,
in turn with the rest, on every core. Errors are against the same functions in float64, which the tests hold equal to
the brute-force sum. `--gate` exits 1 where a ratio left its tolerance of benchmarks/baseline.json.

The process is prepared as the command line prepares it (jsecon/process.py): a host device a core, 512-bit vectors,
freed memory kept; unless XLA_FLAGS and MALLOC_* say otherwise.
"""

import argparse
import atexit
import functools
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from jsecon.process import prepare_process

prepare_process(keep_programs=False)

import jax
import jax.numpy as jnp
import numpy as np
from metrics import Metric, interleaved, show
from scenes import GARDEN, ball, garden

import jsecon
from jsecon.parallel import MESH_OPTIONS, host_mesh
from jsecon.splat.composite import composite
from jsecon.splat.plan import plan_view, render_plan
from jsecon.types import Camera, Gaussians

BASELINE = Path(__file__).resolve().with_name("baseline.json")


def measure(name: str, gaussians: Gaussians, camera: Camera, repeats: int) -> list[Metric]:
    """All rows of one scene."""
    mesh = host_mesh()
    capacity = jsecon.plan_capacity(gaussians, camera, margin=1.0)
    rng = np.random.default_rng(1)
    features = {d: jnp.asarray(rng.normal(size=(gaussians.count, d)), jnp.float32) for d in (3, 16, 32)}
    narrow = features[3]
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, camera))
    calls = {}
    for devices, spread in (("1 device", None), (f"{jax.local_device_count()} devices", mesh)):
        if devices in [key.split(", ")[-1] for key in calls]:
            continue
        jit = functools.partial(jax.jit, compiler_options=None if spread is None else MESH_OPTIONS)

        def rendered(g, f, m=spread):
            return jsecon.render(g, camera, f, capacity=capacity, mesh=m).features

        forward, loss = jit(rendered), lambda g, f, rendered=rendered: (rendered(g, f) ** 2).sum()
        plan = plan_view(gaussians, camera, capacity=capacity, mesh=spread)
        planned = jit(lambda plan, f: render_plan(plan, f).features)

        def planned_loss(f, plan):
            return (render_plan(plan, f).features ** 2).sum()

        alone = jit(lambda plan, f, m=spread: composite(plan.splats, f, plan.lists, camera.width, camera.height, m))
        by_all, by_features = jit(jax.grad(loss, argnums=(0, 1))), jit(jax.grad(planned_loss))
        calls |= {
            f"forward, {devices}": lambda forward=forward: forward(gaussians, narrow),
            f"forward D=16, {devices}": lambda forward=forward: forward(gaussians, features[16]),
            f"forward D=32, {devices}": lambda forward=forward: forward(gaussians, features[32]),
            f"compositing, {devices}": lambda alone=alone, plan=plan: alone(plan, narrow),
            f"planned forward, {devices}": lambda planned=planned, plan=plan: planned(plan, narrow),
            f"planned forward and backward of features, {devices}": lambda g=by_features, plan=plan: g(narrow, plan),
            f"forward and backward of everything, {devices}": lambda g=by_all: g(gaussians, narrow),
        }
    cameras = nearby(camera, 8)
    single = jax.jit(lambda camera: jsecon.render(gaussians, camera, narrow, capacity=2 * capacity).features)
    eight = jax.jit(jax.vmap(lambda camera: jsecon.render(gaussians, camera, narrow, capacity=2 * capacity).features))
    calls["8 single renders"] = lambda: [single(cameras[t]) for t in range(8)]
    calls["8 views by vmap"] = lambda: eight(cameras)
    bound = hand_laid(plan_view(gaussians, camera, capacity=capacity), narrow, camera)
    if bound is not None:
        calls["hand-laid bound"] = bound
    ms, compile_s = interleaved(calls, repeats)

    with jax.enable_x64(True):
        wide = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), jnp.float64), (gaussians, camera, narrow))
        exact = np.asarray(jsecon.render(*wide).features)
    rendered = np.asarray(jsecon.render(gaussians, camera, narrow, capacity=capacity, mesh=mesh).features)
    error = np.abs(rendered - exact).max(-1)

    best = f"{jax.local_device_count()} devices" if mesh is not None else "1 device"
    ratios = {
        "D=16 against D=3": (f"forward D=16, {best}", f"forward, {best}"),
        "D=32 against D=3": (f"forward D=32, {best}", f"forward, {best}"),
        "features, forward and backward with a plan, against the planned forward": (
            f"planned forward and backward of features, {best}",
            f"planned forward, {best}",
        ),
        "everything, forward and backward, against the forward": (
            f"forward and backward of everything, {best}",
            f"forward, {best}",
        ),
        "8 views by vmap against 8 single renders": ("8 views by vmap", "8 single renders"),
    }
    if mesh is not None:
        ratios["compositing, all devices against one"] = (f"compositing, {best}", "compositing, 1 device")
    if bound is not None:
        for devices in dict.fromkeys(("1 device", best)):
            ratios |= {
                f"compositing against the bound, {devices}": (f"compositing, {devices}", "hand-laid bound"),
                f"whole forward against the bound, {devices}": (f"forward, {devices}", "hand-laid bound"),
                f"forward and backward of everything against the bound, {devices}": (
                    f"forward and backward of everything, {devices}",
                    "hand-laid bound",
                ),
            }
    rows = [
        Metric(f"{name}/{key}", ms[a] / ms[b], "x", "lower", 0.5, f"{ms[a]:.1f} ms / {ms[b]:.1f} ms")
        for key, (a, b) in ratios.items()
    ]
    first = {key: value for key, value in compile_s.items() if key != "hand-laid bound"}
    slowest = max(first, key=first.get)
    rows.append(
        Metric(
            f"{name}/first call of a forward render, compilation included",
            compile_s["forward, 1 device"],
            "s",
            "lower",
            2.0,
            f"longest of all rows: {slowest}, {first[slowest]:.1f} s",
        )
    )
    rows.append(
        Metric(f"{name}/median error", float(np.median(error)), "of a unit feature", "lower", 1.0, spread_of(error))
    )
    return rows


def spread_of(error: np.ndarray) -> str:
    return f"99.9 % within {np.quantile(error, 0.999):.2g}, largest {error.max():.2g}"


def nearby(camera: Camera, count: int) -> Camera:
    """A batch of `count` cameras, each a little further to the side."""
    poses = np.tile(np.asarray(camera.world_to_camera), (count, 1, 1))
    poses[:, 0, 3] += 0.02 * np.arange(count)

    def repeat(a):
        return jnp.tile(jnp.asarray(a), count)

    return Camera(
        jnp.asarray(poses), *(repeat(a) for a in (camera.fx, camera.fy, camera.cx, camera.cy)), camera.width,
        camera.height,
    )  # fmt: skip


def hand_laid(plan, features, camera: Camera):
    """A call that returns the ms that ../shared/limit takes on the plan's lists, or None where it can't be built."""
    source = GARDEN.parent.parent / "limit" / "limit.cpp"
    if not source.exists() or shutil.which("g++") is None:
        return None
    s, lengths = np.asarray(plan.splats), np.asarray(plan.lists.lengths)
    l11, l21, l22 = (np.sqrt(2) * s[:, i] for i in (2, 3, 4))
    rows = np.stack([s[:, 0], s[:, 1], l11 * l11, l11 * l21, l21 * l21 + l22 * l22, s[:, 5]], 1).astype(np.float32)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    within = np.arange(starts[-1]) - np.repeat(starts[:-1], lengths)
    ids = np.asarray(plan.lists.gaussians)[np.repeat(np.asarray(plan.lists.starts), lengths) + within]
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    program, scene = folder / "limit", folder / "scene.bin"
    built = subprocess.run(
        ["g++", "-O3", "-march=native", "-fopenmp", str(source), "-o", str(program)], capture_output=True
    )
    if built.returncode:
        return None
    header = [camera.width, camera.height, plan.lists.tile, len(lengths), int(starts[-1]), len(s), features.shape[1]]
    with scene.open("wb") as file:
        for array in (np.array(header, np.int32), rows, np.asarray(features, np.float32), ids, starts):
            array.tofile(file)

    def call() -> float:
        done = subprocess.run([program, scene, folder / "out", "5"], capture_output=True, text=True, check=True)
        return float(done.stdout.split("median")[1].split()[0])

    return call


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--gate", action="store_true", help="exit 1 where a figure is worse than the baseline allows")
    parser.add_argument("--update", action="store_true", help="write benchmarks/baseline.json")
    arguments = parser.parse_args()
    rows = measure("made-up 20k 320x240", *ball(20_000, (0.005, 0.05), 320, 240, 300), arguments.repeats)
    scene = garden()
    if scene is not None:
        rows += measure("garden 648x420", *scene[:2], arguments.repeats)
    show(rows)
    if arguments.update:
        BASELINE.write_text(json.dumps({row.key: row._asdict() for row in rows}, indent=1) + "\n")
    if arguments.gate:
        known = json.loads(BASELINE.read_text())
        worse = [r.key for r in rows if r.key in known and r.value > known[r.key]["value"] * (1 + r.tolerance)]
        print("worse than the baseline:", worse or "nothing")
        return int(bool(worse))
    return 0


if __name__ == "__main__":
    sys.exit(main())
