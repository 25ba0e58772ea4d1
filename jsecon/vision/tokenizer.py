"""CLIP's tokenizer: texts to the ids that open_clip gives them, from the vocabulary in a model's own tokenizer.json.

The text is cleaned as open_clip has it cleaned (ftfy, two rounds of HTML entities, white space, lower case), cut into
words, and each word's UTF-8 bytes are joined by the vocabulary's merges, the earliest learned first (byte pair
encoding). Left out of the cleaning: ftfy's guess at text that was decoded in the wrong encoding ("Ã©" for "é").
"""

import functools
import html
import html.entities
import itertools
import json
import re
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from jsecon.errors import InputError

CONTEXT_LENGTH = 77
"""ids a text, where the graph does not fix it"""
_END_OF_WORD = "</w>"
_START_NAMES, _END_NAMES = ("<|startoftext|>", "<start_of_text>"), ("<|endoftext|>", "<end_of_text>")
_FIXED_WORDS = re.compile(r"<start_of_text>|<end_of_text>|'s|'t|'re|'ve|'m|'ll|'d", re.IGNORECASE)


class ClipTokenizer:
    """Texts to ids by a byte pair vocabulary: `vocabulary` token -> id, `merges` pairs of tokens, the first learned
    first. Raises InputError, at `where`, for a vocabulary that is none of CLIP's kind."""

    def __init__(self, vocabulary: dict[str, int], merges: Sequence[tuple[str, str]], *, where: str | Path):
        self.vocabulary = vocabulary
        self.ranks = {pair: rank for rank, pair in enumerate(merges)}
        start = [vocabulary[name] for name in _START_NAMES if name in vocabulary]
        end = [vocabulary[name] for name in _END_NAMES if name in vocabulary]
        needed = {ending for symbol in byte_symbols() for ending in (symbol, symbol + _END_OF_WORD)}
        needed |= {a + b for a, b in self.ranks}
        missing = sorted(needed - vocabulary.keys())
        if not start or not end or missing:
            raise InputError(
                where,
                found=f"a vocabulary of {len(vocabulary)} tokens without {missing[0]!r}"
                if missing
                else f"a vocabulary of {len(vocabulary)} tokens without start and end of text",
                expected=f"CLIP's byte pairs: all 256 bytes, also with {_END_OF_WORD}, every merge, and "
                f"{_START_NAMES[0]}, {_END_NAMES[0]}",
                remedy="Give the tokenizer.json of a CLIP model.",
            )
        self.start, self.end = start[0], end[0]
        self._fixed = {_START_NAMES[1]: self.start, _END_NAMES[1]: self.end}
        self._encode_word = functools.lru_cache(maxsize=65536)(self._encode_word_afresh)

    def __call__(self, texts: Sequence[str], length: int = CONTEXT_LENGTH) -> Int64[np.ndarray, "q _"]:
        """Q texts -> ids (Q, length): start, the text, end, then 0. A longer text is cut; the end stays."""
        ids = np.zeros((len(texts), length), np.int64)
        for row, text in zip(ids, texts):
            own = [self.start, *self.encode(text), self.end][:length]
            own[-1] = self.end
            row[: len(own)] = own
        return ids

    def encode(self, text: str) -> list[int]:
        """The ids of a text, without start and end."""
        return [id for word in words(cleaned(text)) for id in self._encode_word(word)]

    def _encode_word_afresh(self, word: str) -> tuple[int, ...]:
        if word in self._fixed:
            return (self._fixed[word],)
        symbols = byte_symbols()
        parts = [symbols[byte] for byte in word.encode("utf-8")]
        parts[-1] += _END_OF_WORD
        while len(parts) > 1:
            rank, best = min((self.ranks.get(pair, len(self.ranks)), pair) for pair in itertools.pairwise(parts))
            if rank == len(self.ranks):
                break
            joined: list[str] = []
            at = 0
            while at < len(parts):
                pair = tuple(parts[at : at + 2]) == best
                joined.append("".join(best) if pair else parts[at])
                at += 1 + pair
            parts = joined
        return tuple(self.vocabulary[part] for part in parts)


def load_tokenizer(path: str | Path) -> ClipTokenizer:
    """The tokenizer in a tokenizer.json (Hugging Face), or in a vocab.json with merges.txt beside it.

    Raises InputError where a file is missing, damaged, or no byte pair vocabulary of CLIP's kind.
    """
    path = Path(path)
    content = _read_json(path)
    if path.name == "vocab.json":
        return ClipTokenizer(_vocabulary(path, content), _read_merges(path.with_name("merges.txt")), where=path)
    model = content.get("model", {}) if isinstance(content, dict) else {}
    kind = model.get("type", "BPE" if model else None) if isinstance(model, dict) else None
    if kind != "BPE" or "vocab" not in model or "merges" not in model:
        raise InputError(
            path,
            found=f"a tokenizer of type {kind}" if kind else "no tokenizer",
            expected="type BPE with vocab and merges, as CLIP's",
            remedy="Give the tokenizer.json of a CLIP model.",
        )
    return ClipTokenizer(
        _vocabulary(path, model["vocab"]), [_pair(path, merge) for merge in model["merges"]], where=path
    )


def _read_json(path: Path):
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            path,
            found=f"what cannot be read ({error})",
            expected="a tokenizer as JSON",
            remedy="Fetch the file again.",
        ) from error


