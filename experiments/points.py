"""Better points, each on and off: what one idea alone does to the Gaussians that a text selects.

    python -m experiments.points [--scenes figurines teatime] [--seeds 10 11] [--levels medium high] [--quick]
                                 [--out FOLDER] [--processes N]

Twins of LERF, regions by consensus, texts by the contrast, none refused. A row leaves one thing out of what jsecon does
by default, or adds one that was proposed. Nothing was chosen on these seeds.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import lerf, results
from experiments.fair import ahead, by_text
from experiments.ideas.cover import core_and_cover
from experiments.ideas.straddlers import split
from experiments.tables.answers import Answers, Method, Steps
from experiments.tables.association import Shared
from experiments.tables.fill import fill, place_of, twins_asked
from experiments.tables.ours import ask_field, association, field_of
from experiments.tables.rows import NO_REFUSAL, own
from experiments.tables.setting import Setting
from jsecon.fit.optimise import fit_gaussians
from jsecon.fit.schedule import LearningRates, Schedule
from jsecon.language.membership import vote_shares
from jsecon.query.match import MIN_PIECE_OVERLAP
from jsecon.query.outliers import remove_outliers
from jsecon.splat.render import render_rgb
from jsecon.types import Gaussians, LanguageField, Selection

FIGURES = ("miou", "miou_vala")
AS_IT_IS = "as it is"
FULL_PX = 1000
"""times the pixels of a region: all the evidence that there can be"""


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    levels: tuple[str, ...]
    quick: bool
    out: str


def row_of(
    change: Callable[[LanguageField], LanguageField] = lambda field: field,
    choose: Callable[[Setting, Selection], np.ndarray] | None = None,
    **regions: float,
) -> Method:
    """jsecon's row with its field changed, its Gaussians chosen in another way from their shares, or its regions made
    with other options."""

    def row(setting: Setting, steps: Steps) -> Answers:
        field = change(field_of(setting, by="consensus", **regions))
        answers = ask_field(setting, field, "votes", retrieval_threshold=NO_REFUSAL, pieces=True, clean=choose is None)
        if choose is None:
            return answers

        def select(k: int) -> Selection | None:
            found = answers.select(k)
            return None if found is None else dataclasses.replace(found, mask=jnp.asarray(choose(setting, found)))

        return dataclasses.replace(answers, select=select)

    return row


def without_evidence(field: LanguageField) -> LanguageField:
    """As if all regions were seen in many pixels of each view that shows them."""
    return dataclasses.replace(field, regions=dataclasses.replace(field.regions, pixels=FULL_PX * field.regions.pixels))


def pooled(field: LanguageField) -> LanguageField:
    """Each region with the mean embedding of all that share Gaussians with it, by their pixels."""
    near = np.asarray(field.votes.overlap) >= MIN_PIECE_OVERLAP
    np.fill_diagonal(near, True)
    summed = near @ (np.asarray(field.regions.pixels).sum(1)[:, None] * np.asarray(field.regions.embeddings))
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return dataclasses.replace(
        field,
        regions=dataclasses.replace(
            field.regions, embeddings=(summed / np.where(length > 0, length, 1)).astype(np.float32)
        ),
    )


def quality(gaussians: Gaussians, setting: Setting) -> float:
    """PSNR, dB, over every fifth view that was learnt from."""
    views = range(0, len(setting.frames), 5)
    camera = lambda t: jax.tree.map(jnp.asarray, setting.evidence.cameras[t])
    images = [np.clip(np.asarray(render_rgb(gaussians, camera(t)).features), 0, 1) for t in views]
    return float(-10 * np.log10(np.mean(np.square(np.stack(images) - setting.frames[::5] / 255.0))))


SETTLING = {
    "colours": LearningRates(means=0.0, means_last=0.0, log_scales=0.0, quaternions=0.0),
    "all": LearningRates(means=1e-4, means_last=1e-5, log_scales=5e-3, quaternions=3e-3),
}
SETTLING_STEPS = 100


def changed(setting: Setting, *, cut: bool = True, settle: str = "") -> Answers:
    """The field of a scene whose straddlers are split, then fitted for SETTLING_STEPS more at the rates `settle`, with
    the regions of the scene as it was; PSNR beside."""
    found, before = association(setting, "consensus"), setting.evidence.gaussians
    votes = field_of(setting, by="consensus").votes
    first, share = np.asarray(votes.regions)[:, 0], np.asarray(vote_shares(votes))[:, 0]
    after = before
    if cut:
        after = split(before, setting.evidence.cameras, found.labels, first, share, np.asarray(votes.total))
    if settle:
        how = {"schedule": Schedule(growth="none"), "rates": SETTLING[settle], "steps": SETTLING_STEPS}
        after, _ = fit_gaussians(setting.bench.capture, start=after, key=jax.random.key(setting.seed), **how)
        after = jax.tree.map(jnp.asarray, after)
    evidence = dataclasses.replace(setting.evidence, gaussians=after)
    other = dataclasses.replace(setting, evidence=evidence, levels=(evidence,), shared=Shared())
    other.shared.get("split", lambda: found)
    field = field_of(other, by="split", labels=found.labels)
    answers = ask_field(other, field, "votes", retrieval_threshold=NO_REFUSAL, pieces=True)
    beside = {"psnr_before": quality(before, setting), "psnr_after": quality(after, setting)}
    return dataclasses.replace(answers, beside=beside, gaussians=after)


def _cleaned(**how) -> Callable[[Setting, Selection], np.ndarray]:
    return lambda setting, found: remove_outliers(setting.evidence.gaussians.means, found.mask, **how)


ROWS: dict[str, Method] = {
    AS_IT_IS: row_of(),
    "views without a mask speak": own("outspoken", "contrast", "threshold"),
    "evidence does not count": row_of(without_evidence),
    "fragments pooled before retrieval": row_of(pooled),
    "outliers stay": row_of(choose=lambda setting, found: np.asarray(found.mask)),
    "every cluster stays": row_of(choose=_cleaned(keep="all")),
    "parts that answer": own("consensus", "contrast", "threshold", way="parts"),
    "parts where no region answers": own("consensus", "contrast", "threshold", instead=True),
    "expected IoU": own("consensus", "contrast", "silhouette"),
    "expected IoU at 0.7": own("consensus", "contrast", "strict silhouette"),
    "expected IoU at 10/255": own("consensus", "contrast", "lenient silhouette"),
    "core and cover": row_of(
        choose=lambda setting, found: core_and_cover(
            setting.evidence.gaussians, setting.evidence.cameras, np.asarray(found.similarity)
        )
    ),
    "votes of the centre, half": own("consensus", "contrast", "threshold", centre=0.5),
    "votes of the centre": own("consensus", "contrast", "threshold", centre=1.0),
    "straddlers split": lambda setting, steps: changed(setting),
    "straddlers split, colours settled": lambda setting, steps: changed(setting, settle="colours"),
    "straddlers split, all settled": lambda setting, steps: changed(setting, settle="all"),
    "all settled, none split": lambda setting, steps: changed(setting, cut=False, settle="all"),
}


def report(cells: list[dict], level: str) -> tuple[str, dict]:
    """A Markdown table of one level, and its figures."""
    of = lambda row: [cell for cell in cells if cell["method"] == row]
    told, rows = {}, []
    for row in ROWS:
        means = [float(np.mean([cell[figure] for cell in of(row)])) for figure in FIGURES]
        apart = [ahead(by_text(of(row), n), by_text(of(AS_IT_IS), n)) for n in range(len(FIGURES))]
        known = [k for k in of(row)[0] if k.startswith("psnr")]
        psnr = {k: float(np.mean([cell[k] for cell in of(row)])) for k in known}
        told[row] = {"mean": means, "more": apart, **psnr}
        columns = [(f"{mean:.3f}", f"{d[0]:+.3f} [{d[1]:+.3f}, {d[2]:+.3f}]") for mean, d in zip(means, apart)]
        rows.append((row, *(value for pair in columns for value in pair)))
    heads = [head for figure in FIGURES for head in (figure, "more than as it is [95 %]")]
    quality = [f"{row} {told[row]['psnr_after']:.2f}" for row in told if "psnr_after" in told[row]]
    before = told["straddlers split"]["psnr_before"]
    text = results.table((level, *heads), rows)
    return f"{text}\n\nPSNR of the scene, dB: {before:.2f}; {', '.join(quality)}.", told


def main(asked: Asked, processes: int) -> str:
    """The tables, written."""
    table = lerf.QUICK if asked.quick else lerf.PLAN
    data = dataclasses.replace(table.data, scenes=table.data.scenes if asked.quick else asked.scenes, seeds=asked.seeds)
    place = {"out": asked.out, "cells": str(Path(asked.out) / "cells.jsonl")}
    parts, kept = [], {}
    for level in asked.levels:
        options = {"methods": tuple(ROWS), "level": level, "sweep": (), "processes": processes}
        cells = fill(
            dataclasses.replace(table, data=data, **options, **place), ROWS, tell=lambda line: print(line, flush=True)
        )
        text, kept[level] = report(cells, level)
        parts.append(text)
        print(text, flush=True)
    text = "\n\n".join(parts)
    results.save(Path(asked.out), asked, kept, text)
    return text


if __name__ == "__main__":
    parser = twins_asked("points", "one tiny scene, one seed")
    parser.add_argument("--levels", nargs="+", default=["medium", "high"])
    given = parser.parse_args()
    seeds, levels = ((0,), ("medium",)) if given.quick else (tuple(given.seeds), tuple(given.levels))
    main(Asked(tuple(given.scenes), seeds, levels, given.quick, place_of(given, "points")), given.processes)
