"""A phrase to Gaussians: SAM 3 is asked in frames of the capture, and what most of them find of it is selected."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
from clip_files import COLOURS
from sam3_files import write_sam3

from jsecon import InputError, lift, load_field, load_ply
from jsecon.app import cli
from jsecon.app.phrases import lift_phrase, load_frames
from jsecon.networks.sam3 import PhraseMasks


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_sam3(tmp_path_factory.mktemp("sam3"), side=448)


@pytest.fixture(scope="module")
def painted(room, tmp_path_factory):
    """The room's capture with one thing in red on grey, as its masks have it, and that thing's region."""
    folder = shutil.copytree(room, tmp_path_factory.mktemp("painted") / "capture")
    masks = {path.stem: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (room / "masks").glob("*.png")}
    counts = np.stack([np.bincount(masks[name].ravel(), minlength=1 << 8) for name in sorted(masks)])
    thing = 1 + counts[[0, -1], 1:].min(0).argmax()  # the largest that the first and the last frame both show
    for path in (folder / "images").iterdir():
        image = np.where((masks[path.stem] == thing)[..., None], 255 * np.array(COLOURS["red"])[::-1], 200)
        cv2.imwrite(str(path), image.astype(np.uint8))
    return folder, np.flatnonzero(np.flatnonzero(counts.sum(0)) == thing)[0] - 1


def _query(field, out, *options):
    return cli.main(["query", str(field), *map(str, options), "--out", str(out)])


def test_query_selects_what_a_phrase_names_in_the_frames(room_run, painted, model, tmp_path, capsys):
    run, out = room_run
    capture, region = painted
    asked = "red mug", "green mug", "mug " * 40, "--phrases", model, "--images", capture, "--looks", 2, "--views", 1
    assert _query(out / "field.safetensors", tmp_path, *asked) == 2  # one of them is too long
    told = capsys.readouterr()
    assert "a phrase of 42 tokens" in told.err
    assert "'red mug': seen in 2 of 2 frames" in told.out
    assert "'green mug': seen in 0 of 2 frames" in told.out
    answer = json.loads((tmp_path / "red-mug.json").read_text())
    assert answer["by"] == "phrase"
    assert answer["region"] == region
    assert set(answer["frames"]) == {run.capture.names[0], run.capture.names[-1]}
    assert all(0.5 < score <= 1 for scores in answer["frames"].values() for score in scores)
    chosen = load_ply(tmp_path / answer["ply"])
    assert chosen.count == answer["count"] > 0
    none = json.loads((tmp_path / "green-mug.json").read_text())
    assert (none["count"], none["region"], none["ply"]) == (0, None, None)
    assert list(none["frames"].values()) == [[], []]


def test_a_frame_without_masks_has_its_say(room_run):
    field = load_field(room_run[1] / "field.safetensors")
    height, width = field.cameras.height, field.cameras.width
    large = np.zeros((2, 2 * height, 2 * width), bool)
    large[0, 60:150, 80:200] = large[1, 90:200, 100:240] = True
    seen = PhraseMasks(large, np.float32([0.9, 0.8])), PhraseMasks(large[:0], np.float32([]))
    answer = lift_phrase(field, "mug", dict(zip((1, 2), seen)), threshold=0.5, outliers=False)
    union = large.any(0)[::2, ::2]  # the masks of a frame are one outline, at the field's size
    expected = lift(field, np.stack([union, np.zeros_like(union)]), [1, 2])
    np.testing.assert_array_equal(answer.mask, expected.mask)
    assert answer.frames == {field.names[1]: [0.9, 0.8], field.names[2]: []}
    assert answer.dropped == 0


def test_frames_are_those_of_the_field_at_the_size_of_their_files(room_run, room, tmp_path):
    field = load_field(room_run[1] / "field.safetensors")
    frames = load_frames(field, room_run[1], 3)
    assert list(frames) == [0, 4, 7]
    np.testing.assert_array_equal(frames[4], room_run[0].capture.frames[4])
    (tmp_path / "poses").mkdir()
    with pytest.raises(InputError, match="poses"):
        load_frames(field, tmp_path, 3)
    another = dataclasses.replace(field, names=(*field.names[:7], "another"))
    with pytest.raises(InputError, match="no frame called another among the 8"):
        load_frames(another, room_run[1], 3, room)
    wide = dataclasses.replace(field, cameras=dataclasses.replace(field.cameras, width=200))
    with pytest.raises(InputError, match="frames of 160x120, expected 200x120, or the same shape"):
        load_frames(wide, room_run[1], 3, room)
    moved = dataclasses.replace(field, provenance="{}")
    with pytest.raises(InputError, match="--images DIR"):
        load_frames(moved, room_run[1], 3)
    with pytest.raises(InputError, match="--looks"):
        load_frames(field, room_run[1], 0)


@pytest.mark.parametrize(("options", "says"), [
    (["--phrases", "MODEL"], "there is no query"),
    (["--at", "#0", 3, 3, "--phrases", "MODEL"], "--phrases: there is no text"),
    (["red", "--phrases", "MODEL", "--all", "--by", "code"], "--by --all"),
    (["red", "--images", "x"], "--images: it needs --phrases"),
    (["red", "--looks", "3"], "--looks: it needs --phrases"), (["red", "--phrases", "nowhere"], "no such folder"),
    (["red", "--phrases", "MODEL", "--images", "nowhere"], "nowhere: there is no such file or folder"),
])  # fmt: skip
def test_phrases_that_cannot_be_asked(room_run, model, tmp_path, capsys, options, says):
    options = [model if option == "MODEL" else option for option in options]
    assert _query(room_run[1] / "field.safetensors", tmp_path, *options) == 2
    assert says in capsys.readouterr().err
