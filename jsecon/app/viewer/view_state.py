"""The state of the viewer as a value: steps from one state to the next, links, and the colours of a state.

The module knows neither a window nor a field.
"""

import colorsys
import dataclasses
import json
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.errors import InputError, describe_error
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.query.rules import FRAGMENT_SCORE

Colouring: TypeAlias = Literal["photo", "region", "score"]
COLOURINGS: tuple[Colouring, ...] = get_args(Colouring)
"""what the colours of the Gaussians show: the photographs, regions, or how far each belongs to the answers"""
DIM = 0.4
"""brightness of Gaussians outside of all answers, as a share of what it was"""
GREY = 0.6
"""share of their colour that these lose"""
TINT = 0.55
"""share of the answer's colour in the Gaussians of an answer"""
GOLDEN_ANGLE = 0.61803398875
"""difference of neighbouring hues, in turns"""
MAX_QUERIES = 40
"""number of queries that are highlighted at once"""
MAX_SHELLS = 5
"""shells of neighbours that a selection is grown or shrunk by"""
MAX_UNDO = 100
"""number of states that undo goes back"""


@dataclasses.dataclass(frozen=True)
class ViewQuery:
    """One text or region, and the options that select its Gaussians.

    Attributes:
      query: A text, or the id of a region.
      threshold: Smallest share of a selected Gaussian.
      part_vs_whole: 0 selects the best region alone, 1 all regions that overlap it and are nearer to the query than
        most.
      all_matches: Whether to select all regions that match instead of the best one.
      shells: Shells of neighbours that the selection is grown by; below 0 it is shrunk.
    """

    query: str | int
    threshold: float = SHARE_THRESHOLD
    part_vs_whole: float = 1 - FRAGMENT_SCORE
    all_matches: bool = False
    shells: int = 0

    def __post_init__(self) -> None:
        """Raises ValueError for values that the viewer cannot produce, as a link may hold them."""
        query = self.query
        is_text = isinstance(query, str) and query.strip() != ""
        valid = {
            "query": is_text or (isinstance(query, int) and _is_number(query, 0)),
            "threshold": _is_number(self.threshold, 0, 1),
            "part_vs_whole": _is_number(self.part_vs_whole, 0, 1),
            "all_matches": isinstance(self.all_matches, bool),
            "shells": isinstance(self.shells, int) and _is_number(self.shells, -MAX_SHELLS, MAX_SHELLS),
        }
        if invalid := [name for name, fits in valid.items() if not fits]:
            raise ValueError(f"invalid {', '.join(invalid)}")


