"""The history of a field: changes applied to it, and the field as it was at an earlier date. Pure functions.

A change replaces columns of some Gaussians and regions, and its event keeps what it replaced. So the field as of a date
is had by putting back the events after it, the last first, to the bit. What is gone becomes transparent, and neither
its Gaussians nor its regions answer a query; what is new has Gaussians and a region of its own, with the next ids.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import InputError
from jsecon.field.ledger import Ledger, LedgerView, add_views
from jsecon.files import parse_json
from jsecon.fit.growth import pad_rows
from jsecon.splat.transform import transform_gaussians
from jsecon.splat.visible import HIDDEN_LOGIT
from jsecon.types import Event, Gaussians, LanguageField


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


def _absent(event: Event) -> Event:
    """Its columns where its Gaussians and regions are absent: transparent, never seen, without embedding."""
    logits = np.full_like(event.gaussians.opacity_logits, HIDDEN_LOGIT)
    hidden = dataclasses.replace(event.gaussians, opacity_logits=logits)
    views, embeddings = np.zeros_like(event.views), np.zeros_like(event.embeddings)
    return dataclasses.replace(event, gaussians=hidden, views=views, embeddings=embeddings)


def change_object(
    field: LanguageField,
    mask: Bool[np.ndarray, " n"],
    description: dict[str, Any],
    *,
    motion: Float[np.ndarray, "4 4"] | None = None,
    regions: Sequence[int] = (),
) -> LanguageField:
    """Moves Gaussians rigidly, in the field's world, or makes them and regions absent. The history keeps them."""
    event = _event(field, np.flatnonzero(mask), np.asarray(regions, int), description)
    now = _absent(event)
    if motion is not None:
        moved = transform_gaussians(event.gaussians, motion)
        moved = jax.tree.map(lambda a, b: np.asarray(a, b.dtype), moved, event.gaussians)
        now = dataclasses.replace(event, gaussians=moved)
    return dataclasses.replace(_patched(field, now), history=(*field.history, event))


def add_unseen(field: LanguageField, things: Sequence[Gaussians]) -> LanguageField:
    """Adds Gaussians that no view has seen behind those of a field; all others stay as they are, to the bit."""
    gaussians = jax.tree.map(lambda *columns: np.concatenate(columns), field.gaussians, *things)
    rows = "weights", "labelled", "total", "max_pixel_weight", "views", "weight_where_region_visible"
    columns = pad_rows({name: getattr(field.votes, name) for name in rows}, gaussians.count)
    regions, leaf = pad_rows((field.votes.regions, field.leaf), gaussians.count)
    for column in (regions, leaf):
        if column is not None:
            column[field.gaussians.count :] = -1
    votes = dataclasses.replace(field.votes, regions=regions, **columns)
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
    field, ledger = add_views(add_unseen(field, things), Ledger(ledger.num_regions, ledger.views), views)
    for number, (thing, description) in enumerate(zip(things, descriptions), region):
        rows = np.arange(first, first + thing.count)
        first += thing.count
        event = _event(field, rows, np.array([number]), description | {"region": number})
        field = dataclasses.replace(field, history=(*field.history, _absent(event)))
    return field, ledger


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
