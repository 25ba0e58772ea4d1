"""Real scenes with named truth, made once and kept on disk: Gaussians, regions, votes, truth, and what a labeller says.

Three scenes, each with the masks that it is asked with:

    replica_apartment_0  instance masks that are given, and those of jsecon's vision without weights
    apc_bin              the same two
    bonsai               jsecon's vision without weights; COLMAP's points as Gaussians, nothing fitted; its truth is
                         outlined by hand in held-out frames

What takes long lies in one file for a scene and its masks, the labeller's scores for a crop in another. All rules
(`experiments.words.rules`) are pure functions of what `load_scene` returns.
"""

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from experiments import apc_bin, results
from experiments.datasets import bonsai_outlines
from experiments.datasets.depth_points import labels_of_points
from experiments.datasets.named_objects import CLASSES, NEAR_M, connected_parts, names_of_objects
from experiments.replica_apartment_0 import Options as Scan, load_replica, points_as_gaussians
from experiments.rivals import lifting
from experiments.rivals.evidence import Evidence
from experiments.words.conse import WORDS, Conse
from jsecon.association.atoms import atom_votes
from jsecon.data.capture import load_capture
from jsecon.errors import InputError
from jsecon.files import atomic_write
from jsecon.fit.start import starting_gaussians
from jsecon.language.votes import region_votes
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.results import RunContext
from jsecon.pipeline.stages import associate_masks, frame_proposals
from jsecon.types import Camera, Capture, Gaussians, Regions, Votes
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Networks

VERSION = 1
"""of what is kept of a scene: counted up when this module changes. Remove the folder when jsecon's masks or votes do"""
GIVEN, DEFAULT = "given", "default"
"""masks of the data, and of jsecon's vision without weights"""


def back_projected(evidence: Evidence) -> sparse.csr_matrix:
    """(N, M) the sum of alpha T of each Gaussian over the pixels of each mask: the weights of
    `lifting.train_backprojection`, without a dense row for each Gaussian, as scenes here have many masks."""
    masks, frame = np.asarray(evidence.masks), np.asarray(evidence.frame)
    blocks = []
    for t, image in enumerate(masks):
        own = np.flatnonzero(frame == t)
        place = np.full(len(frame) + 1, -1, np.int32)
        place[own] = np.arange(len(own))
        cast = atom_votes(evidence.gaussians, evidence.cameras[t], place[image], negligible=0.0).tocoo()
        blocks.append((cast.data, cast.row, own[cast.col]))
    values, rows, columns = (np.concatenate(parts) for parts in zip(*blocks))
    return sparse.csr_matrix((values, (rows, columns)), shape=(evidence.gaussians.count, len(frame)))


RIVALS: dict[str, Callable[[Evidence], sparse.csr_matrix]] = {
    "weighted back-projection": back_projected,
    "Occam's LGS": lambda evidence: lifting.train_occam(evidence).weights.tocsr(),
    "VALA": lambda evidence: lifting.train_vala(evidence).weights.tocsr(),
}
"""what gives each Gaussian an embedding of its own"""
BONSAI_EVERY = 3
"""of the frames that are not held out, every so many-th votes"""
JUDGED = 20
"""held-out views, at most, evenly spaced, in which selections are rendered"""
APC_TEXTS = ("chenille stems", "children book", "tissue box", "joke book")
"""of `apc_bin.OBJECTS` in order: its names less the brands"""
BONSAI_TEXTS = {
    "pink blossom": "flower",
    "black pot": "pot",
    "brown stand": "plant stand",
    "purple cloth": "tablecloth",
    "red notebook": "notebook",
    "purple notebook": "notebook",
    "black bench": "bench",
    "black chair": "chair",
    "blue armchair": "armchair",
    "white crate": "crate",
    "brown box": "cardboard box",
    "white door": "door",
    "green rug": "rug",
}
"""what is outlined, by its noun: the labeller knows no colours. Chosen before anything was measured"""


PICTURES = ("frames", "labels", "shown", "things", "thing_names")
"""of a scene's file: what only crops are cut from"""


