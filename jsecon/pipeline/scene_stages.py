"""The stages of a scene: poses, frames, Gaussians and their quality, with photographs or without.

A scene that comes without photographs is rendered from given poses, from those that lie near it, or from planned views.
Only `_load_frames` and `_measure_held_out` read held-out frames.
"""

import dataclasses
import os
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import InputError, join_first
from jsecon.fit.quality import QUICK_LONG_SIDE, measure_quality
from jsecon.fit.start import starting_gaussians
from jsecon.numerics import FRUSTUM_MARGIN, NEAR
from jsecon.pipeline.ignoring import ignore_named
from jsecon.pipeline.options import Options, is_bare_scene
from jsecon.pipeline.scene_files import fit_background, place_in_capture, read_scene
from jsecon.pipeline.stages import WARNING, RunContext, Stage, StageInput, StageResult, training_frames
from jsecon.poses.sfm import find_poses
from jsecon.read.captures.capture import find_panoramas, has_depth, load_capture, read_posed_images, unposed_photographs
from jsecon.read.captures.frames import (
    FrameOptions,
    PosedImages,
    evenly_spaced,
    frame_names,
    transform_poses,
    usable_images,
)
from jsecon.read.captures.lens import undistorted_pinhole
from jsecon.read.captures.nerfstudio import source_from_trained
from jsecon.read.captures.video import DEFAULT_VIDEO_FRAMES, has_panorama_mark, is_video, write_frames
from jsecon.read.splats.point_clouds import gaussians_of_cloud
from jsecon.splat.render import render_depth
from jsecon.splat.sh import C0
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Camera, Capture, Gaussians, Progress, UpAxis
from jsecon.views.frame import find_up_axis, scene_frame, surface_points
from jsecon.views.placing import DEFAULT_VIEWS, cover_with, place_cameras
from jsecon.views.rendered import render_capture

MIN_GAP_DB, MIN_GAP_SPREADS = 5.0, 5.0
"""Least distance below the median PSNR at which a frame is called weak, in dB, and in median absolute deviations."""
_TRAINED = "dataparser_transforms.json"
"""file of nerfstudio with the world in which it trained"""
_NEAR_VIEWS = 48
"""views at poses near a scene: they take no longer than planning 24 does, and match more"""
_LEAST_USABLE, _LEAST_COVERAGE = 0.8, 0.7
"""shares of poses that show some of a scene, and of the scene that they show, from which they are in its world"""


def plan_capture(context: RunContext) -> list[Stage]:
    """Plans the capture, and before it the poses if there are photographs or a video without poses."""
    options, capture = context.options, context.options.capture
    files, notes = unposed_photographs(capture)
    if options.panoramas and not files and not is_video(capture):
        problem = "the input is no folder of photographs without poses, and no video"
        raise InputError("--panoramas", problem, remedy="Leave it out: the camera model of a capture names panoramas.")
    if is_bare_scene(capture):
        return [_plan_rendered_views(context)]
    if is_video(capture):
        count, is_round = _frames_of_video(options)
        what = f"the {count} sharpest {'panoramas' if is_round else 'frames'} of {capture.name}, evenly spread"
        key_options, files = context.key_options("frames"), [capture]
    elif files:
        panoramas, hints = find_panoramas(files, declared=options.panoramas)
        notes += hints
        kind = f"photographs, {len(panoramas)} of them panoramas," if panoramas else "photographs,"
        what = " ".join([f"{len(files)} {kind} which have none{'.' * bool(notes)}", *notes])
        key_options = {"names": [photo.relative_to(capture).as_posix() for photo in files]}
    else:
        return [_plan_load(context, capture)]
    key_options |= context.key_options("panoramas")
    task = f"found by structure from motion (pycolmap) for {what}"
    if context.options.points is not None:
        problem = "the photographs have no poses, so no world that the points could be in"
        raise InputError("--points", problem, "", "Give a capture with poses in the world of the points.")
    poses = Stage("poses", task, _estimate_poses, key_options=key_options, files=tuple(files))
    return [poses, dataclasses.replace(_plan_load(context, None), after=("poses",))]


def _frames_of_video(options: Options) -> tuple[int, bool]:
    """How many frames of a video are taken, and whether they are panoramas, of which each shows more."""
    is_round = options.panoramas or has_panorama_mark(options.capture)
    return options.frames or DEFAULT_VIDEO_FRAMES // (3 if is_round else 1), is_round


