"""The stage that finds masklets: the proposals of each frame, brought together over the frames."""

import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline.progress import Progress
from jsecon.pipeline.stages import Checkpoint, Results, RunContext, Stage, StageResult, training_frames
from jsecon.types import Capture, Gaussians
from jsecon.vision.protocols import Segmenter

CLOUD = 100_000
"""points, at most, that the normals of a capture with depth are taken from"""
GRAIN = 0.02
"""least distance between them, as a share of the median depth: nearer ones show a sensor's noise, not the surface"""


def masklets(work: RunContext) -> Stage:
    """labels (T, H, W) int16 of the training frames, -1 = none: of mask files, or found in the frames."""
    return _found(work) if work.options.masks is None else _read(work)


def _read(work: RunContext) -> Stage:
    options, folder = work.options, work.options.masks
    assert folder is not None

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.data.masks import load_labels

        capture = results["load"]
        names, size = [capture.names[t] for t in training_frames(capture)], capture.frames.shape[1:3]
        how = {"level": options.level, "order": capture.names, "files": dict(zip(capture.names, capture.files))}
        found = load_labels(folder, names, size, **how, progress=progress)
        _require_regions(found.labels, str(folder))
        return StageResult(found.labels, notes=(f"{len(found.ids)} regions in the masks", *found.notes))

    how, given, why = f"read from {folder.name}", work.key_options("level"), f"masks are given ({folder.name})"
    left = {"segmenter": why, "association": why}
    return Stage("masklets", how, compute, "data", after=("load",), key_options=given, files=folder, skipped=left)


def _found(work: RunContext) -> Stage:
    """The proposals of each frame, brought together over the frames by what the scene's own Gaussians say, by consensus
    or by tracking, or by a tracker of its own."""
    options, segmenter, tracker = work.options, work.networks.segmenter, work.networks.tracker

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        capture, scene = results["load"], results["gaussians"]
        proposals, notes = frame_proposals(work, capture, scene)
        labels = associate_masks(work, capture, scene, proposals, progress, record)
        work.networks.close()
        _require_regions(labels, str(options.capture))
        return StageResult(labels, notes=notes)

    if options.proposals is not None:
        how, given = f"proposals read from {options.proposals.name}", work.key_options("level")
    elif segmenter is not None:
        assert options.segmenter is not None
        crops = f" and {options.crop_layers} layers of crops" if options.crop_layers else ""
        grid = f"{options.points_per_side}x{options.points_per_side}"
        how = f"proposals of level {options.level} by {options.segmenter.name}, asked at {grid} points{crops}"
        given = {"model": segmenter.name}
    else:
        how, given = f"{options.granularity} proposals by colour and texture", work.key_options("granularity")
    if options.associated_by == "consensus":
        how, given = f"{how}, what the views agree on", given | work.key_options("agreement", "seed", "centre")
    else:
        by = "through the Gaussians" if options.tracker is None else f"by the SAM 2 of {options.tracker.name}"
        how, given = f"{how}, followed {by}", given | work.key_options("iou_threshold")
    return Stage(
        "masklets",
        how,
        compute,
        "association",
        after=("load", "gaussians"),
        key_options=given
        | {"association": options.associated_by, "tracker": None if tracker is None else tracker.name},
        files=options.proposals,
        shared=options.associated_by == "consensus",
    )


def frame_proposals(
    work: RunContext, capture: Capture, gaussians: Gaussians
) -> tuple[Callable[[int], np.ndarray], tuple[str, ...]]:
    """masks (M, H, W) bool of the t-th training frame, as a function of t: from disk where they are given, else by a
    segmenter, else by colour and texture at the granularity asked for; and notes."""
    options, train = work.options, training_frames(capture)
    frames = np.asarray(capture.frames)[train]
    if options.proposals is not None:
        from jsecon.data.proposals import load_proposals

        names = [capture.names[t] for t in train]
        how = {"level": options.level, "order": capture.names, "files": dict(zip(capture.names, capture.files))}
        return load_proposals(options.proposals, names, frames.shape[1:3], **how)
    segmenter = work.networks.segmenter
    if segmenter is not None:  # which keeps what it finds on disk
        alone = threading.Lock()  # a network takes all cores for one frame

        def ask(t: int) -> np.ndarray:
            with alone:
                return segmenter(frames[t], t)

        return ask, ()
    from jsecon.association.run_lengths import memoized_masks

    classical = _classical_segmenter(options.granularity, capture, gaussians)
    return memoized_masks(lambda t: classical(frames[t], t)), ()


