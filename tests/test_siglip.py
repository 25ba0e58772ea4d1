"""SigLIP: both layouts give the same space, the padding included; what a folder leaves open is named; scale and bias
are found, and a text is refused by the probability that they give."""

import json

import jax
import numpy as np
import pytest
from clip_files import COLOURS, write_clip
from siglip_files import BIAS, LENGTH, SCALE, embedded, write_json, write_siglip
from small_field import KnownTexts, make_field, unit_rows

from experiments.export.vocabulary import write_vocabulary
from jsecon import Scene, query_anchored, query_several
from jsecon.networks.clip import ClipEmbedder
from jsecon.networks.tokenizer import TextTokenizer, _TextRules, read_text_rules
from jsecon.query.match import presence_prob
from jsecon.query.rules import MIN_COSINE, MIN_PRESENCE, QueryRules
from jsecon.vision.protocols import Embedder, Logits

LAYOUTS = ("immich", "transformers.js")
TEXTS = ["a red thing", "blue", "a a a a a a a a a a a green a a a", "yellow red blue"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return {layout: write_siglip(tmp_path_factory.mktemp("siglip") / layout, layout) for layout in LAYOUTS}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_images_and_texts_meet_and_the_padding_is_read(folders, layout):
    embedder = ClipEmbedder(folders[layout])
    assert isinstance(embedder, Embedder)
    np.testing.assert_allclose(embedder.embed_text(TEXTS), embedded(TEXTS), atol=1e-6)
    assert np.abs(embedded(["blue"]) - embedded(["blue"], LENGTH - 3)).max() > 0.01  # so another padding shows
    frame = np.zeros((8, 8, 3), np.uint8)
    frame[:] = np.round(255 * np.asarray(COLOURS["red"]))
    found = embedder.embed_regions(frame, np.ones((1, 8, 8), bool))[0]
    np.testing.assert_allclose(found, np.divide(COLOURS["red"], np.linalg.norm(COLOURS["red"])), atol=0.01)


def test_texts_are_cleaned_as_the_configurations_say(folders):
    canonical = ClipEmbedder(folders["immich"])
    np.testing.assert_allclose(canonical.embed_text(["A_red, THING!"]), embedded(["a red thing"]), atol=1e-6)
    path = folders["immich"] / "textual" / "tokenizer.json"
    said = "Tea &amp; MILK,  d\u00e9j\u00e0_vu!"
    expected = {
        "canonicalize": "tea milk d\u00e9j\u00e0 vu",
        "lower": "tea & milk, d\u00e9j\u00e0_vu!",
        "whitespace": "Tea & MILK, d\u00e9j\u00e0_vu!",
    }
    for clean, text in expected.items():
        assert TextTokenizer(path, _TextRules(LENGTH, "</s>", clean))._clean(said) == text


def test_siglip_2_has_another_vocabulary_padding_and_case(tmp_path):
    path = write_vocabulary(tmp_path, "gemma", ["red mug, blue box"] * 9, tokenizer_class="GemmaTokenizerFast")
    write_siglip(tmp_path / "model", "transformers.js")
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (tmp_path / "model" / name).write_bytes((tmp_path / name).read_bytes())
    rules = read_text_rules(tmp_path / "model", tmp_path / "model" / "tokenizer.json")
    assert rules == _TextRules(LENGTH, "<pad>", "lower")
    tokenizer = TextTokenizer(path, rules)
    (short, long, foreign), mask = tokenizer(["Red Mug,", "mug " * 40, "\u8336"], 8)
    numbers = json.loads(path.read_text())["model"]["vocab"]
    assert short[-1] == numbers["<pad>"] == 0
    assert 1 in short  # its end
    assert long[-1] == numbers["<eos>"] == 1  # a text that is cut keeps its end
    bytes_of_tea = [numbers[f"<0x{byte:02X}>"] for byte in "\u8336".encode()]
    np.testing.assert_array_equal(foreign[: len(bytes_of_tea) + 1], [*bytes_of_tea, 1])
    np.testing.assert_array_equal(tokenizer(["RED MUG,"], 8)[0][0], short)
    np.testing.assert_array_equal(mask, np.ones((3, 8)))


def test_the_name_follows_the_rules_and_not_the_scale(folders, tmp_path):
    folder = write_siglip(tmp_path / "model", "immich")
    name = ClipEmbedder(folder).name
    write_json(folder / "logits.json", {"scale": 5.0, "bias": -1.0})
    assert ClipEmbedder(folder).name == name == ClipEmbedder(folders["immich"]).name
    config = json.loads((folder / "config.json").read_text())
    config["text_cfg"]["tokenizer_kwargs"] = {"clean": "lower"}
    write_json(folder / "config.json", config)
    assert ClipEmbedder(folder).name != name
    clip = write_clip(tmp_path / "clip", "immich")  # open_clip's configuration beside it changes nothing of it
    name = ClipEmbedder(clip).name
    write_json(clip / "config.json", {"embed_dim": 3, "text_cfg": {"context_length": 77, "vocab_size": 49408}})
    assert (ClipEmbedder(clip).name, ClipEmbedder(clip).logits) == (name, None)


def test_a_length_that_is_left_out_is_transformers_own(tmp_path):
    folder = write_siglip(tmp_path / "model", "transformers.js")
    write_json(folder / "config.json", {"model_type": "siglip"})
    assert read_text_rules(folder, folder / "tokenizer.json") == _TextRules(64, "</s>", "canonicalize")


def test_scale_and_bias_are_read_in_every_layout_and_a_folder_without_them_says_so(folders, tmp_path):
    for folder in folders.values():
        np.testing.assert_allclose(ClipEmbedder(folder).logits, (SCALE, BIAS), rtol=1e-4)
    bare = write_siglip(tmp_path / "model", "immich", logits=False)
    assert ClipEmbedder(bare).logits is None
    assert "logits.json" in ClipEmbedder(bare).check()


# The probability in place of the cosine's threshold


@pytest.fixture(scope="module")
def field(scene, cameras):
    return make_field(scene, cameras)[0]


def test_a_text_is_refused_by_its_probability_and_not_by_its_cosine(field):
    embeddings = np.asarray(field.regions.embeddings)
    text = embeddings[2] / np.linalg.norm(embeddings[2])
    plain = query_anchored(field, text)
    cosine = float(embeddings[2] @ text / np.linalg.norm(embeddings[2]))
    for least in (0.001, MIN_PRESENCE, 0.7):
        edge = np.log(least / (1 - least)) - 50 * cosine  # the bias with which the probability is `least`
        for shift, there in ((0.1, True), (-0.1, False)):
            given = None if least == MIN_PRESENCE else least
            logits = Logits(50.0, edge + shift)
            found = query_anchored(field, text, rules=QueryRules(logits=logits, min_score=given))
            several = query_several(field, text[None], rules=QueryRules(logits=logits, min_score=given))
            for selection in (found, several):
                np.testing.assert_array_equal(selection.mask, plain.mask if there else False)
                assert int(selection.region) == (int(plain.region) if there else -1)
            assert float(found.score) == float(plain.score)  # the cosine still ranks
    texts = unit_rows(np.random.default_rng(0), 500, 12)
    best = (texts @ (embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)).T).max(1)
    weak = texts[int(np.argmin(best))]
    assert min(best) < MIN_COSINE
    assert int(query_anchored(field, weak).region) == -1
    assert int(query_anchored(field, weak, rules=QueryRules(logits=Logits(50.0, 60.0))).region) >= 0


