"""Real scenes with named truth: Gaussians, masks, truth, and what a labeller says.

Three scenes, each with the masks that it is asked with:

    replica_apartment_0  instance masks that are given, and those of jsecon's vision without weights
    apc_bin              the same two
    bonsai               jsecon's vision without weights; COLMAP's points as Gaussians, nothing fitted; its truth is
                         outlined by hand in held-out frames

All rules (`experiments.words.rules`) are pure functions of what `load_scene` returns.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from experiments import apc_bin, results
from experiments.baselines import lifting
from experiments.baselines.evidence import Evidence, unit
from experiments.datasets import bonsai_outlines
from experiments.datasets.depth_points import labels_of_points
from experiments.datasets.named_objects import CLASSES, NEAR_M, connected_parts, names_of_objects
from experiments.replica_apartment_0 import Options as Scan, load_replica, points_as_gaussians
from experiments.words.conse import WORDS, Conse
from jsecon.errors import InputError
from jsecon.field.evidence import region_votes
from jsecon.fit.start import starting_gaussians
from jsecon.pipeline.objects import plan_objects
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.stages import Checkpoint, ObjectLabels, Results, RunContext, StageInput
from jsecon.read.captures.capture import load_capture
from jsecon.types import Camera, Capture, Gaussians, Regions, Votes
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Models

GIVEN, DEFAULT = "given", "default"
"""masks of the data, and of jsecon's vision without weights"""
NAMED_POINTS = WORDS / "replica_apartment_0_named_points.npz"


BASELINES: dict[str, Callable[[Evidence], sparse.csr_matrix]] = {
    "weighted back-projection": lambda evidence: lifting.train_backprojection(evidence).weights,
    "Occam's LGS": lambda evidence: lifting.train_occam(evidence).weights,
    "VALA": lambda evidence: lifting.train_vala(evidence).weights,
}
"""what gives each Gaussian an embedding of its own"""
BONSAI_EVERY = 3
"""of the frames that are not held out, every so many-th votes"""
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


