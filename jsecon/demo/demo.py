"""`jsecon demo`: copies the capture of a made-up room out of the package, then runs, asks and measures it.

The room is ray-traced by experiments/rooms, so its labels are exact. Everything else is what a real capture gets.
"""

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import evaluation, pictures, report, running, verbs
from jsecon.app.querying import write_answer
from jsecon.app.scene import Scene
from jsecon.evaluate.lerf import Row
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options, require_writable
from jsecon.pipeline.progress import Console
from jsecon.pipeline.run import Run
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels

ROOM = Path(__file__).with_name("room")
"""The capture: COLMAP, images, masks of the objects, LERF labels of the held-out frames."""


def _demo(verb: verbs.Demo, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon demo`: builds the field of the room, answers its texts, and measures the answers."""
    out = verb.out
    require_writable(out)
    capture = shutil.copytree(ROOM, out / "capture", dirs_exist_ok=True)
    holdout = json.loads((capture / "scene.json").read_text())["holdout"]
    options = Options(capture, holdout=holdout, steps=550)
    run = pipeline.run(options, out, console=console, on_scene=partial(running.show_scene, out, console))
    scene, labels = Scene(run.field), load_lerf_labels(capture / "label")
    console.print_line("measured on the held-out views")
    rows, summary = evaluation.evaluate(scene, labels, console)
    texts = sorted({name for frame in labels for name in frame.objects})
    with console.progress("answers"):
        for text in texts:
            answer = scene.ask(text)
            masks = {t: scene.mask(answer, t) for t in scene.best_frames(answer, 2)}
            write_answer(answer, scene, out / "queries", masks)
    lead = "A made-up room as an ordinary capture: frames, poses and sparse points in, answers to texts out, "
    lead += "on a plain CPU and without any learned weights."
    parts = [_queries(run, rows, summary, labels)]
    metrics = running.write_run(run, out, console, "jsecon demo", lead, parts, anchored=summary)
    view = f'jsecon view {out / "field.safetensors"} "{texts[0]}"  (extra serve; --export writes a page)'
    console.print_line(f"answers {out / 'queries'}\nview it {view}")
    return {"written": [out / name for name in (*running.FILES, running.FIRST_VIEW, "queries")]} | metrics


def _queries(run: Run, rows: list[Row], summary: dict[str, Any], labels: list[LabelledFrame]) -> str:
    """Returns the part of the report with the best view of each answer beside the truth, and its figures."""
    frames = dict(zip(run.capture.names, np.asarray(run.capture.frames)))
    truth = {(frame.name, name): mask for frame in labels for name, (mask, _) in frame.objects.items()}
    cells = []
    for text in sorted({row.query for row in rows}):
        row = max((row for row in rows if row.query == text), key=lambda row: truth[row.frame, text].sum())
        overlay = pictures.selection_overlay(frames[row.frame], row.mask, truth[row.frame, text])
        words = f"IoU {row.iou:.2f}, {row.selected} Gaussians, region {row.region}, score {row.score:.2f}"
        cells.append(report.figure(overlay, words, strong=text))
    words = f"mIoU {summary['miou']:.3f}, mAcc@0.25 {summary['macc']:.3f}, localisation accuracy "
    words += f"{summary['loc_acc']:.3f} ({summary['protocol']}; a missing prediction counts as 0). "
    words += "Pink: the selected Gaussians, rendered alone, over a held-out view. White line: the ground truth."
    return report.section("Queries", words, report.grid(cells, 4))
