"""A real network's maps of named objects on real RGB-D frames, lifted by every method and scored in the other views.

    python -m experiments.apc_detector [FOLDER]

The capture is that of `experiments.apc_bin`: 15 views of a shelf bin, four named objects, and beside each frame a
network's probability map of each object (masks/*.mask.png) with the threshold that its authors chose. A pixel's
embedding is its probabilities, a text one of them. Ten views are lifted; the other five judge: selected Gaussians
alone, alpha > 0.7 and > 10/255, against the objects' models projected (segm/). The network's own maps of those views,
which no other row sees, stand beside.
"""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.apc_bin import OBJECTS, Options, _image, build_gaussians, load_apc
from experiments.rivals.lifting import centre_weights, gate
from jsecon.association.algorithm1 import clean_masklets
from jsecon.association.consensus import consensus_masklets
from jsecon.association.views import SceneViews
from jsecon.evaluate.lerf import VALA_THRESHOLD
from jsecon.evaluate.metrics import iou
from jsecon.fit.depth import points_from_depth
from jsecon.fit.optimise import fit_gaussians
from jsecon.fit.schedule import Schedule
from jsecon.fit.start import starting_gaussians
from jsecon.language.membership import vote_shares, with_shown
from jsecon.language.votes import region_votes
from jsecon.pipeline.masklet_stages import CLOUD, GRAIN
from jsecon.query.render import ALPHA_THRESHOLD, render_selection
from jsecon.query.silhouette import fit_silhouette
from jsecon.splat.composite import composite_features_vjp
from jsecon.splat.plan import plan_view
from jsecon.types import Camera, Capture, Gaussians, Regions
from jsecon.vision.classical import GRANULARITIES, ClassicalSegmenter
from jsecon.vision.surfaces import surfaces_from_depth

FILES = ("creativity_chenille_stems", "i_am_a_bunny_book", "kleenex_tissue_box", "laugh_out_loud_joke_book")
"""the objects of OBJECTS, as the maps' files are called"""
THRESHOLDS = (ALPHA_THRESHOLD, VALA_THRESHOLD)
FIT_STEPS = 1500


