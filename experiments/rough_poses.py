"""RGB-D captures with rough poses: no refinement, the default, and refinement to its end.

    python -m experiments.rough_poses [--seeds 0] [--kinds each drift apc_bin] [--rows never default end]

Made-up rooms have 100 frames with depth, whose poses are wrong: "each" turns and shifts every frame for itself (0.5
degrees and 1 cm, standard deviations along each axis), "drift" by a random walk, some 3 degrees and 6 cm in the end.
"apc_bin" is real: 15 frames of 320x240 with the poses of a robot's arm. Every eighth frame is held out. A row is
refined as `jsecon run` does by default and with `--refine always`, and fitted in 2,000 steps. Seconds are CPU seconds
divided by the cores.
"""

import dataclasses
import time
from pathlib import Path
from typing import Literal

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from experiments import results
from experiments.apc_bin import load_apc
from experiments.rooms.capture import render_capture, room_cameras
from experiments.rooms.room import crowded_room
from jsecon.fit.optimise import Schedule, fit_gaussians
from jsecon.fit.quality import measure_quality
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.fit.start import starting_gaussians
from jsecon.poses.refine import refine_capture
from jsecon.process import cores
from jsecon.types import Capture

FRAMES, STEPS = 100, 2000


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0,)
    kinds: tuple[Literal["each", "drift", "apc_bin"], ...] = ("apc_bin", "each", "drift")
    rows: tuple[Literal["never", "default", "end"], ...] = ("never", "default", "end")
    quick: bool = False
    """Measure a tiny room by few steps."""
    out: str = ""


def rough(capture: Capture, kind: str, seed: int) -> Capture:
    """Turns and shifts the cameras of a capture."""
    draw, count = np.random.default_rng([seed, 41]), len(capture.names)
    noise = draw.normal(size=(count, 6)) * np.repeat([np.radians(0.5), 0.01], 3)
    if kind == "drift":
        noise = noise.cumsum(0) / 2
        noise -= noise.mean(0)
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    off = np.tile(np.eye(4), (count, 1, 1))
    off[:, :3, :3], off[:, :3, 3] = Rotation.from_rotvec(noise[:, :3]).as_matrix(), noise[:, 3:]
    cameras = dataclasses.replace(capture.cameras, world_to_camera=(off @ poses).astype(np.float32))
    return dataclasses.replace(capture, cameras=cameras)


def measure(capture: Capture, row: str, steps: int) -> dict[str, float]:
    """Refines, fits and measures a capture."""
    key, began = jax.random.key(0), time.process_time()
    if row != "never":
        capture = refine_capture(capture, key=key, max_fit_steps=steps / 2 if row == "default" else None)
        print(*capture.notes, sep="\n")
    refined = time.process_time()
    start, _ = starting_gaussians(capture, sh_degree=2)
    most = min(capture.cameras.width * capture.cameras.height // 2, Schedule.max_gaussians)
    scene, _ = fit_gaussians(capture, key=key, steps=steps, start=start, schedule=Schedule(max_gaussians=most))
    ended = time.process_time()
    quality = measure_quality(scene, capture)
    seconds = {"refine, s": (refined - began) / cores(), "all, s": (ended - began) / cores()}
    return {"PSNR, dB": float(np.mean(quality.psnr)), "SSIM": float(np.mean(quality.ssim))} | seconds


def captures(options: Options, kind: str) -> dict[str, Capture]:
    """The captures of a kind by name."""
    if kind == "apc_bin":
        found, _ = load_apc(results.CAPTURES / "apc_bin" / "scene-0000", held_out_every=8, nearest_m=0.2)
        cameras = scale_cameras(found.cameras, 0.5)
        frames = np.stack([resize_frame(frame, cameras) for frame in found.frames])
        return {kind: dataclasses.replace(found, frames=frames, cameras=cameras, depths=found.depths[:, ::2, ::2])}
    made = {}
    size = dict(views=12, width=96, height=72) if options.quick else dict(views=FRAMES)
    for seed in options.seeds:
        room = crowded_room(seed)
        cameras = room_cameras(room, **size)
        held_out = np.arange(len(cameras)) % 8 == 0
        names = tuple(f"frame_{view + 1:05d}" for view in range(len(cameras)))
        made[f"{kind} {seed}"] = rough(render_capture(room, cameras, names, held_out, points=6000)[0], kind, seed)
    return made


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    metrics: dict[str, dict[str, float]] = {}
    for kind in options.kinds:
        for name, capture in captures(options, kind).items():
            for row in options.rows:
                metrics[f"{name}, {row}"] = measure(capture, row, 40 if options.quick else STEPS)
                print(name, row, metrics[f"{name}, {row}"], flush=True)
    names = list(next(iter(metrics.values())))
    rows = [(row, *(f"{figures[name]:.4g}" for name in names)) for row, figures in metrics.items()]
    text = results.table(("capture, row", *names), rows)
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "rough_poses", __doc__, {"seeds": (0,), "kinds": ("each",)}))
