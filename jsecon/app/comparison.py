"""What changed in a scene: a field and its catalogue against a capture, or against another splat of the same place."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.app.catalogue import Catalogue
from jsecon.app.records import rounded, source_points
from jsecon.change.detect import Change
from jsecon.change.history import add_objects, change_object, dates
from jsecon.errors import InputError
from jsecon.field.evidence import ViewEvidence, pack_evidence
from jsecon.field.ledger import Ledger, LedgerView, camera_row
from jsecon.fit.resize import resize_camera, resize_frame, resize_mask, shrink_cameras
from jsecon.read.captures.frames import evenly_spaced
from jsecon.read.captures.images import encode_jpeg
from jsecon.splat.points import back_project, gaussians_from_points
from jsecon.splat.render import render_depth
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Camera, Capture, Gaussians, LanguageField
from jsecon.views.rendered import render_capture
from jsecon.vision.protocols import Embedder

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
        kind, regions = change.suspected or change.kind, np.flatnonzero(listed.regions == index)
        known: dict[str, Any] = {"name": "", "id": None, "region": None}
        if index >= 0:
            # The region that shows most of an object is its name for good; an object's id belongs to one field.
            pixels = np.asarray(field.regions.pixel_counts)[regions].sum(1)
            known = {"name": str(listed.names[index]), "id": index, "region": int(regions[pixels.argmax()])}
        return {
            "kind": change.kind,
            **({"suspected": change.suspected} if change.suspected else {}),
            "probability": round(change.probability, 3),
            **known,
            "from": None if kind == "new" else rounded(start, 1.0),
            "to": None if kind in ("gone", "not seen") else rounded(now, 1.0),
            "distance": round(float(np.linalg.norm(now - start)), 4),
            "turned_degrees": round(np.degrees(Rotation.from_matrix(change.motion[:3, :3]).magnitude()), 1),
            "frames": [self.capture.names[t] for t in change.frames[:5]],
        }


def apply_changes(
    changes: Changes, embedder: Embedder, date: str, ledger: Callable[[], Ledger]
) -> tuple[LanguageField, Ledger | None]:
    """Applies changes to their field, with a date: what moved moves, what is gone is absent, what is new is added.

    Of which region a Gaussian is stays true, also if it moves. So the ledger grows only by what is new; the second
    result is None if it stays.
    """
    field, listed = changes.field, changes.catalogue
    new, descriptions = [change for change in changes.found if change.kind == "new"], []
    if date < (last := dates(field)[-1]):
        raise InputError("--date", f"{date} is before the last change of the field, {last}", remedy="Check it.")
    for change, record in zip(changes.found, changes.records()):
        mask, description = (listed.labels == change.object) & (change.object >= 0), record | {"date": date}
        if change.kind == "moved":
            field = change_object(field, mask, description, motion=change.motion)
        elif change.kind == "gone":
            regions = np.flatnonzero(listed.regions == change.object).tolist()
            field = change_object(field, mask, description, regions=regions)
        elif change.kind == "look":
            field = change_object(field, mask & False, description)
        elif change.kind == "new":
            descriptions.append(description)
    things, masks = new_things(changes, field.cameras)
    if not things:
        return field, None
    first = np.cumsum([field.gaussians.count, *(thing.count for thing in things)])
    views: dict[str, LedgerView] = {}
    for t, mask in masks.items():
        shown = [k for k, change in enumerate(new) if t in change.frames]
        rows = np.concatenate([np.arange(first[k], first[k + 1]) for k in shown])
        regions = np.repeat(field.regions.count + np.array(shown), [things[k].count for k in shown])
        name = changes.capture.names[t]
        while name in field.names or name in views:
            name += f"_{date}"
        views[name] = _new_view(changes, embedder, t, mask, rows, regions)
    return add_objects(field, ledger(), things, views, descriptions)


def _new_view(
    changes: Changes, embedder: Embedder, t: int, masks: np.ndarray, rows: np.ndarray, regions: np.ndarray
) -> LedgerView:
    """What a frame contributes that shows new things: their masks (M, H, W), Gaussians, and the regions of these.

    Each Gaussian has a weight of 4 px in it, and 0.9 at its strongest pixel.
    """
    size, frame = changes.field.cameras, np.asarray(changes.capture.frames[t])
    camera = resize_camera(changes.capture.cameras[t], size.width, size.height)
    frame = resize_frame(frame, camera)
    weights, peaks = np.full(len(rows), 4.0, np.float32), np.full(len(rows), 0.9, np.float32)
    starts = np.arange(len(rows) + 1, dtype=np.int32)
    evidence = ViewEvidence(rows.astype(np.int32), starts, regions.astype(np.int32), weights, peaks)
    pixels = np.stack([np.unique(regions), masks.sum((1, 2))]).astype(np.int32)
    embeddings = np.asarray(embedder.embed_regions(frame, masks), np.float32)
    packed = pack_evidence(evidence, int(regions.max()) + 1)
    return LedgerView(packed, pixels, pixels[0], embeddings, camera_row(camera), encode_jpeg(frame))


def new_things(changes: Changes, cameras: Camera) -> tuple[list[Gaussians], dict[int, np.ndarray]]:
    """Makes Gaussians of each new thing, and the masks (M, H, W) of things in each frame that shows some.

    The masks have the size of `cameras`.
    """
    new = [change for change in changes.found if change.kind == "new"]
    masks = {
        t: np.stack([resize_mask(change.after[t], cameras) for change in new if t in change.frames])
        for t in sorted({t for change in new for t in change.frames})
    }
    return [_new_gaussians(changes, change) for change in new], masks


def _new_gaussians(changes: Changes, change: Change) -> Gaussians:
    """The Gaussians of something new, from the pixels that show it: at their depth, or else at that of its place."""
    capture = changes.capture
    points, colours = [], []
    for t in change.frames:
        camera, mask = capture.cameras[t], change.after[t]
        z = float(np.asarray(camera.world_to_camera, np.float64)[2] @ np.append(change.place, 1))
        size = np.sqrt(mask.sum()) * z / float(camera.fx)
        depth = np.full(mask.sum(), z) if capture.depths is None else np.asarray(capture.depths[t], np.float64)[mask]
        depth = np.where(np.abs(depth - z) < size, depth, z)
        points.append(back_project(camera, np.argwhere(mask), depth))
        colours.append(np.asarray(capture.frames[t])[mask])
    degree = math.isqrt(changes.field.gaussians.sh.shape[1]) - 1
    place = np.concatenate(points)
    return gaussians_from_points(place, np.concatenate(colours), opacity=0.9, scale=0.6, sh_degree=degree)


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
