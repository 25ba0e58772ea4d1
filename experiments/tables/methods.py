"""The rows of Tables 1 to 3: the other methods, queried as their papers do, and ours."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.baselines import lifting
from experiments.baselines.evidence import Evidence
from experiments.baselines.gaussian_grouping import GaussianGrouping, query_gaussian_grouping, train_gaussian_grouping
from experiments.baselines.langsplat import LangSplat, train_langsplat
from experiments.baselines.opengaussian import OpenGaussian, Schedule, train_instances, train_opengaussian
from experiments.protocols.opengaussian import most_similar_text, select_leaf, select_text, without_stragglers
from experiments.tables.answers import Answers, Method, Steps, by_selection
from experiments.tables.ours import asked, paper
from experiments.tables.setting import Setting
from jsecon.types import Array, Selection


def by_features(setting: Setting, features: Float[Array, "n e"], *, relevancy: bool) -> Answers:
    """Selections by VALA's readout of the relevancy, or by the scene's most similar text; classes by the latter."""
    texts, features = jnp.asarray(setting.texts), jnp.asarray(features)
    labels, cosines = most_similar_text(features, texts)

    def by_text(k):
        return select_text(labels, cosines, k)

    means = setting.evidence.gaussians.means

    def read(k):
        return lifting.query_relevancy(features, means, texts[k], jnp.asarray(setting.canonical_phrases))

    return Answers(read if relevancy else by_text, lambda: np.asarray(labels), features=features)


def langsplat(setting: Setting, steps: Steps) -> Answers:
    """Each frame's own masks; asked by the most similar text, as OpenGaussian asks it at the points."""
    return by_features(setting, langsplat_of(setting, setting.evidence, steps).features(), relevancy=False)


def langsplat_of(setting: Setting, evidence: Evidence, steps: Steps) -> LangSplat:
    """LangSplat trained on the masks of one level."""
    key = jax.random.key(setting.seed)
    return train_langsplat(evidence, key=key, steps=steps.langsplat, epochs=steps.epochs)


def gaussian_grouping(setting: Setting, steps: Steps) -> Answers:
    """Tracked ids; a text is found in the first view or not at all."""
    model = gaussian_grouping_of(setting, steps)
    canonical = jnp.asarray(setting.canonical_phrases)

    def ask(k):
        return query_gaussian_grouping(model, setting.evidence, jnp.asarray(setting.texts[k]), canonical)

    return by_selection(setting, ask, model.identity)


def gaussian_grouping_of(setting: Setting, steps: Steps) -> GaussianGrouping:
    """Gaussian Grouping trained on the tracker's ids."""
    rates = dict(zip(("identity_rate", "classifier_rate"), steps.grouping_rates))
    # A classifier's outputs in multiples of 32, and one for no id: settings share their compiled programs.
    key, classes = jax.random.key(setting.seed), 1 + 32 * -(-(int(setting.evidence.tracks.max()) + 1) // 32)
    return train_gaussian_grouping(setting.evidence, key=key, steps=steps.grouping, classes=classes, **rates)[0]


def opengaussian(setting: Setting, steps: Steps) -> Answers:
    """Instance features and a codebook; the most similar leaf."""
    return by_leaves(setting, opengaussian_of(setting, steps))


def opengaussian_of(setting: Setting, steps: Steps, **codebook: Any) -> OpenGaussian:
    """OpenGaussian trained once a setting for each codebook, its `roots`, `leaves` and `position_weight` as for LERF or
    as given; codebooks share the first stage."""
    views, evidence, shared = len(setting.names), setting.evidence, setting.shared
    schedule = Schedule(
        steps.instance,
        steps.coarse,
        steps.fine,
        **{"roots": steps.roots, "leaves": steps.leaves, **codebook},
        min_views=max(2, min(5, views // 4)),
        rate=steps.opengaussian_rate,
        coarse_rate=steps.opengaussian_rate / 10,
    )
    given: Any = {"key": jax.random.key(setting.seed), "schedule": schedule}
    instances = shared.get(("instances", setting.seed), lambda: train_instances(evidence, **given))

    def train():
        return train_opengaussian(evidence, **given, instances=instances)[0]

    return shared.get(("OpenGaussian", setting.seed, *sorted(codebook.items())), train)


def by_leaves(setting: Setting, model: OpenGaussian) -> Answers:
    """A trained OpenGaussian asked as its authors ask it."""
    gaussians = setting.evidence.gaussians

    def ask(k: int) -> Selection:
        text = jnp.asarray(setting.texts[k])
        found = select_leaf(model.leaf_features, model.leaf_codes, model.leaf_of, text, siblings=model.siblings)
        kept = without_stragglers(gaussians.means, gaussians.log_scales, found.mask)
        return dataclasses.replace(found, mask=jnp.asarray(kept))

    def classes() -> np.ndarray:
        labels, _ = most_similar_text(model.leaf_features, jnp.asarray(setting.texts))
        return np.asarray(labels)[np.asarray(model.leaf_of)]

    return Answers(ask, classes, features=model.features)


def _lifted(train: Callable) -> Callable[[Setting, Steps], Answers]:
    return lambda setting, steps: by_features(setting, train(setting.evidence).features, relevancy=True)


METHODS: dict[str, Method] = {
    "LangSplat-m": langsplat,
    "Gaussian Grouping-m": gaussian_grouping,
    "OpenGaussian": opengaussian,
    "Occam's LGS": _lifted(lifting.train_occam),
    "weighted back-projection": _lifted(lifting.train_backprojection),
    "VALA": _lifted(lifting.train_vala),
    "the paper's path": paper,
    "ours, tracks": asked("votes", pieces=True),
    "ours, consensus": asked("votes", by="consensus", pieces=True),
}
"""Rows of Tables 1 to 3."""
RECOMMENDED = "ours, consensus"
"""Row that the others are compared with: what jsecon does by default with masks of single frames."""
