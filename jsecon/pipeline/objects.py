"""The stages of objects: labels of the training frames, embeddings of the regions, votes, codes."""

import functools
import itertools
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.association.consensus import Objects, track_masks
from jsecon.association.frame_superpixels import SceneSuperpixels
from jsecon.errors import InputError
from jsecon.field.columns import vote_blocks
from jsecon.field.evidence import IGNORED, list_evidence, pack_evidence, region_votes, scratch_folder, sum_evidence
from jsecon.field.regions import choose_crops, crop_geometry, join_views, region_embeddings, views_needed
from jsecon.fit.start import points_from_depth
from jsecon.networks.hub import PREFIX, Role, cached_address, catalogue
from jsecon.paper.algorithm1 import masklets
from jsecon.paper.autoencoder import encode, train_autoencoder
from jsecon.paper.distill import distill_votes
from jsecon.paper.tracker import GeometricTracker
from jsecon.parallel import map_views
from jsecon.pipeline.options import GEOMETRIC, Options
from jsecon.pipeline.stages import (
    ObjectLabels,
    RunContext,
    Stage,
    StageInput,
    StageResult,
    training_frames,
)
from jsecon.process import VIEWS_AT_ONCE, cores, memory_budget
from jsecon.read.captures.frames import evenly_spaced
from jsecon.read.masks.masks import load_nested_labels, load_proposals
from jsecon.read.masks.nesting import split_parts
from jsecon.types import Camera, Capture, Codes, Gaussians, Progress, Regions
from jsecon.views.placing import LEAST_GAIN, frames_by_need
from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.protocols import Segmenter
from jsecon.vision.surfaces import surfaces_from_depth

PART_CROPS, PART_PX = 2, 100
"""Largest number of views in which a part is embedded, and its least pixels there: fewer show an encoder little."""
_BYTES_OF_VOTES = 4 + 24
"""Bytes that votes take for each view and Gaussian while they are added up, if every view sees all Gaussians."""


def plan_objects(context: RunContext) -> list[Stage]:
    """Plans objects, their embeddings and votes; and codes, if the options ask for them."""
    return [_plan_labels(context), *_plan_regions(context), *_plan_lifting(context)]


def _plan_labels(context: RunContext) -> Stage:
    """Plans the labels of the training frames: from mask files, or proposals associated over the frames."""
    options, models, folder = context.options, context.models, context.options.masks
    key_options = context.key_options("vision_frames", "vision_minutes")
    if options.vision_minutes is not None and not _chooses_frames(context):
        problem = "no segmenter finds masks that consensus associates, and other masks have no time limit"
        raise InputError("--vision-minutes", problem, remedy="Leave it out, or name a --segmenter.")
    if folder is not None:
        key_options |= context.key_options("level")
        task, read = f"read from {folder.name}", _read_masks
        return Stage("objects", task, read, after=("load",), key_options=key_options, files=(folder,))
    if options.proposals is not None:
        task = f"proposals read from {options.proposals.name}"
        key_options |= context.key_options("level")
    elif models.segmenter is not None:
        task = f"proposals of level {options.level} by {_model_name(options.segmenter or '', 'segmenter')}"
        key_options["model"] = models.segmenter.name
    else:
        task = "proposals by colour and texture"
    if options.tracker is None:
        task += ", what the views agree on"
        key_options |= context.key_options("seed", "centre_pixel_weight")
    elif options.tracker == GEOMETRIC:
        task += ", followed through the Gaussians"
    else:
        task += f", followed by {_model_name(options.tracker, 'tracker')}"
    key_options["tracker"] = options.tracker if models.tracker is None else models.tracker.name
    after, files = ("load", "gaussians"), (options.proposals,)
    return Stage("objects", task, _find_objects, after, key_options, files, distributed=options.tracker is None)


def _model_name(folder: str | Path, role: Role) -> str:
    """The name of the model of a folder: that of the catalogue, or that of the folder."""
    folder = Path(folder)
    repository = (cached_address(folder) or "").removeprefix(PREFIX).partition("@")[0]
    names = (row.name for row in catalogue() if (row.role, row.repository) == (role, repository))
    return next(names, folder.name)


