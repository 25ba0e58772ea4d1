"""jsecon's own rows: the field of a setting, and the ways to ask it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.baselines.evidence import with_room
from experiments.tables.answers import Answers, Method, Steps, by_selection
from experiments.tables.association import Association, associated, by_consensus
from experiments.tables.codes import encode, region_codes
from experiments.tables.setting import Setting
from jsecon.field.evidence import region_votes
from jsecon.field.membership import membership_probability, normalise_votes
from jsecon.paper.autoencoder import train_autoencoder
from jsecon.paper.distill import distill_l1, distill_votes
from jsecon.paper.queries import CODE_THRESHOLD, query_canonical, query_one_step, select_by_code
from jsecon.query.answer import match_regions, query_anchored, query_several
from jsecon.query.classes import query_classes
from jsecon.query.outliers import remove_outliers
from jsecon.query.rules import RULES, QueryRules
from jsecon.types import Codes, LanguageField, Regions, Selection, Votes

BY_COSINE = {"retrieval": "cosine"}
"""the region of the largest cosine, as the paper finds it"""
AGREEMENT = 0.4
"""of views, jsecon's default"""


def association(
    setting: Setting, by: str, *, labels: np.ndarray | None = None, centre: float = 0.0, agreement: float = AGREEMENT
) -> Association:
    """The regions of a setting: by "tracks", "consensus", or any other name with its `labels`. `centre` and `agreement`
    are those of a consensus."""
    if by == "tracks":
        return setting.tracked
    if labels is not None:
        return setting.shared.get(by, lambda: associated(setting.levels, labels))

    def make():
        given = {"seed": setting.seed, "centre": centre, "agreement": agreement}
        return by_consensus(setting.levels, setting.frames, **given)

    return setting.shared.get((by, centre, agreement), make)


def field_of(
    setting: Setting,
    *,
    by: str = "tracks",
    labels: np.ndarray | None = None,
    latent: int | str = "auto",
    uniform: bool = False,
    steps: Steps | None = None,
    centre: float = 0.0,
    agreement: float = AGREEMENT,
) -> LanguageField:
    """jsecon's field of a setting, its regions those of `association`. latent=3: LangSplat's autoencoder; with `steps`
    the paper's own path, Adam on the rendered L1 from random codes, else the votes' mode. `centre` as for
    `region_votes` and, with `agreement`, for `association`."""
    evidence, shared = setting.evidence, setting.shared
    regions = association(setting, by, labels=labels, centre=centre, agreement=agreement)
    embeddings = jnp.asarray(regions.uniform_embeddings if uniform else regions.embeddings)
    found, key = jnp.asarray(regions.labels), jax.random.key(setting.seed)
    known = Regions(np.asarray(embeddings), regions.pixel_counts)

    def cast() -> Votes:
        given = evidence.gaussians, evidence.cameras, found, len(embeddings)
        return normalise_votes(region_votes(*given, by_view=True, centre_pixel_weight=centre), known)

    votes = shared.get(("votes", by, uniform, centre, agreement), cast)
    if latent == "auto":
        table, coder, _ = shared.get(
            ("codes", by, uniform, centre, agreement), lambda: region_codes(embeddings, latent=latent, key=key)
        )
    else:
        epochs = None if steps is None else steps.epochs
        coder = train_autoencoder(embeddings, latent=latent, key=key, epochs=epochs)
        table = encode(coder, embeddings)
    if steps is None:
        codes = distill_votes(votes, table)
    else:
        codes, _ = distill_l1(with_room(evidence.gaussians), evidence.cameras, found, table, steps=steps.paper, key=key)
        codes = codes[: evidence.gaussians.count]
    return LanguageField(
        evidence.gaussians,
        votes,
        known,
        evidence.cameras,
        setting.canonical_phrases,
        np.eye(4),
        setting.names,
        unrelated_words=setting.unrelated_words,
        codes=Codes(codes, table, coder),
    )


def of_all_views(field: LanguageField) -> LanguageField:
    """A field whose votes count every view that sees a Gaussian, not only those that show the region."""
    return dataclasses.replace(field, votes=dataclasses.replace(field.votes, weight_where_region_visible=None))


