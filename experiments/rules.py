"""Each rule of retrieval on and off, at several levels: which of them hold where views share their errors?

    python -m experiments.rules [--scenes NAME ...] [--seeds 0 1] [--levels medium high shared] [--quick] [--out FOLDER]
                                [--processes N]

Twins of LERF. A row changes one rule of `jsecon query`. The first row has all rules as they are, and refuses no text.
Then refusal: texts of the scene, and of names that nothing in it has (`twins.absent_texts`), are held against
thresholds on the similarity of their best region. The thresholds are constants, or quantiles of the similarities of
reference words in the same field. One half of the absent names are the reference words, the other half are refused.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import lerf, results
from experiments.fair import ahead, by_text
from experiments.points import without_evidence
from experiments.tables import twins
from experiments.tables.answers import Answers, Method, Steps
from experiments.tables.fill import fill, place_of, twins_asked
from experiments.tables.ours import field_of
from experiments.tables.rows import NO_REFUSAL, own
from experiments.tables.setting import Setting
from jsecon.query.anchored import query_anchored
from jsecon.query.outliers import remove_outliers
from jsecon.query.retrieval import CONTRAST_THRESHOLD, RETRIEVAL_THRESHOLD, answers
from jsecon.types import LanguageField, Selection

FIGURES = ("miou", "miou_vala")
AS_IT_IS = "as it is"
TRACKS = "tracks, as it is"
QUANTILES = (0.8, 0.9, 0.95, 0.98)
"""of the reference words' similarities with their best regions, above which a text is answered"""
CONSTANTS = {"contrast": CONTRAST_THRESHOLD, "cosine": RETRIEVAL_THRESHOLD}


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the command line asked for."""

    scenes: tuple[str, ...]
    seeds: tuple[int, ...]
    levels: tuple[str, ...]
    quick: bool
    out: str


def rule(
    by: str = "consensus",
    change: Callable[[LanguageField], LanguageField] = lambda field: field,
    *,
    refuses: bool = False,
    level: bool = False,
    **query: Any,
) -> Method:
    """jsecon's answers by regions of `by`, its field changed, or asked with other options `query` of `query_anchored`.
    Unless it `refuses`, no text is refused. `level`: with the figures of `refusal` beside."""

    def row(setting: Setting, steps: Steps) -> Answers:
        field = change(field_of(setting, by=by))
        options = {"retrieval_threshold": None if refuses else NO_REFUSAL, **query}

        def select(k: int) -> Selection:
            found = query_anchored(field, jnp.asarray(setting.texts[k]), **options)
            kept = remove_outliers(np.asarray(setting.evidence.gaussians.means), np.asarray(found.mask))
            return dataclasses.replace(found, mask=jnp.asarray(kept))

        return Answers(select, lambda: np.zeros(0, np.int32), beside=refusal(setting, field) if level else {})

    return row


ROWS: dict[str, Method] = {
    AS_IT_IS: rule(level=True),
    "region by the plain cosine": rule(retrieval="cosine"),
    "evidence does not count": rule(change=without_evidence),
    "no pieces": rule(piece_nearness=None),
    "pieces at 0.25 of the way": rule(piece_nearness=0.25),
    "pieces at 0.75 of the way": rule(piece_nearness=0.75),
    "none alike": rule(alike_threshold=None),
    "all regions that answer": own("consensus", "contrast", "threshold", way="all"),
    "parts that answer": own("consensus", "contrast", "threshold", way="parts"),
    "parts where no region answers": own("consensus", "contrast", "threshold", instead=True),
    "refusing below the constant": rule(refuses=True),
    "by the plain cosine, refusing below the constant": rule(retrieval="cosine", refuses=True),
    TRACKS: rule("tracks"),
    "tracks, region by the plain cosine": rule("tracks", retrieval="cosine"),
    "tracks, evidence does not count": rule("tracks", without_evidence),
    "tracks, no pieces": rule("tracks", piece_nearness=None),
    "tracks, none alike": rule("tracks", alike_threshold=None),
}


def best_scores(field: LanguageField, texts: np.ndarray, retrieval: str) -> np.ndarray:
    """(Q,) the similarity of each text's best region."""
    given = (jnp.asarray(a) for a in (field.regions.embeddings, field.canonical, field.regions.pixels))
    return np.asarray(_best(*given, jnp.asarray(texts, jnp.float32), retrieval))


