"""`jsecon demo`: a made-up room, put on disk as an ordinary capture, then run, queried and measured like a real one.

Two fields are built: one with the default vision, one with the room's true masks given from disk. They share the
cache, and so the frames and the fitted Gaussians. Both are measured on held-out views that nothing was fitted to.
"""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jsecon.app import answers, networks, pictures, pipeline, question, report, summary
from jsecon.app.options import Options, require_writable
from jsecon.app.pipeline import Run
from jsecon.app.progress import Listener
from jsecon.data.lerf_labels import LabelledFrame, load_lerf_labels
from jsecon.data.synthetic import write_room
from jsecon.errors import InputError
from jsecon.evaluate.lerf import Row
from jsecon.files import write_text, written_whole
from jsecon.types import LanguageField

HOLDOUT = 5


def demo(
    out: Path, *, seed: int = 0, steps: int, listener: Listener, room: dict[str, int] | None = None
) -> dict[str, Any]:
    """Writes OUT/{capture, field.npz, true_masks/field.npz, queries, metrics.json, report.html, demo.jpg}; returns the
    metrics.

    `room` holds options of `write_room` (views, width, height, ...), for rooms smaller than the default.
    """
    require_writable(out)
    capture = _capture(out / "capture", seed, {"holdout": HOLDOUT} | (room or {}), listener)
    options = Options(capture, holdout=HOLDOUT, steps=steps, downscale=1.0, seed=seed)
    found = pipeline.run(options, out, listener=listener)
    true_masks = Options(capture, masks=capture / "masks", holdout=HOLDOUT, steps=steps, downscale=1.0, seed=seed)
    given = pipeline.run(true_masks, out / "true_masks", listener=listener, cache_folder=out / "cache")

    labels = load_lerf_labels(capture / "label")
    embedder = networks.embedder_of_field(found.field)
    listener.say("measured on the held-out views")
    results = summary.evaluate(found.field, embedder, labels, listener, ("anchored", "anchored_code", "one_step"))
    with_true = summary.evaluate(given.field, embedder, labels, listener, ("anchored", "one_step"))
    results["true_masks"], results["true_masks_one_step"] = with_true["anchored"], with_true["one_step"]
    metrics = _metrics(results, found, given)
    with listener.progress("report"):
        queries = _queries(found.field, embedder, labels, out / "queries")
        write_text(out / "report.html", _page(found, results, queries, labels, metrics, seed))
        _write_picture(out / "demo.jpg", found, results["anchored"][0])
    single = sum(told["left_out"].get("DBSCAN") == "the selection is one component" for told in queries.values())
    metrics["left_out"]["DBSCAN"] = f"{single} of {len(queries)} selections are one component"
    metrics["peak_memory_mib"] = round(pipeline.peak_memory_mib(), 1)
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    summary.say_table(results, listener)
    listener.say(
        f"held-out PSNR {metrics['held_out_psnr']:.2f} dB, {metrics['seconds_in_all']:.0f} s of work, "
        f"peak memory {metrics['peak_memory_mib']:.0f} MiB"
    )
    listener.say(f"field   {out / 'field.npz'}\nanswers {out / 'queries'}\nreport  {out / 'report.html'}")
    return metrics


def _capture(folder: Path, seed: int, room: dict[str, int], listener: Listener) -> Path:
    """The room on disk; written again only where it is another room or was not written to its end."""
    marker, wanted = folder / "demo.json", json.dumps({"seed": seed} | room, sort_keys=True)
    if not (marker.exists() and marker.read_text() == wanted):
        marker.unlink(missing_ok=True)
        with listener.progress("room") as progress:
            write_room(folder, seed, progress=progress, **room)
        write_text(marker, wanted)
    listener.say(f"the room of seed {seed}: {folder}")
    return folder


def _metrics(results: dict[str, tuple[list[Row], dict[str, Any]]], found: Run, given: Run) -> dict[str, Any]:
    keep = ("miou", "macc", "acc_50", "loc_acc", "pairs", "missing")
    metrics: dict[str, Any] = {kind: {name: told[name] for name in keep} for kind, (_, told) in results.items()}
    own = {name: value for name, value in given.seconds.items() if name not in ("load", "gaussians", "held_out")}
    seconds = found.seconds | {f"{name} (true masks)": value for name, value in own.items()}
    return metrics | {
        "protocol": results["anchored"][1]["protocol"],
        "held_out_psnr": round(float(np.mean(found.psnr)), 3),
        "regions": found.field.regions.count,
        "gaussians": found.field.gaussians.count,
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
        "seconds_in_all": round(sum(seconds.values()), 1),
        "left_out": {f"{name} (true masks)": why for name, why in given.left_out.items()} | found.left_out,
        "peak_memory_mib": 0.0,
    }