@dataclasses.dataclass(frozen=True)
class WordScene:
    """A scene with its masks, all of whose arrays are NumPy's. N Gaussians, T views that vote, R regions, C crops."""

    name: str
    masks: str
    """GIVEN or DEFAULT."""
    gaussians: Gaussians
    cameras: Camera
    """T."""
    votes: Votes
    """with by_view (T, N)."""
    pixels: np.ndarray
    """(R, T) int32 pixels of each region in each view."""
    region: np.ndarray
    """(C,) int32 region of each crop; crops are ordered by view, then by region."""
    view: np.ndarray
    """(C,) int32 its view."""
    names: tuple[str, ...]
    """what truth has names for."""
    asked: np.ndarray
    """(Q,) int32 the names that are asked for."""
    truth: dict[str, np.ndarray]
    """"T1", "T2" -> (N,) int32 name of each Gaussian; len(names) = something else, -1 = not judged."""
    region_names: np.ndarray
    """(R,) int32 the true name of each region; len(names) = something else, -1 = not known."""
    judged: Camera
    """F held-out views."""
    outlines: np.ndarray
    """(F, H, W) int16 names; len(names) = something else, -1 = not judged."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The names that are asked for."""
        return tuple(self.names[k] for k in self.asked)

    def regions(self, crops: Float[np.ndarray, "c e"]) -> Regions:
        """The regions by embeddings of their crops (C, E): means weighted by pixels, of unit length (`phi_bar`)."""
        weight = self.pixels[self.region, self.view].astype(np.float64)
        weight = np.where(np.asarray(crops).any(1), weight, 0.0)
        gather = sparse.csr_matrix((weight, (self.region, np.arange(len(weight)))), (len(self.pixels), len(weight)))
        total = gather @ np.asarray(crops, np.float64)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        unit = np.where(length > 0, total / np.where(length > 0, length, 1.0), 0.0)
        return Regions(unit.astype(np.float32), self.pixels)


@dataclasses.dataclass(frozen=True)
class Sources:
    """Where the data lies."""

    replica: str = Scan.capture
    named_points: str = str(WORDS / "replica_apartment_0_named_points.npz")
    apc: str = apc_bin.Options.capture
    bonsai: str = str(results.CAPTURES / "bonsai")


@dataclasses.dataclass(frozen=True)
class _Raw:
    """A scene before its votes are cast."""

    gaussians: Gaussians
    cameras: Camera
    frames: np.ndarray
    labels: np.ndarray
    names: tuple[str, ...]
    asked: np.ndarray
    truth: dict[str, np.ndarray]
    region_names: np.ndarray
    judged: Camera
    outlines: np.ndarray
    shown: np.ndarray
    """(G, H, W, 3) frames in which things are outlined one by one."""
    things: np.ndarray
    """(G, H, W) things in them, -1 = none."""
    thing_names: np.ndarray
    """(X,) name of each thing, -1 = none that is asked for."""


def _default_masks(capture: Capture, gaussians: Gaussians, folder: Path) -> np.ndarray:
    """labels (T, H, W) of the views that vote, by the vision without weights as `jsecon run` has it; each view's
    proposals are kept in `folder`, so that a run that was stopped goes on."""
    work, scene = RunContext(RunOptions(capture=Path()), Networks(ColourEmbedder()), folder), _on_device(gaussians)
    propose, size = frame_proposals(work, capture, scene)[0], capture.frames.shape[1:3]
    folder.mkdir(parents=True, exist_ok=True)

    def proposals(t: int) -> np.ndarray:
        kept = folder / f"proposals_{t}.npy"
        if not kept.exists():
            found = propose(t)
            with atomic_write(kept) as temporary, open(temporary, "wb") as stream:
                np.save(stream, np.packbits(found.reshape(len(found), -1), axis=1))
        bits = np.unpackbits(np.load(kept), axis=1, count=size[0] * size[1])
        return bits.astype(bool).reshape(-1, *size)

    return associate_masks(work, capture, scene, proposals, lambda done, total: None)


def _on_device(tree):
    return jax.tree.map(jnp.asarray, tree)


def _named(ids: Int[np.ndarray, "..."], name_of: Int[np.ndarray, " r"]) -> Int[np.ndarray, "..."]:
    """The names of ids, -1 = none."""
    return np.where(ids >= 0, name_of[np.maximum(ids, 0)], -1)


def _majority(labels: Int[np.ndarray, "t h w"], names: Int[np.ndarray, "t h w"], regions: int, count: int):
    """(R,) the name that most named pixels of each region have; -1 where none has any."""
    return names_of_objects(labels.ravel(), names.ravel(), regions, count)


