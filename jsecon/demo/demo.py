"""`jsecon demo`: writes a made-up room as an ordinary capture, then runs, queries and measures it like a real one.

It builds two fields: one with the default vision, one with the true masks of the room. They share the cache, and so the
frames and the fitted Gaussians. Both are measured on held-out views.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jsecon.app import ask, evaluation, pictures, report, running, verbs
from jsecon.app.evaluation import Evaluation
from jsecon.app.outputs import answer_masks, write_answer
from jsecon.demo import write_room
from jsecon.demo.film import write_film
from jsecon.demo.room import crowded_room
from jsecon.evaluate.lerf import Row
from jsecon.files import atomic_write, write_text
from jsecon.pipeline import model_loading, run as pipeline
from jsecon.pipeline.options import Options, require_writable
from jsecon.pipeline.progress import Console, Listener
from jsecon.pipeline.run import Run
from jsecon.process import peak_memory_mib
from jsecon.read.masks.labels import LabelledFrame, load_lerf_labels

HOLDOUT = 5
"""Every `HOLDOUT`-th frame is held out."""


def run_demo(
    out: Path, *, seed: int = 0, steps: int, listener: Listener, room: dict[str, int] | None = None
) -> dict[str, Any]:
    """Builds and measures the fields of a made-up room.

    Writes capture/, field.safetensors, true_masks/field.safetensors, queries/, metrics.json, report.html, demo.jpg and
    demo.webp.

    Args:
      out: Folder to write to.
      seed: Seed of the room.
      steps: Number of optimisation steps of the photometric fit.
      listener: Receives messages and progress.
      room: Options of `write_room` that differ from its defaults.

    Returns:
      The metrics.

    Raises:
      InputError: The folder cannot be written.
    """
    require_writable(out)
    capture = _write_capture(out / "capture", seed, {"holdout": HOLDOUT} | (room or {}), listener)
    options = Options(capture, holdout=HOLDOUT, steps=steps, seed=seed)
    run = pipeline.run(options, out, listener=listener)
    true_options = dataclasses.replace(options, masks=capture / "masks")
    true_run = pipeline.run(true_options, out / "true_masks", listener=listener, cache_folder=out / "cache")

    labels = load_lerf_labels(capture / "label")
    embedder = model_loading.field_embedder(run.field)
    listener.say("measured on the held-out views")
    results = evaluation.evaluate(run.field, embedder, labels, listener)
    results["true_masks"] = evaluation.evaluate(true_run.field, embedder, labels, listener, ("anchored",))["anchored"]
    metrics = _metrics(results, run, true_run)
    with listener.progress("report"):
        texts = sorted({name for frame in labels for name in frame.objects})
        answers = {answer.query: answer for answer in ask.ask_each(run.field, embedder, texts=texts)[0]}
        queries = {
            text: write_answer(run.field, answer, out / "queries", answer_masks(run.field, answer, views=2))
            for text, answer in answers.items()
        }
        pictured = max(labels, key=lambda frame: (len(frame.objects), frame.name)).name
        masks = {row.query: row.mask for row in results["anchored"][0] if row.frame == pictured}
        _write_panels(out / "demo.jpg", run, run.capture.names.index(pictured), masks)
        write_film(run.field, [answer for answer in answers.values() if answer.mask.any()], out / "demo.webp")
        film = report.film((out / "demo.webp").read_bytes(), "Rendered from the field: each text lights up its match.")
        write_text(out / "report.html", _page(run, results, queries, labels, metrics, film, seed))
    single = sum(query["skipped"].get("DBSCAN") == "the selection is one component" for query in queries.values())
    metrics["skipped"]["DBSCAN"] = f"{single} of {len(queries)} selections are one component"
    metrics["peak_memory_mib"] = round(peak_memory_mib(), 1)
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    evaluation.print_table(results, listener)
    listener.say(
        f"held-out PSNR {metrics['held_out_psnr']:.2f} dB, {metrics['total_seconds']:.0f} s of work, "
        f"peak memory {metrics['peak_memory_mib']:.0f} MiB"
    )
    field = out / "field.safetensors"
    listener.say(f"field   {field}\nanswers {out / 'queries'}\nreport  {out / 'report.html'}")
    listener.say(f'view it jsecon view {field} "{next(iter(answers), "")}"  (extra viewer; --export writes a page)')
    return metrics


def _demo(verb: verbs.Demo, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon demo`."""
    names = (*running.FILES, "queries", "demo.jpg", "demo.webp")
    result = run_demo(verb.out, seed=verb.seed, steps=verb.steps, listener=console)
    return {"written": [verb.out / name for name in names]} | result


def _write_capture(folder: Path, seed: int, room: dict[str, int], listener: Listener) -> Path:
    """Writes the room, unless the folder already holds the whole room of these options."""
    marker = folder / "demo.json"
    description = json.dumps({"seed": seed} | room, sort_keys=True)
    if not (marker.exists() and marker.read_text() == description):
        marker.unlink(missing_ok=True)
        with listener.progress("room") as progress:
            write_room(folder, crowded_room(seed), progress=progress, **room)
        write_text(marker, description)
    listener.say(f"the room of seed {seed}: {folder}")
    return folder


