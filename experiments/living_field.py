"""A field that grows and forgets: is it, to the last bit, the field of one run, and are photographs placed right?

    python -m experiments.living_field --fields FIELD=CAPTURE [FIELD=CAPTURE ...]

Each field is one that `jsecon run CAPTURE --out FIELD` made, with frames held out. For each:

- A third of its views are forgotten, and added again in 1, 2 and 8 batches and in several orders. Votes, embeddings and
  poses must be those of the run. Each of eight views alone is forgotten, and votes are summed anew without it, from the
  lists of the others. The field is written, and its files are searched for what the ledger held of the view.
- The held-out photographs are placed without their poses. Errors are in degrees, and in percent of the diameter of the
  camera centres. Those of the other captures must be refused.
"""

import contextlib
import dataclasses
import tempfile
from pathlib import Path

import jax
import numpy as np

from experiments import results
from jsecon import LanguageField, Scene, load_capture, open_scene
from jsecon.errors import InputError
from jsecon.field.evidence import TOP, sum_packed
from jsecon.field.ledger import add_views, view_order
from jsecon.pipeline.new_frames import read_frames

BATCHES, ORDERS, VIEWS = (1, 2, 8), 3, 8
SUMS = "regions", "weights", "labelled", "total", "max_pixel_weight", "views"


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    fields: tuple[str, ...] = ()
    """FIELD=CAPTURE each."""
    most: int = 20
    """Most held-out photographs of each capture."""
    out: str = ""


def equal(one: LanguageField, other: LanguageField) -> bool:
    """Whether votes, regions, cameras and names are the same to the last bit."""
    parts = [[field.votes, field.regions, field.cameras] for field in (one, other)]
    pairs = zip(*map(jax.tree.leaves, parts), strict=True)
    return one.names == other.names and all(np.array_equal(a, b) for a, b in pairs)


def batches_equal(scene: Scene) -> tuple[int, int]:
    """How often views that were forgotten and added again make the field of the run, and of how many times."""
    gone = list(scene.ledger.views)[::3]
    less, rng, right = scene.forget(gone), np.random.default_rng(0), []
    for count in BATCHES:
        for _ in range(ORDERS):
            field, ledger = less.field, less.ledger
            for batch in np.array_split(rng.permutation(gone), count):
                field, ledger = add_views(field, ledger, {str(name): scene.ledger.views[name] for name in batch})
            right.append(equal(field, scene.field))
    return sum(right), len(right)


def forgotten_clean(scene: Scene) -> tuple[int, int, int]:
    """How often votes without a view are those of the others, and its bytes are in no file; of how many views."""
    names, votes, clean = list(scene.ledger.views)[:: max(len(scene.ledger.views) // VIEWS, 1)][:VIEWS], 0, 0
    count, regions = scene.field.gaussians.count, scene.field.regions.count
    for name in names:
        less, view = scene.forget([name]), scene.ledger.views[name]
        others = [scene.ledger.views[n].evidence for n in sorted({*scene.ledger.views} - {name}, key=view_order)]
        expected = sum_packed(others, count, regions).votes(TOP)
        votes += all(np.array_equal(getattr(less.field.votes, n), getattr(expected, n)) for n in SUMS)
        with tempfile.TemporaryDirectory() as folder:
            less.save(Path(folder, "field.safetensors"))
            content = b"".join(file.read_bytes() for file in Path(folder).rglob("*") if file.is_file())
        middle = len(view.picture) // 2, len(view.evidence) // 2  # heads of files are alike
        parts = view.picture[middle[0] :][:64], view.evidence[middle[1] :][:64], view.camera[:12], *view.embeddings[:1]
        traces = f'"{name}"'.encode(), *parts
        clean += not any(bytes(trace) in content for trace in traces)
    return votes, clean, len(names)


def place(scene: Scene, capture: Path, most: int, scratch: Path) -> tuple[list[tuple[float, float]], int, bool]:
    """Errors of the held-out photographs that are placed (degrees, % of the scene); how many; whether poses stayed."""
    field, loaded = scene.field, load_capture(capture, long_side=64)
    held = [loaded.names[t] for t in np.flatnonzero(loaded.held_out)][:most]
    files = {Path(file.path).stem: capture / "images" / Path(file.path).name for file in loaded.files}
    for name in held:
        (scratch / files[name].name).symlink_to(files[name].resolve())
    less = scene.forget(held)
    placed = read_frames(less.field, less.ledger, scratch, None, lambda error: None, lambda done, total: None)
    centres = np.asarray(field.cameras.centres, np.float64)
    size, errors = 2 * np.linalg.norm(centres - centres.mean(0), axis=1).max(), []
    for name, pose in zip(placed.names, placed.cameras.world_to_camera):
        t = field.names.index(name)
        found, true = (np.asarray(each, np.float64) for each in (pose, field.cameras.world_to_camera[t]))
        cosine = (np.trace(found[:3, :3] @ true[:3, :3].T) - 1) / 2
        centre = -found[:3, :3].T @ found[:3, 3]
        errors.append((np.degrees(np.arccos(np.clip(cosine, -1, 1))), 100 * np.linalg.norm(centre - centres[t]) / size))
    rows = [field.names.index(name) for name in less.field.names]
    stayed = np.array_equal(less.field.cameras.world_to_camera, np.asarray(field.cameras.world_to_camera)[rows])
    return errors, len(held), stayed


def refused(scene: Scene, captures: list[Path], most: int, scratch: Path) -> tuple[int, int]:
    """How many photographs of other captures are refused, and of how many."""
    for capture in captures:
        for file in sorted((capture / "images").iterdir())[
            :: max(len(list((capture / "images").iterdir())) // most, 1)
        ]:
            (scratch / f"{capture.name}_{file.name}").symlink_to(file.resolve())
    count, grown = len(list(scratch.iterdir())), scene
    with contextlib.suppress(InputError):  # all are refused
        grown = scene.add(scratch, refused=[])
    return count - len(grown.field.names) + len(scene.field.names), count


def main(options: Options) -> dict:
    """Measures all fields."""
    rows, metrics = [], {}
    pairs = [tuple(map(Path, text.split("="))) for text in options.fields]
    for path, capture in pairs:
        scene = open_scene(path)
        right, times = batches_equal(scene)
        votes, clean, views = forgotten_clean(scene)
        with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as two:
            errors, held, stayed = place(scene, capture, options.most, Path(one))
            others = [other for _, other in pairs if other != capture]
            away, strangers = refused(scene, others, options.most // 2, Path(two)) if others else (0, 0)
        degrees, percent = np.median(errors, axis=0) if errors else (np.nan, np.nan)
        figures = right, times, votes, clean, views, len(errors), held, float(degrees), float(percent), away, strangers
        metrics[capture.name] = dict(zip(("equal", "times", "votes", "clean", "views", "placed", "held"), figures))
        metrics[capture.name] |= {"degrees": figures[7], "percent": figures[8], "stayed": stayed}
        placed = f"{len(errors)} of {held}", f"{degrees:.3f}", f"{percent:.3f}", "yes" if stayed else "no"
        row = capture.name, f"{right} of {times}", f"{votes} of {views}", f"{clean} of {views}", *placed
        rows.append((*row, f"{away} of {strangers}"))
        print(rows[-1], flush=True)
    header = "scene", "batches equal", "forgotten equal", "no byte left", "placed", "degrees", "% of the scene"
    table = results.table((*header, "old poses unchanged", "others refused"), rows)
    results.save(Path(options.out), options, metrics, table)
    return metrics


if __name__ == "__main__":
    main(results.read_options(Options, "living_field", __doc__))
