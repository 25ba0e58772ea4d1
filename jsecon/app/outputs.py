"""Answers as files: the selected Gaussians, a JSON record and masks of each, and a page of pictures of all.

Every query has unique file names, the same in every run: an ordinary text is its name ("red mug" is red-mug), any other
name ends in a hash of what it stands for (`file_stem`).
"""

import hashlib
import json
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from jsecon.app import pictures, report
from jsecon.app.records import Answer, Mask
from jsecon.app.scene import Scene
from jsecon.files import write_text
from jsecon.pipeline.progress import Console
from jsecon.read.captures.images import write_image

MAX_SLUG_BYTES = 80
"""bytes of a slug; a file name may have 255 bytes, two slugs and their hashes among them"""


def write_answer(
    answer: Answer, scene: Scene, out: Path, masks: Mapping[int, Bool[np.ndarray, "h w"]], *, ending: str = "ply"
) -> dict[str, Any]:
    """Writes the files of an answer, of an empty one its record alone, and returns the record of the .json.

    Args:
      answer: The answer.
      scene: The scene that gave it.
      out: Output folder.
      masks: Index of a frame -> mask to write (`Scene.mask`).
      ending: Format of the Gaussians: ply, spz or glb.
    """
    stem = file_stem(answer)
    record = answer.as_dict() | {ending: None, "masks": {}}
    if len(answer.rows):
        record[ending] = f"{stem}.{ending}"
        scene.export(out / record[ending], answer)
        for t, mask in masks.items():
            record["masks"][scene.field.names[t]] = file = f"{stem}-{_frame_stem(scene, t)}.png"
            write_image(out / file, mask.astype(np.uint8) * 255)
    write_text(out / f"{stem}.json", json.dumps(record, indent=2) + "\n")
    return record


def write_answers(
    scene: Scene, answers: Sequence[Answer], out: Path, console: Console, *, views: int = 3, ending: str = "ply"
) -> dict[str, Any]:
    """Writes the files of answers and OUT/answers.html, and prints a line for each.

    Args:
      scene: The scene.
      answers: The answers.
      out: Output folder.
      console: Receives the lines.
      views: Number of masks of each answer.
      ending: Format of the Gaussians: ply, spz or glb.

    Returns:
      Paths of the files under "written", and the records under "answers".
    """
    sections: dict[str, str] = {}
    records: dict[str, dict[str, Any]] = {}
    with console.progress("pictures") as progress:
        for n, answer in enumerate(answers):
            stem = file_stem(answer)
            console.print_line(str(answer))
            if answer.outlier_words:
                console.note(f"{answer.outlier_words}; --keep-outliers keeps them")
            if stem not in records:  # else the question stands there twice
                masks = {t: scene.mask(answer, t) for t in scene.best_frames(answer, max(views, 1))}
                records[stem] = write_answer(answer, scene, out, dict(list(masks.items())[:views]), ending=ending)
                sections[stem] = _section(scene, answer, masks)
            progress(n + 1, len(answers))
    lead = "The mask of each selection over the rendered scene."
    write_text(out / "answers.html", report.page("Answers", lead, list(sections.values())))
    console.print_line(f"pictures  {out / 'answers.html'}")
    written = {"folder": out, "pictures": out / "answers.html"}
    return {"written": written, "answers": [records[file_stem(answer)] for answer in answers]}


def _section(scene: Scene, answer: Answer, masks: Mapping[int, np.ndarray]) -> str:
    """The part of the page of answers that shows one of them."""
    overlays = {t: pictures.selection_overlay(scene.render(t), mask) for t, mask in masks.items()}
    figures = [report.figure(image, scene.field.names[t]) for t, image in overlays.items()]
    words = f"Selected by {answer.by}: {answer.describe()}. {answer.outlier_words or 'No outliers were dropped'}."
    return report.section(str(answer.query), words, report.grid(figures, 3))


def file_stem(answer: Answer) -> str:
    """Names the files of an answer without ending: the same name in every run, and not that of any other query."""
    question, name = answer.query.question, str(answer.query)
    plain = slug(name)
    pointed = re.fullmatch(r"(at|box|region) .*\d", name, re.DOTALL)  # a text may be called like a pixel
    by_name = bool(pointed) != isinstance(question, str) and not isinstance(question, Mask)
    device = re.fullmatch(r"con|prn|aux|nul|(com|lpt)\d", plain)  # on Windows, whatever its ending
    short = len(plain.encode()) <= MAX_SLUG_BYTES and not device
    if by_name and short and plain.replace("-", " ") == name:
        return plain
    return _hashed(plain, question if isinstance(question, str) else repr(question))


def _frame_stem(scene: Scene, frame: int) -> str:
    """Returns a frame's name as a part of file names: as it is if it has only letters and digits, else hashed."""
    name = scene.field.names[frame]
    unique = (
        sum(other.casefold() == name.casefold() for other in scene.field.names) == 1
    )  # on a file system without case
    ordinary = re.fullmatch(r"[A-Za-z0-9_]+", name) and len(name) <= MAX_SLUG_BYTES and unique
    return name if ordinary else _hashed(slug(name), name)


def slug(text: str) -> str:
    """Writes a text as a part of a file name: letters and digits in lower case with hyphens between, else "query"."""
    folded = unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())
    return re.sub(r"[^\w]+", "-", folded).strip("-") or "query"


def _hashed(slug: str, key: str) -> str:
    """Returns the beginning of a slug, and a hash of the key behind two hyphens, which no slug has."""
    digest = hashlib.sha256(key.encode("utf-8", "surrogatepass")).hexdigest()[:10]
    start = slug.encode("utf-8", "replace")[:MAX_SLUG_BYTES].decode("utf-8", "ignore")
    return f"{start}--{digest}"