def _classical_segmenter(granularity: str, capture: Capture, gaussians: Gaussians) -> Segmenter:
    """The segmenter without weights, of the training frames.

    Surfaces come from the capture's depth; where there is none, the coarse one takes the depth that the Gaussians
    render. (The finer ones do not: rendered depth costs them more outline than it tells.)
    """
    from jsecon.fit.depth import points_from_depth
    from jsecon.splat.render import render_depth
    from jsecon.vision.classical import GRANULARITIES, ClassicalSegmenter
    from jsecon.vision.surfaces import smooth_depth, surfaces_from_depth

    train = training_frames(capture)
    setting = GRANULARITIES[granularity]
    depths = None if capture.depths is None else np.asarray(capture.depths)[train]
    if depths is not None and depths[:, ::4, ::4].any():
        known = depths[:, ::4, ::4]
        cloud = points_from_depth(capture, voxel=GRAIN * float(np.median(known[known > 0])), stride=4)
        if len(cloud.points) > CLOUD:
            cloud = points_from_depth(capture, max_points=CLOUD, stride=4)
        surfaces = surfaces_from_depth(depths, capture.cameras[train], cloud.points)
        return ClassicalSegmenter(**setting, surfaces=surfaces)
    if granularity == "coarse":
        cameras = jax.tree.map(jnp.asarray, capture.cameras[train])

        def rendered(t: int) -> np.ndarray:
            depth, alpha = (np.asarray(image) for image in render_depth(gaussians, cameras[t]))
            return smooth_depth(np.where(alpha > 0.5, depth, 0.0).astype(np.float32))

        return ClassicalSegmenter(**setting, depths=rendered)
    return ClassicalSegmenter(**setting)


def associate_masks(
    work: RunContext,
    capture: Capture,
    gaussians: Gaussians,
    proposals: Callable[[int], np.ndarray],
    progress: Progress,
    record: Checkpoint | None = None,
) -> np.ndarray:
    """labels (T, H, W) int16 of the training frames: their proposals brought together as the options say. A tracker
    that was stopped goes on behind the last frame of `record`."""
    from jsecon.association.algorithm1 import clean_masklets, masklets as algorithm1
    from jsecon.association.consensus import consensus_masklets
    from jsecon.association.tracker import GeometricTracker
    from jsecon.association.views import SceneViews

    options, train = work.options, training_frames(capture)
    frames, cameras = np.asarray(capture.frames)[train], jax.tree.map(jnp.asarray, capture.cameras[train])
    if options.associated_by == "consensus":
        scene = SceneViews(gaussians, cameras, proposals, centre=options.centre)
        labels = consensus_masklets(frames, scene, agreement=options.agreement, seed=options.seed, progress=progress)
        return clean_masklets(labels)
    tracker = work.networks.tracker or GeometricTracker(gaussians, cameras, proposals)
    labels = algorithm1(
        frames,
        lambda frame, index: proposals(index),
        tracker,
        iou_threshold=options.iou_threshold,
        state=None if record is None else record.read(),
        on_checkpoint=None if record is None else record.keep,
        progress=progress,
    )
    if isinstance(tracker, GeometricTracker):
        labels = tracker.consistent(frames, labels)
    return clean_masklets(labels)


def _require_regions(labels: np.ndarray, where: str) -> None:
    if labels.max(initial=-1) < 0:
        remedy = "Give masks (--masks DIR), or frames with more contrast."
        raise InputError(where, "no region in any frame", "at least one", remedy)
