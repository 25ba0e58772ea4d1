"""SAM whose decoder answers with the true masks under a point, of a made-up room: subpart, part and whole."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Int, Int32

from experiments.rooms.raycast import trace_rays
from experiments.rooms.room import Room
from jsecon.networks.sam import Level, SamSegmenter
from jsecon.types import Camera

LOGIT = 8.0
"""of a pixel of a mask; its negative outside"""
PREDICTED_IOU = 0.95
LEVELS = ("s", "m", "l")


def level_labels(room: Room, camera: Camera) -> dict[str, Int32[np.ndarray, "h w"]]:
    """Labels the pixels of a view at the three granularities of SAM.

    Args:
      room: The room.
      camera: One camera inside of it.

    Returns:
      Labels (H, W) by level: s, connected pieces of one solid (a lid, a handle, a wall); m, connected pieces of one
      object; l, all that is visible of an object, of the table, or of a wall.
    """
    depth, part = trace_rays(room, camera)
    owners = np.array([item.owner for item in room.parts] + [-2], np.int64)
    owner = owners[part]
    walls = _walls(room, camera, depth)
    solid = np.where(part >= 0, part, len(room.parts) + walls)
    whole = np.where(owner == -2, len(room.objects) + 1 + walls, owner + 1)
    return {"s": _pieces(solid), "m": _pieces(whole), "l": np.unique(whole, return_inverse=True)[1].astype(np.int32)}


def masks_of(labels: Int[np.ndarray, "h w"], least: int) -> Bool[np.ndarray, "m h w"]:
    """Returns the masks (M, H, W) of labels with at least `least` pixels."""
    masks = labels[None] == np.unique(labels)[:, None, None]
    return masks[masks.sum((1, 2)) >= least]


def _walls(room: Room, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Number (H, W) of the wall, floor or ceiling that a pixel shows: by where its ray ends."""
    pose = np.asarray(camera.world_to_camera, np.float64)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = (columns - float(camera.cx)) / float(camera.fx), (rows - float(camera.cy)) / float(camera.fy)
    local = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None]
    world = (local - pose[:3, 3]) @ pose[:3, :3]
    low = world - np.array([*-room.half, world[..., 2].min()])
    high = np.array([*room.half, room.ceiling]) - world
    return np.concatenate([np.abs(low), np.abs(high)], -1).argmin(-1)


def _pieces(labels: np.ndarray) -> Int32[np.ndarray, "h w"]:
    """Numbers the connected pieces of labels."""
    pieces = np.zeros(labels.shape, np.int32)
    for label in np.unique(labels):
        count, own = cv2.connectedComponents((labels == label).astype(np.uint8), connectivity=8)
        pieces += np.where(own > 0, own + pieces.max(), 0).astype(np.int32)
        assert count > 1
    return pieces


class ExactGraphs:
    """Stands in for `_SamGraphs`: its masks are true, whatever the frame. It counts its prompts.

    Args:
      labels: Labels (H, W) of the frame by level.
    """

    def __init__(self, labels: dict[str, np.ndarray]):
        self._labels = [labels[level] for level in LEVELS]
        self.prompts = 0

    def encode(self, frame: np.ndarray) -> None:
        """Takes a frame (H, W, 3), which must be the whole one."""

    def decode(self, encoded: None, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the masks of a point (2,) in px of the frame."""
        column, row = point.astype(int)
        self.prompts += 1
        masks = np.stack([labels == labels[row, column] for labels in self._labels])
        return np.where(masks, LOGIT, -LOGIT).astype(np.float32), np.full(3, PREDICTED_IOU, np.float32)

    def to_frame(self, logits: np.ndarray, encoded: None) -> np.ndarray:
        """Masks are of the frame's size already."""
        return logits


class ExactSam(SamSegmenter):
    """`SamSegmenter` over `ExactGraphs` of one frame."""

    def __init__(self, labels: dict[str, np.ndarray], level: Level):
        self._level: Level = level
        self.name = "exact"
        self.__dict__["_graphs"] = self.graphs = ExactGraphs(labels)


class GridPrompts:
    """SAM's own prompts of an image (H, W, 3), in place of guided ones: the centres of 32 x 32 cells, in one round."""

    def __init__(self, image: np.ndarray, levels: int):
        line = np.linspace(1 / 64, 63 / 64, 32)
        size = np.array([image.shape[1], image.shape[0]], np.float32)
        self._points = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2).astype(np.float32) * size

    def next_points(self) -> np.ndarray:
        """Returns all points (P, 2) x, y in px, then none."""
        points, self._points = self._points, self._points[:0]
        return points

    def explain(self, level: int, point: np.ndarray, mask: np.ndarray) -> None:
        """Does nothing: the grid does not depend on the masks."""


class ExactGridSam(ExactSam):
    """`ExactSam` with SAM's own prompts."""

    prompts = GridPrompts


def found_shares(truth: np.ndarray, masks: np.ndarray, thresholds: Sequence[float]) -> list[int]:
    """Counts the true masks (M, H, W) that some mask (K, H, W) shows with an IoU of at least each threshold."""
    flat = [array.reshape(len(array), -1).astype(np.float32) for array in (truth, masks)]
    shared = flat[0] @ flat[1].T
    union = flat[0].sum(1)[:, None] + flat[1].sum(1)[None] - shared
    best = (shared / np.maximum(union, 1)).max(1, initial=0.0)
    return [int((best >= threshold).sum()) for threshold in thresholds]
