"""ConSE on a labeller and text vectors that the test writes in their true formats, and rules on small arrays."""

import io
import json
import zipfile

import numpy as np
import pytest

from experiments.words import rules
from experiments.words.absent import absent_names
from experiments.words.conse import Conse, Crop, Labeller, TextVectors, class_weights, conse, cut_out
from experiments.words.minilm import MiniLM
from jsecon.errors import InputError
from jsecon.paper.queries import relevancies
from jsecon.query.scores import region_similarities
from jsecon.vision.protocols import CANONICAL, Embedder

SIDE = 8
"""px of the pictures that the small labeller takes"""
NAMES = ("Red", "Green", "Blue")


def labeller_file(path):
    """A TensorFlow Lite model whose three scores are the means of a picture's channels, with their names in a zip."""
    flatbuffers = pytest.importorskip("flatbuffers")
    b = flatbuffers.Builder(1024)

    def table(**slots):
        b.StartObject(1 + max(int(slot[1:]) for slot in slots))
        for slot, (put, value) in slots.items():
            put(int(slot[1:]), value, 0)
        return b.EndObject()

    def vector(items, size, put):
        b.StartVector(size, len(items), size)
        for item in reversed(items):
            put(item)
        return b.EndVector()

    at = b.PrependUOffsetTRelativeSlot
    byte, word, integer = b.PrependInt8Slot, b.PrependUint32Slot, b.PrependInt32Slot

    def offsets(items):
        return vector(items, 4, b.PrependUOffsetTRelative)

    def ints(items):
        return vector(items, 4, b.PrependInt32)

    def tensor(name, shape):
        scale, zero = vector([1 / 256], 4, b.PrependFloat32), vector([0], 8, b.PrependInt64)
        quantised = table(_2=(at, scale), _3=(at, zero))
        text, size = b.CreateString(name), ints(shape)
        return table(_0=(at, size), _1=(byte, 3), _2=(word, 0), _3=(at, text), _4=(at, quantised))

    tensors = [tensor("in", (1, SIDE, SIDE, 3)), tensor("pooled", (1, 1, 1, 3)), tensor("out", (1, 3))]
    pool = table(_0=(byte, 1), _1=(integer, 1), _2=(integer, 1), _3=(integer, SIDE), _4=(integer, SIDE))
    reshape = table(_0=(at, ints((1, 3))))
    operators = []
    for code, (source, target, kind, options) in enumerate(((0, 1, 5, pool), (1, 2, 17, reshape))):
        own = ints([source]), ints([target])
        slots = {"_0": (word, code), "_1": (at, own[0]), "_2": (at, own[1]), "_4": (at, options)}
        b.StartObject(5)
        for slot, (put, value) in slots.items():
            put(int(slot[1:]), value, 0)
        b.PrependUint8Slot(3, kind, 0)
        operators.append(b.EndObject())
    graph = {"_0": offsets(tensors), "_1": ints([0]), "_2": ints([2]), "_3": offsets(operators)}
    subgraph = table(**{slot: (at, value) for slot, value in graph.items()})
    codes = [table(_0=(byte, code), _2=(integer, 1), _3=(integer, code)) for code in (1, 22)]
    model = {"_1": offsets(codes), "_2": offsets([subgraph]), "_4": offsets([table(_1=(word, 0))])}
    version = {"_0": (word, 3)}
    b.Finish(table(**version, **{slot: (at, value) for slot, value in model.items()}), file_identifier=b"TFL3")
    names = io.BytesIO()
    with zipfile.ZipFile(names, "w") as archive:
        archive.writestr("labels.txt", "\n".join(NAMES) + "\n")
    path.write_bytes(bytes(b.Output()) + names.getvalue())
    return path


def vectors_file(path):
    """A table of vectors: the three classes are axes, the canonical phrases lie between them."""
    names = ["red", "green", "blue", *CANONICAL, "dark ink"]
    vectors = np.array([[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], *[[1, 1, 1, 1]] * 4, [0, 0, 1, 1]], np.float16)
    np.savez(path, names=np.array(names), vectors=vectors)
    return path


@pytest.fixture(scope="module")
def embedder(tmp_path_factory):
    pytest.importorskip("ai_edge_litert")
    folder = tmp_path_factory.mktemp("words")
    labeller = Labeller(labeller_file(folder / "labeller.tflite"))
    return Conse(labeller, TextVectors(vectors_file(folder / "vectors.npz")), crop=Crop(margin=0.0), top=2)


def test_conse_is_the_weighted_mean_of_the_most_probable_classes():
    rng = np.random.default_rng(0)
    weights, vectors = rng.random((5, 30)), rng.normal(size=(30, 8))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    found = conse(weights, vectors, top=10)
    for row, own in zip(found, weights):
        kept = sorted(range(30), key=lambda k: -own[k])[:10]
        total = sum((own[k] * vectors[k] for k in kept), np.zeros(8))
        np.testing.assert_allclose(row, total / np.linalg.norm(total), atol=1e-6)
    assert not conse(np.zeros((1, 30)), vectors).any()


