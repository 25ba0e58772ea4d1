"""Scenes with true instance labels, seen by simulated vision: what the experiments on ideas measure on.

The Gaussians are those of the real pipeline: demo rooms fitted to their frames, and the points of a Replica scan. A
Gaussian's true object is the one that most of its weight lies on when the true masks of the voting views vote.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from experiments import replica_apartment_0, results
from experiments.simulated_vision.embeddings import SimulatedEmbedder, TextSpace, load_text_space, made_text_space
from experiments.simulated_vision.masks import LEVELS, SimulatedMasks, simulated_masks
from experiments.simulated_vision.worlds import world_of
from jsecon.app.verbs import Demo
from jsecon.demo.demo import PLAIN_ROOM, run_demo
from jsecon.language.field import load_field
from jsecon.language.votes import region_votes
from jsecon.pipeline.progress import Listener
from jsecon.types import Camera, Gaussians


@dataclasses.dataclass(frozen=True)
class Rooms:
    """The demo rooms that an experiment takes, and the texts that it asks: options that such experiments share."""

    demos: str = str(results.HOME.parent / "demos")
    """holds demo0 .. demo4, as `run_demo(demoK, seed=K, room=PLAIN_ROOM)` leaves them; made where missing."""
    texts: str = str(results.CAPTURES.parent / "text")
    """CLIP's vectors of the LVIS classes; where they are not there, made ones."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)

    def folder(self, seed: int) -> Path:
        """Of the demo of `seed`."""
        return Path(self.demos) / f"demo{seed}"

    def scenes(self) -> "dict[str, Callable[[], Scene]]":
        """A function that reads the scene, or makes it first, by name."""
        return {f"demo {seed}": lambda seed=seed: demo_scene(self.folder(seed), seed) for seed in self.seeds}

    def space(self) -> TextSpace:
        """What the classes' names are drawn from."""
        return text_space(Path(self.texts))


@dataclasses.dataclass(frozen=True)
class Places(Rooms):
    """Demo rooms, and replica_apartment_0 where it lies beside the checkout."""

    replica: str = str(results.CAPTURES / "replica_apartment_0")

    def scenes(self) -> "dict[str, Callable[[], Scene]]":
        """As Rooms.scenes; the capture comes last."""
        captures = {"replica_apartment_0": lambda: replica_scene(self.replica)}
        return super().scenes() | (captures if self.replica and Path(self.replica).is_dir() else {})


@dataclasses.dataclass(frozen=True)
class Scene:
    """Gaussians, the views that vote, and their true labels."""

    name: str
    gaussians: Gaussians
    cameras: Camera
    """batch of T."""
    frames: np.ndarray
    """(T, H, W, 3) uint8."""
    labels: np.ndarray
    """(T, H, W) int16 the true objects 0 .. K-1, -1 = none."""
    count: int
    """K."""
    seed: int
    """of the vision that looks at it, and of the objects' classes."""
    truth: np.ndarray
    """(N,) the object that most of the Gaussian's weight lies on; -1 = on none."""


@dataclasses.dataclass(frozen=True)
class Sight:
    """What simulated vision makes of a scene."""

    masks: SimulatedMasks
    embeddings: np.ndarray
    """(T, R, E) of the region's mask in each view; zero where it has none."""
    pixels: np.ndarray
    """(T, R) of that mask."""
    texts: np.ndarray
    """(K, E) of the objects' classes."""
    canonical: np.ndarray
    """(4, E)."""


def demo_scene(folder: Path, seed: int) -> Scene:
    """The demo room of `seed`, as `run_demo` with PLAIN_ROOM leaves it in FOLDER; made where it is missing."""
    if not (folder / "field.safetensors").exists():
        run_demo(folder, seed=seed, steps=Demo.steps, listener=Listener(), room=PLAIN_ROOM)
    field = load_field(folder / "field.safetensors")
    told = json.loads((folder / "capture" / "scene.json").read_text())
    voting = np.array([name not in told["held_out"] for name in field.names])

    def read(kind: str, how: int) -> list[np.ndarray]:
        files = (folder / "capture" / kind / f"{name}.png" for name, votes in zip(field.names, voting) if votes)
        return [cv2.imread(str(file), how) for file in files]

    frames = np.stack([image[..., ::-1] for image in read("images", cv2.IMREAD_COLOR)])
    labels = np.stack(read("masks", cv2.IMREAD_UNCHANGED)).astype(np.int16) - 1
    cameras = field.cameras[np.flatnonzero(voting)]
    return _scene(f"demo {seed}", field.gaussians, cameras, frames, labels, len(told["objects"]), seed)


def held_out_labels(folder: Path, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A demo room's held-out views (V,), as indices of `names`, and their true labels (V, H, W), -1 = none."""
    told = json.loads((folder / "capture" / "scene.json").read_text())
    views = np.array([t for t, name in enumerate(names) if name in told["held_out"]])
    files = (folder / "capture" / "masks" / f"{names[t]}.png" for t in views)
    labels = np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files])
    return views, labels.astype(np.int16) - 1


