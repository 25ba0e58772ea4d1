"""Every reader, with small files of the true format and what a result must be like: for test_fuzz.py."""

import dataclasses
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
from sam2_files import write_sam2
from sam_files import write_sam
from siglip_files import write_siglip
from splat_files import compressed_ply, ply_columns, scene, sog, splat, spz, write_ply
from test_proposal_files import records
from test_rgbd import FORMATS as RGBD

from experiments.datasets.feature_files import write_features
from experiments.rooms.writers import write_colmap
from jsecon.errors import InputError
from jsecon.field.field import check_field, load_field, save_field
from jsecon.networks.clip import ClipEmbedder
from jsecon.networks.sam import SamSegmenter
from jsecon.networks.sam2 import Sam2Tracker
from jsecon.networks.tokenizer import CLIP_LENGTH, TextTokenizer
from jsecon.paper.autoencoder import encode
from jsecon.pipeline import cache
from jsecon.read.captures import images, video
from jsecon.read.captures.capture import load_capture
from jsecon.read.masks.labels import load_lerf_labels
from jsecon.read.masks.masks import embedding_size, load_features, load_labels, load_proposals
from jsecon.read.splats.files import read_gaussians, save_gaussians
from jsecon.read.splats.ply import load_point_cloud
from jsecon.types import Autoencoder, Camera, Codes, Gaussians, LanguageField, Parts, Regions, Votes
from jsecon.vision.stores import EmbeddingStore, StoredSegmenter


@dataclasses.dataclass(frozen=True)
class Case:
    """Files of the true format and what reads them."""

    files: list[Path]
    """to damage, one at a time."""
    read: Callable[[], Any]
    whole: Callable[[Any], None]
    """raises AssertionError on a result that is not well-formed."""


def _finite(*arrays) -> None:
    for array in arrays:
        assert np.isfinite(np.asarray(array)).all(), "numbers that are not finite"


def _array(shape: tuple[int | None, ...], kind: type, low: float = -np.inf, high: float = np.inf) -> Callable:
    """The check of an array of finite numbers; None stands for any size."""

    def whole(found: np.ndarray) -> None:
        assert found.dtype == kind
        assert found.shape == tuple(size or own for size, own in zip(shape, found.shape, strict=True))
        _finite(found)
        assert ((found >= low) & (found <= high)).all()

    return whole


def _gaussians(count: int, basis: int) -> Gaussians:
    rng = np.random.default_rng(count)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, basis, 3)]
    return Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def _whole_gaussians(found: Gaussians) -> None:
    n = found.count
    assert found.log_scales.shape == (n, 3)
    assert found.quaternions.shape == (n, 4)
    assert found.opacity_logits.shape == (n,)
    assert found.sh.shape in {(n, k * k, 3) for k in (1, 2, 3, 4)}
    _finite(found.means, np.exp(np.minimum(found.log_scales, 80)), found.quaternions, found.sh)
    assert not np.isnan(found.opacity_logits).any()
    assert not np.isposinf(found.log_scales).any()
    assert (np.linalg.norm(np.asarray(found.quaternions, np.float64), axis=1) > 0).all()


def ply(folder: Path) -> Iterator[Case]:
    """Gaussians."""
    files = []
    for count, basis in ((20, 1), (9, 4), (0, 16)):
        save_gaussians(folder / f"{count}.ply", _gaussians(count, basis))
        files.append(folder / f"{count}.ply")
    face = "element face 0\nproperty list uchar int vertex_indices\n"
    for form in ("ascii", "binary_big_endian"):
        files.append(folder / f"{form}.ply")
        columns = ply_columns(6) | {"red": np.arange(6)}
        write_ply(files[-1], columns, form, {"opacity": "double", "red": "uchar"}, face)
    for file in files:
        yield Case([file], lambda file=file: read_gaussians(file)[0], _whole_gaussians)


def splats(folder: Path) -> Iterator[Case]:
    """Gaussians as viewers and phones keep them."""
    arrays = scene(300)
    made = {"c.ply": compressed_ply(arrays), "s.splat": splat(arrays), "s.sog": sog(arrays)}
    made |= {f"v{version}.spz": spz(arrays, version) for version in (2, 3, 4)}
    for name, data in made.items():
        (folder / name).write_bytes(data)
    save_gaussians(folder / "g.glb", _gaussians(30, 4))
    for name in [*made, "g.glb"]:
        yield Case([folder / name], lambda file=folder / name: read_gaussians(file)[0], _whole_gaussians)


