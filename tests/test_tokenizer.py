"""Tokenizers: open_clip's ids (in clip_tokens.json), and a message for files that are no such tokenizer."""

import json

import numpy as np
import pytest
from clip_files import fixture, vocabulary, write_tokenizer
from hypothesis import given, settings, strategies as st
from tokenizers import decoders

from jsecon.errors import InputError
from jsecon.networks.tokenizer import CLIP_LENGTH, TextTokenizer

START, END = "<|startoftext|>", "<|endoftext|>"


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> TextTokenizer:
    return TextTokenizer(write_tokenizer(tmp_path_factory.mktemp("clip") / "tokenizer.json"), None)


def test_ids_are_those_of_open_clip(tokenizer):
    """Without the repair of mis-decoded characters, which the fixture leaves out."""
    texts, expected = zip(*fixture()["cases"])
    assert len(texts) > 90
    for text, row, ids in zip(texts, tokenizer(texts, CLIP_LENGTH)[0], expected):
        assert row.tolist() == ids, text


def test_typographic_quotes_are_straight_ones_and_half_a_character_is_no_error(tokenizer):
    pairs = ("the mug\u2019s \u201chandle\u201d", 'the mug\'s "handle"'), ("red \ud83d mug", "red \ufffd mug")
    for text, same in pairs:
        np.testing.assert_array_equal(tokenizer([text], 32)[0], tokenizer([same], 32)[0])


def test_a_long_text_is_cut_and_keeps_its_end(tokenizer):
    start, end = (vocabulary()[token] for token in (START, END))
    row = tokenizer(["mug " * 200], 16)[0][0]
    assert row[0] == start
    assert row[-1] == end
    assert (row[1:-1] != end).all()
    ids, mask = tokenizer(["mug"], 16)
    short = ids[0].tolist()
    assert short[short.index(end) + 1 :] == [0] * (15 - short.index(end))
    np.testing.assert_array_equal(mask[0], np.arange(16) <= short.index(end))


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=40))
def test_the_ids_spell_the_cleaned_text(tokenizer, text):
    name_of = {number: token for token, number in vocabulary().items()}
    ids, mask = tokenizer([text], 1000)
    spelled = "".join(name_of[id] for id in ids[0, 1 : mask[0].sum() - 1]).replace("</w>", "")
    assert decoders.ByteLevel().decode([spelled]) == "".join(tokenizer._clean(text).lower().split())


@pytest.mark.parametrize("content", [
    "{", "[]", '{"model": 3}', '{"model": {"type": "Unigram", "unk_id": 0, "vocab": [["a", 0.0]]}}',
    '{"model": {"type": "BPE", "vocab": {"a": 0}, "merges": []}}',
    '{"model": {"type": "BPE", "vocab": {"a": "b"}, "merges": []}}',
])  # fmt: skip
def test_what_is_no_tokenizer_of_clip_is_refused(tmp_path, content):
    path = tmp_path / "tokenizer.json"
    path.write_text(content)
    with pytest.raises(InputError, match="no tokenizer of this model") as caught:
        TextTokenizer(path, None)
    assert caught.value.where == str(path)


def test_a_file_without_start_and_end_is_refused(tmp_path):
    path = write_tokenizer(tmp_path / "tokenizer.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"post_processor": None}))
    with pytest.raises(InputError, match="a start and an end around a word"):
        TextTokenizer(path, None)
