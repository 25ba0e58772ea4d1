"""The stages of a scene: poses, frames, Gaussians and their quality, with photographs or without.

A scene that comes without photographs is rendered from virtual views, or from given poses. Only `_load_frames` and
`_measure_held_out` read held-out frames.
"""

import dataclasses
import shutil
from functools import partial
from pathlib import Path

import jax
import numpy as np

from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.fit.quality import QUICK_LONG_SIDE, is_weak, measure_quality
from jsecon.fit.start import starting_gaussians
from jsecon.pipeline.options import Options, is_bare_scene
from jsecon.pipeline.scene_files import check_overlap, fit_background, place_in_capture, read_scene
from jsecon.pipeline.stages import KEY_FILE, WARNING, RunContext, Stage, StageInput, StageResult, training_frames
from jsecon.poses.sfm import find_poses
from jsecon.read.captures.capture import (
    has_depth,
    load_capture,
    read_posed_images,
    unposed_photographs,
)
from jsecon.read.captures.frames import FrameOptions, frame_names, make_rigid, transform_poses, usable_images
from jsecon.read.captures.nerfstudio import source_from_trained
from jsecon.read.captures.video import DEFAULT_VIDEO_FRAMES, is_video, write_frames
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Camera, Capture, Gaussians, UpAxis
from jsecon.views.capture import render_capture
from jsecon.views.frame import scene_frame, surface_points
from jsecon.views.plan import place_cameras


def plan_capture(context: RunContext) -> list[Stage]:
    """Plans the capture, and before it the poses if there are photographs or a video without poses."""
    options, capture = context.options, context.options.capture
    if is_bare_scene(capture):
        return [_plan_rendered_views(context)]
    if is_video(capture):
        what = f"the {options.frames or DEFAULT_VIDEO_FRAMES} sharpest frames of {capture.name}, evenly spread"
        key_options, files = context.key_options("frames"), [capture]
    else:
        files, notes = unposed_photographs(capture)
        if not files:
            return [_plan_load(context, capture)]
        what = " ".join([f"{len(files)} photographs, which have none{'.' * bool(notes)}", *notes])
        key_options = {"names": [photo.relative_to(capture).as_posix() for photo in files]}
    how = f"found by structure from motion (pycolmap) for {what}"
    folder = context.out / "poses"
    poses = Stage("poses", how, _estimate_poses, key_options=key_options, files=tuple(files), output_dir=folder)
    return [poses, dataclasses.replace(_plan_load(context, folder), after=("poses",), files=())]


def _plan_load(context: RunContext, capture: Path) -> Stage:
    """Plans the frames at the size that the options ask for, corrected if they ask for that."""
    options = context.options
    key_options = context.key_options("long_side", "frames", "holdout")
    count = "all frames" if options.frames is None else f"at most {options.frames} frames"
    held_out = f"1 in {options.holdout} held out" if options.holdout else "none held out"
    held_out = "the capture's own split or 1 in 8 held out" if options.holdout is None else held_out
    how = f"{count}, long side at most {options.long_side} px, {held_out}"
    refine = _refinement(options, capture)
    if refine != "never":
        key_options |= context.key_options("seed", "steps", "minutes") | {"refine": refine}
        how += ", corrected by short fits"
        how += " in about half of the fit's time where that helps" * (refine == "auto")
    return Stage("load", how, _load_frames, key_options=key_options, files=(capture,))


def _plan_rendered_views(context: RunContext) -> Stage:
    """Plans the stage "load" of a scene without photographs."""
    options = context.options
    files = (options.capture, options.cameras)
    skipped = {"photographs": "the scene comes without any", "held_out": "no photograph to compare with"}
    if options.cameras is None:
        how = f"{options.views} virtual views, planned from the Gaussians of {options.capture.name}"
        key_options = context.key_options("views", "up", "long_side")
    else:
        how = f"the scene rendered from the poses of {options.cameras.name}"
        key_options = context.key_options("long_side")
        skipped["planned views"] = f"the poses are given ({options.cameras.name})"
    return Stage("load", how, _render_views, key_options=key_options, files=files, skipped=skipped)