def ask_field(
    setting: Setting,
    field: LanguageField,
    way: str,
    *,
    retrieval: str = "contrast",
    clean: bool = True,
    threshold: float | None = None,
    pieces: bool = False,
    min_score: float | None = None,
) -> Answers:
    """Queries of a field: `way` is votes, all_views (votes, but every view that sees a Gaussian counts), code,
    probability (of the votes; all anchored, by `retrieval`), one_step or canonical; or all (of all regions that
    answer). `clean` drops outliers, `pieces` joins the regions that are pieces of what the text found."""
    means = np.asarray(setting.evidence.gaussians.means)
    field = of_all_views(field) if way == "all_views" else field
    phrases, codes = jnp.asarray(field.canonical_phrases), field.codes
    rules = QueryRules(retrieval=retrieval, min_score=min_score)
    rules = rules if pieces else dataclasses.replace(rules, fragment_score=None)

    def ask(k: int) -> Selection:
        text = jnp.asarray(setting.texts[k])
        if way == "all":
            every = dataclasses.replace(rules, all_of_class=True, fragment_score=RULES.fragment_score)
            found = query_several(field, text[None], rules=every)
            return dataclasses.replace(found, mask=jnp.asarray(remove_outliers(means, found.mask, keep="all")))
        if way == "one_step":
            code = encode(codes.autoencoder, text)
            found = query_one_step(codes.gaussians, code, 0.9 if threshold is None else threshold)
        elif way == "canonical":
            code, canonical = encode(codes.autoencoder, text), encode(codes.autoencoder, phrases)
            found = query_canonical(codes.gaussians, code, canonical, 0.5 if threshold is None else threshold)
        elif way == "probability":
            found = query_anchored(field, text, rules=dataclasses.replace(rules, min_score=None))
            probability = membership_probability(found.similarity, field.votes)
            inside = (found.region >= 0) & (probability >= (0.5 if threshold is None else threshold))
            found = dataclasses.replace(found, mask=inside)
        else:
            cut = {} if threshold is None else {"min_share": threshold}
            if way == "code":
                match = match_regions(field, text[None], rules)
                found = select_by_code(field, match, CODE_THRESHOLD if threshold is None else threshold)
            else:
                found = query_anchored(field, text, rules=dataclasses.replace(rules, **cut))
        mask = np.asarray(found.mask)
        return (
            dataclasses.replace(found, mask=jnp.asarray(remove_outliers(means, mask, keep="largest")))
            if clean
            else found
        )

    if way not in ("votes", "all"):
        return by_selection(setting, ask, codes.gaussians)
    texts = jnp.asarray(setting.texts)

    def classes():
        return np.asarray(
            query_classes(field, texts, rules=QueryRules(retrieval=retrieval), standardise=False, every=True)[0]
        )

    return Answers(ask, classes, features=codes.gaussians)


def asked(way: str, *, retrieval: str = "contrast", clean: bool = True, pieces: bool = False, **options) -> Method:
    """The row that asks `field_of(setting, **options)` as `ask_field` describes."""
    return lambda setting, steps: ask_field(
        setting, field_of(setting, **options), way, retrieval=retrieval, clean=clean, pieces=pieces
    )


def untracked(setting: Setting, steps: Steps) -> Answers:
    """The paper's row without tracking: every mask of every frame is a region of its own, anchored by code, DBSCAN."""
    field = field_of(setting, by="masks of single frames", labels=np.asarray(setting.evidence.masks))
    return ask_field(setting, field, "code", **BY_COSINE)


def paper(setting: Setting, steps: Steps) -> Answers:
    """The paper's own path: tracks, phi_bar, 3-d codes trained on the rendered L1, the region of the largest cosine,
    anchored by code, DBSCAN."""
    return ask_field(setting, paper_field(setting, steps), "code", retrieval="cosine")


def paper_field(setting: Setting, steps: Steps) -> LanguageField:
    """What the paper's own path trains, once a setting and seed."""
    key = "the paper's path", setting.seed
    return setting.shared.get(key, lambda: field_of(setting, latent=3, steps=steps))
