"""The table of stages: from a capture to what its language field is made of.

    stage      planned by             from
    poses      scene.plan_capture     photographs or a video without poses
    load       scene.plan_capture     the capture, or views of a scene without photographs
    gaussians  scene.plan_gaussians   load: fitted, or read from a file
    objects    objects.plan_objects   load, gaussians (--masks: load alone)
    regions    objects.plan_regions   load, objects
    parts      objects.plan_parts     load, gaussians, objects, with --parts
    votes      lifting.plan_votes     load, gaussians, objects
    codes      lifting.plan_codes     regions, votes, with --paper
    held_out   scene.plan_held_out    load, gaussians

Each plan states how the stage works, for what a run prints first; the stages that it reads (`after`); and the options,
models and files on which its result depends. The function that computes it stands beside the plan. `run` computes the
rows, or reads them from the cache.
"""

from jsecon.pipeline.lifting import plan_codes, plan_votes
from jsecon.pipeline.objects import plan_objects, plan_parts, plan_regions
from jsecon.pipeline.results import RunContext, Stage
from jsecon.pipeline.scene import plan_capture, plan_gaussians, plan_held_out


def run_stages(context: RunContext) -> list[Stage]:
    """Plans the stages of a run. Mask files come before the long fit, so that their errors are found early."""
    options = context.options
    first = [plan_gaussians(context), plan_objects(context)]
    if options.masks is not None:
        first.reverse()
    parts = [plan_parts(context)] if options.parts else []
    codes = [plan_codes(context)] if options.paper else []
    last = [plan_regions(context), *parts, plan_votes(context), *codes, plan_held_out(context)]
    return [*plan_capture(context), *first, *last]


def fit_stages(context: RunContext) -> list[Stage]:
    """Plans the stages that make and measure the scene."""
    return [*plan_capture(context), plan_gaussians(context), plan_held_out(context)]
