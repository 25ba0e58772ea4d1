"""The objects of a field by name: what referring expressions such as "the red mug left of the bottle" choose from.

The text is parsed (query/expressions), the regions of each named object are matched as any query does, the catalogue
tells which objects they belong to, and conditions and orders choose among these (query/referring). Nothing is guessed:
an answer is 0, 1 or several objects, with what came nearest or what would settle which is meant.
"""

import dataclasses
import functools
import re
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from scipy.spatial import KDTree

from jsecon.app.catalogue import Catalogue
from jsecon.app.records import Answer, Object, Query, rounded, source_shapes
from jsecon.errors import InputError
from jsecon.field.columns import votes_of_rows
from jsecon.field.membership import SHARE_THRESHOLD, inside_fraction_of_regions
from jsecon.field.tree import node_members, part_objects
from jsecon.query.answer import match_regions
from jsecon.query.expressions import ANY_OBJECT, parse_expression, split_part
from jsecon.query.match import RegionMatch
from jsecon.query.object_shapes import ObjectShapes
from jsecon.query.outliers import remove_outliers
from jsecon.query.parts import match_parts
from jsecon.query.pointing import frame_index
from jsecon.query.referring import find_referents, with_everything
from jsecon.query.relations import Viewpoint, order_values, viewpoint
from jsecon.query.rules import ABSENT, FOUND, MIN_RANK, QueryRules
from jsecon.read.captures.frames import transform_poses
from jsecon.types import LanguageField, Selection, UpAxis


def choose_shades(
    field: LanguageField, embedder: Any, texts: Sequence[str], rules: QueryRules, *, every: bool
) -> list[str]:
    """Replaces texts that are not found by narrower ones that are.

    Among colours "blue" is a family, and a room may have nothing of its typical colour but a dark and a light blue
    thing. Each is far from the word and near to its own shade.

    The embedder's `narrower(text)`, if it has one, lists texts that name a part of what the text names. With `every`,
    all of these that match replace the text, instead of the best of them. A text whose own match no shade finds stays.
    """
    if not hasattr(embedder, "narrower"):
        return list(texts)

    def match(text: str, rules: QueryRules) -> RegionMatch:
        return match_regions(field, embedder.embed_text([text]), rules)

    replaced: list[str] = []
    for text in texts:
        narrower = embedder.narrower(text)
        best: list[str] = []
        if narrower and int((plain := match(text, rules)).state) < FOUND:
            # Of n attempts one succeeds by chance as often as one attempt that is n times as strict.
            least = MIN_RANK if rules.min_rank is None else rules.min_rank
            strict = dataclasses.replace(rules, min_rank=1 - (1 - least) / len(narrower))
            matches = {option: match(option, strict) for option in narrower}
            best = sorted(
                (o for o, m in matches.items() if int(m.state) == FOUND), key=lambda o: float(matches[o].score)
            )
            if int(plain.state) > ABSENT and int(plain.region) not in [int(matches[option].region) for option in best]:
                best = []  # the match is another thing, which no shade fits
        replaced.extend(best[0 if every else -1 :] or [text])
    return replaced


