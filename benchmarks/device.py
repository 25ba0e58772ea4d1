"""The same code on another device of jax (a GPU): does it agree with the CPU, and how long does it take?

    python benchmarks/device.py [--scene ../shared/splats/garden] [--repeats 9]

Renders garden's view 0 and its gradient with respect to everything on jax's default device and on the CPU, and compares
both with each other and, where there is one, with reference.npz (float64). Times are medians, compilation apart.
"""

import argparse
import statistics
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scenes import GARDEN, garden

import jsecon


def measure(device, gaussians, camera, features, capacity: int, repeats: int) -> dict:
    """Image, gradients, and ms of each call on `device`."""
    gaussians, camera, features = jax.device_put((gaussians, camera, features), device)
    forward = jax.jit(lambda g, f: jsecon.render(g, camera, f, capacity=capacity).features)

    def loss(g, f):
        return (forward(g, f) ** 2).sum()

    plan = jsecon.plan_view(gaussians, camera, capacity=capacity)
    planned = jax.jit(lambda f: jsecon.render_plan(plan, f).features)
    wide = jnp.tile(features, (1, 11))[:, :32]
    labels = jax.device_put(np.arange(camera.width * camera.height, dtype=np.int32) // 997 % 40, device)
    labels = labels.reshape(1, camera.height, camera.width)
    views = jax.tree.map(lambda a: jnp.asarray(a)[None], camera)
    by_all = jax.jit(jax.grad(loss, argnums=(0, 1)))
    votes = jax.jit(lambda g, c, x: jsecon.region_votes(g, c, x, 40, capacity=capacity).weights)
    calls = {
        "forward, D=3": lambda: forward(gaussians, features),
        "forward, D=32": lambda: forward(gaussians, wide),
        "planned forward, D=3": lambda: planned(features),
        "forward and backward of everything, D=3": lambda: by_all(gaussians, features),
        "votes of one view, 40 regions": lambda: votes(gaussians, views, labels),
    }
    out, ms = {}, {}
    for name, call in calls.items():
        out[name] = jax.tree.map(np.asarray, jax.block_until_ready(call()))
        taken = []
        for _ in range(repeats):
            start = time.perf_counter()
            jax.block_until_ready(call())
            taken.append(1e3 * (time.perf_counter() - start))
        ms[name] = statistics.median(taken)
    return {"out": out, "ms": ms}


def relative(a: np.ndarray, b: np.ndarray) -> float:
    """Relative L2 distance."""
    return float(np.linalg.norm(a.astype(np.float64) - b) / max(np.linalg.norm(b.astype(np.float64)), 1e-30))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=GARDEN)
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    scene = garden(arguments.scene)
    if scene is None:
        parser.error(f"no scene.npz in {arguments.scene}")
    gaussians, camera, features = scene
    cpu, device = jax.devices("cpu")[0], jax.devices()[0]
    with jax.default_device(cpu):
        capacity = jsecon.plan_capacity(gaussians, camera, margin=1.0)
        on_cpu = measure(cpu, gaussians, camera, features, capacity, arguments.repeats)
    on_device = measure(device, gaussians, camera, features, capacity, arguments.repeats)
    print(f"jax {jax.__version__}, {device.device_kind} against this machine's CPU (one jax device)")
    print("| what | device ms | CPU ms | relative L2 difference |\n|---|---|---|---|")
    for name, there in on_device["out"].items():
        here = on_cpu["out"][name]
        worst = max(relative(a, b) for a, b in zip(jax.tree.leaves(there), jax.tree.leaves(here), strict=True))
        print(f"| {name} | {on_device['ms'][name]:.1f} | {on_cpu['ms'][name]:.1f} | {worst:.1e} |")
    reference = arguments.scene / "reference.npz"
    if reference.exists():
        true = np.load(reference)
        error = np.abs(on_device["out"]["forward, D=3"] - true["image"]).max(-1)
        print(f"{100 * np.mean(error <= 2e-5):.3f} % of pixels within 2e-5 of the float64 reference, on the device")


if __name__ == "__main__":
    main()
