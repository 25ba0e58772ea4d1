"""The ledger of a field: what each view contributes to it, so that views are added and taken away exactly. Pure.

A field is a sum over views, but for the strongest K regions of a Gaussian, its largest pixel weight and the views that
show a region. So nothing is subtracted: a field is summed anew from the views that the ledger holds. Views are summed
in the order of their names, and weights add up without error (`jsecon.field.evidence`). So the field is the same, to
the last bit, in whatever order views came, and after one is forgotten as if it had never been there. Adding needs only
the sum before the cut, which a ledger keeps once it is known.
"""

import dataclasses
import json
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float32, Int32, UInt8

from jsecon.errors import require
from jsecon.field.evidence import TOP, EvidenceSum, add_evidence, sum_packed
from jsecon.field.membership import normalise_votes
from jsecon.field.regions import unit_rows
from jsecon.types import Camera, LanguageField, Regions


class LedgerView(NamedTuple):
    """What one view contributes to a field."""

    evidence: UInt8[np.ndarray, " b"]
    """Its list of Gaussians, regions and weights, packed (`pack_evidence`)."""
    pixel_counts: Int32[np.ndarray, "2 m"]
    """The regions that it shows, and their pixels."""
    embedded: Int32[np.ndarray, " c"]
    """Regions that were embedded in it."""
    embeddings: Float32[np.ndarray, "c e"]
    """Unit embeddings of these; zero where there was none."""
    camera: Float32[np.ndarray, " 20"]
    """Its pose (4, 4) row by row, then fx, fy, cx, cy."""
    picture: UInt8[np.ndarray, " j"]
    """The photograph at the size of the field's frames, as a JPEG."""


@dataclasses.dataclass(frozen=True)
class Ledger:
    """The views of a field."""

    num_regions: int
    views: Mapping[str, LedgerView]
    """By the names of the frames."""
    sum: EvidenceSum | None = dataclasses.field(default=None, repr=False, compare=False)
    """The sum of all, in the order of their names, where it is known: to add a view is then quick."""


def view_order(name: str) -> tuple[str, str]:
    """Returns the key by which frames are ordered: their names, and the numbers in them (9 before 10)."""
    return re.sub(r"\d+", lambda number: number[0].zfill(20), name), name


def camera_row(camera: Camera) -> Float32[np.ndarray, " 20"]:
    """Joins the numbers of one camera as `LedgerView.camera` has them."""
    lens = [camera.fx, camera.fy, camera.cx, camera.cy]
    return np.concatenate([np.ravel(camera.world_to_camera), lens]).astype(np.float32)


def add_views(field: LanguageField, ledger: Ledger, views: Mapping[str, LedgerView]) -> tuple[LanguageField, Ledger]:
    """Adds views to a field: as one run with all of these views and the same regions makes it, to the last bit.

    Regions of the new views that the field lacks get the next ids. Codes of the paper, which would need training, are
    dropped. The scene, and the cameras of the old views, stay as they are.

    Args:
      field: The field.
      ledger: Its ledger.
      views: New views by name.

    Returns:
      The new field and its ledger.

    Raises:
      ValueError: The field has a view of that name.
    """
    twice = sorted(set(views) & set(field.names))
    require(not twice, "add_views", f"views that are there already: {twice[:3]}", "new names", "Forget them first.")
    counts = [ledger.num_regions, *(int(view.pixel_counts[0].max(initial=-1)) + 1 for view in views.values())]
    count, ordered = max(counts), sorted({**ledger.views, **views}, key=view_order)
    is_cut = ledger.sum is not None  # the field's votes are then those of the sum
    before = sum_ledger(field, ledger).sum
    assert before is not None
    new = [name for name in ordered if name in views]
    packed = [views[name].evidence for name in new]
    total = add_evidence(before, packed, [ordered.index(name) for name in new], count)
    return _build_field(field, Ledger(count, {**ledger.views, **views}, total), {*field.names, *views}, grows=is_cut)


def forget_views(field: LanguageField, ledger: Ledger, names: Collection[str]) -> tuple[LanguageField, Ledger]:
    """Takes frames out of a field: as one run without them and with the same regions makes it, to the last bit.

    A region that no other view shows keeps its id, without votes and embedding. Codes of the paper come from
    all views together and are dropped. The Gaussians stay.

    Args:
      field: The field.
      ledger: Its ledger.
      names: Names of frames of the field, also of ones that had no part in its votes.

    Returns:
      The new field and its ledger.

    Raises:
      ValueError: The field has no frame of that name, or no other frame.
    """
    names, known = set(names), set(field.names)
    require(names <= known, "forget_views", sorted(names - known)[:3], "names of the field's frames", "Check them.")
    views = {name: view for name, view in ledger.views.items() if name not in names}
    require(len(views) > 0, "forget_views", "all views", "at least one view that stays", "Delete the field instead.")
    return _build_field(field, sum_ledger(field, Ledger(ledger.num_regions, views)), known - names)


