"""Turns texts into token ids with a model's tokenizer.json, through Hugging Face's `tokenizers`.

The file has the vocabulary, the words and the special tokens. It states neither the length of a text nor its padding
nor how SigLIP's texts are cleaned: those follow from the configuration files beside it, which exporters write.
"""

import contextlib
import html
import string
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from jsecon.errors import InputError, describe_error
from jsecon.files import read_json

CLIP_LENGTH = 77
"""tokens of a text of CLIP, if the graph does not fix it; and open_clip's default"""
_CLEANING_OF_CLASS = {"SiglipTokenizer": "canonicalize", "GemmaTokenizer": "lower", "Siglip2Tokenizer": "lower"}
"""transformers' tokenizer -> cleaning. SigLIP was trained without punctuation, SigLIP 2 in lower case
(google-research/big_vision); its published files carry the class of Gemma, whose vocabulary it uses"""
_FETCH = "Fetch the file again, from the folder that the graphs come from."


class _TextRules(NamedTuple):
    """How a SigLIP takes its texts."""

    length: int
    """tokens of a text; a longer one is cut, and keeps its end"""
    pad: str
    """token that pads a shorter one. These models read it: their attention has no causal mask"""
    clean: str
    """open_clip's name of the cleaning: canonicalize (lower case without punctuation), lower, or whitespace"""


class TextTokenizer:
    """Tokenizer of a model folder, or an InputError that names its file.

    Args:
      path: The tokenizer.json.
      rules: How the model takes its texts; None for CLIP, which reads up to the first end of a text, padded with 0.
    """

    def __init__(self, path: Path, rules: _TextRules | None):
        from tokenizers import Tokenizer

        self._path = path
        self._rules = rules
        with self._errors("a tokenizer.json of Hugging Face's kind"):
            self._tokenizer = Tokenizer.from_str(path.read_text(encoding="utf-8"))
            self._tokenizer.encode_special_tokens = True  # a text cannot end itself
            self._pad = 0
            if rules is not None:
                self._pad = self._tokenizer.token_to_id(rules.pad)
                if self._pad is None:
                    raise ValueError(f"{self._tokenizer.get_vocab_size()} tokens without {rules.pad!r}")
            elif len(self._tokenizer.encode("a").ids) != 3:
                raise ValueError("it does not put a start and an end around a word")

    def __call__(self, texts: Sequence[str], length: int) -> tuple[Int64[np.ndarray, "q l"], Int64[np.ndarray, "q l"]]:
        """Encodes texts, cut or padded on the right to a number of tokens.

        The models were trained so (google-research/big_vision). A `padding_side` of "left" in tokenizer_config.json is
        that of the language model whose vocabulary it is.

        Returns:
          Token ids, and their attention mask: for CLIP 1 up to the end of the text, else 1 everywhere.
        """
        with self._errors(f"{length} tokens for every text"):
            self._tokenizer.enable_truncation(max_length=length)
            self._tokenizer.enable_padding(length=length, pad_id=self._pad)
            rows = self._tokenizer.encode_batch([self._clean(text) for text in texts])
            ids = np.array([row.ids for row in rows], np.int64).reshape(len(texts), length)
            mask = np.array([row.attention_mask for row in rows], np.int64).reshape(ids.shape)
        return ids, mask if self._rules is None else np.ones_like(ids)

    def _clean(self, text: str) -> str:
        """Cleans a text as the model was trained on it: straight quotes, no HTML, single spaces, its letter case."""
        text = text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")  # half of a pair has no encoding
        text = unicodedata.normalize("NFC", html.unescape(html.unescape(text)))
        text = " ".join(text.translate(str.maketrans("\u2018\u2019\u201c\u201d", "''\"\"")).split())
        if self._rules is not None and self._rules.clean == "canonicalize":
            text = " ".join(text.replace("_", " ").translate(str.maketrans("", "", string.punctuation)).split())
        return text if self._rules is not None and self._rules.clean == "whitespace" else text.lower()

    @contextlib.contextmanager
    def _errors(self, expected: str) -> Iterator[None]:
        """Turns whatever `tokenizers` raises into an InputError: its exceptions have no base of their own."""
        try:
            yield
        except BaseException as error:
            if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # of its Rust
                raise
            problem = f"it is no tokenizer of this model ({describe_error(error)})"
            remedy = "Fetch tokenizer.json again; for SigLIP also config.json and tokenizer_config.json."
            raise InputError(self._path, problem, expected, remedy) from error


def read_text_rules(folder: Path, tokenizer: Path) -> _TextRules | None:
    """Reads how a model takes its texts; None if it does so as CLIP does, or there is no config.json.

    config.json of open_clip (immich's layout) has `text_cfg` with `context_length` and, for another vocabulary than
    CLIP's, `hf_tokenizer_name` and `tokenizer_kwargs` (`clean`). That of transformers has `model_type` siglip or
    siglip2, and `text_config`. tokenizer_config.json has `pad_token`, and of transformers `tokenizer_class`.
    InputError is raised if a configuration cannot be read or does not state a rule.
    """
    path, beside = folder / "config.json", tokenizer.with_name("tokenizer_config.json")
    content = _read_object(path) if path.is_file() else {}
    text = content.get("text_cfg") or {}
    is_open_clip = isinstance(text, dict) and "hf_tokenizer_name" in text
    if not is_open_clip and not str(content.get("model_type", "")).startswith("siglip"):
        return None
    settings = _read_object(beside)
    pad = settings.get("pad_token")
    pad = pad.get("content") if isinstance(pad, dict) else pad  # a token is written with its options, or alone
    if not isinstance(pad, str):
        raise InputError(beside, f"pad_token {pad!r}", "the token that pads short texts, which SigLIP reads", _FETCH)
    if is_open_clip:
        options = text.get("tokenizer_kwargs") or {}
        if not isinstance(options, dict) or set(options) - {"clean"}:
            raise InputError(path, f"tokenizer_kwargs {options}", '{"clean": ...} or {}', "Take another model.")
        length, clean = text.get("context_length", CLIP_LENGTH), options.get("clean", "whitespace")
    else:
        name, text = str(settings.get("tokenizer_class", "")).removesuffix("Fast"), content.get("text_config")
        if name not in _CLEANING_OF_CLASS:
            raise InputError(beside, f"tokenizer_class {name!r}", " or ".join(_CLEANING_OF_CLASS), _FETCH)
        # 64 is the default of transformers' SiglipTextConfig.
        length = (text if isinstance(text, dict) else {}).get("max_position_embeddings", 64)
        clean = _CLEANING_OF_CLASS[name]
    if type(length) is not int or not 2 <= length <= 4096 or clean not in ("canonicalize", "lower", "whitespace"):
        expected = "2 to 4096 tokens, cleaned by canonicalize, lower or whitespace"
        raise InputError(path, f"texts of {length!r} tokens, cleaned by {clean!r}", expected, _FETCH)
    return _TextRules(length, pad, clean)


def _read_object(path: Path) -> dict[str, Any]:
    """Reads a JSON object."""
    expected = "a JSON object with the model's settings"
    content = read_json(path, expected, _FETCH)
    if not isinstance(content, dict):
        raise InputError(path, f"JSON of {type(content).__name__}", expected, _FETCH)
    return content
