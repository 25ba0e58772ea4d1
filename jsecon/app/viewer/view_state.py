"""What a viewer shows of a field, as a value: a state, what leads from one to the next, and the colours that follow.

No window and no field: app/viewer has both.
"""

import colorsys
import dataclasses
import json
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.errors import InputError, describe_error
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.query.match import PIECE_THRESHOLD

Paint: TypeAlias = Literal["photo", "code", "region", "score"]
PAINTS: tuple[Paint, ...] = get_args(Paint)
"""what the Gaussians' colours say: the photographs, the codes, the regions, how far each belongs to the answers"""
DIM, GREY = 0.4, 0.6
"""of what no answer lights up: how bright it stays, and how much of its colour goes"""
TINT = 0.55
"""of an answer's own colour in what it lights up"""
MOST = 40
"""things asked for at once, and texts' length in a link times a hundred"""


@dataclasses.dataclass(frozen=True)
class Ask:
    """One thing that is asked for, and how."""

    thing: str | int
    """a text, or a region."""
    threshold: float = SHARE_THRESHOLD
    """least share of a Gaussian."""
    whole: float = 1 - PIECE_THRESHOLD
    """0: a part alone, the best region; 1: all that overlaps it and is nearer to what was asked than most."""
    every: bool = False
    """all regions that answer, not only the best."""


@dataclasses.dataclass(frozen=True)
class ViewState:
    """What is seen. Two equal states look the same."""

    things: tuple[str | int, ...] = ()
    """what is lit up, in the order of its colours: texts, and regions that were clicked."""
    threshold: float = Ask.threshold
    whole: float = Ask.whole
    every: bool = False
    paint: Paint = "photo"
    only: tuple[Ask, ...] = ()
    """if any, all else is gone."""
    hidden: tuple[Ask, ...] = ()
    """what is gone."""
    camera: tuple[float, ...] = ()
    """in a link: position, the point looked at, upwards, nine numbers in the field's world; empty: as it is."""

    @property
    def asks(self) -> tuple[Ask, ...]:
        """What is lit up, with how it is asked."""
        return tuple(Ask(thing, self.threshold, self.whole, self.every) for thing in self.things)


def asked(state: ViewState, line: str) -> ViewState:
    """Lights up what the texts of a line name, between semicolons, each once; nothing for none."""
    said = dict.fromkeys(text.strip() for text in line.split(";") if text.strip())
    return dataclasses.replace(state, things=tuple(said)[:MOST])


def line_of(state: ViewState) -> str:
    """The line that asks for the texts of a state."""
    return "; ".join(thing for thing in state.things if isinstance(thing, str))


def clicked(state: ViewState, region: int, *, more: bool = False) -> ViewState:
    """Lights up a region alone, or with `more` beside what is lit up; a second time takes it away."""
    rest = tuple(thing for thing in state.things if thing != region) if more else ()
    taken_away = region in state.things if more else state.things == (region,)
    return dataclasses.replace(state, things=rest if taken_away else (*rest, region)[-MOST:])


def instead(state: ViewState, place: int, region: int) -> ViewState:
    """A region in place of the thing that is lit up in the colour `place`."""
    things = dict.fromkeys((*state.things[:place], region, *state.things[place + 1 :]))
    return dataclasses.replace(state, things=tuple(things))


def moved(state: ViewState, **controls: Any) -> ViewState:
    """The state with threshold and whole (0 to 1), every or paint as given."""
    for name in ("threshold", "whole"):
        if name in controls:
            controls[name] = round(min(max(float(controls[name]), 0.0), 1.0), 3)
    return dataclasses.replace(state, **controls)


def shown_only(state: ViewState) -> ViewState:
    """What is lit up and nothing else; as it is where nothing is lit up."""
    return dataclasses.replace(state, only=state.asks) if state.things else state


def hidden(state: ViewState) -> ViewState:
    """Without what is lit up."""
    gone = dict.fromkeys((*state.hidden, *state.asks))
    return dataclasses.replace(state, things=(), hidden=tuple(gone)[-MOST:])


def all_shown(state: ViewState) -> ViewState:
    """Nothing is gone any more."""
    return dataclasses.replace(state, only=(), hidden=())


@dataclasses.dataclass(frozen=True)
class History:
    """A state and those before it, to go back to."""

    state: ViewState = dataclasses.field(default_factory=ViewState)
    past: tuple[ViewState, ...] = ()

    LENGTH = 100

    def then(self, state: ViewState) -> "History":
        """The next state. One that looks the same adds nothing, and a control that moves on takes the place of where
        it was, so that going back leads to before it was touched."""
        if state == self.state:
            return self
        changed = _differing(self.state, state)
        sliding = changed in ({"threshold"}, {"whole"}) and self.past and _differing(self.past[-1], state) == changed
        return History(state, self.past if sliding else (*self.past, self.state)[-self.LENGTH :])

    def back(self) -> "History":
        """The state before; the first where there is none."""
        return History(self.past[-1], self.past[:-1]) if self.past else self


def _differing(one: ViewState, other: ViewState) -> set[str]:
    names = [field.name for field in dataclasses.fields(ViewState)]
    return {name for name in names if getattr(one, name) != getattr(other, name)}


