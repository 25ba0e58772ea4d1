"""OpenGaussian: 6-d instance features, a codebook of two levels, and the masks' embeddings tied to its leaves.

After Wu et al. 2024 (yanmin-wu/OpenGaussian, train.py): (1) features whose renderings are alike within a mask and apart
between masks; (2) coarse clusters of features and positions, then fine ones of features within each, both trained
straight through; (3) each leaf takes the embeddings of the masks that its silhouette fits. A query is
`experiments.protocols.opengaussian.select_leaf`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int

from experiments.baselines.descent import descend
from experiments.baselines.evidence import Evidence, local_masks, only, view_plans
from experiments.baselines.leaves import assign_to_centres, cluster_means, split_roots, view_overlaps
from jsecon.numerics import normalize, safe_norm
from jsecon.splat.plan import ViewPlan, render_plan
from jsecon.types import Array

SIZE = 6
INTRA_WEIGHT = 0.1
SILHOUETTE = 0.7
REFRESH_COARSE, REFRESH_FINE = 200, 50
"""steps between two assignments of the Gaussians to centres"""
MATCH_SILHOUETTE, MATCH_SCORE = 0.8, 0.2
MOST_VARIANCE, LARGE = 0.006, 0.8
"""a mask whose features vary more is no pseudo label, unless it is this large a part of the view's largest"""
_ADAM = optax.scale_by_adam(eps=1e-15)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OpenGaussian:
    """A trained model."""

    features: Array
    """(N, 6) instance features, unit."""
    leaf_of: Array
    """(N,) int32 leaf of each Gaussian: root * k2 + fine cluster."""
    leaf_codes: Array
    """(k1 k2, 6) the codebook's leaves."""
    leaf_features: Array
    """(k1 k2, E) language features; zero where fewer than `min_views` views matched."""
    matches: Array
    """(k1 k2,) int32 views in which the leaf matched a mask."""
    siblings: int = dataclasses.field(metadata={"static": True})
    """k2."""


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Steps and sizes; the defaults are those for LERF."""

    instance_steps: int = 10_000
    coarse_steps: int = 10_000
    fine_steps: int = 20_000
    roots: int = 64
    """k1."""
    leaves: int = 10
    """k2, of each root."""
    position_weight: float = 0.5
    min_views: int = 5
    """views that a leaf must match a mask in, or it has no language feature."""
    rate: float = 1e-3
    """Adam's; larger for a shorter schedule."""
    coarse_rate: float = 1e-4


@dataclasses.dataclass(frozen=True)
class Instances:
    """What the first stage leaves to the others: codebooks of different sizes may share it."""

    features: Array
    """(M, 6): of the N Gaussians, and of those that make room behind them (`evidence.with_room`)."""
    history: Array
    """(steps,) the loss before each step."""
    data: Any
    """the plans of all views, and the masks (T, H, W) counted from 0 in each."""
    names: Int[np.ndarray, "t k"]
    """rows of the evidence that the counts stand for, -1 = none."""
    labels: tuple[Array, Array]
    """the masks' pseudo labels (T, K, 6), and (T, K) whether each is one."""