@dataclasses.dataclass(frozen=True)
class ViewState:
    """What the viewer shows. Two equal states look the same.

    Attributes:
      queries: Texts and clicked regions that are highlighted, in the order of their colours.
      threshold: As in `ViewQuery`.
      part_vs_whole: As in `ViewQuery`.
      all_matches: As in `ViewQuery`.
      colouring: What the colours of the Gaussians show.
      isolated: If any, only their Gaussians are visible.
      hidden: Queries whose Gaussians are invisible.
      camera: In a link, position, point looked at and up direction, nine numbers in the field's world; else empty.
      shells: As in `ViewQuery`.
    """

    queries: tuple[str | int, ...] = ()
    threshold: float = ViewQuery.threshold
    part_vs_whole: float = ViewQuery.part_vs_whole
    all_matches: bool = False
    colouring: Colouring = "photo"
    isolated: tuple[ViewQuery, ...] = ()
    hidden: tuple[ViewQuery, ...] = ()
    camera: tuple[float, ...] = ()
    shells: int = 0

    @property
    def view_queries(self) -> tuple[ViewQuery, ...]:
        """The highlighted queries with their options."""
        options = self.threshold, self.part_vs_whole, self.all_matches, self.shells
        return tuple(ViewQuery(query, *options) for query in self.queries)

    @property
    def text_line(self) -> str:
        """The highlighted texts, separated by semicolons."""
        return "; ".join(query for query in self.queries if isinstance(query, str))

    @property
    def link(self) -> str:
        """The state as one line of JSON, without fields at their defaults."""
        default = ViewState()
        fields = {name: value for name, value in dataclasses.asdict(self).items() if value != getattr(default, name)}
        return json.dumps(fields, ensure_ascii=False, separators=(",", ":"))

    def with_texts(self, line: str) -> "ViewState":
        """Highlights texts in place of what is highlighted.

        Args:
          line: The texts, separated by semicolons. Each counts once.

        Returns:
          The next state.
        """
        texts = dict.fromkeys(text.strip() for text in line.split(";") if text.strip())
        return dataclasses.replace(self, queries=tuple(texts)[:MAX_QUERIES])

    def toggle_region(self, region: int, *, add: bool = False) -> "ViewState":
        """Highlights a region, or removes it where it is highlighted.

        Args:
          region: Id of the region.
          add: Whether the other queries stay.

        Returns:
          The next state.
        """
        others = tuple(query for query in self.queries if query != region) if add else ()
        remove = region in self.queries if add else self.queries == (region,)
        return dataclasses.replace(self, queries=others if remove else (*others, region)[-MAX_QUERIES:])

    def replace_match(self, place: int, region: int) -> "ViewState":
        """Highlights a region in place of a query.

        Args:
          place: Index of the query.
          region: Id of the region.

        Returns:
          The next state.
        """
        queries = dict.fromkeys((*self.queries[:place], region, *self.queries[place + 1 :]))
        return dataclasses.replace(self, queries=tuple(queries))

    def with_controls(self, **controls: Any) -> "ViewState":
        """Sets controls.

        Args:
          **controls: Fields of the state; threshold and part_vs_whole are clipped to 0 .. 1.

        Returns:
          The next state.
        """
        for name in ("threshold", "part_vs_whole"):
            if name in controls:
                controls[name] = round(min(max(float(controls[name]), 0.0), 1.0), 3)
        return dataclasses.replace(self, **controls)

    def isolate(self) -> "ViewState":
        """Shows only the highlighted Gaussians.

        Returns:
          The next state: the same one if no query is highlighted.
        """
        return dataclasses.replace(self, isolated=self.view_queries) if self.queries else self

    def hide(self) -> "ViewState":
        """Hides the highlighted Gaussians.

        Returns:
          The next state, without highlighted queries.
        """
        hidden = dict.fromkeys((*self.hidden, *self.view_queries))
        return dataclasses.replace(self, queries=(), hidden=tuple(hidden)[-MAX_QUERIES:])

    def show_all(self) -> "ViewState":
        """Shows all Gaussians again.

        Returns:
          The next state.
        """
        return dataclasses.replace(self, isolated=(), hidden=())


@dataclasses.dataclass(frozen=True)
class History:
    """A state and those before it.

    Attributes:
      state: The present state.
      past: Earlier states, the last one last.
    """

    state: ViewState = dataclasses.field(default_factory=ViewState)
    past: tuple[ViewState, ...] = ()

    def then(self, state: ViewState) -> "History":
        """Adds a state. All moves of one slider in a row count as one step.

        Args:
          state: The next state.

        Returns:
          The history with that state as the present one.
        """
        if state == self.state:
            return self
        changed = _differences(self.state, state)
        is_slider = changed in ({"threshold"}, {"part_vs_whole"}, {"shells"})
        if is_slider and self.past and _differences(self.past[-1], state) == changed:
            return History(state, self.past)
        return History(state, (*self.past, self.state)[-MAX_UNDO:])

    def back(self) -> "History":
        """Takes the last step back.

        Returns:
          The history before that step; the same one if there is none.
        """
        return History(self.past[-1], self.past[:-1]) if self.past else self


def _differences(one: ViewState, other: ViewState) -> set[str]:
    """Returns the names of the fields that differ."""
    names = [field.name for field in dataclasses.fields(ViewState)]
    return {name for name in names if getattr(one, name) != getattr(other, name)}


