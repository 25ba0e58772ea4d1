"""The table of contents: what `jsecon` holds, and where each name lives."""

from jsecon.app.notebook import show as show, to_html as to_html, to_png as to_png
from jsecon.app.place import Place as Place, locate as locate
from jsecon.association.algorithm1 import masklets as masklets
from jsecon.backend import check_backend as check_backend
from jsecon.data.capture import load_capture as load_capture
from jsecon.data.gaussian_files import load_gaussians as load_gaussians, save_gaussians as save_gaussians
from jsecon.data.ply import load_ply as load_ply, save_ply as save_ply
from jsecon.errors import InputError as InputError
from jsecon.evaluate.metrics import (
    accuracy_at as accuracy_at,
    iou as iou,
    localization_accuracy as localization_accuracy,
    mean_iou as mean_iou,
)
from jsecon.language.autoencoder import Autoencoder as Autoencoder, train_autoencoder as train_autoencoder
from jsecon.language.blocks import (
    codes_in_blocks as codes_in_blocks,
    region_votes_in_blocks as region_votes_in_blocks,
)
from jsecon.language.distill import distill_l1 as distill_l1, distill_votes as distill_votes
from jsecon.language.field import check_field as check_field, load_field as load_field, save_field as save_field
from jsecon.language.regions import region_embeddings as region_embeddings
from jsecon.language.shares import (
    finish_votes as finish_votes,
    membership_probability as membership_probability,
    with_overlap as with_overlap,
    with_shown as with_shown,
)
from jsecon.language.votes import region_votes as region_votes
from jsecon.parallel import host_mesh as host_mesh
from jsecon.query.anchored import query_anchored as query_anchored, query_region as query_region
from jsecon.query.blocks import query_in_blocks as query_in_blocks
from jsecon.query.classes import query_classes as query_classes
from jsecon.query.direct import (
    query_canonical as query_canonical,
    query_one_step as query_one_step,
    unit_codes as unit_codes,
)
from jsecon.query.lift import lift as lift
from jsecon.query.masks import selection_mask as selection_mask
from jsecon.query.outliers import remove_outliers as remove_outliers
from jsecon.query.pixel import region_at as region_at
from jsecon.query.several import query_several as query_several
from jsecon.splat.capacity import plan_capacity as plan_capacity
from jsecon.splat.plan import plan_view as plan_view, render_plan as render_plan
from jsecon.splat.project import project as project
from jsecon.splat.render import render as render, render_depth as render_depth, render_rgb as render_rgb
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

__version__: str
__all__: list[str]
