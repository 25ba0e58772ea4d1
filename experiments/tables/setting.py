"""A benchmark's scene made ready for every method: the same Gaussians, masks, tracks and texts for all of them."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baselines.evidence import Evidence
from experiments.datasets.benchmark import Benchmark
from experiments.datasets.feature_files import load_features, load_text_features
from experiments.tables import twins
from experiments.tables.association import Association, Shared, associated
from jsecon.fit.optimise import Schedule, fit_gaussians
from jsecon.fit.start import starting_gaussians
from jsecon.fit.step import LearningRates
from jsecon.read.masks.masks import load_labels
from jsecon.read.splats.formats import load_gaussians
from jsecon.read.splats.writing import save_gaussians
from jsecon.splat.points import gaussians_from_points
from jsecon.types import Camera, Gaussians


@dataclasses.dataclass(frozen=True)
class Setting:
    """One scene, one seed, one level of noise."""

    bench: Benchmark
    evidence: Evidence
    frames: np.ndarray
    """(T, H, W, 3) uint8 of the evidence's views."""
    levels: tuple[Evidence, ...]
    """the evidence of each of LangSplat's levels of masks that differ, first the one above: a plain twin has one."""
    tracked: Association
    """regions by the tracker's ids."""
    texts: np.ndarray
    """(Q, E) of bench.queries."""
    canonical_phrases: np.ndarray
    """(4, E)."""
    cameras: dict[str, Camera]
    """of all frames, by name."""
    names: tuple[str, ...]
    """of the frames that are learnt from."""
    seed: int
    folder: Path
    """of the scene's files: masks, language_features, text_features.json."""
    level: str = ""
    """of a twin's simulated vision."""
    unrelated_words: np.ndarray | None = None
    """(W, E) of the unrelated words; None of a real dataset, whose files have none."""
    shared: Shared = dataclasses.field(default_factory=Shared, compare=False)
    """what methods have in common."""


FIT: Any = {"schedule": Schedule(max_gaussians=0), "rates": LearningRates(means=2e-3, means_last=2e-5)}
"""of the scenes without Gaussians: few steps, one Gaussian for each point of the start"""


def prepare(data: twins.Data, scene: str, seed: int, level: str, *, fit_steps: int) -> Setting:
    """Loads a scene with its masks, tracks and texts; fits its Gaussians where neither the dataset has them (points, or
    <scene>/point_cloud.ply) nor an earlier run."""
    root = data.place(scene, seed, level)
    bench = data.load(root, scene)
    capture, folder = bench.capture, root / scene
    shown = np.flatnonzero(~np.asarray(capture.held_out))
    names, size = tuple(capture.names[t] for t in shown), capture.frames.shape[1:3]
    masks = load_features(folder / "language_features", names, size)
    tracks = load_labels(folder / "masks", names, size).labels.astype(np.int32)
    texts, canonical = load_text_features(folder / "text_features.json", bench.queries)
    gaussians = gaussians_of(bench, folder, data.kept(root, scene), fit_steps)
    cameras = jax.tree.map(jnp.asarray, capture.cameras)
    evidence = Evidence(gaussians, cameras[shown], masks.labels, masks.embeddings, masks.frame, tracks)
    levels = levels_of(evidence, folder, names)
    return Setting(
        bench,
        evidence,
        np.asarray(capture.frames)[shown],
        levels,
        associated(levels, tracks),
        texts,
        canonical,
        {name: capture.cameras[t] for t, name in enumerate(capture.names)},
        names,
        seed,
        folder,
        level,
        None if data.root else twins.words_of(bench, root, level, seed).unrelated_words,
    )


def levels_of(evidence: Evidence, folder: Path, names: tuple[str, ...]) -> tuple[Evidence, ...]:
    """The evidence of each level of the masks in `folder`, first the one given, the largest. One whose masks another
    has is left out: a twin has one level, written for all."""
    found, size = [evidence], evidence.masks.shape[1:]
    for level in ("s", "m"):
        masks = load_features(folder / "language_features", names, size, level=level)
        if not any(np.array_equal(masks.labels, other.masks) for other in found):
            own = {"masks": masks.labels, "embeddings": masks.embeddings, "frame": masks.frame}
            found.append(dataclasses.replace(evidence, **own))
    return tuple(found)


def gaussians_of(bench: Benchmark, folder: Path, kept: Path, steps: int) -> Gaussians:
    """The scene's Gaussians: its points, one each and in order; or those of <folder>/point_cloud.ply; or fitted, and
    left in `kept` under a name that says to what: levels of noise share the frames, and so the fit."""
    if len(bench.points):
        return jax.tree.map(
            jnp.asarray, gaussians_from_points(bench.points, bench.point_colors, opacity=0.9, scale=0.7)
        )
    given = folder / "point_cloud.ply"
    if given.exists():
        return load_gaussians(given)
    seen = hashlib.sha1(np.ascontiguousarray(bench.capture.frames).tobytes()).hexdigest()[:12]
    file = kept / f"{bench.name}_{seen}_{steps}.ply"
    if not file.exists():
        start, _ = starting_gaussians(bench.capture, sh_degree=0)
        gaussians, _ = fit_gaussians(bench.capture, steps=steps, key=jax.random.key(0), start=start, **FIT)
        save_gaussians(file, gaussians)
    return load_gaussians(file)