def _whole_points(found: tuple[np.ndarray, np.ndarray]) -> None:
    points, colours = found
    assert points.shape == colours.shape == (len(points), 3)
    assert colours.dtype == np.uint8
    _finite(points)


def points(folder: Path) -> Iterator[Case]:
    """Point clouds (.ply)."""
    xyz, rng = {axis: np.linspace(-1, 1, 30) for axis in "xyz"}, np.random.default_rng(0)
    for form in ("ascii", "binary_little_endian"):
        for kind in ("uchar", "ushort", "float", None):
            colours = {c: rng.random(30) * 200 for c in ("red", "green", "blue")} if kind else {}
            file = folder / f"{form}-{kind}.ply"
            write_ply(file, xyz | colours, form, dict.fromkeys(colours, kind))
            yield Case([file], lambda file=file: load_point_cloud(file), _whole_points)


def _whole_capture(found) -> None:
    count, height, width = found.frames.shape[:3]
    assert found.frames.dtype == np.uint8
    assert (found.cameras.width, found.cameras.height) == (width, height)
    assert found.cameras.world_to_camera.shape == (count, 4, 4)
    assert found.points.shape == found.point_colors.shape == (len(found.points), 3)
    assert len(found.names) == len(found.held_out) == count
    assert all(isinstance(name, str) for name in found.names)
    _finite(found.cameras.world_to_camera, found.points, found.source_from_scene)
    for own in (found.cameras.fx, found.cameras.fy, found.cameras.cx, found.cameras.cy):
        assert own.shape == (count,)
        _finite(own)
    assert min(found.cameras.fx.min(), found.cameras.fy.min()) > 0
    if found.depths is not None:
        _finite(found.depths)
        assert (found.depths >= 0).all()


def colmap(folder: Path) -> Iterator[Case]:
    """Models in binary and in text, read with their images: test_colmap.py has the other lenses."""
    capture = small_capture(3, points=12)
    write_colmap(capture, folder / "binary")
    model = folder / "binary" / "sparse" / "0"
    lens = np.array([20.0, 21.0, 11.75, 8.5, 0.01, 0.002, 0.001, 0.0], "<f8").tobytes()
    cameras = b"".join(np.array([n, 4], "<i4").tobytes() + np.array([24, 16], "<u8").tobytes() + lens for n in (1, 2))
    (model / "cameras.bin").write_bytes(np.array(2, "<u8").tobytes() + cameras)
    data, track = (model / "points3D.bin").read_bytes(), np.array(2, "<u8").tobytes() + bytes(16)
    tracks = b"".join(data[8 + 51 * n : 51 + 51 * n] + track for n in range(12))
    (model / "points3D.bin").write_bytes(np.array(12, "<u8").tobytes() + tracks)
    write_images(capture, folder / "text" / "images")
    write_text_model(capture, folder / "text" / "sparse" / "0", ["1 RADIAL_FISHEYE 48 32 40 23 16 0.01 0.001"])
    for kind in ("binary", "text"):
        files = sorted((folder / kind / "sparse" / "0").iterdir())
        yield Case(files, lambda kind=kind: load_capture(folder / kind, holdout=2), _whole_capture)


def nerfstudio(folder: Path) -> Iterator[Case]:
    """transforms.json with what it names: depth maps and a cloud."""
    capture = small_capture(3)
    for name, more in {
        "plain": {},
        "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k2": 0.001},
        "deep": {
            "ply_file_path": "cloud.ply",
            "applied_scale": 2.0,
            "applied_transform": np.eye(4)[:3].tolist(),
            "depth_unit_scale_factor": 0.001,
        },
    }.items():
        content = transforms(capture, **more)
        if name == "plain":
            content |= {"camera_angle_x": 1.0, "camera_angle_y": 0.8}
            for entry in content["frames"]:
                del entry["fl_x"], entry["fl_y"]
        (folder / name).mkdir()
        files = [folder / name / "transforms.json"]
        if name == "deep":
            rng = np.random.default_rng(0)
            for n, entry in enumerate(content["frames"]):
                depth = rng.integers(0, 4000, (16, 24)).astype(np.uint16)
                entry["depth_file_path"] = f"depth{n}.{'npy' if n == 1 else 'png'}"
                file = folder / name / entry["depth_file_path"]
                np.save(file, depth / 1000.0) if n == 1 else cv2.imwrite(str(file), depth)
                files.append(file)
            files.append(folder / name / "cloud.ply")
            write_ply(files[-1], {axis: np.linspace(-1, 1, 5) for axis in "xyz"}, "ascii")
        write_transforms(capture, folder / name, content)
        files = [files[0]] * 6 + files[1:]
        yield Case(files, lambda name=name: load_capture(folder / name), _whole_capture)


