"""CLIP's tokenizer: texts to the ids that open_clip gives them, from the vocabulary in a model's own tokenizer.json.

Hugging Face's `tokenizers` joins the byte pairs. Its normaliser, padding and ends, which differ between the published
files, are not read: the text is cleaned and cut into words as open_clip does it.
"""

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from jsecon.errors import InputError, describe_error
from jsecon.files import parse_json

CONTEXT_LENGTH = 77
"""ids per text, where the graph does not fix it"""
_WRITTEN_ENDS = ("<start_of_text>", "<end_of_text>")
"""in a text, and in open_clip's vocabulary"""
_STORED_ENDS = ("<|startoftext|>", "<|endoftext|>")
"""in the vocabularies of Hugging Face"""
_WORDS = r"(?i)<start_of_text>|<end_of_text>|'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"


class ClipTokenizer:
    """Texts to ids by a byte pair vocabulary: `vocabulary` token -> id, `merges` pairs of tokens, the first learned
    first. Raises ValueError for a vocabulary that lacks a byte, a merge, or start and end of text."""

    def __init__(self, vocabulary: dict[str, int], merges: Sequence[tuple[str, str]]):
        from tokenizers import models, pre_tokenizers

        signs = pre_tokenizers.ByteLevel.alphabet()
        missing = {*signs, *(sign + "</w>" for sign in signs), *map("".join, merges)} - vocabulary.keys()
        start, end = (vocabulary.get(a, vocabulary.get(b)) for a, b in zip(_STORED_ENDS, _WRITTEN_ENDS))
        if missing or start is None or end is None:
            raise ValueError(f"{len(vocabulary)} tokens without {min(missing, default='start and end of text')!r}")
        self.start, self.end = start, end
        self._splitter = word_splitter()
        self._model = models.BPE(vocab=vocabulary, merges=list(merges), end_of_word_suffix="</w>")

    def __call__(self, texts: Sequence[str], length: int = CONTEXT_LENGTH) -> Int64[np.ndarray, "q _"]:
        """Q texts -> ids (Q, length): start, the text, end, then 0. A longer text is cut; the end stays."""
        ids = np.zeros((len(texts), length), np.int64)
        for row, text in zip(ids, texts):
            own = [self.start, *self.encode(text), self.end][:length]
            own[-1] = self.end
            row[: len(own)] = own
        return ids

    def mask(self, ids: Int64[np.ndarray, "b l"]) -> Int64[np.ndarray, "b l"]:
        """1 for each id up to the first end, 0 behind it."""
        ends = ids == self.end
        return (np.cumsum(ends, axis=1) - ends == 0).astype(np.int64)

    def encode(self, text: str) -> list[int]:
        """The ids of a text, without start and end."""
        ends = dict(zip(_WRITTEN_ENDS, ([self.start], [self.end])))
        words = [word for word, _ in self._splitter.pre_tokenize_str(cleaned(text))]
        return [id for word in words for id in ends.get(word) or [token.id for token in self._model.tokenize(word)]]


def load_tokenizer(path: str | Path) -> ClipTokenizer:
    """The tokenizer in a tokenizer.json (Hugging Face), or in a vocab.json with merges.txt beside it.

    Raises InputError where a file is missing, damaged, or no byte pair vocabulary of CLIP's kind.
    """
    path = Path(path)
    try:
        content = parse_json(path.read_bytes())
        if path.name == "vocab.json":
            lines = path.with_name("merges.txt").read_text(encoding="utf-8").split("\n")
            vocabulary, merges = content, [line for line in lines if line and not line.startswith("#version")]
        else:
            if content["model"].get("type", "BPE") != "BPE":
                raise ValueError(f"type {content['model']['type']}")
            vocabulary, merges = content["model"]["vocab"], content["model"]["merges"]
        if not all(type(number) is int for number in vocabulary.values()):
            raise ValueError("no table of tokens and their numbers")
        # a merge is written "a b" by older files and ["a", "b"] by newer ones
        pairs = [(str(a), str(b)) for a, b in (m.split(" ") if isinstance(m, str) else m for m in merges)]
        return ClipTokenizer(vocabulary, pairs)
    except Exception as error:  # of the package tokenizers, whose own have no other base
        expected = "JSON of type BPE with vocab and merges (or vocab.json with merges.txt beside it): all 256 bytes, "
        expected += f"also with </w>, every merge, and {' and '.join(_STORED_ENDS)}"
        found = f"no tokenizer of CLIP's kind ({describe_error(error)})"
        remedy = "Fetch the file again, from a CLIP model; for SigLIP with the model's config.json in the folder."
        raise InputError(path, found, expected, remedy) from error


def word_splitter() -> Any:
    """Cuts a cleaned text into words: English endings ('s, 'll), runs of letters, single digits, runs of other signs;
    each with one sign per byte of its UTF-8."""
    from tokenizers import Regex, pre_tokenizers

    bytes_as_signs = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    return pre_tokenizers.Sequence([pre_tokenizers.Split(Regex(_WORDS), "removed", invert=True), bytes_as_signs])


def cleaned(text: str) -> str:
    """The text as open_clip has it cleaned: `mended`, in lower case."""
    return mended(text).lower()


def mended(text: str) -> str:
    """The text with mis-decoded signs put right (ftfy), two rounds of HTML entities, and single spaces."""
    import ftfy

    return " ".join(html.unescape(html.unescape(ftfy.fix_text(text))).split())