def _some(frames: Int[np.ndarray, " f"]) -> Int[np.ndarray, " g"]:
    """JUDGED of the frames, evenly spaced."""
    if len(frames) <= JUDGED:
        return frames
    return frames[np.linspace(0, len(frames) - 1, JUDGED).round().astype(int)]


def _replica(sources: Sources, masks: str, folder: Path) -> _Raw:
    capture, ids = load_replica(sources.replica, voting_every=Scan.voting_every)
    objects = connected_parts(capture, ids)
    points, gaussians = points_as_gaussians(capture, Scan(capture=sources.replica))
    if not Path(sources.named_points).exists():
        raise InputError(sources.named_points, "no such file", "named points (.npz)", "Give the file of named points.")
    with np.load(sources.named_points) as told:
        positions, label, names = told["points"], told["label"], tuple(str(name) for name in told["names"])
    away, place = KDTree(positions).query(points.points, distance_upper_bound=NEAR_M)
    near = np.where(np.isfinite(away), label[np.minimum(place, len(label) - 1)], -1).astype(np.int32)
    count = int(objects.max()) + 1
    silent = np.where(capture.held_out[:, None, None], objects, -1)
    object_of = labels_of_points(points, silent, count)
    by_silent = names_of_objects(object_of, near, count, len(names))
    by_all = names_of_objects(labels_of_points(points, objects, count), near, count, len(names))
    voting, judged = np.flatnonzero(~capture.held_out), _some(np.flatnonzero(capture.held_out))
    if masks == GIVEN:
        labels, region_names = objects[voting], by_all
    else:
        labels = _default_masks(capture, gaussians, folder)
        named = _named(objects[voting], by_all)
        region_names = _majority(labels, named, int(labels.max()) + 1, len(names))
    return _Raw(
        gaussians,
        capture.cameras[voting],
        np.asarray(capture.frames)[voting],
        labels,
        names,
        np.array([names.index(word) for word in CLASSES], np.int32),
        {"T1": near, "T2": _named(object_of, by_silent)},
        region_names,
        capture.cameras[judged],
        _named(objects[judged], by_silent),
        np.asarray(capture.frames)[judged],
        objects[judged],
        by_silent,
    )


def _apc(sources: Sources, masks: str, folder: Path) -> _Raw:
    options = apc_bin.Options(capture=sources.apc)
    how = {"held_out_every": options.held_out_every, "nearest_m": options.nearest_m}
    capture, objects = apc_bin.load_apc(options.capture, **how)
    gaussians = apc_bin.build_gaussians(capture, options)
    voting, judged, count = np.flatnonzero(~capture.held_out), np.flatnonzero(capture.held_out), len(APC_TEXTS)
    labels, region_names = objects[voting], np.arange(count + 1)
    if masks == DEFAULT:
        labels = _default_masks(capture, gaussians, folder)
        region_names = _majority(labels, objects[voting], int(labels.max()) + 1, count + 1)
    truth = _names_by_views(gaussians, capture.cameras[judged], objects[judged], count + 1)
    return _Raw(
        gaussians,
        capture.cameras[voting],
        np.asarray(capture.frames)[voting],
        labels,
        APC_TEXTS,
        np.arange(count, dtype=np.int32),
        {"T2": truth},
        region_names,
        capture.cameras[judged],
        objects[judged],
        np.asarray(capture.frames),
        objects,
        np.where(np.arange(count + 1) < count, np.arange(count + 1), -1),
    )


def _bonsai_frames(sources: Sources) -> Capture:
    """bonsai's frames that are held out, and every BONSAI_EVERY-th of the others."""
    options = RunOptions(Path(sources.bonsai))
    capture = load_capture(options.capture, long_side=options.long_side, holdout=options.holdout)
    held = np.asarray(capture.held_out)
    kept = np.sort(np.concatenate([np.flatnonzero(held), np.flatnonzero(~held)[::BONSAI_EVERY]]))
    own = {"frames": capture.frames[kept], "cameras": capture.cameras[kept], "held_out": held[kept]}
    names, files = (tuple(values[t] for t in kept) for values in (capture.names, capture.files))
    return dataclasses.replace(capture, names=names, files=files, **own)


