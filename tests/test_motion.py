"""Poses of bare photographs: found up to a similarity, kept, gone on with, and refused where they can't be."""

import os
import shutil
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import context_of, png, refused
from photo_files import FOCAL, HEIGHT, WIDTH, apart, write_photos
from PIL import Image

from jsecon.pipeline.run import _compute_stages
from jsecon.pipeline.scene_stages import plan_capture
from jsecon.poses import sfm
from jsecon.poses.sfm import find_poses
from jsecon.read.captures.capture import load_capture, read_posed_images, unposed_photographs

COUNT = 8


def photographs_of(folder) -> list[Path]:
    return unposed_photographs(folder)[0]


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos") / "walk"
    return folder, write_photos(folder, COUNT)


@pytest.fixture(scope="module")
def found(photos, tmp_path_factory):
    """What structure from motion finds, where it works, and the progress on the way."""
    pytest.importorskip("pycolmap")
    work, told = tmp_path_factory.mktemp("work"), []
    capture, notes = find_poses(photographs_of(photos[0]), work, progress=lambda *at: told.append(at))
    return capture, notes, work, told


def poses_are_true(found, true):
    distances, degrees = apart(np.asarray(found, np.float64), true)
    assert distances.max() < 0.005
    assert degrees.max() < 0.3


def test_poses_are_found_up_to_a_similarity_and_progress_counts(photos, found):
    folder, notes, _, counts = found
    capture = load_capture(folder, holdout=0)
    assert capture.names == tuple(f"photo {n:02d}" for n in range(COUNT))  # names with spaces
    assert len(capture.points) > 200
    assert f"{COUNT} of {COUNT} photographs, and {len(capture.points)} points" in notes[0]
    assert float(notes[0].split("error ")[1].split()[0]) < 0.5
    poses_are_true(capture.cameras.world_to_camera, photos[1])
    np.testing.assert_allclose(capture.cameras.fx, FOCAL, rtol=0.03)
    assert counts[-1] == (COUNT, COUNT)


def test_an_incremental_model_replaces_a_global_one_that_contradicts_matches(photos, found, tmp_path, monkeypatch):
    import pycolmap

    work = shutil.copytree(found[2], tmp_path / "work", symlinks=True)
    model = pycolmap.Reconstruction(found[0] / "sparse" / "0")
    assert sfm._is_consistent(pycolmap, work / "database.db", model, COUNT)
    image = next(iter(model.images.values()))
    for index, point in enumerate(image.points2D):  # a photograph whose matches become no points
        if point.has_point3D():
            model.delete_observation(image.image_id, index)
    monkeypatch.setattr(pycolmap, "global_mapping", lambda *_: {0: model})
    model, count = sfm._map(pycolmap, COUNT, work, lambda *_: None)
    assert (model.num_reg_images(), count) == (COUNT, 1)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_binary(tmp_path / "sparse" / "0")
    poses = {image.name: image.world_to_camera for image in read_posed_images(tmp_path).images}
    poses_are_true(np.stack([poses[name] for name in sorted(poses)]), photos[1])


def test_one_lens_for_the_photographs_of_one_camera_and_focal_length(photos, tmp_path):
    for number, focal in enumerate((35, 35, 50, None)):
        exif = Image.Exif()
        if focal is not None:
            exif[0x0110], exif.get_ifd(0x8769)[0x920A] = "camera", float(focal)
        Image.new("RGB", (32, 24)).save(tmp_path / f"{number}.jpg", exif=exif)
    assert sfm._lens_groups(photographs_of(tmp_path), 4 * [(32, 24)]) == [[0, 1], [2], [3]]
    assert sfm._lens_groups(photographs_of(tmp_path), [(32, 24), *(3 * [(24, 32)])]) == [[0], [1], [2], [3]]
    assert sfm._lens_groups(photographs_of(photos[0]), COUNT * [(WIDTH, HEIGHT)]) == [list(range(COUNT))]


