"""The table of stages: from a capture to what its language field is made of.

    stage      computed by               from
    poses      scene.estimate_poses      photographs or a video without poses
    load       scene.load_frames         the capture (a bare scene: render_planned_views or render_given_poses)
    gaussians  scene.fit_scene           load (--gaussians: read_gaussians_of_capture; a bare scene: read_bare_scene)
    objects    objects.find_objects      load, gaussians (--masks: read_masks, from load alone)
    regions    objects.embed_objects     load, objects (--features: read_embeddings)
    parts      objects.find_parts        load, gaussians, objects, with --parts
    votes      lifting.accumulate_votes  load, gaussians, objects
    codes      lifting.compute_codes     regions, votes, with --paper
    held_out   scene.measure_held_out    load, gaussians

Each row is planned below: how it works, for the plan that a run prints first; the stages that it reads (`after`); and
the options, models and files on which its result depends. `run` computes the rows, or reads them from the cache.
"""

import dataclasses
import functools
from pathlib import Path

from jsecon.networks.hub import model_name
from jsecon.pipeline import lifting, objects, scene
from jsecon.pipeline.options import is_bare_scene
from jsecon.pipeline.results import RunContext, Stage
from jsecon.read.captures.capture import unposed_photographs
from jsecon.read.captures.photographs import list_photographs
from jsecon.read.captures.video import DEFAULT_VIDEO_FRAMES, is_video


def run_stages(context: RunContext) -> list[Stage]:
    """Plans the stages of a run. Mask files come before the long fit, so that their errors are found early."""
    options = context.options
    first = [_plan_gaussians(context), _plan_objects(context)]
    if options.masks is not None:
        first.reverse()
    parts = [_plan_parts(context)] if options.parts else []
    codes = [_plan_codes(context)] if options.paper else []
    last = [_plan_regions(context), *parts, _plan_votes(context), *codes, _plan_held_out(context)]
    return [*capture_stages(context), *first, *last]


def fit_stages(context: RunContext) -> list[Stage]:
    """Plans the stages that make and measure the scene."""
    return [*capture_stages(context), _plan_gaussians(context), _plan_held_out(context)]


def capture_stages(context: RunContext) -> list[Stage]:
    """Plans the capture, and before it the poses if there are photographs or a video without poses."""
    options, capture = context.options, context.options.capture
    if is_bare_scene(capture):
        return [_plan_rendered_views(context)]
    if is_video(capture):
        what = f"the {options.frames or DEFAULT_VIDEO_FRAMES} sharpest frames of {capture.name}, evenly spread"
        key_options, files = context.key_options("frames"), capture
    elif unposed_photographs(capture):
        photographs = list_photographs(capture)
        what = f"{len(photographs)} photographs, which have none"
        key_options = {"names": [photo.relative_to(capture).as_posix() for photo in photographs]}
        files = functools.partial(list_photographs, capture)
    else:
        return [_plan_load(context, capture)]
    how = f"found by structure from motion (pycolmap) for {what}"
    folder = context.out / "poses"
    poses = Stage("poses", how, scene.estimate_poses, key_options=key_options, files=files, output_dir=folder)
    return [poses, dataclasses.replace(_plan_load(context, folder), after=("poses",), files=None)]


def _plan_load(context: RunContext, capture: Path) -> Stage:
    """Plans the frames at the size that the options ask for, corrected if they ask for that."""
    options = context.options
    key_options = context.key_options("long_side", "frames", "holdout")
    count = "all frames" if options.frames is None else f"at most {options.frames} frames"
    held_out = f"1 in {options.holdout} held out" if options.holdout else "none held out"
    how = f"{count}, long side at most {options.long_side} px, {held_out}"
    refine = scene.refinement(options, capture)
    if refine != "never":
        key_options |= context.key_options("seed", "steps", "minutes") | {"refine": refine}
        how += ", corrected by short fits"
        how += " in about half of the fit's time where that helps" * (refine == "auto")
    return Stage("load", how, scene.load_frames, key_options=key_options, files=capture)


def _plan_rendered_views(context: RunContext) -> Stage:
    """Plans the stage "load" of a scene without photographs."""
    options, skipped = context.options, {"photographs": "the scene comes without any"}
    if options.cameras is not None:
        poses, both = options.cameras, [options.cameras, options.capture]
        how, key_options = f"the scene rendered from the poses of {poses.name}", context.key_options("long_side")
        skipped["planned views"] = f"the poses are given ({poses.name})"
        render = scene.render_given_poses
        return Stage("load", how, render, key_options=key_options, files=lambda: both, skipped=skipped)
    how = f"{options.views} virtual views, planned from the Gaussians of {options.capture.name}"
    key_options, render = context.key_options("views", "up", "long_side"), scene.render_planned_views
    return Stage("load", how, render, key_options=key_options, files=options.capture, skipped=skipped)