def plan_scene(context: RunContext) -> list[Stage]:
    """Plans the capture, the Gaussians, and the quality of the scene if there are photographs: the last."""
    how = "PSNR and SSIM of the rendered colours"
    held_out = Stage("held_out", how, _measure_held_out, after=("load", "gaussians"), distributed=True)
    scene = [*plan_capture(context), _plan_gaussians(context)]
    return scene if is_bare_scene(context.options.capture) else [*scene, held_out]


def _plan_gaussians(context: RunContext) -> Stage:
    """Plans the scene's Gaussians: of a file, brought into the capture's world, or fitted to the training frames."""
    options = context.options
    bare = is_bare_scene(options.capture)
    path = options.capture if bare else options.gaussians
    if path is None:
        length = f"{options.steps} steps" if options.minutes is None else f"{options.minutes:g} minutes"
        how, key_options = f"fitted to the frames in {length}", context.key_options("steps", "minutes", "seed")
        return Stage("gaussians", how, _fit_scene, after=("load",), key_options=key_options)
    transform = path.parent / "dataparser_transforms.json"
    key_options = {"trained": transform.read_text(errors="replace")} if transform.is_file() and not bare else {}
    skipped = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
    read = _read_bare_scene if bare else _read_gaussians_of_capture
    how = f"read from {path.name}"
    return Stage("gaussians", how, read, after=("load",), key_options=key_options, files=(path,), skipped=skipped)


def _estimate_poses(stage: StageInput) -> StageResult:
    """Finds the poses of photographs or of a video's frames, and writes them as a COLMAP capture to OUT/poses."""
    context, folder = stage.context, stage.checkpoint.folder
    capture, out = context.options.capture, context.out / "poses"
    video = is_video(capture)
    if video:
        frames = context.options.frames
        photos, found = write_frames(capture, folder / "frames", frames=frames, progress=stage.progress)
    else:
        photos, found = unposed_photographs(capture)
    posed, notes = find_poses(photos, folder, where=capture, progress=stage.progress)
    if video:
        shutil.rmtree(posed / "images")
        (folder / "frames").rename(posed / "images")
    shutil.rmtree(out, ignore_errors=True)
    shutil.move(posed, out)
    write_text(out / KEY_FILE, folder.name)
    return StageResult(None, (*found, *notes, f"The poses are in {out}: COLMAP opens them."))


def _refinement(options: Options, capture: Path) -> str:
    """When a run corrects poses and exposures: "auto" only if depth and the data can still decide it."""
    if options.refine != "auto":
        return options.refine
    if options.gaussians is not None:  # they belong to the poses as they are
        return "never"
    return "auto" if has_depth(capture) else "never"


def _load_frames(stage: StageInput) -> StageResult:
    """Loads the capture, in OUT/poses if its poses were estimated, and corrects it as the options ask."""
    options, sizes = stage.context.options, stage.context.key_options("long_side", "frames", "holdout")
    folder = stage.context.out / "poses" if hasattr(stage.results, "poses") else options.capture
    capture = load_capture(folder, **sizes, progress=stage.progress)
    train = training_frames(capture.held_out)
    count, height, width = capture.frames.shape[:3]
    frames = f"{count} frames of {width}x{height}, {count - len(train)} of them held out"
    points = f"{len(capture.points)} sparse points{'' if capture.depths is None else ', depth'}"
    notes = (f"{frames}, {points}", *capture.notes)
    refine = _refinement(options, folder)
    if refine == "never" or (refine == "auto" and capture.depths is None):
        return StageResult(capture, notes=notes)
    from jsecon.poses.refine import refine_capture  # late, like all that imports optax: a plan needs none of it

    limit = _fit_steps(options, capture) / 2 if refine == "auto" else None
    key = jax.random.key(options.seed)
    better = refine_capture(capture, key=key, max_fit_steps=limit, progress=stage.progress)
    return StageResult(better, notes=(*notes, *better.notes[len(capture.notes) :]))