def _plan_load(context: RunContext, capture: Path | None) -> Stage:
    """Plans the frames at the size that the options ask for, corrected if they ask for that.

    The capture is None if its poses are yet to be found.
    """
    options = context.options
    key_options = context.key_options("long_side", "frames", "holdout")
    task = f"frames, long side at most {options.long_side} px"
    task += ", held out by the capture's own split or 1 in 8" * (options.holdout is None)
    refine = _refinement(options, capture)
    if refine != "never":
        key_options |= context.key_options("seed", "steps", "minutes") | {"refine": refine}
        task += ", corrected by short fits"
        task += " in about half of the fit's time where that helps" * (refine == "auto")
    if options.ignore is not None:
        embedder, segmenter = context.models.embedder, context.models.segmenter
        if segmenter is None:
            raise InputError("--ignore", "no network finds masks in the frames", remedy="Add --models auto.")
        key_options |= context.key_options("ignore") | {"embedder": embedder.name, "segmenter": segmenter.name}
        task += f", without the pixels of {options.ignore}"
    return Stage("load", task, _load_frames, key_options=key_options, files=(capture, options.points))


def _plan_rendered_views(context: RunContext) -> Stage:
    """Plans the stage "load" of a scene without photographs."""
    options, near = context.options, _poses_near(context.options)
    files = (options.capture, options.cameras, near, near and _near(options.capture, _TRAINED))
    key_options = context.key_options("views", "up", "long_side")
    if options.cameras is not None:
        task = f"the scene rendered from the poses of {options.cameras.name}"
        key_options = context.key_options("long_side")
    elif near is not None:
        task = f"{_NEAR_VIEWS} of the poses of {near}, or planned views if these do not show {options.capture.name}"
    else:
        task = f"{options.views or DEFAULT_VIEWS} virtual views, planned from the Gaussians of {options.capture.name}"
    return Stage("load", task, _render_views, key_options=key_options, files=files)


def _near(scene: Path, *names: str) -> Path | None:
    """The first of some files in the folder of a scene and the two above, where INRIA and nerfstudio leave them."""
    places = [folder / name for folder in Path(os.path.abspath(scene)).parents[:3] for name in names]
    return next((place for place in places if place.exists()), None)


def _poses_near(options: Options) -> Path | None:
    """The poses that lie near a scene, if the options leave its views open."""
    is_open = options.cameras is None and options.views is None
    return _near(options.capture, "cameras.json", "transforms.json", "sparse") if is_open else None


def plan_scene(context: RunContext) -> list[Stage]:
    """Plans the capture, the Gaussians, and the quality of the scene if there are photographs: the last."""
    task = "PSNR and SSIM of the rendered colours"
    held_out = Stage("held_out", task, _measure_held_out, after=("load", "gaussians"), distributed=True)
    scene = [*plan_capture(context), _plan_gaussians(context)]
    return scene if is_bare_scene(context.options.capture) else [*scene, held_out]


def _plan_gaussians(context: RunContext) -> Stage:
    """Plans the scene's Gaussians: of a file, brought into the capture's world, or fitted to the training frames."""
    options = context.options
    bare = is_bare_scene(options.capture)
    path = options.capture if bare else options.gaussians
    if path is None:
        length = f"{options.steps} steps" if options.minutes is None else f"{options.minutes:g} minutes"
        task, key_options = f"fitted to the frames in {length}", context.key_options("steps", "minutes", "seed")
        return Stage("gaussians", task, _fit_scene, after=("load",), key_options=key_options)
    transform = None if bare else _near(path, _TRAINED)
    key_options = {} if transform is None else {"trained": transform.read_text(errors="replace")}
    read = _read_bare_scene if bare else _read_gaussians_of_capture
    task = f"read from {path.name}"
    return Stage("gaussians", task, read, after=("load",), key_options=key_options, files=(path,))


def _estimate_poses(stage: StageInput) -> StageResult:
    """Finds the poses of photographs or of a video's frames; the result names their COLMAP capture in OUT/cache."""
    context, folder = stage.context, stage.checkpoint.folder
    capture, out = context.options.capture, folder.with_suffix("")
    video, declared = is_video(capture), context.options.panoramas
    if video:
        frames, declared = _frames_of_video(context.options)
        photos, found = write_frames(capture, folder / "frames", frames, stage.progress)
    else:
        photos, found = unposed_photographs(capture)
    panoramas, hints = find_panoramas(photos, declared=declared)
    posed, notes = find_poses(photos, folder, panoramas=panoramas, where=capture, progress=stage.progress)
    if video:
        shutil.rmtree(posed / "images")
        (folder / "frames").rename(posed / "images")
    shutil.rmtree(out, ignore_errors=True)
    shutil.move(posed, out)
    return StageResult(out.name, (*found, *hints, *notes, f"The poses are in {out}: COLMAP opens them."))


