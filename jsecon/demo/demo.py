"""`jsecon demo`: a made-up room, put on disk as an ordinary capture, then run, queried and measured like a real one.

Two fields are built: one with the default vision, one with the room's true masks given from disk. They share the
cache, and so the frames and the fitted Gaussians. Both are measured on held-out views that nothing was fitted to.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jsecon.app import ask, evaluation, pictures, report, run_report
from jsecon.app.outputs import answer_masks, write_answer
from jsecon.data.lerf_labels import LabelledFrame, load_lerf_labels
from jsecon.demo import write_room
from jsecon.demo.film import write_film
from jsecon.evaluate.lerf import Row
from jsecon.files import atomic_write, write_text
from jsecon.pipeline import networks, pipeline
from jsecon.pipeline.options import Options, require_writable
from jsecon.pipeline.pipeline import Run
from jsecon.pipeline.progress import Listener
from jsecon.process import peak_memory_mib
from jsecon.types import LanguageField

HOLDOUT = 5
PLAIN: dict[str, int] = {"crowded": False}
"""`room` of experiments that want one thing of each colour, on a bare table"""


def demo(
    out: Path, *, seed: int = 0, steps: int, listener: Listener, room: dict[str, int] | None = None
) -> dict[str, Any]:
    """Writes OUT/{capture, field.safetensors, true_masks/field.safetensors, queries, metrics.json, report.html,
    demo.jpg, demo.webp}; returns the metrics.

    `room` holds options of `write_room` (views, width, height, crowded, ...), for other rooms than the default.
    """
    require_writable(out)
    capture = _capture(out / "capture", seed, {"holdout": HOLDOUT, "crowded": True} | (room or {}), listener)
    options = Options(capture, holdout=HOLDOUT, steps=steps, downscale=1.0, seed=seed)
    found = pipeline.run(options, out, listener=listener)
    true_masks = Options(capture, masks=capture / "masks", holdout=HOLDOUT, steps=steps, downscale=1.0, seed=seed)
    given = pipeline.run(true_masks, out / "true_masks", listener=listener, cache_folder=out / "cache")

    labels = load_lerf_labels(capture / "label")
    embedder = networks.field_embedder(found.field)
    listener.say("measured on the held-out views")
    results = evaluation.evaluate(found.field, embedder, labels, listener)
    with_true = evaluation.evaluate(given.field, embedder, labels, listener, ("anchored", "one_step"))
    results["true_masks"], results["true_masks_one_step"] = with_true["anchored"], with_true["one_step"]
    metrics = _metrics(results, found, given)
    with listener.progress("report"):
        answers = answers_to(found.field, embedder, sorted({name for frame in labels for name in frame.objects}))
        queries = write_queries(found.field, answers, out / "queries")
        most = max(labels, key=lambda frame: (len(frame.objects), frame.name)).name
        masks = {row.query: row.mask for row in results["anchored"][0] if row.frame == most}
        pictured = write_pictures(out, found, answers, found.capture.names.index(most), masks)
        write_text(out / "report.html", _page(found, results, queries, labels, metrics, pictured, seed))
    single = sum(told["left_out"].get("DBSCAN") == "the selection is one component" for told in queries.values())
    metrics["left_out"]["DBSCAN"] = f"{single} of {len(queries)} selections are one component"
    metrics["peak_memory_mib"] = round(peak_memory_mib(), 1)
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    evaluation.print_table(results, listener)
    listener.say(
        f"held-out PSNR {metrics['held_out_psnr']:.2f} dB, {metrics['seconds_in_all']:.0f} s of work, "
        f"peak memory {metrics['peak_memory_mib']:.0f} MiB"
    )
    say_files(out, next(iter(answers), ""), listener)
    return metrics


def say_files(out: Path, text: str, listener: Listener) -> None:
    """Where it all is, and how to look at it."""
    field = out / "field.safetensors"
    listener.say(f"field   {field}\nanswers {out / 'queries'}\nreport  {out / 'report.html'}")
    asked = f' "{text}"' if text else ""
    listener.say(f"view it jsecon view {field}{asked}  (extra viewer; or --export {out / 'view.html'})")


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
        "left_out": {f"{name} (true masks)": why for name, why in given.skipped.items()} | found.skipped,
        "peak_memory_mib": 0.0,
    }


def answers_to(field: LanguageField, embedder: Any, texts: Sequence[str]) -> dict[str, ask.Answer]:
    """text → its answer, of those that are understood."""
    questions = ask.queries_of(field, embedder, texts=texts)
    return {answer.question: answer for answer in ask.answer_each(questions)[0]}


def write_queries(field: LanguageField, answers: Mapping[str, ask.Answer], out: Path) -> dict[str, dict[str, Any]]:
    """The files of each answer, and its figures, by text."""
    return {text: write_answer(field, own, out, answer_masks(field, own, views=2)) for text, own in answers.items()}


def _page(
    found: Run,
    results: dict[str, tuple[list[Row], dict[str, Any]]],
    queries: dict[str, dict[str, Any]],
    labels: list[LabelledFrame],
    metrics: dict[str, Any],
    pictured: str,
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
        "anchored": "text → region → its votes",
        "anchored_code": "text → region → its code",
        "silhouette": "text → region → its votes, then by the outline",
        "all": "text → all regions that answer → their votes",
        "one_step": "text → codes, directly",
        "canonical": "text → codes, against the canonical phrases",
        "true_masks": "text → region → its votes, true masks given",
        "true_masks_one_step": "text → codes, directly, true masks given",
    }
    rows = []
    for kind, (_, told) in results.items():
        shares = (f"{told[name]:.3f}" for name in ("miou", "macc", "acc_50", "loc_acc"))
        rows.append((names[kind], *shares, told["pairs"], told["missing"]))
    table = report.table(["query", "mIoU", "mAcc@0.25", "Acc@0.5", "Loc. acc.", "pairs", "missing"], rows)
    words = f"{metrics['protocol']}. Held-out views only; a missing prediction counts as 0."
    asked = _query_part(found, results["anchored"][0], results["true_masks"][0], queries, labels)
    parts = [head, pictured, report.section("How well", words, table), _iou_part(results), asked]
    lead = "A made-up room as an ordinary capture: frames, poses and sparse points in, answers to texts out, "
    lead += "on a plain CPU and without any learned weights."
    parts += [*run_report.scene_parts(found), *run_report.work_parts(found)]
    return report.page(f"jsecon demo, room {seed}", lead, parts)


def write_pictures(
    out: Path, run: Run, answers: Mapping[str, ask.Answer], frame: int, masks: Mapping[str, np.ndarray]
) -> str:
    """OUT/demo.jpg, a frame, the masklets and codes of the nearest that was fitted to, and the `masks` that texts have
    in it; and OUT/demo.webp, the film. Returns its part of the page."""
    train = np.flatnonzero(~np.asarray(run.capture.held_out))
    near = int(np.abs(train - frame).argmin())
    frames, t = np.asarray(run.capture.frames), int(train[near])
    codes = pictures.Renderer(run.field.gaussians, run.field.cameras)
    panels = {
        "frame": frames[frame],
        "masklets": pictures.label_overlay(frames[t], run.labels[near]),
        "codes of the Gaussians": codes.colours(t, pictures.code_colours(run.field)),
        "answers to texts": pictures.answers_overlay(frames[frame], masks),
    }
    with atomic_write(out / "demo.jpg") as temporary:
        image = cv2.cvtColor(pictures.strip(panels), cv2.COLOR_RGB2BGR)
        temporary.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    write_film(run.field, [answer for answer in answers.values() if answer.mask.any()], out / "demo.webp")
    words = "Rendered from the field: each text lights up what it selects."
    return report.film((out / "demo.webp").read_bytes(), words)


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
        words = f"IoU {row.iou:.2f}, {row.selected} Gaussians, region {row.region}, score {row.score:.2f}"
        cells.append(report.pair(frame, pictures.selection_overlay(frame, row.mask, true), words, strong=text))
        words = f"true masks given, {other.selected} Gaussians"
        overlay = pictures.selection_overlay(frame, other.mask, true)
        cells.append(report.figure(overlay, words, strong=f"IoU {other.iou:.2f}"))
    words = "Pink: the selected Gaussians, rendered alone, over a held-out view; move the line to see the photograph. "
    words += "White line: the ground truth."
    return report.section("Queries", words, report.grid(cells, 4))


def _iou_part(results: dict[str, tuple[list[Row], dict[str, Any]]]) -> str:
    """Mean IoU of each text by each kind of query."""
    texts = sorted({row.query for row in results["anchored"][0]})
    mean = lambda rows, text: float(np.mean([row.iou for row in rows if row.query == text]))
    rows = [(text, [mean(own, text) for own, _ in results.values()]) for text in texts]
    rows.append(("mean of all pairs", [told["miou"] for _, told in results.values()]))
    header = ["text", *(kind.replace("_", " ") for kind in results)]
    return report.section("IoU of each text", "Mean over the held-out views that show it.", report.shades(header, rows))