def _unit(vector):
    return vector / np.linalg.norm(vector)


def test_weights_are_probabilities_or_log_odds_above_the_least():
    scores = np.array([[0, 1, 128, 255]], np.uint8)
    np.testing.assert_allclose(class_weights(scores)[0], [0, 1 / 256, 0.5, 255 / 256])

    def odds(p):
        return np.log(p / (1 - p))

    least = odds(1 / 512)
    expected = [0, odds(1 / 256) - least, -least, odds(255 / 256) - least]
    np.testing.assert_allclose(class_weights(scores, "log-odds")[0], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("crop", "shape", "outside"),
    [
        (Crop(0.0), (10, 20), None),
        (Crop(0.1), (12, 24), 7),
        (Crop(0.5), (17, 40), 7),  # the box ends 5 px below the frame's upper edge and 2 px above the lower
        (Crop(0.0, "square"), (17, 20), 7),
        (Crop(0.1, "stretched", "greyed"), (12, 24), 128),
        (Crop(0.1, "stretched", "masked"), (12, 24), 0),
        (Crop(0.0, "padded", "kept"), (20, 20), 0),
    ],
)
def test_a_crop_is_the_box_with_its_margin_within_the_frame(crop, shape, outside):
    frame, mask = np.full((17, 60, 3), 7, np.uint8), np.zeros((17, 60), bool)
    mask[5:15, 20:40] = True
    frame[mask] = 200
    found = cut_out(frame, mask, crop)
    assert found.shape == (*shape, 3)
    assert (found == 200).all(-1).sum() == mask.sum()
    rest = found[~(found == 200).all(-1)]
    assert set(np.unique(rest)) == (set() if outside is None else {outside})


def test_it_is_an_embedder_of_regions_and_texts(embedder):
    assert isinstance(embedder, Embedder)
    assert embedder.dim == 4
    np.testing.assert_allclose(embedder.canonical_phrases, 0.5, atol=1e-6)
    frame, masks = np.zeros((20, 30, 3), np.uint8), np.zeros((3, 20, 30), bool)
    masks[0, 2:6, 2:6] = masks[1, 10:18, 10:18] = True
    frame[masks[0]] = 250, 10, 120  # red and blue are the two most probable: green is left out
    frame[masks[1]] = 0, 200, 0
    found = embedder.embed_regions(frame, masks)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[0], _unit(np.array([250, 0, 120, 0])), atol=5e-3)
    np.testing.assert_allclose(found[1:], [[0, 1, 0, 0], [0, 0, 0, 0]], atol=5e-3)
    texts = embedder.embed_text(["Red", "dark-ink"])
    np.testing.assert_allclose(texts, [[1, 0, 0, 0], [0, 0, 0.5**0.5, 0.5**0.5]], atol=1e-6)
    assert Conse(embedder.labeller, embedder.texts, crop=Crop(0.1)).name != embedder.name


def test_what_is_missing_is_named(embedder, tmp_path):
    with pytest.raises(InputError, match="no vector for 'mauve'"):
        embedder.embed_text(["red", "mauve"])
    with pytest.raises(InputError, match=r"labeller\.tflite"):
        Labeller(tmp_path / "labeller.tflite")
    with pytest.raises(InputError, match=r"vectors\.npz"):
        TextVectors(tmp_path / "vectors.npz")
    with pytest.raises(InputError, match="model"):
        TextVectors(embedder.texts.file, tmp_path / "model")
    np.savez(tmp_path / "short.npz", names=["red"], vectors=np.ones((1, 4)))
    with pytest.raises(InputError, match="no vector for 'green'"):
        Conse(embedder.labeller, TextVectors(tmp_path / "short.npz"))
    whole = embedder.labeller.file.read_bytes()
    (tmp_path / "broken.tflite").write_bytes(whole[:4] + b"0000" + whole[8:])
    with pytest.raises(InputError, match=r"broken\.tflite"):
        Labeller(tmp_path / "broken.tflite")(np.zeros((4, 4, 3), np.uint8))


def test_absent_names_are_far_from_all_that_is_there(embedder):
    assert absent_names(embedder.texts, "", ("red",)) == ("green", "blue", "dark ink")
    assert absent_names(embedder.texts, "", ("blue",)) == ("red", "green")


