"""Two ways to say which Gaussians belong to a region that were measured and not kept: by the votes of all views, and by
the lead over the strongest other region. The library's is the share in the views that show the region
(jsecon.language.membership)."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jsecon.language.regions import ALIKE_THRESHOLD
from jsecon.query.match import is_alike
from jsecon.types import LanguageField, Selection

LEAD_THRESHOLD = 0.5
"""the region is the strongest, and most of what is seen of the Gaussian has a label"""


def of_all_views(field: LanguageField) -> LanguageField:
    """The field with votes that do not know which views show a region: every view that sees a Gaussian counts."""
    return dataclasses.replace(field, votes=dataclasses.replace(field.votes, shown=None))


def by_lead(
    field: LanguageField,
    found: Selection,
    *,
    threshold: float | None = None,
    alike_threshold: float | None = ALIKE_THRESHOLD,
) -> Selection:
    """What `found` selects if membership is by the lead, at least `threshold` (default LEAD_THRESHOLD):

        min(w / (w + v), labelled / total)

    with w the votes of its region and of those alike (`alike_threshold`; None: of it alone), v those of the strongest
    other region. Where masks are cut, merged and lost, a region may be the strongest without most of the votes.
    """
    votes, region = field.votes, max(int(found.region), 0)
    chosen = np.arange(votes.num_regions) == region
    if alike_threshold is not None:
        chosen |= np.asarray(is_alike(jnp.asarray(field.regions.embeddings), jnp.asarray(region), alike_threshold))
    ids, weights = np.asarray(votes.regions), np.asarray(votes.weights)
    inside = chosen[np.maximum(ids, 0)]
    own = np.where((ids >= 0) & inside, weights, 0).sum(1)
    rival = np.where((ids >= 0) & ~inside, weights, 0).max(1, initial=0)
    labelled, total = np.asarray(votes.labelled), np.asarray(votes.total)
    known = (np.asarray(votes.views) > 0) & (total > 0) & (int(found.region) >= 0)
    lead = own / np.where(own + rival > 0, own + rival, 1)
    similarity = np.where(known, np.minimum(lead, labelled / np.where(known, total, 1)), 0).astype(np.float32)
    mask = known & (similarity >= (LEAD_THRESHOLD if threshold is None else threshold))
    return dataclasses.replace(found, mask=jnp.asarray(mask), similarity=jnp.asarray(similarity))
