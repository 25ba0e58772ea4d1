"""Twin datasets on disk with the results of simulated vision: masks, tracks, embeddings and texts in true form.

ROOT/<scene>/masks: the tracker's ids, one PNG per frame (0 = none). ROOT/<scene>/language_features: LangSplat's files.
ROOT/<scene>/text_features.json: the queries' and canonical phrases' vectors. Held-out frames get none: nothing may be
learnt from them.
"""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from experiments import results
from experiments.cells import exclusive_lock
from experiments.datasets import twins
from experiments.datasets.benchmark import Benchmark
from experiments.datasets.feature_files import write_features, write_text_features
from experiments.datasets.lerf_ovs import load_lerf_ovs
from experiments.datasets.mesh import SURROUNDINGS, surfaces_of
from experiments.datasets.ovs3d import load_ovs3d
from experiments.datasets.plain_room import make_room
from experiments.datasets.replica import load_replica
from experiments.rooms.raycast import trace_rays
from experiments.simulated_vision.embeddings import (
    SimulatedEmbedder,
    TextSpace,
    load_text_space,
    made_text_space,
    named_after,
)
from experiments.simulated_vision.masks import LEVELS as NOISE, Faults, SimulatedMasks, simulated_masks
from experiments.simulated_vision.worlds import Seen, World, seen_in, world_of
from jsecon.files import write_text
from jsecon.read.captures.images import write_image
from jsecon.read.masks.masks import LEVELS
from jsecon.vision.protocols import CANONICAL
from jsecon.vision.unrelated_words import UNRELATED_WORDS

PERFECT = Faults(0, 2, 0, 0, 0, 0, 0, 0, object_noise=1.0, view_noise=0)
"""true masks that agree in all views, each object embedded alike in all; texts and images lie apart, as in CLIP"""
KIND = 2
"""of twin: raised where what the writers write changes, so that nothing measured on another kind is taken for it"""
WRITERS = {"lerf": twins.write_lerf_twin, "ovs3d": twins.write_ovs3d_twin, "replica": twins.write_replica_twin}
LVIS = "clip_vitb32_lvis.npy", "lvis_names.json"
"""text vectors of real names, in a folder `text` beside the captures"""
ABSENT = 200
"""names that nothing in a twin has: to refuse, and for errors that views share to lean to"""


class Sight(NamedTuple):
    """What simulated vision sees of a twin's frames that may be learnt from."""

    names: list[str]
    frames: np.ndarray
    """(T, H, W, 3) uint8."""
    truth: np.ndarray
    """(T, H, W) int16 true objects, -1 = none."""
    masks: list[SimulatedMasks]
    """of each of LEVELS."""
    embedder: SimulatedEmbedder


def sight(bench: Benchmark, root: Path, level: str, seed: int) -> Sight:
    """Simulated vision of a twin's frames, with the faults of `level`."""
    told = json.loads((root / "twin.json").read_text())["scenes"][bench.name]
    shown = np.flatnonzero(~np.asarray(bench.capture.held_out))
    names = [bench.capture.names[t] for t in shown]
    images = [cv2.imread(str(root / "truth" / bench.name / f"{name}.png"), cv2.IMREAD_UNCHANGED) for name in names]
    truth, frames = np.stack(images).astype(np.int16) - 1, np.asarray(bench.capture.frames)[shown]
    words = sorted({*told["objects"], *bench.queries})
    noise, world = world_of(level)
    faults = PERFECT if noise == "perfect" else NOISE[noise]
    cameras = bench.capture.cameras[shown]
    seen = Seen(truth, truth, np.arange(len(told["objects"])))
    if world.parts or world.groups or world.shadow or world.levels:
        room = make_room(told["seed"], num_objects=len(told["objects"]) - len(SURROUNDINGS))
        depths = np.stack([trace_rays(room, cameras[t])[0] for t in range(len(shown))])
        points, _ = surfaces_of(room, dataclasses.replace(bench.capture, cameras=cameras, depths=depths), truth)
        table = len(room.objects) + SURROUNDINGS.index("table")
        seen = seen_in(world, truth, points, room, table, seed=seed)
    texts = space_of(words, world, seed)
    masks = simulated_masks(seen.masks, faults, seed=seed)
    levels = [masks] * len(LEVELS)
    if seen.small is not None and seen.large is not None:
        small, large = (simulated_masks(m, faults, seed=seed + 1000 * k) for k, m in ((1, seen.small), (2, seen.large)))
        levels = [masks, small, masks, large]
    azimuths = np.arctan2(cameras.centres[:, 1], cameras.centres[:, 0])
    hard = {"world": world, "objects": seen.objects, "azimuths": azimuths, "others": texts.absent}
    embedder = SimulatedEmbedder(
        frames, seen.content, told["objects"], texts.space, faults, seed=seed, reference=texts.unrelated_words, **hard
    )
    return Sight(names, frames, truth, levels, embedder)