def rgbd(folder: Path) -> Iterator[Case]:
    """Folders of depth cameras and phones; their numbers alone, as pictures have a reader of their own."""
    for name, write in RGBD.items():
        write(folder / name)
        files = [file for file in (folder / name).rglob("*") if file.suffix in (".txt", ".json", ".traj", ".pincam")]
        yield Case(sorted(files), lambda name=name: load_capture(folder / name), _whole_capture)


def image(folder: Path) -> Iterator[Case]:
    """Photographs, depth maps and EXIF."""
    rng = np.random.default_rng(0)
    colour = cv2.resize(rng.integers(0, 255, (6, 9, 3), np.uint8), (90, 60))
    alpha = np.dstack([colour, colour[..., 0]])
    for ending in (".png", ".jpg", ".webp", ".tif", ".bmp"):
        cv2.imwrite(str(folder / f"plain{ending}"), colour)
    cv2.imwrite(str(folder / "deep.png"), colour.astype(np.uint16) * 257)
    cv2.imwrite(str(folder / "alpha.png"), alpha)
    cv2.imwrite(str(folder / "alpha.tif"), alpha)
    cv2.imwrite(str(folder / "progressive.jpg"), colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    exif = Image.Exif()
    exif[0x0110], exif.get_ifd(0x8769)[0x920A] = "camera", 35.0
    exif[0x0112] = 6
    for ending in (".jpg", ".png", ".webp", ".tif"):
        Image.fromarray(colour).save(folder / f"exif{ending}", exif=exif)

    def read(file: Path):
        found = images.read_image(file)
        return found, images.image_header(file).upright

    def whole(found) -> None:
        (picture, _), (width, height) = found
        assert picture.dtype == np.uint8
        assert picture.shape == (height, width, 3)
        assert min(width, height) > 0

    for file in sorted(folder.iterdir()):
        yield Case([file], lambda file=file: read(file), whole)
    cv2.imwrite(str(folder / "depth.png"), rng.integers(0, 60000, (30, 40)).astype(np.uint16))
    np.save(folder / "depth.npy", rng.random((30, 40, 1)))

    for file in (folder / "depth.png", folder / "depth.npy"):
        yield Case([file], lambda file=file: images.read_depth(file, 0.001), _array((None, None), np.float32, 0))


def masks(folder: Path) -> Iterator[Case]:
    """Masklets: PNGs of every kind, folders of objects, LangSplat's levels, and a mask that is asked for."""
    ids, names = np.random.default_rng(0).integers(0, 5, (2, 12, 18)).repeat(2, 1).repeat(2, 2), ("a", "b")
    kinds: dict[str, Callable[[np.ndarray], bytes]] = {
        "grey": lambda ids: cv2.imencode(".png", ids.astype(np.uint8))[1].tobytes(),
        "deep": lambda ids: cv2.imencode(".png", (ids * 9000).astype(np.uint16))[1].tobytes(),
        "colour": lambda ids: cv2.imencode(".png", np.stack([ids, ids * 9, ids * 0], -1).astype(np.uint8))[1].tobytes(),
        "palette": lambda ids: png(ids, bits=4, colour_type=3, palette=bytes(range(48))),
        "bits": lambda ids: png(ids % 4, bits=2, colour_type=0),
    }

    def whole(found) -> None:
        assert found.labels.shape == (2, 24, 36)
        assert found.labels.dtype == np.int16
        assert found.labels.min() >= -1
        assert found.labels.max() < len(found.ids)

    for kind, write in kinds.items():
        (folder / kind).mkdir()
        for name, image in zip(names, ids):
            (folder / kind / f"{name}.png").write_bytes(write(image))
        files = sorted((folder / kind).iterdir())
        yield Case(files, lambda kind=kind: load_labels(folder / kind, names, (24, 36)), whole)
    for object in ("001", "002"):
        (folder / "objects" / object).mkdir(parents=True)
        for name, image in zip(names, ids):
            (folder / "objects" / object / f"{name}.png").write_bytes(kinds["grey"]((image == int(object)) * 255))
    yield Case(
        sorted((folder / "objects").rglob("*.png")), lambda: load_labels(folder / "objects", names, (24, 36)), whole
    )
    (folder / "levels").mkdir()
    for name, image in zip(names, ids):
        np.save(folder / "levels" / f"{name}_s.npy", np.broadcast_to(image - 1, (4, 24, 36)).astype(np.float32))
    yield Case(sorted((folder / "levels").iterdir()), lambda: load_labels(folder / "levels", names, (24, 36)), whole)


def langsplat(folder: Path) -> Iterator[Case]:
    """LangSplat's _s.npy with _f.npy."""
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        write_features(folder, name, rng.integers(-1, 3, (12, 16)), rng.normal(size=(3, 5)))

    def whole(found) -> None:
        masks, size = found
        assert masks.labels.shape == (2, 12, 16)
        assert masks.embeddings.shape == (len(masks.frame), size if len(masks.frame) else masks.embeddings.shape[1])
        assert masks.embeddings.dtype == np.float32
        _finite(masks.embeddings)
        assert -1 <= masks.labels.min() <= masks.labels.max() < max(len(masks.frame), 1)

    def read():
        return (load_features(folder, ["a", "b"], (12, 16)), embedding_size(folder))

    yield Case(sorted(folder.iterdir()), read, whole)


def proposals(folder: Path) -> Iterator[Case]:
    """Masks of single frames: SAM's JSON."""
    boxes = np.zeros((2, 20, 30), bool)
    boxes[0, 2:9, 3:8] = boxes[1, 4:18, 10:25] = True
    text = records(boxes)[0]["segmentation"]
    counts = {"size": [20, 30], "counts": [62, 7, 13, 7, 13, 7, 13, 7, 13, 7, 451]}
    for name, content in {
        "a": [
            {"segmentation": code, "predicted_iou": 0.9, "stability_score": 0.95, "area": 50} for code in (counts, text)
        ],
        "b": {"image": {"id": 1}, "annotations": [{"segmentation": text}]},
    }.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    square = [3, 2, 25, 2, 25, 15, 3, 15]
    polygons = [{"segmentation": [square, [5, 4, 9, 4, 9, 9]]}, {"segmentation": [square]}]
    (folder / "c.json").write_text(json.dumps({"images": [{"width": 30, "height": 20}], "annotations": polygons}))

    def read():
        of_frame, _ = load_proposals(folder, tuple("abc"), (20, 30))
        return [of_frame(n) for n in range(3)]

    def whole(found) -> None:
        for masks in found:
            _array((None, 20, 30), bool)(masks)

    files = sorted(folder.iterdir())
    yield Case(files[:2] * 3 + files[2:], read, whole)


def labels(folder: Path) -> Iterator[Case]:
    """LERF's labels as LangSplat has them."""
    shape = {"segmentation": [[1, 2], [9, 3], [5, 9.5]], "area": 9.0, "bbox": [1, 2, 9, 9]}
    thing = {"category": "red mug", "group": 1, "iscrowd": 0} | shape
    for name in ("frame_1", "frame_2"):
        content = {
            "info": {"name": f"{name}.jpg", "width": 30, "height": 20, "note": ""},
            "objects": [thing, thing | {"bbox": [0, 0, 3, 3]}, thing | {"category": "tea"}],
        }
        (folder / f"{name}.json").write_text(json.dumps(content))

    def whole(found) -> None:
        for frame in found:
            assert frame.width > 0
            assert frame.height > 0
            for category, (mask, boxes) in frame.objects.items():
                assert isinstance(category, str)
                assert mask.shape == (frame.height, frame.width)
                assert mask.dtype == bool
                assert boxes.shape == (len(boxes), 4)
                _finite(boxes)

    yield Case(sorted(folder.iterdir()), lambda: load_lerf_labels(folder), whole)


def _field(coder: Autoencoder | None = None) -> LanguageField:
    rng = np.random.default_rng(0)
    n, r, e, d, t, k, p = 12, 3, 8, 4, 2, 2, 2

    def unit(*shape):
        return (lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True))(rng.normal(size=shape)).astype(np.float32)

    def positive(*shape):
        return rng.random(shape).astype(np.float32)

    votes = Votes(
        rng.integers(-1, r, (n, k)).astype(np.int32), positive(n, k), positive(n), positive(n) + 1, positive(n),
        np.full(n, t, np.int32), np.int32(0), r, weight_where_region_visible=positive(n, k), overlap=positive(r, r),
    )  # fmt: skip
    return LanguageField(
        gaussians=_gaussians(n, 4),
        votes=votes,
        regions=Regions(unit(r, e), rng.integers(0, 9, (r, t)).astype(np.int32)),
        cameras=Camera(np.tile(np.eye(4, dtype=np.float32), (t, 1, 1)), *np.full((4, t), 20, np.float32), 24, 16),
        canonical_phrases=unit(4, e),
        source_from_scene=np.eye(4),
        names=("a", "b"),
        embedder="colours",
        provenance='{"jsecon": "1", "options": {"embedder": null}}',
        parts=Parts((np.arange(n) % (p + 1) - 1).astype(np.int32), unit(p, e), positive(p)),
        codes=None if coder is None else Codes(unit(n, d), unit(r, d), coder),
    )


