"""A robot's loop: add a frame with its pose, ask; in an opened scene, and as a command.

    python benchmarks/add_frame.py [--gaussians 100000] [--views 100] [--repeats 5] [--folder FOLDER]

A made-up ball of Gaussians in 60 regions by direction, seen from a ring of cameras of 320x240, without models. FOLDER
keeps its field. Frames that are added are what the scene shows from places between the cameras. Also says what the
ledger costs a run: seconds to pack, and bytes.
"""

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jsecon.process import prepare_process

prepare_process()

import jax
import numpy as np
from metrics import Metric, show
from scipy.spatial.transform import Rotation

from jsecon import Camera, Capture, Gaussians, LanguageField, Regions, Scene, open_scene, render_rgb
from jsecon.field.evidence import list_evidence, pack_evidence, sum_evidence
from jsecon.field.ledger import Ledger, LedgerView, camera_row
from jsecon.field.ledger_file import save_with_ledger
from jsecon.field.membership import normalise_votes
from jsecon.field.regions import region_embeddings
from jsecon.read.captures.images import encode_jpeg, write_image
from jsecon.vision.colours import ColourEmbedder

REGIONS, WIDTH, HEIGHT = 60, 320, 240
SH0 = 0.28209479


def ring(angles: np.ndarray) -> Camera:
    """Cameras around the ball, which look at it."""
    poses = np.tile(np.eye(4, dtype=np.float32), (len(angles), 1, 1))
    turns = np.stack([angles, np.full(len(angles), 0.3)], 1)
    poses[:, :3, :3] = Rotation.from_euler("yx", turns).as_matrix().transpose(0, 2, 1)
    poses[:, 2, 3] = 3.0
    lens = (np.full(len(angles), value, np.float32) for value in (300, 300, WIDTH / 2, HEIGHT / 2))
    return Camera(poses, *lens, WIDTH, HEIGHT)