def test_without_pycolmap_the_message_has_the_line_to_run(photos, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with refused("pip install 'jsecon[sfm]'", "walk"):
        find_poses(photographs_of(photos[0]), tmp_path, where=photos[0])


@pytest.mark.parametrize(("spoil", "says"), [
    ("one damaged", ("photo 03.png", "cannot be read")), ("two endings", ("photo 03.png", "photo 03.jpg")),
    ("two photographs", ("2 photographs", "walk")), ("nothing in common", ("match each other",)),
    ("a crash", ("pycolmap", "code", "log.txt")),
])  # fmt: skip
def test_photographs_without_a_model_are_refused(photos, tmp_path, spoil, says):
    folder = shutil.copytree(photos[0], tmp_path / "walk")
    photographs, work = photographs_of(folder), tmp_path / "work"
    if spoil == "one damaged":
        photographs[3].write_bytes(photographs[3].read_bytes()[:2000])
    elif spoil == "two endings":
        photographs.append(Path(shutil.copy(photographs[3], folder / "photo 03.jpg")))
    elif spoil == "two photographs":
        photographs = photographs[:2]
    elif spoil == "nothing in common":
        for number, photo in enumerate(photographs):
            Image.new("RGB", (64, 48), (30 * number, 9, 9)).save(photo)
    else:
        work.mkdir()
        (work / "database.db").write_bytes(b"no database" * 500)
    with refused(*says):
        find_poses(photographs, work, where=folder)


def test_what_was_stopped_goes_on_with_what_was_found_though_the_photographs_have_moved(photos, found, tmp_path):
    """Into two folders, with the same names in each, one folder's name in Latin-1. Features and pairs of a process that
    was killed are not looked for again; nothing is left of what it half did."""
    folders = [tmp_path / "walk" / name for name in ("cam 0", os.fsdecode(b"c\xe9 #1"))]
    for number, photo in enumerate(photographs_of(photos[0])):
        folder = folders[number // 4]
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(photo, folder / f"{number % 4}.png")
    shutil.copytree(found[2], tmp_path / "work", symlinks=True)
    told = []
    photographs = photographs_of(tmp_path / "walk")
    capture, _ = find_poses(photographs, tmp_path / "work", progress=lambda *at: told.append((*at, time.monotonic())))
    matched = max(at for done, total, at in told if total == COUNT * (COUNT - 1) // 2)
    assert matched - told[0][2] < 2  # no features and no pairs
    moved, plain = load_capture(capture, holdout=0), load_capture(found[0], holdout=0)
    assert moved.names == tuple(f"{folder.name}_{n}" for folder in folders for n in range(4))
    np.testing.assert_array_equal(moved.frames, plain.frames)


def test_photographs_in_subfolders_are_told_from_masks_and_from_output(photos, tmp_path):
    photographs = ["cam0/i0.jpg", "cam0/i1.JPG", "cam1/deep/i0.HEIC"]
    others = ["cam0/i0.jpg.png", "masks/i0.png", "cam1_depth/i0.png", "f/cache/CACHEDIR.TAG", "f/poses/images/i0.jpg"]
    others += [".thumbs/i0.jpg", "cam0/notes.txt", "answers/answers.html", "answers/mask.png"]
    _touch(tmp_path, *photographs, *others)
    assert [str(p.relative_to(tmp_path)) for p in photographs_of(tmp_path)] == photographs
    _touch(tmp_path / "inside", "a.png", "images/b.webp")  # photographs in images/ are those of the capture
    assert photographs_of(tmp_path / "inside") == [tmp_path / "inside" / "images" / "b.webp"]
    shutil.rmtree(tmp_path / "inside")
    with refused("3 photographs without poses", "jsecon run"):
        load_capture(tmp_path)
    (tmp_path / "empty").mkdir()
    with refused("empty folder"):
        load_capture(tmp_path / "empty")
    (tmp_path / "cam1" / "transforms.json").write_text("{}")  # captures beside each other are not one
    with refused("own folder", str(tmp_path / "cam1")):
        load_capture(tmp_path)


def test_a_run_finds_the_poses_first_and_keeps_them_with_its_output_among_the_photographs(photos, found, tmp_path):
    """Structure from motion takes no time here: it gives what the fixture found."""
    folder, asked = shutil.copytree(photos[0], tmp_path / "walk"), []
    out, other = folder / "f", folder / "g"

    def copied(photos, work, *, panoramas, where, progress):
        asked.append(where)
        return Path(shutil.copytree(found[0], work / "capture", symlinks=True)), found[1]

    def again(**changes):
        context = context_of(folder, out, holdout=4, **changes)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("jsecon.pipeline.scene_stages.find_poses", copied)
            done = _compute_stages(context, plan_capture(context))
        return {step.name: step.status for step in done.steps}, " ".join(done.notes)

    ran, cached = {"poses": "run", "load": "run"}, {"poses": "cached", "load": "cached"}
    steps, notes = again()
    assert steps == ran
    assert "8 of 8 photographs" in notes
    assert "2 of them held out" in notes
    poses = next(path for path in (out / "cache").glob("poses-*") if path.is_dir())
    assert {path.name for path in poses.iterdir()} == {"images", "sparse"}
    assert not list((out / "cache").glob("poses-*.checkpoint"))
    shutil.copytree(out, other, symlinks=True)  # of another run: its links to the photographs, and the scene of a fit
    for scene in (out, other):
        scene.with_suffix(".ply").touch()
    assert again()[0] == cached
    assert again(long_side=200)[0] == cached | {"load": "run"}
    assert len(asked) == 1
    shutil.copy(folder / "photo 00.png", folder / "photo 08.png")
    assert again()[0] == ran
    assert len(asked) == 2


@pytest.mark.long
def test_the_bonsai_is_found_as_its_poses_are_given(shared, tmp_path):
    capture = shared / "captures" / "bonsai"
    folder, notes = find_poses(sorted((capture / "images").iterdir()), tmp_path)
    assert "125 of 125 photographs" in notes[0]
    assert float(notes[0].split("error ")[1].split()[0]) < 0.4
    ours, theirs = (load_capture(path, holdout=0, long_side=32).cameras.world_to_camera for path in (folder, capture))
    distances, degrees = apart(np.asarray(ours, np.float64), np.asarray(theirs, np.float64))
    assert np.median(distances) < 0.005
    assert np.median(degrees) < 0.5
    assert np.max(distances) < 0.01


def _touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


@pytest.mark.parametrize("others", [
    ["0001_mask.png", "0002_mask.png"], ["depth0001.png"], ["0001.jpg.png"], ["mask-0003.png"],
])  # fmt: skip
def test_images_named_like_others_with_a_word_more_are_no_photographs(tmp_path, others):
    names = ["0001.jpg", "0002.jpg", "0003.jpg", "mask of zorro.jpg", "0003_b.jpg"]
    _touch(tmp_path, *names, *others)
    photographs, notes = unposed_photographs(tmp_path)
    assert [path.name for path in photographs] == sorted(names)
    assert f"{len(others)} images are left out" in notes[0]
    assert others[0] in notes[0]


@pytest.mark.parametrize("kind", ["16 bits", "1 bit"])
def test_depth_maps_and_masks_of_any_name_are_told_by_their_bits(tmp_path, kind):
    _touch(tmp_path, "a.jpg", "b.jpg")
    numbers = np.arange(12).reshape(3, 4)
    if kind == "16 bits":
        cv2.imwrite(str(tmp_path / "c.png"), numbers.astype(np.uint16))
    else:
        (tmp_path / "c.png").write_bytes(png(numbers % 2, bits=1, colour_type=0))
    assert [path.name for path in photographs_of(tmp_path)] == ["a.jpg", "b.jpg"]
    for name in "ab":
        (tmp_path / f"{name}.jpg").unlink()
    with refused(tmp_path.name, "without poses and photographs", "c.png"):
        load_capture(tmp_path)


@pytest.mark.parametrize(("others", "says"), [
    (["poses_bounds.npy"], "may be poses"), (["notes.txt"], ""),
    (["cams/a.txt"], "may be poses"), (["cameras.json.txt", "pose/c.npy"], "may be poses"),
    (["IMG_1.dng", "walk.mov"], "not read here"),
])  # fmt: skip
def test_what_lies_beside_photographs_and_is_not_used_is_named_in_the_plan(tmp_path, others, says):
    _touch(tmp_path, *others)
    for name in "abc":
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), np.zeros((6, 8, 3), np.uint8))
    stage = plan_capture(context_of(tmp_path, tmp_path / "f"))[0]
    assert "3 photographs" in stage.task
    assert (others[0].partition("/")[0] in stage.task) == bool(says)
    assert says in stage.task


@pytest.mark.parametrize(("names", "head", "says"), [
    (["a.mp4"], b"", "jsecon run {}/a.mp4"), (["a.mov", "b.mov"], b"", "run {}/a.mov"),
    (["images/a.gif"], b"", "1 .gif"), (["a.spz", "notes.txt"], b"", "jsecon run {}/a.spz"),
    (["cameras.json", "point_cloud/iteration_7/point_cloud.ply"], b"", "{}/point_cloud/iteration_7/point_cloud.ply"),
    (["a.r3d"], b"PK\3\4", "a zip archive"), (["a.tgz"], b"\x1f\x8b", "a gzip archive"),
    (["a.jpg"], b"\xff\xd8", "'.jpg' is not a capture"),
])  # fmt: skip
def test_a_folder_without_photographs_and_a_file_that_is_no_capture_are_named(tmp_path, names, head, says):
    """A file begins with the bytes `head`."""
    _touch(tmp_path, *names)
    if head:
        (tmp_path / names[0]).write_bytes(head + bytes(99))
    with refused(names[0] if head else tmp_path, says.format(tmp_path)):
        load_capture(tmp_path / names[0] if head else tmp_path)
