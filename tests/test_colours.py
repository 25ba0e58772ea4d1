import cv2
import numpy as np
import pytest
from capture_files import refused
from hypothesis import given, settings, strategies as st

from jsecon.errors import InputError
from jsecon.vision.colours import BASIC, PALETTE, ColourEmbedder
from jsecon.vision.protocols import Embedder


@pytest.fixture(scope="module")
def embedder() -> ColourEmbedder:
    return ColourEmbedder()


def ball(rgb, *, background=(128, 128, 128), texture=0.0):
    """A lit ball with a highlight and a shadow side in the middle of a 120x120 frame, and its mask."""
    rows, columns = np.mgrid[:120, :120].astype(np.float32)
    mask = (rows - 60) ** 2 + (columns - 60) ** 2 < 20**2
    up, left = (60 - rows) / 20, (60 - columns) / 20
    out = np.sqrt(np.clip(1 - up**2 - left**2, 0, 1))
    light = 0.35 + 0.7 * np.clip(0.5 * up + 0.4 * left + 0.75 * out, 0, 1)
    light = light * (1 + texture * np.sign(np.sin(columns / 2)))
    shine = 0.8 * np.clip(0.35 * up + 0.3 * left + 0.88 * out, 0, 1) ** 60
    linear = (np.asarray(rgb) / 255) ** 2.2 * light[..., None] + shine[..., None]
    frame = np.full((120, 120, 3), background, np.float64)
    frame[mask] = 255 * np.clip(linear, 0, 1)[mask] ** (1 / 2.2)
    return frame.astype(np.uint8), mask


def of_ball(embedder, rgb, **options):
    frame, mask = ball(rgb, **options)
    return embedder.embed_regions(frame, mask[None])[0]


def test_is_an_embedder_of_unit_vectors(embedder):
    assert isinstance(embedder, Embedder)
    frame, mask = ball((200, 30, 30))
    regions = embedder.embed_regions(frame, np.stack([mask, ~mask, np.zeros_like(mask)]))
    texts = embedder.embed_text(["red", "dark green bottle"])
    assert regions.shape == (3, embedder.dim)
    assert regions.dtype == texts.dtype == embedder.canonical_phrases.dtype == np.float32
    for rows in (regions[:2], texts, embedder.canonical_phrases):
        np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)
    assert not regions[2].any()  # an empty mask has no embedding
    assert embedder.embed_regions(frame, np.zeros((0, 120, 120), bool)).shape == (0, embedder.dim)
    assert embedder.embed_text([]).shape == (0, embedder.dim)
    two = embedder.embed_regions(np.array([[(200, 30, 30), (90, 10, 10)]], np.uint8), np.ones((1, 1, 2), bool))
    assert np.linalg.norm(two) == pytest.approx(1, abs=1e-5)
    with pytest.raises(ValueError, match="masks"):
        embedder.embed_regions(frame, mask[None, 1:])


@pytest.mark.parametrize("name", ["dark green", "light green", "dark blue", "light blue", *BASIC])
def test_a_shaded_thing_is_nearest_to_its_own_name(embedder, name):
    names = ["dark green", "light green", "dark blue", "light blue", *BASIC]
    similarity = embedder.embed_text([f"{n} thing" for n in names]) @ of_ball(embedder, PALETTE[name], texture=0.1)
    order = np.argsort(-similarity)
    assert names[order[0]] == name
    assert similarity[order[0]] > 0.75


@pytest.mark.parametrize(("one", "other"), [
    ("gray cat", "grey cat"), ("light-blue cup", "the light blue mug"), ("GREENISH", "greenish"),
    ("lighter green", "pale green"),
    ("red/white box", "red and white striped box"), ("bluish green", "bluish-green"),
    ("reddish, brown", "reddish & brown"),
    ("scarlet", "red"), ("fuchsia", "magenta"),
])  # fmt: skip
def test_texts_that_say_the_same(embedder, one, other):
    np.testing.assert_allclose(*embedder.embed_text([one, other]), atol=1e-6)


@pytest.mark.parametrize("order", [
    ("red", "crimson", "orange", "yellow", "blue"), ("teal", "turquoise", "light blue", "orange"),
    ("greenish", "green", "blue"), ("grey", "greenish", "green"), ("bluish-green", "green", "blue"),
    ("blue", "bluish-green", "green"), ("navy blue", "navy", "blue"), ("bright red", "red", "dark red"),
])  # fmt: skip
def test_likeness_falls_with_the_distance_of_colours(embedder, order):
    """ "-ish" and compounds lie between."""
    first, *others = embedder.embed_text(list(order))
    assert (np.diff(np.stack(others) @ first) < 0).all()


def test_two_colours_want_both(embedder):
    frame, mask = ball((205, 32, 36))
    striped = frame.copy()
    striped[:, ::8] = striped[:, 1::8] = striped[:, 2::8] = striped[:, 3::8] = (242, 242, 240)
    text = embedder.embed_text(["red and white striped box"])[0]
    both = embedder.embed_regions(striped, mask[None])[0] @ text
    assert both > 0.8
    for alone in (embedder.embed_regions(frame, mask[None])[0], of_ball(embedder, PALETTE["white"])):
        assert both > alone @ text + 0.1


def test_the_thing_and_not_the_wall(embedder):
    """A white plate against a beige and a white wall that fills the frame."""
    for wall, least in (((222, 206, 174), 0.2), ((236, 236, 234), 0.05)):
        frame, mask = ball((250, 250, 248), background=wall)
        plate, around = embedder.embed_regions(frame, np.stack([mask, ~mask]))
        assert embedder.embed_text(["white plate"])[0] @ (plate - around) > least
    assert embedder.embed_text(["white wall"])[0] @ (around - plate) > 0.05


@pytest.mark.parametrize("text", ["bottle", "", "shiny", "dark box", "goldfish", "blackboard", "ivy", "  ?!", "éclair"])
def test_a_text_without_colour_is_refused_plainly(embedder, text):
    with refused(repr(text), "colour", "teal", "--at", "CLIP"):
        embedder.embed_text(["red cup", text])
    with pytest.raises(InputError, match="negation"):
        embedder.embed_text(["the cup that isn't red"])


def test_canonical_phrases_lose_to_the_right_colour_and_win_over_wrong_ones(embedder):
    names = [name for name in BASIC if name != "grey"]
    regions = np.stack([of_ball(embedder, PALETTE[name]) for name in names])
    neutral = (embedder.canonical_phrases @ regions.T).max(0)
    assert (np.diagonal(embedder.embed_text(names) @ regions.T) > neutral + 0.05).all()
    others = [names.index("green"), names.index("yellow")]
    assert (embedder.embed_text(["magenta"]) @ regions[others].T < neutral[others]).all()


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_equivariance_and_exposure(seed):
    """Mirroring the frame changes nothing; a little less light keeps a colour's vector near."""
    embedder = ColourEmbedder()
    rng = np.random.default_rng(seed)
    frame = cv2.resize(rng.integers(0, 256, (3, 4, 3), np.uint8), (40, 30), interpolation=cv2.INTER_NEAREST)
    masks = rng.random((4, 30, 40)) < 0.3
    rows = embedder.embed_regions(frame, masks)
    np.testing.assert_allclose(embedder.embed_regions(frame[:, ::-1], masks[:, :, ::-1]), rows, atol=1e-5)
    dimmer = np.round(frame * 0.95).astype(np.uint8)
    assert ((embedder.embed_regions(dimmer, masks) * rows).sum(1) > 0.8).all()
