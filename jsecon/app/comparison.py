"""What changed in a scene: a field and its catalogue against a capture, or against another splat of the same place."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import cv2
import jax
import numpy as np

from jsecon.app.catalogue import Catalogue
from jsecon.app.records import rounded, source_points
from jsecon.change.detect import Change, object_changes
from jsecon.change.history import add_objects, add_unseen, dates, move_object, remove_object
from jsecon.errors import InputError
from jsecon.field.evidence import ViewEvidence, pack_evidence
from jsecon.field.ledger import Ledger, LedgerView, camera_row
from jsecon.fit.resize import resize_camera, resize_frame, resize_mask, shrink_cameras
from jsecon.read.captures.frames import evenly_spaced, transform_poses
from jsecon.read.captures.images import encode_jpeg
from jsecon.splat.points import back_project, gaussians_from_points
from jsecon.splat.render import render_depth
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Camera, Capture, Gaussians, LanguageField
from jsecon.views.capture import render_capture
from jsecon.views.frame import field_up
from jsecon.vision.protocols import Embedder

if TYPE_CHECKING:
    from jsecon.pipeline.new_frames import NewFrame

LONG_SIDE = 320
"""Longest side at which photographs are compared, px."""


@dataclasses.dataclass(frozen=True)
class Changes:
    """What changed in a scene, with its capture.

    Attributes:
      field: The field before.
      catalogue: Its objects.
      capture: The photographs that it was compared with, in the field's world and at the size of the comparison.
      found: What became of each object of the catalogue, surroundings apart, then what is new.
    """

    field: LanguageField = dataclasses.field(repr=False)
    catalogue: Catalogue = dataclasses.field(repr=False)
    capture: Capture = dataclasses.field(repr=False)
    found: tuple[Change, ...]

    def records(self) -> list[dict[str, Any]]:
        """Plain values of each change for JSON, in the capture's world."""
        return [self._record(change) for change in self.found]

    def _record(self, change: Change) -> dict[str, Any]:
        field, listed, index = self.field, self.catalogue, change.object
        now, start = source_points(field, np.stack([change.place, change.start]))
        kind = change.suspected or change.kind
        cosine = (np.trace(change.motion[:3, :3]) - 1) / 2
        is_known = index >= 0
        return {
            "kind": change.kind,
            **({"suspected": change.suspected} if change.suspected else {}),
            "probability": round(change.probability, 3),
            "name": str(listed.names[index]) if is_known else "",
            "id": index if is_known else None,
            "region": _main_region(field, listed, index) if is_known else None,
            "from": None if kind == "new" else rounded(start, 1.0),
            "to": None if kind in ("gone", "not seen") else rounded(now, 1.0),
            "distance": round(float(np.linalg.norm(now - start)), 4),
            "turned_degrees": round(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), 1),
            "frames": [self.capture.names[t] for t in change.frames[:5]],
        }


def _main_region(field: LanguageField, catalogue: Catalogue, index: int) -> int:
    """The region that shows most of an object of the catalogue: its name for good, while ids are those of one field."""
    own = np.flatnonzero(catalogue.regions == index)
    pixels = np.asarray(field.regions.pixel_counts)[own].sum(1)
    return int(own[pixels.argmax()]) if len(own) else -1


def find_changes(field: LanguageField, listed: Catalogue, capture: Capture) -> Changes:
    """Compares a field with a capture whose poses are in the world of the field's own capture."""
    world = np.linalg.inv(np.asarray(field.source_from_scene, np.float64)) @ np.asarray(capture.source_from_scene)
    poses = transform_poses(np.asarray(capture.cameras.world_to_camera), world).astype(np.float32)
    cameras = dataclasses.replace(jax.tree.map(np.asarray, capture.cameras), world_to_camera=poses)
    cameras = shrink_cameras(cameras, LONG_SIDE)
    frames = np.stack([resize_frame(np.asarray(frame), cameras) for frame in capture.frames])
    depths = None
    if capture.depths is not None:
        size, scale = (cameras.width, cameras.height), float(np.cbrt(np.linalg.det(world[:3, :3])))
        nearest = functools.partial(cv2.resize, dsize=size, interpolation=cv2.INTER_NEAREST)
        depths = np.stack([nearest(np.asarray(depth)) for depth in capture.depths]) * np.float32(scale)
    things = np.append(~listed.surroundings, False)
    labels = np.where(things[listed.labels], listed.labels, -1)
    up = np.array(field_up(field).axis)
    found = object_changes(field.gaussians, labels, frames, cameras, depths, up=up)
    kept = [change for change in found if change.object < 0 or (labels == change.object).any()]
    capture = dataclasses.replace(capture, frames=frames, cameras=cameras, depths=depths)
    return Changes(field, listed, capture, tuple(kept))


