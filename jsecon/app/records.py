"""The records of asking: what a question is (`Query`), and what comes back (`Answer`).

A question is a text, or one of four small records: `At` (a pixel), `Box`, `Mask` and `Region`. Every door of jsecon
gives it to `Scene.ask`, and shows the `Answer`: its words (`str`), its record (`as_dict`), its place.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, require_one_of
from jsecon.files import parse_json, scratch_array
from jsecon.query.object_shapes import ObjectShapes, gaussian_spreads, object_shapes
from jsecon.query.referring import Object
from jsecon.query.rules import ABSENT, FOUND, STATES, UNSURE
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Gaussians, LanguageField, Selection, UpAxis

METHODS = ("votes", "code")
"""how a region selects Gaussians: by their votes, or by their codes (the paper)"""


@dataclasses.dataclass(frozen=True)
class At:
    """The pixel in column x and row y of a frame: selects the region that lies there."""

    frame: int | str
    """name or index of the frame; "#10" is an index too"""
    x: int | float
    """column, px; or if x and y are from 0 to 1 and not both integers, a share of the width"""
    y: int | float


@dataclasses.dataclass(frozen=True)
class Box:
    """A box in a frame, its last column and row included: selects the regions that are seen by more than half in it."""

    frame: int | str
    x0: int
    y0: int
    x1: int
    y1: int


@dataclasses.dataclass(frozen=True, eq=False)
class Mask:
    """One object, outlined in one frame or several."""

    frames: Mapping[Any, np.ndarray]
    """frame -> (H, W) bool at the size of the field's frames"""


@dataclasses.dataclass(frozen=True)
class Region:
    """A region of the field by its id."""

    id: int


Question: TypeAlias = str | At | Box | Mask | Region


@dataclasses.dataclass(frozen=True)
class Query:
    """A question and how it is answered. Equal queries of one scene have equal answers.

    A text with a word of place, an order or a number is read by its own words: `frame` is for these texts alone, and
    the other options are for all other questions.

    Attributes:
      question: A text, `At`, `Box`, `Mask` or `Region`. A text may be composite: `"red mug" or "bowl" but not
        "handle"`; or tell things apart: "the red mug left of the bottle", "the second largest box". Words in quotes
        are searched for as they stand.
      by: How a region selects Gaussians, "votes" or "code".
      threshold: Smallest similarity of a selected Gaussian; None takes 0.5 for votes and 0.9 for codes.
      min_rank: Share of unrelated words that must be less similar to the scene than a text, else it is absent; 0
        selects the best match of every text. None judges by its margin among these words (`jsecon.query.rules`).
      outliers: Whether to drop the Gaussians that stand apart from the rest.
      frame: Frame from which left, right, front and behind are seen. None takes the mean camera, or the frame that
        shows most objects where the cameras look in all directions.

    Raises:
      InputError: A number is out of its range, or a box or mask is to be answered by codes.
      ValueError: `by` is unknown.
    """

    question: Question
    by: str = "votes"
    threshold: float | int | None = None
    min_rank: float | int | None = None
    outliers: bool = True
    frame: int | str | None = None

    def __post_init__(self) -> None:
        """Refuses numbers out of their ranges."""
        require_one_of("query", self.by, METHODS, "'votes' is the default.")
        numbers = {"threshold": (self.threshold, -1 if self.by == "code" else 0), "min_rank": (self.min_rank, 0)}
        for name, (value, least) in numbers.items():
            if value is not None and not least <= value <= 1:
                expected = f"a number from {least} to 1"
                raise InputError(name, f"{value:g}", expected, f"Leave {name} out for the default.")
        if isinstance(self.question, Box | Mask) and self.by != "votes":
            problem = "a mask or a box selects by the outline alone"
            raise InputError("by", problem, remedy="Leave it out, or ask a text.")

    def __str__(self) -> str:
        """The text, or the name of a pixel, box, mask or region."""
        question = self.question
        if isinstance(question, str):
            return question
        if isinstance(question, Mask):
            return f"mask {next(iter(question.frames), '')}"
        return " ".join(map(str, (type(question).__name__.lower(), *vars(question).values())))


