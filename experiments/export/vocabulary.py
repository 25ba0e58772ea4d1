"""Small vocabularies of SentencePiece's kind, true in form: SigLIP's own can't be had where nothing can be fetched.

`t5` is of SigLIP's form (Unigram, a mark before every word, "</s>" as end and as padding), `gemma` of SigLIP 2's (byte
pairs with bytes for what is unknown, "<eos>" as end, "<pad>"). Both are learned from a text, and written as Hugging
Face writes them: tokenizer.json and tokenizer_config.json.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jsecon.files import write_text

SIZE = 800
"""tokens learned, at most"""


def write_vocabulary(folder: Path, kind: str, texts: Iterable[str], *, tokenizer_class: str) -> Path:
    """tokenizer.json of `kind`, "t5" or "gemma", learned from `texts`, with tokenizer_config.json beside it."""
    tokenizer, pad, end = (_t5 if kind == "t5" else _gemma)(texts)
    settings = {
        "tokenizer_class": tokenizer_class,
        "pad_token": pad,
        "eos_token": end,
        "unk_token": "<unk>",
        "model_max_length": 64,
        "padding_side": "right",
        "model_input_names": ["input_ids"],
    }
    write_text(folder / "tokenizer.json", tokenizer.to_str(pretty=False) + "\n")
    write_text(folder / "tokenizer_config.json", json.dumps(settings, indent=2) + "\n")
    return folder / "tokenizer.json"


def _t5(texts: Iterable[str]) -> tuple[Any, str, str]:
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, processors, trainers

    tokenizer = Tokenizer(models.Unigram())
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Replace(Regex(" {2,}"), " ")])
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace(replacement="▁", prepend_scheme="always")
    special = ["<pad>", "</s>", "<unk>"]
    trainer = trainers.UnigramTrainer(
        vocab_size=SIZE, special_tokens=special, unk_token="<unk>", show_progress=False, initial_alphabet=_letters()
    )
    tokenizer.train_from_iterator(texts, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    return tokenizer, "</s>", "</s>"


def _gemma(texts: Iterable[str]) -> tuple[Any, str, str]:
    from tokenizers import AddedToken, Tokenizer, models, normalizers, pre_tokenizers, processors, trainers

    def shell(model: Any) -> Any:
        made = Tokenizer(model)
        made.normalizer = normalizers.Replace(" ", "▁")
        made.pre_tokenizer = pre_tokenizers.Split(" ", "merged_with_previous")
        return made

    learned = shell(models.BPE(unk_token="<unk>"))
    trainer = trainers.BpeTrainer(
        vocab_size=SIZE, special_tokens=["<unk>"], show_progress=False, initial_alphabet=_letters()
    )
    learned.train_from_iterator(texts, trainer)
    content = json.loads(learned.to_str())["model"]
    special = ["<pad>", "<eos>", "<bos>", "<unk>"]
    tokens = [*special, *(f"<0x{byte:02X}>" for byte in range(256))]
    tokens += [token for token, _ in sorted(content["vocab"].items(), key=lambda item: item[1]) if token != "<unk>"]
    merges = [tuple(m.split(" ")) if isinstance(m, str) else tuple(m) for m in content["merges"]]
    numbers = {token: number for number, token in enumerate(tokens)}
    tokenizer = shell(models.BPE(numbers, merges, unk_token="<unk>", fuse_unk=True, byte_fallback=True))
    tokenizer.add_special_tokens([AddedToken(token, special=True, normalized=False) for token in special])
    tokenizer.post_processor = processors.TemplateProcessing(single="$A <eos>", special_tokens=[("<eos>", 1)])
    return tokenizer, "<pad>", "<eos>"


def _letters() -> list[str]:
    return ["▁", *map(chr, range(ord("!"), ord("~") + 1))]
