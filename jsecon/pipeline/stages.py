"""The stages of a run. A function `_plan_...` plans a stage, the function below it computes the result.

    poses, load, gaussians, masklets, regions, parts, votes, codes, held_out

Only `load`, `field_of` and the measurement of quality read held-out frames.
"""

import dataclasses
import functools
import itertools
import shutil
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.association.consensus import consensus_masklets, pieces_on_masks
from jsecon.association.run_lengths import cache_masks_as_rle
from jsecon.association.scene import SceneSuperpixels
from jsecon.errors import InputError
from jsecon.field.columns import is_mapped, vote_blocks
from jsecon.field.membership import normalise_votes_in_blocks
from jsecon.field.regions import Embed, embeddings_of_masks, region_embeddings, scene_parts
from jsecon.field.streaming import region_votes_in_blocks
from jsecon.field.votes import region_votes, votes_memory
from jsecon.files import write_text
from jsecon.fit.depth import points_from_depth
from jsecon.fit.quality import QUICK_LONG_SIDE, is_weak, measure_quality
from jsecon.fit.start import starting_gaussians
from jsecon.networks.hub import model_name
from jsecon.paper.algorithm1 import clean_masklets, masklets as algorithm1
from jsecon.paper.autoencoder import encode, train_autoencoder
from jsecon.paper.distill import distill_votes
from jsecon.paper.tracker import GeometricTracker
from jsecon.pipeline.bare_stages import bare_stages, require_options_apply
from jsecon.pipeline.options import Options, is_bare_scene
from jsecon.pipeline.results import (
    KEY_FILE,
    Checkpoint,
    Results,
    RunContext,
    Stage,
    StageInput,
    StageResult,
    training_frames,
    vision_frames,
)
from jsecon.pipeline.scene_files import check_overlap, place_in_capture, read_scene
from jsecon.poses.sfm import find_poses
from jsecon.process import memory_budget
from jsecon.read.captures.capture import has_depth, load_capture, unposed_photographs
from jsecon.read.captures.nerfstudio import source_from_trained
from jsecon.read.captures.photographs import list_photographs
from jsecon.read.captures.video import DEFAULT_VIDEO_FRAMES, is_video, write_frames
from jsecon.read.masks.langsplat import load_features
from jsecon.read.masks.masks import load_labels
from jsecon.read.masks.proposals import load_proposals
from jsecon.splat.render import render_depth
from jsecon.types import Camera, Capture, Codes, Gaussians, LanguageField, Progress, Regions
from jsecon.vision.classical import GRANULARITIES, ClassicalSegmenter
from jsecon.vision.protocols import Embedder, Segmenter
from jsecon.vision.reference_words import reference_of
from jsecon.vision.surfaces import smooth_depth, surfaces_from_depth

SECONDS_PER_STEP = 0.024
"""s of a step of the fit, on two cores of an AMD EPYC; estimates how many steps --minutes allows"""
SECONDS_PER_MEGAPIXEL = 0.2
"""s more of a step per million pixels of a frame"""
SH_DEGREE = 2
"""degree of the spherical harmonics of fitted colours"""
LONG_STEPS = 3000
"""Number of steps from which a fit counts as long."""
LONG_MINUTES = 3.0
"""Minutes from which a fit counts as long."""
MAX_CLOUD_POINTS = 100_000
"""points from depth whose normals are estimated"""
MIN_CLOUD_SPACING = 0.02
"""least distance between them, as a share of the median depth: closer points show a sensor's noise, not the surface"""
LATENT = 3
"""numbers of a code in the paper"""


def run_stages(context: RunContext) -> list[Stage]:
    """Plans the stages of a run. Mask files come before the long fit, so that their errors are found early."""
    first = [_plan_gaussians(context), _plan_masklets(context)]
    if context.options.masks is not None:
        first.reverse()
    parts = [_plan_parts(context)] if context.options.parts else []
    codes = [_plan_codes(context)] if context.options.paper else []
    last = [_plan_votes(context), *codes, _plan_held_out(context)]
    return [*capture_stages(context), *first, _plan_regions(context), *parts, *last]


def fit_stages(context: RunContext) -> list[Stage]:
    """Plans the stages that make and measure the scene."""
    return [*capture_stages(context), _plan_gaussians(context), _plan_held_out(context)]


