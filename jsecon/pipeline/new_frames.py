"""New photographs of a scene that has a field: their poses, their labels, and what they contribute to the ledger."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import UInt8

from jsecon.association.scene import FrameSuperpixels, SceneSuperpixels, label_by_regions
from jsecon.errors import InputError, join_first
from jsecon.field.evidence import pack_evidence, view_evidence
from jsecon.field.ledger import Ledger, LedgerView, camera_row, view_order
from jsecon.field.membership import LABELLED_PART, SHARE_THRESHOLD
from jsecon.fit.resize import resize_camera, resize_frame
from jsecon.poses.resection import MIN_INLIERS, Landmarks, find_pose
from jsecon.read.captures.build import build_capture
from jsecon.read.captures.capture import read_posed_images, unposed_photographs
from jsecon.read.captures.frames import FrameOptions, frame_names, transform_poses
from jsecon.read.captures.images import decode_jpeg, encode_jpeg, is_photograph, read_image
from jsecon.read.masks.masks import load_proposals
from jsecon.splat.sh import C0
from jsecon.types import Camera, Capture, LanguageField, Progress
from jsecon.vision.classical import GRANULARITIES, ClassicalSegmenter
from jsecon.vision.protocols import Embedder

MIN_CORRELATION = 0.7
"""Correlation of a photograph with what the scene shows from its pose, below which they do not belong together."""


class NewFrame(NamedTuple):
    """A photograph at the size of a field's frames."""

    pixels: UInt8[np.ndarray, "h w 3"]
    camera: Camera
    """In the field's world."""


def read_frames(
    field: LanguageField,
    ledger: Ledger,
    photos: Path | Capture,
    poses: Path | None,
    refuse: Callable[[InputError], None],
    progress: Progress,
) -> dict[str, NewFrame]:
    """Reads photographs, finds poses that they lack, and leaves out those that the field has.

    `refuse` gets the error of each photograph that cannot be read or placed.
    """
    if isinstance(photos, Path) and poses is None and (files := _photographs(photos)):
        names = dict(zip(frame_names([file.name for file in files], photos), files))
        new = _without_known(field, names, photos)
        return _place(field, ledger, new, refuse, progress)
    capture = photos if isinstance(photos, Capture) else _read_capture(field, photos, poses)
    scene_from_capture = np.linalg.inv(field.source_from_scene) @ np.asarray(capture.source_from_scene)
    moved = transform_poses(np.asarray(capture.cameras.world_to_camera), scene_from_capture)
    cameras = dataclasses.replace(capture.cameras, world_to_camera=moved.astype(np.float32))
    cameras = jax.tree.map(np.asarray, cameras)
    rows = _without_known(field, {name: t for t, name in enumerate(capture.names)}, "photographs")
    frames = {}
    for done, (name, t) in enumerate(rows.items()):
        frames[name] = _sized(field, np.asarray(capture.frames[t]), cameras[t])
        progress(done + 1, len(rows))
    return frames


def _photographs(path: Path) -> list[Path]:
    """Lists photographs without poses: one file, or those of a folder."""
    if path.is_file() and is_photograph(path):
        return [path]
    return unposed_photographs(path)[0]


def _without_known(field: LanguageField, new: Mapping[str, Any], where: object) -> dict[str, Any]:
    """Leaves out frames that the field has by their names, in order."""
    fresh = {name: new[name] for name in sorted(new, key=view_order) if name not in field.names}
    if not fresh:
        problem = f"the field has frames of all {len(new)} names already ({join_first(list(new))})"
        raise InputError(where, problem, remedy="Forget them first (jsecon forget), or rename the new ones.")
    return fresh


def _read_capture(field: LanguageField, photos: Path, poses: Path | None) -> Capture:
    """Reads a capture, or photographs whose poses are in another file."""
    posed = read_posed_images(photos if poses is None else poses)
    if poses is not None:
        folder = photos if photos.is_dir() else photos.parent
        files = {file.name: file for file in folder.rglob("*") if file.is_file()}
        chosen = {photos.name} if photos.is_file() else set(files)
        images = [image for image in posed.images if Path(image.name).name in chosen]
        if not images:
            problem = f"none of its {len(posed.images)} poses is of a photograph in {photos}"
            raise InputError(poses, problem, remedy="Names of photographs must be those that the poses name.")
        images = [dataclasses.replace(image, image=files[Path(image.name).name]) for image in images]
        posed = dataclasses.replace(posed, images=images)
    missing = dataclasses.replace(posed, images=[i for i in posed.images if _frame_name(i.name) not in field.names])
    posed = missing if missing.images else posed
    return build_capture(posed, FrameOptions(long_side=max(field.cameras.width, field.cameras.height), holdout=0))


def _frame_name(name: str) -> str:
    return frame_names([name], "")[0]


def _sized(field: LanguageField, pixels: UInt8[np.ndarray, "h w 3"], camera: Camera) -> NewFrame:
    """Brings a photograph to the size of the field's frames, each axis by its own factor."""
    camera = resize_camera(camera, field.cameras.width, field.cameras.height)
    return NewFrame(resize_frame(pixels, camera), camera)


