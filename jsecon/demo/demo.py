"""`jsecon demo`: copies the capture of a made-up room out of the package, then runs, asks and measures it.

The room is ray-traced by experiments/rooms, so its labels are exact. Everything else is what a real capture gets.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import evaluation, pictures, report, running, verbs
from jsecon.app.outputs import write_answer
from jsecon.app.scene import Scene
from jsecon.evaluate.lerf import Row
from jsecon.files import write_text
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options, require_writable
from jsecon.pipeline.progress import Console
from jsecon.pipeline.run import Run
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels

ROOM = Path(__file__).with_name("room")
"""The capture: COLMAP, images, masks of the objects, LERF labels of the held-out frames."""


def run_demo(out: Path, *, listener: Console, room: Path = ROOM, steps: int = 550) -> dict[str, Any]:
    """Builds the field of the room, answers the texts of its labels, and writes answers, report.html and metrics.json.

    Args:
      out: Folder to write to.
      listener: Receives messages and progress.
      room: The capture to copy.
      steps: Number of optimisation steps of the photometric fit.
    """
    require_writable(out)
    capture = _copy_capture(room, out)
    holdout = json.loads((capture / "scene.json").read_text())["holdout"]
    options = Options(capture, holdout=holdout, steps=steps)
    run = pipeline.run(options, out, listener=listener)
    scene, labels = Scene(run.field), load_lerf_labels(capture / "label")
    results = evaluation.evaluate(scene, labels, listener, ("anchored",))
    rows, summary = results["anchored"]
    with listener.progress("report"):
        texts = sorted({name for frame in labels for name in frame.objects})
        for text in texts:
            answer = scene.ask(text)
            write_answer(answer, scene, out / "queries", scene.masks(answer, 2))
        metrics = running.run_metrics(run) | {"anchored": summary}
        write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
        write_text(out / "report.html", _page(run, rows, summary, labels))
    listener.print_line("measured on the held-out views")
    evaluation.print_table(results, listener)
    field = out / "field.safetensors"
    listener.print_line(f"field   {field}\nanswers {out / 'queries'}\nreport  {out / 'report.html'}")
    listener.print_line(f'view it jsecon view {field} "{texts[0]}"  (extra viewer; --export writes a page)')
    return metrics


def _demo(verb: verbs.Demo, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon demo`."""
    result = run_demo(verb.out, listener=console)
    return {"written": [verb.out / name for name in (*running.FILES, "queries")]} | result


def _copy_capture(room: Path, out: Path) -> Path:
    """Copies the room to OUT/capture, whole or not at all, unless it is there."""
    capture, unfinished = out / "capture", out / "capture.part"
    if not capture.is_dir():
        shutil.rmtree(unfinished, ignore_errors=True)
        shutil.copytree(room, unfinished)
        unfinished.rename(capture)
    return capture


def _page(run: Run, rows: list[Row], summary: dict[str, Any], labels: list[LabelledFrame]) -> str:
    """Returns the report: the figures, the best view of each answer beside the truth, and the run."""
    tiles = report.tiles(
        {
            "mIoU, text to Gaussians": f"{summary['miou']:.3f}",
            "mAcc@0.25": f"{summary['macc']:.3f}",
            "localisation accuracy": f"{summary['loc_acc']:.3f}",
            "held-out PSNR": f"{float(np.mean(run.held_out.psnr)):.2f} dB",
            "of work": f"{sum(run.seconds.values()):.0f} s",
        }
    )
    frames = dict(zip(run.capture.names, np.asarray(run.capture.frames)))
    truth = {(frame.name, name): mask for frame in labels for name, (mask, _) in frame.objects.items()}
    cells = []
    for text in sorted({row.query for row in rows}):
        row = max((row for row in rows if row.query == text), key=lambda row: truth[row.frame, text].sum())
        overlay = pictures.selection_overlay(frames[row.frame], row.mask, truth[row.frame, text])
        words = f"IoU {row.iou:.2f}, {row.selected} Gaussians, region {row.region}, score {row.score:.2f}"
        cells.append(report.pair(frames[row.frame], overlay, words, strong=text))
    words = "Pink: the selected Gaussians, rendered alone, over a held-out view; move the line to see the photograph. "
    words += f"White line: the ground truth. Figures: {summary['protocol']}; a missing prediction counts as 0."
    lead = "A made-up room as an ordinary capture: frames, poses and sparse points in, answers to texts out, "
    lead += "on a plain CPU and without any learned weights."
    parts = [tiles, report.section("Queries", words, report.grid(cells, 4)), *running.run_parts(run)]
    return report.page("jsecon demo", lead, parts)