def _plan_regions(context: RunContext) -> list[Stage]:
    """Plans an embedding of each region, and of each part that the tree of objects has."""
    options, embedder, after = context.options, context.models.embedder.name, ("load", "objects")
    task = f"embedded by {embedder!r} in {options.crops} views each, or more where these scatter, weighted by pixels"
    key_options = {"embedder": embedder} | context.key_options("crops")
    stages = [Stage("regions", task, _embed_objects, after=after, key_options=key_options, distributed=True)]
    if options.tracker is None:
        kind = "parts of objects" if options.masks is None else "objects whose masks lie in others"
        task, after = f"{kind}, in at most {min(options.crops, PART_CROPS)} views each", (*after, "regions")
        stages.append(Stage("parts", task, _embed_parts, after=after, key_options=key_options, distributed=True))
    return stages


def _plan_lifting(context: RunContext) -> list[Stage]:
    """Plans the votes of the regions for each Gaussian, and the codes of the paper if the options ask for them."""
    task, after = "the strongest regions of each Gaussian", ("load", "gaussians", "objects")
    key_options = context.key_options("centre_pixel_weight", "ledger")
    votes = Stage("votes", task, _accumulate_votes, after=after, key_options=key_options, distributed=True)
    if not context.options.paper:
        return [votes]
    task = "3 numbers per region by an autoencoder, distilled into the Gaussians by their votes"
    key_options = context.key_options("seed")
    return [votes, Stage("codes", task, _compute_codes, after=("regions", "votes"), key_options=key_options)]


def _chooses_frames(context: RunContext) -> bool:
    """Whether a network finds masks in frames that are chosen by need: a tracker needs them evenly spaced."""
    return context.models.segmenter is not None and context.options.tracker is None


def _frames_of_vision(stage: StageInput) -> tuple[np.ndarray, tuple[str, ...]]:
    """Chooses the training frames in which masks are found, and notes why others are left out."""
    context, capture = stage.context, stage.results.load
    limit, minutes = context.options.vision_frames, context.options.vision_minutes
    train = training_frames(capture.held_out)
    if not _chooses_frames(context):
        return train[evenly_spaced(len(train), limit)], ()
    order = frames_by_need(stage.results.gaussians, capture.cameras[train], limit=limit, progress=stage.progress)
    why = "--vision-frames allows no more" if len(order) == limit else f"others add less than {LEAST_GAIN:.0%} each"
    if minutes is not None:
        began, segmenter = time.monotonic(), context.models.segmenter

        def segment(row: int) -> bool:
            is_early = row < 2 or time.monotonic() - began < 60 * minutes
            if is_early:  # the masks are stored on disk
                segmenter(capture.frames[train[order[row]]], row)
            return is_early

        is_early = np.array(map_views(len(order), segment, stage.progress))
        why = why if is_early.all() else "--vision-minutes allows no more"
        order = order[is_early]
    notes = (f"masks in {len(order)} of {len(train)} training frames: {why}",) if len(order) < len(train) else ()
    return train[np.sort(order)], notes


class _TrainingView:
    """The training frames in which masks are found and embedded."""

    def __init__(self, capture: Capture, options: Options, train: np.ndarray):
        self.capture, self.train = capture, train
        self.names = [capture.names[t] for t in self.train]
        self.size = capture.cameras.height, capture.cameras.width
        frames = dict(itertools.zip_longest(capture.names, capture.files))
        self.mask_layout: dict[str, Any] = {"level": options.level, "frames": frames}
        """How files of masks belong to the frames, for their readers."""

    @functools.cached_property
    def frames(self) -> np.ndarray:
        """(T, H, W, 3) their pixels: a view of the capture's if these are all of its frames, else one copy."""
        frames = np.asarray(self.capture.frames)
        return frames if len(self.train) == len(frames) else frames[self.train]

    @functools.cached_property
    def cameras(self) -> Camera:
        """Their T cameras, on jax's device."""
        return jax.tree.map(jnp.asarray, self.capture.cameras[self.train])


def _read_masks(stage: StageInput) -> StageResult:
    """Reads the labels of the training frames from mask files."""
    frames, _ = _frames_of_vision(stage)
    folder, view = stage.context.options.masks, _TrainingView(stage.results.load, stage.context.options, frames)
    assert folder is not None
    how = {"frames": view.mask_layout["frames"], "progress": stage.progress}
    loaded, parent = load_nested_labels(folder, view.names, view.size, **how)
    _clear_ignored(loaded.labels, view)
    _require_regions(loaded.labels, str(folder))
    notes = (f"{len(loaded.ids)} regions in the masks", *loaded.notes)
    return StageResult(ObjectLabels(frames=frames, **split_parts(loaded.labels, parent)), notes)


