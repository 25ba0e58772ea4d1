"""A fit by second order against Adam: held-out error per step and per minute.

    python -m experiments.second_order [--capture FOLDER] [--long-side PX] [--steps N]

The diagonal of J^T J (J: the rendered image by a parameter) is the mean of (J^T r)^2 over random signs r of every pixel
and channel (Hutchinson): one more backward pass through the rendering, here in every EVERY-th step. Its running mean h
takes the place of Adam's second moment: a parameter moves by rate * clip(m / (gamma h), -1, 1), m the running mean of
the gradient, so that no step leaves the region that Adam's rate spans (arXiv 2305.14342 clips so; arXiv 2602.00395
bounds the change of each Gaussian). h is scaled as the loss is, by one over pixels times channels. Both start from the
same Gaussians, none are added, all frames are taken at full size in the same order, gradients and renders are the
library's.
"""

import argparse
import dataclasses
import functools
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from jsecon.data.capture import load_capture
from jsecon.fit.quality import measure_quality
from jsecon.fit.schedule import LearningRates, rates_at
from jsecon.fit.start import starting_gaussians
from jsecon.fit.view import TrainingViews, view_loss
from jsecon.parallel import MESH_OPTIONS, host_mesh
from jsecon.process import clear_programs
from jsecon.splat.capacity import default_capacity
from jsecon.splat.render import render
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Gaussians

WAYS: dict[str, tuple[float | None, int]] = {
    "Adam": (None, 1),
    "second order, gamma 1, every step": (1.0, 1),
    "second order, gamma 0.1, every step": (0.1, 1),
    "second order, gamma 0.01, every step": (0.01, 1),
    "second order, gamma 0.1, every 10th": (0.1, 10),
}
"""gamma (None: Adam), and the steps from one look at the curvature to the next"""
FIRST, SECOND = 0.9, 0.99
"""of the gradient's running mean, and of the curvature's"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What is fitted, and how far."""

    capture: str = "../shared/captures/bonsai"
    long_side: int = 400
    steps: int = 1500
    looks: int = 5
    out: Path = results.HOME / "results" / "second_order"


class State(NamedTuple):
    """What a step moves."""

    gaussians: Gaussians
    first: Gaussians
    second: Gaussians


@functools.partial(jax.jit, static_argnames=("gamma", "looked", "capacity", "mesh"), compiler_options=MESH_OPTIONS)
def step(state: State, view, numbers: dict[str, Any], *, gamma: float | None, looked: bool, capacity: int, mesh):
    """One step; `looked`: the curvature is asked in it."""
    gaussians, first, second = state
    none = jnp.zeros((gaussians.count, 0))
    loss = lambda g: view_loss(g, none, None, view, numbers["extent"], capacity, mesh)
    (_, (value, overflow)), gradient = jax.value_and_grad(loss, has_aux=True)(gaussians)
    number = numbers["number"] + 1
    first = jax.tree.map(lambda m, g: FIRST * m + (1 - FIRST) * g, first, gradient)
    if gamma is None:
        second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, second, gradient)
        change = jax.tree.map(
            lambda m, v: (m / (1 - FIRST**number)) / (jnp.sqrt(v / (1 - 0.999**number)) + 1e-15), first, second
        )
    else:
        if looked:
            colours = lambda g: render(g, view.camera, colours_from_sh(g, view.camera), capacity=capacity, mesh=mesh)
            image, back = jax.vjp(lambda g: colours(g).features, gaussians)
            signs = jax.random.rademacher(jax.random.key(numbers["number"]), image.shape, image.dtype)
            (by,) = back(signs)
            second = jax.tree.map(lambda h, b: SECOND * h + (1 - SECOND) * b**2 / image.size, second, by)
        looks = numbers["looks"]
        change = jax.tree.map(
            lambda m, h: jnp.clip(
                (m / (1 - FIRST**number)) / jnp.maximum(gamma * h / (1 - SECOND**looks), 1e-15), -1, 1
            ),
            first,
            second,
        )
    rate = rates_at(numbers["done"], numbers["rates"], gaussians, numbers["extent"], numbers["degree"])
    gaussians = jax.tree.map(lambda p, c, r: p - r * c, gaussians, change, rate)
    return State(gaussians, first, second), value, overflow


def fitted(capture, start: Gaussians, way: str, options: Options) -> list[dict]:
    """Held-out PSNR and SSIM at so many looks along the way, with the seconds of the steps alone."""
    gamma, every = WAYS[way]
    views, mesh = TrainingViews(capture), host_mesh()
    strips = 1 if mesh is None else mesh.size
    capacity = 2 * default_capacity(start.count, views.cameras.width, views.cameras.height, strips=strips)
    zeros = jax.tree.map(jnp.zeros_like, start)
    state, cells, spent, count = State(start, zeros, zeros), [], 0.0, len(views.used)
    order = np.concatenate([np.random.default_rng(n).permutation(count) for n in range(-(-options.steps // count))])

    def taken(state: State, number: int):
        done = number / options.steps
        numbers = {
            "number": np.int32(number),
            "looks": np.float32(number // every + 1),
            "done": np.float32(done),
            "degree": np.int32(min(2, int(done * 10))),
            "extent": views.extent,
            "rates": LearningRates(),
        }
        given = {"gamma": gamma, "looked": number % every == 0, "capacity": capacity, "mesh": mesh}
        state, _, overflow = step(state, views[order[number]], numbers, **given)
        if int(overflow) > 0:
            raise RuntimeError(f"{int(overflow)} pairs too many for a capacity of {capacity}")
        return state

    for number in {0, 1 % every}:
        taken(state, number)  # compilation apart
    for look in range(options.looks):
        first, last = (round(options.steps * (look + n) / options.looks) for n in (0, 1))
        began = time.monotonic()
        for number in range(first, last):
            state = taken(state, number)
        jax.block_until_ready(state)
        spent += time.monotonic() - began
        found = measure_quality(state.gaussians, capture)
        cell = {"way": way, "steps": last, "seconds": spent}
        cells.append(cell | {"psnr": float(found.psnr.mean()), "ssim": float(found.ssim.mean())})
        print(json.dumps(cells[-1]), flush=True)
    return cells


def main(options: Options) -> None:
    capture = load_capture(options.capture, long_side=options.long_side)
    start, _ = starting_gaussians(capture, sh_degree=2)
    cells = []
    for way in WAYS:
        cells += fitted(capture, start, way, options)
        clear_programs()
    marks = sorted({cell["steps"] for cell in cells})
    rows = []
    for way in WAYS:
        own = [cell for cell in cells if cell["way"] == way]
        rows.append((way, *(f"{c['psnr']:.2f} dB, {c['seconds']:.0f} s" for c in own), f"{own[-1]['ssim']:.3f}"))
    table = results.table(("way", *(f"{mark} steps" for mark in marks), "SSIM"), rows)
    results.save(options.out, options, {"cells": cells}, table)


if __name__ == "__main__":
    from jsecon.process import prepare_process

    prepare_process()
    parser = argparse.ArgumentParser()
    parser.add_argument("--capture", default=Options.capture)
    parser.add_argument("--long-side", type=int, default=Options.long_side)
    parser.add_argument("--steps", type=int, default=Options.steps)
    parser.add_argument("--out", type=Path, default=Options.out)
    main(Options(**vars(parser.parse_args())))
