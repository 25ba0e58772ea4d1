"""What the same features score under each protocol: read in the rendered image, or selected at the points.

    python -m experiments.two_protocols [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins. Under LangSplat's 2D protocol (experiments.protocols.langsplat_2d), under which most of these
methods were published, the feature map is rendered, decoded where it is compressed, compared with the text pixel by
pixel and cut relative to its own range; the best of the levels s, m and l counts. At the points, as in
`experiments.lerf`, Gaussians are selected and rendered alone.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from experiments import lerf
from experiments.protocols.langsplat_2d import evaluate_langsplat_2d, pixel_relevancy
from experiments.rivals import lifting
from experiments.rivals.evidence import Evidence
from experiments.tables import layout
from experiments.tables.answers import Answers, Method, Steps
from experiments.tables.fill import Plan, options_of
from experiments.tables.methods import RECOMMENDED, by_features, langsplat_of
from experiments.tables.ours import ask_field, field_of
from experiments.tables.setting import Setting
from jsecon.data.lerf_labels import LabelledFrame
from jsecon.evaluate.lerf import resize_camera
from jsecon.language.distill import distill_votes
from jsecon.splat.render import render
from jsecon.types import Array

Map = tuple[Array, Callable[[Array], Array]]
"""a feature of each Gaussian, and what makes embeddings of its rendered image"""


def in_the_image(setting: Setting, maps: Sequence[Map]) -> dict[str, float]:
    """The figures miou_2d, macc_2d and loc_2d of a map per level, at the size of the labels."""
    gaussians = jax.tree.map(jnp.asarray, setting.evidence.gaussians)
    texts, canonical = jnp.asarray(setting.texts), jnp.asarray(setting.canonical)
    labels = setting.bench.frames
    resize = lambda frame: resize_camera(setting.cameras[frame.name], frame.width, frame.height)
    cameras = {frame.name: jax.tree.map(jnp.asarray, resize(frame)) for frame in labels}

    @functools.lru_cache(maxsize=1)  # the pairs come frame by frame
    def images(name: str) -> list[Array]:
        return [decode(render(gaussians, cameras[name], field).features) for field, decode in maps]

    def relevancies(frame: LabelledFrame, query: str) -> np.ndarray:
        text = texts[setting.bench.queries.index(query)]
        return np.stack([pixel_relevancy(image, text, canonical) for image in images(frame.name)])

    _, told = evaluate_langsplat_2d(labels, relevancies, expected_pairs=setting.bench.pairs)
    return {"miou_2d": told["miou"], "macc_2d": told["macc"], "loc_2d": told["loc_acc"]}


def langsplat(setting: Setting, steps: Steps) -> Answers:
    """LangSplat-m; its codes are rendered, then decoded pixel by pixel. An autoencoder per level."""
    models = [langsplat_of(setting, evidence, steps) for evidence in setting.levels]
    answers = by_features(setting, models[0].features(), relevancy=False)
    return dataclasses.replace(answers, beside=in_the_image(setting, [(m.codes, m.decode) for m in models]))


def _as_they_are(image: Array) -> Array:
    return image


def _lifted(train: Callable[[Evidence], lifting.Lifted]) -> Method:
    def method(setting: Setting, steps: Steps) -> Answers:
        fields = [jnp.asarray(train(evidence).features) for evidence in setting.levels]
        answers = by_features(setting, fields[0], relevancy=True)
        return dataclasses.replace(answers, beside=in_the_image(setting, [(f, _as_they_are) for f in fields]))

    return method


def ours(setting: Setting, steps: Steps) -> Answers:
    """At the points as in Table 1; in the image each Gaussian bears its region's embedding."""
    field = field_of(setting, by="consensus")
    embeddings = distill_votes(field.votes, jnp.asarray(field.regions.embeddings))
    beside = in_the_image(setting, [(embeddings, _as_they_are)])
    return dataclasses.replace(ask_field(setting, field, "votes", pieces=True), beside=beside)


ROWS: dict[str, Method] = {
    "LangSplat-m": langsplat,
    "Occam's LGS": _lifted(lifting.train_occam),
    "weighted back-projection": _lifted(lifting.train_backprojection),
    "VALA": _lifted(lifting.train_vala),
    RECOMMENDED: ours,
}


def _plan(table: Plan) -> Plan:
    """Beside Table 1, on its first seed, with cells of its own: they hold more."""
    own = dataclasses.replace(lerf.beside(table, "protocols", ROWS), cells="", sweep=())
    return dataclasses.replace(own, data=dataclasses.replace(own.data, seeds=own.data.seeds[:1]))


PLAN, QUICK = _plan(lerf.PLAN), _plan(lerf.QUICK)
FIGURES = ("miou_2d", "macc_2d", "loc_2d", "miou", "macc", "loc_acc")
NOTES = (
    "miou_2d, macc_2d, loc_2d: LangSplat's 2D protocol, rendered relevancy, 30x30 px smoothing, best level, threshold "
    "0.4; miou, macc, loc_acc: point level, rendered, alpha > 0.7 (Table 1). A twin's image is 192 px high and LERF's "
    "730, so that the 30 px smear more here."
)


def main(plan: Plan) -> str:
    """The table, written."""
    return layout.make(plan, ROWS, FIGURES, notes=NOTES)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
