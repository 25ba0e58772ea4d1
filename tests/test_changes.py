"""Changes of a scene: each kind is found; exposure, and what no photograph sees, is no change."""

import base64
import dataclasses

import cv2
import jax
import numpy as np
import pytest
from capture_files import run_cli
from conftest import cameras_of, capture_of, gaussians_at, look_at
from PIL import Image
from small_field import lone_votes
from starlette.testclient import TestClient

from experiments.rooms.writers import write_colmap
from jsecon import InputError, LanguageField, Regions, Scene, load_field
from jsecon.app.scene import open_scene
from jsecon.app.server import application
from jsecon.change import detect
from jsecon.change.detect import depth_cost, object_changes
from jsecon.change.history import events
from jsecon.field.evidence import pack_evidence, view_evidence
from jsecon.field.ledger import Ledger, LedgerView, add_views, camera_row
from jsecon.field.ledger_file import save_with_ledger
from jsecon.read.captures.capture import taken_on
from jsecon.read.captures.images import encode_jpeg
from jsecon.splat.render import render, render_rgb
from jsecon.types import UpAxis
from jsecon.vision.colours import ColourEmbedder

UP = np.array([0.0, 0.0, 1.0])
COLOURS = {"red": (0.8, 0.1, 0.1), "blue": (0.1, 0.2, 0.8), "green": (0.1, 0.6, 0.2), "orange": (0.95, 0.5, 0.1)}
PLACES = {"red": (-0.35, 0.2), "blue": (0.3, 0.3), "green": (0.3, -0.35), "orange": (-0.3, -0.3)}


def scene_of(**places):
    """A grey table with upright bars of the named colours at (x, y), and the label of each Gaussian.

    There are four bars, so that scenes share programs: the rest is transparent.
    """
    flat = np.stack(np.meshgrid(np.arange(-0.75, 0.76, 0.05), np.arange(-0.75, 0.76, 0.05)), -1).reshape(-1, 2)
    grid = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in (1, 3)), np.arange(6)), -1).reshape(-1, 3) * 0.035
    bars = [grid + np.array([*places.get(name, (0, 0)), 0.03]) for name in COLOURS]
    labels = np.repeat([-1, *range(4)], [len(flat), *map(len, bars)])
    colours = np.array([(0.55, 0.5, 0.45), *COLOURS.values()])[labels + 1]
    logits = np.array([3.0, *(3.0 if name in places else -30.0 for name in COLOURS)])[labels + 1]
    means = np.concatenate([np.column_stack([flat, np.zeros(len(flat))]), *bars])
    sizes = np.where(labels < 0, 0.03, 0.02)[:, None]
    scene = gaussians_at(means, sizes, logit=logits, sh=((colours - 0.5) / 0.2820948)[:, None])
    return scene, np.where(logits > 0, labels, -1)


@pytest.fixture(scope="module")
def eyes():
    poses = [look_at(1.5 * np.array([np.cos(a), np.sin(a), 0.6]), up=UP) for a in (0.4, 2.4, 4.6)]
    return cameras_of(poses, (80, 80, 48, 36), 96, 72)


def photographs(gaussians, cameras):
    images = [np.asarray(render_rgb(gaussians, camera, depth=True).features) for camera in cameras]
    return np.stack([(255 * np.clip(image, 0, 1)).astype(np.uint8) for image in images])


def test_unseen_is_not_gone_light_is_no_change_and_another_place_is_refused(eyes):
    before, labels = scene_of(red=PLACES["red"], blue=(0.3, 30.0))
    frames = photographs(scene_of(red=PLACES["red"])[0], eyes)
    for seen in (frames, (0.6 * frames + 8).astype(np.uint8)):
        assert [change.kind for change in object_changes(before, labels, seen, eyes, up=UP)] == ["same", "not seen"]
    with pytest.raises(InputError, match="photograph 1: the scene explains"):
        object_changes(before, labels, 255 * (np.indices(frames.shape).sum(0) % 2).astype(np.uint8), eyes, up=UP)


