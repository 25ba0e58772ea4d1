"""`jsecon run`, `fit` and `demo`, and what a run writes at its end: metrics.json, and report.html with pictures.

The demo's room is ray-traced by experiments/rooms, so its labels are exact. All else is what a real capture gets.
"""

import contextlib
import json
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jsecon.app import evaluation, pictures, report, verbs
from jsecon.app.catalogue import main_regions, palette
from jsecon.app.querying import write_answer
from jsecon.app.scene import Scene
from jsecon.evaluate.lerf import Row
from jsecon.files import write_text
from jsecon.pipeline import processes, run as pipeline
from jsecon.pipeline.options import Options, is_bare_scene, require_writable
from jsecon.pipeline.progress import Console
from jsecon.pipeline.run import Run
from jsecon.pipeline.stages import WARNING
from jsecon.process import peak_memory_mib
from jsecon.read.captures.frames import evenly_spaced
from jsecon.read.captures.images import write_image
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels
from jsecon.read.splats.writing import require_writable_format, save_gaussians
from jsecon.types import Capture, Gaussians, Quality

FILES = ("field.safetensors", "report.html", "metrics.json")
"""files of a run"""
FIRST_VIEW = "first_view.png"
"""file of a run of photographs: the picture that is there as soon as there is a scene"""

ROOM = Path(__file__).parents[1] / "demo" / "room"
"""the capture of the demo: COLMAP, images, masks of the objects, LERF labels of the held-out frames"""


