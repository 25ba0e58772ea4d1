"""One question put to a field, and its answer as files: a .ply of the Gaussians, a JSON of figures, a few masks.

Read on the way from a text to its .ply, without the ground; behind each file lies more of its own room, behind
splat/transform and query/masks the engine, behind `by="silhouette"` query/silhouette:

    ask     app/question, language/field, vision/colours, query/several, query/anchored, query/retrieval
    clean   language/shares, query/outliers
    write   query/masks, splat/transform, data/ply
"""

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jsecon.data.ply import save_ply
from jsecon.errors import InputError, require
from jsecon.files import write_text, written_whole
from jsecon.language.shares import SHARE_THRESHOLD, membership_probability
from jsecon.query.anchored import query_anchored, query_region
from jsecon.query.direct import query_canonical, query_one_step
from jsecon.query.masks import selection_mask
from jsecon.query.outliers import MIN_SAMPLES, default_eps, one_component, remove_outliers
from jsecon.query.parts import query_parts
from jsecon.query.pixel import region_at
from jsecon.query.several import parts_of_question, query_several
from jsecon.query.silhouette import silhouette_members
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Gaussians, LanguageField, Selection

METHODS = ("votes", "silhouette", "code", "one_step", "canonical")
"""votes, code: anchored, membership by a Gaussian's votes or its code; silhouette: by votes, then one by one by the
outline that they make; one_step, canonical: codes against the text"""
ONE_STEP_THRESHOLD = 0.8
"""on the cosine of a Gaussian's code and the text's"""
CANONICAL_THRESHOLD = 0.5
"""on the relevancy: closer to the text than to every canonical phrase"""


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a question selected."""

    question: str
    by: str
    """one of METHODS."""
    selection: Selection
    """as the query gave it."""
    mask: np.ndarray
    """(N,) bool: the selection without outliers."""
    left_out: dict[str, str]
    """part -> why it was not needed."""

    @property
    def dropped(self) -> int:
        """Gaussians dropped as outliers."""
        return int(np.asarray(self.selection.mask).sum() - self.mask.sum())


def ask_text(
    field: LanguageField,
    embedder: Any,
    text: str,
    *,
    by: str = "votes",
    threshold: float | None = None,
    outliers: bool = True,
    several: bool = False,
) -> Answer:
    """The Gaussians that a text names; with `several`, of all regions that answer it (`query_several` has the rule).

    A text may be composite: `"red mug" or "bowl" but not "handle"`. Raises InputError where the embedder has no words
    for a part, and for several regions or a composite text by anything but votes.
    """
    require(by in METHODS, "by", by, f"one of {METHODS}", "votes is the default.")
    if not len(field.canonical):  # its embeddings came from files, without phrases: those of who reads the text
        field = dataclasses.replace(field, canonical=np.asarray(embedder.canonical, np.float32))
    wanted, unwanted = parts_of_question(text)
    if several or unwanted or len(wanted) > 1:
        if by not in ("votes", "silhouette"):
            remedy = "Leave out --by, or ask for one thing."
            raise InputError(text, f"several regions by {by}", "by votes or silhouette", remedy)
        given: dict[str, Any] = {} if threshold is None else {"similarity_threshold": threshold}
        embedded = jax.device_put(embedder.embed_text(wanted + unwanted))
        selection = query_several(field, embedded[: len(wanted)], embedded[len(wanted) :], several=several, **given)
        if several and field.parts is not None:
            selection = query_parts(field, selection, embedded[: len(wanted)])
        return _answer(field, text, by, _shaped(field, selection, by, threshold), outliers, {}, keep="all")
    embedding = jax.device_put(embedder.embed_text([text])[0])
    if by in ("votes", "silhouette", "code"):
        selection = query_anchored(field, embedding, by=_membership(by), similarity_threshold=threshold)
        selection = _shaped(field, selection, by, threshold)
    else:
        from jsecon.language.codes import encode

        code = encode(field.autoencoder, embedding)
        usual = ONE_STEP_THRESHOLD if by == "one_step" else CANONICAL_THRESHOLD
        least = usual if threshold is None else threshold
        if by == "one_step":
            selection = query_one_step(field.codes, code, least)
        else:
            canonical = encode(field.autoencoder, jnp.asarray(field.canonical))
            selection = query_canonical(field.codes, code, canonical, least)
    return _answer(field, text, by, selection, outliers, {})


def ask_pixel(
    field: LanguageField,
    frame: int | str,
    x: int,
    y: int,
    *,
    by: str = "votes",
    threshold: float | None = None,
    outliers: bool = True,
) -> Answer:
    """The Gaussians of what lies under pixel (column x, row y) of a frame (its index or name); no text is embedded.

    Raises InputError for a frame or pixel that the field does not have, and where no region lies there.
    """
    index = frame_index(field, frame)
    region = region_at(field, index, x, y)
    name = field.names[index]
    if region < 0:
        remedy = "Choose another pixel or frame: report.html of the run shows the regions."
        raise InputError(f"--at {name} {x} {y}", "no region under that pixel", "a pixel of an object", remedy)
    by = by if by in ("silhouette", "code") else "votes"
    selection = query_region(field, region, by=_membership(by), similarity_threshold=threshold)
    selection = _shaped(field, selection, by, threshold)
    left = {"text encoder": "the region under the pixel is the anchor"}
    return _answer(field, f"at {name} {x} {y}", by, selection, outliers, left)


def _membership(by: str) -> str:
    return "code" if by == "code" else "votes"


def _shaped(field: LanguageField, selection: Selection, by: str, threshold: float | None) -> Selection:
    """By "silhouette" the Gaussians whose outline fits the shares best in the field's views; else as it is."""
    if by != "silhouette":
        return selection
    least = SHARE_THRESHOLD if threshold is None else threshold
    mask = silhouette_members(field.gaussians, field.cameras, selection.similarity, threshold=least)
    return dataclasses.replace(selection, mask=mask & (selection.region >= 0))