def test_depth_alone_tells_what_is_gone(eyes):
    """Of the table's colour, so that colours tell nothing."""
    before, labels = scene_of(red=PLACES["red"], blue=PLACES["blue"])
    grey = dataclasses.replace(before, sh=np.broadcast_to(before.sh[:1], before.sh.shape))
    logits = np.where(labels == 1, np.float32(-30), grey.opacity_logits)
    after = dataclasses.replace(grey, opacity_logits=logits)
    depths = np.stack([np.asarray(render_rgb(after, camera, depth=True).depth) for camera in eyes])
    found = object_changes(grey, labels, photographs(after, eyes), eyes, depths, up=UP)
    assert [change.kind for change in found] == ["same", "gone"]


def test_depth_shows_low_things_and_no_edge_that_lies_a_pixel_off():
    table, edge = np.full((12, 12), 1.4), np.full((12, 12), 1.4)
    edge[:, 6:] = 1.0
    np.testing.assert_array_equal(depth_cost(np.roll(edge, 1, axis=0), np.roll(edge, 1, axis=1)), 0)
    low = table.copy()
    low[4:8, 4:8] = 1.37
    np.testing.assert_allclose(depth_cost(low, table)[4:8, 4:8], -(1.5 * 0.03 / (0.03 * 1.4) - 0.5))
    assert not depth_cost(low, table)[:4].any()
    assert np.isnan(depth_cost(np.zeros((12, 12)), table)).all()


def field_with_ledger(gaussians, labels, eyes, frames):
    """The field that a run makes of three views, whose masks are the bars, and its ledger."""
    embedder, views, things = ColourEmbedder(), {}, np.eye(4, dtype=np.float32)[labels] * (labels >= 0)[:, None]
    for name, camera, frame in zip(("a", "b", "c"), eyes, frames):
        shares = np.asarray(render(gaussians, camera, things, depth=True).features)
        image = np.where(shares.max(-1) > 0.5, shares.argmax(-1), -1)
        evidence = pack_evidence(view_evidence(gaussians, camera, image, 3), 3)
        shown, pixels = np.unique(image[image >= 0], return_counts=True)
        rows = embedder.embed_regions(frame, image[None] == shown[:, None, None])
        pixels = np.stack([shown, pixels]).astype(np.int32)
        views[name] = LedgerView(evidence, pixels, pixels[0], rows, camera_row(camera), encode_jpeg(frame))
    empty = Regions(np.zeros((3, embedder.dim), np.float32), np.zeros((3, 0), np.int32))
    votes = dataclasses.replace(lone_votes(np.maximum(labels, 0), 3), overlap=np.eye(3, dtype=np.float32))
    words = embedder.canonical_phrases, np.eye(4), (), embedder.name
    more = {"unrelated_words": embedder.unrelated_words, "up": UpAxis((0.0, 0.0, 1.0), "given")}
    none = jax.tree.map(lambda a: np.asarray(a)[:0], eyes)
    return add_views(LanguageField(gaussians, votes, empty, none, *words, **more), Ledger(3, {}), views)


