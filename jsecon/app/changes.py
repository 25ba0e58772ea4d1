"""`jsecon changes` and `jsecon update`: what changed, as JSON, a table, and a page with pictures and a plan."""

import datetime
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jsecon.app import pictures, report, verbs
from jsecon.app.comparison import LONG_SIDE, Changes, frames_capture, splat_capture
from jsecon.app.opening import locate_field
from jsecon.app.records import world_record
from jsecon.app.scene import Scene, open_scene
from jsecon.change.detect import KINDS
from jsecon.errors import InputError, require
from jsecon.field.ledger import Ledger
from jsecon.files import FIELD_FILE, csv_text, exclusive_lock, parse_json, reading, write_text
from jsecon.numerics import axes_across
from jsecon.pipeline.new_frames import read_frames
from jsecon.pipeline.options import is_bare_scene, read_date, require_writable
from jsecon.pipeline.progress import Console
from jsecon.pipeline.scene_files import read_scene
from jsecon.read.captures.capture import load_capture, lone_photographs, taken_on
from jsecon.splat.sh import C0
from jsecon.types import Capture, LanguageField, Progress
from jsecon.views.frame import field_up

_COLOURS = {"moved": (40, 110, 230), "gone": (220, 50, 60), "new": (20, 150, 80), "look": (190, 120, 20)}
"""RGB of the kinds of changes."""


