"""Does "the lid of the red pot" find that part? Made-up rooms, whose things have parts that are known.

    python -m experiments.parts [--seeds 0 1 ...]

The rooms are those of `experiments.catalogue`, as depth cameras see them (24 frames of 640x480); each point is a
Gaussian. Masks are the true ones of things and of single solids, as SAM's levels have them; a share of the latter is
left out of each frame. The embedding of a mask is simulated: the mean of what its pixels show, plus a gap and errors of
each mask and each solid. A solid that is a part shows mostly the part's word; the others show the thing's.

An expression is right if the IoU of its Gaussians with the true ones of that part is above 0.25. A part is asked for if
it has at least 30 Gaussians and the room has one thing of that name. Absent: other names of parts, of the same things.
A lone word, as "lid", is right if more than half of its Gaussians are of parts of that name; or, where the room has no
such part, if there are none.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jsecon
from experiments import results
from experiments.replica_apartment_0 import Options as Points, points_as_gaussians
from experiments.rooms.capture import render_capture, room_cameras
from experiments.rooms.raycast import trace_rays
from experiments.rooms.room import Room, crowded_room
from experiments.simulated_vision.embeddings import TextSpace, made_text_space
from experiments.simulated_vision.exact_sam import level_labels, masks_of
from jsecon.app.scene import Scene
from jsecon.errors import InputError
from jsecon.field.tree import node_members
from jsecon.pipeline.objects import plan_objects
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.run import join_field
from jsecon.pipeline.stages import Checkpoint, Results, RunContext, StageInput
from jsecon.types import LanguageField
from jsecon.vision.protocols import Models
from jsecon.vision.unrelated_words import UNRELATED_WORDS

PARTS = {
    "mug": ("", "handle"),
    "pot": ("", "lid", "knob", "handle", "handle"),
    "kettle": ("", "spout", "lid", "knob", "handle"),
    "bottle": ("", "shoulder", "neck", "cap"),
    "vase": ("", "neck"),
    "bowl": ("", "foot"),
    "teddy": ("body", "head", "muzzle", *("foot", "arm", "ear") * 2),
}
"""Names of the solids of each shape; "" has the name of the thing."""
LEAST, RIGHT = 30, 0.25
"""Gaussians of a part that is asked for; IoU above which its answer is right."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    missing: float = 0.3
    """Share of the masks of solids that are left out of a frame."""
    noise: float = 0.6
    """Length of the error of a mask, relative to a text; that of a solid is half of it."""
    out: str = "experiments/results/parts"


class PartEmbedder:
    """An `Embedder` of the frames of a room.

    Args:
      frames: (T, H, W, 3).
      solids: (T, H, W) solid at each pixel; the number of solids where there is none.
      names: Of each solid, "thing" or "thing|part".
      space: Texts.
      noise: Length of the error of a mask.
      seed: Seed of the errors.
    """

    def __init__(
        self, frames: np.ndarray, solids: np.ndarray, names: list[str], space: TextSpace, noise: float, seed: int
    ):
        self.name, self.dim = f"simulated parts (seed {seed})", space.vectors.shape[1]
        self._solids, self._noise = solids, noise
        self._frames = {frame.tobytes(): t for t, frame in enumerate(frames)}
        self._words = dict(zip(space.names, space.vectors))
        draw, mean = np.random.default_rng([seed, 3]), space.vectors.mean(0)
        shown = [
            np.average([self._words[w] for w in name.split("|")], 0, (0.3, 0.7)[: name.count("|") + 1])
            for name in names
        ]
        content = [_unit(row) + 0.5 * noise * _unit(draw.standard_normal(self.dim)) for row in shown]
        self._content = np.array([*content, mean])
        self._gap = _unit(draw.standard_normal(self.dim))
        self.canonical_phrases = np.array([mean + _unit(draw.standard_normal(self.dim)) for _ in range(4)], np.float32)
        self.unrelated_words = self.embed_text(list(UNRELATED_WORDS))

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> np.ndarray:
        """(M, E) unit embeddings of the masks of one of the frames."""
        t, rows = self._frames[np.asarray(frame).tobytes()], np.zeros((len(masks), self.dim), np.float32)
        for m, mask in enumerate(masks):
            shares = np.bincount(self._solids[t][mask], minlength=len(self._content)) / max(mask.sum(), 1)
            error = np.random.default_rng([int(mask.sum()), t, m]).standard_normal(self.dim)
            rows[m] = _unit(shares @ self._content + self._gap + self._noise * _unit(error))
        return rows

    def embed_text(self, texts: list[str]) -> np.ndarray:
        """(Q, E) vectors of names of the space."""
        if unknown := [text for text in texts if text not in self._words]:
            raise InputError(unknown[0], "no such name", f"one of {len(self._words)}", "Use a name of the space.")
        return np.array([self._words[text] for text in texts], np.float32)


def _unit(row: np.ndarray) -> np.ndarray:
    return row / np.linalg.norm(row)


def solid_names(room: Room) -> list[str]:
    """The name of each solid of a room: of a thing, of a part of one as "thing|part", or of furniture."""
    names = ["table"] * len(room.furniture)
    for thing in room.objects:
        parts = PARTS.get(thing.shape, ())
        parts = (*parts, *[""] * (len(thing.parts) - len(parts)))
        names += [f"{thing.name or 'clutter'}|{part}".rstrip("|") for part in parts]
    return names


