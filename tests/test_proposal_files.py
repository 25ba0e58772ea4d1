"""Masks of single frames from disk: SAM's own JSON, LangSplat's files, PNGs, whichever a frame has."""

import json
import tempfile
from pathlib import Path

import numpy as np
from capture_files import run_lengths
from hypothesis import given, settings, strategies as st

from jsecon.read.masks.masks import load_proposals

SIZE = (20, 30)


def records(masks, scores=None):
    """As scripts/amg.py of segment-anything writes them."""
    found = []
    for mask in masks:
        rle = run_lengths(mask)
        found.append({"segmentation": rle | {"counts": text_of(rle["counts"])}, "area": int(mask.sum())})
    for record, score in zip(found, scores or []):
        record |= {"predicted_iou": score, "stability_score": 0.9}
    return found


def test_json_of_sams_generator_may_overlap_and_is_ordered_by_score(tmp_path):
    """Three masks, the second inside of the first."""
    masks = np.zeros((3, *SIZE), bool)
    masks[0, 2:12, 3:20] = masks[1, 4:8, 5:9] = masks[2, 14:19, 10:28] = True
    (tmp_path / "a.json").write_text(json.dumps(records(masks, [0.8, 0.95, 0.9])))
    (tmp_path / "b.json").write_text(json.dumps({"image": {"image_id": 1}, "annotations": records(masks)}))
    read, notes = load_proposals(tmp_path, ("a", "b", "c"), SIZE)
    np.testing.assert_array_equal(read(0), masks[[1, 2, 0]])
    np.testing.assert_array_equal(read(1), masks)
    assert read(2).shape == (0, *SIZE)
    assert notes == ("1 of 3 frames have no masks (the first: c).",)


def text_of(runs) -> str:
    """The 6-bit digits of runs, written the other way round from how they are read: by twos' complement."""
    text = ""
    for n, run in enumerate(runs):
        value = run - runs[n - 2] if n > 2 else run
        while True:
            digit, value = value & 31, value >> 5
            more = value != (-1 if digit & 16 else 0)
            text += chr(48 + (digit | 32 if more else digit))
            if not more:
                break
    return text


def decoded(rle) -> np.ndarray:
    """The mask of a run-length encoding."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.json").write_text(json.dumps([{"segmentation": rle}]))
        return load_proposals(folder, ("a",), tuple(rle["size"]))[0](0).any(0)  # a mask without pixels is none


def test_the_example_of_cocos_own_tests():
    mask = np.zeros(90, bool)
    mask[[6, *range(47, 51), *range(56, 60), *range(65, 69)]] = True
    for counts in ("61X13mN000`0", [6, 1, 40, 4, 5, 4, 5, 4, 21]):
        np.testing.assert_array_equal(decoded({"size": [9, 10], "counts": counts}).T.ravel(), mask)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 70), st.floats(0, 1))
def test_every_mask_comes_back(seed, height, width, density):
    rng = np.random.default_rng(seed)
    mask = np.kron(rng.random((height, width)) < density, np.ones((1, rng.integers(1, 9)), bool)) > 0
    rle = run_lengths(mask)
    for counts in (rle["counts"], text_of(rle["counts"])):
        np.testing.assert_array_equal(decoded(rle | {"counts": counts}), mask)