@dataclasses.dataclass(frozen=True, eq=False)
class WordScene:
    """A scene with its masks. N Gaussians, T views that vote, R regions, C crops."""

    name: str
    gaussians: Gaussians
    cameras: Camera
    """T."""
    frames: np.ndarray
    """(T, H, W, 3) uint8."""
    labels: np.ndarray
    """(T, H, W) int32 regions, -1 = none."""
    names: tuple[str, ...]
    """what truth has names for."""
    asked: np.ndarray
    """(Q,) the names that are asked for."""
    truth: np.ndarray
    """(N,) name of each Gaussian by views that do not vote; len(names) = something else, -1 = not judged."""
    region_names: np.ndarray
    """(R,) the true name of each region; len(names) = something else, -1 = not known."""
    things: np.ndarray
    """(N,) the single thing that each Gaussian is of, by views that do not vote; -1 = not known."""
    found: ObjectLabels | None = None
    """What default masks were found to show, with its tree; None where masks are given."""
    outlined: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """Frames (G, H, W, 3) in which things are outlined one by one, the things in them (G, H, W), -1 = none, and the
    name of each thing (X,), -1 = none that is asked for."""

    @property
    def texts(self) -> tuple[str, ...]:
        """The names that are asked for."""
        return tuple(self.names[k] for k in self.asked)

    @functools.cached_property
    def pixels(self) -> np.ndarray:
        """(R, T) int32 pixels of each region in each view."""
        count = int(self.labels.max()) + 1
        rows = [np.bincount(image[image >= 0], minlength=count) for image in self.labels]
        return np.stack(rows, 1).astype(np.int32)

    @functools.cached_property
    def votes(self) -> Votes:
        """The votes of the masks, with by_view (T, N)."""
        given = _on_device((self.gaussians, self.cameras, self.labels))
        return region_votes(*given, len(self.pixels), by_view=True)

    @functools.cached_property
    def crops(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The crops that regions are cut into, ordered by view, then by region: labels (T, H, W) by crop, and the
        region and the view (C,) of each crop."""
        masks, region, view = np.full(self.labels.shape, -1, np.int32), [], []
        for t, image in enumerate(self.labels):
            for own in np.unique(image[image >= 0]):
                masks[t][image == own] = len(region)
                region.append(own)
                view.append(t)
        return masks, np.array(region, np.int32), np.array(view, np.int32)

    def regions(self, embeddings: Float[np.ndarray, "c e"]) -> Regions:
        """The regions by embeddings of their crops (C, E): means weighted by pixels, of unit length (`phi_bar`)."""
        _, region, view = self.crops
        weight = self.pixels[region, view].astype(np.float64)
        weight = np.where(np.asarray(embeddings).any(1), weight, 0.0)
        gather = sparse.csr_matrix((weight, (region, np.arange(len(weight)))), (len(self.pixels), len(weight)))
        return Regions(unit(gather @ np.asarray(embeddings, np.float64)), self.pixels)


def _default_masks(capture: Capture, gaussians: Gaussians) -> ObjectLabels:
    """Objects of the views that vote, by the vision without weights as `jsecon run` has it."""
    work, loaded = RunContext(RunOptions(Path()), Models(ColourEmbedder()), Path()), Results(load=capture)
    loaded.gaussians = _on_device(gaussians)
    return (
        plan_objects(work)[0]
        .compute(StageInput(work, loaded, lambda done, total: None, Checkpoint(Path("objects"))))
        .value
    )


def _on_device(tree):
    return jax.tree.map(jnp.asarray, tree)


def _named(ids: Int[np.ndarray, "..."], name_of: Int[np.ndarray, " r"]) -> Int[np.ndarray, "..."]:
    """The names of ids, -1 = none."""
    return np.where(ids >= 0, name_of[np.maximum(ids, 0)], -1)


def _replica(masks: str) -> WordScene:
    capture, ids = load_replica(Scan.capture, voting_every=Scan.voting_every)
    objects = connected_parts(capture, ids)
    points, gaussians = points_as_gaussians(capture, Scan())
    if not NAMED_POINTS.exists():
        raise InputError(NAMED_POINTS, "there is no such file", remedy="Put the file of named points there.")
    with np.load(NAMED_POINTS) as told:
        positions, label, names = told["points"], told["label"], tuple(str(name) for name in told["names"])
    away, place = KDTree(positions).query(points.points, distance_upper_bound=NEAR_M)
    near = np.where(np.isfinite(away), label[np.minimum(place, len(label) - 1)], -1).astype(np.int32)
    count = int(objects.max()) + 1
    silent = np.where(capture.held_out[:, None, None], objects, -1)
    object_of = labels_of_points(points, silent, count)
    by_silent = names_of_objects(object_of, near, count, len(names))
    by_all = names_of_objects(labels_of_points(points, objects, count), near, count, len(names))
    voting = np.flatnonzero(~capture.held_out)
    labels, region_names, found = objects[voting], by_all, None
    if masks == DEFAULT:
        found = _default_masks(capture, gaussians)
        labels = found.labels
        named = _named(objects[voting], by_all)
        region_names = names_of_objects(labels.ravel(), named.ravel(), int(labels.max()) + 1, len(names))
    return WordScene(
        name="replica_apartment_0",
        gaussians=gaussians,
        cameras=capture.cameras[voting],
        frames=np.asarray(capture.frames)[voting],
        labels=labels,
        names=names,
        asked=np.array([names.index(word) for word in CLASSES]),
        truth=_named(object_of, by_silent),
        region_names=region_names,
        things=object_of,
        found=found,
    )


def _apc(masks: str) -> WordScene:
    options = apc_bin.Options()
    how = {"held_out_every": options.held_out_every, "nearest_m": options.nearest_m}
    capture, objects = apc_bin.load_apc(options.capture, **how)
    gaussians = apc_bin.build_gaussians(capture, options)
    voting, judged, count = np.flatnonzero(~capture.held_out), np.flatnonzero(capture.held_out), len(APC_TEXTS)
    labels, region_names, found = objects[voting], np.arange(count + 1), None
    if masks == DEFAULT:
        found = _default_masks(capture, gaussians)
        labels = found.labels
        region_names = names_of_objects(labels.ravel(), objects[voting].ravel(), int(labels.max()) + 1, count + 1)
    frames = np.asarray(capture.frames)
    truth = _names_by_views(gaussians, capture.cameras[judged], objects[judged], count + 1)
    return WordScene(
        name="apc_bin",
        gaussians=gaussians,
        cameras=capture.cameras[voting],
        frames=frames[voting],
        labels=labels,
        names=APC_TEXTS,
        asked=np.arange(count),
        truth=truth,
        region_names=region_names,
        things=np.where(truth < count, truth, -1),
        found=found,
        outlined=(frames, objects, np.array([*range(count), -1])),
    )


def _bonsai(masks: str) -> WordScene:
    assert masks == DEFAULT
    options = RunOptions(results.CAPTURES / "bonsai")
    capture = load_capture(options.capture, long_side=options.long_side, holdout=options.holdout)
    held = np.asarray(capture.held_out)
    kept = np.sort(np.concatenate([np.flatnonzero(held), np.flatnonzero(~held)[::BONSAI_EVERY]]))
    own = {"frames": capture.frames[kept], "cameras": capture.cameras[kept], "held_out": held[kept]}
    own |= {"names": tuple(capture.names[t] for t in kept), "files": tuple(capture.files[t] for t in kept)}
    capture = dataclasses.replace(capture, **own)
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
    voting, found = np.flatnonzero(~np.asarray(capture.held_out)), _default_masks(capture, gaussians)
    labels = found.labels
    by_thing = np.where(outlined >= 0, outlined, len(things))
    thing = _names_by_views(gaussians, capture.cameras[frames], by_thing, len(things) + 1)
    # No frame has both an outline and a region: a region's name is that of most Gaussians that it is strongest on.
    strongest = _names_by_views(gaussians, capture.cameras[voting], labels, int(labels.max()) + 1)
    return WordScene(
        name="bonsai",
        gaussians=gaussians,
        cameras=capture.cameras[voting],
        frames=np.asarray(capture.frames)[voting],
        labels=labels,
        names=names,
        asked=np.arange(len(names)),
        truth=truth,
        region_names=names_of_objects(strongest, truth, int(labels.max()) + 1, len(names) + 1),
        things=np.where(thing < len(things), thing, -1),
        found=found,
        outlined=(np.asarray(capture.frames)[frames], outlined, thing_names),
    )


def _names_by_views(gaussians: Gaussians, cameras: Camera, names: Int[np.ndarray, "f h w"], count: int) -> np.ndarray:
    """(N,) the name on whose pixels a Gaussian has the most weight in some views; -1 where none shows it."""
    given = _on_device((gaussians, cameras, names.astype(np.int32)))
    return np.asarray(region_votes(*given, count, top=1).regions)[:, 0].astype(np.int32)


SCENES: dict[str, Callable[[str], WordScene]] = {"replica_apartment_0": _replica, "apc_bin": _apc, "bonsai": _bonsai}


@functools.cache
def load_scene(name: str, masks: str) -> WordScene:
    """Makes a scene of SCENES with its masks, GIVEN or DEFAULT, of which bonsai has the latter only.

    Raises InputError where data is missing.
    """
    scene = SCENES[name](masks)
    return dataclasses.replace(scene, labels=np.asarray(scene.labels, np.int32))


@functools.cache
def scores_of(scene: WordScene, embedder: Conse) -> np.ndarray:
    """(C, K) uint8 what the labeller of `embedder` says of each crop of a scene."""
    _, region, view = scene.crops
    masks = (scene.labels[t] == own for own, t in zip(region, view))
    return np.stack([embedder.scores(scene.frames[t], mask[None])[0] for t, mask in zip(view, masks)])


def baseline_weights(scene: WordScene, method: str) -> sparse.csr_matrix:
    """(N, C) weight of each crop on each Gaussian by a method of BASELINES."""
    gaussians, cameras = _on_device((scene.gaussians, scene.cameras))
    masks, _, view = scene.crops
    nothing = np.zeros((len(view), 1), np.float32)
    return BASELINES[method](Evidence(gaussians, cameras, masks, nothing, view, scene.labels))