def field_of_parts(seed: int, options: Options) -> tuple[LanguageField, PartEmbedder, list[str], np.ndarray]:
    """The field of a room by masks of things and solids, its embedder, the names of its solids, and the solid that has
    most of the weight of each Gaussian, -1 where nothing has."""
    room = crowded_room(seed)
    cameras = room_cameras(room, views=24, width=640, height=480)
    frame_names = tuple(f"frame_{t:05d}" for t in range(24))
    capture = render_capture(room, cameras, frame_names, np.zeros(24, bool), points=100)[0]
    gaussians = jax.tree.map(jnp.asarray, points_as_gaussians(capture, Points(voxel_m=0.01))[1])
    names, draw = solid_names(room), np.random.default_rng([seed, 5])
    traced = [trace_rays(room, camera)[1] for camera in cameras]
    solids = np.stack([np.where(image >= 0, image, len(names)).astype(np.int32) for image in traced])
    proposals = []
    for camera in cameras:
        labels = level_labels(room, camera)
        wholes, parts = masks_of(labels["l"], 100), masks_of(labels["s"], 100)
        parts = [
            part for part in parts[draw.random(len(parts)) >= options.missing] if not (part == wholes).all((1, 2)).any()
        ]
        proposals.append(np.array([*wholes, *parts]))

    class TrueMasks:
        name = "true masks of things and solids"

        def __call__(self, frame: np.ndarray, index: int) -> np.ndarray:
            return proposals[index]

    parts = {part for own in PARTS.values() for part in own} - {""}
    words = sorted({word for name in names for word in name.split("|")} | parts | {*UNRELATED_WORDS})
    embedder = PartEmbedder(
        np.asarray(capture.frames), solids, names, made_text_space(words, seed=seed), options.noise, seed
    )
    run = RunOptions(Path(), seed=seed)
    context, done = RunContext(run, Models(embedder, TrueMasks()), Path()), Results(load=capture)
    done.gaussians = gaussians
    for stage in plan_objects(context):
        given = StageInput(context, done, lambda number, total: None, Checkpoint(Path(stage.name)))
        setattr(done, stage.name, stage.compute(given).value)
    votes = jsecon.region_votes(gaussians, jax.tree.map(jnp.asarray, cameras), solids, len(names) + 1, top=1)
    truth = np.asarray(votes.regions)[:, 0]
    return join_field(done, embedder, "{}", run), embedder, names, np.where(truth < len(names), truth, -1)


def ask_parts(seed: int, options: Options) -> tuple[list[float], list[float], list[bool], list[bool]]:
    """The IoU of each expression of a room, that of the best node, whether absent parts are refused, and lone words."""
    field, embedder, names, truth = field_of_parts(seed, options)
    scene, ious, best, refused = Scene(field, embedder), [], [], []
    tree, leaf = np.asarray(field.tree), np.asarray(field.leaf)
    things = [item.name for item in crowded_room(seed).objects]
    words = {part for parts in PARTS.values() for part in parts} - {""}
    for thing in sorted({name for name in things if name and things.count(name) == 1}):
        own = {name.split("|")[1] for name in names if name.startswith(f"{thing}|")}
        for part in sorted(own):
            true = np.isin(truth, [n for n, name in enumerate(names) if name == f"{thing}|{part}"])
            if true.sum() >= LEAST:
                mask = _ask(scene, part, thing)
                ious.append(_iou(mask, true))
                nodes = (node_members(tree, leaf, n) for n in range(field.regions.count, len(tree)))
                best.append(max(_iou(node, true) for node in nodes))
                print(f"{part} of the {thing}: {true.sum()} {mask.sum()} {ious[-1]:.2f} {best[-1]:.2f}", flush=True)
        refused += [not _ask(scene, part, thing).any() for part in sorted(words - own) if own]
    lone, shown = [], {name.split("|")[1] for name in names if "|" in name}
    for word in sorted(words):
        mask = scene.ask(word).mask
        true = np.isin(truth, [n for n, name in enumerate(names) if name.endswith(f"|{word}")])
        lone.append(mask.any() and true[mask].mean() > 0.5 if word in shown else not mask.any())
    return ious, best, refused, lone


def _iou(mask: np.ndarray, true: np.ndarray) -> float:
    return float((mask & true).sum() / (mask | true).sum())


def _ask(scene: Scene, part: str, thing: str) -> np.ndarray:
    """The Gaussians of an answer; none where the embedder lacks the text as a whole: no part of the thing matched."""
    try:
        return scene.ask(f"the {part} of the {thing}").mask
    except InputError:
        return np.zeros(scene.field.gaussians.count, bool)


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    measured: dict[str, Any] = {f"seed {seed}": ask_parts(seed, options) for seed in options.seeds}
    measured["all"] = tuple([x for row in measured.values() for x in row[k]] for k in range(4))
    header = (
        "room",
        "expressions",
        "right",
        "mean IoU",
        "best node, mean IoU",
        "absent parts",
        "refused",
        "lone words",
    )
    rows = []
    for name, (ious, best, refused, lone) in measured.items():
        shares = [np.mean(np.array(ious) > RIGHT), np.mean(ious), np.mean(best), np.mean(refused), np.mean(lone)]
        right, iou, node, refusal, words = (round(float(share), 3) for share in shares)
        rows.append((name, len(ious), right, iou, node, len(refused), refusal, words))
    table = results.table(header, rows)
    metrics = {"rows": [dict(zip(header, row)) for row in rows]}
    bars = {name: [row[header.index(name)] for row in rows] for name in ("right", "mean IoU", "refused")}
    results.save(Path(options.out), options, metrics, table, results.bars([row[0] for row in rows], bars, "share"))
    print(table)
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
