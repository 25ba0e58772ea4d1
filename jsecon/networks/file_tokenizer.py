"""Texts to ids by a tokenizer.json as it stands: SigLIP's and SigLIP 2's, which are of SentencePiece's kind.

The file joins pieces and sets its ends; it does not say how long a text is, what fills the rest, and often not how a
text is cleaned first. That is told by the configurations beside it (`TextRules`, read in clip_folder.py).
"""

import contextlib
import string
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from jsecon.errors import InputError, describe_error
from jsecon.files import parse_json
from jsecon.networks.tokenizer import cleaned, mended

CLEANINGS = ("canonicalize", "lower", "whitespace")
"""open_clip's names: without punctuation and in lower case (SigLIP); in lower case (SigLIP 2); as it is written. All
mend mis-decoded signs, HTML entities and white space"""
MOST_LENGTH = 4096
"""ids of a text"""


class TextRules(NamedTuple):
    """How a model takes its texts."""

    length: int
    """ids of a text; a longer one is cut, and keeps its end."""
    pad: str
    """token that fills a shorter one. These models read it: their attention goes both ways, from the last place."""
    clean: str
    """one of CLEANINGS."""


class FileTokenizer:
    """Texts to ids by the tokenizer.json at `path`. Raises InputError where it cannot be read or lacks the padding."""

    def __init__(self, path: str | Path, rules: TextRules):
        from tokenizers import Tokenizer

        self.rules, self._path = rules, Path(path)
        with _read(self._path, f"a tokenizer of Hugging Face's kind with the token {rules.pad!r}"):
            text = self._path.read_text(encoding="utf-8")
            _check_ends(parse_json(text).get("post_processor"))
            self._tokenizer = Tokenizer.from_str(text)
            number = self._tokenizer.token_to_id(rules.pad)
            if number is None:
                raise ValueError(f"{self._tokenizer.get_vocab_size()} tokens without {rules.pad!r}")
        self._number = int(number)

    def __call__(self, texts: Sequence[str], length: int) -> Int64[np.ndarray, "q _"]:
        """Q texts -> ids (Q, length), cut or filled at the end, as the models were trained (google-research/big_vision;
        a `padding_side` of "left" in tokenizer_config.json is that of the language model that the vocabulary is of)."""
        with _read(self._path, f"{length} ids for every text"):
            self._tokenizer.enable_truncation(max_length=length)
            self._tokenizer.enable_padding(length=length, pad_id=self._number, pad_token=self.rules.pad)
            rows = self._tokenizer.encode_batch([self.clean(text) for text in texts])
            return np.array([row.ids for row in rows], np.int64).reshape(len(texts), length)

    def clean(self, text: str) -> str:
        """A text as the model was trained on it."""
        if self.rules.clean == "lower":
            return cleaned(text)
        if self.rules.clean == "whitespace":
            return mended(text)
        bare = mended(text).replace("_", " ").translate(str.maketrans("", "", string.punctuation))
        return " ".join(bare.lower().split())

    def mask(self, ids: Int64[np.ndarray, "b l"]) -> Int64[np.ndarray, "b l"]:
        """All ones: the models are trained without a mask, and read the padding."""
        return np.ones_like(ids)


def _check_ends(processor: Any) -> None:
    """Raises ValueError where a template names a token that it does not define: the package tokenizers would abort."""
    for part in [processor, *processor.get("processors", [])] if processor else []:
        named = [piece["SpecialToken"]["id"] for piece in part.get("single", []) if "SpecialToken" in piece]
        unknown = set(named) - set(part.get("special_tokens", {}))
        if unknown:
            raise ValueError(f"ends {unknown} that are not defined")


@contextlib.contextmanager
def _read(path: Path, expected: str) -> Iterator[None]:
    """Turns whatever the package tokenizers raises into an InputError: its own exceptions have no other base."""
    try:
        yield
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # an abort in its Rust
            raise
        found = f"no such tokenizer ({describe_error(error)})"
        raise InputError(path, found, expected, "Fetch tokenizer.json and tokenizer_config.json again.") from error