# Poses


def capture_stages(context: RunContext) -> list[Stage]:
    """Plans the capture, and before it the poses if there are photographs or a video without poses."""
    bare = is_bare_scene(context.options.capture)
    require_options_apply(context.options, bare=bare)
    if bare:
        return [bare_stages(context)["load"]]
    capture = context.options.capture
    if not (is_video(capture) or unposed_photographs(capture)):
        return [_plan_load(context)]
    stage = _plan_poses(context)
    assert stage.output_dir is not None
    options = dataclasses.replace(context.options, capture=stage.output_dir)
    posed = dataclasses.replace(context, options=options)
    plan = _plan_load(posed)

    # The stage computes from the posed capture, whatever the context of the run says.
    def compute(stage_input):
        return plan.compute(stage_input._replace(context=posed))

    return [stage, dataclasses.replace(plan, compute=compute, after=("poses",), files=None)]


def _plan_poses(context: RunContext) -> Stage:
    """Plans the poses of photographs or of a video's frames, as a COLMAP capture in OUT/poses."""
    capture, options = context.options.capture, context.options
    if is_video(capture):
        what = f"the {options.frames or DEFAULT_VIDEO_FRAMES} sharpest frames of {capture.name}, evenly spread"
        key_options, files = context.key_options("frames"), capture
    else:
        photographs = list_photographs(capture)
        what = f"{len(photographs)} photographs, which have none"
        key_options = {"names": [photo.relative_to(capture).as_posix() for photo in photographs]}
        files = functools.partial(list_photographs, capture)

    how = f"found by structure from motion (pycolmap) for {what}"
    return Stage("poses", how, _find_poses, key_options=key_options, files=files, output_dir=context.out / "poses")


def _find_poses(stage: StageInput) -> StageResult:
    context, folder = stage.context, stage.checkpoint.folder
    capture, out = context.options.capture, context.out / "poses"
    video = is_video(capture)
    if video:
        frames = context.options.frames
        photos = write_frames(capture, folder / "frames", frames=frames, progress=stage.progress)
    else:
        photos = list_photographs(capture)
    report, posed = find_poses(photos, folder, where=capture, progress=stage.progress)
    if video:
        shutil.rmtree(posed / "images")
        (folder / "frames").rename(posed / "images")
    shutil.rmtree(out, ignore_errors=True)
    shutil.move(posed, out)
    write_text(out / KEY_FILE, folder.name)
    return StageResult(report, notes=(*report.notes, f"The poses are in {out}: COLMAP opens them."))


# The capture


def _plan_load(context: RunContext) -> Stage:
    """Plans the capture at the size that the options ask for, corrected if they ask for that."""
    options = context.options
    key_options = context.key_options("long_side", "frames", "holdout")
    count = "all frames" if options.frames is None else f"at most {options.frames} frames"
    held_out = f"1 in {options.holdout} held out" if options.holdout else "none held out"
    how = f"{count}, long side at most {options.long_side} px, {held_out}"
    refine = _refinement(options)
    if refine != "none" or options.drop_frames != "none":
        key_options |= context.key_options("drop_frames", "seed") | {"refine": refine}
        if refine == "auto":
            key_options |= context.key_options("steps", "minutes")
            how += ", poses and exposures corrected where that helps, in about half of the fit's time at most "
            how += "(--refine auto)"
        elif refine != "none":
            how += f", corrected by short fits (--refine {refine})"
        if options.drop_frames == "auto":
            how += ", frames that a short fit does not explain left out"
    return Stage("load", how, _load, key_options=key_options, files=options.capture)


def _refinement(options: Options) -> str:
    """What a run corrects of poses and exposures: "auto" only if depth and the data can still decide it."""
    if options.refine != "auto":
        return options.refine
    if options.gaussians is not None:  # they belong to the poses as they are
        return "none"
    return "auto" if has_depth(options.capture) else "none"