def _vocabulary(path: Path, content: object) -> dict[str, int]:
    if not isinstance(content, dict) or not all(type(number) is int for number in content.values()):
        raise InputError(path, found="no table of tokens", expected="token -> number", remedy="Fetch the file again.")
    return content


def _pair(path: Path, merge: object) -> tuple[str, str]:
    """A merge, written "a b" by older files and ["a", "b"] by newer ones."""
    parts = merge.split(" ") if isinstance(merge, str) else merge
    if not isinstance(parts, list) or len(parts) != 2 or not all(isinstance(part, str) for part in parts):
        raise InputError(path, found=f"the merge {merge!r}", expected="two tokens", remedy="Fetch the file again.")
    return parts[0], parts[1]


def _read_merges(path: Path) -> list[tuple[str, str]]:
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, ValueError) as error:
        raise InputError(
            path,
            found=f"what cannot be read ({error})",
            expected="a merge a line, beside vocab.json",
            remedy="Fetch the file too.",
        ) from error
    return [_pair(path, line) for line in lines if line and not line.startswith("#version")]


def words(text: str) -> Iterator[str]:
    """The words of a cleaned text: English endings ('s, 'll), runs of letters, single digits, runs of other signs."""
    at = 0
    while at < len(text):
        fixed = _FIXED_WORDS.match(text, at)
        kind = _kind(text[at])
        end = at + 1
        if fixed:
            end = fixed.end()
        elif kind in "LS":
            while end < len(text) and _kind(text[end]) == kind:
                end += 1
        if kind != " ":
            yield text[at:end]
        at = end


@functools.lru_cache(maxsize=4096)
def _kind(character: str) -> str:
    """L letter, N number, S another sign, or a space."""
    if character.isspace():
        return " "
    category = unicodedata.category(character)[0]
    return category if category in "LN" else "S"


def cleaned(text: str) -> str:
    """The text without what writing systems of computers leave in it, on one line, in lower case (see the module)."""
    mended, entities = "", True
    for line in re.split(r"(?<=\n)", text):
        entities &= "<" not in line  # from a tag on, it is HTML, whose entities stand for themselves
        mended += _mended(line, entities)
    return " ".join(html.unescape(html.unescape(mended)).split()).lower()


def _mended(line: str, entities: bool) -> str:
    before = None
    while line != before:
        before = line
        if entities:
            line = re.sub(r"&#?[0-9A-Za-z]{1,24};", _entity, line)
        line = re.sub(r"[\x80-\x9f]", _windows_1252, line)
        line = line.translate(_plain_signs())
        line = line.replace("\r\n", "\n").replace("\r", "\n")
        line = re.sub(r"[\ud800-\udbff][\udc00-\udfff]", _joined_surrogates, line)
        line = re.sub(r"[\ud800-\udfff]", "�", line)
        line = re.sub(r"\x1b\[[\d;]*[a-zA-Z]", "", line)
        line = re.sub("[\x00-\x08\x0b\x0e-\x1f\x7f\u206a-\u206f\ufeff\ufff9-\ufffc]", "", line)
        line = unicodedata.normalize("NFC", line)
    return line


def _entity(match: re.Match[str]) -> str:
    """The sign of an HTML entity that ends in a semicolon; also of names in capitals, unless HTML knows those."""
    name = match[0][1:]
    if name.startswith("#"):
        sign = html.unescape(match[0])
        return match[0] if ";" in sign else sign
    if name in html.entities.html5:
        return html.entities.html5[name]
    small = name.lower()
    known = small in html.entities.html5 and name == name.upper() and html.unescape(match[0]) == match[0]
    return html.entities.html5[small].upper() if known else match[0]


def _windows_1252(match: re.Match[str]) -> str:
    """The sign that Windows has where Latin-1 has a control code."""
    try:
        return match[0].encode("latin-1").decode("cp1252")
    except UnicodeDecodeError:
        return match[0]


def _joined_surrogates(match: re.Match[str]) -> str:
    return match[0].encode("utf-16-le", "surrogatepass").decode("utf-16-le")


@functools.cache
def _plain_signs() -> dict[int, str]:
    """Straight quotation marks, Latin ligatures and digraphs as letters, signs of full and half width as usual ones,
    line separators as line ends."""
    table = {0x02BC: "'"} | dict.fromkeys(range(0x2018, 0x201C), "'") | dict.fromkeys(range(0x201C, 0x2020), '"')
    for code in (
        0x0132,
        0x0133,
        0x0149,
        *range(0x01F1, 0x01F4),
        *range(0x01C4, 0x01CD),
        *range(0xFB00, 0xFB05),
        0xFB06,
    ):
        table[code] = unicodedata.normalize("NFKC", chr(code))
    table[0xFB05] = "\u017ft"  # compatibility would make the long s a round one
    for code in range(0xFF01, 0xFFF0):
        if unicodedata.normalize("NFKC", chr(code)) != chr(code):
            table[code] = unicodedata.normalize("NFKC", chr(code))
    return table | {0x3000: " ", 0x2028: "\n", 0x2029: "\n", 0x85: "\n"}


@functools.cache
def byte_symbols() -> tuple[str, ...]:
    """The sign that stands for each byte: itself where it can be seen in Latin-1, else one from 256 on."""
    seen = {*range(0x21, 0x7F), *range(0xA1, 0xAD), *range(0xAE, 0x100)}
    hidden = iter(range(256, 512))
    return tuple(chr(byte) if byte in seen else chr(next(hidden)) for byte in range(256))
