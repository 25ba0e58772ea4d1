"""The votes of all views of a capture against rendering those views once.

    python benchmarks/votes.py RUN [--width 793] [--features 16] [--repeats 3]

RUN is the folder that `jsecon run` left: its Gaussians, cameras and the labels of its masklets (RUN/cache), brought to
WIDTH pixels. In turn in one run, over all devices: the views rendered with D random features a Gaussian; the regions'
votes; and the votes that also keep what each view saw (`by_view`, a run's default). Largest relative difference of the
two votes' weights beside it; their error against float64 is a test (tests/test_votes.py).
"""

import argparse
import dataclasses
from pathlib import Path

from jsecon.process import prepare_process

prepare_process(keep_programs=False)

import jax
import jax.numpy as jnp
import numpy as np
from metrics import Metric, interleaved, show

import jsecon
from jsecon.errors import InputError
from jsecon.files import read_arrays
from jsecon.parallel import map_views
from jsecon.types import Camera, Gaussians


def voting_views(run: Path, width: int) -> tuple[Gaussians, Camera, np.ndarray, int]:
    """Gaussians, the voting views' cameras and labels (T, H, W) at `width` pixels, and the number of regions."""
    field = jsecon.load_field(run / "field.safetensors")
    files = sorted((run / "cache").glob("objects-*.safetensors"), key=lambda file: file.stat().st_mtime)
    if not files:
        raise InputError(run, "it has no cache of the stage objects", "the folder of a whole run", "jsecon run")
    objects = read_arrays(files[-1])[1]
    labels, voting = objects["root.value.labels"], objects["root.value.frames"]
    scale = width / field.cameras.width
    height = round(field.cameras.height * scale)
    lens = {name: getattr(field.cameras, name) * np.float32(scale) for name in ("fx", "fy", "cx", "cy")}
    cameras = dataclasses.replace(field.cameras, **lens, width=width, height=height)
    rows, columns = (np.arange(n) * size // n for n, size in zip((height, width), labels.shape[1:]))
    labels = labels[:, rows[:, None], columns[None]].astype(np.int32)
    return field.gaussians, jax.tree.map(lambda a: np.asarray(a)[voting], cameras), labels, field.regions.count


def measure(run: Path, width: int, size: int, repeats: int) -> list[Metric]:
    """All rows."""
    gaussians, cameras, labels, regions = voting_views(run, width)
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    capacity = jsecon.plan_capacity(gaussians, cameras, margin=1.0, devices=1)
    features = jnp.asarray(np.random.default_rng(0).normal(size=(gaussians.count, size)), jnp.float32)

    def image(t: int):
        return jsecon.render(gaussians, cameras[t], features, capacity=capacity).features.block_until_ready()

    def votes(by_view: bool):
        return jsecon.region_votes(gaussians, cameras, labels, regions, capacity=capacity, by_view=by_view)

    calls = {
        "rendered": lambda: map_views(len(labels), image)[-1],
        "votes": lambda: votes(False).weights,
        "votes by view": lambda: votes(True).weights,
    }
    ms, _ = interleaved(calls, repeats)
    plain, kept = (np.asarray(votes(by_view).weights) for by_view in (False, True))
    apart = float(np.abs(plain - kept).max() / plain.max())
    what = f"{len(labels)} views of {cameras.width}x{cameras.height}, {gaussians.count} Gaussians, {regions} regions"
    rows = [Metric(f"{what}: rendered, D={size}", ms["rendered"] / 1e3, "s", "lower", 0.5)]
    for name in ("votes", "votes by view"):
        note = f"{ms[name] / 1e3:.2f} s" + (f"; weights apart {apart:.1e}" if name != "votes" else "")
        rows.append(Metric(f"{name} against rendered", ms[name] / ms["rendered"], "x", "lower", 0.3, note))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    for name, default in (("width", 793), ("features", 16), ("repeats", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()
    show(measure(asked.run, asked.width, asked.features, asked.repeats))
