"""Every reader with small files of the true format: for test_fuzz.py, which damages them at random, and for the table
of damage in test_readers.py."""

import dataclasses
import functools
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from capture_files import png, small_capture, transforms, write_images, write_text_model, write_transforms
from clip_files import write_clip, write_tokenizer
from PIL import Image
from point_files import WRITERS, points_of
from sam2_files import write_sam2
from sam_files import write_sam
from siglip_files import write_siglip
from small_field import field_of, lone_votes, unit_rows
from splat_files import compressed_ply, gaussians, ply_columns, scene, sog, splat, spz, write_ply
from test_proposal_files import records
from test_rgbd import FORMATS as RGBD
from test_video import moving

from experiments.rooms.writers import write_colmap, write_lerf_labels
from jsecon.field.field import check_field, load_field, save_field
from jsecon.networks.clip import ClipEmbedder
from jsecon.networks.sam import SamSegmenter
from jsecon.networks.sam2 import Sam2Tracker
from jsecon.networks.tokenizer import CLIP_LENGTH, TextTokenizer
from jsecon.paper.autoencoder import encode, train_autoencoder
from jsecon.read.captures import images, video
from jsecon.read.captures.capture import load_capture
from jsecon.read.masks import masks
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels
from jsecon.read.splats.formats import read_gaussians
from jsecon.read.splats.point_clouds import load_point_cloud
from jsecon.read.splats.writing import save_gaussians
from jsecon.types import Capture, Codes, Gaussians, LanguageField, Regions

NAMES, MASK_SIZE = ("a", "b"), (24, 36)


def check_result(found: Any) -> None:
    """Raises AssertionError unless a result is well-formed: its numbers are finite, its sizes agree, and its indices
    point to something."""
    if isinstance(found, Gaussians):  # a flat one has no thickness, a sure one has an infinite logit
        assert not np.isnan(found.opacity_logits).any()
        assert not np.isposinf(found.log_scales).any()
        assert (np.linalg.norm(np.asarray(found.quaternions, np.float64), axis=1) > 0).all()
        assert found.sh.shape in {(found.count, k * k, 3) for k in (1, 2, 3, 4)}
        found = found.means, np.exp(np.minimum(found.log_scales, 80)), found.quaternions, found.sh
    elif isinstance(found, Capture):
        count, height, width = found.frames.shape[:3]
        cameras = found.cameras
        assert (cameras.width, cameras.height) == (width, height)
        assert count == len(cameras.world_to_camera) == len(cameras.fx) == len(found.names) == len(found.held_out)
        assert found.points.shape == found.point_colors.shape
        assert min(cameras.fx.min(), cameras.fy.min()) > 0
        assert found.depths is None or (found.depths >= 0).all()
    elif hasattr(found, "ids"):  # tracked masks
        count = len(found.ids)
        assert -1 <= found.labels.min() <= found.labels.max() < max(count, 1)
    elif isinstance(found, LanguageField):
        check_result(found.gaussians)
        assert ((found.votes.regions >= -1) & (found.votes.regions < found.regions.count)).all()
        assert isinstance(json.loads(found.provenance), dict)
        assert min(found.cameras.width, found.cameras.height) > 0
        if found.codes is not None:
            check_result(encode(found.codes.autoencoder, np.asarray(found.canonical_phrases)))
        found = dataclasses.replace(found, gaussians=None)
    for leaf in jax.tree.leaves(found):
        assert isinstance(leaf, str) or np.isfinite(leaf).all()


def _plys(folder: Path) -> None:
    for count, basis in ((20, 1), (9, 4), (0, 16)):
        save_gaussians(folder / f"{count}.ply", gaussians(scene(count, basis)))
    face = "element face 0\nproperty list uchar int vertex_indices\n"
    for form in ("ascii", "binary_big_endian"):
        columns = ply_columns(6) | {"red": np.arange(6)}
        write_ply(folder / f"{form}.ply", columns, form, {"opacity": "double", "red": "uchar"}, face)


