"""Gaussian Grouping-m: 16-d identity codes and a classifier of tracked ids; a text is looked up in the first frame.

After Ye et al. 2024 (lkeab/gaussian-grouping, train.py), with the geometry frozen as for all baselines here: theirs is
trained too. The text query needs the object in the first view, where theirs asks Grounding DINO and SAM and this asks
that frame's masks.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float
from scipy.spatial import KDTree

from experiments.baselines.descent import descend
from experiments.baselines.evidence import Evidence, view_plans, with_room
from jsecon.errors import InputError
from jsecon.paper.queries import _relevancies
from jsecon.splat.plan import plan_view, render_plan
from jsecon.splat.sh import C0
from jsecon.types import Array, Selection

STEPS = 30_000
SIZE = 16
CLASSES = 256
"""ids are 8-bit; 0 is no mask. Both losses are divided by this number's, whatever the classifier's size"""
IDENTITY_RATE, CLASSIFIER_RATE = 2.5e-3, 5e-4
KL_EVERY, KL_SAMPLES, KL_NEIGHBOURS, KL_WEIGHT = 5, 1000, 5, 2.0
OVERLAP = 0.7
"""an id is kept where this part of its region in the first view lies in the text's mask"""
PROBABILITY = 0.3
"""of the kept ids together, from which a Gaussian is selected (their removal_thresh)"""
RELEVANT, NEARLY = 0.5, 0.9
"""LERF relevancy below which no mask of the first view is the text's, and the share of the best mask's from which
others are too: theirs take all that the detector found together"""

_relevancies = jax.jit(_relevancies)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GaussianGrouping:
    """Identity codes and the linear classifier of C ids, 256 by default."""

    identity: Array
    """(N, 16)."""
    kernel: Array
    """(16, C)."""
    bias: Array
    """(C,)."""

    def probabilities(self, identity: Float[Array, "*batch 16"]) -> Float[Array, "*batch classes"]:
        """Softmax over the ids of codes, a Gaussian's or a rendered pixel's; id 0 = no mask, id k = track k - 1."""
        return _probabilities(identity, self.kernel, self.bias)


@jax.jit
def _probabilities(identity: Array, kernel: Array, bias: Array) -> Array:
    return jax.nn.softmax(identity @ kernel + bias)


def train_gaussian_grouping(
    evidence: Evidence,
    *,
    key: Array,
    steps: int = STEPS,
    identity_rate: float = IDENTITY_RATE,
    classifier_rate: float = CLASSIFIER_RATE,
    classes: int = CLASSES,
) -> tuple[GaussianGrouping, Array]:
    """Cross entropy of the rendered codes' classes over all pixels, divided by log 256, and at every fifth step the 3D
    loss: the KL divergence between 1,000 Gaussians' classes and those of their five nearest (themselves included).

    A schedule of hundreds of steps wants larger rates than the paper's. `classes`: the classifier's outputs; those that
    no track has only take time. Returns the model and the loss before each step. Raises InputError for more than
    classes - 1 tracks.
    """
    most = int(np.asarray(evidence.tracks).max(initial=-1)) + 1
    if most >= classes:
        raise InputError("tracks", f"{most} ids", f"at most {classes - 1}", "Leave small regions out.")
    plans, count = view_plans(evidence), evidence.gaussians.count
    rows = plans.splats.shape[1]
    init_key, kernel_key, bias_key, key = jax.random.split(key, 4)
    bound = 1 / math.sqrt(SIZE)
    params = {
        "identity": (jax.random.uniform(init_key, (rows, SIZE)) - 0.5) / C0,
        "kernel": jax.random.uniform(kernel_key, (SIZE, classes), minval=-bound, maxval=bound),
        "bias": jax.random.uniform(bias_key, (classes,), minval=-bound, maxval=bound),
    }
    means = np.asarray(evidence.gaussians.means, np.float64)
    nearest = KDTree(means).query(means, k=min(KL_NEIGHBOURS, count))[1].reshape(count, -1).astype(np.int32)
    nearest = np.pad(nearest, ((0, rows - count), (0, 0)))
    data = plans, jnp.asarray(evidence.tracks) + 1, jnp.asarray(nearest), jnp.asarray(count)
    optimizer, views = _optimizer(identity_rate, classifier_rate), len(evidence.masks)
    params, history = descend(_loss, params, data, views=views, steps=steps, optimizer=optimizer, key=key)
    return GaussianGrouping(**params | {"identity": params["identity"][:count]}), history


