"""Writers of captures and labels in the formats of other programs, on the host: what made-up rooms are handed on as."""

import itertools
import json
import os
import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from jsecon.errors import require
from jsecon.files import atomic_write, path_within, write_text
from jsecon.read.captures.frames import transform_poses
from jsecon.read.captures.images import write_image
from jsecon.read.masks.labels import LabelledFrame
from jsecon.types import Capture


def write_colmap(capture: Capture, path: str | Path, *, image_format: str = "png") -> None:
    """Writes a capture for COLMAP, in the world of the poses that it was loaded from.

    Points keep their colours; observations and tracks are empty and errors -1 (not computed), since a Capture has none.
    The format has no place for depths and held-out frames: hold frames out again on loading. Into `path` come
    sparse/0/{cameras,images,points3D}.bin (PINHOLE, number 1) and images/.
    """
    path, cameras = Path(path), capture.cameras
    intrinsics = np.stack([cameras.fx, cameras.fy, cameras.cx, cameras.cy], axis=-1).astype(np.float64)
    distinct, camera_of = np.unique(intrinsics, axis=0, return_inverse=True)
    names = [f"{name}.{image_format.lstrip('.')}" for name in capture.names]
    files = [path_within(path / "images", name) for name in names]
    for file, frame in zip(files, np.asarray(capture.frames)):
        write_image(file, frame)
    camera_bytes = [struct.pack("<Q", len(distinct))]
    camera_bytes += [
        struct.pack("<iiQQ4d", n, 1, cameras.width, cameras.height, *row) for n, row in enumerate(distinct, start=1)
    ]
    image_bytes = [struct.pack("<Q", len(names))]
    poses_from_scene = (
        np.eye(4) if capture.poses_from_scene is None else np.asarray(capture.poses_from_scene, np.float64)
    )
    poses = transform_poses(np.asarray(cameras.world_to_camera, np.float64), poses_from_scene)
    for n, (name, pose, camera) in enumerate(zip(names, poses, camera_of.ravel()), start=1):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True, scalar_first=True)
        numbers = itertools.chain(quaternion, pose[:3, 3])
        head = struct.pack("<i7di", n, *numbers, camera + 1)
        image_bytes.append(head + os.fsencode(name) + b"\0" + struct.pack("<Q", 0))
    points = np.zeros(len(capture.points), "<u8, 3<f8, 3u1, <f8, <u8")
    points["f0"] = np.arange(1, len(points) + 1)
    points["f1"] = np.asarray(capture.points, np.float64) @ poses_from_scene[:3, :3] + poses_from_scene[:3, 3]
    points["f2"], points["f3"] = capture.point_colors, -1.0
    contents = {
        "cameras": b"".join(camera_bytes),
        "images": b"".join(image_bytes),
        "points3D": struct.pack("<Q", len(points)) + points.tobytes(),
    }
    for kind, content in contents.items():
        with atomic_write(path / "sparse" / "0" / f"{kind}.bin") as temporary:
            temporary.write_bytes(content)


def write_lerf_labels(folder: str | Path, frames: Iterable[LabelledFrame], *, image_ending: str = ".png") -> None:
    """Writes `<name>.json` of each frame; `load_lerf_labels` gives the same masks and boxes back.

    A polygon has one piece and no holes, so a mask is written as several objects of its category: one for each
    connected piece, and pieces with holes are cut along pixel rows. Each has the category's box that fits it best.
    A category without pixels or boxes is a ValueError.
    """
    for frame in frames:
        objects = []
        for group, (category, (mask, boxes)) in enumerate(frame.objects.items(), start=1):
            fits = mask.shape == (frame.height, frame.width) and bool(mask.any()) and len(boxes) > 0
            got = f"mask {mask.shape} with {int(mask.sum())} pixels, {len(boxes)} boxes"
            expected = f"({frame.height}, {frame.width}), with pixels and a box"
            require(fits, f"{frame.name}: {category}", got, expected, "Leave out what the frame does not show.")
            for polygon, box in _with_boxes(_mask_polygons(mask), np.asarray(boxes, np.float64)):
                shape = {"segmentation": polygon.astype(float).tolist(), "area": float(mask.sum()), "layer": 1.0}
                rest = {"bbox": box.tolist(), "iscrowd": 0, "note": ""}
                objects.append({"category": category, "group": group} | shape | rest)
        info = {"name": frame.name + image_ending, "width": frame.width, "height": frame.height, "depth": 3, "note": ""}
        write_text(path_within(Path(folder), f"{frame.name}.json"), json.dumps({"info": info, "objects": objects}))


def _mask_polygons(mask: Bool[np.ndarray, "h w"]) -> list[np.ndarray]:
    """Outlines a mask by polygons without holes, whose polygon masks OR-ed are the mask exactly."""
    polygons = []
    image = np.ascontiguousarray(mask, np.uint8)
    _, labels = cv2.connectedComponents(image, connectivity=8)
    contours, tree = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    for contour, (_, _, hole, parent) in zip(contours, tree[0] if tree is not None else ()):
        if parent >= 0:
            continue
        outline = contour[:, 0]
        if hole < 0:
            polygons.append(outline)
            continue
        # Cut along the middle row of a hole: it opens into a notch of either part. The hole nearest to the piece's
        # middle, so that many holes are halved at each cut.
        cuts = []
        while hole >= 0:
            rows = contours[hole][:, 0, 1]
            cuts.append(int(rows.min() + rows.max() + 1) // 2)
            hole = tree[0][hole][0]
        cut = min(cuts, key=lambda row: abs(2 * row - outline[:, 1].min() - outline[:, 1].max()))
        x, y, width, height = cv2.boundingRect(outline)
        piece = labels[y : y + height, x : x + width] == labels[outline[0, 1], outline[0, 0]]
        upper, lower = piece[: cut - y], piece[cut - y :]
        polygons += [polygon + np.array([x, y]) for polygon in _mask_polygons(upper)]
        polygons += [polygon + np.array([x, cut]) for polygon in _mask_polygons(lower)]
    return polygons


def _with_boxes(polygons: list[np.ndarray], boxes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each polygon with the box that shares most with it; boxes left over go with the first polygon again."""
    pairs, unused = [], set(range(len(boxes)))
    for polygon in polygons:
        low, high = polygon.min(0), polygon.max(0) + 1
        shared = (np.minimum(boxes[:, 2:], high) - np.maximum(boxes[:, :2], low)).clip(0).prod(1)
        area = (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(1)
        best = int(np.lexsort((area, -shared))[0])
        pairs.append((polygon, boxes[best]))
        unused.discard(best)
    return pairs + [(polygons[0], boxes[index]) for index in sorted(unused)]
