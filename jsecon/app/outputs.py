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

import jax
import numpy as np
from jaxtyping import Bool, Int

from jsecon.app import pictures, report
from jsecon.app.ask import Answer
from jsecon.app.locate import decimals, rounded, selected_centers
from jsecon.field.field import subset_field
from jsecon.field.membership import probability_inside
from jsecon.files import write_text
from jsecon.pipeline.progress import Listener
from jsecon.query.render import selection_mask
from jsecon.read.captures.images import write_image
from jsecon.read.splats.files import save_gaussians
from jsecon.read.splats.ply import save_ply
from jsecon.types import LanguageField

MAX_SLUG_BYTES = 80
"""bytes of a slug; a file name may have 255 bytes, two slugs and their hashes among them"""
DEVICES = frozenset(("con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))))
"""names that Windows reserves for devices, whatever their ending"""
POINTED = re.compile(r"(at|box|region) .*\d", re.DOTALL)
"""names of queries without a text: a pixel, a box, a region"""


def best_frames(field: LanguageField, answer: Answer, count: int) -> list[int]:
    """Chooses the frames that show a selection best.

    Args:
      field: The field, with a row for each row of the answer.
      answer: The answer.
      count: Maximum number of frames.

    Returns:
      Indices of frames, best first: by the pixels of the region, or without a region by the centres in view.
    """
    region = int(answer.selection.region)
    if region >= 0:
        visible = np.asarray(field.regions.pixel_counts)[region]
    else:
        means = np.asarray(field.gaussians.means)[answer.mask]
        pose = np.asarray(field.cameras.world_to_camera)
        local = np.einsum("tij,nj->tni", pose[:, :3, :3], means) + pose[:, None, :3, 3]
        z = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        u = np.asarray(field.cameras.fx)[:, None] * local[..., 0] / z + np.asarray(field.cameras.cx)[:, None]
        v = np.asarray(field.cameras.fy)[:, None] * local[..., 1] / z + np.asarray(field.cameras.cy)[:, None]
        visible = ((u >= 0) & (u < field.cameras.width) & (v >= 0) & (v < field.cameras.height)).sum(1)
    order = np.argsort(-visible, kind="stable")[:count]
    return [int(t) for t in order if visible[t] > 0]


def answer_masks(field: LanguageField, answer: Answer, views: int) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Renders the selected Gaussians alone in the frames that show them best.

    Args:
      field: The field.
      answer: The answer.
      views: Maximum number of frames.

    Returns:
      Index of a frame -> (H, W) bool, where their alpha is above 0.7.
    """
    field = _part_of(field, answer)
    gaussians, mask = jax.device_put((field.gaussians, answer.mask))
    cameras = jax.tree.map(np.asarray, field.cameras)  # whose items need no compilation
    frames = best_frames(field, answer, views)
    return {t: np.asarray(selection_mask(gaussians, cameras[t], mask)) for t in frames}


def _part_of(field: LanguageField, answer: Answer) -> LanguageField:
    """Returns the field of the Gaussians that an answer has rows for, which are all without `Answer.rows`."""
    return field if answer.rows is None else subset_field(field, answer.rows)


def write_answer(
    field: LanguageField,
    answer: Answer,
    out: Path,
    masks: Mapping[int, Bool[np.ndarray, "h w"]],
    *,
    ending: str = "ply",
) -> dict[str, Any]:
    """Writes the files of an answer. Of an empty selection it writes the record alone.

    Args:
      field: The field.
      answer: The answer.
      out: Output folder.
      masks: Masks to write (`answer_masks`).
      ending: Format of the Gaussians: ply, spz or glb.

    Returns:
      The record of the .json. Its coordinates are in the capture's world.
    """
    stem = file_stem(answer)
    part = _part_of(field, answer)
    record = _record(part, answer) | {"gaussians": field.gaussians.count, ending: None, "masks": {}}
    if answer.mask.any():
        record[ending] = f"{stem}.{ending}"
        save_scene(part, out / record[ending], rows=np.flatnonzero(answer.mask))
        for t, mask in masks.items():
            record["masks"][field.names[t]] = file = f"{stem}-{_frame_stem(field, t)}.png"
            write_image(out / file, mask.astype(np.uint8) * 255)
    write_text(out / f"{stem}.json", json.dumps(record, indent=2) + "\n")
    return record


def _record(field: LanguageField, answer: Answer) -> dict[str, Any]:
    """Returns count, score, region and place of an answer as plain values."""
    means = selected_centers(field, answer.mask)
    region = int(answer.selection.region)
    place = None
    probability = {} if answer.presence is None else {"presence": round(answer.presence, 4)}
    if len(means):
        low, high = means.min(0), means.max(0)
        size = float(np.linalg.norm(high - low))
        box = {"min": rounded(low, size), "max": rounded(high, size)}
        place = {"centroid": rounded(means.mean(0), size), "bounding_box": box}
        if answer.by == "votes":
            inside = probability_inside(answer.selection.similarity, field.votes, answer.mask)
            probability["mean"] = round(float(inside.mean()), 4)
            probability["percentile_10"] = round(float(np.quantile(inside, 0.1)), 4)
    record = {
        "query": answer.query,
        "by": answer.by,
        "count": len(means),
        "objects": answer.objects if len(means) else 0,
        "score": round(float(answer.selection.score), 6),
        "rank": answer.rank,
        "confidence": answer.confidence,
        "region": region if region >= 0 else None,
        "probability": probability or None,
        "outliers": {
            "dropped": answer.dropped,
            "selected": int(np.asarray(answer.selection.mask).sum()),
            "clusters_kept": answer.clusters[0],
            "clusters_dropped": answer.clusters[1],
        },
        "place": place,
        "skipped": answer.skipped,
    }
    return record if answer.relation is None else record | {"relation": dict(answer.relation)}


def write_answers(
    field: LanguageField, answers: Sequence[Answer], out: Path, listener: Listener, *, views: int, ending: str = "ply"
) -> dict[str, Any]:
    """Writes the files of answers and OUT/answers.html, and prints a line for each.

    Args:
      field: The field.
      answers: The answers.
      out: Output folder.
      listener: Receives the lines.
      views: Number of masks for each answer.
      ending: Format of the Gaussians: ply, spz or glb.

    Returns:
      Paths of the files under "written", and the records under "answers".
    """
    in_blocks = any(answer.rows is not None for answer in answers)
    renderer = pictures.Renderer(field.gaussians, field.cameras, in_blocks=in_blocks)
    sections = []
    records = []
    with listener.progress("pictures") as progress:
        for n, answer in enumerate(answers):
            masks = answer_masks(field, answer, max(views, 1))
            written = {t: masks[t] for t in list(masks)[:views]}
            record = write_answer(field, answer, out, written, ending=ending)
            records.append(record)
            line = _line(answer, record)
            listener.say(f"{answer.query!r}: {line}")
            outliers = _outliers_message(record["outliers"])
            if outliers:
                listener.note(outliers)
            overlays = {t: pictures.selection_overlay(renderer.photo(t), mask) for t, mask in masks.items()}
            figures = [report.figure(image, field.names[t]) for t, image in overlays.items()]
            words = f"Selected by {answer.by}: {line}. {outliers or 'No outliers were dropped'}."
            sections.append(report.section(answer.query, words, report.grid(figures, 3)))
            progress(n + 1, len(answers))
    lead = "The mask of each selection over the rendered scene."
    write_text(out / "answers.html", report.page("Answers", lead, sections))
    listener.say(f"pictures  {out / 'answers.html'}")
    return {"written": {"folder": out, "pictures": out / "answers.html"}, "answers": records}


def _line(answer: Answer, record: Mapping[str, Any]) -> str:
    """Returns an answer and its record as one line."""
    parts = [f"{record['count']} of {record['gaussians']} Gaussians"]
    parts += [f"{record['objects']} objects"] if record["objects"] > 1 else []
    parts.append(f"score {record['score']:.3f}")
    parts += [answer.rank_words] if answer.rank_words else []
    if record["confidence"] is not None and record["region"] is not None:
        parts.append(f"confidence {int(100 * record['confidence'])} %")
    if record["region"] is not None:
        parts.append(f"region {record['region']}")
    elif "regions" in record["skipped"]:
        parts.append("parts in place of a region")
    elif record["by"] in ("votes", "code"):
        parts.append("no region matches it")
    if record["place"] is None:
        return ", ".join([*parts, "no Gaussian is selected"])
    box = record["place"]["bounding_box"]
    digits = decimals(float(np.linalg.norm(np.subtract(box["max"], box["min"]))), 0.01)
    centroid = ", ".join(f"{coordinate:.{digits}f}" for coordinate in record["place"]["centroid"])
    return ", ".join([*parts, f"around ({centroid})"])


def _outliers_message(outliers: Mapping[str, int]) -> str:
    """Returns what DBSCAN dropped of an answer and how to keep it; "" if it dropped no Gaussian."""
    if not outliers["dropped"]:
        return ""
    many = outliers["clusters_dropped"]
    clusters = f", {many} smaller cluster{'s' if many > 1 else ''} among them" if many else ""
    count = f"{outliers['dropped']} of {outliers['selected']}"
    return f"{count} selected Gaussians stand apart and were dropped{clusters}; --keep-outliers keeps them"


def save_scene(
    field: LanguageField,
    file: Path,
    *,
    rows: Int[np.ndarray, " m"] | None = None,
    object_ids: Int[np.ndarray, " n"] | None = None,
) -> None:
    """Writes Gaussians in the world of the capture's files, in blocks, so that a mapped field need not fit memory.

    Args:
      field: The field.
      file: The .ply, .spz or .glb to write. A .glb also holds regions, and codes if the field has them.
      rows: The Gaussians to write, in this order; None writes all.
      object_ids: (N,) ids of all Gaussians for the property `object_id` of a .ply.
    """
    if rows is not None:
        field = subset_field(field, rows)
        object_ids = None if object_ids is None else object_ids[rows]
    if file.suffix.lower() == ".ply":
        save_ply(file, field.gaussians, similarity=field.source_from_scene, object_ids=object_ids)
        return
    columns = {}
    if file.suffix.lower() == ".glb":
        codes = None if field.codes is None else field.codes.gaussians
        columns = {"codes": codes, "regions": pictures.main_regions(field)}
    save_gaussians(file, field.gaussians, similarity=field.source_from_scene, **columns)


def file_stem(answer: Answer) -> str:
    """Names the files of an answer: the same name in every run, and not that of any other query.

    Args:
      answer: The answer.

    Returns:
      The name without ending.
    """
    plain = slug(answer.query)
    pointed = POINTED.fullmatch(answer.query) is not None  # a text may be called like a pixel
    by_name = answer.key == answer.query if pointed else answer.key is None
    short = len(plain.encode()) <= MAX_SLUG_BYTES and plain not in DEVICES
    if by_name and short and plain.replace("-", " ") == answer.query:
        return plain
    return _hashed(plain, answer.query if answer.key is None else answer.key + "\0")


def _frame_stem(field: LanguageField, frame: int) -> str:
    """Returns a frame's name as a part of file names: as it is if it has only letters and digits, else hashed."""
    name = field.names[frame]
    unique = sum(other.casefold() == name.casefold() for other in field.names) == 1  # on a file system without case
    ordinary = re.fullmatch(r"[A-Za-z0-9_]+", name) and len(name) <= MAX_SLUG_BYTES and unique
    return name if ordinary else _hashed(slug(name), name)


def slug(text: str) -> str:
    """Writes a text as a part of a file name.

    Args:
      text: The text.

    Returns:
      Its letters and digits in lower case, with hyphens between; "query" if it has none.
    """
    folded = unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())
    return re.sub(r"[^\w]+", "-", folded).strip("-") or "query"


def _hashed(slug: str, key: str) -> str:
    """Returns the beginning of a slug, and a hash of the key behind two hyphens, which no slug has."""
    digest = hashlib.sha256(key.encode("utf-8", "surrogatepass")).hexdigest()[:10]
    start = slug.encode("utf-8", "replace")[:MAX_SLUG_BYTES].decode("utf-8", "ignore")
    return f"{start}--{digest}"
