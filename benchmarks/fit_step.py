"""One step of the photometric fit against forward and backward of L1 alone, on all devices, in the same run.

    python benchmarks/fit_step.py [CAPTURE] [--long-side PX] [--sh-degree D] [--repeats N]

A step is projection, colours, compositing, L1 and SSIM, the votes of the error, their gradients, and Adam; the
reference renders and differentiates the same view with L1. Medians, interleaved, compilation apart. Error: the step's
loss against the plain formula of the loss on the same image (photometric_loss without a mesh).
"""

import argparse
import dataclasses
import functools
import json
import time
from typing import Any

from jsecon.process import prepare_process

prepare_process(keep_programs=False)

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from jsecon.fit.growth import pad_with_free_rows
from jsecon.fit.photometric import photometric_loss
from jsecon.fit.start import starting_gaussians
from jsecon.fit.step import LearningRates, StepRunner, TrainState, put_on_devices
from jsecon.parallel import MESH_OPTIONS, host_mesh, map_rows
from jsecon.read.captures.capture import load_capture
from jsecon.splat.capacity import default_capacity, round_capacity
from jsecon.splat.render import render, render_rgb
from jsecon.splat.sh import colours_from_sh


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("capture", nargs="?", default="../shared/captures/bonsai")
    parser.add_argument("--long-side", type=int, default=400)
    parser.add_argument("--sh-degree", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=25)
    asked = parser.parse_args()
    capture = load_capture(asked.capture, long_side=asked.long_side, frames=9)
    gaussians, _ = starting_gaussians(capture, sh_degree=asked.sh_degree)
    gaussians = pad_with_free_rows(jax.tree.map(np.asarray, gaussians), round_capacity(gaussians.count))
    mesh = host_mesh()
    options: dict[str, Any] = {} if mesh is None else {"compiler_options": MESH_OPTIONS}

    def put(tree):
        return jax.device_put(tree, None if mesh is None else NamedSharding(mesh, PartitionSpec()))

    cameras = jax.tree.map(lambda a: np.asarray(a, np.float32), capture.cameras)
    camera, frame = put((cameras[4], capture.frames[4]))
    strips = 1 if mesh is None else mesh.size
    room = default_capacity(gaussians.count, cameras.width, cameras.height, strips=strips)

    def absolute(gaussians, camera, frame):
        colours = map_rows(colours_from_sh, gaussians, camera, mesh)
        image = render(gaussians, camera, colours, capacity=room, mesh=mesh).features
        return jnp.abs(image - frame.astype(jnp.float32) / 255).mean()

    zeros = jax.tree.map(np.zeros_like, gaussians)
    current = put_on_devices(TrainState(gaussians, zeros, zeros, zeros.opacity_logits, None), mesh)
    steps = StepRunner(dataclasses.replace(capture, held_out=np.arange(9) != 4), mesh, LearningRates(), None)
    whole_step = functools.partial(steps.run_step, current, 1.0, 0, 0, 0.0, 3)
    reference = functools.partial(jax.jit(jax.value_and_grad(absolute), **options), current.gaussians, camera, frame)
    runs = {"l1": reference, "step": whole_step}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        jax.block_until_ready(run())
    for _ in range(asked.repeats):
        for name, run in runs.items():
            started = time.perf_counter()
            jax.block_until_ready(run())
            seconds[name].append(time.perf_counter() - started)
    image = render_rgb(gaussians, jax.tree.map(np.asarray, cameras[4]), background=jnp.zeros(3)).features
    plain = float(photometric_loss(image, jnp.asarray(capture.frames[4], jnp.float32) / 255))
    ms = {name: 1000 * float(np.median(taken)) for name, taken in seconds.items()}
    told = {
        "gaussians": gaussians.count,
        "devices": strips,
        "ms": ms,
        "to_l1": {name: ms[name] / ms["l1"] for name in ms},
    }
    print(json.dumps(told | {"loss_error": abs(float(whole_step()[1]) - plain)}))


if __name__ == "__main__":
    main()
