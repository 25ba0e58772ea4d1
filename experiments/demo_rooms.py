"""What the default vision answers in the rooms of `jsecon demo`, and what exact outlines would.

    python -m experiments.demo_rooms [--seeds 0 1 2 3 4] [--rooms FOLDER] [--quick]

For each seed, FOLDER/SEED has the room's capture and field, and true_masks/ the field of its true masks, which shares
the cache. mIoU is of the rendered selections in the held-out views. One-step compares codes of 16 numbers with the
text's own. Of the first room it also writes the film and the panels of docs/results/demo.md.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.rooms import crowded_room, write_room
from experiments.rooms.film import write_film
from experiments.rooms.panels import answers_overlay, side_by_side
from experiments.tables.codes import encode, region_codes
from jsecon import Scene
from jsecon.app import evaluation, pictures
from jsecon.app.catalogue import main_regions, palette
from jsecon.evaluate.lerf import Row, evaluate_labels
from jsecon.files import atomic_write
from jsecon.paper.distill import distill_votes
from jsecon.paper.queries import query_one_step
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.progress import Console
from jsecon.read.masks.labels import load_lerf_labels
from jsecon.types import Selection

HOLDOUT = 5
LATENT = 16
"""Numbers of a code of the one-step query."""
ONE_STEP_THRESHOLD = 0.8
QUICK_ROOM = {"views": 8, "width": 96, "height": 72}


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    quick: bool = False
    """Measure one tiny room."""
    rooms: str = str(results.HOME.parent / "demos")
    """Folder that keeps the rooms and their fields."""
    out: str = ""


def fields_of_room(folder: Path, seed: int, quick: bool) -> tuple[pipeline.Run, pipeline.Run]:
    """Writes the room and runs it as `jsecon demo` does, and with its true masks; what is there already is read."""
    capture = folder / "capture"
    if not (capture / "scene.json").is_file():
        write_room(capture, crowded_room(seed), holdout=HOLDOUT, **(QUICK_ROOM if quick else {}))
    options = RunOptions(capture, holdout=HOLDOUT, steps=60 if quick else 550, seed=seed)
    run = pipeline.run(options, folder, console=Console())
    masked = dataclasses.replace(options, masks=capture / "masks")
    cache = folder / "true_masks" / "cache"
    cache.parent.mkdir(exist_ok=True)
    if not cache.exists():
        cache.symlink_to(folder.resolve() / "cache")  # the Gaussians are the same
    return run, pipeline.run(masked, cache.parent, console=Console())


def one_step(run: pipeline.Run, embedder) -> Callable[[str], Selection]:
    """Returns what selects the Gaussians whose code is similar to a text's."""
    table, coder, _ = region_codes(jnp.asarray(run.field.regions.embeddings), latent=LATENT, key=jax.random.key(0))
    codes = distill_votes(run.field.votes, table)

    def select(text: str) -> Selection:
        return query_one_step(codes, encode(coder, jnp.asarray(embedder.embed_text([text])[0])), ONE_STEP_THRESHOLD)

    return select


def measure(folder: Path, seed: int, options: Options) -> tuple[dict[str, float], pipeline.Run, list[Row]]:
    """Figures of a room, its run, and the rows of the anchored query."""
    run, masked = fields_of_room(folder, seed, options.quick)
    labels, scene = load_lerf_labels(folder / "capture" / "label"), Scene(run.field)
    cameras = {name: run.field.cameras[t] for t, name in enumerate(run.field.names)}
    rows, summary = evaluation.evaluate(scene, labels, Console())
    _, exact = evaluation.evaluate(Scene(masked.field), labels, Console())
    select = one_step(run, scene.embedder)
    direct = evaluate_labels(run.field.gaussians, cameras, labels, select)[1]
    kinds = {"mIoU": summary, "exact outlines": exact, "one-step": direct}
    figures = {name: float(kind["miou"]) for name, kind in kinds.items()}
    return figures | {"PSNR, dB": float(np.mean(run.held_out.psnr))}, run, rows


def draw(run: pipeline.Run, rows: list[Row], out: Path) -> None:
    """Writes the film, and a held-out frame beside masks, regions and answers."""
    scene = Scene(run.field)
    answers = [scene.ask(text) for text in sorted({row.query for row in rows})]
    out.mkdir(parents=True, exist_ok=True)
    write_film(run.field, [answer for answer in answers if answer.mask.any()], out / "demo.webp")
    pictured = max({row.frame for row in rows}, key=lambda name: (sum(row.frame == name for row in rows), name))
    frame, train = run.capture.names.index(pictured), np.flatnonzero(~np.asarray(run.capture.held_out))
    nearest = int(np.abs(train - frame).argmin())
    frames, t = np.asarray(run.capture.frames), int(train[nearest])
    masks = {row.query: row.mask for row in rows if row.frame == pictured}
    colours = np.concatenate([palette(run.field.regions.count) / 255, np.full((1, 3), 0.25)])[main_regions(run.field)]
    panels = {
        "frame": frames[frame],
        "masks of one object each": pictures.label_overlay(frames[t], run.labels[nearest]),
        "regions of the Gaussians": pictures.render_picture(run.field.gaussians, run.field.cameras[t], colours),
        "answers to texts": answers_overlay(frames[frame], masks),
    }
    with atomic_write(out / "demo.jpg") as temporary:
        image = cv2.cvtColor(side_by_side(panels), cv2.COLOR_RGB2BGR)
        temporary.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    metrics: dict[str, dict] = {}
    for place, seed in enumerate(options.seeds):
        folder = Path(options.rooms) / f"{'quick-' if options.quick else ''}{seed}"
        metrics[f"seed {seed}"], run, rows = measure(folder, seed, options)
        print(seed, metrics[f"seed {seed}"], flush=True)
        if place == 0:
            draw(run, rows, Path(options.out))
    names = list(next(iter(metrics.values())))
    lines = [(seed, *(row[name] for name in names)) for seed, row in metrics.items()]
    metrics["mean"] = {name: float(np.mean([row[name] for row in metrics.values()])) for name in names}
    text = results.table(("room", *names), [*lines, ("mean", *metrics["mean"].values())])
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "demo", __doc__, {"seeds": (0,)}))
