"""The rows of the tables: each method trains on a setting and answers queries by selecting Gaussians.

An answer's `select(k)` is the Selection of the k-th query; `classes()` the most fitting query of each Gaussian, for the
datasets whose truth is at the points.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.association import Association, associated, by_consensus
from experiments.setting import Setting
from jsecon.baselines import lifting
from jsecon.baselines.evidence import Evidence, shared_capacity
from jsecon.baselines.gaussian_grouping import query_gaussian_grouping, train_gaussian_grouping
from jsecon.baselines.langsplat import LangSplat, train_langsplat
from jsecon.baselines.opengaussian import Schedule, train_opengaussian
from jsecon.evaluate.opengaussian import most_similar_text, select_leaf, select_text, without_stragglers
from jsecon.language.autoencoder import train_autoencoder
from jsecon.language.codes import encode, region_codes
from jsecon.language.distill import distill_l1, distill_votes
from jsecon.language.votes import region_votes
from jsecon.query.anchored import query_anchored
from jsecon.query.canonical import query_canonical
from jsecon.query.classes import query_classes
from jsecon.query.one_step import query_one_step
from jsecon.query.outliers import remove_outliers
from jsecon.query.pieces import PIECE_NEARNESS, with_overlap
from jsecon.query.probability import membership_probability
from jsecon.query.showing import with_shown
from jsecon.types import Array, LanguageField, Regions, Selection, Votes


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
    beside: dict[str, float] = dataclasses.field(default_factory=dict)
    """figures under a protocol of the method's own, to stand beside the table's."""


Method = Callable[[Setting, Steps], Answers]


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


def by_features(setting: Setting, features: Float[Array, "n e"], *, relevancy: bool) -> Answers:
    """Selections by VALA's readout of the relevancy, or by the scene's most similar text; classes by the latter."""
    texts, features = jnp.asarray(setting.texts), jnp.asarray(features)
    labels, cosines = most_similar_text(features, texts)
    by_text = lambda k: select_text(labels, cosines, k)
    means = setting.evidence.gaussians.means
    read = lambda k: lifting.query_relevancy(features, means, texts[k], jnp.asarray(setting.canonical))
    return Answers(read if relevancy else by_text, lambda: np.asarray(labels))


def langsplat(setting: Setting, steps: Steps) -> Answers:
    """Each frame's own masks; asked by the most similar text, as OpenGaussian asks it at the points."""
    return by_features(setting, langsplat_of(setting, setting.evidence, steps).features(), relevancy=False)


def langsplat_of(setting: Setting, evidence: Evidence, steps: Steps) -> LangSplat:
    """LangSplat trained on the masks of one level."""
    key = jax.random.key(setting.seed)
    return train_langsplat(evidence, key=key, steps=steps.langsplat, init="random", epochs=steps.epochs)