@dataclasses.dataclass(frozen=True, eq=False)
class Answer:
    """What a query selects of a field of N Gaussians. `str` of it is the line that the command line prints.

    Attributes:
      query: The query, of a pixel with the name of its frame.
      by: "votes" or "code"; "outline" for a box or masks; "relation" for a text that tells things apart; "history" for
        what moved, is gone or is new.
      mask: (N,) bool, the selected Gaussians, without outliers.
      selection: The Gaussians before outliers were dropped, with similarity, best region (-1 for none) and score.
      field: The field.
      count: Number of separate objects: 0 if nothing is selected, and 1 where the selection does not tell.
      reason: Why nothing is selected, or not the number that the text says; "" if there is nothing to say.
      objects: With by="relation", the objects that the text names, best first.
      reading: With by="relation", how the text was read; else "".
      viewpoint: From where directions were seen; "" if nothing depends on it.
      used: The objects that `objects` were compared with.
      question: What would settle which object is meant; "" if nothing has to be.
      up: Which way was up in the field's world, if the text has a relation or an order.
    """

    query: Query
    by: str
    mask: np.ndarray = dataclasses.field(repr=False)
    selection: Selection = dataclasses.field(repr=False)
    field: LanguageField = dataclasses.field(repr=False)
    count: int = 1
    reason: str = ""
    objects: tuple[Object, ...] = ()
    reading: str = ""
    viewpoint: str = ""
    used: tuple[Object, ...] = ()
    question: str = ""
    up: UpAxis | None = None

    @functools.cached_property
    def rows(self) -> np.ndarray:
        """(M,) ids of the selected Gaussians, rising."""
        return np.flatnonzero(self.mask)

    @functools.cached_property
    def points(self) -> Float[np.ndarray, "m 3"]:
        """(M, 3) float64 centres of the selected Gaussians in the capture's world."""
        return source_points(self.field, np.asarray(self.field.gaussians.means)[self.rows])

    @functools.cached_property
    def place(self) -> ObjectShapes:
        """Oriented box, box along the axes and points of the selection, in the capture's world and its unit.

        `center` is the middle of the oriented box. It lies nearer to the middle of a thing that is seen from one side
        than the mean of the points: views from above see more of its top.

        Raises:
          InputError: No Gaussian is selected.
        """
        if not len(self.rows):
            problem = self.reason or f"no Gaussian is selected (score {float(self.selection.score):.3f})"
            raise InputError(f"query {str(self.query)!r}", problem, remedy="Ask with other words, or by a pixel.")
        return source_shapes(self.field, self.rows, np.zeros(len(self.rows), int))[0]

    @property
    def state(self) -> str:
        """Whether the scene has what the query names.

        "found"; "unsure", where the best match is selected and what the text names may be absent; or "absent", where no
        Gaussian is selected.
        """
        state = FOUND if self.selection.state is None else int(self.selection.state)
        return STATES[state if len(self.rows) else ABSENT]

    def as_dict(self) -> dict[str, Any]:
        """The record of the answer as plain values for JSON, in the capture's world: the same at every door."""
        region, selected = int(self.selection.region), int(np.asarray(self.selection.mask).sum())
        record = {
            "query": str(self.query),
            "state": self.state,
            "by": self.by,
            "count": len(self.rows),
            "gaussians": self.field.gaussians.count,
            "objects": self.count,
            "score": round(float(self.selection.score), 6),
            "rank": _known(self.selection.rank),
            "region": region if region >= 0 else None,
            "outliers": {"dropped": selected - len(self.rows), "selected": selected},
            "place": self._place_record() if len(self.rows) else None,
            "reason": self.reason,
            **world_record(self.field),
            "frame_size": [self.field.cameras.width, self.field.cameras.height],
        }
        if self.by != "relation":
            return record
        relation: dict[str, Any] = {name: getattr(self, name) for name in ("reading", "viewpoint", "question")}
        relation["up"] = None if self.up is None else dataclasses.asdict(source_up(self.field, self.up))
        for name in ("objects", "used"):
            relation[name] = [self._object_record(found) for found in getattr(self, name)]
        return record | {"relation": relation}

    def _place_record(self) -> dict[str, Any]:
        """The place as plain values: mean and box of the centres, and the oriented box."""
        low, high = self.points.min(0), self.points.max(0)
        size = float(np.linalg.norm(high - low))
        oriented = {"center": self.place.center, "extent": 2 * self.place.half_size}
        return {
            "centroid": rounded(self.points.mean(0), size),
            "bounding_box": {"min": rounded(low, size), "max": rounded(high, size)},
            **{name: rounded(values, size) for name, values in oriented.items()},
            "axes": np.round(self.place.axes, 6).tolist(),
        }

    def _object_record(self, found: Object) -> dict[str, Any]:
        """An object as plain values."""
        size = 2 * found.shape.half_size[0]
        length = float(np.linalg.norm(size))
        return {
            "phrase": found.phrase,
            "regions": list(found.regions),
            "gaussians": len(found.rows),
            "center": rounded(found.shape.center[0], length),
            "size": rounded(size, length),
            "score": round(found.score, 4),
            "sure": found.sure,
            "conditions": found.conditions,
        }

    def describe(self) -> str:
        """The answer in words, without the query's name: what was read, counts, score and place."""
        if self.by == "relation":
            names = ", ".join(sorted({found.phrase for found in self.objects}))
            number = _number(sum(found.sure for found in self.objects), self.count) + (f" ({names})" if names else "")
            seen = f", {self.viewpoint}" if self.viewpoint else ""
            up = "" if self.up is None else f"up is from {self.up}"
            sentences = [f"read as {self.reading}{seen}: {number}", self.reason.rstrip("."), up, self.question]
            return ". ".join(filter(None, [*sentences, self._counts()]))
        return ", ".join([self.reason, self._counts()]) if self.by == "history" else self._counts()

    def _counts(self) -> str:
        """Counts, score and place, separated by commas."""
        region = int(self.selection.region)
        parts = [f"{len(self.rows)} of {self.field.gaussians.count} Gaussians"]
        parts += [f"{self.count} objects"] if self.count > 1 else []
        if self.by not in ("relation", "history"):
            parts.append(f"score {float(self.selection.score):.3f}")
            if (rank := _known(self.selection.rank)) is not None:
                parts.append(f"more similar than {int(100 * rank + 1e-6)} % of unrelated words")
        if self.state == STATES[UNSURE]:
            parts.append("unsure: it may be absent")
        if region >= 0:
            parts.append(f"region {region}")
        elif self.by in METHODS:
            parts.append(self.reason or "no region matches it")
        if isinstance(self.query.question, At | Box):
            parts.append(f"in frames of {self.field.cameras.width}x{self.field.cameras.height} px")
        if not len(self.rows):
            return ", ".join([*parts, "no Gaussian is selected"])
        digits = decimals(float(np.linalg.norm(np.ptp(self.points, axis=0))), 0.01)
        centroid = ", ".join(f"{coordinate:.{digits}f}" for coordinate in self.points.mean(0))
        return ", ".join([*parts, f"around ({centroid})"])

    def __str__(self) -> str:
        """The line that the command line prints."""
        return f"{str(self.query)!r}: {self.describe()}"