def _run(verb: verbs.Run, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon run`; the result has the metrics, or the plan of a dry run."""
    options = verb.options
    if verb.dry_run:
        return pipeline.dry_run(options, verb.out, console=console)
    show = None if is_bare_scene(options.capture) else partial(_show_scene, verb.out, console)
    with processes.connection(options) if verb.distributed else contextlib.nullcontext(0) as index:
        if index == 0:
            run = pipeline.run(options, verb.out, console=console, on_scene=show)
        else:
            pipeline.run_worker(options, verb.out)
    if index > 0:
        raise SystemExit(0)
    title = f"Language field of {options.capture.resolve().name}"
    metrics = _write_run(run, verb.out, console, title, "Made by jsecon from posed frames.")
    query = f'jsecon query {verb.out / "field.safetensors"} "dark green bottle" --out {verb.out / "answers"}'
    console.print_line(f"next    {query}")
    names = FILES if show is None else (*FILES, FIRST_VIEW)
    return {"written": [verb.out / name for name in names]} | metrics


def _fit(verb: verbs.Fit, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon fit`: writes the scene in the world of the capture's files, and prints its figures."""
    require_writable_format(verb.out)
    folder = verb.out.with_suffix("")
    if verb.dry_run:
        return pipeline.dry_run(verb.options, folder, scene_only=True, console=console)
    gaussians, capture, held_out = pipeline.fit(verb.options, folder, console=console)
    save_gaussians(verb.out, gaussians, similarity=capture.source_from_scene)
    quality = _quality(held_out, console)
    console.print_line(f"{gaussians.count} Gaussians  {verb.out}")
    return {"written": {"scene": verb.out}, "gaussians": gaussians.count} | quality


def _show_scene(out: Path, console: Console, capture: Capture, gaussians: Gaussians) -> None:
    """Writes OUT/first_view.png, a photograph beside the scene from the same place, held out from the fit if any is."""
    t = int(np.argmax(np.asarray(capture.held_out)))
    rendered = pictures.render_picture(gaussians, jax.tree.map(np.asarray, capture.cameras)[t])
    write_image(out / FIRST_VIEW, np.concatenate([np.asarray(capture.frames[t]), rendered], axis=1))
    console.print_line(f"first view, photograph and scene: {out / FIRST_VIEW}")


def _write_run(
    run: Run, out: Path, console: Console, title: str, lead: str, parts: Sequence[str] = (), **figures: Any
) -> dict[str, Any]:
    """Writes OUT/metrics.json and OUT/report.html of a run, prints its figures, and returns the metrics.

    `parts` are sections that come first in the report (`jsecon.app.report`), and `figures` more metrics.
    """
    metrics = {
        "gaussians": run.field.gaussians.count,
        "regions": run.field.regions.count,
        "frames": len(run.capture.names),
        "size": [run.capture.cameras.width, run.capture.cameras.height],
        **_quality(run.held_out, console),
        "seconds": {name: round(value, 2) for name, value in run.seconds.items()},
        "notes": list(run.notes),
        "peak_memory_mib": round(peak_memory_mib(), 1),
        **figures,
    }
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    summary = (
        f"{metrics['gaussians']} Gaussians, {metrics['regions']} regions, "
        f"{sum(run.seconds.values()):.0f} s, peak memory {metrics['peak_memory_mib']:.0f} MiB"
    )
    warnings = [note for note in run.notes if note.startswith(WARNING)]
    with console.progress("report"):
        result = report.section("Result", ". ".join([summary, *run.notes]))
        write_text(out / "report.html", report.page(title, lead, [result, *parts, _pictures(run)]))
    console.print_line("\n".join([*warnings, summary]))
    console.print_line(f"field   {out / 'field.safetensors'}\nreport  {out / 'report.html'}")
    return metrics


def _quality(held_out: Quality, console: Console) -> dict[str, float | None]:
    """Prints and returns mean PSNR (dB) and SSIM of the held-out frames, None if there are no such frames."""
    count = len(held_out.frames)
    if not count:
        return {"held_out_psnr": None, "held_out_ssim": None}
    psnr, ssim = float(np.mean(held_out.psnr)), float(np.mean(held_out.ssim))
    console.print_line(f"held-out PSNR {psnr:.2f} dB, SSIM {ssim:.3f} over {count} frames")
    return {"held_out_psnr": round(psnr, 3), "held_out_ssim": round(ssim, 4)}


def _pictures(run: Run) -> str:
    """Returns the part that shows frames, masks, regions and the rendered scene."""
    gaussians, cameras = jax.device_put(run.field.gaussians), jax.tree.map(np.asarray, run.field.cameras)
    colours = np.concatenate([palette(run.field.regions.count) / 255, np.full((1, 3), 0.25)])  # grey without a region
    colours = colours[main_regions(run.field)]
    cells = []
    for row in evenly_spaced(len(run.labels), 6):
        t = int(run.vision_frames[row])
        frame = np.asarray(run.capture.frames[t])
        cells += [
            report.figure(frame, run.capture.names[t]),
            report.figure(pictures.label_overlay(frame, run.labels[row]), "masks", sharp=True),
            report.figure(pictures.render_picture(gaussians, cameras[t], colours), "regions"),
            report.figure(pictures.render_picture(gaussians, cameras[t]), "rendered"),
        ]
    words = "A region has one colour in all views, and so has each Gaussian by its strongest region; grey has none."
    return report.section("Frames, masks, regions", words, report.grid(cells, 4))


def _demo(verb: verbs.Demo, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon demo`: builds the field of the room, answers its texts, and measures the answers."""
    out = verb.out
    require_writable(out)
    capture = shutil.copytree(ROOM, out / "capture", dirs_exist_ok=True)
    holdout = json.loads((capture / "scene.json").read_text())["holdout"]
    options = Options(capture, holdout=holdout, steps=550)
    run = pipeline.run(options, out, console=console, on_scene=partial(_show_scene, out, console))
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
    parts = [_demo_answers(run, rows, summary, labels)]
    metrics = _write_run(run, out, console, "jsecon demo", lead, parts, anchored=summary)
    view = f'jsecon view {out / "field.safetensors"} "{texts[0]}"  (extra serve; --export writes a page)'
    console.print_line(f"answers {out / 'queries'}\nview it {view}")
    return {"written": [out / name for name in (*FILES, FIRST_VIEW, "queries")]} | metrics


def _demo_answers(run: Run, rows: list[Row], summary: dict[str, Any], labels: list[LabelledFrame]) -> str:
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
