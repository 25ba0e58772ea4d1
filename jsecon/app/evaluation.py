"""How well a field answers texts: each kind of query against labels, by the point-level rendered protocol."""

import dataclasses
import json
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from jsecon.app import verbs
from jsecon.app.models import open_embedder
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError
from jsecon.evaluate.lerf import Row, evaluate_at_thresholds
from jsecon.files import write_text
from jsecon.paper.autoencoder import encode
from jsecon.paper.queries import query_canonical, query_one_step
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console, Listener
from jsecon.query.expressions import parse_query
from jsecon.query.render import ALPHA_THRESHOLD
from jsecon.query.select import codes_of
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels
from jsecon.types import Selection

Evaluation: TypeAlias = dict[str, tuple[list[Row], dict[str, Any]]]
"""kind of query -> its pairs, and their summary"""

KINDS: dict[str, dict[str, Any]] = {
    "anchored": {"by": "votes"},
    "all": {"all_of_class": True},
    "anchored_code": {"by": "code"},
}
"""kind of query -> options of `Scene.ask`"""
BASELINES = ("one_step", "canonical")
"""kinds of queries that compare the code of each Gaussian with a text"""
ONE_STEP_THRESHOLD = 0.8
"""on the cosine of a Gaussian's code and the text's"""
CANONICAL_THRESHOLD = 0.5
"""on the relevancy: nearer to the text than to every canonical phrase"""


def evaluate(
    scene: Scene, labels: Sequence[LabelledFrame], listener: Listener, kinds: Sequence[str] | None = None
) -> Evaluation:
    """Measures kinds of queries.

    Args:
      scene: The scene. A text that its embedder has no words for counts as 0.
      labels: Masks of named objects in frames of the field.
      listener: Receives the progress.
      kinds: Names in `KINDS` and `BASELINES`; None takes all that the field has data for.

    Returns:
      Pairs and summary of each kind.
    """
    field = scene.field
    cameras = {name: field.cameras[t] for t, name in enumerate(field.names)}
    results = {}
    by_votes = [kind for kind in KINDS if KINDS[kind].get("by") != "code"]
    for kind in kinds or (by_votes if field.codes is None else (*KINDS, *BASELINES)):

        def select(text: str, kind: str = kind) -> Selection | None:
            try:
                if kind in BASELINES:
                    return _select_by_code(scene, text, kind)
                answer = scene.ask(text, **KINDS[kind])
            except InputError:  # no words for it
                return None
            return dataclasses.replace(answer.selection, mask=answer.mask)

        with listener.progress(f"evaluate {kind}") as progress:
            options = {"alpha_thresholds": (ALPHA_THRESHOLD,), "progress": progress}
            measured = evaluate_at_thresholds(field.gaussians, cameras, labels, select, **options)
            results[kind] = measured[ALPHA_THRESHOLD]
    return results


def _select_by_code(scene: Scene, text: str, kind: str) -> Selection:
    """Selects the Gaussians whose codes are similar to that of a text: by a kind of BASELINES, without regions."""
    field = scene.text_field
    texts = parse_query(text).included
    codes = codes_of(field)
    code = encode(codes.autoencoder, jax.device_put(scene.embedder.embed_text(texts[:1])[0]))
    if kind == "one_step":
        return query_one_step(codes.gaussians, code, ONE_STEP_THRESHOLD)
    canonical = encode(codes.autoencoder, jnp.asarray(field.canonical_phrases))
    return query_canonical(codes.gaussians, code, canonical, CANONICAL_THRESHOLD)


def _eval(verb: verbs.Eval, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon eval`: prints the table, and writes OUT/evaluation.json with every pair."""
    out = verb.out or verb.field.parent
    require_writable(out)
    with console.progress("field"):
        scene = open_scene(verb.field, embedder=lambda field: open_embedder(field, verb, console))
        _ = scene.embedder  # else its absence would count as 0 for every text
    results = evaluate(scene, load_lerf_labels(verb.labels), console)
    print_table(results, console)
    pairs = {kind: summary | {"rows": [_plain(row) for row in rows]} for kind, (rows, summary) in results.items()}
    write_text(out / "evaluation.json", json.dumps(pairs, indent=2) + "\n")
    console.say(f"all pairs  {out / 'evaluation.json'}")
    return {"written": {"pairs": out / "evaluation.json"}} | {kind: summary for kind, (_, summary) in results.items()}


def _plain(row: Row) -> dict[str, Any]:
    """Returns a row without its mask as plain values."""
    values = {name: getattr(row, name) for name in ("frame", "query", "iou", "located", "selected", "region", "score")}
    return values | {"iou": round(row.iou, 4), "score": round(row.score, 4)}


def print_table(results: Evaluation, listener: Listener) -> None:
    """Prints the protocol, and mIoU, mAcc@0.25 and localisation accuracy of each kind of query.

    Args:
      results: What `evaluate` returned.
      listener: Receives the lines.
    """
    _, first = next(iter(results.values()))
    listener.say(
        f"{first['protocol']}\n{first['pairs']} pairs of {first['queries']} queries in {first['frames']} frames"
    )
    listener.say(f"  {'query':<14} {'mIoU':>6} {'mAcc@0.25':>10} {'Loc. acc.':>10} {'missing':>8}")
    for kind, (_, summary) in results.items():
        shares = f"{summary['miou']:>6.3f} {summary['macc']:>10.3f} {summary['loc_acc']:>10.3f}"
        listener.say(f"  {kind:<14} {shares} {summary['missing']:>8}")