def _best_body(embeddings, canonical, pixels, texts, retrieval):
    score, known = jax.vmap(lambda text: answers(embeddings, text, canonical, pixels, retrieval))(texts)
    return jnp.where(known, score, -jnp.inf).max(1)


_best = jax.jit(_best_body, static_argnames="retrieval")


def refusal(setting: Setting, field: LanguageField) -> dict[str, float]:
    """Shares of the texts of what is there that are kept, and of what is not that are refused, by each threshold; and
    how often a text of the first kind is more similar to its best region than one of the second."""
    absent = twins.absent_texts(setting.bench, setting.folder.parent, setting.level, setting.seed)
    told = {}
    for retrieval, constant in CONSTANTS.items():
        present, beside = (best_scores(field, texts, retrieval) for texts in (setting.texts, absent))
        reference, refused = beside[: len(beside) // 2], beside[len(beside) // 2 :]
        cuts = {f"{constant:g}": constant} | {f"q {q:g}": float(np.quantile(reference, q)) for q in QUANTILES}
        for name, cut in cuts.items():
            told[f"{retrieval} {name}: kept"] = float((present >= cut).mean())
            told[f"{retrieval} {name}: refused"] = float((refused < cut).mean())
        told[f"{retrieval}: ordered"] = float((present[:, None] > refused).mean())
    return told


def report(cells: list[dict], level: str) -> tuple[str, dict]:
    """Markdown tables of one level, and its figures."""
    of = lambda row: [cell for cell in cells if cell["method"] == row]
    told, rows = {}, []
    for row in ROWS:
        base = TRACKS if row.startswith("tracks") else AS_IT_IS
        means = [float(np.mean([cell[figure] for cell in of(row)])) for figure in FIGURES]
        apart = [ahead(by_text(of(row), n), by_text(of(base), n)) for n in range(len(FIGURES))]
        told[row] = {"mean": means, "more": apart}
        columns = [(f"{mean:.3f}", f"{d[0]:+.3f} [{d[1]:+.3f}, {d[2]:+.3f}]") for mean, d in zip(means, apart)]
        rows.append((row, *(value for pair in columns for value in pair)))
    heads = [head for figure in FIGURES for head in (figure, "more than as it is [95 %]")]
    names = [name for name in of(AS_IT_IS)[0] if name.endswith(("kept", "refused", "ordered"))]
    told["refusal"] = {name: float(np.mean([cell[name] for cell in of(AS_IT_IS)])) for name in names}
    cuts = [name.removesuffix(": kept") for name in names if name.endswith("kept")]
    shares = [(cut, told["refusal"][f"{cut}: kept"], told["refusal"][f"{cut}: refused"]) for cut in cuts]
    ordered = "; ".join(f"{name} {told['refusal'][name]:.3f}" for name in names if name.endswith("ordered"))
    second = results.table((f"{level}: threshold", "present kept", "absent refused"), shares)
    return f"{results.table((level, *heads), rows)}\n\n{second}\n\nPresent above absent: {ordered}.", told


def main(asked: Asked, processes: int) -> str:
    """The tables, written."""
    table = lerf.QUICK if asked.quick else lerf.PLAN
    data = dataclasses.replace(table.data, scenes=table.data.scenes if asked.quick else asked.scenes, seeds=asked.seeds)
    place = {"out": asked.out, "cells": str(Path(asked.out) / "cells.jsonl")}
    parts, kept = [], {}
    for level in asked.levels:
        options = {"methods": tuple(ROWS), "level": level, "sweep": (), "processes": processes}
        plan = dataclasses.replace(table, data=data, **options, **place)
        try:
            cells = fill(plan, ROWS, tell=lambda line: print(line, flush=True))
        except SystemExit:  # of a helper, which has no table to write
            continue
        text, kept[level] = report(cells, level)
        parts.append(text)
        print(text, flush=True)
    if processes:
        results.save(Path(asked.out), asked, kept, "\n\n".join(parts))
    return "\n\n".join(parts)


if __name__ == "__main__":
    parser = twins_asked("rules", "one tiny scene, one seed")
    parser.add_argument("--levels", nargs="+", default=["medium", "high", "shared"])
    parser.set_defaults(scenes=list(lerf.PLAN.data.scenes), seeds=[0, 1])
    given = parser.parse_args()
    seeds, levels = ((0,), ("shared",)) if given.quick else (tuple(given.seeds), tuple(given.levels))
    main(Asked(tuple(given.scenes), seeds, levels, given.quick, place_of(given, "rules")), given.processes)
