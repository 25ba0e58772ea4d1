"""The rows of the tables: each method trains on a setting and answers queries by selecting Gaussians.

An answer's `select(k)` is the Selection of the k-th query; `classes()` the most fitting query of each Gaussian, for the
datasets whose truth is at the points.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from experiments.setting import Setting
from jsecon.baselines import lifting
from jsecon.baselines.gaussian_grouping import query_gaussian_grouping, train_gaussian_grouping
from jsecon.baselines.langsplat import train_langsplat
from jsecon.baselines.opengaussian import Schedule, train_opengaussian
from jsecon.evaluate.opengaussian import most_similar_text, select_leaf, select_text, without_stragglers
from jsecon.language.autoencoder import train_autoencoder
from jsecon.language.codes import encode, region_codes
from jsecon.language.distill import distill_l1, distill_votes
from jsecon.language.votes import region_votes
from jsecon.query.anchored import query_anchored
from jsecon.query.canonical import query_canonical
from jsecon.query.one_step import query_one_step
from jsecon.query.outliers import remove_outliers
from jsecon.types import LanguageField, Regions, Selection


@dataclasses.dataclass(frozen=True)
class Steps:
    """How long the trained methods train. The papers' schedules are 30,000 steps and more at small rates; these are
    shorter at larger rates, started from random codes where zero would keep still (REFERENCE B.7)."""

    langsplat: int = 1500
    epochs: int | None = None
    """of the autoencoders; None: LangSplat's."""
    grouping: int = 800
    grouping_rates: tuple[float, float] = (0.025, 0.005)
    instance: int = 800
    coarse: int = 200
    fine: int = 200
    roots: int = 64
    leaves: int = 10
    opengaussian_rate: float = 0.02
    paper: int = 1500


@dataclasses.dataclass(frozen=True)
class Answers:
    """What a trained method says."""

    select: Callable[[int], Selection | None]
    classes: Callable[[], np.ndarray]


def _by_selection(setting: Setting, select: Callable[[int], Selection | None]) -> Answers:
    def classes() -> np.ndarray:
        # Where several texts select a Gaussian, the one that fits its anchor best: all may share that anchor.
        best = np.full(setting.evidence.gaussians.count, -np.inf)
        found = np.full(len(best), -1)
        for k in range(len(setting.texts)):
            answer = select(k)
            if answer is not None:
                better = np.asarray(answer.mask) & (float(answer.score) > best)
                best[better], found[better] = float(answer.score), k
        return found

    return Answers(select, classes)


def _by_features(setting: Setting, features, *, relevancy: bool) -> Answers:
    """Selections by VALA's readout of the relevancy, or by the scene's most similar text; classes by the latter."""
    texts, features = jnp.asarray(setting.texts), jnp.asarray(features)
    labels, cosines = most_similar_text(features, texts)
    by_text = lambda k: select_text(labels, cosines, k)
    means = setting.evidence.gaussians.means
    read = lambda k: lifting.query_relevancy(features, means, texts[k], jnp.asarray(setting.canonical))
    return Answers(read if relevancy else by_text, lambda: np.asarray(labels))


def langsplat(setting: Setting, steps: Steps) -> Answers:
    """Each frame's own masks; asked by the most similar text, as OpenGaussian asks it at the points."""
    key = jax.random.key(setting.seed)
    model = train_langsplat(setting.evidence, key=key, steps=steps.langsplat, init="random", epochs=steps.epochs)
    return _by_features(setting, model.features(), relevancy=False)


def gaussian_grouping(setting: Setting, steps: Steps) -> Answers:
    """Tracked ids; a text is found in the first view or not at all."""
    rates = dict(zip(("identity_rate", "classifier_rate"), steps.grouping_rates))
    key = jax.random.key(setting.seed)
    model, _ = train_gaussian_grouping(setting.evidence, key=key, steps=steps.grouping, **rates)
    ask = lambda k: query_gaussian_grouping(
        model, setting.evidence, jnp.asarray(setting.texts[k]), jnp.asarray(setting.canonical)
    )
    return _by_selection(setting, ask)


