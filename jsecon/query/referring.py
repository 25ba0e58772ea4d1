"""Which objects a referring expression names: candidates of its words, the scores of its conditions, and its order.

The parsed text (query/expressions) is compared with shapes by the soft predicates of query/relations. Host code.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from jsecon.query.expressions import ANCHORED_ORDERS, Condition, NounPhrase
from jsecon.query.object_shapes import ObjectShapes
from jsecon.query.relations import SATISFIED, Viewpoint, between_scores, order_values, pair_scores
from jsecon.query.rules import FOUND


@dataclasses.dataclass(frozen=True)
class Object:
    """An object that a phrase names."""

    phrase: str
    """The words that it was found by."""
    regions: tuple[int, ...]
    """Its regions."""
    rows: np.ndarray
    """(M,) its Gaussians."""
    shape: ObjectShapes
    """Its box and points, in the world of the capture."""
    sure: bool = True
    """Whether enough of the frames that see it show it; else it may be a fragment."""
    state: int = FOUND
    """Whether the scene has what the phrase names, an index of `rules.STATES`."""
    conditions: dict[str, float] = dataclasses.field(default_factory=dict)
    """Score of each condition that was put to it, by the condition in words."""

    @property
    def score(self) -> float:
        """The smallest score of its conditions; 1 without any."""
        return min(self.conditions.values(), default=1.0)


Find = Callable[[str], list[Object]]
"""The objects that a phrase names; all for ANY_OBJECT."""


@dataclasses.dataclass
class _ReferringResult:
    """The objects of one reading of a noun phrase with its conditions."""

    chosen: list[Object]
    """The objects, best first."""
    used: list[Object] = dataclasses.field(default_factory=list)
    """The objects that they were compared with."""
    undecided: list[Object] = dataclasses.field(default_factory=list)
    """Objects among which the text does not choose; empty if it does."""
    reason: str = ""
    """Why there is no object, or not the number that the text says; else empty."""


def _stack_shapes(objects: Sequence[Object]) -> ObjectShapes:
    """Joins the shapes of at least one object to one record."""
    return jax.tree.map(lambda *columns: np.concatenate(columns), *(found.shape for found in objects))


def find_referents(
    find: Find,
    thing: NounPhrase,
    conditions: Sequence[Condition],
    view: Viewpoint,
    units: tuple[float, float] = (1.0, 1.0),
) -> _ReferringResult:
    """Finds the objects of a name that meet conditions, one reading of a text, and chooses among them by the order.

    `units` are the capture's unit and the metre, in the world of the shapes.
    """
    candidates = find(thing.text)
    if not candidates:
        return _ReferringResult([], reason=f"there is no {thing.text!r} in the scene")
    shapes = _stack_shapes(candidates)
    used: list[Object] = []
    orders: list[tuple[str, np.ndarray]] = []
    for condition in conditions:
        anchors = []
        for anchor in condition.anchors:
            nested = condition.conditions if anchor is condition.anchors[-1] else ()
            result = find_referents(find, anchor, nested, view, units)
            if not result.chosen:
                return _ReferringResult([], used=used, reason=f"nothing to compare with: {result.reason}")
            anchors.append(result.chosen)
            used += [found for found in result.chosen if found not in used]
        scores = _condition_scores(candidates, shapes, condition, anchors, view, units)
        if condition.relation in ANCHORED_ORDERS:
            orders.append((condition.relation, scores))
            continue
        named = [found.conditions | {str(condition): round(float(x), 4)} for found, x in zip(candidates, scores)]
        candidates = [dataclasses.replace(found, conditions=row) for found, row in zip(candidates, named)]
    valid = [k for k, found in enumerate(candidates) if found.score >= SATISFIED]
    valid = [k for k in valid if all(np.isfinite(values[k]) for _, values in orders)]
    if not valid:
        return _ReferringResult([], used, reason=_nearest_miss(candidates))
    matches = len(valid)
    valid.sort(key=lambda k: -candidates[k].score)
    if thing.order is not None:
        orders.append((thing.order, np.asarray(order_values(shapes, view)[thing.order])))
    close: list[int] = []
    for name, values in orders:
        count = len(valid)
        valid, close = _ordered(shapes, valid, values, thing, name)
        if not valid:
            reason = f"there are {count} {thing.text!r}, so none is number {thing.rank}"
            return _ReferringResult([], used, reason=reason)
    chosen = [candidates[k] for k in valid]
    undecided = [chosen[-1], *(candidates[k] for k in close)] if close else []
    if len(chosen) > 1 and not thing.every and not orders and thing.number is None:
        undecided = chosen
    counts = [(thing.number, len(chosen)), (thing.among, matches)]
    wrong = [f"the text says {said} and {count} match" for said, count in counts if said not in (None, count)]
    return _ReferringResult(chosen, used, undecided, "; ".join(wrong))


def with_everything(relation: str, chosen: Sequence[Object], things: Sequence[Object], view: Viewpoint) -> list[Object]:
    """Adds the things that are on objects, or in them, and on what was added."""
    found, condition = list(chosen), Condition(relation, ())
    while left := [thing for thing in things if _apart([thing], found).all()]:
        scores = _condition_scores(left, _stack_shapes(left), condition, [found], view, (1.0, 1.0))
        if scores.max() < SATISFIED:
            break
        found += [thing for thing, score in zip(left, scores) if score >= SATISFIED]
    return found


def _apart(a: Sequence[Object], b: Sequence[Object]) -> Bool[np.ndarray, "k l"]:
    """Which pairs of objects have no region in common."""
    return np.array([[not set(first.regions) & set(other.regions) for other in b] for first in a])


def _condition_scores(
    candidates: Sequence[Object],
    shapes: ObjectShapes,
    condition: Condition,
    anchors: Sequence[Sequence[Object]],
    view: Viewpoint,
    units: tuple[float, float],
) -> Float[np.ndarray, " k"]:
    """Score of a condition for each candidate, with the anchor that fits best; for an anchored order the value."""
    others = _stack_shapes(anchors[0])
    usable = _apart(candidates, anchors[0])
    if condition.relation == "between":
        ends = _stack_shapes(anchors[-1])
        distinct = _apart(candidates, anchors[-1])[:, None] & _apart(anchors[0], anchors[-1])
        scores = between_scores(shapes, others, ends)
        return np.where(usable[:, :, None] & distinct, scores, 0.0).max((1, 2))
    rows = max(512 // len(others), 1)  # pairs at once, whose points stay in the processor's cache
    parts = [shapes[first : first + rows] for first in range(0, len(shapes), rows)]
    length = condition.length * units[condition.in_metres]
    scores = np.concatenate([pair_scores(condition.relation, part, others, view, length) for part in parts])
    if condition.relation in ANCHORED_ORDERS:
        gaps = np.where(usable, scores, np.inf).min(1)
        return gaps if condition.relation == "nearest to" else np.where(np.isfinite(gaps), -gaps, np.inf)
    return np.where(usable, scores, 0.0).max(1)


def _ordered(
    shapes: ObjectShapes, valid: Sequence[int], values: np.ndarray, thing: NounPhrase, name: str
) -> tuple[list[int], list[int]]:
    """Chooses by an order: the objects, and the others that are as good by a hair."""
    ranked = sorted(valid, key=lambda k: values[k])
    count = (thing.number or 1) if thing.every or (thing.number or 0) > 1 else 1
    first = thing.rank - 1 if name not in ANCHORED_ORDERS else 0
    chosen = ranked[first : first + count]
    others = [k for k in ranked if k not in chosen]
    # Within 0.02 radians, or 0.08 of the mean half of the sides, neither is clearly before the other.
    tolerance = 0.02 if name in ("leftmost", "rightmost") else 0.08 * np.median(shapes.half_size.mean(-1)[ranked])
    close = [k for k in others if chosen and min(abs(values[k] - values[c]) for c in chosen) <= tolerance]
    return chosen, close


def _nearest_miss(candidates: Sequence[Object]) -> str:
    """Says which candidate came nearest, and which condition it does not meet."""
    best = max(candidates, key=lambda found: found.score)
    if not best.conditions:
        return f"there is no other object to compare the {best.phrase!r} with"
    condition, score = min(best.conditions.items(), key=lambda item: item[1])
    what = repr(best.phrase) if len({found.phrase for found in candidates}) == 1 else "object"
    return f"no {what} is {condition}: the nearest scores {score:.2f}, and {SATISFIED:g} is needed"