def _load(stage: StageInput) -> StageResult:
    options, sizes = stage.context.options, stage.context.key_options("long_side", "frames", "holdout")
    capture = load_capture(options.capture, **sizes, progress=stage.progress)
    train = training_frames(capture.held_out)
    count, height, width = capture.frames.shape[:3]
    frames = f"{count} frames of {width}x{height}, {count - len(train)} of them held out"
    points = f"{len(capture.points)} sparse points{'' if capture.depths is None else ', depth'}"
    notes = (f"{frames}, {points}", *capture.notes)
    refine = _refinement(options)
    if refine == "none" and options.drop_frames == "none":
        return StageResult(capture, notes=notes)
    better = _refine(capture, options, refine, stage.progress)
    training_frames(better.held_out)
    return StageResult(better, notes=(*notes, *better.notes[len(capture.notes) :]))


def _refine(capture: Capture, options: Options, refine: str, progress: Progress) -> Capture:
    """Corrects poses and exposures by short fits, and leaves out the frames that these do not explain."""
    from jsecon.fit.corrections import RefineOptions  # late, like all that imports optax: a plan needs none of it
    from jsecon.poses.refine import refine_capture

    what, max_fit_steps = None, None
    if refine == "auto" and capture.depths is not None:
        what, max_fit_steps = RefineOptions(), _fit_steps(options, capture) / 2
    elif refine not in ("auto", "none"):
        what = RefineOptions(refine in ("poses", "both"), refine in ("exposure", "both"))
    return refine_capture(
        capture,
        key=jax.random.key(options.seed),
        refine=what,
        drop_weak=options.drop_frames == "auto",
        decide=refine == "auto",
        max_fit_steps=max_fit_steps,
        progress=progress,
    )


def _fit_steps(options: Options, capture: Capture) -> float:
    """Steps of the photometric fit; those that `minutes` allow are estimated."""
    if options.minutes is None:
        return float(options.steps)
    megapixels = capture.cameras.width * capture.cameras.height / 1e6
    return 60 * options.minutes / (SECONDS_PER_STEP + SECONDS_PER_MEGAPIXEL * megapixels)


# The Gaussians


def _plan_gaussians(context: RunContext) -> Stage:
    """Plans the scene's Gaussians: of a file, brought into the capture's world, or fitted to the training frames."""
    if is_bare_scene(context.options.capture):
        return bare_stages(context)["gaussians"]
    options, path = context.options, context.options.gaussians
    if path is not None:
        transform = path.parent / "dataparser_transforms.json"
        key_options = {"trained": transform.read_text(errors="replace")} if transform.is_file() else {}
        skipped = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
        how = f"read from {path.name}"
        return Stage(
            "gaussians", how, _read_gaussians, after=("load",), key_options=key_options, files=path, skipped=skipped
        )
    length = f"{options.steps} steps" if options.minutes is None else f"{options.minutes:g} minutes"
    key_options = context.key_options("steps", "minutes", "seed")
    return Stage(
        "gaussians", f"fitted to the frames in {length}", _fit_gaussians, after=("load",), key_options=key_options
    )


def _read_gaussians(stage: StageInput) -> StageResult:
    path, capture = stage.context.options.gaussians, stage.results.load
    assert path is not None
    scene, read_notes = read_scene(path)
    transform = path.parent / "dataparser_transforms.json"
    trained = source_from_trained(transform) if transform.is_file() else None
    placed, notes = place_in_capture(scene, capture, path, trained, stage.progress)
    check_overlap(placed, capture.cameras[training_frames(capture.held_out)], str(path))
    return StageResult(placed, notes=(*notes, *read_notes))


