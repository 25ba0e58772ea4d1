"""The vision that needs no weights, against true instances: how good is a mask, and how well does its id last?

    python -m experiments.default_vision [FOLDER]

Scenes: the demo rooms of seeds 0 to 4 (made in FOLDER where they are missing) and, where ../shared/captures is at hand,
replica_apartment_0, whose ids stand for several objects each. For every true object that fills at least 1 % of a view:
the best IoU of any masklet with it there, its mean over objects and views; and the share of an object's views whose
best masklet has the id that is the best in most of them, its mean over objects seen twice or more. All from the
pipeline's own stages: consensus (the default) and Algorithm 1 through the Gaussians; beside them, the same proposals
left alone in each frame, and carried from frame to frame by dense optical flow (OpenCV's DIS).
"""

import dataclasses
import sys
import tempfile
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments import replica_apartment_0, results
from jsecon.data.capture import load_capture
from jsecon.demo import demo
from jsecon.eyes import Eyes
from jsecon.language.field import load_field
from jsecon.options import Options as RunOptions
from jsecon.plan import Silent
from jsecon.stages import masklets_from_frames, proposals_of, training_frames
from jsecon.types import Capture, Gaussians
from jsecon.vision.colours import ColourEmbedder

LEAST = 0.01
"""share of a view that an object must fill to count there"""
KEPT = 0.5
"""optical flow: a proposal keeps the id that fills at least this much of it, as IoU"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    rooms: str = ""
    """folder of the demo rooms"""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    capture: str = str(results.CAPTURES / "replica_apartment_0")
    out: str = str(results.HOME / "results" / "default_vision")


def score(found: np.ndarray, truth: np.ndarray, *, least: float = LEAST) -> tuple[float, float]:
    """(mean best IoU, mean share of views under one id) of masklets `found` (T, H, W) for the objects `truth`
    (T, H, W); -1 = none in both."""
    best, ids = [], {}
    for labels, true in zip(found, truth, strict=True):
        for k in np.unique(true[true >= 0]):
            inside = true == k
            if inside.mean() < least:
                continue
            names, shared = np.unique(labels[inside], return_counts=True)
            shared = shared[names >= 0]
            names = names[names >= 0]
            sizes = np.array([(labels == name).sum() for name in names])
            iou = shared / (sizes + inside.sum() - shared)
            best.append(iou.max(initial=0.0))
            ids.setdefault(k, []).append(names[iou.argmax()] if len(names) else -1)
    lasting = []
    for named in ids.values():
        if len(named) > 1:
            names, counts = np.unique([n for n in named if n >= 0], return_counts=True)
            lasting.append(counts.max(initial=0) / len(named) if len(names) else 0.0)
    return float(np.mean(best)), float(np.mean(lasting))


def alone(frames: np.ndarray, proposals) -> np.ndarray:
    """labels (T, H, W): every frame's proposals, the better above the worse, under ids of their own."""
    labels, last = np.full(frames.shape[:3], -1, np.int32), 0
    for t in range(len(frames)):
        masks = proposals(t)
        for m in range(len(masks) - 1, -1, -1):
            labels[t][masks[m]] = last + m
        last += len(masks)
    return labels


def by_flow(frames: np.ndarray, single: np.ndarray, *, kept: float = KEPT) -> np.ndarray:
    """The single frames' labels under ids that dense optical flow carries on from the frame before."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    y, x = np.mgrid[: frames.shape[1], : frames.shape[2]].astype(np.float32)
    labels, fresh = single.copy(), int(single.max()) + 1
    for t in range(1, len(frames)):
        back = flow.calc(grey[t], grey[t - 1], None)
        carried = cv2.remap(
            labels[t - 1].astype(np.float32), x + back[..., 0], y + back[..., 1], cv2.INTER_NEAREST, borderValue=-1
        ).astype(np.int32)
        labels[t] = -1
        for name in np.unique(single[t][single[t] >= 0]):
            mask = single[t] == name
            names, shared = np.unique(carried[mask], return_counts=True)
            union = np.array([(carried == n).sum() for n in names]) + mask.sum() - shared
            iou = np.where(names >= 0, shared / union, 0.0)
            if iou.max() >= kept:
                labels[t][mask] = names[iou.argmax()]
            else:
                labels[t][mask] = fresh
                fresh += 1
    return labels


def measure(capture: Capture, gaussians: Gaussians, truth: np.ndarray) -> dict[str, dict[str, float]]:
    """The scores and seconds (segmentation included) of each way, on the frames that take part."""
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    options = RunOptions(capture=Path())
    train = training_frames(capture)
    frames, truth = np.asarray(capture.frames)[train], truth[train]
    none = Eyes(ColourEmbedder(), None, None)
    track = dataclasses.replace(options, association="tracking")
    silent = lambda done, total: None
    single = lambda: alone(frames, proposals_of(options, capture, gaussians, None)[0])
    ways = {
        "each frame alone": single,
        "optical flow": lambda: by_flow(frames, single()),
        "tracking (Algorithm 1)": lambda: masklets_from_frames(track, capture, gaussians, none, silent).value,
        "consensus (default)": lambda: masklets_from_frames(options, capture, gaussians, none, silent).value,
    }
    found = {}
    for name, way in ways.items():
        start = time.perf_counter()
        labels = way()
        seconds = time.perf_counter() - start
        iou, lasting = score(labels, truth)
        found[name] = {"best_iou": iou, "lasting": lasting, "seconds": seconds}
    return found


def demo_room(folder: Path, seed: int) -> tuple[Capture, Gaussians, np.ndarray]:
    """The room of `seed` as `jsecon demo` leaves it, and its true labels (T, H, W)."""
    if not (folder / "field.npz").exists():
        demo(folder, seed=seed, reporter=Silent())
    capture = load_capture(folder / "capture", holdout=8)
    files = [folder / "capture" / "masks" / f"{name}.png" for name in capture.names]
    truth = np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]).astype(np.int32) - 1
    return capture, load_field(folder / "field.npz").gaussians, truth


def replica(folder: str) -> tuple[Capture, Gaussians, np.ndarray]:
    """replica_apartment_0, every second view, its depth points as Gaussians."""
    given = replica_apartment_0.Options(capture=folder)
    capture, truth = replica_apartment_0.load_replica(folder, voting_every=given.voting_every)
    return capture, replica_apartment_0.points_as_gaussians(capture, given)[1], truth


def main(options: Options = Options()) -> dict:
    """Measures every scene and writes the table."""
    rooms = Path(options.rooms or tempfile.mkdtemp())
    scenes = {f"demo {seed}": (lambda seed=seed: demo_room(rooms / f"demo{seed}", seed)) for seed in options.seeds}
    if Path(options.capture).exists():
        scenes["replica_apartment_0"] = lambda: replica(options.capture)
    found = {}
    for name, make in scenes.items():
        found[name] = measure(*make())
        print(name, found[name], flush=True)
    rows = [
        (scene, way, row["best_iou"], row["lasting"], row["seconds"])
        for scene, ways in found.items()
        for way, row in ways.items()
    ]
    demos = [ways for name, ways in found.items() if name.startswith("demo")]
    for way in demos[0] if demos else ():
        mean = [float(np.mean([room[way][key] for room in demos])) for key in ("best_iou", "lasting", "seconds")]
        rows.append((f"mean of {len(demos)} demos", way, *mean))
    table = results.table(("scene", "association", "mean best IoU", "share of views under one id", "seconds"), rows)
    results.save(Path(options.out), options, found, table)
    print(table)
    return found


if __name__ == "__main__":
    main(Options(rooms=sys.argv[1]) if len(sys.argv) > 1 else Options())
