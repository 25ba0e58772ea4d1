"""New photographs of a scene that has a field: their poses, their labels, and what they contribute to the ledger."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Bool, UInt8
from scipy import sparse

from jsecon.association.frame_superpixels import FrameSuperpixels, frame_superpixels, label_by_regions
from jsecon.errors import InputError, join_first
from jsecon.field.columns import votes_of_rows
from jsecon.field.evidence import IGNORED, pack_evidence, plan_evidence
from jsecon.field.ledger import Ledger, LedgerView, camera_row, view_order
from jsecon.field.membership import LABELLED_PART, SHARE_THRESHOLD
from jsecon.files import parse_json
from jsecon.fit.resize import resize_camera, resize_capture, resize_frame
from jsecon.poses.resection import MIN_INLIERS, pose_finder
from jsecon.read.captures.build import build_capture
from jsecon.read.captures.capture import lone_photographs, read_posed_images
from jsecon.read.captures.frames import FrameOptions, frame_names, move_capture, take_frames
from jsecon.read.captures.images import encode_jpeg, read_image
from jsecon.read.masks.masks import load_proposals
from jsecon.read.masks.nesting import outermost
from jsecon.splat.sh import C0
from jsecon.types import Capture, LanguageField, Progress, Votes
from jsecon.vision.classical import ClassicalSegmenter
from jsecon.vision.protocols import Embedder

MIN_CORRELATION = 0.75
"""Least correlation of a photograph with what the scene shows from its pose. Held-out ones of fox and bonsai have
0.95 and more from their own poses, and up to 0.72 from those of their neighbours."""


def read_frames(
    field: LanguageField,
    ledger: Ledger,
    photos: Path | Capture,
    poses: Path | None,
    refuse: Callable[[InputError], None],
    progress: Progress,
) -> Capture:
    """Reads photographs, finds poses that they lack, and leaves out those that the field has.

    They are in the field's world and of the size of its frames. `refuse` gets the error of each photograph that cannot
    be read or placed.
    """
    if isinstance(photos, Path) and poses is None:
        files = lone_photographs(photos)
        if files:
            names = frame_names([file.name for file in files], photos)
            return _place(field, ledger, _without_known(field, names, files), refuse, progress)
    capture = photos if isinstance(photos, Capture) else _read_capture(field, photos, poses)
    rows = [*_without_known(field, capture.names, range(len(capture.names))).values()]
    capture = move_capture(take_frames(capture, rows), field.source_from_scene)
    return resize_capture(capture, resize_camera(capture.cameras, field.cameras.width, field.cameras.height))


def _without_known(field: LanguageField, names: Sequence[str], items: Sequence[Any]) -> dict[str, Any]:
    """Leaves out frames that the field has by their names."""
    new = dict(zip(names, items))
    fresh = {name: new[name] for name in sorted({*new} - {*field.names}, key=view_order)}
    if not fresh:
        problem = f"the field has frames of all {len(new)} names already ({join_first(list(new))})"
        raise InputError("photographs", problem, remedy="Forget them first (jsecon forget), or rename the new ones.")
    return fresh


def _read_capture(field: LanguageField, photos: Path, poses: Path | None) -> Capture:
    """Reads a capture, or photographs whose poses are in another file; only what the field lacks."""
    posed = read_posed_images(photos if poses is None else poses)
    images = list(posed.images)
    if poses is not None:
        files = {file.name: file for file in (photos.rglob("*") if photos.is_dir() else [photos])}
        images = [replace(i, image=files[Path(i.name).name]) for i in images if Path(i.name).name in files]
        if not images:
            problem = f"none of its {len(posed.images)} poses is of a photograph in {photos}"
            raise InputError(poses, problem, remedy="Names of photographs must be those that the poses name.")
    new = _without_known(field, frame_names([image.name for image in images], photos), images)
    size = FrameOptions(long_side=max(field.cameras.width, field.cameras.height), holdout=0)
    return build_capture(replace(posed, images=list(new.values())), size)


def _place(
    field: LanguageField,
    ledger: Ledger,
    files: Mapping[str, Path],
    refuse: Callable[[InputError], None],
    progress: Progress,
) -> Capture:
    """Finds the poses of photographs by the pictures of the ledger."""
    rows = [t for t, name in enumerate(field.names) if name in ledger.views]
    views = jax.tree.map(lambda a: np.asarray(a)[rows], field.cameras)
    find_pose = pose_finder(field.gaussians, views, [_decode_jpeg(ledger.views[field.names[t]].picture) for t in rows])
    names, cameras, frames = [], [], []
    for done, (name, file) in enumerate(files.items()):
        try:
            photo = read_image(file)
        except InputError as error:
            refuse(error)
            continue
        size = FrameOptions(long_side=max(views.width, views.height)).size(photo.shape[1::-1])
        photo = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        camera, inliers = find_pose(photo)
        if camera is None:
            problem = f"only {inliers} of its features agree with the field on a pose, {MIN_INLIERS} needed"
            remedy = "Photograph more of what the field shows, from nearer to its views, or give its pose (--poses)."
            refuse(InputError(file, problem, remedy=remedy))
        else:
            names.append(name)
            cameras.append(resize_camera(camera, views.width, views.height))
            frames.append(resize_frame(photo, cameras[-1]))
        progress(done + 1, len(files))
    pixels = np.array(frames, np.uint8).reshape(-1, views.height, views.width, 3)
    placed = jax.tree.map(lambda *columns: np.stack(columns), *cameras) if cameras else views[:0]
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(len(names), bool), None
    return Capture(pixels, placed, *nothing, np.asarray(field.source_from_scene), tuple(names))


def _decode_jpeg(data: UInt8[np.ndarray, " b"]) -> UInt8[np.ndarray, "h w 3"]:
    """Decodes what `encode_jpeg` encoded; ValueError if it is damaged."""
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise ValueError("a picture is no JPEG")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def make_views(
    field: LanguageField,
    capture: Capture,
    embedder: Embedder,
    masks: Path | None,
    refuse: Callable[[InputError], None],
    progress: Progress,
    things: Mapping[str, Bool[np.ndarray, "m h w"]],
) -> dict[str, LedgerView]:
    """Labels new frames (`read_frames`) with the field's regions, embeds these, and lists their evidence.

    `refuse` gets the error of each photograph that is unlike the scene. `things` has masks in some frames, by their
    names, of what no view of the field saw.
    """
    options = parse_json(field.provenance).get("options", {})
    propose = ClassicalSegmenter()
    if masks is not None:
        size = field.cameras.height, field.cameras.width
        read = load_proposals(masks, list(capture.names), size, level=options.get("level", "l"))[0]
        outer = outermost if options.get("masks") and field.part_nodes is not None else np.asarray
        propose = lambda pixels, index: outer(read(index))  # noqa: E731
    gaussians = jax.device_put(replace(field.gaussians, sh=None))  # as a run's, whose programs are compiled
    votes, views, opened = jax.tree.map(np.asarray, field.votes), {}, []
    held = (votes.labelled >= LABELLED_PART * SHARE_THRESHOLD * votes.total) & (votes.views > 0)
    strongest, uncovered = votes.regions[:, 0], np.zeros(len(held), bool)
    for event in field.history:  # what lay behind a thing that went has the votes of that thing's pixels
        uncovered |= np.isin(strongest, strongest[event.rows]) & ~np.isin(np.arange(len(held)), event.rows)
    owner = np.where(held & ~uncovered, strongest, -1)
    # Without masks from outside, leftovers that many views left without a region stay so.
    unknown = (owner < 0) if masks is not None else votes.views == 0
    for t, name in enumerate(capture.names):
        pixels, camera = np.asarray(capture.frames[t]), capture.cameras[t]
        list_labels = plan_evidence(gaussians, camera, centre_pixel_weight=options.get("centre_pixel_weight", 0.0))
        proposals = propose(pixels, t)
        if name in things:  # first: what covers them too opens no other region
            proposals = np.concatenate([things[name], proposals])
        view = frame_superpixels(pixels, proposals, list_labels)
        progress(t + 1, len(capture.names))
        if name not in things and (like := _likeness(view, field, pixels)) < MIN_CORRELATION:
            problem = (
                f"it does not look like the scene from its pose (correlation {like:.2f}, {MIN_CORRELATION} needed)"
            )
            remedy = "Give poses in the world of the field's capture, or the photographs alone to find their poses."
            refuse(InputError(f"photograph {name}", problem, remedy=remedy))
            continue
        seen = view.seen
        shares = _region_shares(votes_of_rows(votes, seen), votes.num_regions, ~uncovered[seen])
        consensus = sparse.hstack([shares, *(part[seen] for part in opened)], "csr")
        labels, new = label_by_regions(view, owner[seen], consensus, unknown[seen], split=masks is not None)
        if capture.ignored is not None:
            labels = np.where(capture.ignored[t], IGNORED, labels)
        old = votes.num_regions + sum(part.shape[1] for part in opened)
        count = old + new
        evidence = list_labels(labels, count)
        if new:  # the next frame may show them too
            view_weights = evidence.matrix(len(owner), count)
            opened.append(view_weights[:, old:count].multiply(1 / np.maximum(view_weights.sum(1), 1e-9)).tocsr())
        shown, areas = np.unique(labels[labels >= 0], return_counts=True)
        rows = np.asarray(embedder.embed_regions(pixels, labels[None] == shown[:, None, None]), np.float32)
        pixel_counts = np.stack([shown, areas]).astype(np.int32)
        packed = pack_evidence(evidence, count)
        views[name] = LedgerView(packed, pixel_counts, pixel_counts[0], rows, camera_row(camera), encode_jpeg(pixels))
    return views


def _region_shares(votes: Votes, num_regions: int, counts: Bool[np.ndarray, " n"]) -> Any:
    """Returns the share (N, R) of each Gaussian that counts in its regions, over the views that see both."""
    rows, columns = np.nonzero(votes.weights * counts[:, None])
    seen = votes.total[:, None] if votes.weight_where_region_visible is None else votes.weight_where_region_visible
    share = (votes.weights / np.maximum(seen, 1e-9))[rows, columns]
    return sparse.csr_matrix((share, (rows, votes.regions[rows, columns])), (len(votes.total), num_regions))


def _likeness(view: FrameSuperpixels, field: LanguageField, pixels: UInt8[np.ndarray, "h w 3"]) -> float:
    """Correlates the mean colours of a photograph's superpixels with those of the Gaussians that lie on them."""
    flat, labels = pixels.reshape(-1, 3), view.labels.reshape(-1)
    area = np.bincount(labels)
    photo = np.stack([np.bincount(labels, column) for column in flat.T], 1) / area[:, None]
    colours = np.clip(0.5 + C0 * np.asarray(field.gaussians.sh)[view.seen, 0], 0, 1)
    total = np.maximum(np.asarray(view.votes.sum(0)).ravel(), 1e-6)
    shown = view.votes.T @ colours / total[:, None]
    weight = np.where(total >= 0.2 * area, area, 0)
    if not weight.any():
        return 0.0
    spread = np.sum([np.cov(*columns, aweights=weight, ddof=0) for columns in zip(photo.T, shown.T)], axis=0)
    return float(spread[0, 1] / max(np.sqrt(spread[0, 0] * spread[1, 1]), 1e-9))
