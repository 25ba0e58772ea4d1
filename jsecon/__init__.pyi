"""Public names of `jsecon`, and the module of each."""

from .app.catalogue import Catalogue as Catalogue, objects as objects
from .app.records import (
    Answer as Answer,
    At as At,
    Box as Box,
    Mask as Mask,
    Object as Object,
    Query as Query,
    Region as Region,
)
from .app.scene import Scene as Scene, locate as locate, open_scene as open_scene
from .backend import check_backend as check_backend
from .errors import InputError as InputError
from .evaluate.metrics import (
    accuracy_at as accuracy_at,
    iou as iou,
    localization_accuracy as localization_accuracy,
    mean_iou as mean_iou,
)
from .field.evidence import region_votes as region_votes
from .field.field import check_field as check_field, load_field as load_field, save_field as save_field
from .field.membership import (
    membership_probability as membership_probability,
    normalise_votes as normalise_votes,
)
from .field.regions import region_embeddings as region_embeddings
from .paper.algorithm1 import masklets as masklets
from .paper.autoencoder import encode as encode, train_autoencoder as train_autoencoder
from .paper.distill import distill_l1 as distill_l1, distill_votes as distill_votes
from .paper.queries import query_canonical as query_canonical, query_one_step as query_one_step
from .parallel import host_mesh as host_mesh
from .query.answer import (
    match_regions as match_regions,
    query_anchored as query_anchored,
    query_region as query_region,
    query_several as query_several,
    select_gaussians as select_gaussians,
)
from .query.classes import query_classes as query_classes
from .query.match import RegionMatch as RegionMatch
from .query.object_shapes import ObjectShapes as ObjectShapes, object_shapes as object_shapes
from .query.outliers import remove_outliers as remove_outliers
from .query.pointing import lift as lift, region_at as region_at
from .query.rules import QueryRules as QueryRules
from .query.selection_masks import selection_mask as selection_mask
from .read.captures.capture import load_capture as load_capture
from .read.splats.formats import load_gaussians as load_gaussians
from .read.splats.writing import save_gaussians as save_gaussians
from .splat.capacity import plan_capacity as plan_capacity
from .splat.plan import plan_view as plan_view, render_plan as render_plan
from .splat.project import project as project
from .splat.render import render as render, render_depth as render_depth, render_rgb as render_rgb
from .types import (
    Autoencoder as Autoencoder,
    Camera as Camera,
    Capture as Capture,
    Codes as Codes,
    Gaussians as Gaussians,
    LanguageField as LanguageField,
    Regions as Regions,
    Rendering as Rendering,
    Selection as Selection,
    Votes as Votes,
)

__version__: str
__all__: list[str]