def apply_changes(
    changes: Changes, embedder: Embedder, date: str, ledger: Callable[[], Ledger]
) -> tuple[LanguageField, Ledger | None]:
    """Applies changes to their field, with a date: what moved moves, what is gone is absent, what is new is added.

    Of which region a Gaussian is stays true, also if it moves. So the ledger grows only by what is new; the second
    result is None if it stays.
    """
    field, listed = changes.field, changes.catalogue
    if date < (last := dates(field)[-1]):
        raise InputError("--date", f"{date} is before the last change of the field, {last}", remedy="Check it.")
    found = [(change, record | {"date": date}) for change, record in zip(changes.found, changes.records())]
    for change, description in found:
        mask = (listed.labels == change.object) & (change.object >= 0)
        if change.kind == "moved":
            field = move_object(field, mask, change.motion, description)
        elif change.kind == "gone":
            field = remove_object(field, mask, np.flatnonzero(listed.regions == change.object).tolist(), description)
        elif change.kind == "look":
            field = remove_object(field, mask & False, (), description)
    new = [(change, description) for change, description in found if change.kind == "new" and change.frames]
    if not new:
        return field, None
    things = [_new_gaussians(changes, change) for change, _ in new]
    first = np.cumsum([field.gaussians.count, *(thing.count for thing in things)])
    views: dict[str, LedgerView] = {}
    for t in sorted({t for change, _ in new for t in change.frames}):
        shown = [k for k, (change, _) in enumerate(new) if t in change.frames]
        rows = np.concatenate([np.arange(first[k], first[k + 1]) for k in shown])
        regions = np.repeat(field.regions.count + np.array(shown), [things[k].count for k in shown])
        masks = np.stack([new[k][0].after[t] for k in shown])
        name = _new_name(changes.capture.names[t], date, (*field.names, *views))
        views[name] = _new_view(changes, embedder, t, masks, rows, regions)
    try:
        known = ledger()
    except InputError as error:
        problem = f"the photographs show something new, which needs the field's ledger, and {error.problem}"
        raise InputError(error.where, problem, remedy=error.remedy) from error
    return add_objects(field, known, things, views, [description for _, description in new])


def frames_capture(field: LanguageField, frames: Mapping[str, "NewFrame"]) -> Capture:
    """Frames in a field's world as a capture."""
    cameras = jax.tree.map(lambda *columns: np.stack(columns), *(frame.camera for frame in frames.values()))
    pixels, nothing = np.stack([frame.pixels for frame in frames.values()]), np.zeros((0, 3), np.float32)
    depths = [np.zeros(pixels.shape[1:3], np.float32) if f.depth is None else f.depth for f in frames.values()]
    measured = np.stack(depths) if any(depth.any() for depth in depths) else None
    world, held_out = np.asarray(field.source_from_scene), np.zeros(len(pixels), bool)
    return Capture(pixels, cameras, nothing, nothing.astype(np.uint8), held_out, measured, world, tuple(frames))


def add_new_things(
    field: LanguageField, listed: Callable[[], Catalogue], frames: Mapping[str, "NewFrame"]
) -> tuple[LanguageField, dict[str, "NewFrame"]]:
    """Gives Gaussians to what frames with depth show and no Gaussian explains, and its masks to these frames."""
    shown = {name: frame for name, frame in frames.items() if frame.depth is not None and frame.depth.any()}
    if not shown:
        return field, dict(frames)
    changes = find_changes(field, listed(), frames_capture(field, shown))
    new = [change for change in changes.found if change.kind == "new" and change.frames]
    masked = {}
    for t, (name, frame) in enumerate(shown.items()):
        if masks := [resize_mask(change.after[t], frame.camera) for change in new if t in change.frames]:
            masked[name] = frame._replace(things=np.stack(masks))
    things = [_new_gaussians(changes, change) for change in new]
    return add_unseen(field, things) if things else field, {**frames, **masked}


