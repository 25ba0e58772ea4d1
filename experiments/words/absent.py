"""Names of what is not in a scene: against them a refusal is measured.

A name of the table is absent where its text vector has a cosine below LEAST with that of every name of what is in the
scene, so that synonyms and near kinds are left out, and where it is none of ALWAYS: wholes and kinds that any of these
scenes is or has, and phrases that name no thing. It may still be there unseen, as a thing that nobody labelled.
"""

from experiments.words.conse import TextVectors
from jsecon.vision.protocols import CANONICAL

LEAST = 0.5
"""of the cosine"""
_PHRASES = "a photo of a {}, something to sit on, something to read, something to drink from, a place to sleep"
_WHOLES = (
    "light source, electronics, room, building, property, house, home, interior, furniture, flooring, shelf, shelving, "
    "cabinetry, plant, flower, textile, wood, glass, metal, plastic, fun, paper, light, lighting, doorknob, handle, "
    "knob, machine, container, box, fabric, leather, brick, tile, pattern, bag, hardware"
)
ALWAYS = frozenset((*CANONICAL, *_PHRASES.split(", "), *_WHOLES.split(", ")))
SEEN = {
    "replica_apartment_0": "television set, trash can, curtain, clock, towel, clothes, shoe, bicycle",
    "apc_bin": "shelf, book, box, cardboard box, tissue paper, pipe cleaners, toy, robot, hand, bin",
    "bonsai": "bonsai, potted plant, piano, keyboard, bicycle, lamp, floor, wall, curtain, window, table, book, "
    "magazine, tire, shoe, carpet, blanket, cushion, sofa, pillow, cable, speaker",
}
"""what the pictures show or may show beside the names of their truth"""


def absent_names(texts: TextVectors, scene: str, present: tuple[str, ...]) -> tuple[str, ...]:
    """The names of the table that are absent from a scene whose things have the names `present`."""
    known = [name for name in (*present, *SEEN.get(scene, "").split(", ")) if name in texts]
    nearest = (texts.vectors @ texts.embed(known).T).max(axis=1)
    left_out = ALWAYS | set(known)
    return tuple(name for name, near in zip(texts.names, nearest) if near < LEAST and name not in left_out)
