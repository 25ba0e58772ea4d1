"""The stages of a scene that comes without photographs: its views are planned and rendered, its Gaussians are read."""

from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline.progress import Progress
from jsecon.pipeline.stages import Checkpoint, Results, RunContext, Stage, StageResult

SPLATS = (".ply", ".spz", ".sog", ".splat", ".glb")
"""endings of files that are scenes of Gaussians"""


def is_bare_scene(capture: Path) -> bool:
    """Whether the input of a run is a file of Gaussians instead of a capture."""
    return capture.suffix.lower() in SPLATS and not capture.is_dir()


def planned_views(work: RunContext) -> Stage:
    """Stage "load" of a bare scene: virtual views are planned from its Gaussians, and rendered as its frames."""
    options = work.options
    if options.gaussians is not None:
        problem = f"{options.capture.name} is a scene of Gaussians itself"
        raise InputError("--gaussians", problem, "", "Leave out --gaussians, or give the folder of the photographs.")

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.pipeline.scene_stages import given_gaussians
        from jsecon.views.capture import into_world, render_capture, world_of_scene

        source, _ = given_gaussians(options.capture)
        to_source = world_of_scene(source)
        capture, _ = render_capture(
            into_world(source, to_source),
            to_source,
            views=options.views,
            width=options.long_side,
            height=options.long_side * 3 // 4,
            up=None if options.up is None else np.array(options.up, np.float64),
            progress=progress,
        )
        return StageResult(capture, notes=capture.notes)

    how = f"{options.views} virtual views, planned from the Gaussians of {options.capture.name}"
    skipped = {"photographs": "the scene comes without any"}
    given = work.key_options("views", "up", "long_side")
    return Stage("load", how, compute, "views", key_options=given, files=options.capture, skipped=skipped)


def scene_itself(work: RunContext) -> Stage:
    """Stage "gaussians" of a bare scene: those of its file, in the world of the planned views."""
    path = work.options.capture

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.pipeline.scene_stages import given_gaussians
        from jsecon.views.capture import into_world

        source, notes = given_gaussians(path)
        return StageResult(into_world(source, np.asarray(results["load"].to_source, np.float64)), notes=notes)

    skipped = {"photometric fit": f"the scene's Gaussians are given ({path.name})"}
    how = f"read from {path.name}"
    return Stage("gaussians", how, compute, "fit", after=("load",), files=path, skipped=skipped)
