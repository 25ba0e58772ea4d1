"""Find things in 3D Gaussian scenes by text, at the level of points, in functional JAX on a plain CPU.

This file is the table of contents. A name is imported when it is first used, so `import jsecon` costs nothing and jax
starts only when something needs it.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jsecon.backend import check_backend as check_backend
    from jsecon.data.capture import load_capture as load_capture
    from jsecon.data.ply import load_ply as load_ply, save_ply as save_ply
    from jsecon.errors import InputError as InputError
    from jsecon.evaluate.metrics import (
        accuracy_at as accuracy_at,
        iou as iou,
        localization_accuracy as localization_accuracy,
        mean_iou as mean_iou,
    )
    from jsecon.language.autoencoder import Autoencoder as Autoencoder, train_autoencoder as train_autoencoder
    from jsecon.language.distill import distill_l1 as distill_l1, distill_votes as distill_votes
    from jsecon.language.field import load_field as load_field, save_field as save_field
    from jsecon.language.masklets import masklets as masklets
    from jsecon.language.regions import region_embeddings as region_embeddings
    from jsecon.language.solve_l1 import solve_l1 as solve_l1
    from jsecon.language.votes import region_votes as region_votes
    from jsecon.parallel import host_mesh as host_mesh
    from jsecon.query.anchored import (
        query_anchored as query_anchored,
        query_region as query_region,
        region_at as region_at,
    )
    from jsecon.query.canonical import query_canonical as query_canonical
    from jsecon.query.classes import query_classes as query_classes
    from jsecon.query.masks import selection_mask as selection_mask
    from jsecon.query.one_step import query_one_step as query_one_step
    from jsecon.query.outliers import remove_outliers as remove_outliers
    from jsecon.query.pieces import with_overlap as with_overlap
    from jsecon.query.probability import membership_probability as membership_probability
    from jsecon.query.several import query_several as query_several
    from jsecon.query.showing import with_shown as with_shown
    from jsecon.query.units import unit_codes as unit_codes
    from jsecon.splat.plan import plan_view as plan_view, render_plan as render_plan
    from jsecon.splat.project import project as project
    from jsecon.splat.render import render as render, render_depth as render_depth, render_rgb as render_rgb
    from jsecon.splat.tiles import plan_capacity as plan_capacity
    from jsecon.types import (
        Camera as Camera,
        Capture as Capture,
        Gaussians as Gaussians,
        LanguageField as LanguageField,
        Regions as Regions,
        Rendering as Rendering,
        Selection as Selection,
        Votes as Votes,
    )

__version__ = "0.1.0"

_CONTENTS = {
    "jsecon.backend": ("check_backend",),
    "jsecon.data.capture": ("load_capture",),
    "jsecon.data.ply": ("load_ply", "save_ply"),
    "jsecon.errors": ("InputError",),
    "jsecon.evaluate.metrics": ("accuracy_at", "iou", "localization_accuracy", "mean_iou"),
    "jsecon.language.autoencoder": ("Autoencoder", "train_autoencoder"),
    "jsecon.language.distill": ("distill_l1", "distill_votes"),
    "jsecon.language.field": ("load_field", "save_field"),
    "jsecon.language.masklets": ("masklets",),
    "jsecon.language.regions": ("region_embeddings",),
    "jsecon.language.solve_l1": ("solve_l1",),
    "jsecon.language.votes": ("region_votes",),
    "jsecon.parallel": ("host_mesh",),
    "jsecon.query.anchored": ("query_anchored", "query_region", "region_at"),
    "jsecon.query.canonical": ("query_canonical",),
    "jsecon.query.classes": ("query_classes",),
    "jsecon.query.masks": ("selection_mask",),
    "jsecon.query.one_step": ("query_one_step",),
    "jsecon.query.outliers": ("remove_outliers",),
    "jsecon.query.probability": ("membership_probability",),
    "jsecon.query.several": ("query_several",),
    "jsecon.query.pieces": ("with_overlap",),
    "jsecon.query.showing": ("with_shown",),
    "jsecon.query.units": ("unit_codes",),
    "jsecon.splat.plan": ("plan_view", "render_plan"),
    "jsecon.splat.project": ("project",),
    "jsecon.splat.render": ("render", "render_depth", "render_rgb"),
    "jsecon.splat.tiles": ("plan_capacity",),
    "jsecon.types": ("Camera", "Capture", "Gaussians", "LanguageField", "Regions", "Rendering", "Selection", "Votes"),
}
_HOME = {name: module for module, names in _CONTENTS.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'jsecon' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