def _metrics(results: Evaluation, run: Run, true_run: Run) -> dict[str, Any]:
    """Figures of metrics.json; `run_demo` adds the peak memory."""
    keys = ("miou", "macc", "acc_50", "loc_acc", "pairs", "missing")
    metrics: dict[str, Any] = {kind: {key: figures[key] for key in keys} for kind, (_, figures) in results.items()}
    shared = ("load", "gaussians", "held_out")
    true_seconds = {f"{name} (true masks)": s for name, s in true_run.seconds.items() if name not in shared}
    seconds = run.seconds | true_seconds
    return metrics | {
        "protocol": results["anchored"][1]["protocol"],
        "held_out_psnr": round(float(np.mean(run.psnr)), 3),
        "regions": run.field.regions.count,
        "gaussians": run.field.gaussians.count,
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
        "total_seconds": round(sum(seconds.values()), 1),
        "skipped": {f"{name} (true masks)": why for name, why in true_run.skipped.items()} | run.skipped,
        "peak_memory_mib": 0.0,
    }


def _write_panels(file: Path, run: Run, frame: int, masks: Mapping[str, np.ndarray]) -> None:
    """Writes a held-out frame, the masklets and regions of the nearest training frame, and the masks of the answers."""
    train = np.flatnonzero(~np.asarray(run.capture.held_out))
    nearest = int(np.abs(train - frame).argmin())
    frames, t = np.asarray(run.capture.frames), int(train[nearest])
    renderer = pictures.Renderer(run.field.gaussians, run.field.cameras)
    panels = {
        "frame": frames[frame],
        "masklets": pictures.label_overlay(frames[t], run.labels[nearest]),
        "regions of the Gaussians": renderer.colours(t, pictures.region_colours(run.field)),
        "answers to texts": pictures.answers_overlay(frames[frame], masks),
    }
    with atomic_write(file) as temporary:
        image = cv2.cvtColor(pictures.side_by_side(panels), cv2.COLOR_RGB2BGR)
        temporary.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def _page(
    run: Run,
    results: Evaluation,
    queries: dict[str, dict[str, Any]],
    labels: list[LabelledFrame],
    metrics: dict[str, Any],
    film: str,
    seed: int,
) -> str:
    """The report as one HTML page."""
    anchored = results["anchored"][1]
    tiles = report.tiles(
        {
            "mIoU, text to Gaussians": f"{anchored['miou']:.3f}",
            "mAcc@0.25": f"{anchored['macc']:.3f}",
            "localisation accuracy": f"{anchored['loc_acc']:.3f}",
            "mIoU, true masks given": f"{metrics['true_masks']['miou']:.3f}",
            "held-out PSNR": f"{metrics['held_out_psnr']:.2f} dB",
            "of work": f"{metrics['total_seconds']:.0f} s",
        }
    )
    names = {
        "anchored": "text → region → its votes",
        "all": "text → all matching regions → their votes",
        "true_masks": "text → region → its votes, true masks given",
    }
    rows = []
    for kind, (_, figures) in results.items():
        shares = (f"{figures[key]:.3f}" for key in ("miou", "macc", "acc_50", "loc_acc"))
        rows.append((names[kind], *shares, figures["pairs"], figures["missing"]))
    table = report.table(["query", "mIoU", "mAcc@0.25", "Acc@0.5", "Loc. acc.", "pairs", "missing"], rows)
    words = f"{metrics['protocol']}. Held-out views only; a missing prediction counts as 0."
    parts = [
        tiles,
        film,
        report.section("How well", words, table),
        _iou_section(results),
        _query_section(run, results["anchored"][0], results["true_masks"][0], queries, labels),
        *running.run_parts(run),
    ]
    lead = "A made-up room as an ordinary capture: frames, poses and sparse points in, answers to texts out, "
    lead += "on a plain CPU and without any learned weights."
    return report.page(f"jsecon demo, room {seed}", lead, parts)


def _query_section(
    run: Run, rows: list[Row], true_rows: list[Row], queries: dict[str, dict[str, Any]], labels: list[LabelledFrame]
) -> str:
    """The held-out view that shows each object largest, with the selections of both fields."""
    frames = dict(zip(run.capture.names, np.asarray(run.capture.frames)))
    truth = {(frame.name, name): mask for frame in labels for name, (mask, _) in frame.objects.items()}
    true_by_pair = {(row.frame, row.query): row for row in true_rows}
    cells = []
    for text in queries:
        row = max((row for row in rows if row.query == text), key=lambda row: truth[row.frame, text].sum())
        frame, true_mask = frames[row.frame], truth[row.frame, text]
        other = true_by_pair[row.frame, text]
        words = f"IoU {row.iou:.2f}, {row.selected} Gaussians, region {row.region}, score {row.score:.2f}"
        cells.append(report.pair(frame, pictures.selection_overlay(frame, row.mask, true_mask), words, strong=text))
        words = f"true masks given, {other.selected} Gaussians"
        overlay = pictures.selection_overlay(frame, other.mask, true_mask)
        cells.append(report.figure(overlay, words, strong=f"IoU {other.iou:.2f}"))
    words = "Pink: the selected Gaussians, rendered alone, over a held-out view; move the line to see the photograph. "
    words += "White line: the ground truth."
    return report.section("Queries", words, report.grid(cells, 4))


def _iou_section(results: Evaluation) -> str:
    """Mean IoU of each text by each kind of query."""
    texts = sorted({row.query for row in results["anchored"][0]})
    table = []
    for text in texts:
        means = [float(np.mean([row.iou for row in rows if row.query == text])) for rows, _ in results.values()]
        table.append((text, means))
    table.append(("mean of all pairs", [figures["miou"] for _, figures in results.values()]))
    header = ["text", *(kind.replace("_", " ") for kind in results)]
    return report.section(
        "IoU of each text", "Mean over the held-out views that show it.", report.shades(header, table)
    )


VERBS = {verbs.Demo: _demo}
"""what does the work of each verb"""