def train_instances(evidence: Evidence, *, key: Array, schedule: Schedule = Schedule()) -> Instances:
    """The first stage: features whose renderings are alike within a mask and apart between masks."""
    init_key, first_key, *_ = jax.random.split(key, 5)
    local, names = local_masks(evidence)
    plans, (views, slots) = view_plans(evidence), names.shape
    data = plans, jnp.asarray(local)
    start = jax.random.uniform(init_key, (plans.splats.shape[1], SIZE))
    loss = _instance_loss_of(slots, schedule.instance_steps // 2)
    given: Any = {"views": views, "steps": schedule.instance_steps, "scale": -schedule.rate, "key": first_key}
    features, history = descend(loss, start, data, optimizer=_ADAM, **given)
    return Instances(features, history, data, names, _pseudo_labels(features, data, slots))


def train_opengaussian(
    evidence: Evidence, *, key: Array, schedule: Schedule = Schedule(), instances: Instances | None = None
) -> tuple[OpenGaussian, Array]:
    """Trains the three stages; returns the model and the loss of the first before each step. `instances`: the first
    stage of the same evidence, key and schedule, where it is there already."""
    first = train_instances(evidence, key=key, schedule=schedule) if instances is None else instances
    *_, centre_key, coarse_key, fine_key = jax.random.split(key, 5)
    data, labels, names = first.data, first.labels, first.names
    means = jnp.asarray(evidence.gaussians.means)
    scaled = (means - means.min(0)) / jnp.maximum(jnp.ptp(means), 1e-9)
    features, root_of = _coarse(first.features, scaled, data, labels, schedule, centre_key, coarse_key)
    features, leaf_of, codes = _fine(features, root_of, data, labels, schedule, fine_key)
    leaf_features, matches = _associate(leaf_of, codes, data, labels, names, np.asarray(evidence.embeddings))
    leaf_features = jnp.where((matches >= schedule.min_views)[:, None], leaf_features, 0.0)
    units = normalize(features[: len(means)])
    return OpenGaussian(units, leaf_of, codes, leaf_features, matches, schedule.leaves), first.history


def _draw(plan: ViewPlan, features: Array) -> tuple[Array, Array]:
    """(H W, 6) rendered (f + 1) / 2 of unit features, and (H W,) alpha."""
    rendered = render_plan(plan, (normalize(features) + 1) / 2)
    return rendered.features.reshape(-1, SIZE), rendered.alpha.reshape(-1)


def _mask_means(image: Array, ids: Array, slots: int) -> tuple[Array, Array]:
    """(K, 6) mean of the pixels (P, 6) of each mask, and (K,) their number; ids (P,), -1 = none."""
    place = jnp.where(ids >= 0, ids, slots)
    pixels = jax.ops.segment_sum(jnp.ones(place.shape), place, slots + 1)[:slots]
    return jax.ops.segment_sum(image, place, slots + 1)[:slots] / jnp.maximum(pixels, 1)[:, None], pixels


def _instance_loss(
    features: Array, data: Any, view: Array, step: Array, key: Array, *, slots: int, halfway: int
) -> Array:
    del key
    plans, local = data
    image, alpha = _draw(jax.tree.map(lambda a: a[view], plans), features)
    ids = jnp.where(alpha > SILHOUETTE, local[view].reshape(-1), -1)
    means, pixels = _mask_means(image, ids, slots)
    there = pixels > 0
    number = jnp.maximum(there.sum(), 1)
    spread = safe_norm(image - means[jnp.maximum(ids, 0)])
    per_mask, _ = _mask_means(spread[:, None] * jnp.ones(SIZE), ids, slots)
    intra = jnp.sum(jnp.where(there, per_mask[:, 0], 0.0)) / number
    pairs = there[:, None] & there[None] & ~jnp.eye(slots, dtype=bool)
    closeness = 1 / (jnp.sum((means[:, None] - means[None]) ** 2, axis=-1) + 1)
    # Near pairs count most: weights rise by rank from 0.1 to 1; later only the nearest tenth keeps its own.
    ranked = jnp.argsort(jnp.argsort(jnp.where(pairs, jax.lax.stop_gradient(closeness), -1.0), axis=1), axis=1)
    rank = ranked - (slots - pairs.sum(1, keepdims=True))
    weight = 0.1 + 0.9 * rank / jnp.maximum(pairs.sum(1, keepdims=True) - 1, 1)
    weight = jnp.where((step >= halfway) & (weight < 0.9), 0.1, weight)
    inter = jnp.sum(jnp.where(pairs, weight * closeness, 0.0)) / jnp.maximum(number * (number - 1), 1)
    return INTRA_WEIGHT * intra + inter


@functools.cache
def _instance_loss_of(slots: int, halfway: int) -> Callable:
    """One function object for each pair of options: `descend` compiles once for each."""
    return functools.partial(_instance_loss, slots=slots, halfway=halfway)


@functools.partial(jax.jit, static_argnums=2)
def _pseudo_labels(features: Array, data: Any, slots: int) -> tuple[Array, Array]:
    """(T, K, 6) the masks' mean features, and (T, K) whether each is a label: there, and even or large."""
    plans, local = data

    def one(view):
        plan, ids = view
        image, alpha = _draw(plan, features)
        ids = jnp.where(alpha > SILHOUETTE, ids.reshape(-1), -1)
        means, pixels = _mask_means(image, ids, slots)
        variance, _ = _mask_means((image - means[jnp.maximum(ids, 0)]) ** 2, ids, slots)
        even = variance.mean(1) <= MOST_VARIANCE
        return means, (pixels > 0) & (even | (pixels > LARGE * pixels.max()))

    return jax.lax.map(one, (plans, local))


def _through(features: Array, of: Array, count: int) -> Array:
    """Each Gaussian's cluster mean forward, its own feature backward."""
    units = normalize(features)
    means = cluster_means(units, jnp.where(of >= 0, of, count), jnp.zeros((count, SIZE)))
    return units + jax.lax.stop_gradient(means[jnp.maximum(of, 0)] - units)


def _quantised_loss(features: Array, data: Any, view: Array, step: Array, key: Array, *, clusters: int) -> Array:
    """Rendered cluster means against the pseudo labels: L1 over the labelled silhouette, or, where `fine`, L2 of one
    root alone. One program for both stages."""
    del step
    plans, local, (means, valid), of, root_of, count, fine = data
    # A root drawn by its Gaussians: each takes its turn as often as it is large.
    root = root_of[jax.random.randint(key, (), 0, count)]
    plan = only(jax.tree.map(lambda a: a[view], plans), ~fine | (root_of == root))
    image, alpha = _draw(plan, _through(features, of, clusters))
    ids = local[view].reshape(-1)
    target = means[view][jnp.maximum(ids, 0)]
    counts = (ids >= 0) & valid[view][jnp.maximum(ids, 0)] & (alpha > SILHOUETTE)
    error = jnp.where(fine, jnp.square(image - target), jnp.abs(image - target))
    return jnp.sum(jnp.where(counts[:, None], error, 0.0)) / (SIZE * jnp.maximum(counts.sum(), 1))


@functools.cache
def _quantised_loss_of(clusters: int) -> Callable:
    return functools.partial(_quantised_loss, clusters=clusters)


def _coarse(features, scaled, data, labels, schedule: Schedule, centre_key, key) -> tuple[Array, Array]:
    """Features trained through their roots' means, and the root of each Gaussian."""
    roots = min(schedule.roots, count := len(scaled))

    def points(f):
        return jnp.concatenate([normalize(f[:count]), schedule.position_weight * scaled], axis=1)

    centres = points(features)[jax.random.choice(centre_key, count, (roots,), replace=False)]

    def assign(features):
        nonlocal centres
        of, centres = assign_to_centres(points(features), centres)
        return of

    loss = _quantised_loss_of(roots * schedule.leaves)  # as many as the fine stage has; no Gaussian is of the others
    room = _room(features, count)

    def given(of):
        return (*data, labels, room(of), room(of), jnp.asarray(count), jnp.asarray(False))

    steps, rate = schedule.coarse_steps, schedule.coarse_rate
    return _clustered(loss, features, assign, given, steps=steps, refresh=REFRESH_COARSE, rate=rate, key=key)


def _fine(features, root_of, data, labels, schedule: Schedule, key) -> tuple[Array, Array, Array]:
    """Features, leaves and the leaves' codes; a root has one leaf more than the most masks that it meets in a view."""
    count = len(root_of)
    roots, leaves, room = min(schedule.roots, count), schedule.leaves, _room(features, count)
    number = _leaves_wanted(room(root_of), data, labels, roots, leaves)

    def split(f):
        return split_roots(normalize(f[:count]), root_of, number, leaves)

    loss = _quantised_loss_of(roots * leaves)

    def given(of):
        return (*data, labels, room(of), room(root_of), jnp.asarray(count), jnp.asarray(True))

    steps, rate = schedule.fine_steps, schedule.rate
    features, of = _clustered(loss, features, split, given, steps=steps, refresh=REFRESH_FINE, rate=rate, key=key)
    return features, of, cluster_means(normalize(features[:count]), of, jnp.zeros((roots * leaves, SIZE)))


def _room(features: Array, count: int) -> Callable[[Array], Array]:
    """Clusters of `count` Gaussians -> of all rows of `features`, -1 = none."""
    return lambda of: jnp.asarray(np.pad(of, (0, len(features) - count), constant_values=-1))


def _clustered(
    loss: Callable, features: Array, assign: Callable, given: Callable, *, steps: int, refresh: int, rate: float, key
) -> tuple[Array, Array]:
    """Features trained on `given(of)`, and the cluster `of` each Gaussian, assigned anew every `refresh` steps."""
    of = assign(features)
    for start in range(0, steps, refresh):
        data = given(of)
        how: Any = {"views": len(data[1]), "steps": min(refresh, steps - start), "scale": -rate}
        features, _ = descend(loss, features, data, optimizer=_ADAM, key=jax.random.fold_in(key, start), **how)
        of = assign(features)
    return features, of


def _leaves_wanted(root_of, data, labels, roots: int, leaves: int) -> Int[np.ndarray, " k"]:
    """1 + the largest number of a view's labels that match the root: half of the label's pixels are the root's."""
    valid = np.asarray(labels[1])
    both, _, pixels = view_overlaps(data, root_of, MATCH_SILHOUETTE, groups=roots, slots=valid.shape[1])
    matched = (both > 0.5 * pixels[:, None]) & valid[:, None] & (pixels[:, None] > 0)
    return np.minimum(1 + matched.sum(2).max(0), leaves)


def _associate(
    leaf_of: Array, codes: Array, data: Any, labels: Any, names: Int[np.ndarray, "t k"], embeddings: Float[Array, "m e"]
) -> tuple[Array, Array]:
    """(L, E) sum of the embeddings of the matched masks, divided by their number, and (L,) that number.

    A leaf's silhouette alone, alpha > 0.8, meets each mask of a view with IoU (1 - L1 distance of their features); the
    best counts where it is above 0.2 (equation 5 of the paper).
    """
    used, place = np.unique(np.asarray(leaf_of), return_inverse=True)
    room, slots = data[0].splats.shape[1] - len(place), names.shape[1]
    group_of = jnp.asarray(np.pad(place, (0, room), constant_values=-1), jnp.int32)
    both, area, pixels = view_overlaps(data, group_of, MATCH_SILHOUETTE, groups=len(used), slots=slots)
    means, valid = (np.asarray(a) for a in labels)
    summed = np.zeros((len(codes), embeddings.shape[1]), np.float64)
    matches = np.zeros(len(codes), np.int32)
    own = (np.asarray(codes)[used] + 1) / 2
    for t in range(len(both)):
        overlap = both[t] / np.maximum(pixels[t] + area[t, :, None] - both[t], 1)
        distance = np.abs(means[t][None] - own[:, None]).mean(-1)
        score = np.where(valid[t] & (pixels[t] > 0), overlap * (1 - distance), 0.0)
        found = score.argmax(1)
        hit = score.max(1) > MATCH_SCORE
        summed[used[hit]] += embeddings[names[t][found[hit]]]
        matches[used[hit]] += 1
    return jnp.asarray(summed / (matches[:, None] + 1e-4), jnp.float32), jnp.asarray(matches)
