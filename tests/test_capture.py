"""load_capture finds the format; options are checked."""

import numpy as np
import pytest
from capture_files import refused, small_capture, transforms, write_transforms

from experiments.rooms.writers import write_colmap
from jsecon.read.captures.capture import load_capture
from jsecon.read.captures.frames import evenly_spaced

CAPTURE = small_capture()


def test_formats_are_detected(tmp_path):
    write_colmap(CAPTURE, tmp_path / "colmap")
    write_transforms(CAPTURE, tmp_path / "nerfstudio")
    (tmp_path / "nerfstudio/transforms.json").rename(tmp_path / "nerfstudio/transforms_train.json")
    for path in ("colmap", "nerfstudio/transforms_train.json"):
        loaded = load_capture(tmp_path / path)
        np.testing.assert_array_equal(loaded.frames, CAPTURE.frames)
    (tmp_path / "nerfstudio/images").rename(tmp_path / "elsewhere")
    with refused("nerfstudio", "without poses", "transforms_train.json"):
        load_capture(tmp_path / "nerfstudio")
    with refused("nowhere", "no such file or folder"):
        load_capture(tmp_path / "nowhere")
    write_transforms(CAPTURE, tmp_path / "colmap", {**transforms(CAPTURE), "frames": []})
    assert len(load_capture(tmp_path / "colmap").points) == len(CAPTURE.points)


@pytest.mark.parametrize("options", [
    {"downscale": 0.5}, {"downscale": float("nan")}, {"long_side": 0}, {"frames": 0}, {"holdout": 1},
    {"holdout": -8},
])  # fmt: skip
def test_options_are_checked(tmp_path, options):
    write_colmap(CAPTURE, tmp_path)
    with refused(*options):
        load_capture(tmp_path, **options)


def test_options_and_progress(tmp_path):
    write_colmap(CAPTURE, tmp_path)
    calls = []
    loaded = load_capture(tmp_path, downscale=1.5, frames=4, holdout=None, progress=lambda *call: calls.append(call))
    assert loaded.frames.shape == (4, 11, 16, 3)
    np.testing.assert_allclose(loaded.cameras.fx, CAPTURE.cameras.fx[[0, 1, 3, 4]] / 1.5)
    np.testing.assert_allclose(loaded.cameras.fy, CAPTURE.cameras.fy[[0, 1, 3, 4]] * 11 / 16)
    assert not loaded.held_out.any()
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    same = load_capture(tmp_path, long_side=16, frames=4)
    np.testing.assert_array_equal(same.frames, loaded.frames)
    assert load_capture(tmp_path, long_side=100).frames.shape == CAPTURE.frames.shape
    single = load_capture(tmp_path, frames=1)
    assert not single.held_out.any()
    assert any("only one" in note for note in single.notes)


@pytest.mark.parametrize("count", [1, 2, 7, 50])
@pytest.mark.parametrize("wanted", [1, 2, 3, 7, 49, 100, None])
def test_spread(count, wanted):
    chosen = evenly_spaced(count, wanted)
    assert len(chosen) == min(count, wanted or count)
    assert chosen[0] == 0
    assert len(chosen) == 1 or chosen[-1] == count - 1
    gaps = np.diff(chosen)
    assert len(gaps) == 0 or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)
