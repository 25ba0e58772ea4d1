"""An answer as files: one of the Gaussians, a JSON of figures, a few masks.

Every question has file names of its own, the same in every run: an ordinary text is its own name ("red mug" is
red-mug), any other name ends in a hash of what it stands for (`file_stem`).
"""

import hashlib
import json
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Bool

from jsecon.app import pictures, report
from jsecon.app.ask import Answer, quantile_message
from jsecon.app.locate import digits, rounded, selected_centers
from jsecon.app.viewer.static_page import NOWHERE, main_regions
from jsecon.data.gaussians.files import save_gaussians
from jsecon.files import atomic_write, write_text
from jsecon.language.field import subset_field
from jsecon.language.membership import probability_inside
from jsecon.pipeline.progress import Listener
from jsecon.query.render import selection_mask
from jsecon.splat.transform import transform_gaussians_float64
from jsecon.types import Gaussians, LanguageField

_MOST_BYTES = 80
"""of a slug: a file's name may have 255 bytes, two slugs and their hashes among them"""
_DEVICES = frozenset(("con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))))
"""names that Windows keeps for devices, whatever their ending"""
_POINTED = re.compile(r"(at|box|region) .*\d", re.DOTALL)
"""questions without a text: a pixel, a box, a region"""


def selected(gaussians: Gaussians, mask: np.ndarray) -> Gaussians:
    """The selected Gaussians alone."""
    return jax.tree.map(lambda a: np.asarray(a)[np.asarray(mask)], gaussians)


def best_frames(field: LanguageField, answer: Answer, count: int) -> list[int]:
    """The `count` frames that show the selection best: by the region's pixels, or by the Gaussians' centres in view."""
    region = int(answer.selection.region)
    if region >= 0:
        seen = np.asarray(field.regions.pixels)[region]
    else:
        means = np.asarray(field.gaussians.means)[answer.mask]
        pose = np.asarray(field.cameras.world_to_camera)
        local = np.einsum("tij,nj->tni", pose[:, :3, :3], means) + pose[:, None, :3, 3]
        z = np.where(local[..., 2] > 0, local[..., 2], np.nan)
        u = np.asarray(field.cameras.fx)[:, None] * local[..., 0] / z + np.asarray(field.cameras.cx)[:, None]
        v = np.asarray(field.cameras.fy)[:, None] * local[..., 1] / z + np.asarray(field.cameras.cy)[:, None]
        seen = ((u >= 0) & (u < field.cameras.width) & (v >= 0) & (v < field.cameras.height)).sum(1)
    order = np.argsort(-seen, kind="stable")[:count]
    return [int(t) for t in order if seen[t] > 0]


def part_of(field: LanguageField, answer: Answer) -> LanguageField:
    """The field of the Gaussians that an answer speaks of: of all, but where `Answer.rows` names them."""
    return field if answer.rows is None else subset_field(field, answer.rows)


def _figures(field: LanguageField, answer: Answer) -> dict[str, Any]:
    """The figures of an answer: count, score, region, and where it is.

    Under "place", in the capture's own world: "centroid", the mean of the centres of the selected Gaussians, as
    `Place.centroid`, and "bounding_box", the least and the greatest of their coordinates.
    """
    means = selected_centers(field, answer.mask)
    place = sure = None
    if len(means):
        low, high = means.min(0), means.max(0)
        size = float(np.linalg.norm(high - low))
        box = {"min": rounded(low, size), "max": rounded(high, size)}
        place = {"centroid": rounded(means.mean(0), size), "bounding_box": box}
    region = int(answer.selection.region)
    if answer.by == "votes" and len(means):
        probability = probability_inside(answer.selection.similarity, field.votes, answer.mask)
        sure = {"mean": round(float(probability.mean()), 4), "tenth": round(float(np.quantile(probability, 0.1)), 4)}
    if answer.there is not None:
        sure = {"there": round(answer.there, 4)} | (sure or {})
    return {
        "query": answer.question,
        "by": answer.by,
        "count": len(means),
        "of": field.gaussians.count,
        "score": round(float(answer.selection.score), 6),
        "quantile": answer.quantile,
        "region": region if region >= 0 else None,
        "probability": sure,
        "outliers_dropped": answer.dropped,
        "outliers": {
            "dropped": answer.dropped,
            "of_selected": int(np.asarray(answer.selection.mask).sum()),
            "clusters_kept": answer.clusters[0],
            "clusters_dropped": answer.clusters[1],
            "keep_with": "--keep-outliers" if answer.dropped else None,
        },
        "place": place,
        "left_out": answer.left_out,
    } | ({} if answer.frames is None else {"frames": dict(answer.frames)})


def centroid_text(place: dict[str, Any]) -> str:
    """The centroid of a "place" of `_figures` in words, to a hundredth of the size of the thing."""
    box = place["bounding_box"]
    decimals = digits(float(np.linalg.norm(np.subtract(box["max"], box["min"]))), 0.01)
    return f"({', '.join(f'{c:.{decimals}f}' for c in place['centroid'])})"


def write_answer(
    field: LanguageField,
    answer: Answer,
    out: Path,
    masks: Mapping[int, Bool[np.ndarray, "h w"]],
    *,
    ending: str = "ply",
) -> dict[str, Any]:
    """Writes OUT/<stem>.ply (or .spz, .glb: `ending`), .json, and <stem>-<frame>.png of `masks` (by frame, see
    `answer_masks`); returns the figures. An empty selection leaves out the Gaussians and
    the masks.
    """
    stem, count = file_stem(answer), field.gaussians.count
    field = part_of(field, answer)
    chosen = transform_gaussians_float64(selected(field.gaussians, answer.mask), field.to_source)
    told = _figures(field, answer) | {"of": count, ending: None, "masks": {}}
    if answer.mask.any():
        told[ending] = f"{stem}.{ending}"
        own = {"codes": np.asarray(field.codes), "regions": _regions(field)} if ending == "glb" else {}
        save_gaussians(out / told[ending], chosen, **{name: table[answer.mask] for name, table in own.items()})
        for t, mask in masks.items():
            told["masks"][field.names[t]] = file = f"{stem}-{_frame_stem(field, t)}.png"
            with atomic_write(out / file) as temporary:
                temporary.write_bytes(cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes())
    write_text(out / f"{stem}.json", json.dumps(told, indent=2) + "\n")
    return told


def save_scene(field: LanguageField, file: Path) -> None:
    """Writes all Gaussians in the capture files' own world, in blocks: a mapped field need not fit into memory. With
    their codes and regions where the file is a .glb."""
    own = {"codes": field.codes, "regions": _regions(field)} if file.suffix.lower() == ".glb" else {}
    save_gaussians(file, field.gaussians, similarity=field.to_source, **own)


def _regions(field: LanguageField) -> np.ndarray:
    """(N,) as a .glb holds them: -1 = none."""
    regions = main_regions(field)
    return np.where(regions == NOWHERE, -1, regions)


def answer_masks(field: LanguageField, answer: Answer, views: int) -> dict[int, Bool[np.ndarray, "h w"]]:
    """frame -> (H, W) bool of the `views` best frames: where the selected Gaussians alone have an alpha above 0.7."""
    field = part_of(field, answer)
    gaussians, mask = jax.device_put((field.gaussians, answer.mask))
    cameras = jax.tree.map(np.asarray, field.cameras)  # whose items compile nothing
    frames = best_frames(field, answer, views)
    return {t: np.asarray(selection_mask(gaussians, cameras[t], mask)) for t in frames}


def file_stem(answer: Answer) -> str:
    """The name of an answer's files without their endings: the same in every run, and no other question's."""
    question, plain = answer.question, _slug(answer.question)
    pointed = _POINTED.fullmatch(question) is not None
    own = answer.key == question if pointed else answer.key is None  # a text may be called like a pixel
    ordinary = plain.replace("-", " ") == question and len(plain.encode()) <= _MOST_BYTES and plain not in _DEVICES
    return plain if own and ordinary else _hashed(plain, question if answer.key is None else answer.key + "\0")


def _frame_stem(field: LanguageField, frame: int) -> str:
    """A frame's name as a part of file names: a name of letters and digits as it is, any other as a slug and a hash."""
    name = field.names[frame]
    alike = sum(other.casefold() == name.casefold() for other in field.names)  # on a file system without case
    ordinary = re.fullmatch(r"[A-Za-z0-9_]+", name) and len(name) <= _MOST_BYTES and alike == 1
    return name if ordinary else _hashed(_slug(name), name)


def _slug(text: str) -> str:
    """The letters and digits of a text, in lower case, with hyphens between; "query" for a text without any."""
    folded = unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())
    return re.sub(r"[^\w]+", "-", folded).strip("-") or "query"


def _hashed(slug: str, key: str) -> str:
    """The beginning of a slug, and a hash of the key behind two hyphens, which no slug has."""
    digest = hashlib.sha256(key.encode("utf-8", "surrogatepass")).hexdigest()[:10]
    start = slug.encode("utf-8", "replace")[:_MOST_BYTES].decode("utf-8", "ignore")
    return f"{start}--{digest}"


def write_answers(
    field: LanguageField,
    answers: Sequence[Answer],
    out: Path,
    listener: Listener,
    *,
    views: int,
    ending: str = "ply",
) -> dict[str, Any]:
    """The files of each answer, OUT/answers.html, and a line each; returns the files and the figures."""
    in_blocks = any(item.rows is not None for item in answers)
    renderer, parts, figures_of = pictures.Renderer(field.gaussians, field.cameras, in_blocks=in_blocks), [], []
    with listener.progress("pictures") as progress:
        for n, item in enumerate(answers):
            shown = answer_masks(field, item, max(views, 1))
            masks = {t: shown[t] for t in list(shown)[:views]}
            told = write_answer(field, item, out, masks, ending=ending)
            figures_of.append(told)
            if told["place"]:
                place = f"around {centroid_text(told['place'])}"
            elif told["region"] is None and item.by in ("votes", "code"):
                place = "nothing selected: no region answers it"
            else:
                place = "nothing selected"
            count, score = f"{told['count']} of {told['of']} Gaussians", f"score {told['score']:.3f}"
            score += "" if item.quantile is None else f", {quantile_message(item.quantile)}"
            unheld = "regions" in told["left_out"]
            where = "its parts, as no region holds it" if unheld else f"region {told['region']}"
            listener.say(f"{item.question!r}: {count}, {score}, {where}, {place}")
            if dropped := outliers_message(told["outliers"]):
                listener.note(dropped)
            else:
                dropped = "no outliers dropped"
            words = f"{count} by {item.by}; {score}; {where}; {dropped}; {place}."
            overlays = {t: pictures.selection_overlay(renderer.photo(t), mask) for t, mask in shown.items()}
            figures = [report.figure(image, field.names[t]) for t, image in overlays.items()]
            parts.append(report.section(item.question, words, report.grid(figures, 3)))
            progress(n + 1, len(answers))
    write_text(out / "answers.html", report.page("Answers", "The selection's own mask over the rendered scene.", parts))
    listener.say(f"pictures  {out / 'answers.html'}")
    return {"written": {"folder": out, "pictures": out / "answers.html"}, "answers": figures_of}


def outliers_message(outliers: dict[str, Any]) -> str:
    """What DBSCAN dropped of an answer, and how to keep it; "" where it dropped nothing."""
    if not outliers["dropped"]:
        return ""
    many = outliers["clusters_dropped"]
    clusters = f", {many} smaller cluster{'s' if many > 1 else ''} among them" if many else ""
    part = f"{outliers['dropped']} of {outliers['of_selected']} selected Gaussians stand apart and were dropped"
    return f"{part}{clusters}; --keep-outliers keeps them"
