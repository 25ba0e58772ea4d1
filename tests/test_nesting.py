"""Masks that lie in others: their tree against a readable twin, its labels, the files that hold such masks, and a field
that is asked for a part of a thing."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from balls import COLOURS, ring_of_balls
from capture_files import refused, run_cli, run_lengths, write_mask, write_transforms
from conftest import capture_of
from hypothesis import given, settings, strategies as st

from jsecon import Region, open_scene, save_gaussians
from jsecon.field.field import _is_tree
from jsecon.field.tree import node_members, parts_above
from jsecon.read.masks.masks import load_labels, load_nested_labels, load_proposals
from jsecon.read.masks.nesting import CONTAINED, lies_in, nest_masks, split_parts
from jsecon.splat.sh import C0

SIZE = (48, 64)


def slow_parents(frames, count):
    """The parent of each object, by sets: `frames` have masks by object."""
    largest = [max([int(masks[n].sum()) for masks in frames if n in masks], default=0) for n in range(count)]
    parents = []
    for part in range(count):
        wholes = []
        for whole in range(count):
            both = [(masks[part], masks[whole]) for masks in frames if part in masks and whole in masks]
            later = whole < part
            lies = [(a & b).sum() >= CONTAINED * a.sum() and b.sum() + later > a.sum() for a, b in both]
            is_larger = largest[whole] + later > largest[part]
            if any(lies) and sum(lies) >= CONTAINED * len(lies) and is_larger:
                wholes.append(whole)
        parents.append(min(wholes, key=lambda whole: (largest[whole], -whole), default=-1))
    return parents


def fast_parents(frames, count):
    """`nest_masks` of masks by object."""
    columns = []
    for masks in frames:
        stack = np.stack([np.zeros(SIZE, bool), *(masks[n] for n in sorted(masks))])[1:]
        columns.append((np.array(sorted(masks), int), *lies_in(stack)))
    return nest_masks(columns, count).tolist()


def rectangle(top, left, bottom, right):
    mask = np.zeros(SIZE, bool)
    mask[top:bottom, left:right] = True
    return mask


MASKS = st.builds(lambda y, x, h, w: rectangle(y, x, y + h, x + w), *[st.integers(1, 30)] * 4)


@settings(max_examples=200)
@given(st.lists(st.dictionaries(st.integers(0, 5), MASKS), max_size=5))
def test_the_tree_of_any_masks_is_that_of_the_readable_twin(frames):
    assert fast_parents(frames, 6) == slow_parents(frames, 6)


def chain(parents, node):
    """A node and what it lies in."""
    return [node, *(chain(parents, parents[node]) if parents[node] >= 0 else [])] if node >= 0 else []


@given(st.integers(1, 8), st.integers(0, 2**32))
def test_labels_of_things_and_parts_are_those_of_the_smallest_objects(count, seed):
    """Each pixel keeps its object and all that this lies in, each part on one layer; objects without pixels go."""
    rng = np.random.default_rng(seed)
    parents = [int(rng.integers(-1, max(n, 1))) if n else -1 for n in range(count)]
    labels = rng.integers(-1, len(parents), (2, 3, 4)).astype(np.int16)
    split = split_parts(labels, np.array(parents))
    if max(parents) < 0:
        assert split.keys() == {"labels"}
        np.testing.assert_array_equal(split["labels"], labels)
        return
    things, tree, layers = split["labels"], split["tree"], split["parts"]
    assert things.dtype == layers.dtype == np.int16
    count = int(things.max()) + 1
    assert _is_tree(tree, count)
    assert (tree[:count] == -1).all()
    assert (tree[count:] >= 0).all()
    np.testing.assert_array_equal(split["part_nodes"], np.arange(count, len(tree)))
    object_of = {}
    for place in np.ndindex(labels.shape):
        nodes = [int(part) + count for part in layers[(slice(None), *place)] if part >= 0]
        shown = ([int(things[place])] if things[place] >= 0 else []) + nodes
        own = chain(parents, int(labels[place]))
        assert len(shown) == len(own)
        for node, thing in zip(shown, own[::-1]):
            assert object_of.setdefault(node, thing) == thing
    assert sorted(object_of) == [*range(len(tree))]
    assert len(set(object_of.values())) == len(tree)
    for node, thing in object_of.items():
        assert (object_of[int(tree[node])] if tree[node] >= 0 else -1) == parents[thing]
    for part in range(len(tree) - count):
        assert (layers == part).any((1, 2, 3)).sum() == 1


NAMES = ("a", "b", "c")
MUG, HANDLE, PLATE = rectangle(10, 10, 34, 30), rectangle(14, 26, 24, 31), rectangle(5, 40, 40, 60)
"""the handle sticks out by a px"""


def mug_and_handle(shift):
    return [np.roll(mask, shift, axis=1) for mask in (MUG, HANDLE, PLATE)]


@pytest.mark.parametrize("order", [("mug", "handle", "plate"), ("handle", "plate", "mug")])
def test_folders_of_objects_in_each_other_nest_whatever_they_are_called(tmp_path, order):
    for number, kind in enumerate(order):
        for t, name in enumerate(NAMES):
            mask = dict(zip(("mug", "handle", "plate"), mug_and_handle(t)))[kind]
            write_mask(tmp_path / f"{number}_{kind}" / f"{name}.png", 255 * mask)
    labels, ids, notes = load_labels(tmp_path, NAMES, SIZE)
    parent = load_nested_labels(tmp_path, NAMES, SIZE)[1]
    place = {kind: order.index(kind) for kind in order}
    assert ids == (1, 2, 3)
    assert [parent[place[kind]] for kind in ("mug", "handle", "plate")] == [-1, place["mug"], -1]
    assert any("1 of the 3 regions lie in those of others" in note for note in notes)
    for t in range(3):
        mug, handle, plate = mug_and_handle(t)
        np.testing.assert_array_equal(labels[t] == place["handle"], handle)
        np.testing.assert_array_equal(labels[t] == place["mug"], mug & ~handle)
        np.testing.assert_array_equal(labels[t] == place["plate"], plate)


TRACKS = {
    "TAO": lambda track: {"track_id": track},
    "CVAT": lambda track: {"attributes": {"occluded": False, "track_id": track}},
    "CocoVID": lambda track: {"instance_id": track, "attributes": ["front"]},
}


@pytest.mark.parametrize("kind", TRACKS)
@pytest.mark.parametrize("is_coco", [True, False])
def test_json_with_numbers_of_objects_is_read_as_their_masks(tmp_path, kind, is_coco):
    """One file of COCO, or one of SAM a frame, best first; 0 is an object, too."""
    records = []
    for t, name in enumerate(NAMES):
        own = [{"segmentation": run_lengths(mask), "predicted_iou": 0.5 + 0.1 * track, "image_id": t} for track, mask in
               enumerate(mug_and_handle(t))]  # fmt: skip
        own = [record | TRACKS[kind](7 * track) for track, record in enumerate(own)]
        records += [*own, {"segmentation": [], "image_id": t} | TRACKS[kind](99)]
        if not is_coco:
            (tmp_path / f"{name}.json").write_text(json.dumps(own))
    if is_coco:
        images = [{"id": t, "file_name": f"{name}.jpg", "height": 48, "width": 64} for t, name in enumerate(NAMES)]
        images.append({"id": 9, "file_name": "empty.jpg", "height": 48, "width": 64})
        (tmp_path / "instances.json").write_text(json.dumps({"images": images, "annotations": records}))
    names = (*NAMES, "empty")
    (labels, ids, _), parent = load_nested_labels(tmp_path, names, SIZE)
    assert ids == (0, 7, 14)
    assert parent.tolist() == [-1, 0, -1]
    mug, handle, plate = mug_and_handle(2)
    np.testing.assert_array_equal(labels[2], np.select([handle, mug, plate], [1, 0, 2], -1))
    assert (labels[3] == -1).all()
    np.testing.assert_array_equal(load_proposals(tmp_path, names, SIZE)[0](2), [plate, handle, mug])


@pytest.mark.parametrize("tracks", [(1, None), (1, 1), ("1", "2"), (None, None)])
def test_json_without_a_number_for_each_object_is_of_single_frames(tmp_path, tracks):
    records = [{"segmentation": run_lengths(mask), "track_id": n} for mask, n in zip((MUG, PLATE), tracks)]
    (tmp_path / "a.json").write_text(json.dumps(records))
    with refused("a.json", "single frame", "--proposals"):
        load_labels(tmp_path, ("a",), SIZE)
    np.testing.assert_array_equal(load_proposals(tmp_path, ("a",), SIZE)[0](0), [MUG, PLATE])


BALL_OF = np.repeat([0, 1, 2, 3], [2500, 1500, 1500, 1500])
"""the disc, and the red, blue and green ball of each Gaussian of `ring_of_balls`"""


@pytest.fixture(scope="module")
def dumbbell(tmp_path_factory):
    """Folder of a field, `out`: of a red ball with a blue one as its part, and a green one apart, on a disc."""
    folder = tmp_path_factory.mktemp("dumbbell")
    gaussians, cameras, frames, truth, _ = ring_of_balls()
    colours = (COLOURS[BALL_OF].astype(np.float32) / 255 - 0.5) / C0
    save_gaussians(folder / "balls.ply", dataclasses.replace(gaussians, sh=colours[:, None]))
    for place, rows in (("capture", np.arange(0, 24, 3)), ("later", np.array([1, 2]))):
        names = tuple(f"frame_{t:02d}" for t in rows)
        capture = capture_of(frames[rows], cameras[rows], np.zeros(len(rows), bool))
        write_transforms(dataclasses.replace(capture, names=names), folder / place)
        for name, image in zip(names, truth[rows]):
            for kind, balls in (("mug", (1, 2)), ("handle", (2,)), ("ball", (3,))):
                write_mask(folder / f"{place}_masks" / kind / f"{name}.png", 255 * np.isin(image, balls))
    line = "run", folder / "capture", "--out", folder / "out", "--gaussians", folder / "balls.ply", "--holdout", 0
    assert run_cli(*line, "--masks", folder / "capture_masks") == 0
    return folder


def test_given_masks_in_each_other_are_asked_as_found_ones_are(dumbbell, capsys):
    scene = open_scene(dumbbell / "out")
    field = scene.field
    assert field.tree.tolist() == [-1, -1, 1]
    assert field.part_nodes.tolist() == [2]
    assert parts_above(field).tolist() == [-1, -1, 1]  # what a second click takes
    is_red, is_blue = BALL_OF == 1, BALL_OF == 2
    handle = scene.ask("the blue handle of the red mug")
    assert (handle.by, handle.state) == ("relation", "found")
    assert handle.objects[0].regions == (2,)
    assert handle.mask[is_blue].mean() > 0.8  # some lie within, unseen
    assert handle.mask[~is_blue].mean() < 0.02
    mug = scene.ask("red")
    assert int(mug.selection.region) == 1
    assert mug.mask[is_red | is_blue].mean() > 0.8
    assert mug.mask[~(is_red | is_blue)].mean() < 0.02
    np.testing.assert_array_equal(
        scene.ask(Region(2)).selection.mask, node_members(*map(np.asarray, (field.tree, field.leaf)), 2)
    )
    parts = scene.at_level(-1)
    assert len(scene.objects()) < len(parts.objects())
    assert parts.ask(Region(2)).mask[is_blue].mean() > 0.8
    assert parts.ask(Region(1)).mask[is_red].mean() > 0.8
    assert parts.ask(Region(1)).mask[is_blue].mean() < 0.1
    assert run_cli("objects", dumbbell / "out", "--level", -1) == 0


def test_masks_of_added_frames_that_lie_in_others_open_no_region(dumbbell):
    scene = open_scene(dumbbell / "out")
    grown = scene.add(dumbbell / "later", masks=dumbbell / "later_masks")
    assert grown.field.regions.count == 2
    assert len(grown.field.names) == 10
    pixels = np.asarray(grown.field.regions.pixel_counts)[1]
    assert (pixels[[grown.field.names.index(name) for name in ("frame_01", "frame_02")]] > 0).all()
    np.testing.assert_array_equal(grown.field.leaf, scene.field.leaf)


def test_parts_of_a_scene_larger_than_memory_are_voted_for_on_disk_to_the_same_field(dumbbell, tmp_path, monkeypatch):
    shutil.copytree(dumbbell / "out" / "cache", tmp_path / "cache")
    next((tmp_path / "cache").glob("votes-*.safetensors")).unlink()
    monkeypatch.setenv("JSECON_MEMORY", "1e-6")
    line = "run", dumbbell / "capture", "--out", tmp_path, "--gaussians", dumbbell / "balls.ply", "--holdout", 0
    assert run_cli(*line, "--masks", dumbbell / "capture_masks") == 0
    leaves = [np.asarray(open_scene(folder).field.leaf) for folder in (tmp_path, dumbbell / "out")]
    np.testing.assert_array_equal(*leaves)
