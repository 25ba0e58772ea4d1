"""The stages about the scene: poses are found where there are none, the capture is loaded, its Gaussians are read or
fitted, held-out frames are measured."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.data.coordinates import transform_poses
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.pipeline.bare_stages import is_bare_scene, planned_views, scene_itself
from jsecon.pipeline.options import SceneOptions
from jsecon.pipeline.progress import Progress
from jsecon.pipeline.stages import (
    KEY_FILE,
    WARNING,
    Checkpoint,
    Results,
    RunContext,
    Stage,
    StageResult,
    training_frames,
)
from jsecon.types import Camera, Capture, Gaussians


def capture_stages(work: RunContext) -> list[Stage]:
    """The capture; before it, where there are photographs or a video without poses, the poses."""
    if work.load is None and is_bare_scene(work.options.capture):
        return [planned_views(work)]
    if work.load is not None or not _bare(work.options.capture):
        return [load(work)]
    found = poses(work)
    posed = dataclasses.replace(work, options=dataclasses.replace(work.options, capture=found.output_dir))
    return [found, dataclasses.replace(load(posed), after=("poses",), files=None)]


def _bare(capture: Path) -> bool:
    """Whether it is a video, or a folder of photographs without a file of poses."""
    if capture.is_dir():
        from jsecon.data.capture import unposed_photographs

        return len(unposed_photographs(capture)) > 0
    from jsecon.data.video import is_video

    return is_video(capture)


def poses(work: RunContext) -> Stage:
    """The poses of bare photographs or of a video's frames, as a COLMAP capture in OUT/poses."""
    from jsecon.data.sfm import find_poses, list_photographs
    from jsecon.data.video import DEFAULT_VIDEO_FRAMES, is_video, write_frames

    capture, out, video = work.options.capture, work.out / "poses", is_video(work.options.capture)

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        folder = record.folder
        if video:
            photos = write_frames(capture, folder / "frames", frames=work.options.frames, progress=progress)
        else:
            photos = list_photographs(capture)
        found, posed = find_poses(photos, folder, where=capture, progress=progress)
        if video:
            shutil.rmtree(posed / "images")
            (folder / "frames").rename(posed / "images")
        shutil.rmtree(out, ignore_errors=True)
        shutil.move(posed, out)
        write_text(out / KEY_FILE, folder.name)
        return StageResult(found, notes=(*found.notes(), f"The poses are in {out}: COLMAP opens them."))

    if video:
        what = f"the {work.options.frames or DEFAULT_VIDEO_FRAMES} sharpest frames of {capture.name}, evenly spread"
    else:
        what = f"{len(list_photographs(capture))} photographs, which have none"
    how = f"found by structure from motion (pycolmap) for {what}"
    if video:
        return Stage(
            "poses", how, compute, "data", key_options=work.key_options("frames"), files=capture, output_dir=out
        )
    given = {"names": [photo.relative_to(capture).as_posix() for photo in list_photographs(capture)]}
    return Stage(
        "poses", how, compute, "data", key_options=given, files=lambda: list_photographs(capture), output_dir=out
    )


STEP_SECONDS = 0.024, 0.2
"""seconds of a step of the fit, and seconds more per million pixels of a frame, measured on two cores of an AMD EPYC;
estimates how many steps --minutes allows"""


def load(work: RunContext) -> Stage:
    """Loads the capture at the size that the options ask for, and corrects it where they ask for that."""
    as_it_is = refinement(work) == "none" and work.options.drop_frames == "none"
    return _as_it_is(work) if as_it_is else _put_right(work)


def refinement(work: RunContext) -> Literal["none", "poses", "exposure", "both", "auto"]:
    """What a run corrects of poses and exposures; "auto" only where depth and the data can still decide it."""
    options = work.options
    if options.refine != "auto":
        return options.refine
    from jsecon.data.capture import may_have_depth

    if options.gaussians is not None:  # they belong to the poses as they are
        return "none"
    return "auto" if work.load is not None or may_have_depth(options.capture) else "none"