def sum_ledger(field: LanguageField, ledger: Ledger) -> Ledger:
    """Returns a ledger that knows the sum of its views, in the order of their names."""
    if ledger.sum is not None:
        return ledger
    packed = [ledger.views[name].evidence for name in sorted(ledger.views, key=view_order)]
    return dataclasses.replace(ledger, sum=sum_packed(packed, field.gaussians.count, ledger.num_regions))


def _build_field(
    field: LanguageField, ledger: Ledger, names: Collection[str], *, grows: bool = False
) -> tuple[LanguageField, Ledger]:
    """Builds the field of frames from a ledger and its sum; some frames may have no part in the votes.

    With `grows` the weights are at least those of the votes of `field`.
    """
    count, top = ledger.num_regions, field.votes.regions.shape[1]
    top = max(top, TOP) if top == field.regions.count else top  # a field of few regions holds all
    ordered = sorted(names, key=view_order)
    views = {name: ledger.views[name] for name in ordered if name in ledger.views}
    assert ledger.sum is not None
    known = np.asarray(field.votes.weights)
    votes = ledger.sum.votes(top, known[:, -1] if grows and known.shape[1] == top else None)
    total = np.zeros((count, field.regions.embeddings.shape[1]))
    pixels = np.zeros((count, len(views)), np.int32)
    for t, view in enumerate(views.values()):
        pixels[view.pixel_counts[0], t] = view.pixel_counts[1]
        total[view.embedded] += pixels[view.embedded, t, None] * view.embeddings.astype(np.float64)
    embeddings = unit_rows(total)
    all_pixels = np.zeros((count, len(ordered)), np.int32)
    all_pixels[:, [name in views for name in ordered]] = pixels
    rows = dict(zip(field.names, map(camera_row, jax.tree.map(np.asarray, field.cameras))))
    rows |= {name: view.camera for name, view in views.items() if name not in rows}
    cameras = np.stack([rows[name] for name in ordered])
    width, height = field.cameras.width, field.cameras.height
    new = dataclasses.replace(
        field,
        votes=normalise_votes(votes, Regions(embeddings, pixels)),
        regions=Regions(embeddings, all_pixels),
        cameras=Camera(cameras[:, :16].reshape(-1, 4, 4), *cameras[:, 16:].T, width=width, height=height),
        names=tuple(ordered),
        **_grown_tree(field, count, np.asarray(votes.regions)[:, 0]),
        **_parts_in_frames(field, ordered, count),
        codes=None,
    )
    return _with_history(new), ledger


def _with_history(field: LanguageField) -> LanguageField:
    """Makes absent what the history says is gone; events that restore it get what the ledger's views say of it."""
    views, embeddings, events = np.array(field.votes.views), np.array(field.regions.embeddings), []
    for event in field.history:
        kind = json.loads(event.description)["kind"]
        columns = {"views": views[event.rows], "embeddings": embeddings[event.regions]}
        events.append(dataclasses.replace(event, **{n: column * (kind != "new") for n, column in columns.items()}))
        if kind == "gone":
            views[event.rows], embeddings[event.regions] = 0, 0
    votes = dataclasses.replace(field.votes, views=views)
    regions = dataclasses.replace(field.regions, embeddings=embeddings)
    return dataclasses.replace(field, votes=votes, regions=regions, history=tuple(events))


def _parts_in_frames(field: LanguageField, names: Sequence[str], count: int) -> dict[str, Any]:
    """The parts of a field of other frames and `count` regions: without those that a frame which is gone shows."""
    if field.part_regions is None or field.part_nodes is None:
        return {}
    place = {name: t for t, name in enumerate(field.names)}
    old, nodes = np.asarray(field.part_regions.pixel_counts), np.asarray(field.part_nodes) + count - field.regions.count
    kept = ~old[:, [t for name, t in place.items() if name not in names]].any(1)
    pixels = np.pad(old, [(0, 0), (0, 1)])[:, [place.get(name, -1) for name in names]]
    return {
        "part_regions": Regions(field.part_regions.embeddings[kept], pixels[kept]),
        "part_nodes": nodes[kept].astype(np.int32),
    }


def _grown_tree(field: LanguageField, count: int, strongest: Int32[np.ndarray, " n"]) -> dict[str, np.ndarray]:
    """Tree and smallest nodes of a field that has `count` regions now: new ones stand alone, before all other nodes."""
    if field.tree is None:
        return {}
    old, tree, leaf = field.regions.count, np.asarray(field.tree), np.asarray(field.leaf)
    tree, leaf = (np.where(nodes >= old, nodes + count - old, nodes).astype(np.int32) for nodes in (tree, leaf))
    leaf = np.where((leaf < 0) & (strongest >= old), strongest, leaf)
    return {"tree": np.insert(tree, old, np.full(count - old, -1)), "leaf": leaf}