def _place(
    field: LanguageField,
    ledger: Ledger,
    files: Mapping[str, Path],
    refuse: Callable[[InputError], None],
    progress: Progress,
) -> dict[str, NewFrame]:
    """Finds the poses of photographs by the pictures of the ledger."""
    rows = [t for t, name in enumerate(field.names) if name in ledger.views]
    cameras = jax.tree.map(lambda a: np.asarray(a)[rows], field.cameras)
    pictures = [decode_jpeg(ledger.views[field.names[t]].picture) for t in rows]
    landmarks = Landmarks(field.gaussians, cameras, pictures)
    side, frames = max(cameras.width, cameras.height), {}
    for done, (name, file) in enumerate(files.items()):
        try:
            photo, _ = read_image(file)
        except InputError as error:
            refuse(error)
            continue
        small = min(side / max(photo.shape[:2]), 1.0)
        size = Camera(np.eye(4), *np.ones(4), *(max(round(length * small), 1) for length in photo.shape[1::-1]))
        photo = resize_frame(photo, size)
        found = find_pose(photo, landmarks)
        if found.camera is None:
            problem = f"only {found.inliers} of its features agree with the field on a pose, {MIN_INLIERS} needed"
            remedy = "Photograph more of what the field shows, from nearer to its views, or give its pose (--poses)."
            refuse(InputError(file, problem, remedy=remedy))
        else:
            frames[name] = _sized(field, photo, found.camera)
        progress(done + 1, len(files))
    return frames


def make_views(
    field: LanguageField,
    ledger: Ledger,
    frames: Mapping[str, NewFrame],
    embedder: Embedder,
    masks: Path | None,
    refuse: Callable[[InputError], None],
    progress: Progress,
) -> dict[str, LedgerView]:
    """Labels new frames with the field's regions, embeds these, and lists their evidence.

    `refuse` gets the error of each photograph that is unlike the scene.
    """
    options = json.loads(field.provenance).get("options", {})
    centre = {"centre_pixel_weight": float(options.get("centre_pixel_weight", 0.0))}
    segment = ClassicalSegmenter(**GRANULARITIES[options.get("granularity", "medium")])
    proposals = None
    if masks is not None:
        size = field.cameras.height, field.cameras.width
        proposals, _ = load_proposals(masks, list(frames), size, level=options.get("level", "l"))
    gaussians = jax.device_put(dataclasses.replace(field.gaussians, sh=None))  # as a run's, whose programs are compiled
    votes, count, views = jax.tree.map(np.asarray, field.votes), ledger.num_regions, {}
    held = (votes.labelled >= LABELLED_PART * SHARE_THRESHOLD * votes.total) & (votes.views > 0)
    owner = np.where(held, votes.regions[:, 0], -1)
    # Without masks from outside, leftovers that many views left without a region stay so.
    unknown = (owner < 0) if masks is not None else votes.views == 0
    for done, (name, (pixels, camera)) in enumerate(frames.items()):
        found = segment(pixels, 0) if proposals is None else proposals(done)
        batch = jax.tree.map(lambda a: np.asarray(a)[None], camera)
        view = SceneSuperpixels(gaussians, batch, [found], **centre).all(pixels[None])[0]
        progress(done + 1, len(frames))
        if (like := _likeness(view, field, pixels)) < MIN_CORRELATION:
            problem = (
                f"it does not look like the scene from its pose (correlation {like:.2f}, {MIN_CORRELATION} needed)"
            )
            remedy = "Give poses in the world of the field's capture, or the photographs alone to find their poses."
            refuse(InputError(f"photograph {name}", problem, remedy=remedy))
            continue
        labels, new = label_by_regions(view, owner, count, unknown, split=masks is not None)
        evidence = view_evidence(gaussians, camera, labels, count + new, **centre)
        if new:  # the next frame may show them too
            opened = evidence.matrix(len(owner), count + new)[:, count : count + new]
            strongest = np.asarray(opened.argmax(1)).ravel()
            most = (np.asarray(opened.sum(1)).ravel() > 0) & unknown
            owner, unknown = np.where(most, count + strongest, owner), unknown & ~most
        count += new
        shown, areas = np.unique(labels[labels >= 0], return_counts=True)
        rows = np.asarray(embedder.embed_regions(pixels, labels[None] == shown[:, None, None]), np.float32)
        pixel_counts = np.stack([shown, areas]).astype(np.int32)
        packed = pack_evidence(evidence, count)
        views[name] = LedgerView(packed, pixel_counts, pixel_counts[0], rows, camera_row(camera), encode_jpeg(pixels))
    return views


def _likeness(view: FrameSuperpixels, field: LanguageField, pixels: UInt8[np.ndarray, "h w 3"]) -> float:
    """Correlates the mean colours of a photograph's superpixels with those of the Gaussians that lie on them."""
    flat, labels = pixels.reshape(-1, 3), view.labels.reshape(-1)
    area = np.bincount(labels)
    photo = np.stack([np.bincount(labels, column) for column in flat.T], 1) / area[:, None]
    colours = np.clip(0.5 + C0 * np.asarray(field.gaussians.sh)[view.seen, 0], 0, 1)
    total = np.maximum(np.asarray(view.votes.sum(0)).ravel(), 1e-6)
    pair = np.stack([photo, view.votes.T @ colours / total[:, None]]) * 1.0
    weight = np.where(total >= 0.2 * area, area, 0.0)[:, None] / area.sum()
    pair -= (pair * weight).sum(1, keepdims=True) / max(weight.sum(), 1e-9)
    squares = (pair**2 * weight).sum((1, 2))
    return float((pair[0] * pair[1] * weight).sum() / max(np.sqrt(squares.prod()), 1e-9))
