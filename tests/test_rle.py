"""COCO's run-length encoding: a published example, and every mask comes back from its own code."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jsecon.data.rle import decode_rle
from jsecon.errors import InputError


def runs_of(mask) -> list[int]:
    """Lengths of runs down the columns, of 0 first."""
    flat = np.concatenate([[False], mask.T.ravel()])
    edges = np.flatnonzero(np.diff(flat)) + 0
    return np.diff([0, *edges, mask.size]).tolist()


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


def test_the_example_of_cocos_own_tests():
    counts = [6, 1, 40, 4, 5, 4, 5, 4, 21]
    mask = decode_rle({"size": [9, 10], "counts": "61X13mN000`0"}, "here")
    np.testing.assert_array_equal(mask, decode_rle({"size": [9, 10], "counts": counts}, "here"))
    assert mask.sum() == 1 + 4 + 4 + 4
    assert np.argwhere(mask.T.ravel())[0] == 6


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 70), st.floats(0, 1))
def test_every_mask_comes_back(seed, height, width, density):
    rng = np.random.default_rng(seed)
    mask = np.kron(rng.random((height, width)) < density, np.ones((1, rng.integers(1, 9)), bool)) > 0
    size = list(mask.shape)
    for counts in (runs_of(mask), text_of(runs_of(mask))):
        np.testing.assert_array_equal(decode_rle({"size": size, "counts": counts}, "here"), mask)


@pytest.mark.parametrize(
    ("rle", "words"),
    [
        ({"size": [9, 10], "counts": "61X13mN000"}, "69 of 9x10"),
        ({"size": [9, 10], "counts": "61X13mN000`"}, "breaks off"),
        ({"size": [9, 10], "counts": "61 X"}, "is no digit"),
        ({"size": [9, 10], "counts": [-10, 100]}, "90 of 9x10"),
        ({"size": [0, 10], "counts": []}, "0 of 0x10"),
        ({"size": [9, 10]}, "KeyError"),
        ([[10, 10, 20, 20, 10, 20]], "TypeError"),
        ({"size": [2, 2], "counts": "abc\u00e9"}, "is no digit"),
    ],
)
def test_what_is_no_mask_is_refused_where_it_lies(rle, words):
    with pytest.raises(InputError, match=words) as caught:
        decode_rle(rle, "frame_0001.json, mask 3")
    assert caught.value.where == "frame_0001.json, mask 3"
