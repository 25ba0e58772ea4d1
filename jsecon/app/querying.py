"""`jsecon query` and `jsecon measure`.

The options of a query are its questions, and its answers are files: Gaussians, a record, masks, a page of pictures.
Lengths between things or points are lines and CSV, and one known length gives a field its scale.

Every query has unique file names, the same in every run: an ordinary text is its name ("red mug" is red-mug), any other
name ends in a hash of what it stands for (`_file_stem`).
"""

import hashlib
import itertools
import json
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from jsecon.app import pictures, report, verbs
from jsecon.app.opening import locate_field
from jsecon.app.records import Answer, At, Query
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError
from jsecon.field.field import save_field
from jsecon.files import csv_text, parse_json, remove_files, write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.read.captures.images import write_image

_PAGE = "answers.html"
"""page of a command's answers in its folder"""
_MAX_SLUG_BYTES = 80
"""bytes of a slug; a file name may have 255 bytes, two slugs and their hashes among them"""


def _query(verb: verbs.Query, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon query`; the result has the records of the answers, and the errors of failed queries."""
    queries = _queries(verb)
    require_writable(verb.out)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    scene = (scene if verb.as_of is None else scene.as_of(verb.as_of)).at_level(verb.level)
    with console.progress("answers"):
        if verb.texts:
            _ = scene.embedder  # without it one error stands for all texts
        results = scene.ask_all(queries)
    answers = [answer for answer in results if not isinstance(answer, InputError)]
    for query, result in zip(queries, results):
        if isinstance(result, InputError) and isinstance(query.question, str):
            _remove_answer(verb.out, _file_stem(query))
    if not answers:
        remove_files(verb.out, [_PAGE])
    result = _write_answers(scene, answers, verb.out, console, verb.views) if answers else {"answers": []}
    return result | {"errors": [error for error in results if isinstance(error, InputError)]}


def _queries(verb: verbs.Query) -> list[Query]:
    """The queries of a command, in order: texts, then pixels."""
    questions = [*verb.texts, *(At(*at) for at in verb.at)]
    if not questions:
        remedy = 'For example: jsecon query field.safetensors "red mug" --out answers'
        raise InputError("query", "there is no query", "a TEXT, or --at FRAME X Y", remedy)
    options: dict[str, Any] = {"by": verb.by, "threshold": verb.threshold, "min_rank": verb.min_rank}
    options |= {"outliers": not verb.keep_outliers, "frame": verb.from_frame}
    return [Query(question, **options) for question in questions]


def write_answer(
    answer: Answer, scene: Scene, out: Path, masks: Mapping[int, Bool[np.ndarray, "h w"]]
) -> dict[str, Any]:
    """Writes the files of an answer, of an empty one its record alone, and returns the record of the .json.

    They replace those of an earlier answer to the same question.

    Args:
      answer: The answer.
      scene: The scene that gave it.
      out: Output folder.
      masks: Index of a frame -> mask to write (`Scene.mask`).
    """
    stem = _file_stem(answer.query)
    _remove_answer(out, stem)
    record = answer.as_dict() | {"ply": None, "masks": {}}
    if len(answer.rows):
        record["ply"] = f"{stem}.ply"
        scene.export(out / record["ply"], answer)
        for t, mask in masks.items():
            record["masks"][scene.field.names[t]] = file = f"{stem}-{_frame_stem(scene, t)}.png"
            write_image(out / file, mask.astype(np.uint8) * 255)
    write_text(out / f"{stem}.json", json.dumps(record, indent=2) + "\n")
    return record


def _write_answers(scene: Scene, answers: Sequence[Answer], out: Path, console: Console, views: int) -> dict[str, Any]:
    """Writes the files of answers and OUT/answers.html, and prints a line for each.

    `views` is the number of masks of each answer; without any it renders nothing. The result has paths under "written",
    and the records under "answers".
    """
    sections: dict[str, str] = {}
    records: dict[str, dict[str, Any]] = {}
    for answer in answers:  # before the pictures, which take longer
        console.print_line(str(answer))
    with console.progress("pictures") as progress:
        for n, answer in enumerate(answers):
            stem = _file_stem(answer.query)
            if stem not in records:  # else the question stands there twice
                masks = {t: scene.mask(answer, t) for t in scene.best_frames(answer, views)}
                records[stem] = write_answer(answer, scene, out, masks)
                counts = records[stem]["outliers"]
                words = f"{counts['dropped']} of {counts['selected']} selected Gaussians stand apart and were dropped"
                if counts["dropped"]:
                    console.note(f"{words}; --keep-outliers keeps them")
                overlays = {t: pictures.selection_overlay(scene.render(t), mask) for t, mask in masks.items()}
                figures = [report.figure(image, scene.field.names[t]) for t, image in overlays.items()]
                words = f"Selected by {answer.by}: {answer.describe()}. {words}."
                sections[stem] = report.section(str(answer.query), words, report.grid(figures, 3))
            progress(n + 1, len(answers))
    written = {"folder": out}
    if views:
        lead = "The mask of each selection over the rendered scene."
        write_text(out / _PAGE, report.page("Answers", lead, list(sections.values())))
        console.print_line(f"pictures  {out / _PAGE}")
        written["pictures"] = out / _PAGE
    else:
        remove_files(out, [_PAGE])  # of an earlier command
    return {"written": written, "answers": [records[_file_stem(answer.query)] for answer in answers]}


def _remove_answer(out: Path, stem: str) -> None:
    """Removes the files of an earlier answer: its record, and the Gaussians and masks that the record lists."""
    try:
        earlier = parse_json((out / f"{stem}.json").read_bytes())
        names = [earlier.get("ply"), *earlier.get("masks", {}).values()]
    except (OSError, ValueError, AttributeError):  # there is none, or another program wrote it
        return
    texts = [name for name in names if isinstance(name, str) and name.isprintable()]
    remove_files(out, [*(name for name in texts if name.startswith((f"{stem}.", f"{stem}-"))), f"{stem}.json"])


def _file_stem(query: Query) -> str:
    """Names the files of an answer without ending: the same name in every run, and not that of any other query."""
    question, name = query.question, str(query)
    plain = slug(name)
    pointed = re.fullmatch(r"at .*\d", name, re.DOTALL)  # a text may be called like a pixel
    by_name = bool(pointed) != isinstance(question, str)
    device = re.fullmatch(r"con|prn|aux|nul|(com|lpt)\d", plain)  # on Windows, whatever its ending
    short = len(plain.encode()) <= _MAX_SLUG_BYTES and not device
    if by_name and short and plain.replace("-", " ") == name:
        return plain
    return _hashed(plain, question if isinstance(question, str) else repr(question))


def _frame_stem(scene: Scene, frame: int) -> str:
    """Returns a frame's name as a part of file names: as it is if it has only letters and digits, else hashed."""
    name = scene.field.names[frame]
    # Unique on a file system without case, too.
    unique = [other.casefold() for other in scene.field.names].count(name.casefold()) == 1
    ordinary = re.fullmatch(r"[A-Za-z0-9_]+", name) and len(name) <= _MAX_SLUG_BYTES and unique
    return name if ordinary else _hashed(slug(name), name)


def slug(text: str) -> str:
    """Writes a text as a part of a file name: letters and digits in lower case with hyphens between, else "query"."""
    folded = unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())
    return re.sub(r"[^\w]+", "-", folded).strip("-") or "query"


def _hashed(slug: str, key: str) -> str:
    """Returns the beginning of a slug, and a hash of the key behind two hyphens, which no slug has."""
    digest = hashlib.sha256(key.encode("utf-8", "surrogatepass")).hexdigest()[:10]
    start = slug.encode("utf-8", "replace")[:_MAX_SLUG_BYTES].decode("utf-8", "ignore")
    return f"{start}--{digest}"


def _measure(verb: verbs.Measure, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon measure`; the result has the measurements, and the scale of the field."""
    pairs = [*itertools.combinations(verb.texts, 2), *((ends[:3], ends[3:]) for ends in verb.points)]
    ends = verb.scale_points
    if verb.scale is not None and ends is not None:
        raise InputError("--scale", "it cannot be combined with --scale-points", remedy="Give one known length.")
    known: Any = verb.scale or (ends and (ends[:3], ends[3:6], ends[6]))
    if not pairs and known is None:
        remedy = 'For example: jsecon measure my_field "red mug" "white plate"'
        raise InputError("measure", "there is nothing to measure", "two texts, --points, or --scale", remedy)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    if known is not None:
        scene = scene.scaled(*known)
        save_field(locate_field(verb.field).file, scene.field)
        scale = scene.field.metres_per_unit
        console.print_line(f"scale   1 unit is {scale:.6g} m, --metres-per-unit {scale:.6g} of a new run")
    with console.progress("lengths"):
        rows = [scene.measure(*pair) for pair in pairs]
    for row in rows:
        lengths = ", ".join(f"{row[name]:.4g} between {name}" for name in ("centers", "surfaces"))
        console.print_line(f"{row['a']} to {row['b']}: {lengths} ({row['unit']})")
    result: verbs.VerbResult = {"measurements": rows, "metres_per_unit": scene.field.metres_per_unit}
    if verb.out is None:
        return result
    write_text(verb.out, csv_text(("a", "b", "surfaces", "centers", "angle", "unit"), rows))
    console.print_line(f"table   {verb.out}")
    return result | {"written": {"table": verb.out}}
