"""Answers to referring expressions such as "the red mug left of the bottle", and distances between things.

The text is parsed (query/expressions), the regions of each named object are matched as any query does and their pieces
joined, and the soft predicates of query/relations are compared with SATISFIED. Nothing is guessed: an answer is 0, 1 or
several objects, with what came nearest or what would settle which is meant.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jsecon.app.ask import Answer, frame_index, with_phrases
from jsecon.app.catalogue import Catalogue, objects as list_objects
from jsecon.app.locate import rounded
from jsecon.data.capture import may_have_depth
from jsecon.errors import InputError
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.pipeline.sources import locate_sources
from jsecon.query.expressions import ANCHORED_ORDERS, Condition, Thing, parse_expression
from jsecon.query.match import RegionMatch, match_regions
from jsecon.query.object_shapes import PARALLEL, ObjectShapes, gaussian_spreads, object_shapes, scene_up
from jsecon.query.outliers import split_outliers
from jsecon.query.relations import (
    SATISFIED,
    Viewpoint,
    between_scores,
    order_values,
    pair_scores,
    size_of,
    viewpoint,
)
from jsecon.query.rules import MIN_PIECE_OVERLAP, QueryRules
from jsecon.query.select import select_by_share
from jsecon.query.similarity import Number
from jsecon.types import Array, Camera, LanguageField, Selection, Votes
from jsecon.views.frame import scene_frame, surface_points

WITHIN_REACH = 0.2
"""score from which an object that was not chosen is an alternative"""
CLOSE_CALL = 0.04
"""difference of two values of an order, in units of their size, up to which neither is clearly before the other"""
CLOSE_ANGLE = 0.02
"""the same of directions, radians"""
ONE_WAY = 0.5
"""length of the mean of the cameras' horizontal directions from which they look one way"""
SAME_WAY = 0.7
"""cosine of the ground's normal with the cameras' up axis from which it is the same way up"""
BLOCK = 8
"""objects of each side that are scored at once: one program for all sizes"""
SEEN = ("left of", "right of", "in front of", "behind", "leftmost", "rightmost", "nearest", "farthest")
"""relations and orders that depend on the viewpoint"""


@dataclasses.dataclass(frozen=True)
class FoundObject:
    """An object that a phrase names.

    Attributes:
      phrase: The words that it was found by.
      regions: Its regions.
      rows: (M,) its Gaussians.
      shape: Its box and points, in the field's world.
      conditions: Score of each condition that was put to it, by the condition in words.
    """

    phrase: str
    regions: tuple[int, ...]
    rows: np.ndarray
    shape: ObjectShapes
    conditions: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def score(self) -> float:
        """The smallest score of its conditions; 1 without any."""
        return min(self.conditions.values(), default=1.0)


@dataclasses.dataclass(frozen=True)
class RelationAnswer:
    """What a referring expression names.

    Attributes:
      text: The expression.
      reading: How it was read.
      viewpoint: From where directions were seen; empty if no relation depends on it.
      objects: The objects, best first; empty if none meets the conditions.
      used: The objects that they were compared with.
      alternatives: Other objects of the name, with scores of at least WITHIN_REACH, best first.
      ambiguous: Whether the text leaves open which object is meant.
      question: What would settle it; empty if nothing has to be.
      reason: Why there is no object, or not the number that the text says; else empty.
      mask: (N,) the Gaussians of the objects.
      to_source: (4, 4) from the field's world to the capture's.
    """

    text: str
    reading: str
    viewpoint: str
    objects: tuple[FoundObject, ...]
    used: tuple[FoundObject, ...]
    alternatives: tuple[FoundObject, ...]
    ambiguous: bool
    question: str
    reason: str
    mask: np.ndarray
    to_source: np.ndarray

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.objects)

    def describe(self) -> str:
        """Describes the answer in a sentence or two."""
        names = sorted({found.phrase for found in self.objects})
        number = f"{self.count} object{'s' * (self.count != 1)}{f' ({names[0]})' if names else ''}"
        sentences = [f"read as {self.reading}{f', {self.viewpoint}' if self.viewpoint else ''}: {number}"]
        return ". ".join([*sentences, *filter(None, (self.reason.rstrip("."), self.question))])

    def as_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON, coordinates in the capture's world."""
        record = {name: getattr(self, name) for name in ("text", "reading", "viewpoint", "ambiguous", "question")}
        groups = {name: [_plain(o, self.to_source) for o in getattr(self, name)] for name in ("objects", "used")}
        alternatives = [_plain(found, self.to_source) for found in self.alternatives]
        return record | {"reason": self.reason, "count": self.count} | groups | {"alternatives": alternatives}


