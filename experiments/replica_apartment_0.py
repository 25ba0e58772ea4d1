"""Share of the points of a real RGB-D scan whose code is nearest to that of the right region; masks given.

    python -m experiments.replica_apartment_0 [FOLDER]

The Gaussians are the back-projected depths of all 163 views, one per voxel, without a fit. The masks of every second
view vote. The region whose code is nearest to the Gaussian's code is compared with the label that most of its depth
pixels carry, over all views and over the views whose masks do not vote. The ids have no names. Each gets the CLIP text
vector of an LVIS class, drawn by the seed, so that codes must keep apart what a real embedding space keeps apart (mean
pairwise cosine 0.74).
"""

import dataclasses
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from experiments import results
from experiments.apc_bin import read_png
from experiments.datasets.depth_points import SampledPoints, labels_of_points, sampled_points
from experiments.protocols.points import point_accuracy, point_class_means
from experiments.tables.codes import region_codes
from jsecon.errors import InputError
from jsecon.field.evidence import region_votes
from jsecon.numerics import cosine_matrix
from jsecon.paper.distill import distill_votes
from jsecon.splat.points import gaussians_from_points
from jsecon.types import Camera, Capture, Gaussians

_HEX = """
1f77b4 aec7e8 ff7f0e ffbb78 2ca02c 98df8a d62728 ff9896 9467bd c5b0d5
8c564b c49c94 e377c2 f7b6d2 7f7f7f c7c7c7 bcbd22 dbdb8d 17becf 9edae5
393b79 5254a3 6b6ecf 9c9ede 637939 8ca252 b5cf6b cedb9c 8c6d31 bd9e39
e7ba52 e7cb94 843c39 ad494a d6616b e7969c 7b4173 a55194 ce6dbd de9ed6
"""
PALETTE = np.array([int(h, 16) for h in _HEX.split()])
"""The 40 colours of d3's category20 and category20b, in which semantic/ draws the id of an instance modulo 40."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    capture: tyro.conf.Positional[str] = str(results.CAPTURES / "replica_apartment_0")
    text_vectors: str = str(results.CAPTURES.parent / "text" / "clip_vitb32_lvis.npy")
    voting_every: int = 2
    """The masks of every `voting_every`-th view vote."""
    voxel_m: float = 0.06
    stride: int = 2
    """Every `stride`-th pixel of rows and columns is back-projected."""
    scale: float = 0.5
    """Standard deviation of a Gaussian in units of the distance to its neighbours. Half is the least that leaves
    surfaces closed."""
    opacity: float = 0.9
    latents: tuple[int, ...] = (16, 3)
    """Sizes of the code."""
    seed: int = 0
    out: str = str(results.HOME / "results" / "replica_apartment_0")


def ids_of_colors(image: np.ndarray, where: object) -> np.ndarray:
    """(H, W) int16 ids 0..39 of an RGB image in the palette. Raises InputError for a colour that is not in it."""
    wide = image.astype(np.int64)
    key = (wide[..., 0] << 16) | (wide[..., 1] << 8) | wide[..., 2]
    order = np.argsort(PALETTE)
    place = np.clip(np.searchsorted(PALETTE[order], key), 0, len(PALETTE) - 1)
    ids = order[place].astype(np.int16)
    foreign = PALETTE[ids] != key
    if foreign.any():
        remedy = "Give the label images as they were drawn, without compression or resizing."
        raise InputError(where, f"colour #{key[foreign][0]:06x} is not in the d3-40 palette", remedy=remedy)
    return ids


def world_to_camera(poses: np.ndarray) -> np.ndarray:
    """(T, 4, 4) world-to-camera, OpenCV axes, of rows x y z qw qx qy qz: camera-to-world, OpenGL axes."""
    rotation = Rotation.from_quat(poses[:, 3:], scalar_first=True).as_matrix()
    rotation = rotation * np.array([1.0, -1.0, -1.0])  # the columns are the camera's axes: y and z turn round
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, :3] = rotation.transpose(0, 2, 1)
    result[:, :3, 3] = -np.einsum("tji,tj->ti", rotation, poses[:, :3])
    return result.astype(np.float32)


def load_replica(folder: str | Path, *, voting_every: int) -> tuple[Capture, np.ndarray]:
    """The capture (held out: the views whose masks do not vote), and its ids (T, H, W) int16 in 0..39."""
    folder = Path(folder)
    try:
        poses = np.load(folder / "GT_pose.npy")
    except (OSError, ValueError) as error:
        raise InputError(folder / "GT_pose.npy", str(error), remedy="Give the folder replica_apartment_0.") from error

    def read(kind: str) -> list[np.ndarray]:
        return [read_png(folder / kind / f"{t + 1}.png", cv2.IMREAD_UNCHANGED) for t in range(len(poses))]

    frames = np.stack([image[..., 2::-1] for image in read("rgb")])
    depths = np.stack(read("depth")).astype(np.float32) / 255 * 10
    drawn = [image[..., 2::-1] for image in read("semantic")]
    labels = np.stack([ids_of_colors(image, folder / "semantic" / f"{t + 1}.png") for t, image in enumerate(drawn)])
    count, height, width = depths.shape
    # f = 256, c = 255.5 with pixel centres at integers; from the upper left corner that is 256, which is also where the
    # views' depths agree best (95th of 98 in a hundred within 5 cm: see the module's test on the real capture).
    focal, centre = np.full(count, 256.0, np.float32), np.full(count, 256.0, np.float32)
    cameras = Camera(world_to_camera(poses), focal, focal, centre, centre, width=width, height=height)
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    held_out, names = np.arange(count) % voting_every != 0, tuple(str(t + 1) for t in range(count))
    return Capture(frames, cameras, *nothing, held_out, depths, np.eye(4), names), labels


def points_as_gaussians(capture: Capture, options: Options) -> tuple[SampledPoints, Gaussians]:
    """The back-projected depths of all views, one per voxel, and a Gaussian for each."""
    every_view = dataclasses.replace(capture, held_out=np.zeros_like(capture.held_out))
    points = sampled_points(every_view, voxel=options.voxel_m, stride=options.stride)
    gaussians = gaussians_from_points(
        points.points, points.colors, opacity=options.opacity, scale=options.scale, max_scale=2 * options.voxel_m
    )
    return points, gaussians


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    began = time.perf_counter()
    capture, labels = load_replica(options.capture, voting_every=options.voting_every)
    points, gaussians = points_as_gaussians(capture, options)
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    truth = labels_of_points(points, labels, len(PALETTE))
    silent = np.where(capture.held_out[:, None, None], labels, np.int16(-1))
    truth_silent = labels_of_points(points, silent, len(PALETTE))
    voting = np.flatnonzero(~capture.held_out)
    cameras = jax.tree.map(jnp.asarray, capture.cameras[voting])
    votes = jax.block_until_ready(region_votes(gaussians, cameras, jnp.asarray(labels[voting]), len(PALETTE)))

    vectors = np.load(options.text_vectors)
    rng = np.random.default_rng(options.seed)
    embeddings = vectors[rng.choice(len(vectors), len(PALETTE), replace=False)].astype(np.float32)
    rows = []
    for latent in options.latents:
        codes, _, how = region_codes(jnp.asarray(embeddings), latent=latent, key=jax.random.key(options.seed))
        gram = np.asarray(cosine_matrix(codes, codes)) - 2 * np.eye(len(PALETTE))
        for reduce in ("mode", "median", "mean"):
            point_codes = jax.block_until_ready(distill_votes(votes, codes, reduce))
            nearest = np.where(
                np.asarray(point_codes).any(-1), np.asarray(jnp.argmax(cosine_matrix(point_codes, codes), -1)), -2
            )
            miou, macc = point_class_means(nearest, truth)
            rows.append(
                {
                    "latent": latent,
                    "reduce": reduce,
                    "accuracy": point_accuracy(nearest, truth),
                    "accuracy_silent_views": point_accuracy(nearest, truth_silent),
                    "point_miou": miou,
                    "point_macc": macc,
                    "largest_cosine_between_codes": float(gram.max()),
                    "coder": how,
                }
            )
    metrics = {
        "gaussians": gaussians.count,
        "voting_views": len(voting),
        "views": len(capture.names),
        "never_seen": int((np.asarray(votes.views) == 0).sum()),
        "overflow": int(votes.overflow),
        "points_with_label": int((truth >= 0).sum()),
        "points_in_silent_views": int((truth_silent >= 0).sum()),
        "seconds": round(time.perf_counter() - began, 2),
        "rows": rows,
    }
    columns = {
        "latent": "d",
        "reduce": "votes reduced by",
        "accuracy": "point accuracy",
        "accuracy_silent_views": "against silent views",
        "point_miou": "point mIoU",
        "point_macc": "point mAcc",
        "largest_cosine_between_codes": "largest cosine between codes",
    }
    table = results.table(tuple(columns.values()), [tuple(row[key] for key in columns) for row in rows])
    reductions = ("mode", "median", "mean")
    series = {f"d = {d}": [r["accuracy"] for r in rows if r["latent"] == d] for d in options.latents}
    out = Path(options.out)
    results.save(out, options, metrics, table, results.bars(list(reductions), series, "point accuracy"))
    print(table)
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