def picture(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """What the scene shows."""
    return (np.clip(np.asarray(render_rgb(gaussians, camera).features), 0, 1) * 255).astype(np.uint8)


def make_field(count: int, views: int, path: Path) -> list[Metric]:
    """Writes the field and its ledger; returns what the ledger costs."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    middles = rng.normal(size=(REGIONS, 3))
    owner = (means @ (middles / np.linalg.norm(middles, axis=1, keepdims=True)).T).argmax(1)
    colours = rng.uniform(0.05, 0.95, (REGIONS, 3))[owner]
    sizes = np.log(rng.uniform(0.004, 0.012, (count, 3)))
    columns = means, sizes, rng.normal(size=(count, 4)), np.full(count, 2.0), ((colours - 0.5) / SH0)[:, None]
    gaussians = jax.device_put(Gaussians(*(column.astype(np.float32) for column in columns)))
    cameras = ring(2 * np.pi * np.arange(views) / views)
    frames = np.stack([picture(gaussians, camera) for camera in cameras])
    # Labels by the nearest colour of a region.
    table = np.unique(colours, axis=0)
    labels = np.full(frames.shape[:3], -1, np.int16)
    for image, frame in zip(labels, frames):
        seen = frame.any(-1)
        image[seen] = ((frame[seen][:, None] / 255 - table) ** 2).sum(-1).argmin(1)
    count_regions = len(table)
    lists = list_evidence(gaussians, cameras, labels, count_regions)
    began = time.perf_counter()
    votes = sum_evidence(lists, count, count_regions, by_view=True)
    summed = time.perf_counter()
    packed = [pack_evidence(view, count_regions) for view in lists]
    pack = time.perf_counter() - summed
    embedder = ColourEmbedder()
    regions = region_embeddings(frames, labels, embedder.embed_regions, num_regions=count_regions)
    names, ledger = tuple(f"frame_{t:03d}" for t in range(views)), {}
    for t, name in enumerate(names):
        shown, rows = np.flatnonzero(regions.pixel_counts[:, t]), regions.embedded[:, 1] == t
        pixels = np.stack([shown, regions.pixel_counts[shown, t]]).astype(np.int32)
        embedded = regions.embedded[rows, 0], regions.view_embeddings[rows]
        ledger[name] = LedgerView(packed[t], pixels, *embedded, camera_row(cameras[t]), encode_jpeg(frames[t]))
    regions = Regions(regions.embeddings, regions.pixel_counts)
    space = embedder.canonical_phrases, np.eye(4), names, embedder.name
    field = LanguageField(gaussians, normalise_votes(votes, regions), regions, cameras, *space)
    field = dataclasses.replace(field, unrelated_words=np.zeros((0, embedder.dim), np.float32))
    save_with_ledger(path, field, Ledger(count_regions, ledger))
    entries = sum(len(view.weights) for view in lists)
    size = sum(file.stat().st_size for file in path.with_suffix(".evidence").iterdir())
    note = f"{entries} entries of {views} views, {size / 2**20:.1f} MiB with pictures, {sum(map(len, packed))} bytes"
    return [
        Metric("bytes of an entry of the ledger", sum(map(len, packed)) / entries, "", "lower", 0.1, note),
        Metric("packing the ledger over summing the votes", pack / (summed - began), "x", "lower", 0.5),
    ]


def frame_between(scene: Scene, t: int, views: int) -> Capture:
    """A frame with a pose, from between two cameras."""
    camera = ring(2 * np.pi * (np.array([t]) + 0.5) / views)
    pixels = picture(scene.field.gaussians, camera[0])[None]
    none = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    return Capture(pixels, camera, *none, np.zeros(1, bool), None, np.eye(4), (f"new_{t:03d}",))


def measure(count: int, views: int, repeats: int, folder: Path) -> list[Metric]:
    """All rows."""
    path, rows = folder / "field.safetensors", []
    if not path.is_file():
        rows = make_field(count, views, path)
    scene = open_scene(path)
    times, asked, cpu = [], [], []
    for t in range(repeats + 1):
        frame = frame_between(scene, t, views)
        began, worked = time.perf_counter(), time.process_time()
        scene = scene.add(frame)
        added = time.perf_counter()
        cpu.append(time.process_time() - worked)
        scene.ask("red thing" if t % 2 else "blue thing")
        times.append(added - began)
        asked.append(time.perf_counter() - added)
    note = f"{np.median(cpu[1:]):.2f} CPU-s; first {times[0]:.2f} s, then {', '.join(f'{s:.2f}' for s in times[1:])}"
    rows.append(Metric("add of one frame to an opened scene", float(np.median(times[1:])), "s", "lower", 0.5, note))
    rows.append(Metric("then a question", float(np.median(asked[1:])), "s", "lower", 0.5))
    frame = frame_between(scene, views // 2, views)
    seconds, cpu_seconds = command(path, frame, folder)
    note = f"{cpu_seconds:.2f} CPU-s"
    rows.append(Metric("add of one frame as a command", seconds, "s", "lower", 0.5, note))
    return rows


def command(path: Path, frame: Capture, folder: Path) -> tuple[float, float]:
    """Seconds and CPU-seconds of `jsecon add`, the second time: programs are compiled."""
    capture = folder / "new"
    (capture / "images").mkdir(parents=True, exist_ok=True)
    write_image(capture / "images" / "new.png", frame.frames[0])
    pose = np.linalg.inv(np.asarray(frame.cameras.world_to_camera[0], np.float64)) @ np.diag([1, -1, -1, 1])
    lens = {"fl_x": 300, "fl_y": 300, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    shot = {"file_path": "images/new.png", "transform_matrix": pose.tolist()}
    (capture / "transforms.json").write_text(str(lens | {"frames": [shot]}).replace("'", '"'))
    for _ in range(2):
        began, worked = time.perf_counter(), os.times()
        line = [sys.executable, "-m", "jsecon", "add", str(path), str(capture), "--out", str(folder / "out")]
        subprocess.run(line, check=True, stdout=subprocess.DEVNULL)
        seconds, ended = time.perf_counter() - began, os.times()
    return seconds, sum(ended[2:4]) - sum(worked[2:4])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        show(measure(options.gaussians, options.views, options.repeats, folder))
