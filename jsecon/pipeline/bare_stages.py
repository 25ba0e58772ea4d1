"""The stages of a scene that comes without photographs: its views are planned and rendered, its Gaussians are read."""

import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline.results import RunContext, Stage, StageInput, StageResult
from jsecon.pipeline.scene_files import read_scene
from jsecon.views.capture import into_world, render_capture, world_of_scene


def planned_views(context: RunContext) -> Stage:
    """Plans the stage "load" of a bare scene: virtual views planned from its Gaussians, and rendered as its frames.

    Raises:
      InputError: The options name another file of Gaussians.
    """
    options = context.options
    if options.gaussians is not None:
        problem = f"{options.capture.name} is a scene of Gaussians itself"
        raise InputError("--gaussians", problem, "", "Leave out --gaussians, or give the folder of the photographs.")
    how = f"{options.views} virtual views, planned from the Gaussians of {options.capture.name}"
    skipped = {"photographs": "the scene comes without any"}
    key_options = context.key_options("views", "up", "long_side")
    return Stage("load", how, _render_views, key_options=key_options, files=options.capture, skipped=skipped)


def _render_views(stage: StageInput) -> StageResult:
    options = stage.context.options
    source, _ = read_scene(options.capture)
    to_source = world_of_scene(source)
    capture, _ = render_capture(
        into_world(source, to_source),
        to_source,
        views=options.views,
        width=options.long_side,
        height=options.long_side * 3 // 4,
        up=None if options.up is None else np.array(options.up, np.float64),
        progress=stage.progress,
    )
    return StageResult(capture, notes=capture.notes)


def scene_itself(context: RunContext) -> Stage:
    """Plans the stage "gaussians" of a bare scene: those of its file, in the world of the planned views."""
    path = context.options.capture
    skipped = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
    return Stage("gaussians", f"read from {path.name}", _read_scene, after=("load",), files=path, skipped=skipped)


def _read_scene(stage: StageInput) -> StageResult:
    source, notes = read_scene(stage.context.options.capture)
    return StageResult(into_world(source, np.asarray(stage.results.load.to_source, np.float64)), notes=notes)