def _bonsai(sources: Sources, masks: str, folder: Path) -> _Raw:
    capture = _bonsai_frames(sources)
    gaussians = starting_gaussians(capture)[0]
    names = tuple(dict.fromkeys(BONSAI_TEXTS.values()))
    things = bonsai_outlines.outlines(capture)
    frames = np.array(sorted({t for own in things.values() for t in own}))
    outlined = np.full((len(frames), *capture.frames.shape[1:3]), -1, np.int16)
    for k, own in enumerate(things.values()):
        for t, mask in own.items():
            outlined[np.searchsorted(frames, t)][mask] = k
    thing_names = np.array([names.index(BONSAI_TEXTS[thing]) for thing in things])
    outlines = np.where(outlined >= 0, thing_names[outlined], len(names)).astype(np.int16)
    truth = _names_by_views(gaussians, capture.cameras[frames], outlines, len(names) + 1)
    voting, labels = np.flatnonzero(~np.asarray(capture.held_out)), _default_masks(capture, gaussians, folder)
    # No frame has both an outline and a region: a region's name is that of most Gaussians that it is strongest on.
    count = int(labels.max()) + 1
    votes = region_votes(*_on_device((gaussians, capture.cameras[voting])), _on_device(labels), count, top=1)
    region_names = names_of_objects(np.asarray(votes.regions)[:, 0], truth, count, len(names) + 1)
    return _Raw(
        gaussians,
        capture.cameras[voting],
        np.asarray(capture.frames)[voting],
        labels,
        names,
        np.arange(len(names), dtype=np.int32),
        {"T2": truth},
        region_names,
        capture.cameras[frames],
        outlines,
        np.asarray(capture.frames)[frames],
        outlined,
        thing_names,
    )


def _names_by_views(gaussians: Gaussians, cameras: Camera, names: Int[np.ndarray, "f h w"], count: int) -> np.ndarray:
    """(N,) the name on whose pixels a Gaussian has the most weight in some views; -1 where none shows it."""
    given = jax.tree.map(jnp.asarray, (gaussians, cameras))
    votes = region_votes(*given, jnp.asarray(names.astype(np.int32)), count, top=1)
    return np.asarray(votes.regions)[:, 0].astype(np.int32)


SCENES: dict[str, tuple[Callable[[Sources, str, Path], _Raw], tuple[str, ...]]] = {
    "replica_apartment_0": (_replica, (GIVEN, DEFAULT)),
    "apc_bin": (_apc, (GIVEN, DEFAULT)),
    "bonsai": (_bonsai, (DEFAULT,)),
}
"""what makes a scene, and the masks that it comes with"""


def load_scene(folder: str | Path, name: str, masks: str, sources: Sources = Sources()) -> WordScene:
    """A scene of SCENES with its masks, from `folder`, or made and kept there.

    Raises InputError where data is missing.
    """
    file = _file_of(Path(folder), name, masks, sources)
    if not file.exists():
        raw = SCENES[name][0](sources, masks, Path(folder) / name)
        _write(file, _arrays(raw))
    with np.load(file) as kept:
        return _scene(name, masks, {key: kept[key] for key in kept.files if key not in PICTURES})


def things_of(folder: str | Path, name: str, masks: str, sources: Sources = Sources()):
    """Frames (G, H, W, 3) of a scene, the things outlined in them (G, H, W), -1 = none, and the name of each thing
    (X,), -1 = none that is asked for."""
    load_scene(folder, name, masks, sources)
    with np.load(_file_of(Path(folder), name, masks, sources)) as kept:
        return tuple(kept[key] for key in PICTURES[2:])


def _file_of(folder: Path, name: str, masks: str, sources: Sources) -> Path:
    told = [Path(place).name for place in dataclasses.astuple(sources)]
    key = hashlib.sha256(repr((VERSION, told)).encode()).hexdigest()[:8]
    return folder / f"{name}-{masks}-{key}.npz"


def scores_of(folder: str | Path, scene: WordScene, embedder: Conse, sources: Sources = Sources()) -> np.ndarray:
    """(C, K) uint8 what the labeller of `embedder` says of each crop of a scene, from `folder`, or measured and kept
    there."""
    file = _file_of(Path(folder), scene.name, scene.masks, sources)
    crop = embedder.crop
    key = hashlib.sha256(embedder.labeller.file.read_bytes()).hexdigest()[:8]
    kept = file.with_name(f"{file.stem}-scores-{crop.margin:g}-{crop.shape}-{crop.surroundings}-{key}.npy")
    if not kept.exists():
        with np.load(file) as arrays:
            frames, labels = arrays["frames"], arrays["labels"]
        found = np.zeros((len(scene.region), len(embedder.labeller.names)), np.uint8)
        for t in range(len(frames)):
            own = np.flatnonzero(scene.view == t)
            for k in own:
                found[k] = embedder.scores(frames[t], (labels[t] == scene.region[k])[None])[0]
        with atomic_write(kept) as temporary, open(temporary, "wb") as stream:
            np.save(stream, found)
    return np.load(kept)