@dataclasses.dataclass(frozen=True)
class Measure:
    """Distances between two objects, in the unit of the capture's world.

    Attributes:
      a: Name of the first.
      b: Name of the second.
      surfaces: Smallest distance between Gaussians of the two.
      centers: Distance of the middles of their boxes.
      gap: Free way between their boxes on the line between the middles; 0 where the boxes meet.
      angle: Degrees of the second above the horizontal as seen from the first, middle to middle; negative below.
      unit: "metres", or "capture units" where the capture's scale is not known to be metres.
    """

    a: str
    b: str
    surfaces: float
    centers: float
    gap: float
    angle: float
    unit: str

    def as_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON."""
        lengths = rounded(np.array([self.surfaces, self.centers, self.gap]), self.centers)
        return vars(self) | dict(zip(("surfaces", "centers", "gap"), lengths)) | {"angle": round(self.angle, 2)}


class ObjectScene:
    """A field prepared for expressions. It keeps the objects that phrases named, with their shapes.

    Args:
      field: The field.
      embedder: Its embedder.
      up: (3,) up axis in the capture's world; None takes it from the cameras, or from the ground.

    Raises:
      InputError: `up` has no direction.
    """

    def __init__(self, field: LanguageField, embedder: Any, *, up: Sequence[Any] | None = None):
        """Finds the up axis; objects are measured when they are first asked for."""
        self.field = with_phrases(field, embedder)
        self.embedder = embedder
        self.to_source = np.asarray(field.to_source, np.float64)
        self.scale = float(np.cbrt(abs(np.linalg.det(self.to_source[:3, :3]))))
        self.up = _up_of(field) if up is None else self._own_direction(up)
        self.rules = QueryRules(all_of_kind=True, logits=getattr(embedder, "logits", None))
        self.origin = np.asarray(field.cameras.centres, np.float64).mean(0)
        self._votes = jax.tree.map(jnp.asarray, field.votes)
        self._overlap = None if field.votes.overlap is None else np.asarray(field.votes.overlap)
        self._spreads = gaussian_spreads(field.gaussians)
        self._objects: dict[tuple[int, ...], tuple[np.ndarray, ObjectShapes] | None] = {}
        self._phrases: dict[str, tuple[list[FoundObject], float]] = {}

    def _own_direction(self, up: Sequence[Any]) -> np.ndarray:
        """Returns a direction of the capture's world in the field's."""
        direction = self.to_source[:3, :3].T @ np.asarray(up, np.float64).reshape(3)
        length = np.linalg.norm(direction)
        if not (np.isfinite(length) and length > 0):
            raise InputError("--up", f"{list(up)} is no direction", remedy="Give three numbers, for example 0 0 1.")
        return direction / length

    def prepare(self) -> None:
        """Measures the object of every region, so that the first questions are as fast as later ones."""
        for region in range(self.field.regions.count):
            self._object((region,))
        _ = self.catalogue

    @functools.cached_property
    def catalogue(self) -> Catalogue:
        """All objects with names, which tell objects of one name apart."""
        return list_objects(self.field, None, self.embedder)

    def objects_of(self, phrase: str) -> tuple[list[FoundObject], float]:
        """Finds the objects that a phrase names: regions that match it, pieces of one object joined.

        Args:
          phrase: Free text for the embedder.

        Returns:
          The objects, and the share of unrelated words that are less similar to the scene than the phrase.

        Raises:
          InputError: The embedder has no words for the phrase.
        """
        if phrase not in self._phrases:
            embedded = jax.device_put(self.embedder.embed_text([phrase]))
            match = match_regions(self.field, embedded, self.rules)
            regions = np.flatnonzero(np.asarray(match.chosen)) if int(match.region) >= 0 else np.zeros(0, int)
            made = [(group, self._object(group)) for group in _joined(regions, self._overlap)]
            objects = [FoundObject(phrase, group, *parts) for group, parts in made if parts is not None]
            self._phrases[phrase] = objects, float(match.quantile)
        return self._phrases[phrase]

    def _object(self, regions: tuple[int, ...]) -> tuple[np.ndarray, ObjectShapes] | None:
        """Returns Gaussians and shape of the object of some regions; None if it has no Gaussian."""
        if regions not in self._objects:
            chosen = np.zeros(self.field.regions.count, bool)
            chosen[list(regions)] = True
            selection = _select(self._votes, chosen, np.asarray(regions[0]), SHARE_THRESHOLD)
            means = np.asarray(self.field.gaussians.means)
            weight = np.clip(np.asarray(selection.similarity), 0, 1) * np.asarray(self.field.votes.total)
            mask = split_outliers(means, np.asarray(selection.mask), keep="supported", weight=weight).mask
            rows = np.flatnonzero(mask)
            self._objects[regions] = None
            if len(rows):
                labels = np.zeros(len(rows), int)
                shape = object_shapes(means[rows], labels, self.up, spreads=self._spreads[rows])
                self._objects[regions] = rows, shape
        return self._objects[regions]

    def view(self, frame: int | str | None, camera: Camera | None) -> tuple[Viewpoint, str]:
        """Returns the viewpoint of a frame or a camera, or of the mean camera, and what it is in words.

        Cameras that look in all directions have no mean; then it is the frame that shows most objects.
        """
        up = jnp.asarray(self.up, jnp.float32)
        words = "as seen from the given camera"
        if camera is None and frame is None:
            ahead = np.asarray(self.field.cameras.world_to_camera, np.float64)[:, 2, :3]
            ahead = ahead - (ahead @ self.up)[:, None] * self.up
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
            mean = ahead.mean(0)
            if np.linalg.norm(mean) >= ONE_WAY:
                forward = jnp.asarray(mean / np.linalg.norm(mean), jnp.float32)
                return Viewpoint(jnp.zeros(3), forward, up), "as seen from the mean of the cameras"
            pixels = np.asarray(self.field.regions.pixels, np.int64)
            frame = int(np.lexsort((pixels.sum(0), (pixels > 0).sum(0)))[-1])
        if camera is None:
            index = frame_index(self.field, frame if frame is not None else 0)
            camera = jax.tree.map(np.asarray, self.field.cameras)[index]
            words = f"as seen from {self.field.names[index]}"
        assert camera is not None
        moved = np.array(camera.world_to_camera, np.float64)
        moved[:3, 3] += moved[:3, :3] @ self.origin
        return viewpoint(dataclasses.replace(camera, world_to_camera=jnp.asarray(moved, jnp.float32)), up), words

    def stacked(self, objects: Sequence[FoundObject]) -> ObjectShapes:
        """Returns the shapes of objects in float32 around the scene's origin, (K, ...)."""
        shapes = jax.tree.map(lambda *columns: np.concatenate(columns), *(found.shape for found in objects))
        moved = {name: getattr(shapes, name) - self.origin for name in ("center", "low", "high", "points")}
        return jax.tree.map(lambda a: np.asarray(a, np.float32), dataclasses.replace(shapes, **moved))

    @property
    def unit(self) -> str:
        """Unit of the capture's world."""
        capture = locate_sources(self.field).capture
        return "metres" if capture is not None and may_have_depth(Path(capture)) else "capture units"