def _fit_gaussians(stage: StageInput) -> StageResult:
    from jsecon.fit.optimise import fit_gaussians
    from jsecon.fit.schedule import MAX_GAUSSIANS, Schedule

    options, capture, state = stage.context.options, stage.results.load, stage.checkpoint.read()
    start, notes = None, ()
    if state is None:
        start, origin = starting_gaussians(capture, sh_degree=SH_DEGREE, progress=stage.progress)
        check_overlap(start, capture.cameras[training_frames(capture.held_out)], str(options.capture))
        notes = (f"start of the fit: {origin}",)
    pixels, minutes = capture.cameras.width * capture.cameras.height, options.minutes
    is_long = options.steps >= LONG_STEPS if minutes is None else minutes >= LONG_MINUTES
    most = min(pixels if is_long else pixels // 2, MAX_GAUSSIANS)
    fitted, losses = fit_gaussians(
        capture,
        key=jax.random.key(options.seed),
        steps=options.steps if minutes is None else None,
        seconds=None if minutes is None else 60 * minutes,
        start=start,
        state=state,
        schedule=Schedule(max_gaussians=most),
        on_checkpoint=lambda current: stage.checkpoint.keep(lambda: current),
        progress=stage.progress,
    )
    return StageResult(fitted, notes=(*notes, f"{fitted.count} Gaussians after {len(losses)} steps"))


def _plan_held_out(context: RunContext) -> Stage:
    """Plans PSNR and SSIM of the held-out frames."""
    if is_bare_scene(context.options.capture):
        return bare_stages(context)["held_out"]
    how = "PSNR and SSIM of the rendered colours"
    return Stage("held_out", how, _measure, after=("load", "gaussians"), distributed=True)


def _measure(stage: StageInput) -> StageResult:
    capture, scene = stage.results.load, stage.results.gaussians
    train = np.flatnonzero(~np.asarray(capture.held_out))
    fitted = measure_quality(scene, capture, frames=train, long_side=QUICK_LONG_SIDE, progress=stage.progress)
    weak = np.flatnonzero(is_weak(np.asarray(fitted.psnr)))
    notes = ()
    if len(weak):
        names = ", ".join(f"{capture.names[fitted.frames[n]]} ({fitted.psnr[n]:.1f} dB)" for n in weak[:5])
        more = f" and {len(weak) - 5} more" if len(weak) > 5 else ""
        note = f"far below the median frame ({np.median(fitted.psnr):.1f} dB): {names}{more}; a wrong pose, or "
        notes = (note + "something moved (--drop-frames auto leaves them out)",)
    return StageResult(measure_quality(scene, capture, progress=stage.progress), notes=notes)


# The masklets


def _plan_masklets(context: RunContext) -> Stage:
    """Plans the labels of the training frames: from mask files, or proposals associated over the frames."""
    options, models, folder = context.options, context.models, context.options.masks
    if folder is not None:
        reason = f"masks are given ({folder.name})"
        skipped = {"segmenter": reason, "association": reason}
        return Stage(
            "masklets",
            f"read from {folder.name}",
            _read_masklets,
            after=("load",),
            key_options=context.key_options("level", "vision_frames"),
            files=folder,
            skipped=skipped,
        )
    if options.proposals is not None:
        how, key_options = f"proposals read from {options.proposals.name}", context.key_options("level")
    elif models.segmenter is not None:
        assert options.segmenter is not None
        crops = f" and {options.crop_layers} layers of crops" if options.crop_layers else ""
        grid = f"at {options.points_per_side}x{options.points_per_side} points"
        asked = "at points in regions by colour" if options.prompts == "guided" else grid
        how = (
            f"proposals of level {options.level} by {model_name(options.segmenter, 'segmenter')}, asked {asked}{crops}"
        )
        key_options = {"model": models.segmenter.name}
    else:
        how = f"{options.granularity} proposals by colour and texture"
        key_options = context.key_options("granularity")
    if options.associated_by == "consensus":
        how += ", what the views agree on"
        key_options |= context.key_options("agreement", "seed", "centre_pixel_weight")
    else:
        by = "through the Gaussians" if options.tracker is None else f"by {model_name(options.tracker, 'tracker')}"
        how += f", followed {by}"
    tracker = None if models.tracker is None else models.tracker.name
    key_options = {**key_options, "association": options.associated_by, "tracker": tracker}
    key_options |= context.key_options("vision_frames")
    if options.vision_frames is not None:
        how += f", in at most {options.vision_frames} frames"
    return Stage(
        "masklets",
        how,
        _find_masklets,
        after=("load", "gaussians"),
        key_options=key_options,
        files=options.proposals,
        distributed=options.associated_by == "consensus",
    )


def _read_masklets(stage: StageInput) -> StageResult:
    folder, vision = stage.context.options.masks, _Vision(stage.results.load, stage.context.options)
    assert folder is not None
    loaded = load_labels(folder, vision.names, vision.size, **vision.mask_layout, progress=stage.progress)
    _require_regions(loaded.labels, str(folder))
    return StageResult(loaded.labels, notes=(f"{len(loaded.ids)} regions in the masks", *loaded.notes))


class _Vision:
    """The training frames in which masks are found and embedded."""

    def __init__(self, capture: Capture, options: Options):
        self.capture, self.train = capture, vision_frames(capture, options)
        self.names = [capture.names[t] for t in self.train]
        self.size = capture.cameras.height, capture.cameras.width
        frames = dict(itertools.zip_longest(capture.names, capture.files))
        self.mask_layout: dict[str, Any] = {"level": options.level, "frames": frames}
        """How files of masks belong to the frames, for their readers."""

    @property
    def frames(self) -> np.ndarray:
        """(T, H, W, 3) their pixels."""
        return np.asarray(self.capture.frames)[self.train]

    @property
    def cameras(self) -> Camera:
        """Their T cameras, on jax's device."""
        return jax.tree.map(jnp.asarray, self.capture.cameras[self.train])


def _find_masklets(stage: StageInput) -> StageResult:
    context, capture, scene = stage.context, stage.results.load, stage.results.gaussians
    proposals, notes = frame_proposals(context, capture, scene)
    labels = associate_masks(context, capture, scene, proposals, stage.progress, stage.checkpoint)
    context.models.close()
    _require_regions(labels, str(context.options.capture))
    return StageResult(labels, notes=notes)


def frame_proposals(
    context: RunContext, capture: Capture, gaussians: Gaussians
) -> tuple[Callable[[int], np.ndarray], tuple[str, ...]]:
    """Opens the proposals of the frames: from files, by a segmenter, or by colour and texture."""
    options, vision = context.options, _Vision(capture, context.options)
    if options.proposals is not None:
        return load_proposals(options.proposals, vision.names, vision.size, **vision.mask_layout)
    segmenter, frames = context.models.segmenter, vision.frames
    if segmenter is not None:  # it stores its masks on disk
        lock = threading.Lock()  # a network takes all cores for one frame

        def segment(t: int) -> np.ndarray:
            with lock:
                return segmenter(frames[t], t)

        return segment, ()
    classical = _classical_segmenter(options, capture, gaussians)
    return cache_masks_as_rle(lambda t: classical(frames[t], t)), ()


def _classical_segmenter(options: Options, capture: Capture, gaussians: Gaussians) -> Segmenter:
    """Opens the segmenter without weights for the training frames.

    Surfaces come from the capture's depth. Without depth, the coarse granularity takes the depth that the Gaussians
    render; the finer ones do not, as rendered depth costs them more outline than it tells.
    """
    vision = _Vision(capture, options)
    train, cameras = vision.train, vision.cameras
    setting = GRANULARITIES[options.granularity]
    depths = None if capture.depths is None else np.asarray(capture.depths)[train]
    if depths is not None and depths[:, ::4, ::4].any():
        known = depths[:, ::4, ::4]
        spacing = MIN_CLOUD_SPACING * float(np.median(known[known > 0]))
        cloud = points_from_depth(capture, voxel=spacing, stride=4)
        if len(cloud.points) > MAX_CLOUD_POINTS:
            cloud = points_from_depth(capture, max_points=MAX_CLOUD_POINTS, stride=4)
        surfaces = surfaces_from_depth(depths, cameras, cloud.points)
        return ClassicalSegmenter(**setting, surfaces=surfaces)
    if options.granularity != "coarse":
        return ClassicalSegmenter(**setting)

    def rendered(t: int) -> np.ndarray:
        depth, alpha = (np.asarray(image) for image in render_depth(gaussians, cameras[t]))
        return smooth_depth(np.where(alpha > 0.5, depth, 0.0).astype(np.float32))

    return ClassicalSegmenter(**setting, depths=rendered)


def associate_masks(
    context: RunContext,
    capture: Capture,
    gaussians: Gaussians,
    proposals: Callable[[int], np.ndarray],
    progress: Progress,
    checkpoint: Checkpoint | None = None,
) -> np.ndarray:
    """Associates the proposals of the training frames as the options ask: by consensus or by a tracker."""
    options, vision = context.options, _Vision(capture, context.options)
    frames, cameras = vision.frames, vision.cameras
    if options.associated_by == "consensus":
        scene = SceneSuperpixels(gaussians, cameras, proposals, centre=options.centre_pixel_weight)
        labels = consensus_masklets(frames, scene, agreement=options.agreement, seed=options.seed, progress=progress)
        return clean_masklets(labels)
    tracker = context.models.tracker or GeometricTracker(gaussians, cameras, proposals)
    labels = algorithm1(
        frames,
        lambda frame, index: proposals(index),
        tracker,
        state=None if checkpoint is None else checkpoint.read(),
        on_checkpoint=None if checkpoint is None else checkpoint.keep,
        progress=progress,
    )
    if isinstance(tracker, GeometricTracker):
        labels = tracker.consistent(frames, labels)
    return clean_masklets(labels)


def _require_regions(labels: np.ndarray, where: str) -> None:
    if labels.max(initial=-1) < 0:
        remedy = "Give masks (--masks DIR), or frames with more contrast."
        raise InputError(where, "no region in any frame", "at least one", remedy)


# The regions


def _plan_regions(context: RunContext) -> Stage:
    """Plans an embedding of each region: by the embedder, or from files."""
    options, embedder = context.options, context.models.embedder
    after = "load", "masklets"
    if options.features is None:
        how, key_options = f"embedded by {embedder.name!r}, views weighted by pixels", {"embedder": embedder.name}
        return Stage("regions", how, _embed_regions, after=after, key_options=key_options, distributed=True)
    name = options.features.name
    how = f"embeddings read from {name}, level {options.level}, views weighted by pixels"
    return Stage(
        "regions",
        how,
        _read_regions,
        after=after,
        key_options=context.key_options("level"),
        files=options.features,
        skipped={"embedder": f"embeddings are given ({name})"},
    )


def _embed_regions(stage: StageInput) -> StageResult:
    context = stage.context
    frames, embed = _Vision(stage.results.load, context.options).frames, context.models.embedder.embed_regions
    embedded = region_embeddings(frames, stage.results.masklets, embed, progress=stage.progress)
    context.models.close()
    return StageResult(embedded)


def _read_regions(stage: StageInput) -> StageResult:
    options, labels = stage.context.options, stage.results.masklets
    vision = _Vision(stage.results.load, options)
    assert options.features is not None
    features = load_features(options.features, vision.names, vision.size, **vision.mask_layout)
    if not len(features.embeddings):
        problem = f"no mask of level {options.level} in any frame"
        remedy = "Take another --level, or write the files again."
        raise InputError(options.features, problem, "masks with their embeddings", remedy)
    embedded = embeddings_of_masks(labels, features.labels, features.embeddings, progress=stage.progress)
    missing = int((~embedded.embeddings.any(1)).sum())
    notes = (f"{len(features.embeddings)} embeddings in the files",)
    if missing:
        notes = (*notes, f"{missing} regions lie on no mask with one")
    return StageResult(embedded, notes=notes)


def _plan_parts(context: RunContext) -> Stage:
    """Plans small parts of the scene, each with the embeddings of all single-frame masks that contain it."""
    key_options = context.key_options("seed", "level", "granularity", "centre_pixel_weight")
    return Stage(
        "parts",
        "of the scene, by what single masks say of them",
        _find_parts,
        after=("load", "gaussians", "masklets"),
        key_options=key_options | {"embedder": context.models.embedder.name},
        files=context.options.features,
    )


def _find_parts(stage: StageInput) -> StageResult:
    context, options = stage.context, stage.context.options
    vision = _Vision(stage.results.load, options)
    frames = vision.frames
    masks, embed = _masks_with_embeddings(context, stage.results)
    views = SceneSuperpixels(stage.results.gaussians, vision.cameras, masks, centre=options.centre_pixel_weight)
    piece, weights = pieces_on_masks(frames, views, seed=options.seed, progress=stage.progress)
    rows = np.concatenate([embed(t, masks(t)) for t in range(len(frames))])
    context.models.close()
    return StageResult(scene_parts(piece, weights, rows))


def _masks_with_embeddings(context: RunContext, results: Results) -> tuple[Callable[[int], np.ndarray], Embed]:
    """Masks (M, H, W) of the t-th training frame and their embeddings: of --features, of --masks, or proposals."""
    options, vision = context.options, _Vision(results.load, context.options)
    frames = vision.frames

    def by_model(t, masks):
        return context.models.embedder.embed_regions(frames[t], masks)

    if options.features is not None:
        features = load_features(options.features, vision.names, vision.size, **vision.mask_layout)

        def rows(t):
            return np.flatnonzero(np.asarray(features.frame) == t)

        def masks(t):
            return features.labels[t][None] == rows(t)[:, None, None]

        return masks, lambda t, masks: features.embeddings[rows(t)]
    if options.masks is not None:
        labels = results.masklets
        return lambda t: labels[t][None] == np.unique(labels[t][labels[t] >= 0])[:, None, None], by_model
    return frame_proposals(context, results.load, results.gaussians)[0], by_model


# The votes


def _plan_votes(context: RunContext) -> Stage:
    """Plans the weight of each region on each Gaussian over the training frames, with each frame's total."""
    return Stage(
        "votes",
        "the strongest regions of each Gaussian",
        _accumulate_votes,
        after=("load", "gaussians", "masklets"),
        key_options=context.key_options("centre_pixel_weight"),
        distributed=True,
    )


def _accumulate_votes(stage: StageInput) -> StageResult:
    """Accumulates votes; in blocks on disk if they do not fit into memory, to the same up to float32's rounding."""
    options, capture, scene = stage.context.options, stage.results.load, stage.results.gaussians
    labels, folder = stage.results.masklets, stage.checkpoint.folder
    cameras = capture.cameras[vision_frames(capture, options)]
    count = int(labels.max()) + 1
    settings = {"centre": options.centre_pixel_weight, "by_view": True, "progress": stage.progress}
    needed, budget = votes_memory(scene.count, len(labels), count), memory_budget()
    notes = ()
    if needed > budget and jax.process_count() == 1:  # several processes accumulate them together, in memory
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was stopped
        accumulated = region_votes_in_blocks(scene, cameras, labels, count, folder=folder, **settings)
        sizes = f"{needed / 2**30:.2g} GiB otherwise, where memory has room for {budget / 2**30:.2g}"
        notes = (f"votes are cast in blocks: {sizes}",)
    else:
        accumulated = region_votes(scene, cameras, labels, count, **settings)
    unseen = int((np.asarray(accumulated.views) == 0).sum())
    skipped = {"unseen Gaussians": f"{unseen} of {scene.count}, which no frame sees"} if unseen else {}
    return StageResult(accumulated, skipped, notes)


# The codes of the paper


def _plan_codes(context: RunContext) -> Stage:
    """Plans the paper's codes of regions and Gaussians (--paper)."""
    how = f"{LATENT} numbers per region by an autoencoder, distilled into the Gaussians by their votes"
    return Stage("codes", how, _compute_codes, after=("regions", "votes"), key_options=context.key_options("seed"))


def _compute_codes(stage: StageInput) -> StageResult:
    options, embeddings, cast = stage.context.options, stage.results.regions.embeddings, stage.results.votes
    if not np.any(np.asarray(embeddings)):
        raise InputError("--paper", "no region has an embedding to train the autoencoder on", remedy="Leave it out.")
    key = jax.random.key(options.seed)
    autoencoder = train_autoencoder(embeddings, latent=LATENT, key=key, progress=stage.progress)
    table = encode(autoencoder, embeddings)
    blocks = vote_blocks(cast) if is_mapped(cast) else [cast]
    codes = np.concatenate([np.asarray(distill_votes(block, table)) for block in blocks])
    return StageResult(Codes(codes, table, autoencoder))


# The field


def field_of(results: Results, embedder: Embedder, provenance: str, options: Options) -> LanguageField:
    """Joins the results of a run to a field."""
    capture, embedded = results.load, results.regions
    pixels = np.zeros((embedded.count, len(capture.names)), np.int32)
    pixels[:, vision_frames(capture, options)] = embedded.pixel_counts
    return LanguageField(
        gaussians=results.gaussians,
        votes=normalise_votes_in_blocks(results.votes, embedded),
        regions=Regions(embedded.embeddings, pixels),
        cameras=capture.cameras,
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.asarray(capture.source_from_scene),
        names=capture.names,
        embedder=embedder.name,
        provenance=provenance,
        parts=results.parts,
        unrelated_words=reference_of(embedder).astype(np.float16),
        codes=results.codes,
    )
