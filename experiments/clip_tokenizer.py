"""Does the tokenizer give open_clip's ids? 1,000 texts through both, on CLIP's own vocabulary.

    pip install open_clip_torch            (brings torch, ftfy and regex; only this experiment needs them)
    python -m experiments.clip_tokenizer                              compare, on the vocabulary that open_clip ships
    python -m experiments.clip_tokenizer tests/clip_tokens.json       and write the cases that the tests hold fixed

The tests can't carry CLIP's vocabulary (its 48,894 merges are another project's file), so the fixture has a small one
of the same build, learned from the texts themselves, and the ids that open_clip's tokenizer gives on it.
"""
# ruff: noqa: RUF001  (ambiguous signs are what this is about)

import collections
import dataclasses
import gzip
import itertools
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from tokenizers import pre_tokenizers

from experiments import results
from jsecon.files import write_text
from jsecon.networks.tokenizer import ClipTokenizer, cleaned, word_splitter

NOUNS = [
    "mug",
    "bottle",
    "chair",
    "plant",
    "lamp",
    "book",
    "shelf",
    "toaster",
    "ladle",
    "kettle",
    "stool",
    "blanket",
    "cupboard",
    "vase",
    "sofa",
    "bicycle",
]
COLOURS = ["red", "dark-green", "off-white", "bluish", "teal", "navy", "beige", "maroon", "silver", "black-and-white"]
PLACES = ["on the table", "beside the window", "under Anna's desk", "in 2 boxes", "that we'll keep", "they've left"]
ACCENTED = [
    "crème brûlée",
    "Ångström",
    "naïve café",
    "piñata",
    "Zürich's Straße",
    "ÉCOLE",
    "Łódź",
    "žluťoučký kůň",
    "São Paulo",
    "smörgåsbord",
    "façade",
    "jalapeño",
    "coöperate",
    "Đà Nẵng",
    "e\u0301te\u0301",
    "A\u030angstro\u0308m",
    "İstanbul",
]
SCRIPTS = [
    "красная кружка",
    "κόκκινη κούπα",
    "红色杯子",
    "赤いマグカップ",
    "빨간 머그",
    "كوب أحمر",
    "כוס אדומה",
    "लाल मग",
    "แก้วสีแดง",
    "ﾏｸﾞｶｯﾌﾟ",
    "Ｆｕｌｌ　ｗｉｄｔｈ",
    "ⅷ Ⅳ ½ ² ٣ ৪",
]
EMOJI = ["😀", "👩‍👩‍👧", "🏴󠁧󠁢󠁷󠁬󠁳󠁿", "❤️", "👍🏽", "🇩🇪", "☕", "🧸🧸", "🪴", "1️⃣"]
ENTITIES = [
    "salt &amp; pepper",
    "&lt;tag&gt;",
    "caf&eacute;",
    "P&EACUTE;REZ",
    "&amp;amp;",
    "&#233;&#xe9;",
    "5 &lt 6",
    "&euro;20",
    "&nbsp;space&nbsp;",
    "a&notit;b",
    "<b>&amp;</b>",
    "&hearts;&notanentity;",
    "&quot;quoted&quot;",
    "&copy 2024",
    "one\ntwo <i>&amp;\nthree &lt;",
]
SIGNS = [
    "‘curly’ “quotes”",
    "…and—dashes–here",
    "ﬁne ﬂuﬃness",
    "a\u2028b\u0085c\r\nd",
    "tab\tand\x0bvertical",
    "\x1b[31mred\x1b[0m",
    "zero\u200bwidth\ufeff",
    "\ud83d\ude00 \ud83d",
    "don't I'd you're he'll we've 'tis",
    "it''s 's 't're",
    "C++/C# 100%",
    "3.14159e-10",
    "10,000,000",
    "snake_case_name",
    "!!!???",
    "~#@$^*()[]{}|\\",
    "<start_of_text> a <END_OF_TEXT>",
    "<|startoftext|>",
    "",
    "   ",
    "ſtraſſe'ſ",
    "\x93smart\x94 \x80",
    "@user: http://x.y/?a=1&b=2",
    "ŉ ǆ Ĳssel",
]