def _refinement(options: Options, capture: Path | None) -> str:
    """When a run corrects poses and exposures: "auto" only if depth and the data can still decide it."""
    if options.refine != "auto":
        return options.refine
    if options.gaussians is not None:  # they belong to the poses as they are
        return "never"
    return "auto" if capture is not None and has_depth(capture) else "never"


def _load_frames(stage: StageInput) -> StageResult:
    """Loads the capture, in OUT/cache if its poses were estimated, and corrects it as the options ask."""
    options, sizes = stage.context.options, stage.context.key_options("long_side", "frames", "holdout")
    poses = stage.results.poses
    folder = options.capture if poses is None else stage.context.out / "cache" / poses
    capture = load_capture(folder, **sizes, progress=stage.progress)
    if options.points is not None:
        capture = _with_points(capture, options.points, stage.progress)
    if options.ignore is not None:
        texts = [text.strip() for text in options.ignore.split(",")]
        capture = ignore_named(capture, texts, stage.context.models, stage.context.out / "masks", stage.progress)
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


def _with_points(capture: Capture, path: Path, progress: Progress) -> Capture:
    """Gives a capture the points of a cloud in the world of its files, and their depth if it has none of its own."""
    cloud, notes = gaussians_of_cloud(path, 100_000)  # as many as a fit starts from with depth frames
    scene = jax.tree.map(jnp.asarray, transform_gaussians(cloud, np.linalg.inv(capture.source_from_scene)))
    train = np.flatnonzero(~np.asarray(capture.held_out))
    _check_overlap(scene, capture.cameras[train], str(path))
    depths = capture.depths
    if depths is None:
        depths = np.zeros(capture.frames.shape[:3], np.float32)
        for n, t in enumerate(train):
            depth, alpha = map(np.asarray, render_depth(scene, capture.cameras[int(t)]))
            depths[t] = np.where(alpha > 0.5, depth, 0)
            progress(n + 1, len(train))
    colours = np.rint(255 * np.clip(0.5 + C0 * cloud.sh[:, 0], 0, 1)).astype(np.uint8)
    changes = {"points": np.asarray(scene.means), "point_colors": colours, "depths": depths}
    return dataclasses.replace(capture, **changes, notes=(*capture.notes, *notes))


