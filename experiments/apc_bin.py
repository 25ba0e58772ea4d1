"""Selections of four objects in a shelf bin against their masks in held-out views; real RGB-D frames.

    python -m experiments.apc_bin [FOLDER]

The capture is a scene of the MIT-Princeton APC 2016 data (15 views, 640x480). The Gaussians are the back-projected
depths of the training views, whose masks vote. A selection is rendered alone in the held-out views (alpha > 0.7) and
compared with the masks there. The masks are projections of object models, so that they include what the gripper hides.
"""

import dataclasses
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from PIL import Image

from experiments import results
from experiments.datasets.depth_points import confirmed_depths
from jsecon.app.catalogue import palette
from jsecon.app.pictures import outlined
from jsecon.errors import InputError
from jsecon.evaluate.metrics import accuracy_at, iou, mean_iou
from jsecon.field.evidence import region_votes
from jsecon.field.membership import normalise_votes
from jsecon.files import atomic_write
from jsecon.fit.quality import measure_quality
from jsecon.fit.start import points_from_depth
from jsecon.paper.distill import distill_votes
from jsecon.paper.queries import select_by_code
from jsecon.query.answer import match_region, select_gaussians
from jsecon.query.outliers import remove_outliers
from jsecon.query.rules import QueryRules
from jsecon.query.selection_masks import selection_mask
from jsecon.splat.points import gaussians_from_points
from jsecon.types import Camera, Capture, Codes, Gaussians, LanguageField, Regions

OBJECTS = {48: "chenille stems", 114: "bunny book", 132: "kleenex tissue box", 144: "joke book"}
"""Objects by their numbers in segm/; 0 is background."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    capture: tyro.conf.Positional[str] = str(results.CAPTURES / "apc_bin" / "scene-0000")
    held_out_every: int = 3
    """Every `held_out_every`-th frame is held out, starting with the second."""
    nearest_m: float = 0.2
    """Smaller depths show the gripper; the range of the sensor begins here."""
    depth_tolerance: float = 0.015
    """Relative difference up to which the depth of another view confirms a depth."""
    voxel_m: float = 0.003
    scale: float = 0.6
    """Standard deviation of a Gaussian in units of the distance to its neighbours."""
    opacity: float = 0.9
    threshold: float = 0.5
    """Share of the votes from which a Gaussian belongs to an object."""
    out: str = str(results.HOME / "results" / "apc_bin")


def parse_cameras(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Reads (3, 3) colour intrinsics and (T, 4, 4) camera-to-world poses (OpenCV axes) from a cam.info.txt."""
    blocks: dict[str, list[list[float]]] = {}
    title = ""
    for line in text.splitlines():
        if line.startswith("#"):
            title = line[1:].strip()
        elif line.strip():
            blocks.setdefault(title, []).append([float(v) for v in line.split()])
    intrinsics = next((m for t, m in blocks.items() if t.startswith("Color camera intrinsic")), None)
    poses = {t.rsplit("-", 1)[1]: m for t, m in blocks.items() if t.startswith("Camera-to-world")}
    shapes = {np.shape(m) for m in poses.values()}
    if np.shape(intrinsics) != (3, 3) or shapes != {(4, 4)}:
        problem = "lacks the 3x3 colour intrinsic matrix or a 4x4 camera-to-world matrix of each frame"
        raise InputError("cam.info.txt", problem, remedy="Give the file as the APC toolbox writes it.")
    return np.array(intrinsics), np.array([poses[k] for k in sorted(poses)])


def decode_depth(raw: np.ndarray) -> np.ndarray:
    """Depth in metres of a uint16 PNG, whose bits are rotated by three and whose unit is 0.1 mm."""
    return (((raw >> 3) | (raw << 13)) & 0xFFFF).astype(np.float32) / 10_000


def read_png(path: Path, flags: int) -> np.ndarray:
    """Reads a PNG by the flags of cv2.imread. Raises InputError where it cannot be read."""
    image = cv2.imread(str(path), flags)
    if image is None:
        raise InputError(path, "is no readable image", remedy="Fetch the capture again.")
    return image


def load_apc(folder: str | Path, *, held_out_every: int, nearest_m: float) -> tuple[Capture, np.ndarray]:
    """Loads the capture and labels (T, H, W) int16: 0 to 3 are the OBJECTS in order, 4 is background."""
    folder = Path(folder)
    try:
        intrinsics, poses = parse_cameras((folder / "cam.info.txt").read_text())
    except OSError as error:
        remedy = "Give the folder scene-0000 of apc_bin."
        raise InputError(folder / "cam.info.txt", str(error.strerror), remedy=remedy) from error
    names = tuple(f"frame-{t:06d}" for t in range(len(poses)))
    frames = np.stack([read_png(folder / f"{n}.color.png", cv2.IMREAD_COLOR)[..., ::-1] for n in names])
    depths = np.stack([decode_depth(read_png(folder / f"{n}.depth.png", cv2.IMREAD_UNCHANGED)) for n in names])
    depths[depths < nearest_m] = 0
    segments = np.stack([read_png(folder / "segm" / f"{n}.segm.png", cv2.IMREAD_UNCHANGED) for n in names])
    labels = np.full(segments.shape, len(OBJECTS), np.int16)
    for index, number in enumerate(OBJECTS):
        labels[segments == number] = index
    # The matrix puts pixel centres at integers (OpenCV), jsecon half a pixel farther from the upper left corner.
    count = len(names)
    fx, fy, cx, cy = (
        np.full(count, v, np.float32)
        for v in (intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2] + 0.5, intrinsics[1, 2] + 0.5)
    )
    cameras = Camera(
        np.linalg.inv(poses).astype(np.float32), fx, fy, cx, cy, width=frames.shape[2], height=frames.shape[1]
    )
    held_out = np.arange(count) % held_out_every == 1
    no_points = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    return Capture(frames, cameras, *no_points, held_out, depths, np.eye(4), names), labels


