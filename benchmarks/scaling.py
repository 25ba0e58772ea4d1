"""How a forward render grows with Gaussians, pixels and channels: time, pairs, peak memory.

    python benchmarks/scaling.py [--largest 5000000] [--repeats 3]

Each size runs in a process of its own, so that its peak memory is its own; compile time stands apart. The scene is a
ball of Gaussians before the camera whose sizes shrink with their number, as a scene's do: about the same coverage.
Times are medians, in ms; ns a pair = time over (tile, Gaussian) pairs, 8x8 px a tile.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time

SIZES = {
    "N": [(count, 1920, 1080, 3) for count in (10_000, 100_000, 1_000_000, 5_000_000)],
    "pixels": [(200_000, *size, 3) for size in ((480, 270), (960, 540), (1920, 1080), (3840, 2160))],
    "D": [(100_000, 640, 360, channels) for channels in (1, 3, 8, 16, 32, 64, 128, 512)],
}


def one(count: int, width: int, height: int, channels: int, repeats: int) -> dict:
    """Renders one size in this process, prepared as the command line prepares it, over all its devices."""
    from jsecon.process import peak_memory_mib, prepare_process

    prepare_process(keep_programs=False)
    import jax
    import jax.numpy as jnp
    import numpy as np
    from scenes import ball

    import jsecon
    from jsecon.parallel import MESH_OPTIONS, host_mesh
    from jsecon.splat.plan import plan_view

    size = 0.6 * count ** (-1 / 3)
    gaussians, camera = jax.tree.map(jnp.asarray, ball(count, (0.1 * size, size), width, height, 0.9 * width))
    features = jnp.asarray(np.random.default_rng(1).normal(size=(count, channels)), jnp.float32)
    capacity = jsecon.plan_capacity(gaussians, camera, margin=1.0)
    start = time.perf_counter()
    mesh = host_mesh()

    def draw(g, f):
        return jsecon.render(g, camera, f, capacity=capacity, mesh=mesh)

    options = None if mesh is None else MESH_OPTIONS
    render = jax.jit(draw, compiler_options=options).lower(gaussians, features).compile()
    compile_s = time.perf_counter() - start
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        rendering = jax.block_until_ready(render(gaussians, features))
        taken.append(1e3 * (time.perf_counter() - start))
    peak = peak_memory_mib()
    assert int(rendering.overflow) == 0
    pairs = int(plan_view(gaussians, camera, capacity=capacity).lists.lengths.sum())
    return {"ms": statistics.median(taken[1:]), "pairs": pairs, "compile_s": compile_s, "peak_mib": peak}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=int, default=5_000_000, help="the largest number of Gaussians")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--one", type=int, nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(one(*arguments.one, arguments.repeats)))
        return
    print("| along | N | pixels | D | ms | pairs | ns a pair | compile s | peak MiB |")
    print("|---" * 9 + "|")
    for along, sizes in SIZES.items():
        for size in sizes:
            if size[0] > arguments.largest:
                continue
            command = [sys.executable, __file__, "--repeats", str(arguments.repeats), "--one", *map(str, size)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            row = json.loads(done.stdout.splitlines()[-1])
            count, width, height, channels = size
            print(
                f"| {along} | {count:,} | {width}x{height} | {channels} | {row['ms']:.0f} | {row['pairs']:,} "
                f"| {1e6 * row['ms'] / row['pairs']:.0f} | {row['compile_s']:.1f} | {row['peak_mib']:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
