"""Named things in real photographs: how well do answers match outlines drawn by hand in frames that nothing saw?

    python -m experiments.bonsai_outlines [--capture FOLDER] [--out FOLDER]

Mip-NeRF 360's bonsai, 125 photographs, as `jsecon run` takes it: poses and points by COLMAP, Gaussians fitted, regions
by the vision without weights, texts by colour words. The outlines (`datasets/bonsai_outlines.json`, drawn for this
project) are of held-out frames. A thing is asked by its innermost pixel in each of its frames and judged in its others;
by its name, and judged in all. Beside stands the best region there is, chosen by the outlines: what the masks allow.
"""

import argparse
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from jsecon.app.ask import ask_text
from jsecon.errors import InputError
from jsecon.evaluate.metrics import iou
from jsecon.pipeline import pipeline
from jsecon.pipeline.options import Options as RunOptions
from jsecon.query.anchored import query_region
from jsecon.query.outliers import remove_outliers
from jsecon.query.pixel import region_at
from jsecon.query.render import ALPHA_THRESHOLD, VALA_THRESHOLD, render_selection
from jsecon.query.silhouette import fit_silhouette
from jsecon.types import Capture, LanguageField
from jsecon.vision.colours import ColourEmbedder

SILHOUETTE_WEIGHTS = results.HOME / "datasets" / "bonsai_outlines.json"
WAYS = ("pixel", "pixel, silhouette", "name", "name, all that answer", "best region")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    capture: str = str(results.CAPTURES / "bonsai")
    out: str = str(results.HOME / "results" / "bonsai_outlines")


def outlines(capture: Capture) -> dict[str, dict[int, np.ndarray]]:
    """thing -> frame -> (H, W) bool: its outline at the size of the frames, less what is in front of it."""
    told = json.loads(SILHOUETTE_WEIGHTS.read_text())
    height, width = capture.frames.shape[1:3]
    scale = np.array([width / told["width"], height / told["height"]])
    found: dict[str, dict[int, np.ndarray]] = {}
    for name, things in told["frames"].items():
        t = capture.names.index(name)
        covered = np.zeros((height, width), bool)
        for thing in told["in_front"]:
            if thing in things:
                mask = np.zeros((height, width), np.uint8)
                for polygon in things[thing]:
                    cv2.fillPoly(mask, [np.rint(np.array(polygon) * scale).astype(np.int32)], 1)
                found.setdefault(thing, {})[t] = (mask > 0) & ~covered
                covered |= mask > 0
    return found


def innermost(mask: np.ndarray) -> tuple[int, int]:
    """Column and row of the pixel of a mask that is farthest from its border."""
    away = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(away.argmax()), away.shape)
    return int(column), int(row)


class Asked:
    """Answers of one field, judged in any frame of the capture."""

    def __init__(self, field: LanguageField, capture: Capture):
        self.field, self.capture, self._regions = field, capture, {}
        self.gaussians = jax.tree.map(jnp.asarray, field.gaussians)
        self.means, self.embedder = np.asarray(field.gaussians.means), ColourEmbedder()

    def region(self, region: int, silhouette: bool = False) -> np.ndarray:
        """(N,) bool: a region's Gaussians as `jsecon query --at` gives them."""
        if (region, silhouette) not in self._regions:
            found = query_region(self.field, region)
            mask = np.asarray(found.mask)
            if silhouette:
                mask = np.asarray(fit_silhouette(self.field.gaussians, self.field.cameras, found.similarity))
            self._regions[region, silhouette] = remove_outliers(self.means, mask)
        return self._regions[region, silhouette]

    def under(self, t: int, mask: np.ndarray) -> int:
        """The region under the innermost pixel of a mask in frame t, -1 where none is."""
        camera = jax.tree.map(lambda a: np.asarray(a)[t : t + 1], self.capture.cameras)
        seen = dataclasses.replace(self.field, cameras=camera, names=(self.capture.names[t],))
        return region_at(seen, 0, *innermost(mask))

    def name(self, text: str, several: bool) -> np.ndarray | None:
        """(N,) bool, as `jsecon query` gives it; None where the colours have no word for it."""
        try:
            return ask_text(self.field, self.embedder, text, several=several).mask
        except InputError:
            return None

    def judged(self, chosen: np.ndarray, truth: dict[int, np.ndarray]) -> list[tuple[float, float]]:
        """IoU at alpha > 0.7 and > 10/255 in each frame of the truth."""
        rows = []
        for t, mask in truth.items():
            alpha = np.asarray(render_selection(self.gaussians, self.capture.cameras[t], jnp.asarray(chosen)).alpha)
            rows.append(tuple(float(iou(alpha > level, mask)) for level in (ALPHA_THRESHOLD, VALA_THRESHOLD)))
        return rows