def _splats(folder: Path) -> None:
    arrays = scene(300)
    made = {"c.ply": compressed_ply(arrays), "s.splat": splat(arrays), "s.sog": sog(arrays)}
    made |= {f"v{version}.spz": spz(arrays, version) for version in (2, 3, 4)}
    for name, data in made.items():
        (folder / name).write_bytes(data)


def _clouds(folder: Path) -> None:
    xyz, rng = {axis: np.linspace(-1, 1, 30) for axis in "xyz"}, np.random.default_rng(0)
    for form in ("ascii", "binary_little_endian"):
        for kind in ("uchar", "ushort", "float", None):
            colours = {c: rng.random(30) * 200 for c in ("red", "green", "blue")} if kind else {}
            write_ply(folder / f"{form}-{kind}.ply", xyz | colours, form, dict.fromkeys(colours, kind))
    for name, write in WRITERS.items():
        write(folder / name, *points_of(30))


def _placed_points(file: Path) -> tuple[np.ndarray, ...]:
    """Points and colours of a cloud, but for places that are no numbers: a capture leaves these out, with a note."""
    points, colours = load_point_cloud(file)
    placed = np.isfinite(points).all(1)
    return points[placed], colours[placed]


def _colmap(folder: Path) -> None:
    capture = small_capture(3, points=12)
    write_colmap(capture, folder / "binary")
    points = folder / "binary" / "sparse" / "0" / "points3D.bin"
    data, track = points.read_bytes(), np.array(2, "<u8").tobytes() + bytes(16)
    tracks = b"".join(data[8 + 51 * n : 51 + 51 * n] + track for n in range(12))
    points.write_bytes(data[:8] + tracks)
    write_images(capture, folder / "text" / "images")
    write_text_model(capture, folder / "text" / "sparse" / "0", ["1 RADIAL_FISHEYE 48 32 40 23 16 0.01 0.001"])


def _nerfstudio(folder: Path) -> None:
    capture, rng = small_capture(3), np.random.default_rng(0)
    deep = {"ply_file_path": "cloud.ply", "applied_scale": 2.0, "applied_transform": np.eye(4)[:3].tolist()}
    plain = transforms(capture, camera_angle_x=1.0)
    for entry in plain["frames"]:
        del entry["fl_x"], entry["fl_y"]
    write_transforms(capture, folder / "plain", plain)
    fisheye = {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.001}
    write_transforms(capture, folder / "fisheye", transforms(capture, **fisheye))
    capture = dataclasses.replace(capture, depths=rng.integers(0, 4000, (3, 16, 24)) / 1000)
    write_transforms(capture, folder / "deep", transforms(capture, **deep))
    write_ply(folder / "deep" / "cloud.ply", {axis: np.linspace(-1, 1, 5) for axis in "xyz"}, "ascii")


def _images(folder: Path) -> None:
    colour = cv2.resize(np.random.default_rng(0).integers(0, 255, (6, 9, 3), np.uint8), (90, 60))
    alpha, exif = np.dstack([colour, colour[..., 0]]), Image.Exif()
    exif[0x0110], exif.get_ifd(0x8769)[0x920A], exif[0x0112] = "camera", 35.0, 6
    for ending in (".png", ".jpg", ".webp", ".tif", ".bmp"):
        cv2.imwrite(str(folder / f"plain{ending}"), colour)
        if ending != ".bmp":
            Image.fromarray(colour).save(folder / f"exif{ending}", exif=exif)
    cv2.imwrite(str(folder / "deep.png"), colour.astype(np.uint16) * 257)
    cv2.imwrite(str(folder / "alpha.png"), alpha)
    cv2.imwrite(str(folder / "alpha.tif"), alpha)
    cv2.imwrite(str(folder / "progressive.jpg"), colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])


def _read_image(file: Path) -> np.ndarray:
    found = images.read_image(file)
    assert found.shape[1::-1] == images.image_header(file).upright
    return found


def _depths(folder: Path) -> None:
    rng = np.random.default_rng(0)
    cv2.imwrite(str(folder / "depth.png"), rng.integers(0, 60000, (30, 40)).astype(np.uint16))
    np.save(folder / "depth.npy", rng.random((30, 40, 1)))


