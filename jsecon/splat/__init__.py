"""Splatting: project, list tiles, composite front to back, and the readable float64 twin that defines the image."""

from jsecon.splat.capacity import plan_capacity
from jsecon.splat.plan import ViewPlan, plan_view, render_plan
from jsecon.splat.project import Projection, project
from jsecon.splat.render import render, render_depth, render_rgb
from jsecon.splat.sh import colours_from_sh

__all__ = [
    "Projection",
    "ViewPlan",
    "colours_from_sh",
    "plan_capacity",
    "plan_view",
    "project",
    "render",
    "render_depth",
    "render_plan",
    "render_rgb",
]