def _put_right(work: RunContext) -> Stage:
    """Corrects poses and exposures by probe fits, and leaves out the frames that these do not explain."""
    options, plain, asked = work.options, _as_it_is(work), refinement(work)

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.fit.corrections import RefineOptions
        from jsecon.fit.refine import refine_capture

        loaded = plain.compute(results, progress, record)
        capture, refine, max_fit_steps = loaded.value, None, None
        if asked == "auto" and capture.depths is not None:
            refine, max_fit_steps = RefineOptions(), _fit_steps(options, capture) / 2
        elif asked not in ("auto", "none"):
            refine = RefineOptions(asked in ("poses", "both"), asked in ("exposure", "both"))
        better = refine_capture(
            capture,
            key=jax.random.key(options.seed),
            refine=refine,
            drop_weak=options.drop_frames == "auto",
            decide=asked == "auto",
            max_fit_steps=max_fit_steps,
            progress=progress,
        )
        training_frames(better)
        return StageResult(better, notes=(*loaded.notes, *better.notes[len(capture.notes) :]))

    given = work.key_options("drop_frames", "seed") | {"refine": asked}
    if asked == "auto":
        given |= work.key_options("steps", "minutes")
        how = "poses and exposures corrected where that helps, in about half of the fit's time at most (--refine auto)"
    else:
        how = f"corrected by short fits (--refine {asked})" if asked != "none" else ""
    left = "frames that a short fit does not explain left out" if options.drop_frames == "auto" else ""
    how = ", ".join(part for part in (plain.how, how, left) if part)
    return Stage("load", how, compute, "fit", key_options={**plain.key_options, **given}, files=plain.files)


def _fit_steps(options: SceneOptions, capture: Capture) -> float:
    """Steps of the photometric fit; those that `minutes` allow are estimated."""
    if options.minutes is None:
        return float(options.steps)
    once, by_pixels = STEP_SECONDS
    pixels = capture.cameras.width * capture.cameras.height / 1e6
    return 60 * options.minutes / (once + by_pixels * pixels)


def _as_it_is(work: RunContext) -> Stage:
    """The capture as its files say."""
    options, asked = work.options, work.key_options("downscale", "long_side", "frames", "holdout")

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        if work.load is not None:
            return _checked(work.load(), "by its adapter")
        from jsecon.data.capture import load_capture

        return _checked(load_capture(options.capture, **asked, progress=progress), size)

    if options.downscale is None:
        size = f"long side at most {options.long_side} px"
    else:
        size = "full size" if options.downscale == 1 else f"{options.downscale:g} times smaller"
    count = "all frames" if options.frames is None else f"at most {options.frames} frames"
    held = f"1 in {options.holdout} held out" if options.holdout else "none held out"
    given = asked | {"loader": getattr(work.load, "__qualname__", None)}
    return Stage("load", f"{count}, {size}, {held}", compute, "data", key_options=given, files=options.capture)


def _checked(capture: Capture, size: str) -> StageResult:
    """The capture as an Outcome that says what it is. Raises InputError where its views cannot be used together."""
    from jsecon.data.capture import check_views_overlap

    train = training_frames(capture)
    check_views_overlap(capture)
    count, height, width = capture.frames.shape[:3]
    told = f"{count} frames of {width}x{height} ({size}), {count - len(train)} of them held out"
    points = f"{len(capture.points)} sparse points{'' if capture.depths is None else ', depth'}"
    return StageResult(capture, notes=(f"{told}, {points}", *capture.notes))


def gaussians(work: RunContext) -> Stage:
    """The scene's Gaussians: of a file in the capture's world, or fitted to the training frames."""
    if work.load is None and is_bare_scene(work.options.capture):
        return scene_itself(work)
    return _fitted(work) if work.options.gaussians is None else _read(work)


def _read(work: RunContext) -> Stage:
    path = work.options.gaussians
    assert path is not None
    trained = path.parent / "dataparser_transforms.json"

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.data.nerfstudio import trained_to_source

        capture, (given, said) = results["load"], given_gaussians(path)
        told = trained_to_source(trained) if trained.is_file() else None
        found, notes = _in_the_captures_world(given, capture, path, told, progress)
        check_overlap(found, capture.cameras[training_frames(capture)], str(path))
        return StageResult(found, notes=(*notes, *said))

    given = {"trained": trained.read_text(errors="replace")} if trained.is_file() else {}
    left = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
    return Stage(
        "gaussians",
        f"read from {path.name}",
        compute,
        "fit",
        after=("load",),
        key_options=given,
        files=path,
        skipped=left,
    )


