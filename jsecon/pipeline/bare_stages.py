"""The stages of a scene that comes without photographs: its views are planned and rendered, its Gaussians are read."""

import dataclasses
from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline.options import Options
from jsecon.pipeline.results import RunContext, Stage, StageInput, StageResult
from jsecon.pipeline.scene_files import check_overlap, read_scene
from jsecon.read.captures.capture import read_posed_images
from jsecon.read.captures.coordinates import make_rigid, transform_poses
from jsecon.read.captures.frames import FrameOptions, frame_names
from jsecon.splat.transform import transform_gaussians_float64
from jsecon.types import Camera, Gaussians, Quality
from jsecon.views.capture import capture_from_cameras, render_capture
from jsecon.views.frame import scene_frame, surface_points

ORDINARY = (3.0, 30.0)
"""diagonal of a scene that keeps its units: a table to a flat, in metres"""
DIAGONAL = 6.0
"""diagonal that any other scene is brought to"""
FAR = 100.0
"""diagonals from the origin beyond which a scene is moved to it: float32 has few digits out there"""
OF_PHOTOGRAPHS = ("frames", "holdout", "refine", "drop_frames")
"""options that only photographs have a use for"""
OF_BARE_SCENES = ("views", "up", "cameras")
"""options that only a scene without photographs has a use for"""


def require_options_apply(options: Options, *, bare: bool) -> None:
    """Checks that no option is set that the input has no use for."""
    defaults = {field.name: field.default for field in dataclasses.fields(options)}
    for name in OF_PHOTOGRAPHS if bare else OF_BARE_SCENES:
        if getattr(options, name) != defaults[name]:
            kind = "a scene without photographs" if bare else "a capture, which has its own views"
            remedy = (
                "Leave it out; --views sets the number of views." if bare else "Leave it out; --frames sets the most."
            )
            raise InputError(f"--{name.replace('_', '-')}", f"{options.capture.name} is {kind}", remedy=remedy)
    if bare and options.gaussians is not None:
        problem = f"{options.capture.name} is a scene of Gaussians itself"
        raise InputError("--gaussians", problem, "", "Leave out --gaussians, or give the folder of the photographs.")


def bare_stages(context: RunContext) -> dict[str, Stage]:
    """Plans what a bare scene has in place of the stages of photographs."""
    path = context.options.capture
    skipped = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
    scene = Stage("gaussians", f"read from {path.name}", _read_scene, after=("load",), files=path, skipped=skipped)
    held_out = Stage("held_out", "no photograph to compare with", _quality_of_no_frame)
    return {"load": _planned_views(context), "gaussians": scene, "held_out": held_out}


def _planned_views(context: RunContext) -> Stage:
    """Plans the stage "load"."""
    options = context.options
    skipped = {"photographs": "the scene comes without any"}
    if options.cameras is not None:
        how = f"the scene rendered from the poses of {options.cameras.name}"
        poses = options.cameras
        key_options = context.key_options("long_side")
        skipped["planned views"] = f"the poses are given ({poses.name})"
        both = [poses, options.capture]
        return Stage("load", how, _render_poses, key_options=key_options, files=lambda: both, skipped=skipped)
    how = f"{options.views} virtual views, planned from the Gaussians of {options.capture.name}"
    key_options = context.key_options("views", "up", "long_side")
    return Stage("load", how, _render_views, key_options=key_options, files=options.capture, skipped=skipped)


def _render_views(stage: StageInput) -> StageResult:
    options = stage.context.options
    source, _ = read_scene(options.capture)
    source_from_scene = _world_of_scene(source)
    capture = render_capture(
        _into_world(source, source_from_scene),
        source_from_scene,
        views=options.views,
        width=options.long_side,
        height=options.long_side * 3 // 4,
        up=None if options.up is None else np.array(options.up, np.float64),
        progress=stage.progress,
    )
    return StageResult(capture, notes=capture.notes)


def _render_poses(stage: StageInput) -> StageResult:
    options = stage.context.options
    assert options.cameras is not None
    source, _ = read_scene(options.capture)
    source_from_scene = _world_of_scene(source)
    cameras, names = _load_poses(options.cameras, options.long_side)
    poses = transform_poses(np.asarray(cameras.world_to_camera), np.linalg.inv(source_from_scene)).astype(np.float32)
    cameras = dataclasses.replace(cameras, world_to_camera=poses)
    scene = _into_world(source, source_from_scene)
    check_overlap(scene, cameras, str(options.cameras))
    return StageResult(capture_from_cameras(scene, cameras, names, source_from_scene))


def _world_of_scene(gaussians: Gaussians) -> np.ndarray:
    """Returns the (4, 4) similarity to the world of a scene's file from one in which the scene has ordinary numbers."""
    frame = scene_frame(surface_points(gaussians))
    source_from_scene = np.eye(4)
    if not ORDINARY[0] <= frame.diagonal <= ORDINARY[1]:
        source_from_scene[:3, :3] *= frame.diagonal / DIAGONAL
    if np.linalg.norm(frame.centre) > FAR * frame.diagonal:
        source_from_scene[:3, 3] = frame.centre
    return source_from_scene


def _into_world(gaussians: Gaussians, source_from_scene: np.ndarray) -> Gaussians:
    """Moves Gaussians from the world of their file into that of the capture, in float32."""
    moved = transform_gaussians_float64(gaussians, np.linalg.inv(source_from_scene))
    return dataclasses.replace(moved, means=np.asarray(moved.means, np.float32))


def _load_poses(path: Path, long_side: int) -> tuple[Camera, tuple[str, ...]]:
    """Returns T cameras to render from, poses in float64 in the world of their file, and their names.

    `path` is a capture, whose images need not be there, such as the folder of a COLMAP model or a transforms.json. All
    cameras get the size of the first lens, shrunk to `long_side`, each with its field of view and without distortion.
    """
    images = read_posed_images(path).images
    lenses = [image.lens for image in images if image.lens is not None]
    if not images or len(lenses) < len(images):
        problem = "one of its frames has no size" if images else "it has no frame"
        raise InputError(path, problem, "at least one pose, each with w and h", "Estimate the poses again.")
    width, height = FrameOptions(long_side=long_side).size((lenses[0].width, lenses[0].height))
    sized = [lens.resized(width, height) for lens in lenses]

    def column(name):
        return np.array([getattr(lens, name) for lens in sized], np.float32)

    poses = np.stack([make_rigid(image.world_to_camera, path, image.name) for image in images])
    cameras = Camera(poses, column("fx"), column("fy"), column("cx"), column("cy"), width, height)
    return cameras, frame_names([image.name for image in images], path)


def _read_scene(stage: StageInput) -> StageResult:
    source, notes = read_scene(stage.context.options.capture)
    return StageResult(_into_world(source, np.asarray(stage.results.load.source_from_scene, np.float64)), notes=notes)


def _quality_of_no_frame(stage: StageInput) -> StageResult:
    return StageResult(Quality(np.zeros(0, int), np.zeros(0), np.zeros(0)))
