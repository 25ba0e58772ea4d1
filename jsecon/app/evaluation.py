"""How well a field answers texts: each kind of query against labels, by the point-level rendered protocol."""

import dataclasses
import json
from collections.abc import Sequence
from typing import Any, TypeAlias

from jsecon.app import verbs
from jsecon.app.opening import locate_field
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError
from jsecon.evaluate.lerf import Row, evaluate_at_thresholds
from jsecon.files import write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.query.render import ALPHA_THRESHOLD
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels
from jsecon.types import Selection

Evaluation: TypeAlias = dict[str, tuple[list[Row], dict[str, Any]]]
"""kind of query -> its pairs, and their summary"""
KINDS: dict[str, dict[str, Any]] = {
    "anchored": {"by": "votes"},
    "all": {"all_of_class": True},
    "anchored_code": {"by": "code"},
}
"""kind of query -> options of `Scene.ask`; by code only where the field has codes"""


def evaluate(
    scene: Scene, labels: Sequence[LabelledFrame], console: Console, kinds: Sequence[str] = tuple(KINDS)
) -> Evaluation:
    """Measures kinds of queries, and prints mIoU, mAcc@0.25 and localisation accuracy of each.

    A text that the scene's embedder has no words for counts as 0.
    """
    field = scene.field
    cameras = {name: field.cameras[t] for t, name in enumerate(field.names)}
    results = {}
    for kind in kinds:
        options = KINDS[kind]
        if field.codes is None and options.get("by") == "code":
            continue

        def select(text: str, options: dict[str, Any] = options) -> Selection | None:
            [answer] = scene.ask_all([text], **options)
            if isinstance(answer, InputError):  # no words for it
                return None
            return dataclasses.replace(answer.selection, mask=answer.mask)

        with console.progress(f"evaluate {kind}") as progress:
            inputs = field.gaussians, cameras, labels, select
            measured = evaluate_at_thresholds(*inputs, alpha_thresholds=(ALPHA_THRESHOLD,), progress=progress)
            results[kind] = measured[ALPHA_THRESHOLD]
    _, first = next(iter(results.values()))
    counts = f"{first['pairs']} pairs of {first['queries']} queries in {first['frames']} frames"
    console.print_line(f"{first['protocol']}\n{counts}")
    console.print_line(f"  {'query':<14} {'mIoU':>6} {'mAcc@0.25':>10} {'Loc. acc.':>10} {'missing':>8}")
    for kind, (_, summary) in results.items():
        shares = f"{summary['miou']:>6.3f} {summary['macc']:>10.3f} {summary['loc_acc']:>10.3f}"
        console.print_line(f"  {kind:<14} {shares} {summary['missing']:>8}")
    return results


def _eval(verb: verbs.Eval, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon eval`: prints the table, and writes OUT/evaluation.json with every pair."""
    out = verb.out or locate_field(verb.field).file.parent
    require_writable(out)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    with console.progress("model"):
        _ = scene.embedder  # else its absence would count as 0 for every text
    results = evaluate(scene, load_lerf_labels(verb.labels), console)
    names = ("frame", "query", "iou", "located", "selected", "region", "score")
    pairs = {
        kind: summary | {"rows": [{name: getattr(row, name) for name in names} for row in rows]}
        for kind, (rows, summary) in results.items()
    }
    write_text(out / "evaluation.json", json.dumps(pairs, indent=2) + "\n")
    console.print_line(f"all pairs  {out / 'evaluation.json'}")
    return {"written": {"pairs": out / "evaluation.json"}} | {kind: summary for kind, (_, summary) in results.items()}
