"""Answers to referring expressions such as "the red mug left of the bottle", places of things and their distances.

The text is parsed (query/expressions), the regions of each named object are matched as any query does and their pieces
joined (app/object_scene), and conditions and orders choose among the objects (query/referring). Nothing is guessed: an
answer is 0, 1 or several objects, with what came nearest or what would settle which is meant.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from jsecon.app.ask import Answer, ask_text
from jsecon.app.locate import Place, locate_answer, rounded
from jsecon.app.object_scene import ObjectScene, open_scene
from jsecon.errors import InputError, require
from jsecon.query.expressions import is_expression, parse_expression
from jsecon.query.referring import FoundObject, evaluate, stack_shapes
from jsecon.query.relations import Viewpoint, order_values
from jsecon.types import Camera, LanguageField, Selection

SEEN = ("left of", "right of", "in front of", "behind", "leftmost", "rightmost", "nearest", "farthest")
"""relations and orders that depend on the viewpoint"""


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
      source_from_scene: (4, 4) from the field's world to the capture's.
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
    source_from_scene: np.ndarray

    @property
    def count(self) -> int:
        """Number of objects."""
        return len(self.objects)

    def describe(self) -> str:
        """Describes the answer.

        Returns:
          A sentence or two: how the text was read, the number of objects, the reason, and the question.
        """
        names = sorted({found.phrase for found in self.objects})
        number = f"{self.count} object{'s' * (self.count != 1)}{f' ({names[0]})' if names else ''}"
        sentences = [f"read as {self.reading}{f', {self.viewpoint}' if self.viewpoint else ''}: {number}"]
        return ". ".join([*sentences, *filter(None, (self.reason.rstrip("."), self.question))])

    def as_dict(self) -> dict[str, Any]:
        """Makes a record for JSON.

        Returns:
          Plain values by name: those of this class and its description, without the mask, in the capture's world.
        """
        record = {name: getattr(self, name) for name in ("text", "reading", "viewpoint", "ambiguous", "question")}
        groups = {
            name: [_plain(o, self.source_from_scene) for o in getattr(self, name)] for name in ("objects", "used")
        }
        alternatives = [_plain(found, self.source_from_scene) for found in self.alternatives]
        record |= {"description": self.describe(), "reason": self.reason, "count": self.count}
        return record | groups | {"alternatives": alternatives}


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
        """Makes a record for JSON.

        Returns:
          The attributes by name, rounded.
        """
        lengths = rounded(np.array([self.surfaces, self.centers, self.gap]), self.centers)
        return vars(self) | dict(zip(("surfaces", "centers", "gap"), lengths)) | {"angle": round(self.angle, 2)}


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
    outcomes = [evaluate(scene.objects_of, expression.thing, reading, view) for reading in readings]
    place = next((n for n, outcome in enumerate(outcomes) if outcome.chosen), 0)
    best, others = outcomes[place], outcomes[place + 1 :]
    chosen = {found.regions for found in best.chosen}
    differing = [found for outcome in others for found in outcome.chosen if found.regions not in chosen]
    question = ""
    if best.undecided:
        number = str(len(best.chosen)) if best.undecided is best.chosen else "which"
        question = f"{number} {expression.thing.text!r}: {_tell_apart(scene, best.undecided, view)}?"
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
        source_from_scene=scene.source_from_scene,
    )


def _tell_apart(scene: ObjectScene, objects: Sequence[FoundObject], view: Viewpoint) -> str:
    """Says how objects of one name could be told apart: by what stands nearest to each, or from left to right."""
    listed = scene.catalogue
    own = {int(listed.regions[region]) for found in objects for region in found.regions}
    name_of = [str(name) for name in listed.names[:, 0]]
    times = Counter(name_of)
    marks = [k for k, name in enumerate(name_of) if times[name] == 1 and k not in own and not listed.surroundings[k]]
    if marks:
        centers = np.stack(
            [scene.source_from_scene[:3, :3] @ o.shape.center[0] + scene.source_from_scene[:3, 3] for o in objects]
        )
        away = np.linalg.norm(centers[:, None] - np.asarray(listed.shapes.center)[marks], axis=2)
        nearest = [name_of[marks[k]] for k in away.argmin(1)]
        if len(set(nearest)) == len(nearest):
            words = [f"the one near the {name}" for name in nearest]
            return f"{', '.join(words[:-1])} or {words[-1]}"
    bearing = order_values(stack_shapes(objects), view)["leftmost"]
    places = ["the left one", *["a middle one"] * (len(objects) - 2), "the right one"]
    centers = [_plain(objects[k], scene.source_from_scene)["center"] for k in np.argsort(bearing)]
    words = [f"{place} at ({', '.join(f'{x:.2f}' for x in center)})" for place, center in zip(places, centers)]
    return f"{', '.join(words[:-1])} or {words[-1]}"


def _plain(found: FoundObject, source_from_scene: np.ndarray) -> dict[str, Any]:
    """Returns an object as plain values, in the capture's world."""
    center = source_from_scene[:3, :3] @ found.shape.center[0] + source_from_scene[:3, 3]
    scale = float(np.cbrt(abs(np.linalg.det(source_from_scene[:3, :3]))))
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
    """Makes an `Answer` of the answer to an expression, for files and pictures.

    Args:
      answer: The answer to the expression.

    Returns:
      Its Gaussians with a similarity of 1, and the best region if it has one object, else -1.
    """
    region = answer.objects[0].regions[0] if len(answer.objects) == 1 else -1
    score = answer.objects[0].score if answer.objects else 0.0
    best = np.asarray(region, np.int32), np.asarray(score, np.float32)
    selection = Selection(answer.mask, answer.mask.astype(np.float32), *best)
    return Answer(
        answer.text, "relation", selection, answer.mask, {}, relation=answer.as_dict(), objects=max(1, answer.count)
    )


