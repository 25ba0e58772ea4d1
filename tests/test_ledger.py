"""Views that are added to a field and forgotten: it is the field of one run, to the last bit, and keeps no trace."""

import dataclasses
import errno
import itertools
import json
import os

import jax
import numpy as np
import pytest
from capture_files import refused
from small_field import REGIONS, labels_of, make_field, true_regions, unit_rows
from test_field import assert_same

from jsecon.app.scene import open_scene
from jsecon.errors import InputError
from jsecon.field.evidence import _unpack_evidence, pack_evidence, region_votes, view_evidence
from jsecon.field.field import load_field
from jsecon.field.ledger import Ledger, LedgerView, add_views, camera_row, forget_views
from jsecon.field.ledger_file import ledger_file, load_ledger, save_with_ledger
from jsecon.field.membership import normalise_votes
from jsecon.field.regions import region_embeddings
from jsecon.types import Regions

NAMES = "view_2", "view_9", "view_10", "view_11"
"""in the order of the frames of a capture"""


@pytest.fixture(scope="module")
def labels(scene, cameras):
    """Labels of four views; region 4 is seen in the last alone."""
    labels = labels_of(scene, cameras, true_regions(scene))
    return np.where((labels == 4) & (np.arange(4) < 3)[:, None, None], -1, labels)


@pytest.fixture(scope="module")
def rows():
    """(4, 5, 12) embedding of each region in each view."""
    rng = np.random.default_rng(1)
    return np.stack([unit_rows(rng, REGIONS, 12) for _ in NAMES])


def run_on(scene, cameras, labels, rows, chosen):
    """The field that one run makes of the chosen views, with all regions."""

    def embed(frame, masks):
        t, seen = int(frame[0, 0, 0]), [int(labels[int(frame[0, 0, 0])][mask][0]) for mask in masks]
        return rows[t, seen]

    frames = np.zeros((len(chosen), 40, 48, 3), np.uint8) + np.asarray(chosen, np.uint8)[:, None, None, None]
    some, batch = labels[chosen], jax.tree.map(lambda a: np.asarray(a)[chosen], cameras)
    regions = region_embeddings(frames, some, embed, num_regions=REGIONS)
    votes = normalise_votes(region_votes(scene, batch, some, REGIONS, by_view=True), regions)
    field = make_field(scene, cameras)[0]
    names, regions = tuple(NAMES[t] for t in chosen), Regions(regions.embeddings, regions.pixel_counts)
    return dataclasses.replace(field, votes=votes, regions=regions, cameras=batch, names=names, codes=None)


@pytest.fixture(scope="module")
def views(scene, cameras, labels, rows):
    made = {}
    for t, name in enumerate(NAMES):
        evidence = pack_evidence(view_evidence(scene, cameras[t], labels[t], REGIONS), REGIONS)
        shown, pixels = np.unique(labels[t][labels[t] >= 0], return_counts=True)
        counts, picture = np.stack([shown, pixels]).astype(np.int32), np.full(300, 17 * t + 3, np.uint8)
        made[name] = LedgerView(evidence, counts, counts[0], rows[t, shown], camera_row(cameras[t]), picture)
    return made


def test_views_added_in_any_order_make_the_field_of_one_run(scene, cameras, labels, rows, views):
    """To the last bit, also if the first views lack a region, and if one is forgotten and added again."""
    expected = run_on(scene, cameras, labels, rows, [0, 1, 2, 3])
    for first, *batches in itertools.permutations(NAMES):
        t = NAMES.index(first)
        start = run_on(scene, cameras, labels, rows, [t])
        field, ledger = start, Ledger(REGIONS, {first: views[first]})
        for batch in ([batches[0]], batches[1:]):
            field, ledger = add_views(field, ledger, {name: views[name] for name in batch})
        assert_same(field, expected)
    for t, name in enumerate(NAMES):
        less, shorter = forget_views(field, ledger, [name])
        assert_same(less, run_on(scene, cameras, labels, rows, [n for n in range(4) if n != t]))
        assert_same(add_views(less, shorter, {name: views[name]})[0], expected)


def test_regions_that_a_field_lacks_are_added(scene, cameras, labels, rows, views):
    """They come before the unions and parts of its tree, which keep their regions."""
    few = {name: view for name, view in views.items() if 4 not in view.pixel_counts[0]}
    assert len(few) == 3
    field = run_on(scene, cameras, labels, rows, [0, 1, 2])
    four = Regions(field.regions.embeddings[:4], field.regions.pixel_counts[:4])
    leaf = np.arange(field.gaussians.count, dtype=np.int32) % 6
    field = dataclasses.replace(field, regions=four, tree=np.array([4, 4, -1, -1, -1, 3], np.int32), leaf=leaf)
    grown, ledger = add_views(field, Ledger(4, few), {NAMES[3]: views[NAMES[3]]})
    np.testing.assert_array_equal(grown.tree, [5, 5, -1, -1, -1, -1, 3])
    np.testing.assert_array_equal(grown.leaf, leaf + (leaf >= 4))
    assert ledger.num_regions == grown.regions.count == REGIONS
    whole = run_on(scene, cameras, labels, rows, [0, 1, 2, 3])
    for name in ("weights", "regions", "weight_where_region_visible"):
        np.testing.assert_array_equal(getattr(grown.votes, name), getattr(whole.votes, name), err_msg=name)


