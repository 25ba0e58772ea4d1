"""The table of stages: from a capture to what its language field is made of.

    stage      planned by             from
    poses      scene.plan_capture     photographs or a video without poses
    load       scene.plan_capture     the capture, or views of a scene without photographs
    gaussians  scene.plan_scene       load: fitted, or read from a file
    objects    objects.plan_objects   load, gaussians (--masks: load alone)
    regions    objects.plan_objects   load, objects
    parts      objects.plan_objects   load, gaussians, objects, with --parts
    votes      lifting.plan_lifting   load, gaussians, objects
    codes      lifting.plan_lifting   regions, votes, with --paper
    held_out   scene.plan_scene       load, gaussians, if there are photographs

Each plan states how the stage works, for what a run prints first; the stages that it reads (`after`); and the options,
models and files on which its result depends. The function that computes it stands beside the plan. `run` computes the
rows, or reads them from the cache. `jsecon fit` computes those of `scene.plan_scene`.
"""

from jsecon.pipeline.lifting import plan_lifting
from jsecon.pipeline.objects import plan_objects
from jsecon.pipeline.results import RunContext, Stage
from jsecon.pipeline.scene import plan_scene


def run_stages(context: RunContext) -> list[Stage]:
    """Plans the stages of a run. Mask files come before the long fit, so that their errors are found early."""
    by_name = {stage.name: stage for stage in [*plan_scene(context), *plan_objects(context), *plan_lifting(context)]}
    early = ("objects", "gaussians") if context.options.masks is not None else ("gaussians", "objects")
    order = ("poses", "load", *early, "regions", "parts", "votes", "codes", "held_out")
    return [by_name[name] for name in order if name in by_name]
