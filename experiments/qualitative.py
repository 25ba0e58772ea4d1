"""Pictures: what each method learnt, rendered, and what it selects for a text, in a frame that nothing was fitted to.

    python -m experiments.qualitative [--table lerf|ovs3d|replica] [--quick] [--root FOLDER] [--out FOLDER]

A column per method: first its features, by their three principal directions, then what it selects for each text,
rendered alone, with its IoU: of pixels, or, on Replica, of the points that have a label, each of the class that it
answers best, in a frame that was seen. On real data the picture shows the capture's own pixels and goes to pictures/,
which git ignores; a twin's is figure.webp.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from experiments import lerf, ovs3d, replica, results
from experiments.tables.answers import Answers
from experiments.tables.fill import Plan, options_of
from experiments.tables.methods import METHODS
from experiments.tables.setting import Setting, prepare
from jsecon.app.pictures import selection_overlay
from jsecon.evaluate.metrics import iou
from jsecon.files import atomic_write
from jsecon.fit.resize import resize_camera
from jsecon.query.selection_masks import selection_mask
from jsecon.splat.render import render
from jsecon.types import Array, Camera, Gaussians

TEXTS = 4
"""rows of the picture: the texts with the largest masks in the frame"""
QUICK_METHODS = "Occam's LGS", "VALA", "ours, consensus"
TABLES = {"lerf": lerf, "ovs3d": ovs3d, "replica": replica}


def plans(table: str) -> tuple[Plan, Plan]:
    """A table's plan for pictures, and the quick one."""
    given = TABLES[table]
    place = "qualitative" if table == "lerf" else f"qualitative_{table}"
    whole = dataclasses.replace(given.PLAN, sweep=(), out=str(results.HOME / "results" / place))
    quick = str(results.HOME / "results" / "quick" / place)
    return whole, dataclasses.replace(given.QUICK, sweep=(), methods=QUICK_METHODS, out=quick)


@dataclasses.dataclass(frozen=True)
class Seen:
    """A frame that a setting is looked at in."""

    name: str
    camera: Camera
    picture: np.ndarray
    """(H, W, 3) uint8."""
    true: dict[str, np.ndarray]
    """text -> (H, W) bool, the largest first."""
    select: Callable[[Answers, int], Bool[np.ndarray, " n"] | None]
    """the Gaussians of the k-th query."""
    truth_at_points: dict[str, np.ndarray]
    """text -> (N,) bool where the truth lies at the Gaussians."""


def seen(setting: Setting) -> Seen:
    """The first labelled frame; where the truth lies at the points, the one that shows most of them."""
    bench = setting.bench
    if bench.frames:
        frame = bench.frames[0]
        camera = jax.tree.map(jnp.asarray, resize_camera(setting.cameras[frame.name], frame.width, frame.height))
        true = {text: frame.objects[text][0] for text in frame.objects}
        picture = np.asarray(bench.capture.frames[bench.capture.names.index(frame.name)])

        def select(answers: Answers, k: int) -> np.ndarray | None:
            found = answers.select(k)
            return None if found is None else np.asarray(found.mask)

        return Seen(frame.name, camera, picture, largest(true), select, {})
    at_points = {text: np.asarray(bench.point_classes) == k for k, text in enumerate(bench.queries)}
    t = len(setting.names) // 2
    camera = setting.evidence.cameras[t]
    true = {text: shown(setting.evidence.gaussians, camera, own) for text, own in at_points.items() if own.any()}
    labelled = np.asarray(bench.point_classes) >= 0  # the others are nobody's in Table 3

    def by_class(answers, k):
        return (answers.classes() == k) & labelled

    return Seen(setting.names[t], camera, setting.frames[t], largest(true), by_class, at_points)