def test_presence_is_the_sigmoid_of_the_cosine_also_under_jit_and_vmap(field):
    rng = np.random.default_rng(0)
    embeddings, texts = rng.normal(size=(2000, 12)), rng.normal(size=(5, 12))
    embeddings[3] = 0
    lengths = np.linalg.norm(embeddings, axis=1) * np.linalg.norm(texts, axis=1)[:, None]
    cosines = np.divide(texts @ embeddings.T, lengths, out=np.zeros_like(lengths), where=lengths > 0)
    expected = 1 / (1 + np.exp(-(7.0 * cosines - 2.0)))
    expected[:, 3] = 0
    given = embeddings.astype(np.float32), texts.astype(np.float32)
    found = jax.jit(jax.vmap(lambda text: presence_prob(given[0], text, Logits(7.0, -2.0))))(given[1])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(presence_prob(given[0], given[1][0], Logits(7.0, -2.0)), expected[0], atol=1e-6)
    slope = jax.grad(lambda text: presence_prob(given[0], text, Logits(7.0, -200.0)).sum())(given[1][0])
    assert np.isfinite(slope).all()  # though exp(200) overflows
    many = jax.vmap(lambda text: query_anchored(field, text, rules=QueryRules(logits=Logits(50.0, -10.0))).region)(
        given[1]
    )
    each = [query_anchored(field, text, rules=QueryRules(logits=Logits(50.0, -10.0))).region for text in given[1]]
    np.testing.assert_array_equal(many, each)
    assert query_anchored(field, given[1][0]).presence is None


def test_the_answer_says_how_likely_the_text_is_there(field):
    units = np.asarray(field.regions.embeddings) / np.linalg.norm(field.regions.embeddings, axis=1, keepdims=True)
    texts = {"mug": units[0], "cup": units[1], "ghost": -units.sum(0)}
    sure, silent = (Scene(field, KnownTexts(texts, **more)) for more in ({"logits": Logits(20.0, -18.0)}, {}))
    assert int(sure.ask("mug").selection.region) == 0
    for text in ("mug", "mug or cup"):
        np.testing.assert_allclose(sure.ask(text).selection.presence, 1 / (1 + np.exp(-2.0)), rtol=1e-4)
    ghost = sure.ask("ghost")
    assert int(ghost.selection.region) == -1
    assert 0 <= ghost.selection.presence < MIN_PRESENCE
    assert silent.ask("mug").selection.presence is None
    assert set(sure.ask("mug").as_dict()["probability"]) == {"presence", "mean", "percentile_10"}
    assert list(ghost.as_dict()["probability"]) == ["presence"]
    assert set(silent.ask("mug").as_dict()["probability"]) == {"mean", "percentile_10"}
