"""Poses of bare photographs: found up to a similarity, kept, gone on with, and refused where they can't be."""

import dataclasses
import importlib.util
import itertools
import os
import shutil
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import refused
from photo_files import FOCAL, HEIGHT, WIDTH, apart, write_photos
from PIL import Image

from jsecon.app import cli
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console
from jsecon.pipeline.results import KEY_FILE, RunContext
from jsecon.pipeline.scene import plan_capture
from jsecon.poses import sfm
from jsecon.poses.sfm import find_poses
from jsecon.read.captures.capture import list_photographs, load_capture, read_posed_images
from jsecon.read.captures.images import read_image
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Models

COUNT = 8


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos") / "walk"
    return folder, write_photos(folder, COUNT)


@pytest.fixture(scope="module")
def found(photos, tmp_path_factory):
    """What structure from motion finds, where it works, and the progress on the way."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("no pycolmap")
    work, told = tmp_path_factory.mktemp("work"), []
    capture, notes = find_poses(list_photographs(photos[0]), work, progress=lambda *at: told.append(at))
    return capture, notes, work, told


def poses_are_true(found, true):
    distances, degrees = apart(np.asarray(found, np.float64), true)
    assert distances.max() < 0.005
    assert degrees.max() < 0.3


def test_poses_are_found_up_to_a_similarity_and_progress_counts(photos, found):
    folder, notes, _, counts = found
    capture = load_capture(folder, holdout=0)
    assert capture.names == tuple(f"photo {n:02d}" for n in range(COUNT))  # names with spaces
    assert capture.frames.shape[1:] == (HEIGHT, WIDTH, 3)
    assert len(capture.points) > 200
    assert len(notes) == 1
    assert f"{COUNT} of {COUNT} photographs, and {len(capture.points)} points" in notes[0]
    assert float(notes[0].split("error ")[1].split()[0]) < 0.5
    poses_are_true(capture.cameras.world_to_camera, photos[1])
    np.testing.assert_allclose(capture.cameras.fx, FOCAL, rtol=0.03)
    pairs = COUNT * (COUNT - 1) // 2
    assert (pairs, pairs) in counts
    assert counts[-1] == (COUNT, COUNT)
    assert all(0 <= done <= total for done, total in counts)


def test_an_incremental_model_replaces_a_global_one_that_fails(photos, found, tmp_path, monkeypatch):
    import pycolmap

    work = shutil.copytree(found[2], tmp_path / "work", symlinks=True)
    monkeypatch.setattr(pycolmap, "global_mapping", lambda *_: {0: pycolmap.Reconstruction()})
    model, count = sfm._map(pycolmap, COUNT, work, lambda *_: None)
    assert (model.num_reg_images(), count) == (COUNT, 1)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse" / "0")
    poses = {image.name: image.world_to_camera for image in read_posed_images(tmp_path).images}
    poses_are_true(np.stack([poses[name] for name in sorted(poses)]), photos[1])


def test_photographs_are_those_of_images_or_of_the_folder_itself(tmp_path):
    assert list_photographs(tmp_path / "nowhere") == []
    for name in ("b.JPG", "a.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in list_photographs(tmp_path)] == ["a.png", "b.JPG"]
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "c.webp").touch()
    assert [path.name for path in list_photographs(tmp_path)] == ["c.webp"]


def test_one_lens_for_the_photographs_of_one_camera_and_focal_length(photos, tmp_path):
    for number, focal in enumerate((35, 35, 50, None)):
        exif = Image.Exif()
        if focal is not None:
            exif[0x0110], exif.get_ifd(0x8769)[0x920A] = "camera", float(focal)
        Image.new("RGB", (32, 24)).save(tmp_path / f"{number}.jpg", exif=exif)
    assert sfm._lens_groups(list_photographs(tmp_path), 4 * [(32, 24)]) == [[0, 1], [2], [3]]
    assert sfm._lens_groups(list_photographs(tmp_path), [(32, 24), *(3 * [(24, 32)])]) == [[0], [1], [2], [3]]
    assert sfm._lens_groups(list_photographs(photos[0]), COUNT * [(WIDTH, HEIGHT)]) == [list(range(COUNT))]


def test_many_photographs_are_matched_with_neighbours_and_with_those_that_look_alike(found, tmp_path, monkeypatch):
    """Every photograph as often as once before: its double is far away in the order of names.

    Half of the others are asked for: the made-up photographs repeat few patterns, so a double is not always the first.
    """
    import pycolmap

    monkeypatch.setattr(sfm, "ALL_PAIRS", 4)
    monkeypatch.setattr(sfm, "NEIGHBOURS", 1)
    monkeypatch.setattr(sfm, "ALIKE", COUNT)
    with (
        pycolmap.Database.open(found[2] / "database.db") as once,
        pycolmap.Database.open(tmp_path / "database.db") as db,
    ):
        for image in sorted(once.read_all_images(), key=lambda image: image.name):
            if not db.num_cameras():
                camera = once.read_camera(image.camera_id)
                camera_id = db.write_camera(camera)
            for turn in range(2):
                number = db.write_image(pycolmap.Image(name=f"{turn}{image.name}", camera_id=camera_id))
                db.write_keypoints(number, once.read_keypoints(image.image_id))
                db.write_descriptors(number, once.read_descriptors(image.image_id))
        names = {image.image_id: image.name for image in db.read_all_images()}
    listed = []
    monkeypatch.setattr(
        pycolmap, "match_image_pairs", lambda *_, **__: listed.append((tmp_path / "pairs.txt").read_text())
    )
    sfm._match(pycolmap, tmp_path, lambda *_: None)
    pairs = {frozenset(line.split()) for text in listed for line in text.splitlines()}
    for name in names.values():
        if name.startswith("0"):
            assert {name, "1" + name[1:]} in pairs
    ordered = sorted(names.values())
    assert all({a, b} in pairs for a, b in itertools.pairwise(ordered))
    assert len(pairs) < 0.9 * COUNT * (2 * COUNT - 1)  # all pairs


def test_a_photograph_whose_matches_become_no_points_makes_a_model_inconsistent(found):
    import pycolmap

    database = found[2] / "database.db"
    model = pycolmap.Reconstruction(found[0] / "sparse" / "0")
    assert sfm._is_consistent(pycolmap, database, model, COUNT)
    assert not sfm._is_consistent(pycolmap, database, model, COUNT + 1)
    assert not sfm._is_consistent(pycolmap, database, None, COUNT)
    image = next(iter(model.images.values()))
    for index, point in enumerate(image.points2D):
        if point.has_point3D():
            model.delete_observation(image.image_id, index)
    assert not sfm._is_consistent(pycolmap, database, model, COUNT)


def test_without_pycolmap_the_message_has_the_line_to_run(photos, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with refused("pip install 'jsecon[sfm]'", "walk"):
        find_poses(list_photographs(photos[0]), tmp_path, where=photos[0])
    assert cli.main(["run", str(photos[0]), "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr()
    assert "poses            run       found by structure from motion (pycolmap) for 8 photographs" in told.out
    assert "pip install 'jsecon[sfm]'" in told.err


def _damaged(path):
    path.write_bytes(path.read_bytes()[:2000])


def _of_two_endings(path):
    shutil.copy(path, path.with_suffix(".jpg"))


@pytest.mark.parametrize(("spoil", "says"), [(_damaged, "cannot be read"), (_of_two_endings, "photo 03.jpg")])
def test_photographs_that_are_damaged_or_called_the_same_are_refused(photos, tmp_path, spoil, says):
    folder = shutil.copytree(photos[0], tmp_path / "walk")
    spoil(folder / "photo 03.png")
    with refused("photo 03.png", says):
        find_poses(list_photographs(folder), tmp_path / "work")


def test_what_was_stopped_goes_on_with_what_was_found_though_the_photographs_have_moved(photos, found, tmp_path):
    """Into two folders, with the same names in each, one folder's name in Latin-1. Features and pairs of a process that
    was killed are not looked for again; nothing is left of what it half did."""
    folders = [tmp_path / "walk" / name for name in ("cam 0", os.fsdecode(b"c\xe9 #1"))]
    for number, photo in enumerate(list_photographs(photos[0])):
        folder = folders[number // 4]
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(photo, folder / f"{number % 4}.png")
    shutil.copytree(found[2], tmp_path / "work", symlinks=True)
    told = []
    photographs = list_photographs(tmp_path / "walk")
    capture, _ = find_poses(photographs, tmp_path / "work", progress=lambda *at: told.append((*at, time.monotonic())))
    matched = max(at for done, total, at in told if total == COUNT * (COUNT - 1) // 2)
    assert matched - told[0][2] < 2  # no features and no pairs
    moved, plain = load_capture(capture, holdout=0), load_capture(found[0], holdout=0)
    assert moved.names == tuple(f"{folder.name}_{n}" for folder in folders for n in range(4))
    np.testing.assert_array_equal(moved.frames, plain.frames)


def test_photographs_in_subfolders_are_told_from_masks_and_from_output(photos, tmp_path):
    for name in (
        *("cam0/i0.jpg", "cam0/i1.JPG", "cam1/deep/i0.png", ".thumbs/i0.jpg", "cam0/notes.txt"),
        *("cam0/i0.jpg.png", "masks/i0.png", "cam1_depth/i0.png", "f/cache/CACHEDIR.TAG", "f/poses/images/i0.jpg"),
        *("answers/answers.html", "answers/mask.png"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert [str(p.relative_to(tmp_path)) for p in list_photographs(tmp_path)] == [
        *("cam0/i0.jpg", "cam0/i1.JPG", "cam1/deep/i0.png")
    ]
    with refused("3 photographs without poses", "jsecon run"):
        load_capture(tmp_path)
    (tmp_path / "empty").mkdir()
    with refused("empty folder"):
        load_capture(tmp_path / "empty")
    (tmp_path / "cam1" / "transforms.json").write_text("{}")  # captures beside each other are not one
    with refused("own folder", str(tmp_path / "cam1")):
        load_capture(tmp_path)


def test_an_output_folder_among_the_photographs_is_no_input(photos, tmp_path):
    """Its own, that of another run beside it, links in them to the photographs, and the scene of a fit."""
    folder = shutil.copytree(photos[0], tmp_path / "walk")

    def stage(out):
        work = RunContext(Options(folder), Models(ColourEmbedder()), out)
        return plan_capture(work)[0].key({}, out)

    before = stage(folder / "f")
    assert stage(folder / "g") == before
    for name in ("f", "g"):
        (folder / name / "cache").mkdir(parents=True)
        (folder / name / "cache" / "CACHEDIR.TAG").touch()
        (folder / name / "poses" / "images").mkdir(parents=True)
        (folder / name / "poses" / "images" / "photo 00.png").symlink_to(folder / "photo 00.png")
        (folder / f"{name}.ply").touch()
    assert stage(folder / "f") == stage(folder / "g") == before
    (folder / "photo 08.png").touch()
    assert stage(folder / "f") != before


def test_photographs_that_show_nothing_in_common_are_refused(photos, tmp_path):
    with refused("2 photographs", "walk"):
        find_poses(list_photographs(photos[0])[:2], tmp_path / "work", where=photos[0])
    for number in range(3):
        Image.new("RGB", (64, 48), (80 * number, 9, 9)).save(tmp_path / f"{number}.png")
    with refused("match each other"):
        find_poses(list_photographs(tmp_path), tmp_path / "work")


def test_a_crash_of_colmap_is_reported_with_its_log(photos, tmp_path):
    (tmp_path / "database.db").write_bytes(b"no database" * 500)
    with refused("pycolmap", "code", "log.txt"):
        find_poses(list_photographs(photos[0]), tmp_path)
    assert (tmp_path / "log.txt").stat().st_size > 0


class Loaded(Exception):
    """The frames are there: what comes after is not looked at."""


class UntilLoaded(Console):
    """Keeps what it is told, and stops the run once the frames are there."""

    def __init__(self):
        super().__init__()
        self.planned, self.notes = {}, []

    def step(self, step):
        self.planned.setdefault(step.name, step.status)

    def note(self, text):
        self.notes.append(text)
        if "held out" in text:  # what load says
            raise Loaded


@pytest.fixture
def at_once(found, monkeypatch):
    """Structure from motion that takes no time: what the fixture found; how often it was asked."""
    asked = []

    def copied(photos, work, *, where, progress):
        asked.append(where)
        return Path(shutil.copytree(found[0], work / "capture", symlinks=True)), found[1]

    monkeypatch.setattr("jsecon.pipeline.scene.find_poses", copied)
    return asked


def test_a_run_finds_the_poses_first_and_keeps_them(photos, at_once, tmp_path):
    out, options = tmp_path / "out", Options(photos[0], holdout=4)

    def again(**changes):
        console = UntilLoaded()
        with pytest.raises(Loaded):
            pipeline.run(dataclasses.replace(options, **changes), out, console=console)
        return console

    first = again()
    assert list(first.planned)[:2] == ["poses", "load"]
    assert any("8 of 8 photographs" in note and "reprojection error 0." in note for note in first.notes)
    assert any(note.startswith("8 frames of") and "2 of them held out" in note for note in first.notes)
    assert {path.name for path in (out / "poses").iterdir()} == {"images", "sparse", KEY_FILE}
    assert len(list((out / "poses" / "images").iterdir())) == COUNT
    assert not list((out / "cache").glob("poses-*.checkpoint"))
    second = again()
    assert second.planned["poses"] == second.planned["load"] == "cached"
    shutil.rmtree(out / "poses")  # nobody needs it while the frames are cached
    assert again().planned["poses"] == "cached"
    assert len(at_once) == 1
    third = again(long_side=200)
    assert third.planned["poses"] == third.planned["load"] == "run"
    (out / "poses" / KEY_FILE).write_text("another capture's")
    assert again(long_side=240).planned["poses"] == "run"
    assert len(at_once) == 3


def test_only_captures_without_poses_have_the_stage(photos, room, found, tmp_path):
    def names(capture):
        work = RunContext(Options(capture), Models(ColourEmbedder()), tmp_path)
        return [stage.name for stage in plan_capture(work)]

    assert names(photos[0]) == ["poses", "load"]
    for capture in (room, found[0], tmp_path):
        assert names(capture) == ["load"]
    shutil.copytree(photos[0], tmp_path / "images")
    assert names(tmp_path) == ["poses", "load"]
    (tmp_path / "transforms.json").write_text("{}")
    assert names(tmp_path) == ["load"]


def test_colmap_is_given_a_png_for_a_heic(photos, tmp_path):
    import pillow_heif

    image = read_image(list_photographs(photos[0])[0])[0]
    shape = image.shape[1::-1]
    pillow_heif.from_bytes("RGB", shape, image.tobytes()).save(tmp_path / "IMG_1.HEIC", quality=95)
    assert list_photographs(tmp_path) == [tmp_path / "IMG_1.HEIC"]
    sfm._link(tmp_path / "IMG_1.HEIC", tmp_path / "links" / "000000.png", upright_copy=True)
    np.testing.assert_array_equal(
        cv2.imread(tmp_path / "links" / "000000.png")[..., ::-1], read_image(tmp_path / "IMG_1.HEIC")[0]
    )


@pytest.mark.long
def test_the_bonsai_is_found_as_its_poses_are_given(shared, tmp_path):
    capture = shared / "captures" / "bonsai"
    folder, notes = find_poses(list_photographs(capture), tmp_path)
    assert "125 of 125 photographs" in notes[0]
    assert float(notes[0].split("error ")[1].split()[0]) < 0.4
    ours, theirs = (load_capture(path, holdout=0, long_side=32).cameras.world_to_camera for path in (folder, capture))
    distances, degrees = apart(np.asarray(ours, np.float64), np.asarray(theirs, np.float64))
    assert np.median(distances) < 0.005
    assert np.median(degrees) < 0.5
    assert np.max(distances) < 0.01