def test_packing_a_view_loses_nothing(scene, camera, labels):
    evidence = view_evidence(scene, camera, labels[0], REGIONS)
    packed = pack_evidence(evidence, REGIONS)
    for a, b in zip(_unpack_evidence(packed, scene.count, REGIONS), evidence):
        np.testing.assert_array_equal(a, b)
    more = _unpack_evidence(packed, scene.count, REGIONS + 2)  # pixels of no region stay such
    np.testing.assert_array_equal(more.regions == REGIONS + 2, evidence.regions == REGIONS)


def test_no_byte_of_a_forgotten_frame_stays_in_its_files(scene, cameras, labels, rows, views, tmp_path):
    path, gone = tmp_path / "field.safetensors", NAMES[1]
    field = run_on(scene, cameras, labels, rows, [0, 1, 2, 3])
    warnings = json.dumps({"warnings": [f"{gone} is dark", "a sparse scene"]})
    save_with_ledger(path, dataclasses.replace(field, provenance=warnings), Ledger(REGIONS, views))
    scene = open_scene(path)
    assert scene.ledger.views[gone].picture.tobytes() in b"".join(file.read_bytes() for file in files(tmp_path))
    less = scene.forget([gone])
    less.save(path)
    content = b"".join(file.read_bytes() for file in files(tmp_path))
    view = views[gone]
    for trace in (gone.encode(), view.picture, view.evidence[96:], view.embeddings[0], view.camera[:4]):
        assert bytes(trace) not in content
    assert len(files(tmp_path)) == 2
    assert b"a sparse scene" in content
    assert_same(load_field(path), less.field)


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", [1, 2])
def test_a_stop_leaves_the_old_field(scene, cameras, labels, rows, views, tmp_path, monkeypatch, step, fault):
    path = tmp_path / "field.safetensors"
    save_with_ledger(path, run_on(scene, cameras, labels, rows, [0, 1, 2, 3]), Ledger(REGIONS, views))
    less, steps, replace = open_scene(path).forget([NAMES[0]]), itertools.count(1), os.replace

    def fail(*paths):
        if next(steps) == step:
            raise fault
        replace(*paths)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises((InputError, KeyboardInterrupt)) as info:
        less.save(path)
    monkeypatch.undo()
    assert isinstance(fault, KeyboardInterrupt) or "No space left" in str(info.value)
    again = open_scene(path)
    assert again.field.names == NAMES
    assert {*again.ledger.views} == {*NAMES}
    again.forget([NAMES[0]]).save(path)
    assert len(files(tmp_path)) == 2


def files(folder):
    return [file for file in folder.rglob("*") if file.is_file()]


def test_a_field_without_its_ledger_is_refused_in_one_sentence(scene, cameras, labels, rows, views, tmp_path):
    path, field = tmp_path / "room.safetensors", run_on(scene, cameras, labels, rows, [0, 1, 2, 3])
    save_with_ledger(path, field, None)
    with refused(path, "no ledger", "--no-ledger"):
        load_ledger(path, load_field(path))
    field = save_with_ledger(path, field, Ledger(REGIONS, views))
    file = ledger_file(path, field)
    data = file.read_bytes()
    file.write_bytes(data[:-40])
    with refused(file, "damaged"):
        load_ledger(path, field)
    file.unlink()
    with refused(path, "missing", file.name):
        load_ledger(path, field)


def test_parts_follow_the_frames_of_a_field(scene, cameras, labels, rows, views):
    """A part of which a forgotten frame shows something is gone; the columns of the others follow the frames."""
    before = run_on(scene, cameras, labels, rows, [0, 1, 2])
    pixels = np.array([[4, 0, 3], [0, 2, 1]], np.int32)
    parts = {"part_regions": Regions(unit_rows(np.random.default_rng(2), 2, 12), pixels)}
    parts |= {"part_nodes": np.array([6, 7], np.int32), "tree": np.array([5, 5, -1, -1, -1, -1, 0, 1], np.int32)}
    before = dataclasses.replace(before, leaf=true_regions(scene).astype(np.int32), **parts)
    ledger = Ledger(REGIONS, {name: views[name] for name in before.names})
    fewer, _ = forget_views(before, ledger, [before.names[0]])
    np.testing.assert_array_equal(fewer.part_nodes, [7])
    np.testing.assert_array_equal(fewer.part_regions.pixel_counts, [[2, 1]])
    more, _ = add_views(before, ledger, {NAMES[3]: views[NAMES[3]]})
    columns = [more.names.index(name) for name in before.names]
    np.testing.assert_array_equal(np.asarray(more.part_regions.pixel_counts)[:, columns], pixels)
    assert not np.delete(np.asarray(more.part_regions.pixel_counts), columns, axis=1).any()
    np.testing.assert_array_equal(np.asarray(more.tree)[more.part_nodes], [0, 1])