def _up_of(field: LanguageField) -> np.ndarray:
    """Finds the up axis (3,): that of the cameras; of cameras that all look one way, the ground's if it is sure.

    Such cameras tell the up axis only up to how far they are tilted.
    """
    up = scene_up(field.cameras)
    right = np.asarray(field.cameras.world_to_camera, np.float64)[:, 0, :3]
    if np.linalg.eigvalsh(right.T @ right / len(right))[1] < PARALLEL:
        with contextlib.suppress(InputError):  # a scene without a surface has no ground
            ground = scene_frame(surface_points(field.gaussians))
            if ground.sure and ground.axes[2] @ up >= SAME_WAY:
                up = ground.axes[2]
    return up


@jax.jit
def _select(votes: Votes, chosen: Bool[Array, " r"], region: Array, threshold: Number) -> Selection:
    return select_by_share(votes, RegionMatch(chosen, region, jnp.asarray(1.0)), threshold)


def _joined(regions: np.ndarray, overlap: np.ndarray | None) -> list[tuple[int, ...]]:
    """Groups regions that overlap, directly or by way of others: the pieces of one object."""
    groups: list[set[int]] = []
    for region in map(int, regions):
        near = [g for g in groups if overlap is not None and (overlap[region, list(g)] >= MIN_PIECE_OVERLAP).any()]
        groups = [g for g in groups if g not in near] + [set().union({region}, *near)]
    return sorted(tuple(sorted(group)) for group in groups)


