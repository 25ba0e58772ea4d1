"""Turns texts into token ids with a model's tokenizer.json, through Hugging Face's `tokenizers`.

CLIP's files differ in normaliser, padding and special tokens, so a text is cleaned and split into words here as
open_clip does it. The files of SigLIP and SigLIP 2 are used as they are. They state neither the length of a text nor
its padding nor how it is cleaned: `read_text_rules` takes that from the configuration files beside them.
"""

import contextlib
import html
import string
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from jsecon.errors import InputError, describe_error
from jsecon.files import read_json

CLIP_LENGTH = 77
"""tokens of a text of CLIP, if the graph does not fix it; and open_clip's default"""
CLIP_ENDS = ("<|startoftext|>", "<|endoftext|>"), ("<start_of_text>", "<end_of_text>")
"""start and end of a text in the vocabularies of Hugging Face and of open_clip"""
CLIP_WORDS = r"(?i)'s|'t|'re|'ve|'m|'ll|'d|\p{L}+|\p{N}|[^\s\p{L}\p{N}]+"
"""words of a cleaned text: English endings, runs of letters, single digits, runs of other characters"""
CLEANINGS = ("canonicalize", "lower", "whitespace")
"""open_clip's names: lower case without punctuation (SigLIP), lower case (SigLIP 2), as written. Each also repairs
mis-decoded characters, HTML entities and white space"""
CLASSES = {"SiglipTokenizer": "canonicalize", "GemmaTokenizer": "lower", "Siglip2Tokenizer": "lower"}
"""transformers' tokenizer -> cleaning. SigLIP was trained without punctuation, SigLIP 2 in lower case
(google-research/big_vision); its published files carry the class of Gemma, whose vocabulary it uses"""
MAX_LENGTH = 4096
"""tokens of a text"""
SIGLIP_LENGTH = 64
"""tokens of a text of SigLIP if config.json does not state it: the default of transformers' SiglipTextConfig"""
_FETCH = "Fetch the file again, from the folder that the graphs come from."


class TextRules(NamedTuple):
    """How a model takes its texts."""

    length: int
    """tokens of a text; a longer one is cut, and keeps its end"""
    pad: str
    """token that pads a shorter one. These models read it: their attention has no causal mask"""
    clean: str
    """one of CLEANINGS"""


class TextTokenizer:
    """Tokenizer of a model folder.

    Args:
      path: The tokenizer.json.
      rules: How the model takes its texts; None for CLIP: lower case, start and end, padded with 0.

    Raises:
      InputError: The file cannot be read, or lacks the padding token or CLIP's start and end.
    """

    def __init__(self, path: str | Path, rules: TextRules | None = None):
        from tokenizers import Tokenizer

        self._path = Path(path)
        self._rules = rules
        expected = "a tokenizer.json of Hugging Face's kind"
        with _tokenizer_errors(self._path, f"{expected} with the token {rules.pad!r}" if rules else expected):
            self._tokenizer = Tokenizer.from_str(self._path.read_text(encoding="utf-8"))
            self._end = -1
            self._pad = 0 if rules is None else self._token_id(rules.pad)
            if rules is None:
                self._follow_open_clip()

    def __call__(self, texts: Sequence[str], length: int) -> Int64[np.ndarray, "q _"]:
        """Encodes texts, cut or padded on the right.

        The models were trained so (google-research/big_vision). A `padding_side` of "left" in tokenizer_config.json is
        that of the language model whose vocabulary it is.

        Args:
          texts: Q texts.
          length: Number of tokens of each.

        Returns:
          (Q, length) token ids.
        """
        with _tokenizer_errors(self._path, f"{length} tokens for every text"):
            self._tokenizer.enable_truncation(max_length=length)
            self._tokenizer.enable_padding(length=length, pad_id=self._pad)
            rows = self._tokenizer.encode_batch([self.clean(text) for text in texts])
            return np.array([row.ids for row in rows], np.int64).reshape(len(texts), length)

    def count(self, text: str) -> int:
        """Counts the tokens of a text.

        Args:
          text: The text.

        Returns:
          Their number, start and end included.
        """
        self._tokenizer.no_truncation()
        self._tokenizer.no_padding()
        return len(self._tokenizer.encode(self.clean(text)).ids)

    def clean(self, text: str) -> str:
        """Cleans a text as the model was trained on it.

        Args:
          text: The text.

        Returns:
          The clean text.
        """
        repaired = _repair(text)
        if self._rules is None or self._rules.clean == "lower":
            return repaired.lower()
        if self._rules.clean == "whitespace":
            return repaired
        bare = repaired.replace("_", " ").translate(str.maketrans("", "", string.punctuation))
        return " ".join(bare.lower().split())

    def mask(self, ids: Int64[np.ndarray, "b l"]) -> Int64[np.ndarray, "b l"]:
        """Makes the attention mask of token ids.

        Args:
          ids: (B, L).

        Returns:
          (B, L): for CLIP 1 up to the first end, else 1 everywhere.
        """
        if self._rules is not None:
            return np.ones_like(ids)
        ends = ids == self._end
        return (np.cumsum(ends, axis=1) - ends == 0).astype(np.int64)

    def _token_id(self, token: str) -> int:
        number = self._tokenizer.token_to_id(token)
        if number is None:
            raise ValueError(f"{self._tokenizer.get_vocab_size()} tokens without {token!r}")
        return int(number)

    def _follow_open_clip(self) -> None:
        """Splits and ends texts as open_clip does, whatever the file says."""
        from tokenizers import Regex, models, pre_tokenizers, processors

        if not isinstance(self._tokenizer.model, models.BPE):
            raise ValueError(f"type {type(self._tokenizer.model).__name__}, not CLIP's BPE")
        self._tokenizer.model.end_of_word_suffix = "</w>"
        for sign in pre_tokenizers.ByteLevel.alphabet():
            self._token_id(sign)
            self._token_id(f"{sign}</w>")
        start, end = next(
            (ends for ends in CLIP_ENDS if self._tokenizer.token_to_id(ends[0]) is not None), CLIP_ENDS[0]
        )
        ends = [(token, self._token_id(token)) for token in (start, end)]
        self._end = ends[1][1]
        words = pre_tokenizers.Split(Regex(CLIP_WORDS), "removed", invert=True)
        signs = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
        self._tokenizer.normalizer = None
        self._tokenizer.pre_tokenizer = pre_tokenizers.Sequence([words, signs])
        self._tokenizer.post_processor = processors.TemplateProcessing(single=f"{start} $A {end}", special_tokens=ends)
        self._tokenizer.encode_special_tokens = True  # a text cannot end itself


