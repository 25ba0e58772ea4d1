"""Each rule of retrieval on and off, at several levels: which of them hold where views share their errors?

    python -m experiments.rules [--scenes NAME ...] [--seeds 0 1] [--levels medium high shared] [--quick]

Twins of LERF, their points as Gaussians, one each: nothing is fitted or rendered. A row changes one rule of
`jsecon query`. The first row has all rules as they are, and refuses no text. An answer is judged at the points: its IoU
with the points that the true masks of all views put into the object.

Then refusal: texts of the scene, and of names that nothing in it has (`twins.absent_texts`), are held against
thresholds on the similarity of their best region. The thresholds are constants, or quantiles of the similarities of
reference words in the same field. One half of the absent names are the reference words, the other half are refused.
The rows "jsecon query" refuse as the command does, by its own unrelated words and all absent names.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import lerf, results
from experiments.baselines.evidence import Evidence
from experiments.cells import append_cell, read_cells
from experiments.fair import ahead
from experiments.memory_maps import clear_programs
from experiments.tables import twins
from experiments.tables.association import associated
from experiments.tables.ours import field_of
from experiments.tables.setting import Setting
from jsecon.field.evidence import region_votes
from jsecon.query.answer import match_regions, query_anchored, query_several
from jsecon.query.outliers import remove_outliers
from jsecon.query.rules import MIN_COSINE, STATES, QueryRules
from jsecon.splat.points import gaussians_from_points
from jsecon.types import LanguageField

AS_IT_IS = "as it is"
NO_REFUSAL = -1.0
"""below every similarity"""
FULL_PX = 1000
"""Factor on the pixels of a region that gives it full evidence."""
LEAST = 5
"""points of an object that is judged"""
QUANTILES = (0.8, 0.9, 0.95, 0.98)
"""of the reference words' similarities with their best regions, above which a text is answered"""
CONSTANTS = {"cosine": MIN_COSINE}


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    data: tyro.conf.Suppress[twins.Data] = lerf.PLAN.data
    scenes: tuple[str, ...] = lerf.PLAN.data.scenes
    """Twins of LERF."""
    seeds: tuple[int, ...] = (0, 1)
    levels: tuple[str, ...] = ("medium", "high", "shared")
    quick: bool = False
    """Run one tiny scene at one level."""
    out: str = ""


QUICK = {"data": lerf.QUICK.data, "scenes": lerf.QUICK.data.scenes, "seeds": (0,), "levels": ("shared",)}


def on_points(data: twins.Data, scene: str, seed: int, level: str) -> tuple[Setting, np.ndarray]:
    """A twin under simulated vision of a level with its points as Gaussians, and the true object of each point (N,), -1
    where most of its weight lies on none. The twin's files are those of "medium", of which the frames are taken."""
    root = data.place(scene, seed, "medium")
    bench = data.load(root, scene)
    names, frames, truth, (seen, *_), embedder = twins.sight(bench, root, level, seed)
    masks, rows, owners = np.full(truth.shape, -1, np.int32), [], []
    for t, image in enumerate(seen.labels):
        here = np.unique(image[image >= 0])
        masks[t] = np.where(image >= 0, len(owners) + np.searchsorted(here, image), -1)
        rows.append(embedder.embed_regions(frames[t], image[None] == here[:, None, None]))
        owners += [t] * len(here)
    capture = bench.capture
    gaussians = gaussians_from_points(capture.points, capture.point_colors, opacity=0.8, scale=0.4)
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    cameras = jax.tree.map(jnp.asarray, capture.cameras[np.flatnonzero(~np.asarray(capture.held_out))])
    tracks = np.asarray(seen.labels, np.int32)
    evidence = Evidence(gaussians, cameras, masks, np.concatenate(rows), np.array(owners), tracks)
    texts, levels = embedder.embed_text(list(bench.queries)), (evidence,)
    known = (bench, evidence, frames, levels, associated(levels, tracks), texts, embedder.canonical_phrases)
    setting = Setting(*known, {}, tuple(names), seed, root / scene, level, embedder.unrelated_words)
    votes = region_votes(gaussians, cameras, jnp.asarray(truth, jnp.int32), int(truth.max()) + 1)
    inside, outside = np.asarray(votes.weights[:, 0]), np.asarray(votes.total - votes.labelled)
    return setting, np.where(inside > outside, np.asarray(votes.regions[:, 0]), -1)


Row = Callable[[Setting, LanguageField, int], Any]
"""the setting, its field and the number of a query -> a Selection"""


def anchored(change: Callable[[LanguageField], LanguageField] = lambda field: field, **query: Any) -> Row:
    """A field that is changed, asked by other rules `query`."""
    rules = QueryRules(**{"min_score": NO_REFUSAL, **query})
    return lambda setting, field, k: query_anchored(change(field), jnp.asarray(setting.texts[k]), rules=rules)


def without_evidence(field: LanguageField) -> LanguageField:
    """A field whose regions have full evidence in each view that shows them."""
    return dataclasses.replace(
        field, regions=dataclasses.replace(field.regions, pixel_counts=FULL_PX * field.regions.pixel_counts)
    )


def every_region(setting: Setting, field: LanguageField, k: int) -> Any:
    """All regions that answer."""
    rules = QueryRules(all_of_class=True, min_score=NO_REFUSAL)
    return query_several(field, jnp.asarray(setting.texts[k])[None], rules=rules)


