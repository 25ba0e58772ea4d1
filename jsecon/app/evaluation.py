"""How well a field answers texts: against labels, by the point-level rendered protocol."""

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from jsecon.app import verbs
from jsecon.app.opening import locate_field
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError
from jsecon.evaluate.lerf import Row, evaluate_labels
from jsecon.files import write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels
from jsecon.types import Selection


def evaluate(scene: Scene, labels: Sequence[LabelledFrame], console: Console) -> tuple[list[Row], dict[str, Any]]:
    """Measures the answers to all labelled texts, and prints mIoU, mAcc@0.25 and localisation accuracy.

    A text that the scene's embedder has no words for counts as 0. The result has the pairs, and their summary.
    """

    def select(text: str) -> Selection | None:
        try:
            answer = scene.ask(text)
        except InputError:  # no words for it
            return None
        return dataclasses.replace(answer.selection, mask=answer.mask)

    field = scene.field
    cameras = {name: field.cameras[t] for t, name in enumerate(field.names)}
    with console.progress("evaluate") as progress:
        rows, summary = evaluate_labels(field.gaussians, cameras, labels, select, progress=progress)
    counts = f"{summary['pairs']} pairs of {summary['queries']} queries in {summary['frames']} frames"
    shares = {"mIoU": "miou", "mAcc@0.25": "macc", "localisation accuracy": "loc_acc"}
    figures = ", ".join(f"{name} {summary[key]:.3f}" for name, key in shares.items())
    console.print_line(f"{summary['protocol']}\n{counts}, {summary['missing']} missing\n{figures}")
    return rows, summary


def _eval(verb: verbs.Eval, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon eval`: prints the figures, and writes OUT/evaluation.json with every pair."""
    out = verb.out or locate_field(verb.field).file.parent
    require_writable(out)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    with console.progress("model"):
        _ = scene.embedder  # else its absence would count as 0 for every text
    rows, summary = evaluate(scene, load_lerf_labels(verb.labels), console)
    names = ("frame", "query", "iou", "located", "selected", "region", "score")
    pairs = [{name: getattr(row, name) for name in names} for row in rows]
    write_text(out / "evaluation.json", json.dumps(summary | {"rows": pairs}, indent=2) + "\n")
    console.print_line(f"all pairs  {out / 'evaluation.json'}")
    return {"written": {"pairs": out / "evaluation.json"}} | summary