def _coder() -> Autoencoder:
    """Layers of the true layout: 8 -> 4 -> 4, and back."""

    def layer(a, b):
        return {"kernel": np.full((a, b), 0.1, np.float32), "bias": np.zeros(b, np.float32)}

    def both(first, second):
        return {name: np.full(4, value, np.float32) for name, value in (first, second)}

    encoder = {"Dense_0": layer(8, 4), "Dense_1": layer(4, 4), "BatchNorm_0": both(("scale", 1), ("bias", 0))}
    stats = {"BatchNorm_0": both(("mean", 0), ("var", 1))}
    decoder = {"Dense_0": layer(4, 4), "Dense_1": layer(4, 8)}
    return Autoencoder({"params": encoder, "batch_stats": stats}, {"params": decoder})


def field(folder: Path) -> Iterator[Case]:
    """The language field."""

    def whole(found: LanguageField) -> None:
        _whole_gaussians(found.gaussians)
        for path, leaf in jax.tree_util.tree_leaves_with_path(dataclasses.replace(found, gaussians=None)):
            assert np.asarray(leaf).dtype.kind in "iuf", path
            _finite(leaf)
        r = found.regions.count
        for ids, count in (
            (found.votes.regions, r),
            (found.parts.part if found.parts else np.zeros(0, int), len(found.parts.weight) if found.parts else 0),
        ):
            assert np.asarray(ids).dtype.kind in "iu"
            assert ((ids >= -1) & (ids < count)).all(), "indices of nothing"
        assert type(found.names) is tuple
        assert all(isinstance(name, str) for name in found.names)
        assert isinstance(found.embedder, str)
        assert isinstance(json.loads(found.provenance), dict)
        assert type(found.cameras.width) is type(found.cameras.height) is int
        assert min(found.cameras.width, found.cameras.height) > 0
        if found.codes is not None:
            codes = encode(found.codes.autoencoder, np.asarray(found.canonical_phrases))
            assert codes.shape == (len(found.canonical_phrases), found.codes.regions.shape[1])
            _finite(codes)

    for name, value in {
        "plain": _field(),
        "coder": _field(_coder()),
        "bare": dataclasses.replace(_field(), parts=None),
    }.items():
        save_field(folder / f"{name}.safetensors", value)
        yield Case(
            [folder / f"{name}.safetensors"], lambda name=name: load_field(folder / f"{name}.safetensors"), whole
        )
    save_field(folder / "mapped.safetensors", _field())

    def checked() -> LanguageField:
        found = load_field(folder / "mapped.safetensors", mapped=True)
        check_field(folder / "mapped.safetensors")
        return found

    yield Case([folder / "mapped.safetensors"], checked, whole)