def _find_objects(stage: StageInput) -> StageResult:
    """Finds proposals in the training frames, and associates them over the frames to labels of objects."""
    context, scene = stage.context, stage.results.gaussians
    frames, why_fewer = _frames_of_vision(stage)
    view = _TrainingView(stage.results.load, context.options, frames)
    proposals, notes = _frame_proposals(context, view)
    found = _associate_masks(context, view, scene, proposals, stage.progress)
    context.models.close()
    for labels in (found.labels, *(() if found.parts is None else found.parts)):
        _clear_ignored(labels, view)
    _require_regions(found.labels, str(context.options.capture))
    return StageResult(ObjectLabels(frames=frames, **found._asdict()), notes=(*why_fewer, *notes))


def _frame_proposals(context: RunContext, view: _TrainingView) -> tuple[Callable[[int], np.ndarray], tuple[str, ...]]:
    """Opens the proposals, masks (M, H, W) of the t-th training frame: from files, a segmenter, or by colour."""
    options, frames, segmenter = context.options, view.frames, context.models.segmenter
    if options.proposals is not None:
        return load_proposals(options.proposals, view.names, view.size, **view.mask_layout)
    segment = segmenter or _classical_segmenter(options, view)
    return lambda t: np.asarray(segment(frames[t], t)), ()


def _classical_segmenter(options: Options, view: _TrainingView) -> Segmenter:
    """Opens the segmenter without weights for the training frames, with surfaces if the capture has depth.

    The depth that Gaussians render costs masks more outline than it tells.
    """
    capture, surfaces = view.capture, None
    depths = None if capture.depths is None else np.asarray(capture.depths)[view.train]
    if depths is not None and depths[:, ::4, ::4].any():
        known = depths[:, ::4, ::4]
        spacing = 0.02 * float(np.median(known[known > 0]))  # closer points show a sensor's noise, not the surface
        most = 100_000  # points whose normals are estimated
        cloud = points_from_depth(capture, voxel=spacing, max_points=most, stride=4)
        surfaces = surfaces_from_depth(depths, view.cameras, cloud.points)
    if options.tracker is None:
        return ClassicalSegmenter(surfaces=surfaces)
    # A tracker follows each mask for itself: the same thing in two layers would be followed twice.
    return ClassicalSegmenter(surfaces=surfaces, layers=(1.0,))


def _associate_masks(
    context: RunContext,
    view: _TrainingView,
    gaussians: Gaussians,
    proposals: Callable[[int], np.ndarray],
    progress: Progress,
) -> Objects:
    """Associates proposals by consensus or by a tracker, which makes no tree."""
    options, frames, cameras = context.options, view.frames, view.cameras
    if options.tracker is None:
        scene = SceneSuperpixels(gaussians, cameras, proposals, centre_pixel_weight=options.centre_pixel_weight)
        return track_masks(frames, scene, seed=options.seed, progress=progress)
    if context.models.segmenter is not None and options.proposals is None:  # it stores its masks
        proposals(0)  # opens the model once
        with ThreadPoolExecutor(min(cores(), VIEWS_AT_ONCE)) as pool:
            list(pool.map(lambda t: len(proposals(t)), range(len(frames))))
    tracker = context.models.tracker or GeometricTracker(gaussians, cameras, proposals)
    return Objects(masklets(frames, lambda frame, index: proposals(index), tracker, progress=progress))


def _clear_ignored(labels: np.ndarray, view: _TrainingView) -> None:
    """Takes the labels off the ignored pixels: of an operator, of a mask, of what --ignore names."""
    if view.capture.ignored is not None:
        for row, t in enumerate(view.train):
            labels[row][np.asarray(view.capture.ignored[t])] = -1


def _require_regions(labels: np.ndarray, where: str) -> None:
    if labels.max(initial=-1) < 0:
        remedy = "Give masks (--masks DIR), or frames with more contrast."
        raise InputError(where, "no region in any frame", "at least one", remedy)


def _embed_objects(stage: StageInput) -> StageResult:
    """Embeds each region by the embedder of the run, in few views, and then in more where these scatter."""
    context, labels = stage.context, stage.results.objects.labels
    view = _TrainingView(stage.results.load, context.options, stage.results.objects.frames)
    geometry = crop_geometry(labels, view.cameras, int(labels.max()) + 1)

    def embed(views):
        kwargs = {"views": views, "progress": stage.progress}
        return region_embeddings(view.frames, labels, context.models.embedder.embed_regions, **kwargs)

    chosen = choose_crops(*geometry, context.options.crops)
    embedded = embed(chosen)
    more = choose_crops(*geometry, np.maximum(views_needed(embedded), context.options.crops)) & ~chosen
    if more.any():
        embedded = join_views(embedded, embed(more))
    context.models.close()
    kept, total = np.count_nonzero(chosen | more), np.count_nonzero(geometry[0])
    if kept == total:
        return StageResult(embedded)
    why = f"{context.options.crops} views of a region (--crops), or as many more as its views scatter"
    return StageResult(embedded, notes=(f"{kept} of {total} crops embedded: {why}",))


