"""Rendering speed with its error beside it.

    python benchmarks/render.py [--gate] [--update]

Each row is a ratio of medians to the forward render at D = 3 of the same scene in the same run (interleaved), so that
the
machine's speed cancels; milliseconds stand beside it. Errors are against the same functions in float64, which the tests
hold equal to the brute-force sum. Where ../shared/limit and g++ are at hand, the hand-laid AVX-512 compositor takes the
same tile lists in the same run. `--gate` exits 1 where a ratio left its tolerance of benchmarks/baseline.json.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jsecon
from jsecon.splat.composite import composite
from jsecon.splat.splats import splats_of
from jsecon.types import Camera, Gaussians

HOME = Path(__file__).resolve().parent
SHARED = HOME.parent.parent / "shared"


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


def made_up_scene(count: int = 20_000, width: int = 320, height: int = 240) -> tuple[Gaussians, Camera]:
    """Gaussians in a ball before a camera, sizes and turns at random."""
    rng = np.random.default_rng(0)
    gaussians = Gaussians(
        rng.normal(size=(count, 3)).astype(np.float32),
        np.log(rng.uniform(0.005, 0.05, (count, 3))).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = 4
    return gaussians, Camera(pose, *(np.float32(v) for v in (300, 300, width / 2, height / 2)), width, height)


def garden() -> tuple[Gaussians, Camera] | None:
    """The reference scene beside the checkout, view 0, or None."""
    path = SHARED / "splats" / "garden" / "scene.npz"
    if not path.exists():
        return None
    d = np.load(path)
    opacity = d["opacities"].astype(np.float64)
    gaussians = Gaussians(
        d["means"].astype(np.float32),
        np.log(d["scales"]).astype(np.float32),
        d["quats"].astype(np.float32),
        (np.log(opacity) - np.log1p(-opacity)).astype(np.float32),
        np.zeros((len(opacity), 1, 3), np.float32),
    )
    k = d["Ks"][0].astype(np.float32)
    return gaussians, Camera(
        d["viewmats"][0].astype(np.float32), k[0, 0], k[1, 1], k[0, 2], k[1, 2], int(d["width"]), int(d["height"])
    )


def interleaved(functions: dict, repeats: int) -> tuple[dict[str, float], dict[str, float]]:
    """Median ms of each call, taken in turn, and the seconds of each first call (compilation)."""
    compile_s, taken = {}, {name: [] for name in functions}
    for name, call in functions.items():
        start = time.perf_counter()
        jax.block_until_ready(call())
        compile_s[name] = time.perf_counter() - start
    for _ in range(repeats):
        for name, call in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            taken[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in taken.items()}, compile_s


def measure(name: str, gaussians: Gaussians, camera: Camera, repeats: int) -> list[Metric]:
    """All rows of one scene."""
    capacity = jsecon.plan_capacity(gaussians, camera, margin=1.0)
    rng = np.random.default_rng(1)
    features = {d: jnp.asarray(rng.normal(size=(gaussians.count, d)), jnp.float32) for d in (3, 16, 32)}
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, camera))
    forward = jax.jit(lambda g, f: jsecon.render(g, camera, f, capacity=capacity).features)
    loss = lambda g, f: (jsecon.render(g, camera, f, capacity=capacity).features ** 2).sum()
    by_all, by_features = jax.jit(jax.grad(loss, argnums=(0, 1))), jax.jit(jax.grad(loss, argnums=1))
    splats, lists = jax.jit(lambda g: splats_of(g, camera, capacity=capacity))(gaussians)
    alone = jax.jit(lambda s, f, lists: composite(s, f, lists, camera.width, camera.height))
    milliseconds, compile_s = interleaved(
        {
            "forward D=3": lambda: forward(gaussians, features[3]),
            "forward D=16": lambda: forward(gaussians, features[16]),
            "forward D=32": lambda: forward(gaussians, features[32]),
            "compositing alone D=3": lambda: alone(splats, features[3], lists),
            "forward and backward, features D=3": lambda: by_features(gaussians, features[3]),
            "forward and backward, everything D=3": lambda: by_all(gaussians, features[3]),
        },
        repeats,
    )
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), jnp.float64), (gaussians, camera, features[3]))
        exact = np.asarray(jsecon.render(wide[0], wide[1], wide[2]).features)
    error = np.abs(np.asarray(forward(gaussians, features[3])) - exact).max(-1)
    base = milliseconds["forward D=3"]
    rows = [
        Metric(
            f"{name}/{key}",
            value / base,
            "x forward D=3",
            "lower",
            0.5,
            f"{value:.1f} ms, first call {compile_s[key]:.1f} s",
        )
        for key, value in milliseconds.items()
    ]
    rows.append(
        Metric(
            f"{name}/median error",
            float(np.median(error)),
            "of a unit feature",
            "lower",
            1.0,
            f"largest {error.max():.2g}",
        )
    )
    limit = hand_laid(splats, lists, features[3], camera, repeats)
    if limit is not None:
        rows.append(
            Metric(
                f"{name}/compositing alone against the hand-laid bound",
                milliseconds["compositing alone D=3"] / limit,
                "x",
                "lower",
                0.5,
                f"bound {limit:.1f} ms on {os.cpu_count()} cores, ours on one jax device",
            )
        )
        rows.append(Metric(f"{name}/whole forward against the hand-laid bound", base / limit, "x", "lower", 0.5))
    return rows


def hand_laid(splats, lists, features, camera: Camera, repeats: int) -> float | None:
    """Median ms of ../shared/limit on the same lists, or None where it can't be built."""
    source = SHARED / "limit" / "limit.cpp"
    if not source.exists() or shutil.which("g++") is None:
        return None
    s, starts = np.asarray(splats), np.asarray(lists.starts, np.int32)
    l11, l21, l22 = (np.sqrt(2) * s[:, i] for i in (2, 3, 4))
    rows = np.stack([s[:, 0], s[:, 1], l11 * l11, l11 * l21, l21 * l21 + l22 * l22, s[:, 5]], 1).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        program, scene = Path(folder) / "limit", Path(folder) / "scene.bin"
        built = subprocess.run(
            ["g++", "-O3", "-march=native", "-fopenmp", str(source), "-o", str(program)], capture_output=True
        )
        if built.returncode:
            return None
        header = [camera.width, camera.height, lists.tile, len(starts) - 1, int(starts[-1]), len(s), features.shape[1]]
        with scene.open("wb") as file:
            for array in (
                np.array(header, np.int32),
                rows,
                np.asarray(features, np.float32),
                np.asarray(lists.gaussians)[: starts[-1]],
                starts,
            ):
                array.tofile(file)
        done = subprocess.run([program, scene, Path(folder) / "out", str(repeats)], capture_output=True, text=True)
    return float(done.stdout.split("median")[1].split()[0]) if done.returncode == 0 else None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--gate", action="store_true", help="exit 1 where a figure is worse than the baseline allows")
    parser.add_argument("--update", action="store_true", help="write benchmarks/baseline.json")
    arguments = parser.parse_args()
    scenes = {"made-up 20k 320x240": made_up_scene(), "garden 648x420": garden()}
    rows = [
        row for name, scene in scenes.items() if scene is not None for row in measure(name, *scene, arguments.repeats)
    ]
    print(f"jax {jax.__version__}, {jax.local_device_count()} {jax.default_backend()} device(s)")
    print("| what | figure | unit | beside it |\n|---|---|---|---|")
    for row in rows:
        print(f"| {row.key} | {row.value:.3g} | {row.unit} | {row.note} |")
    path = HOME / "baseline.json"
    if arguments.update:
        path.write_text(json.dumps({row.key: row._asdict() for row in rows}, indent=1) + "\n")
    if arguments.gate:
        baseline = json.loads(path.read_text())
        worse = [
            row.key
            for row in rows
            if row.key in baseline and row.value > baseline[row.key]["value"] * (1 + row.tolerance)
        ]
        print("worse than the baseline:", worse or "nothing")
        return int(bool(worse))
    return 0


if __name__ == "__main__":
    sys.exit(main())