def link_of(state: ViewState) -> str:
    """The state as one line of JSON, what is as usual left out."""
    usual = ViewState()
    changed = {n: v for n, v in dataclasses.asdict(state).items() if v != getattr(usual, n)}
    return json.dumps(changed, ensure_ascii=False, separators=(",", ":"))


def state_of(link: str) -> ViewState:
    """The state that `link_of` wrote. Raises InputError for anything else."""
    try:
        if not isinstance(told := json.loads(link), dict):
            raise ValueError("no JSON object")
        told |= {name: tuple(value) for name, value in told.items() if isinstance(value, list)}
        told |= {name: tuple(_ask(**ask) for ask in told[name]) for name in ("only", "hidden") if name in told}
        state = ViewState(**told)
        _require_kinds(state)
    except (ValueError, TypeError, RecursionError) as error:
        found = f"{link[:60]!r} is not a line that a viewer gave ({describe_error(error)})"
        raise InputError("link", found, remedy="Copy the whole line.") from error
    return state


def _ask(**given: Any) -> Ask:
    ask = Ask(**given)
    _require_kinds(ViewState((ask.thing,), ask.threshold, ask.whole, ask.every))
    return ask


def _require_kinds(state: ViewState) -> None:
    """Raises ValueError where a value is none that a viewer gives."""
    whole = lambda value: isinstance(value, int) and not isinstance(value, bool)
    number = lambda value: isinstance(value, float) or whole(value)
    text = lambda value: isinstance(value, str) and len(value.strip()) > 0 and len(value) <= 100 * MOST
    thing = lambda value: text(value) or (whole(value) and value >= 0)
    fits = {
        "things": isinstance(state.things, tuple) and all(map(thing, state.things)),
        "as many as can be shown": max(len(state.things), len(state.only), len(state.hidden)) <= MOST,
        "threshold": number(state.threshold) and 0 <= state.threshold <= 1,
        "whole": number(state.whole) and 0 <= state.whole <= 1,
        "every": isinstance(state.every, bool),
        "paint": state.paint in PAINTS,
        "camera": len(state.camera) in (0, 9) and all(number(x) and abs(x) < 1e9 for x in state.camera),
    }
    if wrong := [name for name, fit in fits.items() if not fit]:
        raise ValueError(f"not as it should be: {', '.join(wrong)}")


def tints(count: int) -> UInt8[np.ndarray, "k 3"]:
    """RGB of answers 0 .. count-1: strong hues, a golden angle apart; kept as count grows."""
    hues = (0.91 + 0.61803398875 * np.arange(count)) % 1.0
    return (255 * np.array([colorsys.hls_to_rgb(h, 0.6, 1.0) for h in hues]).reshape(count, 3)).astype(np.uint8)


def shown(
    count: int, only: Sequence[Bool[np.ndarray, " n"]], hidden: Sequence[Bool[np.ndarray, " n"]]
) -> Bool[np.ndarray, " n"]:
    """(N,) which of `count` Gaussians are seen: those in any of `only`, if there are any, and in none of `hidden`."""
    seen = np.any(only, axis=0) if len(only) else np.ones(count, bool)
    return seen & ~np.any(hidden, axis=0) if len(hidden) else seen


def lit(
    base: UInt8[np.ndarray, "n 3"],
    masks: Sequence[Bool[np.ndarray, " n"]],
    similarities: Sequence[Float[np.ndarray, " n"]],
) -> UInt8[np.ndarray, "n 3"]:
    """(N, 3) RGB: `base` where there is no answer; else each answer's Gaussians in its colour, one that several light
    up in that of the answer that it is most similar to, and the rest dim and grey."""
    if not masks:
        return base
    result = (DIM * (1 - GREY) * base + DIM * GREY * base.mean(1, keepdims=True, dtype=np.float32)).astype(np.uint8)
    nearest = np.full(len(base), -np.inf, np.float32)
    for mask, similarity, tint in zip(masks, similarities, tints(len(masks)), strict=True):
        rows = np.flatnonzero(mask & (np.nan_to_num(similarity) > nearest))
        nearest[rows] = similarity[rows]
        result[rows] = ((1 - TINT) * base[rows] + TINT * tint).astype(np.uint8)
    return result


def scored(similarities: Sequence[Float[np.ndarray, " n"]], count: int) -> UInt8[np.ndarray, "n 3"]:
    """(N, 3) RGB of how far each Gaussian belongs to any answer: dark blue 0, red 0.5, pale yellow 1; grey without an
    answer."""
    if not similarities:
        return np.full((count, 3), 110, np.uint8)
    most = np.nan_to_num(np.max(similarities, axis=0))
    stops = np.array([[18, 20, 60], [90, 24, 120], [205, 50, 70], [250, 150, 40], [252, 250, 190]], np.float32)
    table = np.stack([np.interp(np.linspace(0, 1, 256), np.linspace(0, 1, 5), c) for c in stops.T], 1)
    return table.astype(np.uint8)[(255 * np.clip(most, 0, 1)).astype(np.uint8)]
