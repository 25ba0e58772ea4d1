"""The history of a field: changes applied to it, and the field as it was at an earlier date. Pure functions.

A change replaces columns of some Gaussians and regions, and its event keeps what it replaced. So the field as of a date
is had by putting back the events after it, the last first, to the bit. What is gone becomes transparent, and neither
its Gaussians nor its regions answer a query; what is new has Gaussians and a region of its own, with the next ids.
"""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import InputError
from jsecon.field.ledger import Ledger, LedgerView, add_views
from jsecon.files import parse_json
from jsecon.query.render import HIDDEN_LOGIT
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Event, Gaussians, LanguageField

_QUESTION = re.compile(
    r"(?:what|which (?:things?|objects?))(?:'s| has| have| is| are| was| were)?"
    r" (moved|gone|missing|disappeared|removed|new|added|appeared|changed)\s*\??",
    re.IGNORECASE,
)
_KINDS = {"moved": "moved", "changed": ""} | dict.fromkeys(("new", "added", "appeared"), "new")
_KINDS |= dict.fromkeys(("gone", "missing", "disappeared", "removed"), "gone")


def change_question(text: str) -> str | None:
    """The kind of event that a question such as "what moved" asks for, "" for any; None for another text."""
    match = _QUESTION.fullmatch(text.strip())
    return None if match is None else _KINDS[match[1].lower()]


def _patched(field: LanguageField, event: Event) -> LanguageField:
    """Puts the columns of an event into a field."""

    def put(column, rows, values):
        column = np.array(column)
        column[np.asarray(rows)] = values
        return column

    gaussians = jax.tree.map(lambda a, b: put(a, event.rows, b), field.gaussians, event.gaussians)
    votes = dataclasses.replace(field.votes, views=put(field.votes.views, event.rows, event.views))
    embeddings = put(field.regions.embeddings, event.regions, event.embeddings)
    regions = dataclasses.replace(field.regions, embeddings=embeddings)
    return dataclasses.replace(field, gaussians=gaussians, votes=votes, regions=regions)


def _event(field: LanguageField, rows: np.ndarray, regions: np.ndarray, description: dict[str, Any]) -> Event:
    """The event that puts a field's columns back."""
    return Event(
        rows=rows.astype(np.int32),
        gaussians=jax.tree.map(lambda a: np.asarray(a)[rows], field.gaussians),
        views=np.asarray(field.votes.views)[rows],
        regions=regions.astype(np.int32),
        embeddings=np.asarray(field.regions.embeddings)[regions],
        description=json.dumps(description, sort_keys=True),
    )


def _remembered(field: LanguageField, event: Event, new: Event) -> LanguageField:
    """A field after the columns of `new`, with `event` in its history."""
    return dataclasses.replace(_patched(field, new), history=(*field.history, event))


def move_object(
    field: LanguageField, mask: Bool[np.ndarray, " n"], motion: Float[np.ndarray, "4 4"], description: dict[str, Any]
) -> LanguageField:
    """Moves Gaussians rigidly, in the field's world."""
    event = _event(field, np.flatnonzero(mask), np.zeros(0, int), description)
    moved = transform_gaussians(event.gaussians, motion)
    moved = jax.tree.map(lambda a, b: np.asarray(a, b.dtype), moved, event.gaussians)
    return _remembered(field, event, dataclasses.replace(event, gaussians=moved))


def remove_object(
    field: LanguageField, mask: Bool[np.ndarray, " n"], regions: Sequence[int], description: dict[str, Any]
) -> LanguageField:
    """Makes Gaussians and regions absent: transparent, never seen, without embedding. The history keeps them."""
    event = _event(field, np.flatnonzero(mask), np.asarray(regions, int), description)
    logits = np.full_like(event.gaussians.opacity_logits, HIDDEN_LOGIT)
    hidden = dataclasses.replace(event.gaussians, opacity_logits=logits)
    zeros = np.zeros_like(event.views), np.zeros_like(event.embeddings)
    new = dataclasses.replace(event, gaussians=hidden, views=zeros[0], embeddings=zeros[1])
    return _remembered(field, event, new)


def add_unseen(field: LanguageField, things: Sequence[Gaussians]) -> LanguageField:
    """Adds Gaussians that no view has seen behind those of a field; all others stay as they are, to the bit."""
    gaussians = jax.tree.map(lambda *columns: np.concatenate(columns), field.gaussians, *things)
    more = gaussians.count - field.gaussians.count

    def longer(column, value=0):
        return np.concatenate([column, np.full((more, *np.shape(column)[1:]), value, column.dtype)])

    rows = "weights", "labelled", "total", "max_pixel_weight", "views", "weight_where_region_visible"
    columns = {name: longer(column) for name in rows if (column := getattr(field.votes, name)) is not None}
    votes = dataclasses.replace(field.votes, regions=longer(field.votes.regions, -1), **columns)
    leaf = None if field.leaf is None else longer(field.leaf, -1)
    return dataclasses.replace(field, gaussians=gaussians, votes=votes, leaf=leaf)


def add_objects(
    field: LanguageField,
    ledger: Ledger,
    things: Sequence[Gaussians],
    views: Mapping[str, LedgerView],
    descriptions: Sequence[dict[str, Any]],
) -> tuple[LanguageField, Ledger]:
    """Adds things to a field and its ledger: Gaussians of the field's world, and new views that show them.

    Each gets the next region, of which `views` speak already, and Gaussians behind those of the field.
    """
    region, first = field.regions.count, field.gaussians.count
    owners = np.repeat(np.arange(region, region + len(things)), [thing.count for thing in things]).astype(np.int32)
    field = add_unseen(field, things)
    field, ledger = add_views(field, Ledger(ledger.num_regions, ledger.views), views)
    history = field.history
    for number, description in enumerate(descriptions, region):
        rows = first + np.flatnonzero(owners == number)
        absent = remove_object(field, np.isin(np.arange(field.gaussians.count), rows), [number], {})
        history = *history, _event(absent, rows, np.array([number]), description | {"region": number})
    return dataclasses.replace(field, history=history), ledger


def dates(field: LanguageField) -> list[str]:
    """The dates of a field's states: of its run, "" if that is not known, and of its events."""
    return [parse_json(field.provenance).get("date") or "", *(event["date"] for event in events(field))]


def events(field: LanguageField) -> list[dict[str, Any]]:
    """The descriptions of a field's events, in order of time."""
    return [json.loads(event.description) for event in field.history]


def field_as_of(field: LanguageField, date: str) -> LanguageField:
    """The field as it was at the end of a date: events after it are put back, and things that came later are absent."""
    first, *others = (known[: len(date)] for known in dates(field))
    if date < first:
        raise InputError(
            "--as-of", f"{date} is before the field's photographs, of {first}", remedy="Ask for a later date."
        )
    kept = sum(known <= date for known in others)
    if kept == len(others):
        return field
    for event in reversed(field.history[kept:]):
        field = _patched(field, event)
    origin = parse_json(field.provenance)
    origin.pop("ledger", None)  # which knows only what is there now
    return dataclasses.replace(field, history=field.history[:kept], provenance=json.dumps(origin, sort_keys=True))