def from_link(link: str) -> ViewState:
    """Reads a link.

    Args:
      link: What `ViewState.link` wrote.

    Returns:
      The state.

    Raises:
      InputError: The line is not one of a viewer.
    """
    try:
        content = json.loads(link)
        fields: dict[str, Any] = {n: tuple(value) if isinstance(value, list) else value for n, value in content.items()}
        for name in {"isolated", "hidden"} & set(fields):
            fields[name] = tuple(ViewQuery(**query) for query in fields[name])
        state = ViewState(**fields)
        dataclasses.replace(state, queries=(*state.queries, 0)).view_queries  # noqa: B018 (checks the queries)
        valid = {
            "queries": isinstance(state.queries, tuple),
            "number of queries": max(len(state.queries), len(state.isolated), len(state.hidden)) <= MAX_QUERIES,
            "colouring": state.colouring in COLOURINGS,
            "camera": len(state.camera) in (0, 9) and all(map(_is_number, state.camera)),
        }
        if invalid := [name for name, fits in valid.items() if not fits]:
            raise ValueError(f"invalid {', '.join(invalid)}")
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        problem = f"{link[:60]!r} is not a line of the viewer ({describe_error(error)})"
        raise InputError("link", problem, remedy="Copy the whole line.") from error
    return state


def _is_number(value: Any, low: float | int = -1e9, high: float | int = 1e9) -> bool:
    """Whether a value is a number within bounds, and not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def answer_colours(count: int) -> UInt8[np.ndarray, "k 3"]:
    """Chooses the colours of answers: strong hues, a golden angle apart.

    Args:
      count: Number of answers K.

    Returns:
      RGB of answers 0 .. K-1, each of which does not depend on `count`.
    """
    hues = (0.91 + GOLDEN_ANGLE * np.arange(count)) % 1.0
    return (255 * np.array([colorsys.hls_to_rgb(h, 0.6, 1.0) for h in hues]).reshape(count, 3)).astype(np.uint8)


def highlight(
    base: UInt8[np.ndarray, "n 3"],
    masks: Sequence[Bool[np.ndarray, " n"]],
    similarities: Sequence[Float[np.ndarray, " n"]],
) -> UInt8[np.ndarray, "n 3"]:
    """Tints the Gaussians of each answer in its colour, and dims the others.

    Args:
      base: RGB of the Gaussians.
      masks: Mask of each answer. Without answers the colours stay.
      similarities: Similarity of each Gaussian with each answer. A Gaussian of several answers has the colour of the
        most similar one.

    Returns:
      (N, 3) RGB.
    """
    if not masks:
        return base
    colours = (DIM * (1 - GREY) * base + DIM * GREY * base.mean(1, keepdims=True, dtype=np.float32)).astype(np.uint8)
    best = np.full(len(base), -np.inf, np.float32)
    for mask, similarity, tint in zip(masks, similarities, answer_colours(len(masks)), strict=True):
        rows = np.flatnonzero(mask & (np.nan_to_num(similarity) > best))
        best[rows] = similarity[rows]
        colours[rows] = ((1 - TINT) * base[rows] + TINT * tint).astype(np.uint8)
    return colours


def score_colours(similarities: Sequence[Float[np.ndarray, " n"]], count: int) -> UInt8[np.ndarray, "n 3"]:
    """Colours the Gaussians by how far they belong to the answers.

    Args:
      similarities: Similarity of each Gaussian with each answer, 0 to 1.
      count: Number of Gaussians N.

    Returns:
      (N, 3) RGB of the largest similarity: dark blue 0, red 0.5, pale yellow 1; grey without answers.
    """
    if not similarities:
        return np.full((count, 3), 110, np.uint8)
    largest = np.nan_to_num(np.max(similarities, axis=0))
    stops = np.array([[18, 20, 60], [90, 24, 120], [205, 50, 70], [250, 150, 40], [252, 250, 190]], np.float32)
    table = np.stack([np.interp(np.linspace(0, 1, 256), np.linspace(0, 1, 5), c) for c in stops.T], 1)
    return table.astype(np.uint8)[(255 * np.clip(largest, 0, 1)).astype(np.uint8)]
