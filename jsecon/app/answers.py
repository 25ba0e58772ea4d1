"""An answer as files: one of the Gaussians, a JSON of figures, a few masks."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Bool

from jsecon.app.question import Answer
from jsecon.app.splat_page import NOWHERE, regions_of
from jsecon.data.gaussian_files import save_gaussians
from jsecon.files import write_text, written_whole
from jsecon.language.field import field_of_rows
from jsecon.language.shares import probability_inside
from jsecon.query.masks import selection_mask
from jsecon.splat.transform import carried
from jsecon.types import Gaussians, LanguageField


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
    return field if answer.rows is None else field_of_rows(field, answer.rows)


def _figures(field: LanguageField, answer: Answer, chosen: Gaussians) -> dict[str, Any]:
    """What there is to say about an answer: count, score, region, and the place of the Gaussians `chosen`."""
    means = np.asarray(chosen.means, np.float64)
    place = sure = None
    if len(means):
        box = {"min": means.min(0).round(6).tolist(), "max": means.max(0).round(6).tolist()}
        place = {"centroid": means.mean(0).round(6).tolist(), "bounding_box": box}
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
        "region": region if region >= 0 else None,
        "probability": sure,
        "outliers_dropped": answer.dropped,
        "place": place,
        "left_out": answer.left_out,
    } | ({} if answer.frames is None else {"frames": dict(answer.frames)})


def write_answer(
    field: LanguageField,
    answer: Answer,
    out: Path,
    masks: Mapping[int, Bool[np.ndarray, "h w"]],
    *,
    ending: str = "ply",
) -> dict[str, Any]:
    """Writes OUT/<slug>.ply (or .spz, .glb: `ending`), .json, and <slug>-<frame>.png of `masks` (by frame, see
    `masks_of`); returns the figures. An empty selection leaves out the Gaussians and the masks.
    """
    slug, count = slug_of(answer.question), field.gaussians.count
    field = part_of(field, answer)
    chosen = carried(selected(field.gaussians, answer.mask), field.to_source)
    told = _figures(field, answer, chosen) | {"of": count, ending: None, "masks": {}}
    if answer.mask.any():
        told[ending] = f"{slug}.{ending}"
        own = {"codes": np.asarray(field.codes), "regions": _regions(field)} if ending == "glb" else {}
        save_gaussians(out / told[ending], chosen, **{name: table[answer.mask] for name, table in own.items()})
        for t, mask in masks.items():
            told["masks"][field.names[t]] = f"{slug}-{field.names[t]}.png"
            with written_whole(out / told["masks"][field.names[t]]) as temporary:
                temporary.write_bytes(cv2.imencode(".png", mask.astype(np.uint8) * 255)[1].tobytes())
    write_text(out / f"{slug}.json", json.dumps(told, indent=2) + "\n")
    return told


def save_scene(field: LanguageField, file: Path) -> None:
    """Writes all Gaussians in the capture files' own world, in blocks: a mapped field need not fit into memory. With
    their codes and regions where the file is a .glb."""
    own = {"codes": field.codes, "regions": _regions(field)} if file.suffix.lower() == ".glb" else {}
    save_gaussians(file, field.gaussians, similarity=field.to_source, **own)


def _regions(field: LanguageField) -> np.ndarray:
    """(N,) as a .glb holds them: -1 = none."""
    regions = regions_of(field)
    return np.where(regions == NOWHERE, -1, regions)


def masks_of(field: LanguageField, answer: Answer, views: int) -> dict[int, Bool[np.ndarray, "h w"]]:
    """frame -> (H, W) bool of the `views` best frames: where the selected Gaussians alone have an alpha above 0.7."""
    field = part_of(field, answer)
    gaussians, mask = jax.device_put((field.gaussians, answer.mask))
    cameras = jax.tree.map(np.asarray, field.cameras)  # whose items compile nothing
    frames = best_frames(field, answer, views)
    return {t: np.asarray(selection_mask(gaussians, cameras[t], mask)) for t in frames}


def slug_of(question: str) -> str:
    """A file name without spaces or signs."""
    return re.sub(r"[^\w]+", "-", question.lower()).strip("-")[:80] or "query"
