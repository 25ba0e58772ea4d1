"""The history of a field: changes applied to it, and the field as it was at an earlier date. Pure functions.

A change replaces columns of some Gaussians and regions, and its event keeps what it replaced. So the field as of a date
is had by putting back the events after it, the last first, to the bit. What is gone becomes transparent, and neither
its Gaussians nor its regions answer a query; what is new has Gaussians and a region of its own, with the next ids.
"""

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jsecon.errors import InputError
from jsecon.field.evidence import ViewEvidence, pack_evidence
from jsecon.field.ledger import LedgerView, camera_row, grown_tree
from jsecon.files import parse_json
from jsecon.query.render import HIDDEN_LOGIT
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Camera, Event, Gaussians, LanguageField

_QUESTION = re.compile(
    r"(?:what|which (?:things?|objects?))(?:'s| has| have| is| are| was| were)?"
    r" (moved|gone|missing|disappeared|removed|new|added|appeared|changed)\s*\??",
    re.IGNORECASE,
)
_KINDS = {"moved": "moved", "changed": ""} | dict.fromkeys(("new", "added", "appeared"), "new")
_KINDS |= dict.fromkeys(("gone", "missing", "disappeared", "removed"), "gone")


_WEIGHT, _PEAK = np.float32(4.0), np.float32(0.9)
"""Weight of a Gaussian of a new thing in each frame that shows it, px, and the largest at a pixel."""


class NewThing(NamedTuple):
    """A thing that a field gets."""

    gaussians: Gaussians
    """In the field's world, with as many harmonics as the field's."""
    embedding: Float[np.ndarray, " e"]
    pixel_counts: Mapping[str, int]
    """New frame -> its pixels there."""


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


def add_object(field: LanguageField, thing: NewThing, description: dict[str, Any]) -> LanguageField:
    """Adds the Gaussians of a thing and its region, which gets the next id; frames of it must be the field's."""
    count, number = thing.gaussians.count, field.regions.count
    first, views = field.gaussians.count, np.full(count, len(thing.pixel_counts), np.int32)
    votes, width = field.votes, field.votes.regions.shape[1]
    weight = _WEIGHT * views.astype(np.float32)
    regions, weights = np.full((count, width), -1, np.int32), np.zeros((count, width), np.float32)
    regions[:, 0], weights[:, 0] = number, weight
    columns = {"regions": regions, "weights": weights, "labelled": weight, "total": weight, "views": views}
    columns |= {"max_pixel_weight": np.full(count, _PEAK), "weight_where_region_visible": weights}
    grown = {
        name: np.concatenate([np.asarray(getattr(votes, name)), column])
        for name, column in columns.items()
        if getattr(votes, name) is not None
    }
    if votes.overlap is not None:
        grown["overlap"] = np.pad(np.asarray(votes.overlap), (0, 1))
        grown["overlap"][-1, -1] = 1
    pixels = np.array([[thing.pixel_counts.get(name, 0) for name in field.names]], np.int32)
    old = field.regions
    nodes = grown_tree(field, number + 1)
    if nodes:
        nodes["leaf"] = np.append(nodes["leaf"], np.full(count, number, np.int32))
    parts = field.parts
    if parts is not None:
        parts = dataclasses.replace(parts, part=np.concatenate([parts.part, np.full(count, -1, np.int32)]))
    join = lambda a, b: np.concatenate([np.asarray(a), np.asarray(b, np.asarray(a).dtype)])  # noqa: E731
    field = dataclasses.replace(
        field,
        gaussians=jax.tree.map(join, field.gaussians, thing.gaussians),
        votes=dataclasses.replace(votes, **grown, num_regions=number + 1),
        regions=dataclasses.replace(
            old,
            embeddings=join(old.embeddings, thing.embedding[None]),
            pixel_counts=join(old.pixel_counts, pixels),
        ),
        parts=parts,
        **nodes,
        codes=None,
    )
    mask = np.arange(field.gaussians.count) >= first
    absent = remove_object(field, mask, [number], {})
    before = _event(absent, np.flatnonzero(mask), np.array([number]), description | {"region": number})
    return dataclasses.replace(field, history=(*field.history, before))


def add_frames(field: LanguageField, cameras: Camera, names: Sequence[str]) -> LanguageField:
    """Adds frames, whose cameras have the size of the field's, that show none of its regions yet."""
    both = jax.tree.map(lambda a, b: np.concatenate([np.asarray(a), np.asarray(b)]), field.cameras, cameras)
    pixels = np.pad(np.asarray(field.regions.pixel_counts), ((0, 0), (0, len(names))))
    regions = dataclasses.replace(field.regions, pixel_counts=pixels)
    return dataclasses.replace(field, cameras=both, regions=regions, names=(*field.names, *names))


def new_view(field: LanguageField, name: str, picture: UInt8[np.ndarray, " j"]) -> LedgerView:
    """What a frame of `add_frames` contributes: the votes that `add_object` gave the new things in it."""
    t, votes, regions = field.names.index(name), field.votes, field.regions
    shown = np.flatnonzero(np.asarray(regions.pixel_counts)[:, t]).astype(np.int32)
    rows = np.flatnonzero(np.isin(votes.regions[:, 0], shown)).astype(np.int32)
    columns = np.asarray(votes.regions)[rows, 0], np.full(len(rows), _WEIGHT), np.full(len(rows), _PEAK)
    packed = pack_evidence(ViewEvidence(rows, np.arange(len(rows) + 1, dtype=np.int32), *columns), regions.count)
    pixels, camera = (
        np.stack([shown, np.asarray(regions.pixel_counts)[shown, t]]),
        jax.tree.map(np.asarray, field.cameras)[t],
    )
    return LedgerView(packed, pixels, shown, np.asarray(regions.embeddings)[shown], camera_row(camera), picture)


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
