"""Pictures: the rendered codes of a field, and what each method selects for a text, seen in a held-out frame.

    python -m experiments.qualitative [--quick] [--root FOLDER] [--out FOLDER]

One row per text: the frame, its label, then each method's selection rendered alone, its IoU above it. On real data the
picture shows the capture's own pixels and goes to pictures/, which git ignores; a twin's is figure.png.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import lerf, results
from experiments.tables.fill import Plan, options_of
from experiments.tables.methods import METHODS
from experiments.tables.ours import field_of
from experiments.tables.setting import Setting, prepare
from jsecon.app.pictures import selection_overlay
from jsecon.evaluate.lerf import resized
from jsecon.evaluate.metrics import iou
from jsecon.query.masks import selection_mask
from jsecon.splat.render import render

TEXTS = 4
"""rows of the picture: the texts with the largest masks in the first labelled frame"""
PLAN = dataclasses.replace(lerf.PLAN, sweep=(), out=str(results.HOME / "results" / "qualitative"))
QUICK = dataclasses.replace(
    lerf.QUICK,
    methods=("Occam's LGS", "VALA", "ours, consensus"),
    out=str(results.HOME / "results" / "quick" / "qualitative"),
)


def main(plan: Plan) -> str:
    """Draws the first scene and seed; returns the table of the IoUs shown."""
    scene, seed = plan.data.scenes[0], plan.data.seeds[0]
    setting = prepare(plan.data, scene, seed, plan.level, fit_steps=plan.fit_steps)
    frame = setting.bench.frames[0]
    t = setting.bench.capture.names.index(frame.name)
    camera = jax.tree.map(jnp.asarray, resized(setting.cameras[frame.name], frame.width, frame.height))
    texts = sorted(frame.objects, key=lambda name: -int(frame.objects[name][0].sum()))[:TEXTS]
    picture, codes = np.asarray(setting.bench.capture.frames[t]), rendered_codes(setting, camera)
    panels: dict[str, list] = {text: [(frame.name, picture), ("codes", codes)] for text in texts}
    rows: dict[str, list] = {text: [text] for text in texts}
    for name in plan.methods:
        answers = METHODS[name](setting, plan.steps)
        for text in texts:
            found = answers.select(setting.bench.queries.index(text))
            true = frame.objects[text][0]
            mask = np.zeros_like(true)
            if found is not None:
                mask = np.asarray(selection_mask(setting.evidence.gaussians, camera, found.mask))
            value = float(iou(mask, true))
            panels[text].append((f"{name}\n{value:.2f}", selection_overlay(picture, mask, true)))
            rows[text].append(value)
        print(f"{name}: mean IoU of {len(texts)} texts {np.mean([row[-1] for row in rows.values()]):.3f}")
    table = results.table(("text", *plan.methods), [tuple(row) for row in rows.values()])
    source = "a twin in LERF-OVS's layout" if setting.bench.twin else "LERF-OVS"
    text = f"IoU in {frame.name} of {scene}, {source}, alpha > 0.7; figure.png shows the masks.\n\n{table}"
    drawing, out = draw(panels), Path(plan.out)
    results.save(out, plan, {"iou": {text: row[1:] for text, row in rows.items()}}, text, drawing)
    if not setting.bench.twin:
        (out / "figure.png").unlink()
        results.save_picture(out, "selections.png", drawing)
    print(text)
    return text


def rendered_codes(setting: Setting, camera) -> np.ndarray:
    """(H, W, 3) uint8: the field's codes, rendered, by their three principal directions."""
    field = field_of(setting)
    codes = np.asarray(field.codes)
    known = codes[np.any(codes != 0, 1)]
    axes = np.linalg.svd(known - known.mean(0), full_matrices=False)[2][:3]
    colours = np.zeros((len(codes), 3), np.float32)
    colours[:, : len(axes)] = (codes - known.mean(0)) @ axes.T
    low, high = np.quantile(colours, 0.02, axis=0), np.quantile(colours, 0.98, axis=0)
    colours = np.clip((colours - low) / np.maximum(high - low, 1e-6), 0, 1)
    colours[~np.any(codes != 0, 1)] = 0.5
    image = np.asarray(render(setting.evidence.gaussians, camera, jnp.asarray(colours, jnp.float32)).features)
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
    main(options_of(PLAN, QUICK))
