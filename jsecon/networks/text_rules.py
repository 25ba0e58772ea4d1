"""How a model in a folder takes its texts, from the configurations that its exporters write.

Two files say it:
    config.json             of open_clip (immich's layout): `text_cfg` with `context_length` and, where the vocabulary
                            is not CLIP's own, `hf_tokenizer_name` and `tokenizer_kwargs` (its `clean`)
                            of transformers: `model_type` siglip or siglip2, and `text_config`
    tokenizer_config.json   beside the vocabulary: `pad_token`, and of transformers `tokenizer_class`
"""

from pathlib import Path
from typing import Any

from jsecon.errors import InputError
from jsecon.files import read_json
from jsecon.networks.file_tokenizer import CLEANINGS, MOST_LENGTH, TextRules

CLASSES = {"SiglipTokenizer": "canonicalize", "GemmaTokenizer": "lower", "Siglip2Tokenizer": "lower"}
"""transformers' tokenizer -> how it cleans a text. SigLIP was trained without punctuation, SigLIP 2 in lower case
(google-research/big_vision); the class of the latter's published files is that of Gemma, whose vocabulary it uses"""
MOST_SIGNS = 100
"""of the padding token"""
OPEN_CLIP_LENGTH, TRANSFORMERS_LENGTH = 77, 64
"""of a text, where config.json is silent: what open_clip and transformers' SiglipTextConfig then take"""
_FETCH = "Fetch the file again, from the folder that the graphs come from."


def read_text_rules(folder: Path, tokenizer: Path) -> TextRules | None:
    """The rules of the model in `folder` with the vocabulary `tokenizer`; None where it takes texts as CLIP does, or
    there is no config.json. Raises InputError where a configuration cannot be read or leaves a rule open."""
    path = folder / "config.json"
    if not path.is_file():
        return None
    content = _table(path)
    text, kind = content.get("text_cfg"), str(content.get("model_type", ""))
    if isinstance(text, dict) and "hf_tokenizer_name" in text:
        options = text.get("tokenizer_kwargs") or {}
        if not isinstance(options, dict) or set(options) - {"clean"}:
            raise InputError(path, f"tokenizer_kwargs {options}", '{"clean": ...} or none', "Take another model.")
        length, clean = text.get("context_length", OPEN_CLIP_LENGTH), options.get("clean", "whitespace")
        pad = _padding(tokenizer)[0]
    elif kind.startswith("siglip"):
        pad, name = _padding(tokenizer)
        if name not in CLASSES:
            raise InputError(_beside(tokenizer), f"tokenizer_class {name!r}", " or ".join(CLASSES), _FETCH)
        own = content.get("text_config")
        length = (own if isinstance(own, dict) else {}).get("max_position_embeddings", TRANSFORMERS_LENGTH)
        clean = CLASSES[name]
    else:
        return None
    if type(length) is not int or not 2 <= length <= MOST_LENGTH or clean not in CLEANINGS:
        expected = f"2 to {MOST_LENGTH} ids, cleaned by {', '.join(CLEANINGS)}"
        raise InputError(path, f"texts of {length!r} ids, cleaned by {clean!r}", expected, _FETCH)
    return TextRules(length, pad, clean)


def _beside(tokenizer: Path) -> Path:
    return tokenizer.with_name("tokenizer_config.json")


def _padding(tokenizer: Path) -> tuple[str, str]:
    """The padding token and the tokenizer's class, of the tokenizer_config.json beside it."""
    path = _beside(tokenizer)
    content = _table(path)
    pad = content.get("pad_token")
    pad = pad.get("content") if isinstance(pad, dict) else pad  # a token is written with its options, or bare
    if not isinstance(pad, str) or not 0 < len(pad) <= MOST_SIGNS:
        raise InputError(path, f"pad_token {pad!r}", "the token that fills short texts, which SigLIP reads", _FETCH)
    return pad, str(content.get("tokenizer_class", "")).removesuffix("Fast")


def _table(path: Path) -> dict[str, Any]:
    expected = "a JSON object of the model's settings"
    content = read_json(path, expected, _FETCH)
    if not isinstance(content, dict):
        raise InputError(path, f"JSON of {type(content).__name__}", expected, _FETCH)
    return content