def locate(
    field: LanguageField | ObjectScene,
    text: str,
    embedder: Any = None,
    *,
    frame: int | str | None = None,
    up: Sequence[Any] | None = None,
    **options: Any,
) -> Place:
    """Locates the one thing that a text or a referring expression names.

    In five made-up rooms it finds all 60 things that have a unique name; `center` is off by 5 mm in the median
    (experiments/catalogue.py).

    Args:
      field: The field, or an `ObjectScene` of it.
      text: For example "orange ball" or "the red mug left of the bottle".
      embedder: Embedder of the field; None opens it.
      frame: Of an expression, as for `query_relation`.
      up: Of an expression, as for `query_relation`.
      **options: Of a text, options of `jsecon.app.ask.ask_text`.

    Returns:
      Centre, boxes and points of the selection.

    Raises:
      InputError: The text names no object, or several; or the embedder has no words for it.
      ValueError: An expression has options of a text.
    """
    if not is_expression(text):
        if isinstance(field, ObjectScene):
            field, embedder = field.field, field.embedder
        if embedder is None:
            from jsecon.pipeline.model_loading import field_embedder

            embedder = field_embedder(field)
        answer = ask_text(field, embedder, text, **options)
        if answer.objects > 1:  # their box would have its centre between them
            remedy = "Say which, as in 'the red mug left of the green bottle', or point at it."
            raise InputError(f"query {text!r}", f"it names {answer.objects} objects", "one object", remedy)
        return locate_answer(field, answer)
    require(not options, f"locate {text!r}", sorted(options), "no options of a plain text", "Leave them out.")
    scene = open_scene(field, embedder, up)
    return locate_answer(scene.field, relation_answer(_query_single(scene, text, frame)))


def _query_single(scene: ObjectScene, text: str, frame: int | str | None) -> RelationAnswer:
    """Returns the answer to an expression, or raises InputError unless it has one object."""
    answer = query_relation(scene, text, frame=frame)
    if answer.count != 1:
        problem = f"it names {answer.count} objects" + (f": {answer.reason}" if answer.reason else "")
        remedy = answer.question or "Name one object."
        raise InputError(f"query {answer.text!r}", problem, "one object", remedy[:1].upper() + remedy[1:])
    return answer


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
    one, other = (_query_single(scene, text, frame).objects[0] for text in (a, b))
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
