"""How many colours that a room lacks are refused, and how many of its objects' names are answered, by colours alone.

    python -m experiments.colour_refusal DEMO [DEMO ...]        (folders that `jsecon demo` wrote)

A colour counts as absent if its embedding, and that of each of its shades, has a cosine below 0.8 with the name of
every object. Refused are texts that `jsecon query` refuses by default. Beside them stand basic terms of which a room
has only shades ("blue" beside a dark blue vase): right is the answer to the name of one of these objects.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jsecon
from experiments import results
from jsecon import Scene
from jsecon.numerics import cosine_matrix
from jsecon.read.masks.labels import load_lerf_labels
from jsecon.vision.colours import BASIC, ColourEmbedder

COLOURS = "red orange yellow green blue purple pink brown turquoise teal cyan magenta violet olive navy maroon"
COLOURS += " beige lime gold crimson salmon lavender indigo"
NEAR = 0.8
"""cosine from which two names are about one colour"""


def room_counts(demo: Path, embedder: ColourEmbedder) -> tuple[int, ...]:
    """Counts texts kept of those present, texts refused of those absent, and bare terms right of those with shades."""
    field = jsecon.load_field(demo / "field.safetensors")
    texts = sorted({name for frame in load_lerf_labels(demo / "capture" / "label") for name in frame.objects})
    present = jnp.asarray(embedder.embed_text(texts))
    absent = []
    for text in (f"{colour} thing" for colour in COLOURS.split()):
        words = jnp.asarray(embedder.embed_text([text, *embedder.narrower(text)]))
        if np.asarray(cosine_matrix(words, present)).max() < NEAR:
            absent.append(text)
    bare = [basic for basic in BASIC if not any(text.split()[0] == basic for text in texts)]
    shades = {b: [text for text in texts if f"dark {b}" in text or f"light {b}" in text] for b in bare}
    shades = {basic: names for basic, names in shades.items() if names}
    asked = {*texts, *absent, *shades}
    scene = Scene(field, embedder)
    region = {text: int(scene.ask(text).selection.region) for text in asked}
    kept = sum(region[text] >= 0 for text in texts)
    refused = sum(region[text] < 0 for text in absent)
    right = sum(region[basic] in [region[name] for name in names] for basic, names in shades.items())
    return kept, len(texts), refused, len(absent), right, len(shades)


def main(demos: list[str]) -> list[tuple]:
    """Prints a row of each room (`room_counts`), and their sums."""
    embedder = ColourEmbedder()
    rows = [(Path(demo).name, *room_counts(Path(demo), embedder)) for demo in demos]
    rows.append(("all", *np.sum([row[1:] for row in rows], axis=0)))
    print(results.table(("room", "kept", "of present", "refused", "of absent", "by shades", "of bare terms"), rows))
    return rows


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    main(sys.argv[1:])