def _new_name(name: str, date: str, known: tuple[str, ...]) -> str:
    """A name of a new frame that the field does not have."""
    options = (name, f"{name}_{date}", *(f"{name}_{date}_{n}" for n in range(2, len(known) + 3)))
    return next(option for option in options if option not in known)


def _new_view(
    changes: Changes, embedder: Embedder, t: int, masks: np.ndarray, rows: np.ndarray, regions: np.ndarray
) -> LedgerView:
    """What a frame contributes that shows new things: their masks (M, H, W), Gaussians, and the regions of these.

    Each Gaussian has a weight of 4 px in it, and 0.9 at its strongest pixel.
    """
    size, capture = changes.field.cameras, changes.capture
    frame, camera = np.asarray(capture.frames[t]), jax.tree.map(lambda a: np.asarray(a)[t], capture.cameras)
    weights, peaks = np.full(len(rows), 4.0, np.float32), np.full(len(rows), 0.9, np.float32)
    starts = np.arange(len(rows) + 1, dtype=np.int32)
    evidence = ViewEvidence(rows.astype(np.int32), starts, regions.astype(np.int32), weights, peaks)
    larger = size.width * size.height / frame[..., 0].size
    pixels = np.stack([np.unique(regions), np.rint(larger * masks.sum((1, 2)))]).astype(np.int32)
    embeddings = np.asarray(embedder.embed_regions(frame, masks), np.float32)
    camera = resize_camera(camera, size.width, size.height)
    picture = encode_jpeg(resize_frame(frame, camera))
    packed = pack_evidence(evidence, int(regions.max()) + 1)
    return LedgerView(packed, pixels, pixels[0], embeddings, camera_row(camera), picture)


def _new_gaussians(changes: Changes, change: Change) -> Gaussians:
    """The Gaussians of something new, from the pixels that show it."""
    capture = changes.capture
    points, colours = [], []
    for t in change.frames:
        mask = change.after[t]
        camera = jax.tree.map(lambda a, t=t: np.asarray(a)[t], capture.cameras)
        depth = None if capture.depths is None else np.asarray(capture.depths[t])
        points.append(_surface(mask, camera, change.place, depth))
        colours.append(np.asarray(capture.frames[t])[mask])
    degree = math.isqrt(changes.field.gaussians.sh.shape[1]) - 1
    place = np.concatenate(points)
    return gaussians_from_points(place, np.concatenate(colours), opacity=0.9, scale=0.6, sh_degree=degree)


def _surface(mask: np.ndarray, camera: Camera, place: np.ndarray, depth: np.ndarray | None) -> np.ndarray:
    """Points (P, 3) of a mask's pixels: at their depth, or on a dome as deep as it is wide around a place."""
    pixel = np.asarray(camera.world_to_camera, np.float64)[2] @ np.append(place, 1) / float(camera.fx)  # size there
    inward = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)[mask]
    largest = inward.max()
    z = (float(camera.fx) - np.sqrt(np.maximum(largest**2 - (largest - inward) ** 2, 0))) * pixel
    if depth is not None:
        measured = np.asarray(depth, np.float64)[mask]
        usual = np.median(measured[measured > 0]) if (measured > 0).any() else float(camera.fx) * pixel
        z = np.where(np.abs(measured - usual) < largest * 4 * usual / float(camera.fx), measured, usual)
    return back_project(camera, np.argwhere(mask), z)


def splat_capture(field: LanguageField, gaussians: Gaussians, transform: np.ndarray) -> Capture:
    """Renders other Gaussians of a field's place, with depth, from its views; `transform` takes them to its capture."""
    into_field = np.linalg.inv(np.asarray(field.source_from_scene, np.float64)) @ transform
    moved = transform_gaussians(gaussians, into_field)
    moved = dataclasses.replace(moved, means=np.asarray(moved.means, np.float32))
    rows = evenly_spaced(len(field.names), 8)
    cameras = shrink_cameras(jax.tree.map(lambda a: np.asarray(a)[rows], field.cameras), LONG_SIDE)
    capture = render_capture(moved, cameras, tuple(field.names[t] for t in rows), np.asarray(field.source_from_scene))
    depths = [np.where(a > 0.5, d, 0) for d, a in (map(np.asarray, render_depth(moved, c)) for c in cameras)]
    return dataclasses.replace(capture, depths=np.stack(depths))