def test_rules_on_a_table():
    table = np.array([[0.9, 0.7, 0.1, 0.2], [0.8, 0.3, 0.7, -np.inf]])
    assert rules.best_of(table).tolist() == [[True, False, False, False], [True, False, False, False]]
    assert rules.near_best(table, 0.4).tolist() == [[True, True, False, False], [True, False, False, False]]
    assert rules.best_text(table).tolist() == [[True, True, False, True], [False, False, True, False]]
    scaled = rules.standardised(table)
    np.testing.assert_allclose(scaled[0].mean(), 0, atol=1e-12)
    np.testing.assert_allclose(scaled[0].std(), 1)
    np.testing.assert_allclose(scaled[1, :3], (table[1, :3] - 0.6) / table[1, :3].std())
    assert scaled[1, 3] == -np.inf
    truth, asked = np.array([0, 0, 1, 2, -1]), np.array([0, 1])
    chosen = np.array([[1, 0, 1, 0, 1], [0, 0, 1, 0, 1]], bool)
    np.testing.assert_allclose(rules.ious(chosen, truth, asked), [1 / 3, 1])
    level, found = rules.best_threshold(
        np.array([[5, 4, 3, 2, 9], [0, 0, 4, 0, 9.0]]), truth, asked, np.array([1.0, 4.0, 5.0])
    )
    assert (level, found.tolist()) == (4.0, [1.0, 1.0])
    assert rules.auc(np.array([2.0, 1.0]), np.array([1.0, 0.0])) == 0.875
    low, high = rules.interval(np.array([0.0, 1.0] * 50))
    assert 0.38 < low < 0.42
    assert 0.58 < high < 0.62


def test_scores_of_all_texts_are_those_of_the_library():
    rng = np.random.default_rng(0)

    def unit(shape):
        return (lambda rows: rows / np.linalg.norm(rows, axis=-1, keepdims=True))(rng.normal(size=shape))

    regions, texts, canonical = (unit(shape).astype(np.float32) for shape in ((6, 12), (3, 12), (4, 12)))
    pixels = rng.integers(0, 500, (6, 5)).astype(np.int32)
    regions[2] = 0
    words = rules.unit(rng.standard_normal((9, regions.shape[1]))).astype(np.float32)
    found = {kind: rules.scores(regions, texts, canonical, words, pixels, kind) for kind in rules.SCORES}
    assert all((table[:, 2] == -np.inf).all() for table in found.values())
    known = np.arange(6) != 2
    for q, text in enumerate(texts):
        apart = np.asarray(region_similarities(regions, text, words, "contrast")[0])
        relevancy = np.asarray(relevancies(regions, text, canonical)[0])
        np.testing.assert_allclose(found["contrast"][q, known], apart[known], atol=1e-5)
        np.testing.assert_allclose(found["relevancy"][q, known], relevancy[known], atol=1e-5)
        np.testing.assert_allclose(found["cosine"][q, known], (regions @ text)[known], atol=1e-5)
    moved = rules.scores(regions, rules.unit(texts + canonical.mean(0)), canonical, words, pixels, "centred")
    np.testing.assert_allclose(moved[:, known], found["centred"][:, known], atol=1e-5)  # phrases say nothing


def test_minilm_reads_its_files_and_gives_units(tmp_path):
    """A model of one layer and two heads: what it gives is the hand-written sum of its parts."""
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace

    rng, size = np.random.default_rng(0), 4
    tokenizer = Tokenizer(WordLevel({"a": 0, "b": 1, "[UNK]": 2}, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = Whitespace()
    tokenizer.save(str(tmp_path / "tokenizer.json"))
    config = {"num_attention_heads": 2, "num_hidden_layers": 0, "layer_norm_eps": 0.0}
    (tmp_path / "config.json").write_text(json.dumps(config))
    shapes = {
        "word_embeddings.weight": (3, size),
        "position_embeddings.weight": (8, size),
        "token_type_embeddings.weight": (2, size),
        "LayerNorm.weight": (size,),
        "LayerNorm.bias": (size,),
    }
    tensors = {f"embeddings.{name}": rng.normal(size=shape).astype("<f4") for name, shape in shapes.items()}
    header, data = {}, b""
    for name, value in tensors.items():
        header[name] = {"dtype": "F32", "shape": value.shape, "data_offsets": [len(data), len(data) + value.nbytes]}
        data += value.tobytes()
    told = json.dumps(header).encode()
    (tmp_path / "model.safetensors").write_bytes(len(told).to_bytes(8, "little") + told + data)
    rows = [tensors[f"embeddings.{name}"].astype(float) for name in shapes]
    x = rows[0][[1, 0]] + rows[1][:2] + rows[2][0]
    x = (x - x.mean(1, keepdims=True)) / x.std(1, keepdims=True) * rows[3] + rows[4]
    np.testing.assert_allclose(MiniLM(tmp_path).embed(["b a"])[0], _unit(x.mean(0)), atol=1e-6)


def test_the_real_labeller_knows_a_bonsai(shared):
    """The middle of a photograph, with the bonsai, is a houseplant to it; the whole picture is furniture."""
    pytest.importorskip("ai_edge_litert")
    import cv2

    real = Conse()
    assert len(real.labeller.names) == 631
    assert real.dim == 384
    picture = cv2.imread(str(shared / "captures/bonsai/images/DSCF5725.JPG"))[..., ::-1]
    height, width = picture.shape[:2]
    masks = np.zeros((2, height, width), bool)
    masks[0, height // 4 : 3 * height // 4, width // 4 : 3 * width // 4] = True
    masks[1] = True
    best = [real.labeller.names[int(np.argmax(row))] for row in real.scores(picture, masks)]
    assert best == ["houseplant", "furniture"]