def opengaussian(setting: Setting, steps: Steps) -> Answers:
    """Instance features and a codebook; the most similar leaf."""
    views = len(setting.names)
    schedule = Schedule(
        steps.instance,
        steps.coarse,
        steps.fine,
        steps.roots,
        steps.leaves,
        min_views=max(2, min(5, views // 4)),
        rate=steps.opengaussian_rate,
        coarse_rate=steps.opengaussian_rate / 10,
    )
    model, _ = train_opengaussian(setting.evidence, key=jax.random.key(setting.seed), schedule=schedule)
    gaussians = setting.evidence.gaussians

    def ask(k: int) -> Selection:
        text = jnp.asarray(setting.texts[k])
        found = select_leaf(model.leaf_features, model.leaf_codes, model.leaf_of, text, siblings=model.siblings)
        kept = without_stragglers(gaussians.means, gaussians.log_scales, found.mask)
        return dataclasses.replace(found, mask=jnp.asarray(kept))

    def classes() -> np.ndarray:
        labels, _ = most_similar_text(model.leaf_features, jnp.asarray(setting.texts))
        return np.asarray(labels)[np.asarray(model.leaf_of)]

    return Answers(ask, classes)


def _lifted(train: Callable) -> Callable[[Setting, Steps], Answers]:
    return lambda setting, steps: _by_features(setting, train(setting.evidence).features, relevancy=True)


def field_of(setting: Setting, *, latent: int | str = "auto", uniform: bool = False, steps: Steps | None = None):
    """jsecon's field of a setting. latent=3: LangSplat's autoencoder; with `steps` the paper's own path, Adam on the
    rendered L1 from random codes, else the votes' mode."""
    evidence = setting.evidence
    embeddings = setting.uniform_embeddings if uniform else setting.track_embeddings
    tracks = jnp.asarray(evidence.tracks)
    votes = region_votes(evidence.gaussians, evidence.cameras, tracks, len(embeddings))
    key = jax.random.key(setting.seed)
    if latent == "auto":
        table, coder, _ = region_codes(jnp.asarray(embeddings), latent=latent, key=key)
    else:
        coder = train_autoencoder(
            jnp.asarray(embeddings), latent=latent, key=key, epochs=None if steps is None else steps.epochs
        )
        table = coder.encode(jnp.asarray(embeddings))
    if steps is None:
        codes = distill_votes(votes, table)
    else:
        codes, _ = distill_l1(
            evidence.gaussians, evidence.cameras, tracks, table, steps=steps.paper, key=key, init="random"
        )
    return LanguageField(
        evidence.gaussians,
        codes,
        votes,
        Regions(embeddings, setting.track_pixels.astype(np.int32)),
        table,
        coder,
        evidence.cameras,
        setting.canonical,
        np.eye(4),
        setting.names,
    )


def ask_field(setting: Setting, field: LanguageField, way: str, *, clean: bool = True, threshold=None) -> Answers:
    """Queries of a field: `way` is votes, lead, code (all anchored), one_step or canonical; `clean` drops outliers."""
    means = np.asarray(setting.evidence.gaussians.means)

    def ask(k: int) -> Selection:
        text = jnp.asarray(setting.texts[k])
        if way in ("votes", "lead", "code"):
            found = query_anchored(field, text, by=way, similarity_threshold=threshold)
        elif way == "one_step":
            found = query_one_step(
                field.codes, encode(field.autoencoder, text), 0.9 if threshold is None else threshold
            )
        else:
            canonical = encode(field.autoencoder, jnp.asarray(field.canonical))
            code = encode(field.autoencoder, text)
            found = query_canonical(field.codes, code, canonical, 0.5 if threshold is None else threshold)
        mask = np.asarray(found.mask)
        return dataclasses.replace(found, mask=jnp.asarray(remove_outliers(means, mask))) if clean else found

    return _by_selection(setting, ask)


def _field(way: str, *, clean: bool = True, **options) -> Callable[[Setting, Steps], Answers]:
    return lambda setting, steps: ask_field(setting, field_of(setting, **options), way, clean=clean)


def paper(setting: Setting, steps: Steps) -> Answers:
    """The paper's own path: tracks, phi_bar, 3-d codes trained on the rendered L1, anchored by code, DBSCAN."""
    return ask_field(setting, field_of(setting, latent=3, steps=steps), "code")


METHODS: dict[str, Callable[[Setting, Steps], Answers]] = {
    "LangSplat-m": langsplat,
    "Gaussian Grouping-m": gaussian_grouping,
    "OpenGaussian": opengaussian,
    "Occam's LGS": _lifted(lifting.train_occam),
    "weighted back-projection": _lifted(lifting.train_backprojection),
    "VALA": _lifted(lifting.train_vala),
    "the paper's path": paper,
    "ours, votes": _field("votes"),
    "ours, lead": _field("lead"),
}
"""the rows of Tables 1 to 3"""
COMPONENTS: dict[str, Callable[[Setting, Steps], Answers]] = {
    "per-frame masks, one-step": langsplat,
    "masklets, one-step": _field("one_step", clean=False),
    "masklets, anchored by code": _field("code", clean=False),
    "+ DBSCAN (the paper, distilled by votes)": _field("code"),
    "uniform instead of pixel weights": _field("code", uniform=True),
    "3-d autoencoder codes instead of spread ones": _field("code", latent=3),
    "trained on the rendered L1 (the paper's path)": paper,
    "membership by votes": _field("votes"),
    "membership by lead": _field("lead"),
}
"""the rows of Table 4"""
QUERIES: dict[str, Callable[[Setting, Steps], Answers]] = {
    "one-step": _field("one_step"),
    "canonical": _field("canonical"),
    "anchored by code": _field("code"),
    "anchored by votes": _field("votes"),
    "anchored by lead": _field("lead"),
}
"""the rows of Table 5"""