@functools.cache
def _optimizer(identity: float, classifier: float) -> optax.GradientTransformation:
    rates: dict[Any, Any] = {"identity": optax.adam(identity, eps=1e-15), "classifier": optax.adam(classifier)}
    return optax.multi_transform(rates, {"identity": "identity", "kernel": "classifier", "bias": "classifier"})


def _loss(params: Any, data: Any, view: Array, step: Array, key: Array) -> Array:
    plans, ids, nearest, count = data
    rendered = render_plan(jax.tree.map(lambda a: a[view], plans), params["identity"]).features
    logits = rendered @ params["kernel"] + params["bias"]
    entropy = optax.softmax_cross_entropy_with_integer_labels(logits, ids[view]).mean() / math.log(CLASSES)

    def spatial(params):
        chosen = jax.random.randint(key, (KL_SAMPLES,), 0, count)

        def logs(rows):
            return jax.nn.log_softmax(params["identity"][rows] @ params["kernel"] + params["bias"])

        own, others = logs(chosen), logs(nearest[chosen])
        divergence = jnp.sum(jnp.exp(own)[:, None] * (own[:, None] - others), axis=-1)
        return KL_WEIGHT * divergence.mean() / CLASSES

    return entropy + jax.lax.cond(step % KL_EVERY == 0, spatial, lambda _: jnp.zeros(()), params)


def query_gaussian_grouping(
    model: GaussianGrouping,
    evidence: Evidence,
    text: Float[Array, " e"],
    canonical: Float[Array, "c e"],
    *,
    nearly: float = NEARLY,
    similarity: Float[np.ndarray, " k"] | None = None,
) -> Selection:
    """The Gaussians of the ids that lie in the first view's masks of the text.

    The masks: those of the first frame whose relevancy to the text is at least 0.5, and `nearly` times the most
    relevant one's: a class may have several things, and 1 takes one of them. Without any nothing is selected, which is
    what becomes of everything that the first view does not show. Ids: those with more than 0.7 of their region there
    inside the masks. Gaussians: the kept ids' probability together above 0.3. Selection.region is the row in the
    evidence of the most relevant mask, score its relevancy. `similarity` (K,) of the first view's masks with the text,
    where given, takes the relevancy's place, and then none is too little.
    """
    here = np.flatnonzero(np.asarray(evidence.frame) == 0)
    nothing = jnp.zeros(evidence.gaussians.count)
    if not len(here):
        return Selection(nothing > 0, nothing, jnp.asarray(-1, jnp.int32), jnp.zeros(()))
    if similarity is None:
        least, first_view = RELEVANT, jnp.asarray(evidence.embeddings)[here]
        relevancy, _ = _relevancies(first_view, jnp.asarray(text), jnp.asarray(canonical))
    else:
        least, relevancy = -np.inf, jnp.asarray(similarity)
    best = int(jnp.argmax(relevancy))
    if not relevancy[best] >= least:
        return Selection(nothing > 0, nothing, jnp.asarray(-1, jnp.int32), relevancy[best])
    plan = plan_view(with_room(evidence.gaussians), jax.tree.map(jnp.asarray, evidence.cameras)[0])
    identity = jnp.pad(model.identity, ((0, len(plan.splats) - len(model.identity)), (0, 0)))
    predicted = np.asarray(model.probabilities(render_plan(plan, identity).features)).argmax(-1)
    meant = np.asarray(relevancy) >= max(least, nearly * float(relevancy[best]))
    mask = np.isin(np.asarray(evidence.masks[0]), here[meant])
    classes = len(model.bias)
    sizes, inside = (np.bincount(ids.reshape(-1), minlength=classes) for ids in (predicted, predicted[mask]))
    kept = (sizes > 0) & (inside > OVERLAP * sizes)
    kept[0] = False
    probability = (model.probabilities(model.identity) * kept).sum(-1)
    return Selection(probability > PROBABILITY, probability, jnp.asarray(here[best], jnp.int32), relevancy[best])
