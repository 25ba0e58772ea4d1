"""Worlds that fight back: what real vision does and `Faults` do not, each by a switch of its own from 0 to 1.

`Faults` are drawn anew for each mask, so that views outvote them. These are not: halves that are told apart at the same
place in every view, neighbours that are taken for one again and again, shadows that masks reach over, noise that turns
with the camera, texts that lie near each other, objects that look like other classes from every side.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from experiments.rooms.room import Room
from jsecon.errors import require


@dataclasses.dataclass(frozen=True)
class World:
    """The switches; 0 is off, 1 is hard."""

    parts: float = 0.0
    """share of an object's views in which the two sides of a plane through it are masks of their own, and what sets
    the images of each side apart from the object's, in lengths of a text vector. The plane is the same in all views."""
    groups: float = 0.0
    """share of an object's views in which it and its nearest neighbour are one mask."""
    shadow: float = 0.0
    """how far masks reach over the table beyond the object's footprint, away from the lamp, in its radii."""
    azimuth: float = 0.0
    """part of the views' noise that is a smooth function of the camera's azimuth, four numbers for an object: alike in
    neighbouring views, so that it does not average out."""
    gap: float = 0.0
    """half the deviation of the modality gap's length from class to class, in its own length."""
    names: float = 0.0
    """names with words in common lie near each other: the words' part of what tells names apart, in 0.8."""
    lvis: float = 0.0
    """texts are vectors of LVIS names as CLIP has them: below 1 of any names, at 1 of names near each other."""
    levels: float = 0.0
    """share of an object's views in which masks overlap in three levels: its two sides, itself, and it with its nearest
    neighbour. In the others the three are alike."""
    shared: float = 0.0
    """how far an object's images lean away from its own text, to a mixture of other classes' texts. The mixture is the
    object's own and the same in all views (`leanings`), so that no mean over views removes it."""


SHARED = "shared"
SHARED_STRENGTH = 0.85
"""the level "shared" is medium noise with `World.shared` of this strength. Chosen so that by the plain cosine the own
text is the best of the scene's for a quarter of the regions, as with a real embedder (experiments/shared_errors.py)"""


class Seen(NamedTuple):
    """What there is to segment and to embed in a hard world."""

    masks: np.ndarray
    """(T, H, W) int16 the masks that faultless vision would make, -1 = none."""
    content: np.ndarray
    """(T, H, W) int16 what the pixels show: pieces of objects, -1 = none."""
    objects: np.ndarray
    """(L,) the object of each piece."""
    small: np.ndarray | None = None
    large: np.ndarray | None = None
    """(T, H, W) int16 the masks of a smaller and of a larger level, where there are three."""


def world_of(level: str) -> tuple[str, World]:
    """The level of noise and the world of a name such as "medium+parts=1+gap=0.5"; "shared" is "medium+shared=0.85".
    Raises ValueError for a switch that there is none of, and one beyond 0 to 1."""
    noise, *switches = level.split("+")
    if noise == SHARED:
        noise = "medium"
        switches = [f"{SHARED}={SHARED_STRENGTH}", *switches]
    values = dict(switch.split("=") for switch in switches)
    known = [field.name for field in dataclasses.fields(World)]
    for name, value in values.items():
        fit = name in known and 0 <= float(value) <= 1
        require(fit, "level", f"{name}={value}", f"a number from 0 to 1 of {', '.join(known)}", "See World.")
    return noise, World(**{name: float(value) for name, value in values.items()})


def seen_in(
    world: World,
    truth: Int[np.ndarray, "t h w"],
    points: Float[np.ndarray, "t h w 3"],
    room: Room,
    table: int,
    *,
    seed: int,
) -> Seen:
    """What a world makes of the true labels, whose pixels show `points`, m. The room's objects come first, in its
    order; `table` is the label of its table."""
    count, labels = len(room.objects), int(truth.max()) + 1
    masks, content, objects = truth.astype(np.int16), truth.astype(np.int16), np.arange(labels)
    if world.parts or world.levels:
        content, objects = _halved(truth, points, count, seed)
    if world.parts:
        masks = _cut(masks, truth, content, count, world.parts, np.random.default_rng([seed, 11]))
    if world.shadow:
        masks = _with_shadows(world.shadow, masks, truth, points, room, table)
    if world.groups:
        masks = _joined(masks, objects, room, world.groups, np.random.default_rng([seed, 12]))
    if not world.levels:
        return Seen(masks, content, objects)
    small = _cut(masks, truth, content, count, world.levels, np.random.default_rng([seed, 14]))
    large = _joined(masks, objects, room, world.levels, np.random.default_rng([seed, 15]))
    return Seen(masks, content, objects, small, large)


def _cut(masks, truth, content, count, share, draw):
    """Masks whose objects, the first `count` labels, are their pieces, in a share of their views."""
    apart = draw.random((len(truth), count + 1)) < share
    apart[:, count] = False  # what is no object
    views = np.arange(len(truth))[:, None, None]
    return np.where(apart[views, np.where((truth >= 0) & (truth < count), truth, count)], content, masks)


def _joined(masks, objects, room, share, draw):
    """Masks in which objects and their nearest neighbours are one, in a share of their views."""
    count, labels = len(room.objects), len(objects)
    joined = masks.copy()
    centres = np.stack([item.centre for item in room.objects])
    away = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + 1e9 * np.eye(count)
    single = np.where(masks >= 0, objects[np.clip(masks, 0, labels - 1)], masks)
    for t, together in enumerate(draw.random((len(masks), count)) < share):
        for k in np.flatnonzero(together):
            near = int(away[k].argmin())
            if (single[t] == k).any() and (single[t] == near).any():
                joined[t][(single[t] == k) | (single[t] == near)] = min(k, near)
    return joined


def _halved(truth, points, count, seed):
    """Labels whose objects have two: k on one side of a plane through the object, `labels` + k on the other."""
    draw, labels = np.random.default_rng([seed, 10]), int(truth.max()) + 1
    content = truth.astype(np.int16)
    for k in range(count):
        normal, share = np.array([*draw.normal(0, 0.4, 2), 1.0]), draw.uniform(0.35, 0.65)
        own = truth == k
        if own.any():
            along = points[own] @ normal
            content[own] = np.where(along > np.quantile(along, share), labels + k, k)
    return content, np.concatenate([np.arange(labels), np.arange(count)])


def _with_shadows(length, masks, truth, points, room, table):
    """Masks that reach over the table where an object's footprint lies, moved from the lamp by up to `length` radii."""
    found, on_table = masks.copy(), truth == table
    flat = points[..., :2]
    for k, item in enumerate(room.objects):
        away = item.centre[:2] - room.light[:2]
        away = away / np.linalg.norm(away)
        for part in np.linspace(0, length, 5):
            inside = np.linalg.norm(flat - (item.centre[:2] + part * item.radius * away), axis=-1) < item.radius
            found[on_table & inside] = k
    return found