def query_relation(
    field: LanguageField | ObjectScene,
    text: str,
    embedder: Any = None,
    *,
    frame: int | str | None = None,
    camera: Camera | None = None,
    up: Sequence[Any] | None = None,
) -> RelationAnswer:
    """Finds the objects that a referring expression names.

    Args:
      field: The field, or an `ObjectScene` of it, which keeps what it has measured for later calls.
      text: For example "the red mug left of the bottle" (`parse_expression`).
      embedder: Embedder of the field; None opens it.
      frame: Frame from which directions are seen, its name or index. Without frame and camera they are seen from the
        mean camera, or from the frame that shows most objects where the cameras look in all directions.
      camera: Camera from which directions are seen, in the field's world.
      up: Up axis in the capture's world; None takes it from the cameras, or from the ground where these look one way.

    Returns:
      The answer: 0, 1 or several objects.

    Raises:
      InputError: The text is not understood, the field has no such frame or no regions, or the embedder has no words
        for an object.
    """
    expression = parse_expression(text)
    scene = open_scene(field, embedder, up)
    view, words = scene.view(frame, camera)
    readings = expression.readings()
    outcomes = [_evaluate(scene, expression.thing, reading, view) for reading in readings]
    place = next((n for n, outcome in enumerate(outcomes) if outcome.chosen), 0)
    best, others = outcomes[place], outcomes[place + 1 :]
    chosen = {found.regions for found in best.chosen}
    differing = [found for outcome in others for found in outcome.chosen if found.regions not in chosen]
    question = best.question
    if not question and any({found.regions for found in other.chosen} not in (set(), chosen) for other in others):
        first, second = expression.conditions
        question = f"is it the {expression.thing.text} or the {first.anchors[-1].text} that is {second}?"
    mask = np.zeros(scene.field.gaussians.count, bool)
    for found in best.chosen:
        mask[found.rows] = True
    return RelationAnswer(
        text=text,
        reading=expression.describe(readings[place]),
        viewpoint=words if expression.words & set(SEEN) else "",
        objects=tuple(best.chosen),
        used=tuple(best.used),
        alternatives=tuple({found.regions: found for found in [*best.alternatives, *differing]}.values()),
        ambiguous=bool(question),
        question=question,
        reason=best.reason,
        mask=mask,
        to_source=scene.to_source,
    )


def open_scene(field: LanguageField | ObjectScene, embedder: Any, up: Sequence[Any] | None = None) -> ObjectScene:
    """Returns the `ObjectScene` of a field, or the one that is given."""
    if isinstance(field, ObjectScene):
        return field
    if field.regions.count == 0:
        raise InputError("field", "it has no regions, so no objects", remedy="Make it again with other --masks.")
    if embedder is None:
        from jsecon.pipeline.networks import field_embedder

        embedder = field_embedder(field)
    return ObjectScene(field, embedder, up=up)