def texts(count: int = 1000, seed: int = 0) -> list[str]:
    """Texts of all kinds that people type, the hard ones first, then mixtures; one has 200 words."""
    rng = np.random.default_rng(seed)
    hard = [*ACCENTED, *SCRIPTS, *EMOJI, *ENTITIES, *SIGNS]
    plain = [f"{c} {n} {p}" for c in COLOURS for n in NOUNS for p in PLACES]
    long = " ".join(rng.choice([*NOUNS, *COLOURS, *ACCENTED], 200))
    mixed = []
    while len(mixed) < count - len(hard) - 1:
        parts = [str(rng.choice(plain)), *(str(t) for t in rng.choice(hard, rng.integers(0, 4)))]
        text = str(rng.choice([" ", ", ", "", "\n", " - "])).join(parts[i] for i in rng.permutation(len(parts)))
        mixed.append(text.upper() if rng.random() < 0.2 else text)
    return [*hard, long, *mixed]


def learned_merges(sample: list[str], count: int) -> list[tuple[str, str]]:
    """Byte pairs joined in order of how often they stand beside each other in the sample's words."""
    splitter = word_splitter()
    tally = collections.Counter(word for text in sample for word, _ in splitter.pre_tokenize_str(cleaned(text)))
    split = {word: [*word[:-1], word[-1] + "</w>"] for word in tally}
    merges: list[tuple[str, str]] = []
    while len(merges) < count:
        pairs: collections.Counter[tuple[str, str]] = collections.Counter()
        for word, parts in split.items():
            for pair in itertools.pairwise(parts):
                pairs[pair] += tally[word]
        if not pairs:
            break
        best = min(pairs, key=lambda pair: (-pairs[pair], pair))
        merges.append(best)
        for word, parts in split.items():
            at, joined = 0, []
            while at < len(parts):
                pair = tuple(parts[at : at + 2]) == best
                joined.append("".join(best) if pair else parts[at])
                at += 1 + pair
            split[word] = joined
    return merges


def vocabulary_of(merges: list[tuple[str, str]]) -> dict[str, int]:
    """CLIP's numbering: the bytes in the order of their signs, the same at the end of a word, the merges, the ends."""
    signs = sorted(pre_tokenizers.ByteLevel.alphabet())
    tokens = [*signs, *(sign + "</w>" for sign in signs), *map("".join, merges), "<|startoftext|>", "<|endoftext|>"]
    return {token: number for number, token in enumerate(tokens)}


@dataclasses.dataclass(frozen=True)
class Options:
    """What is compared, and where it is written."""

    count: int = 1000
    """texts"""
    seed: int = 0
    merges: int = 400
    """of the fixture's small vocabulary"""
    fixture: str = ""
    """where to write the tests' cases; empty: nowhere"""
    out: str = str(results.HOME / "results" / "clip_tokenizer")


def main(options: Options) -> dict:
    """Compares on open_clip's own vocabulary, and writes the fixture where asked to."""
    import open_clip
    from open_clip.tokenizer import SimpleTokenizer, default_bpe

    sample = texts(options.count, options.seed)
    lines = gzip.decompress(Path(default_bpe()).read_bytes()).decode("utf-8").split("\n")
    merges = [tuple(line.split()) for line in lines[1 : 49152 - 256 - 2 + 1]]
    theirs, ours = SimpleTokenizer(), ClipTokenizer(vocabulary_of(merges), merges)
    wrong = [text for text in sample if ours([text])[0].tolist() != theirs([text])[0].tolist()]
    metrics = {"texts": len(sample), "same_ids": len(sample) - len(wrong), "open_clip": open_clip.__version__}
    table = results.table(tuple(metrics), [tuple(metrics.values())])
    results.save(Path(options.out), options, metrics | {"differing": wrong}, table)
    print(table)
    if options.fixture:
        hard = sample[: sum(map(len, (ACCENTED, SCRIPTS, EMOJI, ENTITIES, SIGNS))) + 40]
        small = learned_merges(hard, options.merges)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "merges.txt.gz"
            path.write_bytes(gzip.compress("\n".join(["#version", *map(" ".join, small)]).encode()))
            limited = SimpleTokenizer(bpe_path=str(path))
        cases = [[text, limited([text])[0].tolist()] for text in hard]
        write_text(options.fixture, json.dumps({"merges": small, "cases": cases}) + "\n")
    return metrics


if __name__ == "__main__":
    main(Options(fixture=sys.argv[1] if len(sys.argv) > 1 else ""))