def load_maps(folder: Path, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities (T, H, W, 4) in [0, 1], and the authors' threshold of each object (4,)."""
    maps = []
    for name in names:
        images = [_image(folder / "masks" / f"{name}.{file}.mask.png", cv2.IMREAD_UNCHANGED) for file in FILES]
        maps.append(np.stack([image.astype(np.float32) / np.iinfo(image.dtype).max for image in images], axis=-1))
    cuts = [float((folder / "masks" / f"{file}.thresh.txt").read_text()) for file in FILES]
    return np.stack(maps), np.array(cuts, np.float32)


def all_pixels(gaussians: Gaussians, cameras: Camera, maps: np.ndarray) -> np.ndarray:
    """(N, 4) sum of w P over sum of w, all pixels of all views: weighted back-projection."""
    total = np.zeros((gaussians.count, maps.shape[-1] + 1))
    for t in range(len(maps)):
        plan = plan_view(gaussians, cameras[t])
        image = np.concatenate([maps[t], np.ones_like(maps[t][..., :1])], axis=-1)
        total += np.asarray(composite_features_vjp(plan.splats, plan.lists, jnp.asarray(image)))
    return total[:, :-1] / np.maximum(total[:, -1:], 1e-9)


def centres(chosen: Callable) -> Callable:
    """The same at the pixel of the centre alone, where `chosen` lets a weight count: Occam's LGS and VALA."""

    def lifted(gaussians: Gaussians, cameras: Camera, maps: np.ndarray) -> np.ndarray:
        total = np.zeros((gaussians.count, maps.shape[-1] + 1))
        for t, image in enumerate(maps):
            weight, pixel = (np.asarray(a) for a in centre_weights(plan_view(gaussians, cameras[t])))
            weight = np.where(chosen(weight) & (pixel >= 0), weight, 0.0)
            values = image.reshape(-1, image.shape[-1])[np.maximum(pixel, 0)]
            total += weight[:, None] * np.concatenate([values, np.ones_like(values[:, :1])], axis=1)
        return total[:, :-1] / np.maximum(total[:, -1:], 1e-9)

    return lifted


LIFTS: dict[str, Callable[[Gaussians, Camera, np.ndarray], np.ndarray]] = {
    "weighted back-projection": all_pixels,
    "Occam's LGS": centres(lambda weight: weight > 0),
    "VALA": centres(gate),
}


def by_regions(gaussians: Gaussians, capture: Capture, maps: np.ndarray, granularity: str) -> np.ndarray:
    """(N, 4) jsecon's own: masks of the default vision, brought together by consensus; a region's embedding is the mean
    of its pixels' probabilities in all views, a Gaussian's that of its regions, by their shares."""
    train = np.flatnonzero(~capture.held_out)
    depths, frames = np.asarray(capture.depths)[train], np.asarray(capture.frames)[train]
    known = depths[:, ::4, ::4]
    cloud = points_from_depth(capture, voxel=GRAIN * float(np.median(known[known > 0])), stride=4)
    if len(cloud.points) > CLOUD:
        cloud = points_from_depth(capture, max_points=CLOUD, stride=4)
    surfaces = surfaces_from_depth(depths, capture.cameras[train], cloud.points)
    segmenter = ClassicalSegmenter(**GRANULARITIES[granularity], surfaces=surfaces)
    cameras = jax.tree.map(jnp.asarray, capture.cameras[train])
    scene = SceneViews(gaussians, cameras, lambda t: segmenter(frames[t], t))
    labels = clean_masklets(consensus_masklets(frames, scene)).astype(np.int32)
    count = int(labels.max()) + 1
    inside = labels >= 0
    pixels = np.stack([np.bincount(image[image >= 0], minlength=count) for image in labels], axis=1).astype(np.int32)
    sums = [np.bincount(labels[inside], maps[..., k][inside], count) for k in range(maps.shape[-1])]
    embeddings = np.stack(sums, axis=1) / np.maximum(pixels.sum(1, keepdims=True), 1)
    regions = Regions(jnp.asarray(embeddings, jnp.float32), jnp.asarray(pixels))
    votes = with_shown(region_votes(gaussians, cameras, jnp.asarray(labels), count, by_view=True), regions)
    share, ids = np.asarray(vote_shares(votes)), np.asarray(votes.regions)
    whole = np.where(ids >= 0, share, 0).sum(1, keepdims=True)
    mixed = (np.where(ids >= 0, share, 0)[..., None] * embeddings[np.maximum(ids, 0)]).sum(1)
    return mixed / np.maximum(whole, 1e-9)


def fitted(capture: Capture, steps: int) -> Gaussians:
    """The photographs' own fit, as `jsecon fit` makes it."""
    start, _ = starting_gaussians(capture, sh_degree=1)
    gaussians, _ = fit_gaussians(capture, steps=steps, key=jax.random.key(0), start=start, schedule=Schedule())
    return jax.tree.map(jnp.asarray, gaussians)


def score(gaussians: Gaussians, capture: Capture, labels: np.ndarray, masks: list) -> list[list[float]]:
    """Mean IoU of each object over the judging views, for each silhouette threshold."""
    found = []
    for index, chosen in enumerate(masks):
        rows = []
        for t in np.flatnonzero(capture.held_out):
            camera = jax.tree.map(jnp.asarray, capture.cameras[int(t)])
            alpha = np.asarray(render_selection(gaussians, camera, jnp.asarray(chosen)).alpha)
            rows.append([float(iou(alpha > threshold, labels[t] == index)) for threshold in THRESHOLDS])
        found.append(np.mean(rows, axis=0).tolist())
    return found


def table_of(cells: list[dict]) -> str:
    """A Markdown table: IoU of each object at alpha > 0.7, and the means under both readings."""
    header = ("Gaussians", "method", "chosen by", *OBJECTS.values(), "mean, alpha > 0.7", "mean, > 10/255")
    rows = []
    for cell in cells:
        mean = np.mean(cell["iou"], axis=0)
        named = [cell[name] for name in ("scene", "method", "chooser")]
        rows.append((*named, *(row[0] for row in cell["iou"]), float(mean[0]), float(mean[1])))
    return results.table(header, rows)


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the last call was about."""

    capture: str
    fit_steps: int = FIT_STEPS


def main(asked: Asked, out: Path) -> str:
    """The table, written."""
    options = Options(capture=asked.capture)
    capture, labels = load_apc(asked.capture, held_out_every=options.held_out_every, nearest_m=options.nearest_m)
    maps, cuts = load_maps(Path(asked.capture), capture.names)
    train = np.flatnonzero(~capture.held_out)
    cameras, held = jax.tree.map(jnp.asarray, capture.cameras[train]), np.flatnonzero(capture.held_out)
    raw = [
        [float(np.mean([iou(maps[t, ..., k] > cut, labels[t] == k) for t in held]))] * 2 for k, cut in enumerate(cuts)
    ]
    cells = [{"scene": "", "method": "the network's maps of these views", "chooser": "its threshold", "iou": raw}]
    scenes = {"points of depth": build_gaussians(capture, options), "fitted": fitted(capture, asked.fit_steps)}
    for scene, gaussians in scenes.items():
        features = {name: lift(gaussians, cameras, maps[train]) for name, lift in LIFTS.items()}
        for granularity in GRANULARITIES:
            features[f"ours, {granularity} regions"] = by_regions(gaussians, capture, maps[train], granularity)
        for name, found in features.items():
            # The network's own threshold is where a share is one half.
            share = np.where(found <= cuts, 0.5 * found / cuts, 0.5 + 0.5 * (found - cuts) / (1 - cuts))
            best = found.argmax(1)[:, None] == np.arange(len(cuts))
            choosers = {
                "threshold": [share[:, k] >= 0.5 for k in range(len(cuts))],
                "silhouette": [
                    np.asarray(fit_silhouette(gaussians, cameras, np.float32(share[:, k] * best[:, k])))
                    for k in range(len(cuts))
                ],
            }
            for chooser, masks in choosers.items():
                told = {"scene": scene, "method": name, "chooser": chooser}
                cells.append(told | {"iou": score(gaussians, capture, labels, masks)})
                print(cells[-1]["scene"], name, chooser, np.mean(cells[-1]["iou"], axis=0), flush=True)
    table = table_of(cells)
    results.save(out, asked, {"cells": cells}, table)
    print(table)
    return table


if __name__ == "__main__":
    place = results.HOME / "results" / "apc_detector"
    main(Asked(sys.argv[1] if len(sys.argv) > 1 else Options().capture), place)
