"""LERF-OVS, LangSplat's annotation of four LERF scenes: ROOT/<scene>/{images, sparse/0}, ROOT/label/<scene>/*.json.

Frames are those of yanmin-wu/OpenGaussian, scripts/compute_lerf_iou.py; the published percentages are counts over
exactly these numbers of pairs.
"""

from __future__ import annotations

from pathlib import Path

from experiments.datasets.benchmark import Benchmark, hold_out, require_count, twin_of
from jsecon.errors import InputError
from jsecon.read.captures.capture import load_capture
from jsecon.read.masks.labels import load_lerf_labels

LERF_PAIRS = {"figurines": 56, "ramen": 71, "teatime": 59, "waldo_kitchen": 22}
"""(frame, query) pairs of each LERF-OVS scene in the label files: a run with others does not measure the same thing"""
LERF_FRAMES = {
    "figurines": (41, 105, 152, 195),
    "ramen": (6, 24, 60, 65, 81, 119, 128),
    "teatime": (2, 25, 43, 107, 129, 140),
    "waldo_kitchen": (53, 66, 89, 140, 154),
}
"""numbers of the annotated frames, frame_00041 and so on"""


def load_lerf_ovs(root: str | Path, scene: str, *, downscale: float | int | None = None) -> Benchmark:
    """A scene of LERF-OVS with its annotated frames held out. Labels keep their own size, whatever `downscale`.

    Frames belong to labels by name. Raises InputError where a frame that the protocol annotates has no label file,
    where a label has no frame, and where the number of (frame, query) pairs is not the protocol's (that of the twin's
    generator for a twin; unchecked for scenes that are neither).
    """
    root, told = Path(root), twin_of(root, scene)
    folder = root / "label" / scene
    frames = load_lerf_labels(folder)
    names = tuple(f"frame_{n:05d}" for n in LERF_FRAMES.get(scene, ())) if told is None else tuple(told["frames"])
    missing = sorted(set(names) - {frame.name for frame in frames})
    if missing:
        raise InputError(folder, f"no label of {', '.join(missing)}", remedy="Copy all of the scene's label files.")
    pairs = sum(len(frame.objects) for frame in frames)
    expected = LERF_PAIRS.get(scene, pairs) if told is None else told["pairs"]
    require_count(folder, pairs, expected, "(frame, query) pairs")
    capture = load_capture(root / scene, downscale=downscale, holdout=0)
    return Benchmark(
        capture=hold_out(capture, frames, folder),
        frames=tuple(frames),
        name=scene,
        dataset="lerf",
        queries=tuple(sorted({query for frame in frames for query in frame.objects})),
        pairs=pairs,
        twin=told is not None,
    )