def _check_overlap(gaussians: Gaussians, cameras: Camera, where: str) -> None:
    """Checks that at least two cameras see the centres of some of the Gaussians, of which it takes 10,000."""
    centres = np.asarray(gaussians.means[:: max(gaussians.count // 10_000, 1)], np.float64)
    views = np.zeros(len(centres), int)
    for camera in jax.tree.map(np.asarray, cameras):
        x, y, z = camera.world_to_camera[:3, :3] @ centres.T + camera.world_to_camera[:3, 3:]
        beside = np.abs(camera.fx * x + (camera.cx - camera.width / 2) * z) > FRUSTUM_MARGIN * camera.width / 2 * z
        above = np.abs(camera.fy * y + (camera.cy - camera.height / 2) * z) > FRUSTUM_MARGIN * camera.height / 2 * z
        views += (z > NEAR) & ~beside & ~above
    share = float(np.mean(views >= 2)) if len(centres) else 0.0
    if share < 0.01:
        count = len(cameras.world_to_camera)
        problem = f"{share:.1%} of {gaussians.count} points in the view of two or more of the {count} frames"
        remedy = "Check that the poses belong to these frames, and the Gaussians to this capture."
        raise InputError(where, problem, "views that overlap, and a scene in the world of their poses", remedy)


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
    transform = _near(path, _TRAINED)
    trained = None if transform is None else source_from_trained(transform)
    placed, note = place_in_capture(scene, capture, path, trained, stage.progress)
    _check_overlap(placed, capture.cameras[training_frames(capture.held_out)], str(path))
    return StageResult(placed, notes=(note, *read_notes))


def _fit_scene(stage: StageInput) -> StageResult:
    """Fits Gaussians to the training frames. A long fit may have one for each pixel of a frame, a short one half."""
    from jsecon.fit.optimise import Schedule, fit_gaussians

    options, capture, start = stage.context.options, stage.results.load, stage.checkpoint.read()
    notes = ()
    if start is None:
        started = capture if options.points is None else dataclasses.replace(capture, depths=None)
        start, origin = starting_gaussians(started, sh_degree=2, progress=stage.progress)
        _check_overlap(start, capture.cameras[training_frames(capture.held_out)], str(options.capture))
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
        on_checkpoint=stage.checkpoint.keep,
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
        names = join_first([f"{capture.names[fitted.frames[n]]} ({fitted.psnr[n]:.1f} dB)" for n in weak])
        note = f"far below the median frame ({np.median(fitted.psnr):.1f} dB): {names}; a wrong pose, or "
        notes = (note + "something moved: leave them out if the scene is blurred there",)
    return StageResult(measure(), notes=notes)


def is_weak(psnr: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Finds frames far below the median PSNR (dB): wrong poses, moving things, a finger before the lens."""
    values = np.asarray(psnr, np.float64)
    known = values[np.isfinite(values)]
    if not len(known):
        return np.zeros(len(values), bool)
    median = np.median(known)
    return median - values > max(MIN_GAP_DB, MIN_GAP_SPREADS * float(np.median(np.abs(median - known))))


class _Views(NamedTuple):
    """Where a scene without photographs is rendered from."""

    cameras: Camera
    """Batch of T, in the scene's world."""
    names: Sequence[str]
    """T names."""
    notes: tuple[str, ...] = ()
    """What the user should know, a sentence each."""
    up: UpAxis | None = None
    """Which way is up in the scene's world, if that is known with the views."""


def _render_views(stage: StageInput) -> StageResult:
    """Renders a scene without photographs from the poses of a file, from those near it, or from planned views."""
    bare = open_bare_scene(stage.context.options, stage.progress)
    views, world = bare.views, bare.source_from_scene
    capture = render_capture(bare.scene, views.cameras, tuple(views.names), world, notes=views.notes, up=views.up)
    return StageResult(capture, notes=views.notes)


class _BareScene(NamedTuple):
    """A scene without photographs, with views of it."""

    scene: Gaussians
    """In a world of ordinary numbers."""
    source_from_scene: np.ndarray
    """(4, 4) similarity from that world to the file's."""
    views: _Views


def open_bare_scene(options: Options, progress: Progress) -> _BareScene:
    """Reads a scene without photographs, and finds views of it: given ones, those near it, or planned ones."""
    near = _poses_near(options)
    source, _ = read_scene(options.capture)
    source_from_scene = _world_of_scene(_every_nth(source))
    scene = _into_world(source, source_from_scene)
    if options.cameras is not None:
        _, cameras, names = _load_poses(options.cameras, options.long_side)
        views = _Views(_moved(cameras, np.linalg.inv(source_from_scene)), names)
        _check_overlap(scene, views.cameras, str(options.cameras))
        return _BareScene(scene, source_from_scene, views)
    refused, views = (), None
    if near is not None:
        try:
            views = _choose_near(near, options, _every_nth(scene), source_from_scene, progress)
        except InputError as error:
            refused = (f"{WARNING}Views are planned, as the poses near the scene cannot be used. {error}",)
    views = views or _plan_views(options, _every_nth(scene), progress)
    return _BareScene(scene, source_from_scene, views._replace(notes=refused + views.notes))


def _every_nth(scene: Gaussians) -> Gaussians:
    """Takes few enough of a large scene's Gaussians to plan views, so much wider that they cover as much."""
    step = -(-scene.count // (1 << 16))  # views are planned at 80x60 px
    part = scene if step == 1 else jax.tree.map(lambda column: np.asarray(column[::step]), scene)
    return dataclasses.replace(part, log_scales=part.log_scales + np.float32(0.5 * np.log(step)))


def _plan_views(options: Options, scene: Gaussians, progress: Progress) -> _Views:
    """Plans virtual views of a scene."""
    planned = place_cameras(
        scene,
        views=options.views or DEFAULT_VIEWS,
        width=options.long_side,
        height=options.long_side * 3 // 4,
        up=None if options.up is None else np.array(options.up, np.float64),
        progress=progress,
    )
    frame = planned.frame
    up = UpAxis(tuple(frame.axes[2].tolist()), f"the scene, {frame.evidence}", frame.sure)
    names = [f"view_{index:03d}" for index in range(len(planned.cameras))]
    return _Views(planned.cameras, names, (f"{planned}.", *(WARNING + note for note in planned.lack_of_detail())), up)


def _choose_near(
    near: Path, options: Options, scene: Gaussians, source_from_scene: np.ndarray, progress: Progress
) -> _Views:
    """Chooses views among the poses that lie near a scene, in the first world where they show nearly most of it.

    The worlds are that of nerfstudio's training, if its file is there, that of the poses, and that of the files from
    which these were made. Raises InputError if the poses show too little of the scene in each.
    """
    posed, cameras, names = _load_poses(near, options.long_side)
    rows = evenly_spaced(len(cameras), 256)
    transform, worlds = _near(options.capture, _TRAINED), [np.eye(4), np.asarray(posed.source_from_poses)]
    if transform is not None:
        to_trained = np.linalg.inv(source_from_trained(transform))
        worlds = [to_trained @ worlds[1], to_trained, *worlds]
    views = []
    for n, world in enumerate(worlds):
        if not any(np.allclose(world, other) for other in worlds[:n]):
            scene_from_poses = np.linalg.inv(source_from_scene) @ world
            moved = _moved(cameras[rows], scene_from_poses)
            views.append((cover_with(scene, moved, _NEAR_VIEWS, progress), moved, scene_from_poses))
    best = max(cover.coverage for cover, _, _ in views)
    cover, moved, scene_from_poses = next(view for view in views if view[0].coverage >= best - 0.05)
    found = f"{len(cameras)} cameras, {cover.usable:.0%} of which show {cover.coverage:.0%} of {options.capture.name}"
    if min(len(rows) / 2, cover.usable / _LEAST_USABLE, cover.coverage / _LEAST_COVERAGE) < 1:
        remedy = (
            "Put poses in the world of the scene there, with the dataparser_transforms.json of nerfstudio's training."
        )
        raise InputError(near, found, f"2 cameras, {_LEAST_USABLE:.0%} and {_LEAST_COVERAGE:.0%} or more", remedy)
    up = find_up_axis(scene, moved)
    if posed.up is not None:
        axis = scene_from_poses[:3, :3] @ posed.up.axis
        up = dataclasses.replace(posed.up, axis=tuple((axis / np.linalg.norm(axis)).tolist()))
    note = f"{len(cover.chosen)} views at poses of {near}: {found}."
    chosen = np.sort(cover.chosen)
    return _Views(moved[chosen], [names[row] for row in rows[chosen]], (note,), up)


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
    """Moves Gaussians from the world of their file into that of the capture, in float32; colours need no rotation."""
    moved = transform_gaussians(
        dataclasses.replace(gaussians, sh=gaussians.sh[:, :1]), np.linalg.inv(source_from_scene)
    )
    return dataclasses.replace(moved, means=np.asarray(moved.means, np.float32), sh=gaussians.sh)


def _load_poses(path: Path, long_side: int) -> tuple[PosedImages, Camera, tuple[str, ...]]:
    """Reads T poses to render from: as they are, and T cameras in float64 in their world, and their names.

    `path` is a capture, whose images need not be there, such as the folder of a COLMAP model or a transforms.json. All
    cameras get the size of the first lens, shrunk to `long_side`, each with its field of view and without distortion.
    """
    posed = read_posed_images(path.parent if path.name == "sparse" else path)
    images, _ = usable_images(posed)
    lenses = [image.lens for image in images if image.lens is not None]
    if not images or len(lenses) < len(images):
        problem = "one of its frames has no size" if images else "it has no frame"
        raise InputError(path, problem, "at least one pose, each with w and h", "Estimate the poses again.")
    lenses = [lens if lens.view is None else undistorted_pinhole(lens, path) for lens in lenses]
    width, height = FrameOptions(long_side=long_side).size((lenses[0].width, lenses[0].height))
    sized = [lens.resized(width, height) for lens in lenses]
    fx, fy, cx, cy = np.array([[lens.fx, lens.fy, lens.cx, lens.cy] for lens in sized], np.float32).T
    poses = np.stack([image.world_to_camera for image in images])
    names = frame_names([image.name for image in images], path)
    return posed, Camera(poses, fx, fy, cx, cy, width, height), names


def _moved(cameras: Camera, world: np.ndarray) -> Camera:
    """Moves cameras by a similarity of their world, into float32."""
    poses = transform_poses(np.asarray(cameras.world_to_camera), world)
    return dataclasses.replace(cameras, world_to_camera=poses.astype(np.float32))


def _read_bare_scene(stage: StageInput) -> StageResult:
    """Reads a scene without photographs into the world of its rendered views."""
    source, notes = read_scene(stage.context.options.capture)
    return StageResult(_into_world(source, np.asarray(stage.results.load.source_from_scene, np.float64)), notes=notes)
