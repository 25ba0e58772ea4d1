"""Common nouns of all kinds: what the similarity of a text with a scene is measured against.

Few of them are in any one scene. So their best regions say how similar a text is to a scene that does not hold what
it names (jsecon.query.scores). The list was written before anything was measured with it.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from jsecon.errors import InputError
from jsecon.files import READ_ERRORS, atomic_write, read_arrays, write_arrays
from jsecon.process import cache_home
from jsecon.vision.protocols import Embedder

_WORDS = """
apple, banana, orange, lemon, grape, strawberry, cherry, melon, pineapple, coconut, tomato, potato, carrot, onion,
cabbage, mushroom, corn, bean, rice, bread, cheese, butter, egg, sausage, soup, salad, pizza, sandwich, noodle, cake,
cookie, chocolate, ice cream, honey, milk, coffee, wine, beer,
dog, cat, horse, cow, pig, sheep, donkey, camel, elephant, lion, bear, wolf, deer, rabbit, mouse, monkey, kangaroo,
giraffe, zebra, whale, shark, seal, turtle, frog, snake, lizard, crocodile, chicken, duck, swan, eagle, owl, parrot,
penguin, butterfly, bee, ant, spider, snail, crab,
car, bus, truck, ambulance, tractor, motorcycle, bicycle, train, airplane, helicopter, rocket, ship, canoe, submarine,
tire, engine, anchor, sail, parachute,
man, woman, child, baby, face, eye, ear, nose, mouth, tooth, beard, shoulder, elbow, hand, finger, knee, foot, skull,
shirt, trousers, dress, coat, sweater, sock, shoe, sandal, hat, scarf, glove, belt, necktie, button, zipper, necklace,
earring, crown, eyeglasses, umbrella, handbag, backpack, suitcase, wallet,
chair, sofa, bed, table, shelf, drawer, mirror, curtain, carpet, pillow, blanket, lamp, candle, clock, vase, door,
window, staircase, ladder, fireplace, chimney, roof, wall, floor,
cup, plate, bowl, bottle, teapot, frying pan, knife, fork, spoon, oven, refrigerator, toaster, dishwasher, sink,
bathtub, toilet, towel, soap, toothbrush, comb, broom, bucket, sponge, sewing machine, vacuum cleaner,
hammer, saw, screwdriver, nail, axe, shovel, rake, rope, chain, needle, scissors, wheelbarrow, lawn mower,
book, newspaper, map, letter, stamp, pencil, ruler, globe, blackboard, calendar, laptop, printer, telephone,
television, radio, camera, microphone, loudspeaker, headphones, battery, light bulb, calculator, telescope,
microscope, compass, thermometer, syringe, bandage, wheelchair, coin, key, flag, whistle, trophy,
piano, guitar, violin, drum, trumpet, flute,
ball, doll, teddy bear, kite, dice, chess board, balloon, swing, skateboard, surfboard, ski, tennis racket, dumbbell,
tent,
tree, grass, leaf, cactus, rose, palm tree, root, moss,
mountain, desert, forest, beach, island, river, waterfall, wave, cloud, rain, snow, rainbow, moon, volcano, cave, sand,
mud, fire, smoke,
castle, church, temple, school, hospital, restaurant, supermarket, factory, barn, lighthouse, windmill, skyscraper,
bridge, tunnel, railway, harbour, stadium, theatre, museum, prison, fountain, statue, fence, bench, mailbox,
traffic light, fire hydrant,
sword, shield, cannon, bomb, coffin, mask, feather, horn, wing, nest, cage, aquarium, saddle, barrel, cardboard box,
basket, jar, paper, brick, wool, leather, diamond
"""
REFERENCE_WORDS: tuple[str, ...] = tuple(word.strip() for word in _WORDS.split(","))


def reference_of(embedder: Embedder) -> Float32[np.ndarray, "w e"]:
    """Embeds texts that have nothing to do with a scene.

    Args:
      embedder: Space of images and texts. Where it has `unrelated_words`, that is taken.

    Returns:
      (W, E) unit rows; W is 0 where the embedder has no words for REFERENCE_WORDS.
    """
    rows = getattr(embedder, "unrelated_words", None)
    if rows is None:
        try:
            rows = embedder.embed_text(list(REFERENCE_WORDS))
        except InputError:
            rows = np.zeros((0, embedder.dim))
    return np.asarray(rows, np.float32)


def cached_reference(
    space: str, embed_text: Callable[[list[str]], Float32[np.ndarray, "w e"]]
) -> Float32[np.ndarray, "w e"]:
    """Embeds REFERENCE_WORDS, or reads them from the user's cache folder, where they are kept for each space.

    Args:
      space: Names the space by its content: the model's digest and all else that changes its texts.
      embed_text: W texts -> (W, E) unit rows.

    Returns:
      (W, E) unit rows.
    """
    home = cache_home(os.environ)
    if home is None:
        return embed_text(list(REFERENCE_WORDS))
    digest = hashlib.blake2b(repr((space, REFERENCE_WORDS)).encode(), digest_size=12).hexdigest()
    path = home / "jsecon" / f"words-{digest}.safetensors"
    with contextlib.suppress(*READ_ERRORS):
        return read_arrays(path)[1]["rows"]
    rows = embed_text(list(REFERENCE_WORDS))
    # A full disk costs the next run a minute, and is no reason to end this one.
    with contextlib.suppress(InputError), atomic_write(path) as temporary:
        write_arrays(temporary, {"rows": rows})
    return rows
