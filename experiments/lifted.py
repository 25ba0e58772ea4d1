"""From an outline to Gaussians: what one mask, and three, find in the other views, beside the answer to the name.

    python -m experiments.lifted [ROOMS] [--seeds 0 1 2 3 4] [--crowded]

ROOMS as for `experiments.places`. The masks are the true ones of frames held out, as another tool might outline a thing
there; each is lifted from one frame, or from three, and judged in the others by two readings. "Alone" renders the
selected Gaussians with all others deleted, alpha > 0.7: a plate under a ball is then whole, and the true mask, which
lacks what the ball hides, is not. What their exact outlines get so is printed below. "In the scene"
composites the selection through all Gaussians: its pixels are those of which it makes more than half. PRIOR_PX of
`jsecon.query.outline` was chosen on plain rooms 0 and 1.
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.places import Options as Places, asked_for, fields_of, room_of
from jsecon.app.ask import ask_outline, ask_text
from jsecon.data.lerf_labels import LabelledFrame, load_lerf_labels
from jsecon.demo.raycast import trace_rays
from jsecon.demo.room import Room
from jsecon.evaluate.metrics import iou
from jsecon.pipeline.networks import field_embedder
from jsecon.query.render import selection_mask
from jsecon.splat.render import render
from jsecon.types import Camera, Gaussians, LanguageField

WAYS = ("the name", "one mask", "three masks", "a box")
READINGS = ("alone", "in the scene")
HALF = 0.5
"""of a pixel that a selection must make to have it in the scene"""


@dataclasses.dataclass(frozen=True)
class Options(Places):
    """What the experiment can vary."""

    out: str = str(results.HOME / "results" / "lifted")


def boxed(mask: np.ndarray) -> np.ndarray:
    """(H, W) what `box_mask` makes of a mask's box: 2 inside, 0 outside."""
    rows, columns = np.nonzero(mask)
    box = np.zeros(mask.shape, int)
    box[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = 2
    return box


def in_scene(gaussians: Gaussians, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """(H, W) bool: the pixels of which the selected Gaussians make more than half, what stands before them counted."""
    members = jnp.broadcast_to(jnp.asarray(mask, jnp.float32)[:, None], (len(mask), 3))
    return np.asarray(render(gaussians, camera, members).features[..., 0]) > HALF


def outline(room: Room, camera: Camera, name: str) -> np.ndarray:
    """(H, W) bool: the exact outline of the things of a name, nothing before them."""
    things = tuple(item for item in room.objects if item.name == name)
    return trace_rays(dataclasses.replace(room, objects=things, furniture=()), camera)[1] >= 0


def judged(
    field: LanguageField, room: Room, labels: list[LabelledFrame], answers: dict[str, np.ndarray]
) -> dict[tuple[str, str] | str, list[float]]:
    """IoUs by each of WAYS and READINGS, those of the exact outlines, and the seconds of each lift; `answers` (N,) to
    the names."""
    gaussians, cameras = jax.tree.map(jnp.asarray, field.gaussians), jax.tree.map(np.asarray, field.cameras)
    found = nothing()

    def judge(way: str, mask: np.ndarray, name: str, frames: list[LabelledFrame]) -> None:
        for frame in frames:
            camera, true = cameras[field.names.index(frame.name)], frame.objects[name][0]
            alone = np.asarray(selection_mask(gaussians, camera, jnp.asarray(mask)))
            found[way, "alone"].append(float(iou(alone, true)))
            found[way, "in the scene"].append(float(iou(in_scene(gaussians, camera, mask), true)))

    for name, answer in answers.items():
        frames = [frame for frame in labels if name in frame.objects]
        for frame in frames:
            own = outline(room, cameras[field.names.index(frame.name)], name)
            found["themselves"].append(float(iou(own, frame.objects[name][0])))
        judge("the name", answer, name, frames)
        for k in range(len(frames) if len(frames) > 3 else 0):
            turned = frames[k:] + frames[:k]
            for way, count in (("one mask", 1), ("three masks", 3), ("a box", 1)):
                outlines = {frame.name: frame.objects[name][0] for frame in turned[:count]}
                outlines = {frame: boxed(m) for frame, m in outlines.items()} if way == "a box" else outlines
                began = time.perf_counter()
                mask = ask_outline(field, name, outlines).mask
                found["seconds"].append(time.perf_counter() - began)
                judge(way, mask, name, turned[count:])
    return found


def nothing() -> dict[tuple[str, str] | str, list[float]]:
    """What `judged` fills."""
    return {(way, reading): [] for reading in READINGS for way in WAYS} | {"themselves": [], "seconds": []}


def main(options: Places) -> str:
    """The table, written."""
    rows, every = [], nothing()
    columns = [(way, reading) for reading in READINGS for way in WAYS]
    for seed, folder, field in fields_of(options):
        labels = load_lerf_labels(folder / "capture" / "label")
        embedder = field_embedder(field)
        names = sorted({name for frame in labels for name in frame.objects})
        answers = {name: ask_text(field, embedder, name).mask for name in names}
        found = judged(field, room_of(seed, options), labels, answers)
        rows.append((str(seed), *(float(np.mean(found[column])) for column in columns)))
        every = {key: values + found[key] for key, values in every.items()}
        print(rows[-1], flush=True)
    rows.append(("all", *(float(np.mean(every[column])) for column in columns)))
    text = results.table(("room", *(f"{way}, {reading}" for way, reading in columns)), rows)
    text += "\n\nmIoU in the other labelled views: alone at alpha > 0.7, in the scene over half of a pixel. "
    text += f"The things' exact outlines, alone: {np.mean(every['themselves']):.3f}. "
    text += f"A lift takes {np.median(every['seconds']):.2f} s."
    metrics: dict = {reading: {way: float(np.mean(every[way, reading])) for way in WAYS} for reading in READINGS}
    results.save(Path(options.out), options, metrics | {"themselves": float(np.mean(every["themselves"]))}, text)
    print(text)
    return text


if __name__ == "__main__":
    main(asked_for(Options))
