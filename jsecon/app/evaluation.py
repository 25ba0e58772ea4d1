"""How well a field answers texts, against labels."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jsecon.app import ask
from jsecon.data.labels import LabelledFrame, load_lerf_labels
from jsecon.errors import InputError
from jsecon.evaluate.lerf import Row, evaluate_point_level_rendered
from jsecon.files import write_text
from jsecon.pipeline.progress import Listener
from jsecon.types import LanguageField, Selection

KINDS: dict[str, dict[str, Any]] = {
    "anchored": {"by": "votes"},
    "silhouette": {"by": "silhouette"},
    "all": {"several": True},
    "anchored_code": {"by": "code"},
    "one_step": {"by": "one_step"},
    "canonical": {"by": "canonical"},
}
"""kind of query in metrics.json -> how jsecon.app.ask asks"""


def evaluate(
    field: LanguageField,
    embedder: Any,
    labels: Sequence[LabelledFrame],
    listener: Listener,
    kinds: Sequence[str] = tuple(KINDS),
) -> dict[str, tuple[list[Row], dict[str, Any]]]:
    """Rows and summary of each kind of query under the point-level rendered protocol."""
    cameras = {name: field.cameras[t] for t, name in enumerate(field.names)}
    found = {}
    for kind in kinds:

        def select(text: str, how: dict[str, Any] = KINDS[kind]) -> Selection | None:
            try:
                asked = ask.ask_text(field, embedder, text, **how)
            except InputError:  # no words for it: no answer, which counts as 0
                return None
            return dataclasses.replace(asked.selection, mask=asked.mask)

        with listener.progress(f"evaluate {kind}") as progress:
            found[kind] = evaluate_point_level_rendered(field.gaussians, cameras, labels, select, progress=progress)
    return found


def write_evaluation(
    field: LanguageField, embedder: Any, folder: Path, out: Path, listener: Listener
) -> dict[str, Any]:
    """Prints the table and writes OUT/evaluation.json, with every pair; returns the table's figures."""
    found = evaluate(field, embedder, load_lerf_labels(folder), listener)
    print_table(found, listener)
    told = {kind: summary | {"rows": [pair(row) for row in rows]} for kind, (rows, summary) in found.items()}
    write_text(out / "evaluation.json", json.dumps(told, indent=2) + "\n")
    listener.say(f"all pairs  {out / 'evaluation.json'}")
    return {"written": {"pairs": out / "evaluation.json"}} | {kind: summary for kind, (_, summary) in found.items()}


def pair(row: Row) -> dict[str, Any]:
    """A row without its mask, as plain values."""
    return {
        "frame": row.frame,
        "query": row.query,
        "iou": round(row.iou, 4),
        "located": row.located,
        "selected": row.selected,
        "region": row.region,
        "score": round(row.score, 4),
    }


def print_table(found: dict[str, tuple[list[Row], dict[str, Any]]], listener: Listener) -> None:
    """mIoU, mAcc@0.25 and localisation of each kind, with the protocol they were measured under."""
    told = next(iter(found.values()))[1]
    listener.say(f"{told['protocol']}\n{told['pairs']} pairs of {told['queries']} queries in {told['frames']} frames")
    listener.say(f"  {'query':<14} {'mIoU':>6} {'mAcc@0.25':>10} {'Loc. acc.':>10} {'missing':>8}")
    for kind, (_, told) in found.items():
        shares = f"{told['miou']:>6.3f} {told['macc']:>10.3f} {told['loc_acc']:>10.3f}"
        listener.say(f"  {kind:<14} {shares} {told['missing']:>8}")