def frame_index(field: LanguageField, frame: int | str) -> int:
    """A frame's index from its index or its name. Raises InputError for one that the field does not have."""
    for name in (str(frame), Path(str(frame)).stem):
        if name in field.names:
            return field.names.index(name)
    if str(frame).isdecimal() and int(frame) < len(field.names):
        return int(frame)
    known = f"0 to {len(field.names) - 1}, or a name ({field.names[0]} ... {field.names[-1]})"
    raise InputError(f"frame {frame}", "no such frame in the field", known, "Held-out frames are not in the field.")


def _answer(
    field: LanguageField,
    question: str,
    by: str,
    selection: Selection,
    outliers: bool,
    left: dict[str, str],
    keep: str = "largest",
) -> Answer:
    mask, means = np.asarray(selection.mask), np.asarray(field.gaussians.means)
    points = means[mask].astype(np.float64)
    if not outliers:
        left = left | {"DBSCAN": "not asked for"}
    elif len(points) < MIN_SAMPLES:
        left = left | {"DBSCAN": f"fewer than {MIN_SAMPLES} Gaussians are selected"}
    elif np.isfinite(points).all() and one_component(points, default_eps(points)):
        left = left | {"DBSCAN": "the selection is one component"}
    else:
        mask = remove_outliers(means, mask, keep=keep)
    return Answer(question, by, selection, mask, left)


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


def _figures(field: LanguageField, answer: Answer, chosen: Gaussians) -> dict[str, Any]:
    """What there is to say about an answer: count, score, region, and the place of the Gaussians `chosen`."""
    means = np.asarray(chosen.means, np.float64)
    place = sure = None
    if len(means):
        box = {"min": means.min(0).round(6).tolist(), "max": means.max(0).round(6).tolist()}
        place = {"centroid": means.mean(0).round(6).tolist(), "bounding_box": box}
    region = int(answer.selection.region)
    if answer.by == "votes" and len(means):
        probability = np.asarray(membership_probability(answer.selection.similarity, field.votes))[answer.mask]
        sure = {"mean": round(float(probability.mean()), 4), "tenth": round(float(np.quantile(probability, 0.1)), 4)}
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
    }


def write_answer(
    field: LanguageField, answer: Answer, out: Path, masks: Mapping[int, Bool[np.ndarray, "h w"]]
) -> dict[str, Any]:
    """Writes OUT/<slug>.ply, .json, and <slug>-<frame>.png of `masks` (by frame, see `masks_of`); returns the figures.

    The .ply is in the capture files' own world, in INRIA's layout. An empty selection leaves out the .ply and the
    masks.
    """
    slug = slug_of(answer.question)
    chosen = transform_gaussians(selected(field.gaussians, answer.mask), field.to_source)
    told = _figures(field, answer, chosen) | {"ply": None, "masks": {}}
    if answer.mask.any():
        told["ply"] = f"{slug}.ply"
        save_ply(out / told["ply"], chosen)
        for t, mask in masks.items():
            told["masks"][field.names[t]] = f"{slug}-{field.names[t]}.png"
            with written_whole(out / told["masks"][field.names[t]]) as temporary:
                cv2.imwrite(str(temporary), mask.astype(np.uint8) * 255)
    write_text(out / f"{slug}.json", json.dumps(told, indent=2) + "\n")
    return told


def masks_of(field: LanguageField, answer: Answer, views: int) -> dict[int, Bool[np.ndarray, "h w"]]:
    """frame -> (H, W) bool of the `views` best frames: where the selected Gaussians alone have an alpha above 0.7."""
    gaussians, mask = jax.device_put((field.gaussians, answer.mask))
    cameras = jax.tree.map(np.asarray, field.cameras)  # whose items compile nothing
    frames = best_frames(field, answer, views)
    return {t: np.asarray(selection_mask(gaussians, cameras[t], mask)) for t in frames}


def slug_of(question: str) -> str:
    """A file name without spaces or signs."""
    return re.sub(r"[^\w]+", "-", question.lower()).strip("-")[:80] or "query"