def _plan_gaussians(context: RunContext) -> Stage:
    """Plans the scene's Gaussians: of a file, brought into the capture's world, or fitted to the training frames."""
    options = context.options
    bare = is_bare_scene(options.capture)
    path = options.capture if bare else options.gaussians
    if path is None:
        length = f"{options.steps} steps" if options.minutes is None else f"{options.minutes:g} minutes"
        how, key_options = f"fitted to the frames in {length}", context.key_options("steps", "minutes", "seed")
        return Stage("gaussians", how, scene.fit_scene, after=("load",), key_options=key_options)
    transform = path.parent / "dataparser_transforms.json"
    key_options = {"trained": transform.read_text(errors="replace")} if transform.is_file() and not bare else {}
    skipped = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
    read = scene.read_bare_scene if bare else scene.read_gaussians_of_capture
    how = f"read from {path.name}"
    return Stage("gaussians", how, read, after=("load",), key_options=key_options, files=path, skipped=skipped)


def _plan_held_out(context: RunContext) -> Stage:
    """Plans PSNR and SSIM of the held-out frames."""
    if is_bare_scene(context.options.capture):
        return Stage("held_out", "no photograph to compare with", scene.measure_nothing)
    how = "PSNR and SSIM of the rendered colours"
    return Stage("held_out", how, scene.measure_held_out, after=("load", "gaussians"), distributed=True)


def _plan_objects(context: RunContext) -> Stage:
    """Plans the labels of the training frames: from mask files, or proposals associated over the frames."""
    options, models, folder = context.options, context.models, context.options.masks
    key_options = context.key_options("vision_frames")
    if folder is not None:
        reason = f"masks are given ({folder.name})"
        skipped = {"segmenter": reason, "association": reason}
        key_options |= context.key_options("level")
        how, read = f"read from {folder.name}", objects.read_masks
        return Stage("objects", how, read, after=("load",), key_options=key_options, files=folder, skipped=skipped)
    if options.proposals is not None:
        how = f"proposals read from {options.proposals.name}"
        key_options |= context.key_options("level")
    elif models.segmenter is not None:
        how = f"proposals of level {options.level} by {model_name(options.segmenter, 'segmenter')}"
        key_options["model"] = models.segmenter.name
    else:
        how = f"{options.granularity} proposals by colour and texture"
        key_options |= context.key_options("granularity")
    if consensus := options.associated_by == "consensus":
        how += ", what the views agree on"
        key_options |= context.key_options("agreement", "seed", "centre_pixel_weight")
    else:
        by = "through the Gaussians" if options.tracker is None else f"by {model_name(options.tracker, 'tracker')}"
        how += f", followed {by}"
    if options.vision_frames is not None:
        how += f", in at most {options.vision_frames} frames"
    tracker = None if models.tracker is None else models.tracker.name
    key_options |= {"association": options.associated_by, "tracker": tracker}
    after, files = ("load", "gaussians"), options.proposals
    find = objects.find_objects
    return Stage("objects", how, find, after=after, key_options=key_options, files=files, distributed=consensus)


def _plan_regions(context: RunContext) -> Stage:
    """Plans an embedding of each region: by the embedder, or from files."""
    options, embedder, after = context.options, context.models.embedder.name, ("load", "objects")
    if options.features is None:
        how, key_options = f"embedded by {embedder!r}, views weighted by pixels", {"embedder": embedder}
        return Stage("regions", how, objects.embed_objects, after=after, key_options=key_options, distributed=True)
    how = f"embeddings read from {options.features.name}, level {options.level}, views weighted by pixels"
    key_options, read = context.key_options("level"), objects.read_embeddings
    skipped = {"embedder": f"embeddings are given ({options.features.name})"}
    return Stage("regions", how, read, after=after, key_options=key_options, files=options.features, skipped=skipped)


def _plan_parts(context: RunContext) -> Stage:
    how, after = "of the scene, by what single masks say of them", ("load", "gaussians", "objects")
    key_options = context.key_options("seed", "level", "granularity", "centre_pixel_weight")
    key_options["embedder"] = context.models.embedder.name
    find, files = objects.find_parts, context.options.features
    return Stage("parts", how, find, after=after, key_options=key_options, files=files)


def _plan_votes(context: RunContext) -> Stage:
    how, after = "the strongest regions of each Gaussian", ("load", "gaussians", "objects")
    key_options, accumulate = context.key_options("centre_pixel_weight"), lifting.accumulate_votes
    return Stage("votes", how, accumulate, after=after, key_options=key_options, distributed=True)


def _plan_codes(context: RunContext) -> Stage:
    how = f"{lifting.CODE_LENGTH} numbers per region by an autoencoder, distilled into the Gaussians by their votes"
    key_options = context.key_options("seed")
    return Stage("codes", how, lifting.compute_codes, after=("regions", "votes"), key_options=key_options)