ROWS: dict[str, Row] = {
    AS_IT_IS: anchored(),
    "the region by the plain cosine": anchored(retrieval="cosine"),
    "a few pixels are evidence enough": anchored(without_evidence),
    "no pieces": anchored(fragment_score=None),
    "pieces at 0.25 of the way": anchored(fragment_score=0.25),
    "pieces at 0.75 of the way": anchored(fragment_score=0.75),
    "none alike": anchored(duplicate_cosine=None),
    "all regions that answer": every_region,
    "refusing by the constant": anchored(min_score=None),
    "by the plain cosine, refusing by its constant": anchored(retrieval="cosine", min_score=None),
}


def measure(data: twins.Data, scene: str, seed: int, level: str) -> dict:
    """{"consensus": {row: {text: IoU}}, "tracks": {...}, "refusal": shares} of one setting."""
    setting, truth = on_points(data, scene, seed, level)
    names = twins.objects_of(setting.bench, setting.folder.parent)
    means = np.asarray(setting.evidence.gaussians.means)
    told: dict[str, dict] = {}
    for by in ("consensus", "tracks"):
        field = field_of(setting, by=by)
        told[by] = {}
        for row in ROWS:
            told[by][row] = {}
            for k, query in enumerate(setting.bench.queries):
                own = truth == names.index(query)
                if own.sum() >= LEAST:
                    kept = remove_outliers(means, np.asarray(ROWS[row](setting, field, k).mask), keep="largest")
                    told[by][row][query] = round(float((kept & own).sum() / (kept | own).sum()), 4)
        if by == "consensus":
            told["refusal"] = refusal(setting, field)
        told["refusal"] |= default_refusal(setting, field, by)
    return told


def default_refusal(setting: Setting, field: LanguageField, by: str) -> dict[str, float]:
    """Shares of the present texts that `jsecon query` answers by default, and of the absent ones that it refuses: those
    that are absent, and those that are not found."""
    absent = twins.words_of(setting.bench, setting.folder.parent, setting.level, setting.seed).absent

    def states(texts):
        return np.array([int(match_regions(field, jnp.asarray(text)[None]).state) for text in texts])

    kept, refused, told = states(setting.texts), states(absent), {}
    for least in (1, 2):
        name = f"jsecon query, {by}, {' or '.join(STATES[least:])}"
        told |= {f"{name}: kept": float(np.mean(kept >= least)), f"{name}: refused": float(np.mean(refused < least))}
    return told


def best_scores(field: LanguageField, texts: np.ndarray, retrieval: str) -> np.ndarray:
    """(Q,) the similarity of each text's best region."""
    rules = QueryRules(retrieval=retrieval, min_score=NO_REFUSAL)
    return np.array([float(match_regions(field, jnp.asarray(text)[None], rules).score) for text in texts])


def refusal(setting: Setting, field: LanguageField) -> dict[str, float]:
    """Shares of the texts of what is there that are kept, and of what is not that are refused, by each threshold; and
    how often a text of the first kind is more similar to its best region than one of the second."""
    absent = twins.words_of(setting.bench, setting.folder.parent, setting.level, setting.seed).absent
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


def report(found: dict[tuple, dict], level: str) -> tuple[str, dict]:
    """Markdown tables of one level, and its figures."""
    here = {where: told for where, told in found.items() if where[2] == level}

    def by_text(by, row):
        return {(*where, text): value for where, told in here.items() for text, value in told[by][row].items()}

    kept, rows = {}, []
    for by in ("consensus", "tracks"):
        for row in next(iter(here.values()))[by]:
            values, apart = by_text(by, row), ahead(by_text(by, row), by_text(by, AS_IT_IS))
            kept[f"{by}: {row}"] = {"mean": float(np.mean(list(values.values()))), "more": apart}
            rows.append((by, row, kept[f"{by}: {row}"]["mean"], f"{apart[0]:+.3f} [{apart[1]:+.3f}, {apart[2]:+.3f}]"))
    text = results.table((f"{level}: regions by", "rule", "mean IoU", "more than as it is [95 %]"), rows)
    names = list(next(iter(here.values()))["refusal"])
    shares = {name: float(np.mean([told["refusal"][name] for told in here.values()])) for name in names}
    kept["refusal"] = shares
    cuts = [name.removesuffix(": kept") for name in names if name.endswith("kept")]
    lines = [(cut, shares[f"{cut}: kept"], shares[f"{cut}: refused"]) for cut in cuts]
    ordered = ", ".join(f"{name.split(':')[0]} {shares[name]:.3f}" for name in names if name.endswith("ordered"))
    second = results.table((f"{level}: threshold", "present kept", "absent refused"), lines)
    return f"{text}\n\n{second}\n\nA present text is above an absent one: {ordered}.", kept


def main(options: Options) -> dict:
    """Runs what is not measured yet, writes the tables and returns the figures by level."""
    file = Path(options.out) / "cells.jsonl"
    kept, parts, found = {}, [], {}
    for level in options.levels:
        for where in ((scene, seed, level) for seed in options.seeds for scene in options.scenes):
            key = f"{'-'.join(map(str, where))}-{dict(options.data.size)}"
            if key not in read_cells(file):
                clear_programs()
                append_cell(file, key, measure(options.data, *where))
                print(*where, "measured", flush=True)
            found[where] = read_cells(file)[key]
        text, kept[level] = report(found, level)
        parts.append(text)
        print(text, flush=True)
    results.save(Path(options.out), options, kept, "\n\n".join(parts))
    return kept


if __name__ == "__main__":
    main(results.read_options(Options, "rules", __doc__, QUICK))
