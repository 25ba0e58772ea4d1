"""How many colours that a room lacks are refused, and how many of its objects' names are answered, by colours alone.

    python -m experiments.colour_refusal DEMO [DEMO ...]        (folders that `jsecon demo` wrote)

A colour counts as absent if its embedding has a cosine below 0.8 with the name of every object. Refused are texts whose
quantile among unrelated words is below the default of `jsecon query`.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jsecon
from experiments import results
from jsecon.data.labels import load_lerf_labels
from jsecon.numerics import cosine_matrix
from jsecon.query.rules import QUANTILE
from jsecon.vision.colours import ColourEmbedder

COLOURS = "red orange yellow green blue purple pink brown turquoise teal cyan magenta violet olive navy maroon"
COLOURS += " beige lime gold crimson salmon lavender indigo"
NEAR = 0.8
"""cosine from which two names are about one colour"""


def main(demos: list[str]) -> list[tuple]:
    """Prints a row of each room: texts kept of those present, refused of those absent."""
    embedder, rows = ColourEmbedder(), []
    names = [f"{colour} thing" for colour in COLOURS.split()]
    for demo in demos:
        field = jsecon.load_field(Path(demo) / "field.safetensors")
        texts = sorted({name for frame in load_lerf_labels(Path(demo) / "capture" / "label") for name in frame.objects})
        present, others = (jnp.asarray(embedder.embed_text(words)) for words in (texts, names))
        absent = others[np.asarray(cosine_matrix(others, present)).max(1) < NEAR]
        answered = [
            np.array([float(jsecon.match_regions(field, text[None], jsecon.QueryRules()).quantile) for text in group])
            >= QUANTILE
            for group in (present, absent)
        ]
        rows.append((Path(demo).name, answered[0].sum(), len(present), (~answered[1]).sum(), len(absent)))
    rows.append(("all", *np.sum([row[1:] for row in rows], axis=0)))
    print(results.table(("room", "kept", "of present", "refused", "of absent"), rows))
    return rows


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    main(sys.argv[1:])