def kept(folder: Path) -> Iterator[Case]:
    """The run's cache, and what networks found: what cannot be read is computed again."""
    value = {"a": np.arange(12.0).reshape(3, 4), "cameras": _field().cameras, "told": ("x", 1, None), "list": [1, "b"]}
    cache.save(folder / "stage-0.safetensors", value)

    def read():
        return cache.fetch(folder / "stage-0.safetensors", lambda: value)

    def whole(found: tuple) -> None:
        _, seconds, fresh = found
        if fresh:
            raise InputError("cache", "computed again", "-", "-")
        assert isinstance(seconds, float)

    yield Case([folder / "stage-0.safetensors"], read, whole)
    frame, mask = np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), bool)
    store = EmbeddingStore(folder / "embeddings", "model")
    store.write(frame, {bytes(range(16)): np.ones(4, np.float32), bytes(16): np.ones(4, np.float32)})

    def whole_store(found: dict) -> None:
        assert all(isinstance(key, bytes) for key in found)
        for row in found.values():
            _finite(row)

    yield Case(sorted((folder / "embeddings").iterdir()), lambda: store.read(frame), whole_store)

    class Fixed:
        name = "fixed"

        def __call__(self, frame, index):
            return np.stack([mask, ~mask, mask])

        def check(self): ...

        def close(self): ...

    stored = StoredSegmenter(Fixed(), folder / "masks")
    stored(frame, 0)
    yield Case(sorted((folder / "masks").iterdir()), lambda: stored(frame, 0), _array((None, 6, 8), bool))