def gaussian_grouping(setting: Setting, steps: Steps) -> Answers:
    """Tracked ids; a text is found in the first view or not at all."""
    rates = dict(zip(("identity_rate", "classifier_rate"), steps.grouping_rates))
    # A classifier's outputs in multiples of 32, and one for no id: settings share their compiled programs.
    key, classes = jax.random.key(setting.seed), 1 + 32 * -(-(int(setting.evidence.tracks.max()) + 1) // 32)
    model, _ = train_gaussian_grouping(setting.evidence, key=key, steps=steps.grouping, classes=classes, **rates)
    canonical = jnp.asarray(setting.canonical)
    ask = lambda k: query_gaussian_grouping(model, setting.evidence, jnp.asarray(setting.texts[k]), canonical)
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
    return lambda setting, steps: by_features(setting, train(setting.evidence).features, relevancy=True)


def association(setting: Setting, by: str, *, labels: np.ndarray | None = None) -> Association:
    """The regions of a setting: by "tracks", by "consensus", or any other name with its `labels`."""
    evidence = setting.evidence
    if by == "tracks":
        return setting.tracked
    if labels is not None:
        return setting.shared.get(by, lambda: associated(evidence, labels))
    return setting.shared.get(by, lambda: by_consensus(evidence, setting.frames, seed=setting.seed))


def field_of(
    setting: Setting,
    *,
    by: str = "tracks",
    labels: np.ndarray | None = None,
    latent: int | str = "auto",
    uniform: bool = False,
    steps: Steps | None = None,
) -> LanguageField:
    """jsecon's field of a setting, its regions those of `association`. latent=3: LangSplat's autoencoder; with `steps`
    the paper's own path, Adam on the rendered L1 from random codes, else the votes' mode."""
    evidence, shared = setting.evidence, setting.shared
    regions = association(setting, by, labels=labels)
    embeddings = jnp.asarray(regions.uniform_embeddings if uniform else regions.embeddings)
    found, key = jnp.asarray(regions.labels), jax.random.key(setting.seed)
    capacity = shared_capacity(evidence.gaussians, evidence.cameras)
    known = Regions(np.asarray(embeddings), regions.pixels)

    def cast() -> Votes:
        given = evidence.gaussians, evidence.cameras, found, len(embeddings)
        return with_overlap(with_shown(region_votes(*given, by_view=True, capacity=capacity), known))

    votes = shared.get(("votes", by, uniform), cast)
    if latent == "auto":
        table, coder, _ = shared.get(("codes", by, uniform), lambda: region_codes(embeddings, latent=latent, key=key))
    else:
        epochs = None if steps is None else steps.epochs
        coder = train_autoencoder(embeddings, latent=latent, key=key, epochs=epochs)
        table = coder.encode(embeddings)
    if steps is None:
        codes = distill_votes(votes, table)
    else:
        codes, _ = distill_l1(
            evidence.gaussians,
            evidence.cameras,
            found,
            table,
            steps=steps.paper,
            key=key,
            init="random",
            capacity=capacity,
        )
    return LanguageField(
        evidence.gaussians,
        codes,
        votes,
        known,
        table,
        coder,
        evidence.cameras,
        setting.canonical,
        np.eye(4),
        setting.names,
    )


def ask_field(
    setting: Setting,
    field: LanguageField,
    way: str,
    *,
    retrieval: str = "contrast",
    clean: bool = True,
    threshold: float | None = None,
    pieces: bool = False,
) -> Answers:
    """Queries of a field: `way` is votes, all_views (votes, but every view that sees a Gaussian counts), lead, code,
    probability (of the votes; all anchored, by `retrieval`), one_step or canonical; `clean` drops outliers, `pieces`
    joins the regions that are pieces of what the text found."""
    means = np.asarray(setting.evidence.gaussians.means)
    by, weight = ("votes", 1.0) if way == "all_views" else (way, None)
    phrases = jnp.asarray(field.canonical)
    nearness = PIECE_NEARNESS if pieces else None

    def ask(k: int) -> Selection:
        text = jnp.asarray(setting.texts[k])
        if way == "one_step":
            found = query_one_step(
                field.codes, encode(field.autoencoder, text), 0.9 if threshold is None else threshold
            )
        elif way == "canonical":
            code, canonical = encode(field.autoencoder, text), encode(field.autoencoder, phrases)
            found = query_canonical(field.codes, code, canonical, 0.5 if threshold is None else threshold)
        elif way == "probability":
            found = query_anchored(field, text, retrieval=retrieval, piece_nearness=nearness)
            probability = membership_probability(found.similarity, field.votes)
            inside = (found.region >= 0) & (probability >= (0.5 if threshold is None else threshold))
            found = dataclasses.replace(found, mask=inside)
        else:
            found = query_anchored(
                field,
                text,
                by=by,
                retrieval=retrieval,
                similarity_threshold=threshold,
                piece_nearness=nearness,
                unlabelled_weight=weight,
            )
        mask = np.asarray(found.mask)
        return dataclasses.replace(found, mask=jnp.asarray(remove_outliers(means, mask))) if clean else found

    if way != "votes":
        return _by_selection(setting, ask)
    texts = jnp.asarray(setting.texts)
    return Answers(ask, lambda: np.asarray(query_classes(field, texts, retrieval=retrieval, every=True)[0]))


def _field(way: str, *, retrieval: str = "contrast", clean: bool = True, pieces: bool = False, **options) -> Method:
    return lambda setting, steps: ask_field(
        setting, field_of(setting, **options), way, retrieval=retrieval, clean=clean, pieces=pieces
    )


def paper(setting: Setting, steps: Steps) -> Answers:
    """The paper's own path: tracks, phi_bar, 3-d codes trained on the rendered L1, the region of the largest cosine,
    anchored by code, DBSCAN."""
    return ask_field(setting, field_of(setting, latent=3, steps=steps), "code", retrieval="cosine")


METHODS: dict[str, Method] = {
    "LangSplat-m": langsplat,
    "Gaussian Grouping-m": gaussian_grouping,
    "OpenGaussian": opengaussian,
    "Occam's LGS": _lifted(lifting.train_occam),
    "weighted back-projection": _lifted(lifting.train_backprojection),
    "VALA": _lifted(lifting.train_vala),
    "the paper's path": paper,
    "ours, tracks": _field("votes", pieces=True),
    "ours, consensus": _field("votes", by="consensus", pieces=True),
}
"""the rows of Tables 1 to 3"""
RECOMMENDED = "ours, consensus"
"""what jsecon does by default with masks of single frames: the row to hold against the others"""
_BY_COSINE = {"retrieval": "cosine"}
COMPONENTS: dict[str, Method] = {
    "LangSplat-m": langsplat,
    "masklets, one-step": _field("one_step", clean=False),
    "masklets, anchored by code": _field("code", clean=False, **_BY_COSINE),
    "+ DBSCAN (the paper, distilled by votes)": _field("code", **_BY_COSINE),
    "uniform instead of pixel weights": _field("code", uniform=True, **_BY_COSINE),
    "3-d autoencoder codes instead of spread ones": _field("code", latent=3, **_BY_COSINE),
    "the paper's path": paper,
    "membership by votes of all views": _field("all_views", **_BY_COSINE),
    "membership by votes of the views that show it": _field("votes", **_BY_COSINE),
    "the region by contrast": _field("votes"),
    "ours, tracks": METHODS["ours, tracks"],
    "ours, consensus, the region by cosine": _field("votes", by="consensus", **_BY_COSINE),
    "ours, consensus, without pieces": _field("votes", by="consensus"),
    "ours, consensus": METHODS["ours, consensus"],
    "ours, consensus, by lead": _field("lead", by="consensus"),
}
"""the rows of Table 4: per-frame masks asked in one step (LangSplat-m), then the paper's parts distilled by votes, the
whole of the paper's path, and ours: the region of the largest contrast and its pieces, by the tracks or by consensus"""
QUERIES: dict[str, Method] = {
    "one-step": _field("one_step"),
    "canonical": _field("canonical"),
    "anchored by code": _field("code", **_BY_COSINE),
    "anchored by code, the region by contrast": _field("code"),
    "anchored by votes of all views": _field("all_views", **_BY_COSINE),
    "anchored by lead": _field("lead", **_BY_COSINE),
    "anchored by votes": _field("votes", **_BY_COSINE),
    "the region by contrast": COMPONENTS["the region by contrast"],
    "ours, tracks": METHODS["ours, tracks"],
}
"""the rows of Table 5, of one field of the tracks with spread codes; the last by votes, the region by contrast, then
with its pieces"""