def largest(true: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The TEXTS whose masks have most pixels."""
    return dict(sorted(true.items(), key=lambda item: -int(item[1].sum()))[:TEXTS])


def shown(gaussians: Gaussians, camera: Camera, chosen: np.ndarray) -> np.ndarray:
    """(H, W) bool: where the chosen Gaussians alone have an alpha above 0.7."""
    return np.asarray(selection_mask(gaussians, camera, jnp.asarray(chosen)))


def main(plan: Plan) -> str:
    """Draws the first scene and seed; returns the table of the IoUs shown."""
    scene, seed = plan.data.scenes[0], plan.data.seeds[0]
    setting = prepare(plan.data, scene, seed, plan.level, fit_steps=plan.fit_steps)
    frame, queries, gaussians = seen(setting), setting.bench.queries, setting.evidence.gaussians
    first = [(frame.name, frame.picture)]
    panels = {"": first} | {
        text: [("truth", selection_overlay(frame.picture, own, own))] for text, own in frame.true.items()
    }
    rows: dict[str, list] = {text: [text] for text in frame.true}
    for name in plan.methods:
        answers = METHODS[name](setting, plan.steps)
        panels[""].append((name, rendered(gaussians, frame.camera, answers.features)))
        for text, true in frame.true.items():
            chosen = frame.select(answers, queries.index(text))
            none = chosen is None or not chosen.any()
            mask = np.zeros_like(true) if none else shown(gaussians, frame.camera, chosen)
            judged = (mask, true) if not frame.truth_at_points else (chosen, frame.truth_at_points[text])
            value = 0.0 if none else float(iou(*judged))
            panels[text].append((f"{value:.2f}", selection_overlay(frame.picture, mask, true)))
            rows[text].append(value)
        print(f"{name}: mean IoU of {len(rows)} texts {np.mean([row[-1] for row in rows.values()]):.3f}", flush=True)
    table = results.table(("text", *plan.methods), [tuple(row) for row in rows.values()])
    source = f"{'a twin in the layout of ' if setting.bench.twin else ''}{setting.bench.dataset}"
    judged = "of points" if frame.truth_at_points else "of pixels, alpha > 0.7"
    text = f"IoU in {frame.name} of {scene}, {source}, {judged}; figure.webp shows the masks.\n\n{table}"
    drawing, out = draw(panels), Path(plan.out)
    results.save(out, plan, {"iou": {text: row[1:] for text, row in rows.items()}}, text, drawing)
    if not setting.bench.twin:
        (out / "figure.webp").unlink()
        with atomic_write(out / "pictures" / "selections.png") as temporary:
            drawing.savefig(temporary, dpi=110, bbox_inches="tight")
    print(text)
    return text


def rendered(gaussians: Gaussians, camera: Camera, features: Float[Array, "n f"]) -> np.ndarray:
    """(H, W, 3) uint8: features, rendered, by their three principal directions; grey where a Gaussian has none."""
    codes = np.asarray(features, np.float32)
    has = np.isfinite(codes).all(1) & np.any(codes != 0, 1)
    known = codes[has][:: max(1, has.sum() // 20_000)]
    axes = np.linalg.svd(known - known.mean(0), full_matrices=False)[2][:3]
    colours = np.zeros((len(codes), 3), np.float32)
    colours[has, : len(axes)] = (codes[has] - known.mean(0)) @ axes.T
    low, high = np.quantile(colours[has], 0.02, axis=0), np.quantile(colours[has], 0.98, axis=0)
    colours = np.clip((colours - low) / np.maximum(high - low, 1e-6), 0, 1)
    colours[~has] = 0.5
    image = np.asarray(render(gaussians, camera, jnp.asarray(colours, jnp.float32)).features)
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def draw(panels: dict[str, list]):
    """A row of pictures per text."""
    from matplotlib.figure import Figure

    columns = max(map(len, panels.values()))
    figure = Figure(figsize=(1.9 * columns, 1.7 * len(panels)))
    for r, (text, row) in enumerate(panels.items()):
        for c, (title, picture) in enumerate(row):
            axes = figure.add_subplot(len(panels), columns, r * columns + c + 1)
            axes.imshow(picture)
            axes.set_title(title, fontsize=7)
            axes.set_xticks([])
            axes.set_yticks([])
            if c == 0:
                axes.set_ylabel(text, fontsize=7)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--table", choices=TABLES, default="lerf")
    which, words = parser.parse_known_args()
    main(options_of(*plans(which.table), words))