def test_an_updated_field_answers_as_things_are_now_and_as_they_were(eyes, tmp_path):
    before, labels = scene_of(red=PLACES["red"], blue=PLACES["blue"], green=PLACES["green"])
    after, _ = scene_of(red=(-0.1, -0.05), green=PLACES["green"], orange=PLACES["orange"])
    embedder = ColourEmbedder()
    field, ledger = field_with_ledger(before, labels, eyes, photographs(before, eyes))
    old = Scene(field, embedder)
    capture = capture_of(photographs(after, eyes), eyes, np.zeros(3, bool))
    moved, gone, _, _ = object_changes(before, labels, capture.frames, eyes, up=UP)
    np.testing.assert_allclose(moved.motion[:2, 3] + moved.motion[:2, :2] @ PLACES["red"], (-0.1, -0.05), atol=0.03)
    assert len(gone.frames) == 3
    save_with_ledger(tmp_path / "old.safetensors", field, ledger)
    write_colmap(capture, tmp_path / "photos")
    options = "--out", tmp_path / "new", "--date", "2026-11-28"
    assert run_cli("update", tmp_path / "old.safetensors", tmp_path / "photos", *options) == 0
    rows = [row.split(",")[:2] for row in (tmp_path / "new" / "changes.csv").read_text().splitlines()[1:]]
    assert sorted(rows) == [["gone", "blue"], ["moved", "red"], ["new", ""], ["same", "green"]]
    assert "moved red (object" in (tmp_path / "new" / "changes.html").read_text()
    new = Scene(load_field(tmp_path / "new" / "field.safetensors"), embedder)
    assert [(event["kind"], event["region"]) for event in events(new.field)] == [("moved", 0), ("gone", 1), ("new", 3)]
    np.testing.assert_allclose(new.ask("red").place.center[:2], (-0.1, -0.05), atol=0.03)
    assert old.ask("blue").mask.any()
    assert not new.ask("blue").mask.any()
    np.testing.assert_allclose(new.ask("orange").place.center[:2], PLACES["orange"], atol=0.06)
    listed = old.objects()
    for region, text in enumerate(("what moved?", "what is gone")):
        mask = listed.mask(listed.regions[region])
        np.testing.assert_array_equal(new.ask(text).rows, np.flatnonzero(mask))
        assert (labels[mask] == region).all()
    then = new.as_of("2026-11-27")
    for now, was in zip(jax.tree.leaves(then.field.gaussians), jax.tree.leaves(before)):
        np.testing.assert_array_equal(now[: before.count], was)
    for text in ("red", "blue", "green", "orange"):
        np.testing.assert_array_equal(then.ask(text).rows, old.ask(text).rows)
    with pytest.raises(InputError, match="before the last change"):
        new.update(capture, date="2026-11-01")
    with pytest.raises(InputError, match="no ledger of its views"):
        old.update(capture, date="2026-11-28")


def test_frames_are_added_and_forgotten_after_an_update_and_it_is_updated_again(eyes, tmp_path):
    before, labels = scene_of(red=PLACES["red"], blue=PLACES["blue"], green=PLACES["green"])
    places = {"red": (-0.1, -0.05), "green": PLACES["green"], "orange": PLACES["orange"]}
    after, later = scene_of(**places)[0], scene_of(**places | {"green": (0.35, 0.3)})[0]
    path, names = tmp_path / "field.safetensors", ("d", "e", "f")
    save_with_ledger(path, *field_with_ledger(before, labels, eyes, photographs(before, eyes)))
    day2 = dataclasses.replace(capture_of(photographs(after, eyes), eyes, np.zeros(3, bool)), names=names)
    open_scene(path).update(day2, date="2026-11-02").save(path)
    updated = open_scene(path)
    assert {*updated.ledger.views} == {"a", "b", "c", *names}
    more = dataclasses.replace(day2, frames=day2.frames[:1], cameras=eyes[:1], names=("g",))
    grown = updated.add(more)
    pose = np.linalg.inv(np.asarray(eyes.world_to_camera[0], np.float64)) @ np.diag([1.0, -1, -1, 1])
    lens = {"fl_x": 80, "fl_y": 80, "cx": 48, "cy": 36, "w": 96, "h": 72}
    image = base64.b64encode(cv2.imencode(".png", more.frames[0][..., ::-1])[1].tobytes()).decode()
    shot = {"name": "g.png", "image": image, "pose": lens | {"transform_matrix": pose.tolist()}}
    client = TestClient(application(scenes := {updated.name: updated}), "http://127.0.0.1")
    assert client.post("/frames", json=shot).json() == {"field": updated.name, "frames": 7}
    np.testing.assert_allclose(scenes[updated.name].field.votes.weights, grown.field.votes.weights, atol=1e-3)
    assert client.post("/frames", json=shot).status_code == 422  # of that name already
    for name in ("regions", "weights", "total", "views", "weight_where_region_visible"):
        rebuilt, old = (np.asarray(getattr(s.field.votes, name)) for s in (grown.forget(["g"]), updated))
        np.testing.assert_array_equal(rebuilt, old, err_msg=name)
    for scene in (updated, grown, grown.forget(["d"])):
        np.testing.assert_allclose(scene.ask("red").place.center[:2], places["red"], atol=0.03)
        np.testing.assert_allclose(scene.ask("orange").place.center[:2], places["orange"], atol=0.06)
        assert not scene.ask("blue").mask.any()
    day3 = dataclasses.replace(day2, frames=photographs(later, eyes), names=("h", "i", "j"))
    last = grown.update(day3, date="2026-11-03")
    assert [(e["kind"], e["region"]) for e in events(last.field)] == [
        ("moved", 0),
        ("gone", 1),
        ("new", 3),
        ("moved", 2),
    ]
    np.testing.assert_allclose(last.ask("green").place.center[:2], (0.35, 0.3), atol=0.03)
    assert [change.kind for change in updated.changes(last).found if change.kind != "same"] == ["moved"]
    then = Scene(dataclasses.replace(last.field, provenance='{"date": "2026-11-01"}'), last.embedder).as_of(
        "2026-11-01"
    )
    np.testing.assert_allclose(then.ask("blue").place.center[:2], PLACES["blue"], atol=0.03)
    assert not then.ask("orange").mask.any()
    with pytest.raises(InputError, match="2026-10-31 is before the field's photographs, of 2026-11-01"):
        then.as_of("2026-10-31")