@dataclasses.dataclass
class _Outcome:
    """The objects of one reading of a thing with its conditions."""

    chosen: list[FoundObject]
    alternatives: list[FoundObject] = dataclasses.field(default_factory=list)
    used: list[FoundObject] = dataclasses.field(default_factory=list)
    question: str = ""
    reason: str = ""


def _evaluate(scene: ObjectScene, thing: Thing, conditions: Sequence[Condition], view: Viewpoint) -> _Outcome:
    """Finds the objects of a name that meet conditions, and chooses among them by the order."""
    candidates, quantile = scene.objects_of(thing.text)
    if not candidates:
        known = "" if np.isnan(quantile) else f" ({int(100 * quantile)} % of unrelated words are less like the scene)"
        return _Outcome([], reason=f"there is no {thing.text!r} in the scene{known}")
    used: list[FoundObject] = []
    orders: list[tuple[str, np.ndarray]] = []
    for condition in conditions:
        anchors = []
        for anchor in condition.anchors:
            outcome = _evaluate(scene, anchor, condition.conditions if anchor is condition.anchors[-1] else (), view)
            if not outcome.chosen:
                return _Outcome([], used=used, reason=f"nothing to compare with: {outcome.reason}")
            anchors.append(outcome.chosen)
            used += [found for found in outcome.chosen if found not in used]
        scores = _condition_scores(scene, candidates, condition, anchors, view)
        if condition.relation in ANCHORED_ORDERS:
            orders.append((condition.relation, scores))
            continue
        named = [found.conditions | {str(condition): round(float(x), 4)} for found, x in zip(candidates, scores)]
        candidates = [dataclasses.replace(found, conditions=row) for found, row in zip(candidates, named)]
    valid = [k for k, found in enumerate(candidates) if found.score >= SATISFIED]
    if orders:
        valid = [k for k in valid if all(np.isfinite(values[k]) for _, values in orders)]
    rest = [k for k in range(len(candidates)) if k not in valid and candidates[k].score >= WITHIN_REACH]
    if not valid:
        return _Outcome([], [candidates[k] for k in rest], used, reason=_nearest_miss(candidates))
    valid.sort(key=lambda k: -candidates[k].score)
    close: list[int] = []
    if thing.order is not None:
        orders.append((thing.order, np.asarray(order_values(scene.stacked(candidates), view)[thing.order])))
    others: list[int] = []
    for name, values in orders:
        valid, close, others, reason = _ordered(scene, candidates, valid, values, thing, name)
        if reason:
            return _Outcome([], [candidates[k] for k in others], used, reason=reason)
    chosen = [candidates[k] for k in valid]
    alternatives = [candidates[k] for k in dict.fromkeys([*close, *others, *rest])]
    question, reason = "", ""
    if close:
        question = f"which {thing.text!r}: {_tell_apart(scene, [chosen[-1], *(candidates[k] for k in close)], view)}?"
    elif len(chosen) > 1 and not thing.every and not orders and thing.number is None:
        question = f"{len(chosen)} {thing.text!r}: {_tell_apart(scene, chosen, view)}?"
    if thing.number is not None and len(chosen) != thing.number:
        reason = f"the text says {thing.number} and {len(chosen)} match"
    return _Outcome(chosen, alternatives, used, question, reason)


def _blocks(a: ObjectShapes, b: ObjectShapes, score: Callable[[ObjectShapes, ObjectShapes], Any]) -> Any:
    """Scores all pairs of two sets in blocks of one size, so that one program serves sets of any size."""

    def padded(count: int) -> np.ndarray:
        return np.minimum(np.arange(-(-count // BLOCK) * BLOCK), count - 1).reshape(-1, BLOCK)

    def beside(*tables: Any) -> Any:
        return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *tables)

    rows = [beside(*(score(a[i], b[j]) for j in padded(len(b)))) for i in padded(len(a))]
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=0)[: len(a), : len(b)], *rows)


