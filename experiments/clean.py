"""Floaters and haze that are added to fitted scenes: how many `jsecon clean` takes away, and what else.

    python -m experiments.clean [--seeds 0 1 2 3 4] [--rooms FOLDER]
    python -m experiments.clean --field FIELD --capture CAPTURE      (a field of `jsecon run` on a capture)

Rooms and fields come from experiments/demo_rooms.py. A tenth of the number of Gaussians is added in the free space of
random pixels, between a camera and 0.9 of the depth there, evenly over the volume. Half are floaters (deviations of
0.002 to 0.008 of their depth, opacities 0.05 to 0.95), half haze (0.01 to 0.03, opacities 0.01 to 0.06), each stretched
at random, in colours of the scene.

- gone: share of the added Gaussians that go.
- lost: share of the fit's own Gaussians that go; own: of the fit as it was, without any added.
- PSNR of the held-out photographs: of the fit, with the added ones, cleaned, and of the fit cleaned as it was.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool

import jsecon
from experiments import results
from experiments.demo_rooms import fields_of_room
from jsecon.fit.quality import measure_quality
from jsecon.read.captures.frames import evenly_spaced
from jsecon.splat.visible import hide
from jsecon.types import Camera, Capture, Gaussians
from jsecon.views.clean import find_litter

SHARE = 0.1
"""added Gaussians per Gaussian of the fit"""
VIEWS = 48
"""training views, at most, that the cleaning looks from"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    quick: bool = False
    """Measure one tiny room."""
    rooms: str = str(results.HOME.parent / "demos")
    """Folder that keeps the rooms and their fields."""
    field: str = ""
    capture: str = ""
    out: str = ""


def spoil(gaussians: Gaussians, cameras: Camera, seed: int) -> tuple[Gaussians, Bool[np.ndarray, " m"]]:
    """Adds floaters and haze; the second value marks them."""
    draw, count = np.random.default_rng(seed), round(SHARE * gaussians.count)
    depths = [np.asarray(jsecon.render_depth(gaussians, camera)[0]) for camera in cameras]
    views = draw.integers(0, len(cameras), count)
    x, y = (draw.integers(0, size, count) for size in (cameras.width, cameras.height))
    far = np.array([depths[t][row, column] for t, column, row in zip(views, x, y)])
    depth = 0.9 * far * draw.uniform(0.03, 1, count) ** (1 / 3)
    chosen = jax.tree.map(lambda a: np.asarray(a)[views], cameras)
    local = np.stack([(x + 0.5 - chosen.cx) / chosen.fx, (y + 0.5 - chosen.cy) / chosen.fy, np.ones(count)], axis=1)
    pose = chosen.world_to_camera
    means = np.einsum("nji,nj->ni", pose[:, :3, :3], local * depth[:, None] - pose[:, :3, 3])
    is_haze = np.arange(count) % 2 == 1
    low, high = np.where(is_haze, 0.01, 0.002), np.where(is_haze, 0.03, 0.008)
    size = np.log(depth * np.exp(draw.uniform(np.log(low), np.log(high))))[:, None] + draw.normal(0, 0.4, (count, 3))
    opacity = draw.uniform(np.where(is_haze, 0.01, 0.05), np.where(is_haze, 0.06, 0.95))
    colours = np.asarray(gaussians.sh)[draw.integers(0, gaussians.count, count)]
    added = Gaussians(means, size, draw.normal(size=(count, 4)), np.log(opacity / (1 - opacity)), colours)
    both = jax.tree.map(lambda *parts: np.concatenate(parts).astype(np.float32), gaussians, added)
    return both, np.arange(both.count) >= gaussians.count


def measure(gaussians: Gaussians, capture: Capture, seed: int) -> dict[str, float]:
    """Spoils a fit, cleans it, and compares it with photographs."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    cameras = jax.tree.map(np.asarray, capture.cameras[train[evenly_spaced(len(train), VIEWS)]])
    spoiled, added = spoil(gaussians, cameras, seed)
    gone, own = find_litter(spoiled, cameras) > 0, find_litter(gaussians, cameras) > 0
    scenes = (gaussians, spoiled, hide(spoiled, gone), hide(gaussians, own))
    quality = [float(np.mean(measure_quality(scene, capture).psnr)) for scene in scenes]
    figures = {"gone": gone[added].mean(), "lost": gone[~added].mean(), "own": own.mean()}
    figures = {name: float(value) for name, value in figures.items()}
    return figures | dict(zip(("fit, dB", "spoiled, dB", "cleaned, dB", "fit cleaned, dB"), quality))


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    metrics: dict[str, dict] = {}
    if options.field:
        field = jsecon.load_field(options.field)
        capture = jsecon.load_capture(options.capture, long_side=field.cameras.width)
        metrics[Path(options.capture).name] = measure(jax.tree.map(np.asarray, field.gaussians), capture, 0)
    for seed in () if options.field else options.seeds:
        folder = Path(options.rooms) / f"{'quick-' if options.quick else ''}{seed}"
        run, _ = fields_of_room(folder, seed, options.quick)
        metrics[f"room {seed}"] = measure(jax.tree.map(np.asarray, run.field.gaussians), run.capture, seed)
        print(seed, metrics[f"room {seed}"], flush=True)
    names = list(next(iter(metrics.values())))
    rows = [(scene, *(row[name] for name in names)) for scene, row in metrics.items()]
    text = results.table(("scene", *names), rows)
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "clean", __doc__, {"seeds": (0,)}))