def _fit_steps(options: Options, capture: Capture) -> float:
    """Steps of the photometric fit; those that `minutes` allow are estimated."""
    if options.minutes is None:
        return float(options.steps)
    megapixels = capture.cameras.width * capture.cameras.height / 1e6
    seconds_per_step = 0.024 + 0.2 * megapixels  # on two cores of an AMD EPYC
    return 60 * options.minutes / seconds_per_step


def _read_gaussians_of_capture(stage: StageInput) -> StageResult:
    """Reads the Gaussians of a file into the world of the capture."""
    path, capture = stage.context.options.gaussians, stage.results.load
    assert path is not None
    scene, read_notes = read_scene(path)
    transform = path.parent / "dataparser_transforms.json"
    trained = source_from_trained(transform) if transform.is_file() else None
    placed, notes = place_in_capture(scene, capture, path, trained, stage.progress)
    check_overlap(placed, capture.cameras[training_frames(capture.held_out)], str(path))
    return StageResult(placed, notes=(*notes, *read_notes))


def _fit_scene(stage: StageInput) -> StageResult:
    """Fits Gaussians to the training frames. A long fit may have one for each pixel of a frame, a short one half."""
    from jsecon.fit.optimise import Schedule, fit_gaussians

    options, capture, start = stage.context.options, stage.results.load, stage.checkpoint.read()
    notes = ()
    if start is None:
        start, origin = starting_gaussians(capture, sh_degree=2, progress=stage.progress)
        check_overlap(start, capture.cameras[training_frames(capture.held_out)], str(options.capture))
        notes = (f"start of the fit: {origin}",)
    pixels, minutes = capture.cameras.width * capture.cameras.height, options.minutes
    is_long = options.steps >= 3000 if minutes is None else minutes >= 3
    most = min(pixels if is_long else pixels // 2, Schedule.max_gaussians)
    # Half of the frames' size in the first half costs a program of its own. It pays in long fits: the demo's room has
    # 32.4 dB after 550 steps with it and 32.9 without, in the same time.
    sizes = ((1.0, 1.0),) if minutes is None and options.steps < 1000 else Schedule.sizes
    fitted, losses = fit_gaussians(
        capture,
        key=jax.random.key(options.seed),
        steps=options.steps if minutes is None else None,
        seconds=None if minutes is None else 60 * minutes,
        start=start,
        schedule=Schedule(sizes, most),
        on_checkpoint=lambda current: stage.checkpoint.keep(lambda: current),
        progress=stage.progress,
    )
    return StageResult(fitted, notes=(*notes, f"{fitted.count} Gaussians after {len(losses)} steps"))


def _measure_held_out(stage: StageInput) -> StageResult:
    """Measures the held-out frames, and names training frames that the scene does not explain."""
    capture, scene = stage.results.load, stage.results.gaussians
    background = None if stage.context.options.gaussians is None else fit_background(scene, capture)
    train = np.flatnonzero(~np.asarray(capture.held_out))
    measure = partial(measure_quality, scene, capture, background=background, progress=stage.progress)
    fitted = measure(frames=train, long_side=QUICK_LONG_SIDE)
    weak = np.flatnonzero(is_weak(np.asarray(fitted.psnr)))
    notes = ()
    if len(weak):
        names = ", ".join(f"{capture.names[fitted.frames[n]]} ({fitted.psnr[n]:.1f} dB)" for n in weak[:5])
        more = f" and {len(weak) - 5} more" if len(weak) > 5 else ""
        note = f"far below the median frame ({np.median(fitted.psnr):.1f} dB): {names}{more}; a wrong pose, or "
        notes = (note + "something moved: leave them out if the scene is blurred there",)
    return StageResult(measure(), notes=notes)


def _render_views(stage: StageInput) -> StageResult:
    """Renders a scene without photographs from planned views, or from the poses of a file."""
    options, notes, up = stage.context.options, (), None
    source, _ = read_scene(options.capture)
    source_from_scene = _world_of_scene(source)
    scene = _into_world(source, source_from_scene)
    if options.cameras is None:
        planned = place_cameras(
            scene,
            views=options.views,
            width=options.long_side,
            height=options.long_side * 3 // 4,
            up=None if options.up is None else np.array(options.up, np.float64),
            progress=stage.progress,
        )
        frame = planned.frame
        up = UpAxis(tuple(frame.axes[2].tolist()), f"the scene, {frame.evidence}", frame.sure)
        cameras, notes = planned.cameras, (f"{planned}.", *(WARNING + note for note in planned.lack_of_detail()))
        names = tuple(f"view_{index:03d}" for index in range(len(cameras)))
    else:
        cameras, names = _load_poses(options.cameras, options.long_side, source_from_scene)
        check_overlap(scene, cameras, str(options.cameras))
    capture = render_capture(scene, cameras, names, source_from_scene, notes=notes, up=up)
    return StageResult(capture, notes=notes)


def _world_of_scene(gaussians: Gaussians) -> np.ndarray:
    """Returns the (4, 4) similarity to the world of a scene's file from one in which the scene has ordinary numbers.

    A scene from the size of a table to that of a flat, in metres, keeps its units. One that is further from the origin
    than 100 times its size is moved there: float32 has few digits out there.
    """
    frame = scene_frame(surface_points(gaussians))
    source_from_scene = np.eye(4)
    if not 3 <= frame.diagonal <= 30:
        source_from_scene[:3, :3] *= frame.diagonal / 6
    if np.linalg.norm(frame.centre) > 100 * frame.diagonal:
        source_from_scene[:3, 3] = frame.centre
    return source_from_scene


def _into_world(gaussians: Gaussians, source_from_scene: np.ndarray) -> Gaussians:
    """Moves Gaussians from the world of their file into that of the capture, in float32."""
    moved = transform_gaussians(gaussians, np.linalg.inv(source_from_scene))
    return dataclasses.replace(moved, means=np.asarray(moved.means, np.float32))


def _load_poses(path: Path, long_side: int, source_from_scene: np.ndarray) -> tuple[Camera, tuple[str, ...]]:
    """Returns T cameras to render from, and their names.

    `path` is a capture, whose images need not be there, such as the folder of a COLMAP model or a transforms.json. All
    cameras get the size of the first lens, shrunk to `long_side`, each with its field of view and without distortion.
    """
    images, _ = usable_images(read_posed_images(path))
    lenses = [image.lens for image in images if image.lens is not None]
    if not images or len(lenses) < len(images):
        problem = "one of its frames has no size" if images else "it has no frame"
        raise InputError(path, problem, "at least one pose, each with w and h", "Estimate the poses again.")
    width, height = FrameOptions(long_side=long_side).size((lenses[0].width, lenses[0].height))
    sized = [lens.resized(width, height) for lens in lenses]
    intrinsics = np.array([[lens.fx, lens.fy, lens.cx, lens.cy] for lens in sized], np.float32)
    poses = np.stack([make_rigid(image.world_to_camera, path, image.name) for image in images])
    poses = transform_poses(poses, np.linalg.inv(source_from_scene)).astype(np.float32)
    fx, fy, cx, cy = intrinsics.T
    return Camera(poses, fx, fy, cx, cy, width, height), frame_names([image.name for image in images], path)


def _read_bare_scene(stage: StageInput) -> StageResult:
    """Reads a scene without photographs into the world of its rendered views."""
    source, notes = read_scene(stage.context.options.capture)
    return StageResult(_into_world(source, np.asarray(stage.results.load.source_from_scene, np.float64)), notes=notes)