def tokenizer(folder: Path) -> Iterator[Case]:
    """tokenizer.json of CLIP."""
    write_tokenizer(folder / "tokenizer.json")

    def read() -> np.ndarray:
        texts = ["a red mug's 12 handles", "", "é<end_of_text>"]
        return TextTokenizer(folder / "tokenizer.json", None)(texts, CLIP_LENGTH)[0]

    yield Case([folder / "tokenizer.json"], read, _array((3, 77), np.int64, 0))


def _inputs_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix in (".onnx", ".json", ".npz", ".txt"))


def _nothing(found: object) -> None:
    pass


def clip(folder: Path) -> Iterator[Case]:
    """CLIP folders, put to the test as before a run."""
    for layout in ("immich", "transformers.js"):
        write_clip(folder / layout, layout)
        files = _inputs_of(folder / layout)
        yield Case(files, lambda layout=layout: ClipEmbedder(folder / layout).check(), _nothing)


def siglip(folder: Path) -> Iterator[Case]:
    """SigLIP folders, put to the test as before a run, with their scale and bias."""

    def read(layout: str) -> object:
        embedder = ClipEmbedder(folder / layout)
        embedder.check()
        return embedder.logits

    def whole(found: object) -> None:
        assert found is None or (0 < found[0] <= 1e4 and abs(found[1]) <= 1e3)

    for layout in ("immich", "transformers.js"):
        write_siglip(folder / layout, layout)
        yield Case(_inputs_of(folder / layout), lambda layout=layout: read(layout), whole)


def sam(folder: Path) -> Iterator[Case]:
    """SAM folders, put to the test, then asked for a frame's masks."""
    frame = np.zeros((24, 32, 3), np.uint8)

    def read(name: str) -> np.ndarray:
        segmenter = SamSegmenter(folder / name)
        segmenter.check()
        return segmenter(frame, 0)

    for name in ("sam", "sam2"):
        write_sam(folder / name, name, side=64)
        yield Case(_inputs_of(folder / name), lambda name=name: read(name), _array((None, 24, 32), bool))


def sam2(folder: Path) -> Iterator[Case]:
    """SAM 2 folders, put to the test, then asked to follow a mask."""
    frames, prompt = np.zeros((2, 16, 16, 3), np.uint8), np.ones((1, 16, 16), bool)

    def read() -> np.ndarray:
        tracker = Sam2Tracker(folder)
        tracker.check()
        return tracker(frames, 0, prompt)

    write_sam2(folder)
    yield Case(_inputs_of(folder), read, _array((2, 16, 16), np.int16, -1, 0))


def videos(folder: Path) -> Iterator[Case]:
    """Videos of three containers."""
    rng = np.random.default_rng(0)
    for name, code in {"a.avi": "MJPG", "b.mp4": "mp4v", "c.mkv": "mp4v"}.items():
        writer = cv2.VideoWriter(str(folder / name), cv2.VideoWriter.fourcc(*code), 10, (64, 48))
        assert writer.isOpened(), name
        for _ in range(6):
            writer.write(cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (64, 48)))
        writer.release()

        def read(name=name):
            shutil.rmtree(folder / "frames", ignore_errors=True)
            return video.write_frames(folder / name, folder / "frames", frames=3)

        def whole(found) -> None:
            assert 1 <= len(found) <= 3
            assert all(cv2.imread(str(file)).size for file in found)

        yield Case([folder / name], read, whole)


READERS: dict[str, Callable[[Path], Iterator[Case]]] = {
    own.__name__: own
    for own in (
        *(ply, splats, points, colmap, nerfstudio, rgbd, image, masks, langsplat, proposals, labels),
        *(field, kept, tokenizer, clip, siglip, sam, sam2, videos),
    )
}
