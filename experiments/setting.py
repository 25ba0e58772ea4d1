"""A benchmark's scene made ready for every method: the same Gaussians, masks, tracks and texts for all of them."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import twins
from jsecon.baselines.evidence import Evidence
from jsecon.data.benchmark import Benchmark
from jsecon.data.labels import load_labels
from jsecon.data.langsplat_files import load_features, load_text_features
from jsecon.data.ply import load_ply, save_ply
from jsecon.fit.initialise import gaussians_from_points
from jsecon.fit.optimise import fit_gaussians
from jsecon.fit.start import starting_gaussians
from jsecon.types import Camera, Gaussians


@dataclasses.dataclass(frozen=True)
class Setting:
    """One scene, one seed, one level of noise."""

    bench: Benchmark
    evidence: Evidence
    track_embeddings: np.ndarray
    """(R, E) unit, of each track the mean of its masks' embeddings weighted by their pixels (phi_bar)."""
    track_pixels: np.ndarray
    """(R, T)."""
    uniform_embeddings: np.ndarray
    """(R, E) the same with each view counting alike."""
    texts: np.ndarray
    """(Q, E) of bench.queries."""
    canonical: np.ndarray
    """(4, E)."""
    cameras: dict[str, Camera]
    """of all frames, by name."""
    names: tuple[str, ...]
    """of the frames that are learnt from."""
    seed: int


def prepare(data: twins.Data, scene: str, seed: int, level: str, *, fit_steps: int) -> Setting:
    """Loads a scene and what vision says of it; fits its Gaussians where neither the dataset has them (points, or
    <scene>/point_cloud.ply) nor an earlier run."""
    root = data.place(scene, seed, level)
    bench = data.load(root, scene)
    capture, folder = bench.capture, root / scene
    shown = np.flatnonzero(~np.asarray(capture.held_out))
    names, size = tuple(capture.names[t] for t in shown), capture.frames.shape[1:3]
    masks = load_features(folder / "language_features", names, size)
    tracks = load_labels(folder / "masks", names, size, shared=True).labels.astype(np.int32)
    texts, canonical = load_text_features(folder / "text_features.json", bench.queries)
    gaussians = gaussians_of(bench, folder, fit_steps)
    cameras = jax.tree.map(jnp.asarray, capture.cameras)
    evidence = Evidence(gaussians, cameras[shown], masks.labels, masks.embeddings, masks.frame, tracks)
    pixels = overlaps(tracks, masks.labels, len(masks.embeddings))
    count = np.zeros((len(pixels), len(names)), np.int64)
    for t in range(len(names)):
        count[:, t] = pixels[:, masks.frame == t].sum(1)
    share = pixels / np.maximum(count[:, masks.frame], 1)
    return Setting(
        bench,
        evidence,
        _unit(pixels @ masks.embeddings),
        count,
        _unit(share @ masks.embeddings),
        texts,
        canonical,
        {name: capture.cameras[t] for t, name in enumerate(capture.names)},
        names,
        seed,
    )


def overlaps(tracks: np.ndarray, masks: np.ndarray, count: int) -> np.ndarray:
    """(R, M) pixels that lie in both the track and the mask."""
    regions = int(tracks.max(initial=-1)) + 1
    both = (tracks >= 0) & (masks >= 0)
    joint = np.bincount(tracks[both].astype(np.int64) * count + masks[both], minlength=regions * count)
    return joint.reshape(regions, count)


def gaussians_of(bench: Benchmark, folder: Path, steps: int) -> Gaussians:
    """The scene's Gaussians: its points, one each and in order; or those of a .ply; or fitted, and kept as one."""
    if len(bench.points):
        return jax.tree.map(
            jnp.asarray, gaussians_from_points(bench.points, bench.point_colors, opacity=0.9, scale=0.7)
        )
    given, kept = folder / "point_cloud.ply", folder / f"fitted_{steps}.ply"
    for file in (given, kept):
        if file.exists():
            return load_ply(file)
    start, _ = starting_gaussians(bench.capture)
    gaussians, _ = fit_gaussians(bench.capture, steps=steps, key=jax.random.key(0), start=start)
    save_ply(kept, gaussians)
    return load_ply(kept)


def _unit(rows: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.where(length > 0, rows / np.where(length > 0, length, 1), 0).astype(np.float32)
