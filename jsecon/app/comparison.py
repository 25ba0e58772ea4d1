"""What changed in a scene: a field and its catalogue against a capture, or against another splat of the same place."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

from jsecon.app.catalogue import Catalogue
from jsecon.app.records import rounded, source_points
from jsecon.change.detect import Change, object_changes
from jsecon.errors import InputError
from jsecon.fit.resize import resize_frame, shrink_cameras
from jsecon.pipeline.scene_files import read_scene
from jsecon.read.captures.frames import evenly_spaced, transform_poses
from jsecon.splat.render import render_depth
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Capture, LanguageField
from jsecon.views.capture import render_capture
from jsecon.views.frame import field_up

LONG_SIDE = 320
"""Longest side at which photographs are compared, px."""
SPLAT_VIEWS = 8
"""Views of a field from which another splat is rendered."""


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
        field, listed = self.field, self.catalogue
        record: dict[str, Any] = {"kind": change.kind, "probability": round(change.probability, 3)}
        name = str(listed.names[change.object, 0]) if change.object >= 0 else ""
        ids = {"id": change.object, "region": main_region(field, listed, change.object)} if change.object >= 0 else {}
        record |= {"name": name} | ({"id": None, "region": None} | ids)
        now = source_points(field, change.place[None])[0]
        start = now
        if change.kind == "moved":
            inverse = np.linalg.inv(change.motion)
            start = source_points(field, (change.place @ inverse[:3, :3].T + inverse[:3, 3])[None])[0]
        record["from"] = None if change.kind == "new" else rounded(start, 1.0)
        record["to"] = None if change.kind in ("gone", "not seen") else rounded(now, 1.0)
        record["distance"] = round(float(np.linalg.norm(now - start)), 4)
        cosine = (np.trace(change.motion[:3, :3]) - 1) / 2
        record["turned_degrees"] = round(float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), 1)
        record["frames"] = [self.capture.names[t] for t in change.frames[:5]]
        return record


def main_region(field: LanguageField, catalogue: Catalogue, index: int) -> int:
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


def splat_capture(field: LanguageField, file: Path, transform: Path | None) -> Capture:
    """Renders another splat of the same place, with depth, from views of a field."""
    gaussians, _ = read_scene(file)
    into_field = np.linalg.inv(np.asarray(field.source_from_scene, np.float64)) @ _read_matrix(transform)
    moved = transform_gaussians(gaussians, into_field)
    moved = dataclasses.replace(moved, means=np.asarray(moved.means, np.float32))
    rows = evenly_spaced(len(field.names), SPLAT_VIEWS)
    cameras = shrink_cameras(jax.tree.map(lambda a: np.asarray(a)[rows], field.cameras), LONG_SIDE)
    capture = render_capture(moved, cameras, tuple(field.names[t] for t in rows), np.asarray(field.source_from_scene))
    depths = [np.where(a > 0.5, d, 0) for d, a in (map(np.asarray, render_depth(moved, c)) for c in cameras)]
    return dataclasses.replace(capture, depths=np.stack(depths))


def _read_matrix(file: Path | None) -> np.ndarray:
    """Reads a 4x4 similarity from a text file."""
    if file is None:
        return np.eye(4)
    try:
        matrix = np.loadtxt(file)
    except (OSError, ValueError) as error:
        raise InputError(
            file, f"cannot read it ({error})", remedy="Give a text file of four rows of numbers."
        ) from error
    turn = matrix[:3, :3] @ matrix[:3, :3].T if matrix.shape == (4, 4) else np.zeros((3, 3))
    if not turn[0, 0] > 0 or not np.allclose(turn / turn[0, 0], np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
        raise InputError(file, "no similarity", "4 rows of 4 numbers: rotation times scale, and shift", "Check it.")
    return matrix