def judge(asked: Asked, truth: dict[int, np.ndarray], thing: str) -> dict[str, list[tuple[float, float]]]:
    """IoUs of a thing by each way to ask."""
    found: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    for t, mask in truth.items():
        others, region = {other: own for other, own in truth.items() if other != t}, asked.under(t, mask)
        for way in WAYS[:2]:
            nothing = [(0.0, 0.0)] * len(others)
            found[way] += asked.judged(asked.region(region, way != "pixel"), others) if region >= 0 else nothing
    for way in WAYS[2:4]:
        chosen = asked.name(thing, way != "name")
        found[way] = asked.judged(chosen, truth) if chosen is not None else [(0.0, 0.0)] * len(truth)
    every = [asked.judged(asked.region(r), truth) for r in candidates(asked, truth)]
    found["best region"] = max(every, key=lambda rows: np.mean([row[0] for row in rows]), default=[])
    return found


def candidates(asked: Asked, truth: dict[int, np.ndarray]) -> list[int]:
    """Regions that lie under any of a grid of pixels of the outlines."""
    found = set()
    for t, mask in truth.items():
        rows, columns = np.nonzero(mask)
        for k in np.linspace(0, len(rows) - 1, 12).astype(int):
            spot = np.zeros_like(mask)
            spot[rows[k], columns[k]] = True
            found.add(asked.under(t, spot))
    return sorted(found - {-1})


def draw(asked: Asked, things: dict[str, dict[int, np.ndarray]]):
    """Each thing's answer to its name in its first frame, green, and its outline, white."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 3 * -(-len(things) // 4)))
    for n, (thing, truth) in enumerate(things.items()):
        axes = figure.add_subplot(-(-len(things) // 4), 4, n + 1, title=thing, xticks=[], yticks=[])
        (t, mask), chosen = next(iter(truth.items())), asked.name(thing, False)
        picture = np.clip(asked.capture.frames[t].astype(np.float32) * 1.6, 0, 255)
        if chosen is not None:
            drawn = render_selection(asked.gaussians, asked.capture.cameras[t], jnp.asarray(chosen)).alpha
            picture[np.asarray(drawn) > ALPHA_THRESHOLD] *= (0.5, 1, 0.5)
        axes.imshow(picture.astype(np.uint8))
        axes.contour(mask, [0.5], colors="white", linewidths=0.8)
    figure.tight_layout()
    return figure


def main(options: Options, tell: Callable[[str], None] = print) -> str:
    """The table, written."""
    out = Path(options.out)
    run = pipeline.run(RunOptions(Path(options.capture)), out / "run")
    asked = Asked(run.field, run.capture)
    things = {thing: truth for thing, truth in outlines(run.capture).items() if len(truth) > 1}
    rows, kept = [], {}
    for thing, truth in things.items():
        kept[thing] = judge(asked, truth, thing)
        means = {way: np.mean(found, axis=0) if found else np.zeros(2) for way, found in kept[thing].items()}
        rows.append((thing, len(truth), *(f"{means[way][0]:.3f} / {means[way][1]:.3f}" for way in WAYS)))
        tell(str(rows[-1]))
    mean = [np.mean([np.mean(kept[thing][way], axis=0) for thing in things], axis=0) for way in WAYS]
    rows.append(("mean", sum(map(len, things.values())), *(f"{m[0]:.3f} / {m[1]:.3f}" for m in mean)))
    text = results.table(("thing", "frames", *WAYS), rows)
    text += "\n\nIoU at alpha > 0.7 / > 10/255, mean over the held-out frames that show the thing, then over things. "
    text += f"{run.field.gaussians.count} Gaussians, {run.field.regions.count} regions, {np.mean(run.psnr):.2f} dB."
    results.save(out, options, kept, text)
    results.save_picture(out, "answers.png", draw(asked, things))
    tell(text)
    return text


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--capture", default=Options.capture)
    parser.add_argument("--out", default=Options.out)
    given = parser.parse_args()
    main(Options(given.capture, given.out))