def _repair(text: str) -> str:
    """Repairs mis-decoded characters (ftfy), two rounds of HTML entities, and white space."""
    import ftfy

    return " ".join(html.unescape(html.unescape(ftfy.fix_text(text))).split())


@contextlib.contextmanager
def _tokenizer_errors(path: Path, expected: str) -> Iterator[None]:
    """Turns whatever `tokenizers` raises into an InputError: its exceptions have no base of their own."""
    try:
        yield
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # of its Rust
            raise
        problem = f"it is no tokenizer of this model ({describe_error(error)})"
        remedy = "Fetch tokenizer.json again; for SigLIP also config.json and tokenizer_config.json."
        raise InputError(path, problem, expected, remedy) from error


def read_text_rules(folder: Path, tokenizer: Path) -> TextRules | None:
    """Reads how a model takes its texts from the configurations that its exporters write.

    config.json of open_clip (immich's layout) has `text_cfg` with `context_length` and, for another vocabulary than
    CLIP's, `hf_tokenizer_name` and `tokenizer_kwargs` (`clean`). That of transformers has `model_type` siglip or
    siglip2, and `text_config`. tokenizer_config.json has `pad_token`, and of transformers `tokenizer_class`.

    Args:
      folder: The model folder.
      tokenizer: Its tokenizer.json.

    Returns:
      The rules; None if the model takes texts as CLIP does, or there is no config.json.

    Raises:
      InputError: A configuration cannot be read or does not state a rule.
    """
    path = folder / "config.json"
    if not path.is_file():
        return None
    content = _read_object(path)
    text = content.get("text_cfg")
    if isinstance(text, dict) and "hf_tokenizer_name" in text:
        options = text.get("tokenizer_kwargs") or {}
        if not isinstance(options, dict) or set(options) - {"clean"}:
            raise InputError(path, f"tokenizer_kwargs {options}", '{"clean": ...} or {}', "Take another model.")
        length = text.get("context_length", CLIP_LENGTH)
        clean = options.get("clean", "whitespace")
        pad = _read_padding(tokenizer)[0]
    elif str(content.get("model_type", "")).startswith("siglip"):
        pad, name = _read_padding(tokenizer)
        if name not in CLASSES:
            where = tokenizer.with_name("tokenizer_config.json")
            raise InputError(where, f"tokenizer_class {name!r}", " or ".join(CLASSES), _FETCH)
        text = content.get("text_config")
        length = (text if isinstance(text, dict) else {}).get("max_position_embeddings", SIGLIP_LENGTH)
        clean = CLASSES[name]
    else:
        return None
    if type(length) is not int or not 2 <= length <= MAX_LENGTH or clean not in CLEANINGS:
        expected = f"2 to {MAX_LENGTH} tokens, cleaned by {', '.join(CLEANINGS)}"
        raise InputError(path, f"texts of {length!r} tokens, cleaned by {clean!r}", expected, _FETCH)
    return TextRules(length, pad, clean)


def _read_padding(tokenizer: Path) -> tuple[str, str]:
    """Reads the padding token and the tokenizer's class from the tokenizer_config.json beside a tokenizer.json."""
    path = tokenizer.with_name("tokenizer_config.json")
    content = _read_object(path)
    pad = content.get("pad_token")
    pad = pad.get("content") if isinstance(pad, dict) else pad  # a token is written with its options, or alone
    if not isinstance(pad, str):
        raise InputError(path, f"pad_token {pad!r}", "the token that pads short texts, which SigLIP reads", _FETCH)
    return pad, str(content.get("tokenizer_class", "")).removesuffix("Fast")


def _read_object(path: Path) -> dict[str, Any]:
    """Reads a JSON object."""
    expected = "a JSON object with the model's settings"
    content = read_json(path, expected, _FETCH)
    if not isinstance(content, dict):
        raise InputError(path, f"JSON of {type(content).__name__}", expected, _FETCH)
    return content