def _embed_parts(stage: StageInput) -> StageResult:
    """Embeds the parts of objects in the few views that show most of them."""
    context, objects = stage.context, stage.results.objects
    if objects.parts is None or objects.part_nodes is None:
        return StageResult(None)
    view, count = _TrainingView(stage.results.load, context.options, objects.frames), len(objects.part_nodes)
    embed, most = context.models.embedder.embed_regions, min(context.options.crops, PART_CROPS)
    embeddings = np.zeros((count, stage.results.regions.embeddings.shape[1]), np.float32)
    pixels = np.zeros((count, len(view.train)), np.int32)
    for labels in objects.parts:  # each part is on one layer
        shown, cut, directions = crop_geometry(labels, view.cameras, count)
        chosen = choose_crops(np.where(shown >= PART_PX, shown, 0), cut, directions, most)
        layer = region_embeddings(view.frames, labels, embed, num_regions=count, views=chosen, progress=stage.progress)
        embeddings, pixels = embeddings + layer.embeddings, pixels + layer.pixel_counts
    context.models.close()
    return StageResult(Regions(embeddings, pixels))


def _accumulate_votes(stage: StageInput) -> StageResult:
    """Accumulates votes, on disk if they do not fit into memory; the votes are the same."""
    options, capture, scene = stage.context.options, stage.results.load, stage.results.gaussians
    objects, folder = stage.results.objects, stage.checkpoint.folder
    labels, frames = objects.labels, objects.frames
    cameras, count = capture.cameras[frames], int(labels.max()) + 1
    if capture.ignored is not None:  # what stood before a Gaussian there says nothing of it
        labels = np.where(np.asarray(capture.ignored)[frames], IGNORED, labels)
    needed, budget = _BYTES_OF_VOTES * scene.count * len(labels), memory_budget()
    on_disk = needed > budget and jax.process_count() == 1  # several processes exchange them in memory
    notes = ()
    if on_disk:
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was stopped
        sizes = f"{needed / 2**30:.2g} GiB otherwise, where memory has room for {budget / 2**30:.2g}"
        notes = (f"votes are kept on disk: {sizes}",)
    settings = {"centre_pixel_weight": options.centre_pixel_weight, "progress": stage.progress}
    with scratch_folder(folder if on_disk else None) as scratch:
        lists = list_evidence(scene, cameras, labels, count, folder=scratch, **settings)
        where = folder if on_disk else None
        accumulated = sum_evidence(lists, scene.count, count, by_view=True, folder=where)
        with ThreadPoolExecutor(cores()) as pool:
            packed = tuple(pool.map(lambda view: pack_evidence(view, count), lists)) if options.ledger else ()
    nodes = None
    if objects.leaf is None and objects.parts is not None:
        for part in objects.parts:  # of parts in parts, the smaller comes later
            labels = np.where(part >= 0, part + np.int16(count), labels)
        where = folder / "parts" if on_disk else None
        nodes = region_votes(scene, cameras, labels, int(labels.max()) + 1, folder=where, **settings).regions[:, 0]
    unseen = int((np.asarray(accumulated.views) == 0).sum())
    if unseen:
        notes = (*notes, f"no frame sees {unseen} of {scene.count} Gaussians")
    return StageResult((accumulated, packed, nodes), notes)


def _compute_codes(stage: StageInput) -> StageResult:
    """Trains the paper's autoencoder, and distils the codes of the regions into the Gaussians by their votes."""
    options, embeddings, cast = stage.context.options, stage.results.regions.embeddings, stage.results.votes[0]
    if not np.any(np.asarray(embeddings)):
        raise InputError("--paper", "no region has an embedding to train the autoencoder on", remedy="Leave it out.")
    key = jax.random.key(options.seed)
    autoencoder = train_autoencoder(embeddings, latent=3, key=key, progress=stage.progress)
    table = encode(autoencoder, embeddings)
    codes = np.concatenate([np.asarray(distill_votes(block, table)) for block in vote_blocks(cast)])
    return StageResult(Codes(codes, table, autoencoder))