def test_the_date_of_photographs_is_the_latest_of_their_exif_data(tmp_path):
    for number, date in enumerate(("2026:11:03 10:00:00", "2026:11:01 09:00:00", None)):
        exif = Image.Exif()
        if date is not None:
            exif.get_ifd(0x8769)[0x9003] = date
        Image.new("RGB", (8, 8)).save(tmp_path / f"{number}.jpg", exif=exif)
    assert taken_on(tmp_path) == "2026-11-03"
    assert taken_on(tmp_path / "1.jpg") == "2026-11-01"
    assert taken_on(tmp_path / "2.jpg") is None


def test_what_too_little_shows_is_unsure_and_not_applied(eyes, monkeypatch):
    before, labels = scene_of(red=PLACES["red"], blue=PLACES["blue"])
    frames = photographs(scene_of(red=PLACES["red"])[0], eyes)
    gone = object_changes(before, labels, frames, eyes, up=UP)[1]
    monkeypatch.setattr(detect, "MIN_PROBABILITY", gone.probability + 0.001)
    unsure = object_changes(before, labels, frames, eyes, up=UP)[1]
    assert (gone.kind, unsure.kind, unsure.suspected) == ("gone", "unsure", "gone")


def test_frames_with_depth_that_are_added_give_gaussians_to_what_is_new(eyes):
    """Once, and the others stay as they are, to the bit; without depth there are no new ones."""
    before, labels = scene_of(red=PLACES["red"], blue=PLACES["blue"], green=PLACES["green"])
    after, _ = scene_of(red=PLACES["red"], blue=PLACES["blue"], green=PLACES["green"], orange=PLACES["orange"])
    field, ledger = field_with_ledger(before, labels, eyes, photographs(before, eyes))
    old = Scene(field, ColourEmbedder(), ledger=lambda: ledger)
    poses = [look_at(1.5 * np.array([np.cos(a), np.sin(a), 0.6]), up=UP) for a in (0.4, 0.1)]
    shown = cameras_of(poses, (80, 80, 48, 36), 96, 72)
    frames = photographs(after, shown)
    depths = np.stack([np.asarray(render_rgb(after, camera, depth=True).depth) for camera in shown])
    first, second = (capture_of(frames[[t]], shown[t : t + 1], np.zeros(1, bool), depths[[t]]) for t in range(2))
    second = dataclasses.replace(second, names=("f1",))
    assert old.add(dataclasses.replace(first, depths=None)).field.gaussians.count == field.gaussians.count
    new = old.add(first)
    assert new.field.gaussians.count > field.gaussians.count
    for grown, given in zip(*(jax.tree.leaves(f.gaussians) for f in (new.field, field)), strict=True):
        np.testing.assert_array_equal(np.asarray(grown)[: field.gaussians.count], given)
    assert new.field.regions.count == 4
    np.testing.assert_allclose(new.ask("orange").place.center[:2], PLACES["orange"], atol=0.06)
    np.testing.assert_allclose(new.ask("red").place.center[:2], PLACES["red"], atol=0.03)
    assert new.add(second).field.gaussians.count == new.field.gaussians.count