def _masks(folder: Path) -> None:
    ids = np.random.default_rng(0).integers(0, 5, (2, 12, 18)).repeat(2, 1).repeat(2, 2)
    kinds: dict[str, Callable[[np.ndarray], bytes]] = {
        "grey": lambda ids: cv2.imencode(".png", ids.astype(np.uint8))[1].tobytes(),
        "deep": lambda ids: cv2.imencode(".png", (ids * 9000).astype(np.uint16))[1].tobytes(),
        "colour": lambda ids: cv2.imencode(".png", np.stack([ids, ids * 9, ids * 0], -1).astype(np.uint8))[1].tobytes(),
        "palette": lambda ids: png(ids, bits=4, colour_type=3, palette=bytes(range(48))),
        "bits": lambda ids: png(ids % 2, bits=1, colour_type=0),
    }
    for kind in (*kinds, "objects/001", "objects/002"):
        (folder / kind).mkdir(parents=True)
    for name, image in zip(NAMES, ids):
        for kind, write in kinds.items():
            (folder / kind / f"{name}.png").write_bytes(write(image))
        for number in (1, 2):
            cv2.imwrite(str(folder / f"objects/00{number}/{name}.png"), 255 * (image == number).astype(np.uint8))


def _proposals(folder: Path) -> None:
    boxes = np.zeros((2, 20, 30), bool)
    boxes[0, 2:9, 3:8] = boxes[1, 4:18, 10:25] = True
    counts = {"size": [20, 30], "counts": [62, 7, 13, 7, 13, 7, 13, 7, 13, 7, 451]}
    square = [3, 2, 25, 2, 25, 15, 3, 15]
    polygons = [{"segmentation": [square, [5, 4, 9, 4, 9, 9]]}, {"segmentation": [square]}]
    (folder / "sam").mkdir()
    for name, content in {
        "a": [{"segmentation": counts, "predicted_iou": 0.9, "stability_score": 0.95, "area": 50}, *records(boxes)],
        "b": {"images": [{"width": 30, "height": 20}], "annotations": polygons},
    }.items():
        (folder / "sam" / f"{name}.json").write_text(json.dumps(content))
    (folder / "levels").mkdir()
    for name in NAMES:
        levels = np.broadcast_to(boxes[0] * 2 + boxes[1] - 1.0, (4, 20, 30)).astype(np.float32)
        np.save(folder / "levels" / f"{name}_s.npy", levels)


def _read_proposals(folder: Path) -> list[np.ndarray]:
    of_frame, _ = masks.load_proposals(folder, NAMES, (20, 30))
    return [of_frame(n) for n in range(len(NAMES))]


def _labels(folder: Path) -> None:
    mask = np.zeros((20, 30), bool)
    mask[2:9, 3:8] = True
    things = {"red mug": (mask, np.float32([[1, 2, 9, 9], [0, 0, 3, 3]])), "tea": (mask, np.float32([[1, 2, 9, 9]]))}
    (folder / "lerf").mkdir()
    write_lerf_labels(folder / "lerf", [LabelledFrame(name, 30, 20, things) for name in ("frame_1", "frame_2")])


def tiny_field(**own) -> LanguageField:
    """A field of 12 Gaussians and three regions."""
    rng = np.random.default_rng(0)
    table = {"weight_where_region_visible": np.ones((12, 1), np.float32), "overlap": np.eye(3, dtype=np.float32)}
    own = {"gaussians": gaussians(scene(12)), "canonical_phrases": unit_rows(rng, 4, 8), **own}
    votes = dataclasses.replace(lone_votes(np.arange(12) % 3, 3), **table)
    return field_of(votes, Regions(unit_rows(rng, 3, 8), np.ones((3, 1), np.int32)), **own)


def _codes() -> Codes:
    rng = np.random.default_rng(0)
    coder = train_autoencoder(unit_rows(rng, 1, 8), latent=4, key=jax.random.key(0), epochs=1)
    return Codes(unit_rows(rng, 12, 4), unit_rows(rng, 3, 4), coder)