def _queries(field: LanguageField, embedder: Any, labels: list[LabelledFrame], out: Path) -> dict[str, dict[str, Any]]:
    """Each labelled object asked for by its name: its files, and its figures by name."""
    told = {}
    for text in sorted({name for frame in labels for name in frame.objects}):
        try:
            answer = question.ask_text(field, embedder, text)
            told[text] = answers.write_answer(field, answer, out, answers.masks_of(field, answer, views=2))
        except InputError as error:
            told[text] = {"count": 0, "score": 0.0, "region": None, "left_out": {}, "not_understood": str(error)}
    return told


def _page(
    found: Run,
    results: dict[str, tuple[list[Row], dict[str, Any]]],
    queries: dict[str, dict[str, Any]],
    labels: list[LabelledFrame],
    metrics: dict[str, Any],
    seed: int,
) -> str:
    anchored = results["anchored"][1]
    head = report.tiles(
        {
            "mIoU, text to Gaussians": f"{anchored['miou']:.3f}",
            "mAcc@0.25": f"{anchored['macc']:.3f}",
            "localisation accuracy": f"{anchored['loc_acc']:.3f}",
            "mIoU, true masks given": f"{metrics['true_masks']['miou']:.3f}",
            "mIoU, one-step query": f"{metrics['one_step']['miou']:.3f}",
            "held-out PSNR": f"{metrics['held_out_psnr']:.2f} dB",
            "of work": f"{metrics['seconds_in_all']:.0f} s",
        }
    )
    names = {
        "anchored": "text -> region -> its votes",
        "anchored_code": "text -> region -> its code",
        "one_step": "text -> codes, directly",
        "true_masks": "text -> region -> its votes, true masks given",
        "true_masks_one_step": "text -> codes, directly, true masks given",
    }
    rows = []
    for kind, (_, told) in results.items():
        shares = (f"{told[name]:.3f}" for name in ("miou", "macc", "acc_50", "loc_acc"))
        rows.append((names[kind], *shares, told["pairs"], told["missing"]))
    table = report.table(["query", "mIoU", "mAcc@0.25", "Acc@0.5", "Loc. acc.", "pairs", "missing"], rows)
    words = f"{metrics['protocol']}. Held-out views only; a missing prediction counts as 0."
    asked = _query_part(found, results["anchored"][0], results["true_masks"][0], queries, labels)
    parts = [head, report.section("How well", words, table), asked]
    lead = "A made-up room as an ordinary capture: frames, poses and sparse points in, answers to texts out, "
    lead += "on a plain CPU and without any learned weights."
    parts += [*summary.scene_parts(found), *summary.work_parts(found)]
    return report.page(f"jsecon demo, room {seed}", lead, parts)


def _write_picture(path: Path, found: Run, rows: list[Row]) -> None:
    """The demo at a glance: a frame, its masklets and codes, and what a text selects in the held-out view
    beside it."""
    row = max(rows, key=lambda row: row.iou * row.mask.sum())
    held = found.capture.names.index(row.frame)
    train = np.flatnonzero(~np.asarray(found.capture.held_out))
    near = int(np.abs(train - held).argmin())
    frames, t = np.asarray(found.capture.frames), int(train[near])
    codes = pictures.Renderer(found.field.gaussians, found.field.cameras)
    image = pictures.strip(
        {
            "frame": frames[t],
            "masklets": pictures.label_overlay(frames[t], found.labels[near]),
            "codes of the Gaussians": codes.colours(t, pictures.code_colours(found.field)),
            f'"{row.query}"': pictures.selection_overlay(frames[held], row.mask),
        }
    )
    with written_whole(path) as temporary:
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        temporary.write_bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def _query_part(
    found: Run, rows: list[Row], true_rows: list[Row], queries: dict[str, dict[str, Any]], labels: list[LabelledFrame]
) -> str:
    """For each query, the held-out view that shows it largest: the frame, the selection, the same with true masks."""
    frames = dict(zip(found.capture.names, np.asarray(found.capture.frames)))
    truth = {(frame.name, name): mask for frame in labels for name, (mask, _) in frame.objects.items()}
    given_rows = {(row.frame, row.query): row for row in true_rows}
    cells = []
    for text in queries:
        row = max((row for row in rows if row.query == text), key=lambda row: truth[row.frame, text].sum())
        frame, true = frames[row.frame], truth[row.frame, text]
        other = given_rows[row.frame, text]
        cells.append(report.figure(frame, row.frame, strong=text))
        words = f"{row.selected} Gaussians, region {row.region}, score {row.score:.2f}"
        for answer, caption in ((row, words), (other, f"true masks given: {other.selected} Gaussians")):
            overlay = pictures.selection_overlay(frame, answer.mask, true)
            cells.append(report.figure(overlay, caption, strong=f"IoU {answer.iou:.2f}"))
    words = "Pink: the selected Gaussians, rendered alone, over a held-out view. White line: the ground truth."
    return report.section("Queries", words, report.grid(cells, 3))
