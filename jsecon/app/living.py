"""The verbs of a field that lives: `jsecon add`, `forget`, `changes` and `update`, and the page of changes."""

import collections
import contextlib
import datetime
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jsecon.app import pictures, report, verbs
from jsecon.app.comparison import LONG_SIDE, Changes, splat_capture
from jsecon.app.opening import locate_field
from jsecon.app.records import world_record
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError, join_first
from jsecon.field.field import load_field
from jsecon.field.ledger_file import remove_stale
from jsecon.files import FIELD_FILE, csv_text, exclusive_lock, reading, remove_files, write_text
from jsecon.numerics import axes_across
from jsecon.pipeline.new_frames import read_frames
from jsecon.pipeline.options import is_bare_scene, read_date, require_writable
from jsecon.pipeline.progress import Console
from jsecon.pipeline.scene_files import read_scene
from jsecon.read.captures.capture import load_capture, lone_photographs, taken_on
from jsecon.splat.visible import hide
from jsecon.types import Camera
from jsecon.views.frame import field_up

_COLOURS = {"moved": (40, 110, 230), "gone": (220, 50, 60), "new": (20, 150, 80), "look": (190, 120, 20)}
"""RGB of the kinds of changes."""


def _add(verb: verbs.Add, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon add`; photographs that are refused are errors, and the others are added."""
    refused: list[InputError] = []
    with _changing(verb.field, verb.out) as path:
        scene = open_scene(verb.field, embedder=verb.embedder, console=console)
        try:
            grown = scene.add(verb.photos, poses=verb.poses, masks=verb.masks, refused=refused, console=console)
        except InputError as error:
            return {"errors": [*refused, error]}
        with console.progress("write"):
            grown.save(path)
    added = [name for name in grown.field.names if name not in scene.field.names]
    opened = grown.field.regions.count - scene.field.regions.count
    console.print_line(f"added   {join_first(added)}; {opened} new regions\nfield   {path}")
    return {"written": [path], "added": added, "new_regions": opened, "errors": refused}


def _forget(verb: verbs.Forget, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon forget`."""
    with _changing(verb.field, verb.out) as path:
        scene = open_scene(verb.field, console=console)
        with console.progress("votes"):
            less = scene.forget(verb.frames)
        # First: the same command finishes what is left if it is stopped here.
        removed = _remove_traces(path.parent) if verb.out is None else []
        with console.progress("write"):
            less.save(path)
    forgotten = [name for name in scene.field.names if name not in less.field.names]
    console.print_line(f"forgot  {join_first(forgotten)}\nfield   {path}")
    if removed:
        console.print_line(f"removed {', '.join(removed)}, which showed them")
    return {"written": [path], "forgotten": forgotten, "removed": removed}


@contextlib.contextmanager
def _changing(field: Path, out: Path | None) -> Iterator[Path]:
    """Yields the path of the field to write, for one process at a time; what a stopped one left there is removed."""
    old = locate_field(field)
    if old.splat is not None:
        problem = "it is a file of Gaussians, whose views are rendered"
        raise InputError(field, problem, remedy=f"Give its field, {old.file.parent}, or make one of photographs.")
    path = old.file if out is None else out / FIELD_FILE
    require_writable(path.parent)
    with exclusive_lock(path.parent):
        if path.is_file():
            remove_stale(path, load_field(path, mapped=True))
        yield path


def _remove_traces(folder: Path) -> list[str]:
    """Removes what a run keeps of its frames beside the field; returns the names."""
    from jsecon.app.running import FILES, FIRST_VIEW  # late: to add frames needs no run

    names = [name for name in (*FILES[1:], FIRST_VIEW) if (folder / name).is_file()]
    remove_files(folder, names)
    mark = "cache/CACHEDIR.TAG"  # as of a run; beside it `jsecon demo` keeps pictures of its answers
    for place in [place for place in ("cache", "queries") if (folder / mark).is_file() and (folder / place).is_dir()]:
        shutil.rmtree(folder / place)
        names.append(f"{place}/")
    return names


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
            other = read_scene(verb.photos)[0]
            with reading(transform, "4 rows of 4 numbers: rotation times scale, and shift", "Check it."):
                similarity = np.eye(4) if transform is None else np.loadtxt(transform).reshape(4, 4)
                capture = splat_capture(scene.field, other, similarity)
        elif lone_photographs(verb.photos):
            capture = read_frames(scene.field, scene.ledger, verb.photos, None, refused.append, progress)
            if not capture.names:
                raise refused.pop()
        else:
            capture = load_capture(verb.photos, long_side=LONG_SIDE, holdout=0, progress=progress)
    with console.progress("changes"):
        changes = scene.changes(capture)
    records = changes.records()
    for record in records:
        if record["kind"] not in ("same", "not seen"):
            console.print_line(_words(record))
    count = collections.Counter(record["kind"] for record in records)
    console.print_line(", ".join(f"{number} {kind}" for kind, number in count.items()) or "no objects")
    files = {name: out / f"changes.{name}" for name in ("json", "csv", "html")}
    content = {"frame": "the capture's world", "changes": records} | world_record(changes.field)
    write_text(files["json"], json.dumps(content, indent=2) + "\n")
    write_text(files["csv"], _table(records))
    with console.progress("pictures"):
        write_text(files["html"], _page(changes))
    console.print_line(f"pictures  {files['html']}")
    return changes, {"changes": records, "written": files, "errors": refused}


def _update(verb: verbs.Update, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon update`; the result has the records of the changes."""
    if is_bare_scene(verb.photos):
        raise InputError(verb.photos, "a file of Gaussians", "photographs", "jsecon changes compares two of them.")
    date = read_date(verb.date or taken_on(verb.photos) or datetime.date.today().isoformat())
    with _changing(verb.field, verb.out) as path:
        scene = open_scene(verb.field, embedder=verb.embedder, console=console)
        changes, result = _write_changes(verb, scene, path.parent, console)
        with console.progress("write"):
            scene.update(changes, date=date).save(path)
    console.print_line(f"date    {date}\nfield   {path}")
    return result | {"date": date, "written": {**result["written"], "field": path}}


def _words(record: dict[str, Any]) -> str:
    """Says in a line what changed, or what may have changed."""
    doubt = record.get("suspected")
    title = f"{record['kind']:>6}  {record['name'] or 'something'}"
    title += "" if record["id"] is None else f" (object {record['id']})"
    places = [f"{word} {np.round(record[word], 2).tolist()}" for word in ("from", "to") if record[word] is not None]
    words = " ".join(places) + (f", perhaps {doubt}: too little shows it" if doubt else "")
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
    cards, others, capture = [], [], changes.capture
    for change, record in zip(changes.found, changes.records()):
        if change.kind not in _COLOURS or not change.frames:
            kind = change.kind + (f" ({change.suspected}?)" if change.suspected else "")
            others.append(f"{record['name'] or 'something'} {kind}")
            continue
        t = max(change.frames, key=lambda t: int(change.before[t].sum() + change.after[t].sum()))
        images = pictures.render_picture(changes.field.gaussians, capture.cameras[t]), np.asarray(capture.frames[t])
        pair = [
            report.figure(pictures.outlined(image, mask, _COLOURS[change.kind], 2), words)
            for image, mask, words in zip(images, (change.before[t], change.after[t]), ("before", capture.names[t]))
        ]
        title, _, words = " ".join(_words(record).split()).partition(": ")
        cards.append(report.section(title, words, report.grid(pair, 2)))
    plan = report.figure(_draw_plan(changes), "From above: blue moved, red gone, green new, brown another look.")
    lead = f"{len(cards)} changes, {len(others)} other objects, by {len(capture.names)} photographs."
    parts = [
        report.section("Plan", "", report.grid([plan], 2)),
        *cards,
        report.section("Other objects", ", ".join(others)),
    ]
    return report.page("Changes", lead, parts)


def _draw_plan(changes: Changes) -> np.ndarray:
    """Renders the scene from above, with a mark of each change and an arrow of what moved."""
    field, listed = changes.field, changes.catalogue
    up = np.array(field_up(field).axis)
    right, ahead = axes_across(up)
    turn, size = np.stack([right, -ahead, -up]), np.array([field.cameras.width, field.cameras.height])
    things = np.append(~listed.surroundings, False)[listed.labels]
    means = np.asarray(field.gaussians.means, np.float64) @ turn.T
    ends = np.array([(change.start, change.place) for change in changes.found]).reshape(-1, 2, 3) @ turn.T
    extremes = np.quantile(means[things if things.any() else ...], [0.01, 0.99], axis=0)
    low, high = (extreme(np.concatenate([extremes, *ends]), axis=0) for extreme in (np.min, np.max))
    scale = float((0.8 * size / np.maximum(high - low, 1e-6)[:2]).min())  # px a unit
    away = 100 * float((high - low).max())  # so far that heights shift nothing
    eye = np.append((low + high)[:2] / 2, low[2] - away)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -eye
    lens = np.array([scale * away, scale * away, *size / 2], np.float32)
    camera = Camera(pose.astype(np.float32), *lens, *size.tolist())
    image = pictures.render_picture(hide(field.gaussians, means[:, 2] < low[2]), camera)  # without ceilings
    image = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    for change, pixels in zip(changes.found, np.rint(2 * scale * (ends[..., :2] - eye[:2]) + size).astype(int)):
        if change.kind in _COLOURS:
            start, end = pixels.tolist()
            cv2.arrowedLine(image, start, end, _COLOURS[change.kind], 3, cv2.LINE_AA, tipLength=0.12)
            cv2.circle(image, end, 14, _COLOURS[change.kind], 3, cv2.LINE_AA)
    return image