def _condition_scores(
    scene: ObjectScene,
    candidates: Sequence[FoundObject],
    condition: Condition,
    anchors: Sequence[Sequence[FoundObject]],
    view: Viewpoint,
) -> Float[np.ndarray, " k"]:
    """Score of a condition for each candidate, with the anchor that fits best; for an anchored order the value."""
    shapes = scene.stacked(candidates)
    apart = [np.array([[not set(c.regions) & set(o.regions) for o in row] for c in candidates]) for row in anchors]
    if condition.relation == "between":
        first, second = anchors[0], anchors[-1]
        ends, tables = scene.stacked(second), []
        for middle in (scene.stacked([found]) for found in first):
            tables.append(_blocks(shapes, ends, lambda a, c, b=middle: between_scores(a, b, c)[:, 0]))
        values = np.stack(tables, axis=1)
        distinct = np.array([[not set(b.regions) & set(c.regions) for c in second] for b in first])
        usable = apart[0][:, :, None] & apart[-1][:, None, :] & distinct
        return np.where(usable, values, 0.0).max((1, 2))
    table = _blocks(shapes, scene.stacked(anchors[0]), lambda a, b: pair_scores(a, b, view))
    if condition.relation in ANCHORED_ORDERS:
        gaps = np.where(apart[0], table["gap"], np.inf).min(1)
        return gaps if condition.relation == "nearest to" else np.where(np.isfinite(gaps), -gaps, np.inf)
    return np.where(apart[0], table[condition.relation], 0.0).max(1)


def _ordered(
    scene: ObjectScene,
    candidates: Sequence[FoundObject],
    valid: list[int],
    values: np.ndarray,
    thing: Thing,
    name: str,
) -> tuple[list[int], list[int], list[int], str]:
    """Chooses by an order: the objects, those that are as good by a hair, the others, and why there is none."""
    ranked = sorted(valid, key=lambda k: values[k])
    count = (thing.number or 1) if thing.every or (thing.number or 0) > 1 else 1
    first = thing.rank - 1 if name not in ANCHORED_ORDERS else 0
    chosen = ranked[first : first + count]
    others = [k for k in ranked if k not in chosen]
    if not chosen:
        return [], [], others, f"there are {len(ranked)} {thing.text!r}, so none is number {thing.rank}"
    size = float(np.median([float(size_of(candidates[k].shape)[0]) for k in ranked]))
    tolerance = CLOSE_ANGLE if name in ("leftmost", "rightmost") else CLOSE_CALL * size
    close = [k for k in others if min(abs(values[k] - values[c]) for c in chosen) <= tolerance]
    return chosen, close, others, ""


def _nearest_miss(candidates: Sequence[FoundObject]) -> str:
    """Says which candidate came nearest, and which condition it does not meet."""
    best = max(candidates, key=lambda found: found.score)
    if not best.conditions:
        return f"there is no other object to compare the {best.phrase!r} with"
    condition, score = min(best.conditions.items(), key=lambda item: item[1])
    count = len(candidates)
    kind = f"of {count} {best.phrase!r} none" if count > 1 else f"the {best.phrase!r} there is not"
    return f"{kind} {condition}: the nearest scores {score:.2f}, and {SATISFIED:g} is needed"


