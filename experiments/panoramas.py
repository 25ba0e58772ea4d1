"""A made-up room as panoramas, with their poses and without, beside perspective photographs of the same directions.

    python -m experiments.panoramas [--seeds 0] [--rows photographs poses found] [--rooms FOLDER] [--quick]

Twelve panoramas stand around the table, each turned at random and tilted by up to 5 degrees. The photographs are traced
at the poses and with the lens of the views that jsecon cuts. All three are run with the default vision and the same
steps; those with poses start from the same sparse points, those without from what structure from motion finds. Every
fifth panorama is held out. PSNR compares the traced photographs of the held-out directions with renderings, without
the cone below the panoramas; mIoU is that of rendered answers there. Errors of the poses that were found are medians,
after a similarity.
"""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from experiments import results
from experiments.rooms import crowded_room
from experiments.rooms.capture import MIN_LABEL_PIXELS, label_frame, look_at, render_capture
from experiments.rooms.raycast import PanoramaCamera, render_views
from experiments.rooms.room import Room
from experiments.rooms.writers import write_colmap
from jsecon import Scene, load_capture
from jsecon.app import evaluation
from jsecon.files import write_text
from jsecon.fit.quality import measure_quality
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.progress import Console
from jsecon.read.captures.images import write_image

COUNT, HOLDOUT = 12, 5
ROWS = ("photographs", "poses", "found")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0,)
    rows: tuple[str, ...] = ROWS
    width: int = 1024
    """Width of the panoramas, px; their views have a third of it."""
    steps: int = 900
    quick: bool = False
    """Measure one tiny room."""
    rooms: str = str(results.HOME.parent / "demos" / "panoramas")
    """Folder that keeps the rooms and their fields."""
    out: str = ""


def panorama_poses(seed: int) -> np.ndarray:
    """(COUNT, 4, 4) world-to-camera around the table."""
    draw, poses = np.random.default_rng([seed, 31]), []
    for turn in 2 * np.pi * np.arange(COUNT) / COUNT + draw.normal(0, 0.03, COUNT):
        radius, height = 0.95 + 0.1 * np.sin(2 * turn), 0.45 + 0.12 * np.sin(3 * turn)
        centre, heading = np.array([radius * np.cos(turn), radius * np.sin(turn), height]), draw.uniform(0, 2 * np.pi)
        pose = look_at(centre, centre + np.array([np.cos(heading), np.sin(heading), 0])).astype(np.float64)
        tilt = Rotation.from_euler("XZ", draw.uniform(-5, 5, 2), degrees=True).as_matrix()
        poses.append(np.block([[tilt @ pose[:3]], [pose[3:]]]))
    return np.stack(poses)


def write_captures(folder: Path, room: Room, width: int) -> None:
    """Writes the room as panoramas with poses, without, and as photographs of the directions of their views."""
    poses, given = panorama_poses(room.seed), folder / "poses"
    images, _, _ = render_views(room, [PanoramaCamera(pose, width, width // 2) for pose in poses])
    lines = []
    for n, (pose, image) in enumerate(zip(poses, images)):
        name, turn = f"pano_{n:03d}.png", Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        write_image(given / "images" / name, image)
        lines += [" ".join(map(str, [n + 1, *turn, *pose[:3, 3], 1, name])), ""]
    write_text(given / "sparse/0/cameras.txt", f"1 EQUIRECTANGULAR {width} {width // 2} {width} {width // 2}\n")
    write_text(given / "sparse/0/images.txt", "\n".join(lines) + "\n")
    shutil.copytree(given / "images", folder / "found" / "images", dirs_exist_ok=True)
    cut = load_capture(given, holdout=HOLDOUT)
    views, instances = render_capture(room, cut.cameras, cut.names, cut.held_out, points=6000)
    write_colmap(views, folder / "photographs")
    for row, held_out in ("photographs", cut.names), ("poses", [f"pano_{n:03d}" for n in range(COUNT)]):
        every = len(held_out) // COUNT
        tested = [f"{name}.png\n" for n, name in enumerate(held_out) if n // every % HOLDOUT == 0]
        write_text(folder / row / "sparse/0/test.txt", "".join(tested))
    shutil.copy(folder / "photographs/sparse/0/points3D.bin", given / "sparse/0")
    np.savez(folder / "truth.npz", frames=views.frames, instances=instances, ignored=cut.ignored)


def pose_errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Median errors of poses after a similarity: m, and degrees."""
    ours, theirs = (-np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3]) for poses in (found, true))
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    turn = Rotation.align_vectors(b, a)[0].as_matrix()
    moved = a @ turn.T
    between = found[:, :3, :3] @ turn.T @ np.swapaxes(true[:, :3, :3], 1, 2)
    off = np.linalg.norm((moved * b).sum() / (moved**2).sum() * moved - b, axis=1)
    return float(np.median(off)), float(np.median(np.degrees(Rotation.from_matrix(between).magnitude())))


def measure(folder: Path, row: str, room: Room, options: Options) -> dict[str, float]:
    """The figures of a row."""
    with np.load(folder / "truth.npz") as truth:
        frames, instances, ignored = truth["frames"], truth["instances"], truth["ignored"]
    capture = folder / row
    is_found = row == "found"
    chosen = RunOptions(capture, holdout=HOLDOUT if is_found else None, steps=options.steps, panoramas=is_found)
    run = pipeline.run(dataclasses.replace(chosen, seed=room.seed), folder / f"{row}_field", console=Console())
    names = [f"pano_{n:03d}_{view}" for n in range(COUNT) for view in range(8)]
    rows = [names.index(name) for name in run.capture.names]
    exact = dataclasses.replace(run.capture, frames=frames[rows], ignored=ignored[rows])
    held_out = np.flatnonzero(np.arange(len(names)) // 8 % HOLDOUT == 0)
    kept = np.flatnonzero(np.isin(rows, held_out))
    quality = measure_quality(run.field.gaussians, exact, frames=kept)
    labels = [label_frame(names[t], instances[t], room.names, MIN_LABEL_PIXELS) for t in held_out]
    labels = [label for label in labels if label.objects and label.name in run.capture.names]
    _, summary = evaluation.evaluate(Scene(run.field), labels, Console())
    figures = {"registered": len(rows) / 8, "PSNR, dB": float(np.mean(quality.psnr)), "mIoU": float(summary["miou"])}
    errors = (
        pose_errors(np.asarray(run.capture.cameras.world_to_camera[::8], np.float64), panorama_poses(room.seed))
        if len(rows) == len(names)
        else (np.nan, np.nan)
    )
    return figures | dict(zip(("off, mm", "off, degrees"), (1000 * errors[0], errors[1])))


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    metrics: dict[str, dict] = {}
    for seed in options.seeds:
        folder, room = Path(options.rooms) / f"{'quick-' if options.quick else ''}{seed}", crowded_room(seed)
        if not (folder / "truth.npz").is_file():
            write_captures(folder, room, options.width)
        for row in options.rows:
            metrics[f"room {seed}, {row}"] = measure(folder, row, room, options)
            print(seed, row, metrics[f"room {seed}, {row}"], flush=True)
    names = list(next(iter(metrics.values())))
    text = results.table(("capture", *names), [(row, *(line[name] for name in names)) for row, line in metrics.items()])
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "panoramas", __doc__, {"seeds": (0,), "width": 384, "steps": 60}))
