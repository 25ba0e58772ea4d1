"""CLIP's tokenizer: open_clip's ids (in clip_tokens.json), and a message for files that are no such tokenizer."""

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
    return TextTokenizer(write_tokenizer(tmp_path_factory.mktemp("clip") / "tokenizer.json"))


def test_ids_are_those_of_open_clip(tokenizer):
    cases = [
        (text, ids) for text, ids in fixture()["cases"] if "<start_of_text>" not in text
    ]  # a text that ends itself
    assert len(cases) > 100
    for (text, ids), row in zip(cases, tokenizer([text for text, _ in cases], CLIP_LENGTH)):
        assert row.tolist() == ids, text


def test_a_long_text_is_cut_and_keeps_its_end(tokenizer):
    start, end = (vocabulary()[token] for token in (START, END))
    row = tokenizer(["mug " * 200], 16)[0]
    assert row[0] == start
    assert row[-1] == end
    assert (row[1:-1] != end).all()
    short = tokenizer(["mug"], 16)[0].tolist()
    assert short[short.index(end) + 1 :] == [0] * (15 - short.index(end))
    np.testing.assert_array_equal(tokenizer.mask(np.array([short]))[0], [1] * tokenizer.count("mug") + [0] * 13)


def test_merges_as_pairs_and_no_ending_of_words_are_the_same_tokenizer(tokenizer, tmp_path):
    content = json.loads(write_tokenizer(tmp_path / "tokenizer.json").read_text())
    content["model"]["merges"] = [merge.split(" ") for merge in content["model"]["merges"]]
    del content["model"]["end_of_word_suffix"]
    (tmp_path / "tokenizer.json").write_text(json.dumps(content))
    sample = [text for text, _ in fixture()["cases"][:40]]
    other = TextTokenizer(tmp_path / "tokenizer.json")
    np.testing.assert_array_equal(other(sample, CLIP_LENGTH), tokenizer(sample, CLIP_LENGTH))


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=40))
def test_the_ids_spell_the_cleaned_text(tokenizer, text):
    name_of = {number: token for token, number in vocabulary().items()}
    ids = tokenizer([text], 1000)[0][1 : tokenizer.count(text) - 1]
    spelled = "".join(name_of[id] for id in ids).replace("</w>", "")
    assert decoders.ByteLevel().decode([spelled]) == "".join(tokenizer.clean(text).split())


@pytest.mark.parametrize("content", [
    "{", "[]", '{"model": 3}', '{"model": {"type": "Unigram", "unk_id": 0, "vocab": [["a", 0.0]]}}',
    '{"model": {"type": "BPE", "vocab": {"a": 0}, "merges": []}}',
    '{"model": {"type": "BPE", "vocab": {"a": "b"}, "merges": []}}',
    '{"model": {"type": "BPE", "vocab": {"a": 0}, "merges": ["a b c"]}}',
])  # fmt: skip
def test_what_is_no_tokenizer_of_clip_is_refused(tmp_path, content):
    (tmp_path / "tokenizer.json").write_text(content)
    with pytest.raises(InputError, match="no tokenizer of this model") as caught:
        TextTokenizer(tmp_path / "tokenizer.json")
    assert caught.value.where == str(tmp_path / "tokenizer.json")


def test_a_vocabulary_without_ends_is_refused(tmp_path):
    content = json.loads(write_tokenizer(tmp_path / "tokenizer.json").read_text())
    del content["model"]["vocab"][END]
    content["model"]["unk_token"] = None
    content["added_tokens"] = content["added_tokens"][:1]
    (tmp_path / "tokenizer.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"tokens without '<\|endoftext\|>'"):
        TextTokenizer(tmp_path / "tokenizer.json")