def _write(file: Path, arrays: dict[str, np.ndarray]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def _arrays(raw: _Raw) -> dict[str, np.ndarray]:
    """All that is kept of a scene: what was given, and the votes of its masks by every method."""
    labels, count = np.asarray(raw.labels, np.int32), int(raw.labels.max()) + 1
    gaussians, cameras = jax.tree.map(jnp.asarray, (raw.gaussians, raw.cameras))
    votes = region_votes(gaussians, cameras, jnp.asarray(labels), count, by_view=True)
    _, region, view = _masks_of(labels)
    arrays = {
        "frames": raw.frames,
        "labels": labels.astype(np.int16),
        "names": np.array(raw.names),
        "asked": raw.asked,
        "region_names": np.asarray(raw.region_names, np.int32),
        "outlines": np.asarray(raw.outlines, np.int16),
        "shown": raw.shown,
        "things": np.asarray(raw.things, np.int16),
        "thing_names": np.asarray(raw.thing_names, np.int32),
        "pixels": np.stack([np.bincount(image[image >= 0], minlength=count) for image in labels], 1).astype(np.int32),
        "region": region,
        "view": view,
    }
    arrays |= {f"truth {name}": np.asarray(own, np.int32) for name, own in raw.truth.items()}
    for kind, tree in (
        ("gaussians", raw.gaussians),
        ("cameras", raw.cameras),
        ("judged", raw.judged),
        ("votes", votes),
    ):
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if value is not None:
                arrays[f"{kind} {field.name}"] = np.asarray(value)
    return arrays


def _masks_of(labels: Int[np.ndarray, "t h w"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The crops that regions are cut into: labels (T, H, W) by crop, and the region and the view of each crop (C,)."""
    masks, region, view = np.full(labels.shape, -1, np.int32), [], []
    for t, image in enumerate(labels):
        for own in np.unique(image[image >= 0]):
            masks[t][image == own] = len(region)
            region.append(own)
            view.append(t)
    return masks, np.array(region, np.int32), np.array(view, np.int32)


def rival_weights(folder: str | Path, scene: WordScene, method: str, sources: Sources = Sources()) -> sparse.csr_matrix:
    """(N, C) weight of each crop on each Gaussian by a method of RIVALS, from `folder`, or measured and kept there."""
    file = _file_of(Path(folder), scene.name, scene.masks, sources)
    kept = file.with_name(f"{file.stem}-{method.replace(' ', '-').replace(chr(39), '')}.npz")
    if not kept.exists():
        with np.load(file) as arrays:
            labels = np.asarray(arrays["labels"], np.int32)
        gaussians, cameras = jax.tree.map(jnp.asarray, (scene.gaussians, scene.cameras))
        masks, nothing = _masks_of(labels)[0], np.zeros((len(scene.view), 1), np.float32)
        found = RIVALS[method](Evidence(gaussians, cameras, masks, nothing, scene.view, labels))
        _write(kept, {part: getattr(found, part) for part in ("data", "indices", "indptr")})
    with np.load(kept) as arrays:
        parts = tuple(arrays[part] for part in ("data", "indices", "indptr"))
        return sparse.csr_matrix(parts, shape=(scene.gaussians.count, len(scene.region)))


def _scene(name: str, masks: str, arrays: dict[str, np.ndarray]) -> WordScene:
    def tree(kind, record):
        own = {key.removeprefix(f"{kind} "): value for key, value in arrays.items() if key.startswith(f"{kind} ")}
        static = ("width", "height", "num_regions")
        return record(**{key: int(value) if key in static else value for key, value in own.items()})

    return WordScene(
        name,
        masks,
        tree("gaussians", Gaussians),
        tree("cameras", Camera),
        tree("votes", Votes),
        arrays["pixels"],
        arrays["region"],
        arrays["view"],
        tuple(str(word) for word in arrays["names"]),
        arrays["asked"],
        {key.removeprefix("truth "): value for key, value in arrays.items() if key.startswith("truth ")},
        arrays["region_names"],
        tree("judged", Camera),
        arrays["outlines"],
    )