def _fields(folder: Path) -> None:
    for name, own in {"plain": {}, "coder": {"codes": _codes()}, "mapped": {}}.items():
        save_field(folder / f"{name}.safetensors", tiny_field(**own))


def _read_field(file: Path) -> LanguageField:
    found = load_field(file, mapped=file.stem == "mapped")
    check_field(file)
    return found


def _read_tokens(file: Path) -> np.ndarray:
    texts = ["a red mug's 12 handles", "", "é<end_of_text>"]
    return TextTokenizer(file, None)(texts, CLIP_LENGTH)[0]


def _checked(model: Any) -> Any:
    """A model, put to the test as before a run."""
    model.check()
    return model


def _videos(folder: Path) -> None:
    for name, code in {"a.avi": "MJPG", "b.mp4": "mp4v", "c.mkv": "mp4v"}.items():
        moving(folder / name, code, count=6)


def _read_video(file: Path) -> list[np.ndarray]:
    frames = file.with_suffix("")
    shutil.rmtree(frames, ignore_errors=True)
    found = [cv2.imread(str(frame)) for frame in video.write_frames(file, frames, 3)[0]]
    assert 1 <= len(found) <= 3
    return found


NETWORK = (".onnx", ".json", ".npz", ".txt")
LAYOUTS = "immich", "transformers.js"
FRAMES = np.zeros((2, 16, 16, 3), np.uint8)
READERS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any], tuple[str, ...]]] = {
    "ply": (_plys, lambda file: read_gaussians(file)[0], ()),
    "splats": (_splats, lambda file: read_gaussians(file)[0], ()),
    "clouds": (_clouds, _placed_points, ()),
    "colmap": (_colmap, lambda folder: load_capture(folder, holdout=2), (".bin", ".txt")),
    "nerfstudio": (_nerfstudio, load_capture, (".json", "h0.png", "d.ply")),
    "rgbd": (lambda folder: [write(folder / name) for name, write in RGBD.items()], load_capture,
             (".txt", ".json", ".traj", ".pincam")),
    "images": (_images, _read_image, ()),
    "depths": (_depths, lambda file: images.read_depth(file, 0.001), ()),
    "masks": (_masks, lambda folder: masks.load_labels(folder, NAMES, MASK_SIZE), ()),
    "proposals": (_proposals, _read_proposals, ()),
    "labels": (_labels, lambda folder: [frame.objects for frame in load_lerf_labels(folder)], ()),
    "field": (_fields, _read_field, ()),
    "tokenizer": (lambda folder: write_tokenizer(folder / "tokenizer.json"), _read_tokens, ()),
    "clip": (lambda folder: [write_clip(folder / name, name) for name in LAYOUTS],
             lambda folder: _checked(ClipEmbedder(folder)).name, NETWORK),
    "siglip": (lambda folder: [write_siglip(folder / name, name) for name in LAYOUTS],
               lambda folder: _checked(ClipEmbedder(folder)).name, NETWORK),
    "sam": (lambda folder: [write_sam(folder / name, name, side=64) for name in ("sam", "sam2")],
            lambda folder: _checked(SamSegmenter(folder))(FRAMES[0], 0), NETWORK),
    "sam2": (lambda folder: write_sam2(folder / "tiny"),
             lambda folder: _checked(Sam2Tracker(folder))(FRAMES, 0, np.ones((1, 16, 16), bool)), NETWORK),
    "videos": (_videos, _read_video, ()),
}  # fmt: skip
"""reader -> a function that writes files and folders of its formats into a folder, what reads each of them, and how the
names of those files in them end that are damaged; () for all"""


def cases(name: str, folder: Path) -> Iterator[tuple[list[Path], Callable[[], Any]]]:
    """Writes the files and folders of a reader into a new folder; of each the files to damage, and what reads it."""
    write, read, endings = READERS[name]
    folder.mkdir()
    write(folder)
    for entry in sorted(folder.iterdir()):
        files = [file for file in (entry, *sorted(entry.rglob("*"))) if file.is_file()]
        damaged = [file for file in files if not endings or file.name.endswith(endings)]
        yield damaged, functools.partial(read, entry)
