"""A catalogue and relation queries of a field of 200 objects, in a process that has just opened it.

    python benchmarks/objects.py [--objects 200] [--gaussians 100000]

A made field: boxes and balls in the colours of the palette, each a region; every seventh is two regions that overlap,
as masks of two views make them. A first process leaves the programs on disk; each table is of a later process. Services
prepare a field before the first question. CPU seconds are of all threads: those that count on a shared machine.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jsecon.process import prepare_process

QUESTIONS = (
    "the red mug left of the dark blue box",
    "the largest yellow ball",
    "the brown box nearest to the turquoise ball",
    "the pink cup between the red mug and the dark green bottle",
)
"""asked in turn, each in its own words"""


def made_field(objects: int, gaussians: int, seed: int = 0) -> Any:
    """A field of objects on a grid, z up, seen from one side."""
    import numpy as np

    from experiments.rooms.capture import look_at
    from jsecon.types import Camera, Gaussians, LanguageField, Regions, Votes
    from jsecon.vision.colours import VOCABULARY, ColourEmbedder

    draw = np.random.default_rng(seed)
    embedder = ColourEmbedder()
    owner = np.sort(np.arange(gaussians) % objects)
    side = int(np.ceil(np.sqrt(objects)))
    half = draw.uniform(0.08, 0.3, (objects, 3))
    places = np.divmod(np.arange(objects), side)
    middle = np.stack([places[0] - side / 2, places[1] - side / 2, half[:, 2]], axis=1)
    points = draw.uniform(-1, 1, (gaussians, 3))
    round_ones = owner % 2 == 0
    points[round_ones] /= np.linalg.norm(points[round_ones], axis=1, keepdims=True)
    means = (middle[owner] + half[owner] * points).astype(np.float32)
    scales = np.log(draw.uniform(0.01, 0.02, (gaussians, 3))).astype(np.float32)
    turns = draw.normal(size=(gaussians, 4)).astype(np.float32)
    flat = np.ones(gaussians, np.float32)
    scene = Gaussians(means, scales, turns, 3 * flat, np.zeros((gaussians, 1, 3), np.float32))

    twins = np.arange(0, objects, 7)
    count = objects + len(twins)
    twin_of = np.full(objects, -1, np.int32)
    twin_of[twins] = objects + np.arange(len(twins))
    regions = np.stack([owner.astype(np.int32), twin_of[owner], (owner + 1).astype(np.int32) % objects], axis=1)
    weights = np.float32([6, 5, 0.5]) * draw.uniform(0.8, 1, (gaussians, 3)).astype(np.float32)
    weights[regions < 0] = 0
    total = weights.sum(1)
    overlap = np.eye(count, dtype=np.float32)
    overlap[twins, twin_of[twins]] = overlap[twin_of[twins], twins] = 0.6
    shown = np.repeat(np.maximum(total, 10.0)[:, None], 3, axis=1).astype(np.float32)
    views, nothing = np.full(gaussians, 24, np.int32), np.zeros((), np.int32)
    votes = Votes(
        regions,
        weights,
        total,
        total * 1.1,
        flat,
        views,
        nothing,
        count,
        weight_where_region_visible=shown,
        overlap=overlap,
    )
    names = [VOCABULARY[k % len(VOCABULARY)] for k in [*range(objects), *twins]]
    embeddings = np.asarray(embedder.embed_text(names), np.float32) + draw.normal(0, 0.01, (count, embedder.dim))
    embeddings = (embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)).astype(np.float32)
    eyes = [np.array([x, -1.2 * side, 0.6 * side]) for x in np.linspace(-side / 4, side / 4, 24)]
    poses = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    lens = np.full(len(eyes), 300, np.float32)
    return LanguageField(
        gaussians=scene,
        votes=votes,
        regions=Regions(embeddings, np.full((count, len(eyes)), 900, np.int32)),
        cameras=Camera(poses, lens, lens, lens, lens * 0.75, 600, 450),
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.eye(4),
        names=tuple(f"frame_{t:05d}" for t in range(len(eyes))),
        embedder=embedder.name,
        unrelated_words=np.asarray(embedder.unrelated_words, np.float16),
    )


def measure(file: Path, order: str) -> None:
    """Opens the field and asks in this process; prints seconds and CPU seconds of each step as JSON."""
    prepare_process()
    import jsecon
    from jsecon.pipeline.model_loading import field_embedder

    rows: dict[str, tuple[float, float]] = {}

    def timed(name: str, call: Callable[[], Any]) -> Any:
        begin = time.perf_counter(), time.process_time()
        value = call()
        rows[name] = time.perf_counter() - begin[0], time.process_time() - begin[1]
        return value

    field = timed("import and load the field", lambda: jsecon.load_field(file))
    scene = timed("open it for questions", lambda: jsecon.Scene(field, field_embedder(field)))
    if order == "prepared":
        timed("prepare it", scene.prepare)
    if order == "catalogue":
        timed("catalogue", lambda: jsecon.objects(field))
    else:
        for number, text in enumerate(QUESTIONS):
            timed(f"relation query {number + 1}", lambda text=text: scene.relate(text))
    print(json.dumps(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=200)
    parser.add_argument("--gaussians", type=int, default=100_000)
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        return measure(Path(arguments.measure[0]), arguments.measure[1])
    with tempfile.TemporaryDirectory(prefix="jsecon-objects-") as folder:
        from jsecon.field.field import save_field

        file = Path(folder) / "field.safetensors"
        save_field(file, made_field(arguments.objects, arguments.gaussians))
        environ = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
        environ["XDG_CACHE_HOME"] = str(Path(folder) / "home")

        def rows_of(order: str) -> dict:
            command = [sys.executable, __file__, "--measure", str(file), order]
            text = subprocess.run(command, env=environ, check=True, stdout=subprocess.PIPE, text=True).stdout
            return json.loads(text.splitlines()[-1])

        rows_of("catalogue")
        rows_of("prepared")
        for order in ("catalogue", "prepared", "at once"):
            print(f"\n{order}\n\n| step | ms | CPU ms |\n|---|---|---|")
            for name, (seconds, cpu) in rows_of(order).items():
                print(f"| {name} | {1e3 * seconds:.0f} | {1e3 * cpu:.0f} |")


if __name__ == "__main__":
    main()
