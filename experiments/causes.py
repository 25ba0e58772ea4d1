"""Where a selection's IoU is lost: a wrong region for the text, a broken region, or the wrong Gaussians for the region?

    python -m experiments.causes [--quick]

One twin of LERF-OVS as Table 1 uses it. Masks are associated over the frames by the tracker's ids, or by consensus. For
each: how many texts find a region of the right object, by the cosine and by the contrast; how much of the
object its best region holds over all frames (recall) and how much of that is the object's (purity); and mIoU of the
text's region, and of the best region given, by each kind of membership: the share of the votes of all views; of the
views that show the region; the lead. Above all stands what the Gaussians themselves allow: true masks, membership by
votes. VALA, which needs no region, is beside; and what a stricter threshold does, as the two readings of alpha, 0.7 and
10/255, want opposite things of the rim of a selection.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from experiments import lerf, results
from experiments.tables.answers import Answers, Steps
from experiments.tables.association import overlaps
from experiments.tables.fill import measure
from experiments.tables.memberships import by_lead, of_all_views
from experiments.tables.methods import METHODS
from experiments.tables.ours import ask_field, association, field_of
from experiments.tables.setting import Setting, prepare
from experiments.tables.twins import Data
from jsecon.query.anchored import query_anchored, query_region
from jsecon.query.outliers import remove_outliers
from jsecon.types import Selection

ASSOCIATIONS = ("tracks", "consensus")
RETRIEVALS = ("cosine", "contrast")
MEMBERSHIPS = ("all_views", "votes", "lead")
SHARES = (0.7, 0.8, 0.9)
"""of a Gaussian's weight that must lie inside, where the default is 0.5: what strictness wins and loses"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    data: Data = lerf.PLAN.data
    scene: str = "figurines"
    seed: int = 1
    level: str = "medium"
    fit_steps: int = lerf.PLAN.fit_steps
    out: str = str(results.HOME / "results" / "causes")


QUICK = Options(lerf.QUICK.data, fit_steps=80, out=str(results.HOME / "results" / "quick" / "causes"))


def true_objects(setting: Setting, options: Options) -> tuple[np.ndarray, list[int]]:
    """(T, H, W) the object of each pixel of the evidence's frames, -1 = none, and the object that each query means."""
    root = options.data.place(options.scene, options.seed, options.level)
    objects = json.loads((root / "twin.json").read_text())["scenes"][options.scene]["objects"]
    files = (root / "truth" / options.scene / f"{name}.png" for name in setting.names)
    labels = np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]).astype(np.int32) - 1
    return labels, [objects.index(query) for query in setting.bench.queries]


def given(setting: Setting, field, regions: list[int], way: str) -> Answers:
    """The answers where each query is told its region."""

    def ask(k: int) -> Selection:
        found = query_region(of_all_views(field) if way == "all_views" else field, regions[k])
        found = by_lead(field, found, alike_threshold=None) if way == "lead" else found
        kept = remove_outliers(np.asarray(setting.evidence.gaussians.means), np.asarray(found.mask))
        return dataclasses.replace(found, mask=jnp.asarray(kept))

    return Answers(ask, lambda: np.zeros(0, np.int32))


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    setting = prepare(options.data, options.scene, options.seed, options.level, fit_steps=options.fit_steps)
    truth, meant = true_objects(setting, options)
    rows: list[dict] = []

    def told(name: str, answers: Answers, **more) -> None:
        figures = measure(setting, answers)
        rows.append({"what": name, **more, "miou": figures["miou"], "miou_vala": figures["miou_vala"]})

    told("true masks, votes", given(setting, field_of(setting, by="truth", labels=truth), meant, "votes"))
    told("VALA", METHODS["VALA"](setting, Steps()))
    for by in ASSOCIATIONS:
        field, regions = field_of(setting, by=by), association(setting, by)
        joint = overlaps(regions.labels, truth, int(truth.max()) + 1)
        joint = np.pad(joint, ((0, len(regions.embeddings) - len(joint)), (0, 0)))
        size, whole = regions.pixels.sum(1), np.bincount(truth[truth >= 0], minlength=joint.shape[1])
        best = [int(joint[:, k].argmax()) for k in meant]
        state = {
            "recall": float(np.mean([joint[r, k] / whole[k] for r, k in zip(best, meant)])),
            "purity": float(np.mean([joint[r, k] / max(size[r], 1) for r, k in zip(best, meant)])),
        }
        for way in MEMBERSHIPS:
            for retrieval in RETRIEVALS:
                found = [int(query_anchored(field, text, retrieval=retrieval).region) for text in setting.texts]
                right = sum(r >= 0 and joint[r, k] == joint[r].max() > 0 for r, k in zip(found, meant))
                answers = ask_field(setting, field, way, retrieval=retrieval)
                told(f"{by}, {way}, {retrieval}", answers, texts=f"{right} of {len(meant)}", **state)
            told(f"{by}, {way}, region given", given(setting, field, best, way), **state)
        for share in SHARES:
            answers = ask_field(setting, field, "votes", threshold=share)
            told(f"{by}, votes, contrast, share >= {share:g}", answers, **state)
    columns = ("what", "texts", "recall", "purity", "miou", "miou_vala")
    table = results.table(columns, [tuple(row.get(name, "") for name in columns) for row in rows])
    text = f"{options.scene}, seed {options.seed}, a twin in LERF-OVS's layout, {options.level} noise.\n\n{table}"
    results.save(Path(options.out), options, {"rows": rows}, text, draw(rows))
    print(text)
    return {"rows": rows}


def draw(rows: list[dict]):
    """A group of bars for each association and membership; lines for what needs no region."""
    found = {row["what"]: row["miou"] for row in rows}
    ways = [(by, way) for by in ASSOCIATIONS for way in MEMBERSHIPS]
    series = {end: [found[f"{by}, {way}, {end}"] for by, way in ways] for end in (*RETRIEVALS, "region given")}
    figure = results.bars([f"{by}\n{way}" for by, way in ways], series, "mIoU")
    for name, style in (("true masks, votes", "--"), ("VALA", ":")):
        figure.axes[0].axhline(found[name], color="0.3", linestyle=style, label=name)
    figure.axes[0].legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="one tiny scene")
    main(QUICK if parser.parse_args().quick else Options())