def _tell_apart(scene: ObjectScene, objects: Sequence[FoundObject], view: Viewpoint) -> str:
    """Says how objects of one name could be told apart: by what stands nearest to each, or from left to right."""
    listed = scene.catalogue
    own = {int(listed.regions[region]) for found in objects for region in found.regions}
    name_of = [str(name) for name in listed.names[:, 0]]
    unique = [k for k, name in enumerate(name_of) if name_of.count(name) == 1]
    marks = [k for k in unique if k not in own and not listed.surroundings[k]]
    if marks:
        centers = np.stack([scene.to_source[:3, :3] @ o.shape.center[0] + scene.to_source[:3, 3] for o in objects])
        away = np.linalg.norm(centers[:, None] - np.asarray(listed.shapes.center)[marks], axis=2)
        nearest = [name_of[marks[k]] for k in away.argmin(1)]
        if len(set(nearest)) == len(nearest):
            words = [f"the one near the {name}" for name in nearest]
            return f"{', '.join(words[:-1])} or {words[-1]}"
    bearing = np.asarray(order_values(scene.stacked(objects), view)["leftmost"])
    places = ["the left one", *["a middle one"] * (len(objects) - 2), "the right one"]
    centers = [_plain(objects[k], scene.to_source)["center"] for k in np.argsort(bearing)]
    words = [f"{place} at ({', '.join(f'{x:.2f}' for x in center)})" for place, center in zip(places, centers)]
    return f"{', '.join(words[:-1])} or {words[-1]}"


def _plain(found: FoundObject, to_source: np.ndarray) -> dict[str, Any]:
    """Returns an object as plain values, in the capture's world."""
    center = to_source[:3, :3] @ found.shape.center[0] + to_source[:3, 3]
    scale = float(np.cbrt(abs(np.linalg.det(to_source[:3, :3]))))
    size = 2 * scale * np.asarray(found.shape.half_size[0])
    length = float(np.linalg.norm(size))
    return {
        "phrase": found.phrase,
        "regions": list(found.regions),
        "gaussians": len(found.rows),
        "center": rounded(center, length),
        "size": rounded(size, length),
        "score": round(found.score, 4),
        "conditions": found.conditions,
    }


def relation_answer(answer: RelationAnswer) -> Answer:
    """Returns the Gaussians of an expression as an `Answer`, for files and pictures."""
    region = answer.objects[0].regions[0] if len(answer.objects) == 1 else -1
    score = answer.objects[0].score if answer.objects else 0.0
    best = np.asarray(region, np.int32), np.asarray(score, np.float32)
    selection = Selection(answer.mask, answer.mask.astype(np.float32), *best)
    return Answer(answer.text, "relation", selection, answer.mask, {}, relation=answer.as_dict())


def measure(
    field: LanguageField | ObjectScene,
    a: str,
    b: str,
    embedder: Any = None,
    *,
    frame: int | str | None = None,
    up: Sequence[Any] | None = None,
) -> Measure:
    """Measures the distance between two objects.

    Args:
      field: The field, or an `ObjectScene` of it.
      a: Referring expression of the first object.
      b: Of the second.
      embedder: Embedder of the field; None opens it.
      frame: As for `query_relation`.
      up: As for `query_relation`.

    Returns:
      The distances in the capture's world.

    Raises:
      InputError: As for `query_relation`; or an expression names no object, or several.
    """
    scene = open_scene(field, embedder, up)
    found = []
    for text in (a, b):
        answer = query_relation(scene, text, frame=frame)
        if answer.count != 1:
            problem = f"it names {answer.count} objects" + (f": {answer.reason}" if answer.reason else "")
            remedy = answer.question or "Name one object."
            raise InputError(f"measure {text!r}", problem, "one object", remedy[:1].upper() + remedy[1:])
        found.append(answer.objects[0])
    one, other = found
    means = np.asarray(scene.field.gaussians.means, np.float64)
    surfaces = float(KDTree(means[one.rows]).query(means[other.rows])[0].min())
    line = other.shape.center[0] - one.shape.center[0]
    centers = float(np.linalg.norm(line))
    way = line / max(centers, 1e-300)
    reach = [float(np.min(np.asarray(s.half_size[0]) / np.maximum(np.abs(s.axes[0].T @ way), 1e-12)))
             for s in (one.shape, other.shape)]  # fmt: skip
    angle = float(np.degrees(np.arcsin(np.clip(way @ scene.up, -1, 1))))
    surfaces, centers, free = (scene.scale * x for x in (surfaces, centers, max(centers - sum(reach), 0.0)))
    return Measure(a, b, surfaces, centers, free, angle, scene.unit)