def _number(sure: int, count: int) -> str:
    """Says how many objects there are, of which some are sure: "3 objects, perhaps 4"."""
    words = [f"{n} object{'s' * (n != 1)}" for n in (sure, count)]
    if sure == count:
        return words[0]
    return f"{words[0]}, perhaps {count}" if sure else f"perhaps {words[1]}"


def _known(value: Any) -> float | None:
    """A number to four digits; None for None and NaN."""
    return None if value is None or np.isnan(value) else round(float(value), 4)


def source_points(field: LanguageField, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Moves points of the field's world to the capture's, in float64."""
    source_from_scene = np.asarray(field.source_from_scene, np.float64)
    return points.astype(np.float64) @ source_from_scene[:3, :3].T + source_from_scene[:3, 3]


def source_up(field: LanguageField, up: UpAxis) -> UpAxis:
    """Turns an up axis of the field's world into the capture's."""
    turn = np.asarray(field.source_from_scene, np.float64)[:3, :3]
    axis = turn @ np.array(up.axis) / np.cbrt(abs(np.linalg.det(turn)))
    return dataclasses.replace(up, axis=tuple(axis.round(6).tolist()))


def world_record(field: LanguageField) -> dict[str, Any]:
    """Describes the capture's world: its unit and, if a point cloud named one, its reference system."""
    scale, crs = field.metres_per_unit, parse_json(field.provenance or "{}").get("crs", "")
    unit = "capture units" if scale is None else "metres" if scale == 1 else f"capture units of {scale:g} metres"
    offset = np.asarray(field.source_from_scene, np.float64)[:3, 3].tolist()
    return {"unit": unit} | ({"crs": crs, "offset": offset} if crs else {})


def source_shapes(
    field: LanguageField, rows: np.ndarray, labels: np.ndarray, up: np.ndarray | None = None
) -> ObjectShapes:
    """Measures objects in the capture's world: `labels` are those of the Gaussians `rows` (`object_shapes`)."""
    plain = dataclasses.replace(field.gaussians, sh=None)  # shapes have no colours
    chosen = gaussian_rows(plain, rows)
    spreads = gaussian_spreads(transform_gaussians(chosen, field.source_from_scene))
    return object_shapes(source_points(field, np.asarray(chosen.means)), labels, up, spreads=spreads)


def gaussian_rows(gaussians: Gaussians, ids: Int[np.ndarray, " m"]) -> Gaussians:
    """Takes some of the Gaussians as NumPy arrays (`scratch_array`)."""

    def take(column: Any) -> np.ndarray:
        column = np.asarray(column)
        out = scratch_array((len(ids), *column.shape[1:]), column.dtype)
        return np.take(column, ids, axis=0, out=out, mode="clip")  # other modes copy

    return jax.tree.map(take, gaussians)


def decimals(size: float, part: float) -> int:
    """Decimals that show differences of `part` of a thing's size; 6 for a size of 0 or one that is not finite."""
    return max(0, math.ceil(-math.log10(size * part))) if size > 0 and math.isfinite(size) else 6


def rounded(values: np.ndarray, size: float) -> list[float]:
    """Rounds coordinates of a thing to a millionth of its size, with six decimals or more."""
    return np.round(np.asarray(values, np.float64), max(6, decimals(size, 1e-6))).tolist()
