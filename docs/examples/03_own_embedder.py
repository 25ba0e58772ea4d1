"""Use an embedder of your own: any space that texts and pixels share.

Run: python docs/examples/03_own_embedder.py [FIELD [CAPTURE]]
"""

import dataclasses
import sys

import numpy as np

import jsecon
from jsecon.read.masks.masks import load_labels

WORDS = {"warm": (1.0, 0.2, -1.0), "cold": (-1.0, 0.1, 1.0), "green": (-0.6, 1.0, -0.6)}


class Warmth:
    """Compares what sets the mean colour of a region apart from grey with a few words."""

    name, dim = "warmth-1", 3
    canonical_phrases = np.full((1, 3), 3**-0.5, np.float32)

    def embed_regions(self, frame, masks):
        means = np.array([frame[mask].mean(0) if mask.any() else np.zeros(3) for mask in masks]).reshape(-1, 3)
        return unit(means - means.mean(1, keepdims=True))

    def embed_text(self, texts):
        return unit(np.array([WORDS[text] for text in texts]))


def unit(rows):
    return (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-6)).astype(np.float32)


field = jsecon.load_field(sys.argv[1] if len(sys.argv) > 1 else "jsecon-demo/field.safetensors")
folder = sys.argv[2] if len(sys.argv) > 2 else "jsecon-demo/capture"
capture, embedder = jsecon.load_capture(folder, holdout=0), Warmth()
labels, ids, _ = load_labels(f"{folder}/masks", capture.names, capture.frames.shape[1:3])
regions = jsecon.region_embeddings(capture.frames, labels, embedder.embed_regions)
votes = jsecon.region_votes(field.gaussians, capture.cameras, labels, len(ids), by_view=True)
own = {"regions": regions, "votes": jsecon.normalise_votes(votes, regions), "embedder": embedder.name}
own |= {"cameras": capture.cameras, "names": capture.names, "canonical_phrases": embedder.canonical_phrases}
field = dataclasses.replace(field, **own, unrelated_words=None, tree=None, leaf=None, codes=None)

answer = jsecon.Scene(field, embedder).ask("cold")
print(answer)
blue_minus_red = np.asarray(field.gaussians.sh)[:, 0, 2] - np.asarray(field.gaussians.sh)[:, 0, 0]
assert answer.mask.any()
assert blue_minus_red[answer.mask].mean() > 0 > blue_minus_red[~answer.mask].mean()