class ObjectIndex:
    """The objects of the catalogue that phrases name, in the world of the capture. It keeps what the last ones name.

    Args:
      field: The field, with what texts are compared with.
      embedder: Its embedder.
      catalogue: Its objects.
      up: Its up axis.
    """

    def __init__(self, field: LanguageField, embedder: Any, catalogue: Catalogue, up: UpAxis):
        self._field = field
        self._embedder = embedder
        self._catalogue, self._up = catalogue, up
        poses = transform_poses(np.asarray(field.cameras.world_to_camera), np.asarray(field.source_from_scene))
        self._cameras = dataclasses.replace(jax.tree.map(np.asarray, field.cameras), world_to_camera=poses)
        self._rules = QueryRules(all_of_class=True)
        self._votes = jax.tree.map(np.asarray, field.votes)
        self._measured = functools.lru_cache(1024)(self._measure)
        self._objects_of = functools.lru_cache(1024)(self._find_objects)

    def _find_objects(self, phrase: str) -> list[Object]:
        """Finds the objects that a phrase names: those with a region that matches it.

        Where a text is the best name of some of the objects, the others do not count. A phrase such as "handle of the
        mug" names the parts of a thing, if the thing has such parts, and "handle" parts of any thing, if no thing is
        called so.
        """
        listed = self._catalogue
        if (named := split_part(phrase)) and (found := self.find_parts(*named)):
            return found
        if phrase == ANY_OBJECT:
            things = np.flatnonzero(~listed.surroundings).tolist()
            named = [self._object(str(listed.names[n]), n) for n in things]
            return [found for found in named if len(found.rows)]
        texts = choose_shades(self._field, self._embedder, [phrase], self._rules, every=True)
        embedded = self._embedder.embed_text(texts)
        match = match_regions(self._field, embedded, self._rules)
        if int(match.state) < FOUND:  # no thing has that name; parts of things may
            unsure = int(match.region) if int(match.state) > ABSENT else -1
            nodes, state = match_parts(self._field, embedded, self._rules, unless=unsure)
            if len(nodes):
                return [self._part(phrase, int(node), state) for node in nodes]
        regions = np.flatnonzero(np.asarray(match.chosen)) if int(match.region) >= 0 else np.zeros(0, int)
        owners = listed.regions[regions]
        named = set(owners[self._is_best_name(texts, regions)].tolist()) - {-1}
        things = sorted(named or set(owners.tolist()) - {-1})
        found = [self._object(phrase, n, int(match.state)) for n in things]
        return [thing for thing in found if len(thing.rows)]

    def find_parts(self, part: str, whole: str) -> list[Object]:
        """Finds the parts that a text names of each thing that another one names; "part" names all of them.

        There are none where the embedder has no words for either: the text is the name of a thing then.
        """
        field, found = self._field, []
        if field.part_regions is None:
            return []
        name = re.sub(r"(^| )(parts?|pieces?)$", "", part)
        try:
            texts = self._embedder.embed_text([name]) if name else None
            wholes = self._objects_of(whole)
        except InputError:
            return []
        for thing in wholes:
            nodes, state = np.asarray(field.part_nodes)[np.isin(part_objects(field), thing.regions)], thing.state
            if texts is not None:
                nodes, state = match_parts(field, texts, self._rules, thing.regions)
            found += [self._part(f"{part} of {thing.phrase}", int(node), state) for node in nodes]
        return [thing for thing in found if len(thing.rows)]

    def _part(self, phrase: str, node: int, state: int) -> Object:
        """A part of an object as an object of its own."""
        rows = np.flatnonzero(node_members(np.asarray(self._field.tree), np.asarray(self._field.leaf), node))
        shape = source_shapes(self._field, rows, np.zeros(len(rows), int), self._catalogue.up)
        return Object(phrase, (node,), rows, shape, state=state)

    def _object(self, phrase: str, index: int, state: int = FOUND) -> Object:
        """An object of the catalogue by its id."""
        regions, rows, shape = self._measured(index)
        return Object(phrase, regions, rows, shape, sure=bool(self._catalogue.sure[index]), state=state)

    def _measure(self, index: int) -> tuple[tuple[int, ...], np.ndarray, ObjectShapes]:
        """Regions of an object, its Gaussians, and their shape: without its parts, and what stands apart from it."""
        regions = tuple(np.flatnonzero(self._catalogue.regions == index).tolist())
        rows = np.flatnonzero(self._catalogue.mask(index))
        share = inside_fraction_of_regions(votes_of_rows(self._votes, rows), regions).fraction
        rows, share = rows[share >= SHARE_THRESHOLD], share[share >= SHARE_THRESHOLD]
        means, weight = np.asarray(self._field.gaussians.means)[rows], share * self._votes.total[rows]
        rows = rows[remove_outliers(means, np.ones(len(rows), bool), keep="supported", weight=weight)]
        return regions, rows, source_shapes(self._field, rows, np.zeros(len(rows), int), self._catalogue.up)

    def _is_best_name(self, texts: Sequence[str], regions: np.ndarray) -> np.ndarray:
        """Which regions no other name of the vocabulary fits better than the text; all, if there is no vocabulary.

        "Orange" means the orange thing where there is a dark orange one too.
        """
        if len(texts) > 1 or self._names is None:
            return np.ones(len(regions), bool)
        embeddings = np.asarray(self._field.regions.embeddings)[regions]
        similarity = embeddings @ np.asarray(self._embedder.embed_text(list(texts)))[0]
        # A name that is as near within rounding fits no better.
        return similarity >= (embeddings @ self._names.T).max(1) - 1e-4

    @functools.cached_property
    def _names(self) -> np.ndarray | None:
        """(V, E) embeddings of the embedder's vocabulary, if it has one."""
        names = getattr(self._embedder, "vocabulary", ())
        return np.asarray(self._embedder.embed_text(list(names))) if names else None

    def _view(self, frame: int | str | None) -> tuple[Viewpoint, str]:
        """From where directions are seen, and what that is in words.

        Without a frame it is the mean camera, or the frame that shows most objects where the cameras look in all
        directions.
        """
        cameras, up = self._cameras, self._catalogue.up
        if frame is None:
            ahead = np.asarray(cameras.world_to_camera, np.float64)[:, 2, :3]
            ahead = ahead - (ahead @ up)[:, None] * up
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
            mean = ahead.mean(0)
            if np.linalg.norm(mean) >= 0.5:  # they look one way
                middle = np.asarray(cameras.centres, np.float64).mean(0)
                return Viewpoint(middle, mean / np.linalg.norm(mean), up), "as seen from the mean of the cameras"
            pixels = np.asarray(self._field.regions.pixel_counts, np.int64)
            frame = int(np.lexsort((pixels.sum(0), (pixels > 0).sum(0)))[-1])
        index = frame_index(self._field, frame)
        return viewpoint(cameras[index], up), f"as seen from {self._field.names[index]}"

    def answer(self, query: Query) -> Answer:
        """Finds the objects that a referring expression names."""
        expression = parse_expression(str(query))
        metres = self._field.metres_per_unit
        if any(condition.in_metres for condition in expression.conditions) and metres is None:
            problem = "the size of this scene in metres is not known, so no distance in metres can be compared"
            remedy = 'Ask in units of the capture ("within 2 units of"), or run with --metres-per-unit.'
            raise InputError(f"expression {str(query)!r}", problem, remedy=remedy)
        units = 1.0, 1.0 / (metres or 1.0)
        view, words = self._view(query.frame)
        readings = expression.readings()
        outcomes = [find_referents(self._objects_of, expression.thing, reading, view, units) for reading in readings]
        place = next((n for n, outcome in enumerate(outcomes) if outcome.chosen), 0)
        best, others = outcomes[place], outcomes[place + 1 :]
        chosen = {found.regions for found in best.chosen}
        question = ""
        if best.undecided:
            number = f"which of {len(best.chosen)}" if best.undecided is best.chosen else "which"
            places = self._places(best.undecided, view)
            question = f"{number} {expression.thing.text!r} is meant, from left to right at {places}?"
        if not question and any({found.regions for found in other.chosen} not in (set(), chosen) for other in others):
            first, second = expression.conditions
            question = f"is it the {expression.thing.text} or the {first.anchors[-1].text} that is {second}?"
        named = best.chosen
        if named and expression.adds:
            named = with_everything(expression.adds, named, self._objects_of(ANY_OBJECT), view)
        mask = np.zeros(self._field.gaussians.count, bool)
        for found in named:
            mask[found.rows] = True
        region = named[0].regions[0] if len(named) == 1 else -1
        score = named[0].score if named else 0.0
        state = np.asarray(min((found.state for found in [*best.chosen, *best.used]), default=ABSENT), np.int32)
        score = np.asarray(score, np.float32)
        selection = Selection(mask, mask.astype(np.float32), np.asarray(region, np.int32), score, state=state)
        return Answer(
            query=query,
            by="relation",
            mask=mask,
            selection=selection,
            field=self._field,
            count=len(named),
            reason=best.reason,
            objects=tuple(named),
            reading=expression.describe(readings[place]),
            viewpoint=words if expression.depends_on_view else "",
            up=self._up if expression.conditions or expression.thing.order or expression.adds else None,
            used=tuple(best.used),
            question=question,
        )

    def _places(self, objects: Sequence[Object], view: Viewpoint) -> str:
        """Says where objects are, from left to right."""
        ordered = sorted(objects, key=lambda found: order_values(found.shape, view)["leftmost"][0])
        return ", ".join(f"({', '.join(f'{x:.2f}' for x in found.shape.center[0])})" for found in ordered)

    def distances(self, ends: Sequence[Answer | Sequence[float | int]]) -> dict[str, Any]:
        """Distances of what two answers select, or of points, in metres if they are known.

        The angle is that of the second above the horizontal, degrees.
        """
        (points, middle), (others, end) = map(self._extent, ends)
        centers = float(np.linalg.norm(end - middle))
        angle = float(np.degrees(np.arcsin(np.clip((end - middle) @ self._catalogue.up / max(centers, 1e-300), -1, 1))))
        metres = self._field.metres_per_unit
        scale = metres or 1.0
        lengths = scale * np.array([KDTree(points).query(others)[0].min(), centers])
        result: dict[str, Any] = dict(zip(("surfaces", "centers"), rounded(lengths, scale * centers)))
        unit = "capture units" if metres is None else "metres"
        return result | {"angle": round(angle, 2), "unit": unit, "up": str(self._up)}

    def _extent(self, end: Answer | Sequence[float | int]) -> tuple[np.ndarray, np.ndarray]:
        """Points (M, 3) of what an answer selects and the middle (3,) of its upright box; of a point itself."""
        if not isinstance(end, Answer):
            return np.array([end], np.float64), np.asarray(end, np.float64)
        shape = source_shapes(self._field, end.rows, np.zeros(len(end.rows), int), self._catalogue.up)
        return end.points, shape.center[0]