def build_gaussians(capture: Capture, options: Options) -> Gaussians:
    """One Gaussian per voxel of the back-projected depths of the training views."""
    depths = confirmed_depths(capture, tolerance=options.depth_tolerance, min_views=1)
    points = points_from_depth(dataclasses.replace(capture, depths=depths), voxel=options.voxel_m)
    gaussians = gaussians_from_points(
        points.points, points.colors, opacity=options.opacity, scale=options.scale, max_scale=3 * options.voxel_m
    )
    return jax.tree.map(jnp.asarray, gaussians)


def build_field(gaussians: Gaussians, capture: Capture, labels: np.ndarray) -> LanguageField:
    """Field of the votes of the training masks. The regions have one-hot embeddings."""
    used = np.flatnonzero(~capture.held_out)
    cameras = jax.tree.map(jnp.asarray, capture.cameras[used])
    count = len(OBJECTS) + 1
    pixels = np.stack([(labels[used] == r).sum((1, 2)) for r in range(count)]).astype(np.int32)
    regions = Regions(jnp.eye(count), jnp.asarray(pixels))
    votes = normalise_votes(region_votes(gaussians, cameras, jnp.asarray(labels[used]), count, by_view=True), regions)
    return LanguageField(
        gaussians=gaussians,
        votes=votes,
        regions=regions,
        cameras=cameras,
        canonical_phrases=jnp.zeros((1, count)),
        source_from_scene=jnp.eye(4),
        names=tuple(capture.names[t] for t in used),
        embedder="labels",
        codes=Codes(distill_votes(votes, regions.embeddings), regions.embeddings, None),
    )


WAYS = ("votes", "code", "votes + DBSCAN")
"""Ways to select the Gaussians of a region."""


def evaluate(
    field: LanguageField, capture: Capture, labels: np.ndarray, options: Options, ways: tuple[str, ...] = WAYS
) -> list[dict]:
    """Rows of each way to select, object and held-out view."""
    rows = []
    for way in ways:
        by = way.split()[0]
        for index, name in enumerate(OBJECTS.values()):
            match = match_region(field, index)
            if by == "code":
                chosen = select_by_code(field, match).mask
            else:
                chosen = select_gaussians(field, match, QueryRules(min_share=options.threshold)).mask
            if way.endswith("DBSCAN"):
                chosen = jnp.asarray(remove_outliers(np.asarray(field.gaussians.means), np.asarray(chosen), keep="all"))
            for t in np.flatnonzero(capture.held_out):
                camera = jax.tree.map(jnp.asarray, capture.cameras[int(t)])
                mask = np.asarray(selection_mask(field.gaussians, camera, chosen))
                row = {"by": way, "object": name, "frame": capture.names[t], "selected": int(chosen.sum())}
                rows.append(row | {"iou": float(iou(mask, labels[t] == index))})
    return rows


def draw_answers(field: LanguageField, capture: Capture, labels: np.ndarray, options: Options) -> np.ndarray:
    """A held-out photograph (H, W, 3), and beside it the objects' Gaussians in it, with the outlines of the truth."""
    t = int(np.flatnonzero(capture.held_out)[1])
    frame, camera = np.asarray(capture.frames[t]), jax.tree.map(jnp.asarray, capture.cameras[t])
    answers = (0.5 * frame).astype(np.uint8)
    for index, colour in enumerate(palette(len(OBJECTS))):
        chosen = select_gaussians(field, match_region(field, index), QueryRules(min_share=options.threshold)).mask
        mask = np.asarray(selection_mask(field.gaussians, camera, chosen))
        answers[mask] = (0.5 * frame[mask] + 0.5 * colour).astype(np.uint8)
        answers = outlined(answers, labels[t] == index, (255, 255, 255), 2)
    return np.concatenate([frame, answers], axis=1)


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    began = time.perf_counter()
    capture, labels = load_apc(options.capture, held_out_every=options.held_out_every, nearest_m=options.nearest_m)
    gaussians = build_gaussians(capture, options)
    field = jax.block_until_ready(build_field(gaussians, capture, labels))
    rows = evaluate(field, capture, labels, options)
    metrics = {
        "gaussians": gaussians.count,
        "held_out": [capture.names[t] for t in np.flatnonzero(capture.held_out)],
        "psnr_held_out_db": float(measure_quality(gaussians, capture).psnr.mean()),
        "miou": {way: mean_iou(r["iou"] for r in rows if r["by"] == way) for way in WAYS},
        "macc_025": {way: accuracy_at([r["iou"] for r in rows if r["by"] == way]) for way in WAYS},
        "objects": {
            way: {
                name: mean_iou(r["iou"] for r in rows if (r["by"], r["object"]) == (way, name))
                for name in OBJECTS.values()
            }
            for way in WAYS
        },
        "seconds": round(time.perf_counter() - began, 2),
        "rows": rows,
    }
    lines = [(way, *(metrics["objects"][way][n] for n in OBJECTS.values()), metrics["miou"][way]) for way in WAYS]
    table = results.table(("selected by", *OBJECTS.values(), "mean IoU"), lines)
    out = Path(options.out)
    series = {way: [metrics["objects"][way][name] for name in OBJECTS.values()] for way in WAYS}
    results.save(out, options, metrics, table, results.bars(list(OBJECTS.values()), series, "IoU, held-out views"))
    with atomic_write(out / "answers.webp") as temporary:
        Image.fromarray(draw_answers(field, capture, labels, options)).save(temporary, "WEBP", quality=80)
    print(table)
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