def given_gaussians(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """A file's Gaussians (NumPy), and what its reader has to say of them. Raises InputError where there is none."""
    from jsecon.data.gaussians.files import read_gaussians

    found, notes = read_gaussians(path)
    if not found.count:
        raise InputError(path, "the file holds no Gaussians", "at least one", "Export the scene again.")
    return found, notes


_LEAD = 0.05
"""of correlation with the frames, that a less likely world must have before a likelier one"""
_ROUGHLY = 0.6
"""correlation with the frames below which more is said: a fitted scene has 0.97 in its world, 0.56 a tenth of a metre
beside it, 0.39 when turned by 20 degrees, and a crude one 0.81 in its world"""


def _in_the_captures_world(
    gaussians: Gaussians, capture: Capture, path: Path, trained: np.ndarray | None, progress: Progress
) -> tuple[Gaussians, tuple[str, ...]]:
    """A file's Gaussians (NumPy, float64 means) in the world of the capture's cameras, and what was taken for theirs.

    The file does not tell its world, so a few frames are rendered in each that it may be: the one that `trained` leads
    back from, the capture files', the poses', those of known trainings. The one that looks like the frames is taken.
    """
    from jsecon.fit.worlds import photo_similarity, training_worlds
    from jsecon.splat.transform import transform_gaussians_float64

    to_source = np.asarray(capture.to_source, np.float64)
    to_poses = np.eye(4) if capture.to_poses is None else np.asarray(capture.to_poses, np.float64)
    transformed = not np.allclose(to_poses, to_source, rtol=1e-9, atol=1e-9 * np.abs(to_source).max())
    worlds: list[tuple[str, np.ndarray]] = []
    if trained is not None:
        worlds.append(("dataparser_transforms.json", trained))
        if transformed:
            worlds.append(("dataparser_transforms.json, of the poses", to_source @ np.linalg.inv(to_poses) @ trained))
    worlds.append(("the capture's files" if transformed else "the capture's poses", np.eye(4)))
    if transformed:
        worlds.append(("the poses, without the applied_transform undone", to_source @ np.linalg.inv(to_poses)))

    def seen_in(world: np.ndarray) -> tuple[Gaussians, Any]:
        moved = transform_gaussians_float64(gaussians, np.linalg.inv(to_source) @ world)
        scene = jax.tree.map(jnp.asarray, moved)
        return scene, photo_similarity(scene, capture)

    looked = []
    for n, (name, world) in enumerate(worlds):
        looked.append((name, *seen_in(world)))
        progress(n + 1, len(worlds))
    best = looked[0]
    for other in looked[1:]:
        if other[2].correlation > best[2].correlation + _LEAD:
            best = other
    if not best[2].explained:
        cameras = np.linalg.inv(transform_poses(np.asarray(capture.cameras.world_to_camera, np.float64), to_poses))
        points = np.asarray(capture.points, np.float64) @ to_poses[:3, :3].T + to_poses[:3, 3]
        for name, world in training_worlds(cameras, points):
            scene, seen = seen_in(to_source @ np.linalg.inv(world @ to_poses))
            if seen.explained and seen.correlation > best[2].correlation + _LEAD:
                best = f"the training, normalised as by {name}", scene, seen
    name, scene, seen = best
    figures = f"correlation with the frames {seen.correlation:.2f}, {seen.psnr:.1f} dB"
    notes = [f"The Gaussians were read in the world of {name} ({figures})."]
    if seen.correlation < _ROUGHLY:
        notes[0] += " They show the frames only roughly: the scene is crude, or its world or poses are a bit off."
    if not seen.explained:
        notes[0] = (
            f"{WARNING}The Gaussians of {path.name} do not look like the frames ({figures}). They are probably in "
            f"another world than the poses, and answers will be wrong. Give Gaussians in the world of the capture, or "
            f"put the dataparser_transforms.json of their training beside {path.name}."
        )
    return scene, (*notes, *_rounded_note(gaussians, path))


def _rounded_note(gaussians: Gaussians, path: Path) -> tuple[str, ...]:
    """Where a file's float32 has rounded the places of its Gaussians: nothing brings them back."""
    from jsecon.data.gaussians.ply import MAX_READ_ROUNDING

    if gaussians.means.dtype != np.float32:
        return ()
    steps = np.spacing(np.abs(gaussians.means).max(axis=1))
    if np.median(steps / np.exp(gaussians.log_scales.max(axis=1).astype(np.float64))) < 2 * MAX_READ_ROUNDING:
        return ()
    told = f"{path.name} holds positions in float32, which rounds them to {np.median(steps):.2g} units out there."
    return (f"{WARNING}{told} Export them in double precision, or nearer to the origin.",)


def _fitted(work: RunContext) -> Stage:
    options, minutes = work.options, work.options.minutes

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.fit.optimise import fit_gaussians
        from jsecon.fit.schedule import Schedule, default_max_gaussians
        from jsecon.fit.start import starting_gaussians

        capture, state = results["load"], record.read()
        start, notes = None, ()
        if state is None:
            start, whence = starting_gaussians(capture, sh_degree=options.sh_degree, progress=progress)
            check_overlap(start, capture.cameras[training_frames(capture)], str(options.capture))
            notes = (f"start of the fit: {whence}",)
        pixels = capture.cameras.width * capture.cameras.height
        most = options.gaussians_at_most or default_max_gaussians(pixels, steps=options.steps, minutes=minutes)
        found, losses = fit_gaussians(
            capture,
            key=jax.random.key(options.seed),
            steps=options.steps if minutes is None else None,
            seconds=None if minutes is None else 60 * minutes,
            start=start,
            state=state,
            schedule=Schedule(max_gaussians=most),
            on_checkpoint=lambda current: record.keep(lambda: current),
            progress=progress,
        )
        return StageResult(found, notes=(*notes, f"{found.count} Gaussians after {len(losses)} steps"))

    left = {"view-dependent colour": "SH degree 0"} if options.sh_degree == 0 else {}
    length = f"{options.steps} steps" if minutes is None else f"{minutes:g} minutes"
    most = options.gaussians_at_most
    number = "" if most is None else f", at most {most} Gaussians"
    how = f"fitted to the frames in {length}, SH degree {options.sh_degree}{number}"
    given = work.key_options("steps", "minutes", "sh_degree", "gaussians_at_most", "seed")
    return Stage("gaussians", how, compute, "fit", after=("load",), key_options=given, skipped=left)


def check_overlap(gaussians: Gaussians, cameras: Camera, where: str, *, least: float = 0.01) -> None:
    """Raises InputError where fewer than `least` of the Gaussians lie in the view of at least two cameras."""
    from jsecon.splat.project import project

    seen = jax.lax.map(lambda camera: project(gaussians, camera).visible, jax.tree.map(jnp.asarray, cameras))
    share = float(jnp.mean(seen.sum(0) >= 2)) if gaussians.count else 0.0
    if share < least:
        found = f"{share:.1%} of {gaussians.count} points in the view of two or more of the {len(seen)} frames"
        remedy = "Check that the poses belong to these frames, and the Gaussians to this capture."
        raise InputError(where, found, "views that overlap, and a scene in the world of their poses", remedy)


def held_out(work: RunContext) -> Stage:
    """PSNR and SSIM of the frames held out, against the photographs; and which of the others stay far below them."""

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.fit.quality import QUICK_LONG_SIDE, is_weak, measure_quality

        capture, scene = results["load"], results["gaussians"]
        train = np.flatnonzero(~np.asarray(capture.held_out))
        fitted = measure_quality(scene, capture, frames=train, long_side=QUICK_LONG_SIDE, progress=progress)
        low = np.flatnonzero(is_weak(np.asarray(fitted.psnr)))
        names = ", ".join(f"{capture.names[fitted.frames[n]]} ({fitted.psnr[n]:.1f} dB)" for n in low[:5])
        more = f" and {len(low) - 5} more" if len(low) > 5 else ""
        told = f"far below the median frame ({np.median(fitted.psnr):.1f} dB): {names}{more}; a wrong pose, or "
        told += "something moved (--drop-frames auto leaves them out)"
        return StageResult(measure_quality(scene, capture, progress=progress), notes=(told,) if len(low) else ())

    how = "PSNR and SSIM of the rendered colours"
    return Stage("held_out", how, compute, "fit", after=("load", "gaussians"), shared=True)
