"""From an outline to Gaussians: what one mask, and three, find in the other views, beside the answer to the name.

    python -m experiments.lifted [ROOMS] [--seeds 0 1 2 3 4] [--crowded]

ROOMS as for `experiments.places`. The masks are the true ones of frames held out, as another tool might outline a thing
there; each is lifted from one frame, or from three, and judged in the others (alpha > 0.7). PRIOR_PX of
`jsecon.query.lift` was chosen on rooms 0 and 1.
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.places import Options as Places, asked_for, fields_of
from jsecon.app.question import ask_outline, ask_text
from jsecon.data.lerf_labels import LabelledFrame, load_lerf_labels
from jsecon.evaluate.metrics import iou
from jsecon.pipeline.networks import embedder_of_field
from jsecon.query.masks import selection_mask
from jsecon.types import LanguageField

WAYS = ("the name", "one mask", "three masks", "a box")


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


def judged(field: LanguageField, labels: list[LabelledFrame], answers: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """IoUs by each of WAYS, and the seconds of each lift; `answers` (N,) to the names."""
    gaussians, cameras = jax.tree.map(jnp.asarray, field.gaussians), jax.tree.map(np.asarray, field.cameras)
    found: dict[str, list[float]] = {way: [] for way in (*WAYS, "seconds")}

    def judge(way: str, mask: np.ndarray, name: str, frames: list[LabelledFrame]) -> None:
        for frame in frames:
            camera = cameras[field.names.index(frame.name)]
            shown = np.asarray(selection_mask(gaussians, camera, jnp.asarray(mask)))
            found[way].append(float(iou(shown, frame.objects[name][0])))

    for name, answer in answers.items():
        frames = [frame for frame in labels if name in frame.objects]
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


def main(options: Places) -> str:
    """The table, written."""
    rows, every = [], {way: [] for way in (*WAYS, "seconds")}
    for seed, folder, field in fields_of(options):
        labels = load_lerf_labels(folder / "capture" / "label")
        embedder = embedder_of_field(field)
        names = sorted({name for frame in labels for name in frame.objects})
        found = judged(field, labels, {name: ask_text(field, embedder, name).mask for name in names})
        rows.append((str(seed), *(float(np.mean(found[way])) for way in WAYS)))
        every = {way: values + found[way] for way, values in every.items()}
        print(rows[-1], flush=True)
    rows.append(("all", *(float(np.mean(every[way])) for way in WAYS)))
    text = results.table(("room", *WAYS), rows)
    text += f"\n\nmIoU at alpha > 0.7 in the other labelled views. A lift takes {np.median(every['seconds']):.2f} s."
    results.save(Path(options.out), options, dict(zip(WAYS, rows[-1][1:])), text)
    print(text)
    return text


if __name__ == "__main__":
    main(asked_for(Options))
