"""A made-up RGB-D capture as a hand-held sensor leaves it, poses and exposures off: what refining them wins.

    python -m experiments.rough_capture [--seeds 1 2 3] [--steps 2000] [--ways clean none both auto]

The demo's room with its depth. Each frame's pose is off by POSE_CM along each of the camera's axes and POSE_DEGREES
about each (normal), its brightness by a gain in 1 +- GAIN (uniform, then 8 bits). Fits of the same steps, one after the
other: to the capture without the noise (clean), to the noisy one (none), and to the noisy one with its poses and
exposures corrected, as `--refine both` does it (both) and as a run does it by default, in at most half of the fit's
time (auto). Held out: every fifth frame, PSNR against the capture that was fitted to; of a corrected one, that is a
frame with its pose and exposure by alignment to the frozen probe. Constants were chosen on seeds 0 and 1.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import jax
import numpy as np
from scipy.linalg import expm

from experiments import results
from jsecon.demo import make_room, render_views, room_cameras
from jsecon.fit.optimise import fit_gaussians
from jsecon.fit.quality import measure_quality
from jsecon.fit.refine import refine_capture
from jsecon.fit.start import starting_gaussians
from jsecon.types import Capture

POSE_CM, POSE_DEGREES, GAIN = 1.0, 0.5, 0.2


@dataclasses.dataclass(frozen=True)
class Options:
    """Of the captures and the fits."""

    seeds: tuple[int, ...] = (1, 2, 3)
    ways: tuple[str, ...] = ("clean", "none", "auto")
    views: int = 40
    width: int = 240
    height: int = 180
    holdout: int = 5
    steps: int = 2000
    out: Path = results.HOME / "results" / "rough_capture"


def rgbd_capture(seed: int, options: Options) -> Capture:
    """The demo's room with depth, and no sparse points."""
    room = make_room(seed)
    cameras = room_cameras(room, views=options.views, width=options.width, height=options.height)
    frames, _, depths = render_views(room, cameras)
    held_out = np.arange(options.views) % options.holdout == 0
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    names = tuple(f"frame_{t:03d}" for t in range(options.views))
    return Capture(frames, cameras, *nothing, held_out, depths, np.eye(4, dtype=np.float32), names)


def roughened(capture: Capture, seed: int) -> Capture:
    """Poses and brightness as said above."""
    draw, count = np.random.default_rng([seed, 11]), len(capture.names)
    poses = np.array(capture.cameras.world_to_camera, np.float64)
    for t in range(count):
        turn, shift = np.radians(POSE_DEGREES) * draw.normal(size=3), POSE_CM / 100 * draw.normal(size=3)
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), -turn), shift
        poses[t] = expm(twist) @ poses[t]
    gains = draw.uniform(1 - GAIN, 1 + GAIN, count)[:, None, None, None]
    frames = np.rint(np.clip(np.asarray(capture.frames) * gains, 0, 255)).astype(np.uint8)
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses.astype(np.float32))
    return dataclasses.replace(capture, cameras=cameras, frames=frames)


def fitted(capture: Capture, options: Options, seed: int) -> dict:
    """Held-out figures of a fit, and its seconds."""
    start, _ = starting_gaussians(capture, sh_degree=1)
    began = time.monotonic()
    gaussians, _ = fit_gaussians(capture, key=jax.random.key(seed), start=start, steps=options.steps)
    found, seconds = measure_quality(gaussians, capture), time.monotonic() - began
    return {"psnr": float(found.psnr.mean()), "ssim": float(found.ssim.mean()), "seconds": seconds}


def poses_off(capture: Capture, truth: Capture) -> tuple[float, float]:
    """Median cm and degrees of the training cameras from the true ones."""
    a, b = (np.asarray(c.cameras.world_to_camera, np.float64)[~np.asarray(c.held_out)] for c in (capture, truth))
    centre = lambda poses: -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    cosine = (np.einsum("tij,tij->t", a[:, :3, :3], b[:, :3, :3]) - 1) / 2
    off = np.linalg.norm(centre(a) - centre(b), axis=1)
    return 100 * float(np.median(off)), float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))


def corrected(rough: Capture, way: str, options: Options, seed: int) -> Capture:
    """The rough capture with poses and exposures corrected."""
    if way == "both":
        return refine_capture(rough, key=jax.random.key(seed))
    return refine_capture(rough, key=jax.random.key(seed), decide=True, max_fit_steps=options.steps / 2)


def main(options: Options) -> None:
    cells = []
    for seed in options.seeds:
        clean = rgbd_capture(seed, options)
        rough = roughened(clean, seed)
        for way in options.ways:
            began = time.monotonic()
            capture = corrected(rough, way, options, seed) if way in ("both", "auto") else rough
            spent = time.monotonic() - began
            capture = clean if way == "clean" else capture
            centimetres, degrees = poses_off(capture, clean)
            cell = {"seed": seed, "way": way, "cm": centimetres, "degrees": degrees, "refining": spent}
            cells.append(cell | fitted(capture, options, seed))
            print(json.dumps(cells[-1]), *capture.notes, sep="\n", flush=True)
    columns = ("seed", "way", "psnr", "ssim", "cm", "degrees", "refining", "seconds")
    table = results.table(columns, [tuple(cell[name] for name in columns) for cell in cells])
    results.save(options.out, options, {"cells": cells}, table)


if __name__ == "__main__":
    from jsecon.process import prepare_process

    prepare_process()
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=list(Options.seeds))
    parser.add_argument("--steps", type=int, default=Options.steps)
    parser.add_argument("--ways", choices=("clean", "none", "both", "auto"), nargs="+", default=list(Options.ways))
    parser.add_argument("--out", type=Path, default=Options.out)
    asked = parser.parse_args()
    main(Options(seeds=tuple(asked.seeds), ways=tuple(asked.ways), steps=asked.steps, out=asked.out))