def replica_scene(folder: str, seed: int = 0) -> Scene:
    """replica_apartment_0 as its own experiment has it: every second view votes. An id stands for several objects."""
    options = replica_apartment_0.Options(capture=folder)
    capture, labels = replica_apartment_0.load_replica(folder, voting_every=options.voting_every)
    _, gaussians = replica_apartment_0.points_as_gaussians(capture, options)
    voting = np.flatnonzero(~capture.held_out)
    count = len(replica_apartment_0.PALETTE)
    frames = np.asarray(capture.frames)[voting]
    return _scene("replica_apartment_0", gaussians, capture.cameras[voting], frames, labels[voting], count, seed)


def _scene(name, gaussians, cameras, frames, labels, count, seed) -> Scene:
    gaussians, cameras = jax.tree.map(jnp.asarray, (gaussians, cameras))
    votes = region_votes(gaussians, cameras, jnp.asarray(labels), count)
    outside = np.asarray(votes.total - votes.labelled)
    inside, strongest = np.asarray(votes.weights[:, 0]), np.asarray(votes.regions[:, 0])
    return Scene(name, gaussians, cameras, frames, labels, count, seed, np.where(inside > outside, strongest, -1))


def text_space(folder: Path) -> TextSpace:
    """CLIP's vectors of the LVIS classes where they lie in `folder`, else a made space of the same statistics."""
    vectors, names = folder / "clip_vitb32_lvis.npy", folder / "lvis_names.json"
    return load_text_space(vectors, names) if vectors.exists() else made_text_space([f"word {i}" for i in range(1203)])


def look(scene: Scene, level: str, space: TextSpace) -> Sight:
    """Simulated vision of a named level. The objects' classes are drawn by the scene's seed, the same at each level.
    Errors that views share lean to the space's other names too."""
    noise, world = world_of(level)
    faults, views = LEVELS[noise], np.arange(len(scene.frames))
    chosen = np.random.default_rng(scene.seed).choice(len(space.names), scene.count, replace=False)
    classes = [space.names[i] for i in chosen]
    masks = simulated_masks(scene.labels, faults, seed=scene.seed)
    others = np.delete(space.vectors, chosen, axis=0)
    hard = {"world": world, "others": others}
    embedder = SimulatedEmbedder(scene.frames, scene.labels, classes, space, faults, seed=scene.seed, **hard)
    regions = len(masks.origin)
    pixels = np.zeros((len(views), regions), np.int64)
    embeddings = np.zeros((len(views), regions, embedder.dim), np.float32)
    for t, image in enumerate(masks.labels):
        here, pixels_here = np.unique(image[image >= 0], return_counts=True)
        pixels[t, here] = pixels_here
        for r in here:
            embeddings[t, r] = embedder.embed_regions(scene.frames[t], image[None] == r)[0]
    return Sight(masks, embeddings, pixels, embedder.embed_text(classes), embedder.canonical)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Each view's votes apart."""

    votes: sparse.csr_matrix
    """(N, T R) weight of mask (t, r), column t R + r, on each Gaussian."""
    seen: np.ndarray
    """(N, T) weight of all pixels of the view."""
    peak: np.ndarray
    """(N,) largest weight at any pixel."""
    seconds: float
    """CPU seconds of the pass over the views."""


def evidence(scene: Scene, labels: np.ndarray, regions: int) -> Evidence:
    """The votes of region labels (T, H, W), view by view."""
    began = time.process_time()
    count = scene.gaussians.means.shape[0]
    blocks, seen, peak = [], [], np.zeros(count, np.float32)
    for t, image in enumerate(labels):
        image = jnp.asarray(image[None], jnp.int32)
        votes = region_votes(scene.gaussians, scene.cameras[t : t + 1], image, regions)
        weights = np.asarray(votes.weights)
        rows, slots = np.nonzero(weights > 0)
        entries = weights[rows, slots], (rows, np.asarray(votes.regions)[rows, slots])
        blocks.append(sparse.csr_matrix(entries, shape=(count, regions)))
        seen.append(np.asarray(votes.total))
        peak = np.maximum(peak, np.asarray(votes.peak))
    return Evidence(sparse.hstack(blocks, format="csr"), np.stack(seen, 1), peak, time.process_time() - began)


def rooms_of(options: Any, quick: Any = None) -> Any:
    """The options of an experiment on demo rooms that the command line asks for: [--quick] [FOLDER_OF_DEMOS]."""
    parser = argparse.ArgumentParser()
    parser.add_argument("demos", nargs="?", help="where demo0 .. demo4 lie, or shall be made")
    if quick is not None:
        parser.add_argument("--quick", action="store_true", help="one scene, a few steps: at most two minutes")
    given = parser.parse_args()
    chosen = quick if quick is not None and given.quick else options
    return dataclasses.replace(chosen, demos=given.demos) if given.demos else chosen
