"""CLIP's tokenizer: open_clip's ids (held in clip_tokens.json), and a message for files that are no such tokenizer."""

import json

import numpy as np
import pytest
from clip_files import fixture, vocabulary, write_tokenizer
from hypothesis import given, settings, strategies as st
from tokenizers import decoders

from jsecon.errors import InputError
from jsecon.networks.tokenizer import ClipTokenizer, cleaned, load_tokenizer


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> ClipTokenizer:
    return load_tokenizer(write_tokenizer(tmp_path_factory.mktemp("clip") / "tokenizer.json"))


def test_ids_are_those_of_open_clip(tokenizer):
    cases = fixture()["cases"]
    assert len(cases) > 100
    found = tokenizer([text for text, _ in cases])
    for (text, ids), row in zip(cases, found):
        assert row.tolist() == ids, text


def test_a_long_text_is_cut_and_keeps_its_end(tokenizer):
    row = tokenizer(["mug " * 200], 16)[0]
    assert row[0] == tokenizer.start
    assert row[-1] == tokenizer.end
    assert (row[1:-1] != tokenizer.end).all()
    short = tokenizer(["mug"], 16)[0].tolist()
    assert short[short.index(tokenizer.end) + 1 :] == [0] * (15 - short.index(tokenizer.end))


def test_both_spellings_of_a_merge_and_the_older_pair_of_files_are_the_same_tokenizer(tokenizer, tmp_path):
    content = json.loads(write_tokenizer(tmp_path / "tokenizer.json").read_text())
    content["model"]["merges"] = [merge.split(" ") for merge in content["model"]["merges"]]
    (tmp_path / "tokenizer.json").write_text(json.dumps(content))
    (tmp_path / "vocab.json").write_text(json.dumps(vocabulary()))
    lines = ["#version: 0.2", *(" ".join(pair) for pair in fixture()["merges"]), ""]
    (tmp_path / "merges.txt").write_text("\n".join(lines))
    sample = [text for text, _ in fixture()["cases"][:40]]
    for name in ("tokenizer.json", "vocab.json"):
        np.testing.assert_array_equal(load_tokenizer(tmp_path / name)(sample), tokenizer(sample))


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=40))
def test_the_ids_spell_the_cleaned_text(tokenizer, text):
    name_of = {number: token for token, number in vocabulary().items()}
    spelled = "".join(name_of[id] for id in tokenizer.encode(text)).replace("</w>", "")
    assert decoders.ByteLevel().decode([spelled]) == "".join(cleaned(text).split())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "no tokenizer of CLIP's kind"),
        ("[]", "no tokenizer of CLIP's kind"),
        ('{"model": 3}', "no tokenizer of CLIP's kind"),
        ('{"model": {"type": "Unigram", "vocab": [["a", 0.0]]}}', "type Unigram"),
        ('{"model": {"type": "BPE", "vocab": {"a": 0}, "merges": []}}', "1 tokens without '!'"),
        ('{"model": {"type": "BPE", "vocab": {"a": "b"}, "merges": []}}', "no table of tokens"),
        ('{"model": {"type": "BPE", "vocab": {"a": 0}, "merges": ["a b c"]}}', "too many values"),
    ],
)
def test_what_is_no_tokenizer_of_clip_is_refused(tmp_path, content, words):
    (tmp_path / "tokenizer.json").write_text(content)
    with pytest.raises(InputError, match=words) as caught:
        load_tokenizer(tmp_path / "tokenizer.json")
    assert caught.value.where == str(tmp_path / "tokenizer.json")


def test_a_vocabulary_without_ends_or_with_a_merge_it_lacks_is_refused(tmp_path):
    whole, merges = vocabulary(), [tuple(pair) for pair in fixture()["merges"]]
    endless = {token: number for token, number in whole.items() if token != "<|endoftext|>"}
    with pytest.raises(ValueError, match="without 'start and end"):
        ClipTokenizer(endless, merges)
    with pytest.raises(ValueError, match="without 'zq'"):
        ClipTokenizer(whole, [*merges, ("z", "q")])
    (tmp_path / "vocab.json").write_text(json.dumps(whole))
    with pytest.raises(InputError, match=r"merges\.txt"):
        load_tokenizer(tmp_path / "vocab.json")