def _changes(verb: verbs.Changes, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon changes`; the result has the records of the changes."""
    require_writable(verb.out)
    if verb.transform is not None and not is_bare_scene(verb.photos):
        raise InputError("--transform", "photographs have poses", remedy="Leave it out: it is for a file of Gaussians.")
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    return _write_changes(verb, scene, verb.out, console, verb.transform)[1]


def _write_changes(
    verb: verbs.Changes | verbs.Update, scene: Scene, out: Path, console: Console, transform: Path | None = None
) -> tuple[Changes, verbs.VerbResult]:
    """Compares a scene with photographs or other Gaussians; prints what changed, and writes changes.json, .csv, .html.

    The errors of the result are those of photographs that cannot be placed.
    """
    refused: list[InputError] = []
    with console.progress("photographs") as progress:
        if is_bare_scene(verb.photos):
            capture = splat_capture(scene.field, read_scene(verb.photos)[0], _read_similarity(transform))
        elif lone_photographs(verb.photos):
            capture = _placed_capture(scene.field, scene.ledger, verb.photos, refused, progress)
        else:
            capture = load_capture(verb.photos, long_side=LONG_SIDE, holdout=0, progress=progress)
    with console.progress("changes"):
        changes = scene.changes(capture)
    records = changes.records()
    for record in records:
        if record["kind"] not in ("same", "not seen"):
            console.print_line(_words(record))
    count = {kind: sum(record["kind"] == kind for record in records) for kind in KINDS}
    console.print_line(", ".join(f"{number} {kind}" for kind, number in count.items() if number) or "no objects")
    files = {name: out / f"changes.{name}" for name in ("json", "csv", "html")}
    content = {"frame": "the capture's world", "changes": records} | world_record(changes.field)
    write_text(files["json"], json.dumps(content, indent=2) + "\n")
    write_text(files["csv"], _table(records))
    with console.progress("pictures"):
        write_text(files["html"], _page(changes))
    console.print_line(f"pictures  {files['html']}")
    return changes, {"changes": records, "written": files, "errors": refused}


def _placed_capture(
    field: LanguageField, ledger: Ledger, photos: Path, refused: list[InputError], progress: Progress
) -> Capture:
    """Places photographs without poses by the pictures of a field's ledger; `refused` gets the errors of the others."""
    placed = read_frames(field, ledger, photos, None, refused.append, progress)
    if not placed:
        raise refused.pop()
    return frames_capture(field, placed)


def _read_similarity(file: Path | None) -> np.ndarray:
    """Reads a 4x4 similarity from a text file; without one it is the identity."""
    if file is None:
        return np.eye(4)
    with reading(file, "4 rows of 4 numbers: rotation times scale, and shift", "Check it."):
        matrix = np.loadtxt(file).reshape(4, 4)
        turn = matrix[:3, :3] / max(np.cbrt(np.linalg.det(matrix[:3, :3])), 1e-12)
        require(np.allclose(turn @ turn.T, np.eye(3), atol=1e-3), "matrix", "no similarity", "one", "Check it.")
    return matrix


def _update(verb: verbs.Update, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon update`; the result has the records of the changes."""
    out = locate_field(verb.field).file.parent if verb.out is None else verb.out
    require_writable(out)
    if is_bare_scene(verb.photos):
        raise InputError(verb.photos, "a file of Gaussians", "photographs", "jsecon changes compares two of them.")
    date, origin = verb.date, "--date"
    if date is None:
        date, origin = taken_on(verb.photos), "the photographs"
    if date is None:
        date, origin = datetime.date.today().isoformat(), "today, as the photographs have no date"
    read_date(date)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    if "ledger" in parse_json(scene.field.provenance):
        _ = scene.ledger  # a missing file stops here, before the work
    changes, result = _write_changes(verb, scene, out, console)
    updated, path = scene.update(changes, date=date), out / FIELD_FILE
    with exclusive_lock(out), console.progress("write"):
        updated.save(path)
    if unsure := sum(change.kind == "unsure" for change in changes.found):
        count = len(changes.found)
        console.print_line(f"unsure  {unsure} of {count} objects stay as they were: more photographs decide")
    console.print_line(f"date    {date} ({origin})\nfield   {path}")
    return result | {"date": date, "written": {**result["written"], "field": path}}


def _words(record: dict[str, Any]) -> str:
    """Says in a line what changed, or what may have changed."""
    name, doubt = record["name"] or "something", record.get("suspected")
    title = f"{record['kind']:>6}  {name}" + ("" if record["id"] is None else f" (object {record['id']})")
    places = [", ".join(f"{x:.2f}" for x in place) for place in (record["from"], record["to"]) if place is not None]
    words = f"from ({places[0]}) to ({places[1]})" if len(places) == 2 else f"at ({places[0]})"
    if doubt:
        words = f"perhaps {doubt}, {words}; too little shows it"
    if "moved" in (record["kind"], doubt):
        words += f", by {record['distance']:.2f}, turned by {record['turned_degrees']:.0f} degrees"
    return f"{title}: {words}, probability {record['probability']:.2f}, seen in {', '.join(record['frames'][:3])}"


def _table(records: list[dict[str, Any]]) -> str:
    """The records as CSV, a coordinate a column."""
    ends = {end: [f"{end}_{axis}" for axis in "xyz"] for end in ("from", "to")}
    names = ("kind", "name", "id", "region", "probability", "suspected", "distance", "turned_degrees")
    rows = [record | {"frames": " ".join(record["frames"])} for record in records]
    rows = [row | dict(pair for end in ends for pair in zip(ends[end], row[end] or ())) for row in rows]
    return csv_text((*names, *ends["from"], *ends["to"], "frames"), rows)


def _page(changes: Changes) -> str:
    """The page of changes: a plan from above, and before and after of each."""
    records, cards = changes.records(), []
    plan = report.figure(_draw_plan(changes), "From above: blue moved, red gone, green new, brown another look.")
    for change, record in zip(changes.found, records):
        if change.kind not in _COLOURS or not change.frames:
            continue
        shown = change.before if change.before.any() else change.after
        t = max(change.frames, key=lambda t: int(shown[t].sum() + change.after[t].sum()))
        camera = changes.capture.cameras[t]
        images = pictures.render_picture(changes.field.gaussians, camera), np.asarray(changes.capture.frames[t])
        colour = _COLOURS[change.kind]
        outlined = [
            pictures.outlined(image, mask, colour, 2)
            for image, mask in zip(images, (change.before[t], change.after[t]))
        ]
        pair = [report.figure(image, words) for image, words in zip(outlined, ("before", changes.capture.names[t]))]
        title, _, words = " ".join(_words(record).split()).partition(": ")
        cards.append(report.section(title, words, report.grid(pair, 2)))
    others = [r for r in records if r["kind"] not in _COLOURS]
    doubts = [f" ({r['suspected']}?)" if "suspected" in r else "" for r in others]
    rest = [(r["name"], r["id"], r["kind"] + doubt, r["probability"]) for r, doubt in zip(others, doubts)]
    table = report.table(("object", "id", "", "probability"), rest)
    lead = f"{len(cards)} changes, {len(rest)} other objects, by {len(changes.capture.names)} photographs."
    parts = [report.section("Plan", "", report.grid([plan], 2)), *cards, report.section("Other objects", "", table)]
    return report.page("Changes", lead, parts)


def _draw_plan(changes: Changes) -> np.ndarray:
    """Draws the scene from above, with a mark of each change and an arrow of what moved."""
    field, listed = changes.field, changes.catalogue
    things = np.append(~listed.surroundings, False)[listed.labels]
    up = np.array(field_up(field).axis)
    flat = axes_across(up).T
    means = np.asarray(field.gaussians.means, np.float64)
    middle = np.quantile(means[things if things.any() else ...] @ flat, [0.01, 0.99], axis=0)
    near = np.stack([*middle, *(end @ flat for change in changes.found for end in (change.start, change.place))])
    low, high = near.min(0), near.max(0)
    margin = 0.15 * (high - low).max()
    side = 700  # px, the longer one
    scale = side / ((high - low).max() + 2 * margin)
    width, height = np.ceil((high - low + 2 * margin) * scale).astype(int)

    def place(point):
        x, y = (point @ flat - low + margin) * scale
        return round(x), height - 1 - round(y)

    image = np.full((height, width, 3), 245, np.uint8)
    shown = (0.45 * np.clip(0.5 + C0 * np.asarray(field.gaussians.sh)[:, 0], 0, 1) + 0.55) * 255
    heights = means @ up
    top = heights[things].max() if things.any() else np.inf
    for n in np.argsort(heights)[: np.sum(heights <= top)]:
        cv2.circle(image, place(means[n]), 4, shown[n].tolist(), -1)
    for change in changes.found:
        if change.kind in _COLOURS:
            colour, end = _COLOURS[change.kind], place(change.place)
            if change.kind == "moved":
                cv2.arrowedLine(image, place(change.start), end, colour, 3, cv2.LINE_AA, tipLength=0.12)
            cv2.circle(image, end, 14, colour, 3, cv2.LINE_AA)
    return image