def look(bench: Benchmark, root: Path, level: str, seed: int) -> None:
    """Writes the masks, tracks and embeddings of `sight`."""
    names, frames, _, levels, embedder = sight(bench, root, level, seed)
    folder, masks = root / bench.name, levels[0]
    for t, (name, frame) in enumerate(zip(names, frames, strict=True)):
        found, rows, first = [], [], {}
        for level in levels:
            if id(level) not in first:
                image = level.labels[t]
                here = np.unique(image[image >= 0])
                first[id(level)] = np.where(image >= 0, sum(map(len, rows)) + np.searchsorted(here, image), -1)
                rows.append(embedder.embed_regions(frame, image[None] == here[:, None, None]))
            found.append(first[id(level)])
        write_features(folder / "language_features", name, np.stack(found), np.concatenate(rows))
        write_image(folder / "masks" / f"{name}.png", (masks.labels[t] + 1).astype(np.uint16))
    vectors = np.concatenate([embedder.embed_text(list(bench.queries)), embedder.canonical_phrases])
    write_text_features(folder / "text_features.json", [*bench.queries, *CANONICAL], vectors)


class Words(NamedTuple):
    """The texts of a twin's space."""

    space: TextSpace
    """its own names and the benchmark's queries."""
    absent: np.ndarray
    """(ABSENT, E) vectors of names that nothing in the twin has."""
    unrelated_words: np.ndarray
    """(W, E) vectors of the unrelated words, one for each of `UNRELATED_WORDS`."""


def space_of(words: list[str], world: World, seed: int) -> Words:
    """The texts of a twin with these words."""
    absent = [f"absent{n}" for n in range(ABSENT)]
    reference = [f"reference{n}" for n in range(len(UNRELATED_WORDS))]
    ends = np.cumsum([len(words), len(absent), len(reference)])
    if world.lvis:
        real = load_text_space(*(results.CAPTURES.parent / "text" / name for name in LVIS))
        own = named_after(real, words, near=world.lvis == 1, seed=seed, others=[*absent, *reference])
        spaces = [TextSpace(own.names[:end], own.vectors[:end]) for end in ends]
    else:
        # A space for each: a product of more rows need not give the first ones the same bits.
        names = [*words, *absent, *reference]
        spaces = [made_text_space(names[:end], seed=seed, common=world.names) for end in ends]
    return Words(spaces[0], spaces[1].vectors[ends[0] :], spaces[2].vectors[ends[1] :])


def words_of(bench: Benchmark, root: Path, level: str, seed: int) -> Words:
    """The texts of a twin under simulated vision of a level."""
    return space_of(sorted({*objects_of(bench, root), *bench.queries}), world_of(level)[1], seed)


def objects_of(bench: Benchmark, root: Path) -> list[str]:
    """The names of a twin's objects, by their labels; its surroundings come last."""
    return json.loads((root / "twin.json").read_text())["scenes"][bench.name]["objects"]


@dataclasses.dataclass(frozen=True)
class Data:
    """Which scenes an experiment runs on: a real dataset's root, or twins made under the results' folder."""

    dataset: str
    root: str = ""
    """of the real dataset; empty: twins."""
    twins: str = "twins"
    """folder of the twins, from the checkout on."""
    scenes: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0, 1, 2)
    """of the twins and their vision; a real dataset has the first alone, for the training."""
    size: tuple[tuple[str, int | float], ...] = ()
    """of the twins: options of their writer."""
    every: int = 10
    """frames of a real scan of which one is taken (Replica has thousands)."""
    downscale: float | None = None
    """of real frames."""

    def load(self, root: Path, scene: str) -> Benchmark:
        """The scene under the root that `place` gave."""
        if self.dataset == "lerf":
            return load_lerf_ovs(root, scene, downscale=self.downscale)
        if self.dataset == "ovs3d":
            return load_ovs3d(root, scene, downscale=self.downscale)
        return load_replica(root, scene, every=self.every if self.root else 1, downscale=self.downscale)

    def place(self, scene: str, seed: int, level: str) -> Path:
        """The root that holds the scene: a twin with simulated vision of `level` is made where it is not there yet.

        Each (seed, level, size) has a root of its own: a scene's vision lies beside its frames, and twins of another
        size have other labelled frames. One process at a time writes to a root.
        """
        if self.root:
            return Path(self.root)
        kind = json.dumps({"size": dict(self.size), "kind": KIND}, sort_keys=True)
        name = f"{self.dataset}-seed{seed}-{level}-{hashlib.sha1(kind.encode()).hexdigest()[:8]}"
        root = results.HOME.parent / self.twins / name
        marker = root / scene / "made.json"
        if marker.exists():
            return root
        with exclusive_lock(root / "twin.lock", wait=True):
            if not marker.exists():
                number = sum(map(ord, scene))  # the scenes of a dataset are rooms of their own
                WRITERS[self.dataset](root, scene, 1000 * seed + number, **dict(self.size))
                look(self.load(root, scene), root, level, seed)
                write_text(marker, kind)
        return root

    def kept(self, root: Path, scene: str) -> Path:
        """Where Gaussians fitted to the scene are kept: twins of all levels of noise share them."""
        return root / scene if self.root else root.parent / "fitted"
