"""Query speed with its error beside it.

    python benchmarks/query.py [--gaussians 1000000] [--repeats 7]

A made field: random votes over 40 regions, unit codes of 3 numbers, one query compiled, and 100 queries
under vmap, in turn in one run. Errors are against NumPy float64.
"""

import argparse
import functools

from jsecon.process import prepare_process

prepare_process(keep_programs=False)

import jax
import jax.numpy as jnp
import numpy as np
from metrics import Metric, interleaved, show

from jsecon.paper.queries import query_one_step, select_by_code
from jsecon.query.answer import match_regions, query_anchored
from jsecon.types import Camera, Codes, Gaussians, LanguageField, Regions, Votes

REGIONS, TOP, TEXTS, SAMPLE, SIZE = 40, 8, 100, 20_000, 3


def made_field(count: int, seed: int = 0) -> LanguageField:
    """A field of random votes; a Gaussian's code is that of its strongest region, turned a little."""
    rng = np.random.default_rng(seed)
    embeddings = rng.normal(size=(REGIONS, 512)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    table = embeddings[:, :SIZE] / np.linalg.norm(embeddings[:, :SIZE], axis=1, keepdims=True)
    ids = rng.integers(0, REGIONS, (count, TOP), dtype=np.int32)
    weights = -np.sort(-rng.exponential(size=(count, TOP)).astype(np.float32), axis=1)
    codes = np.empty((count, SIZE), np.float32)
    for rows in np.array_split(np.arange(count), max(1, count // 50_000)):
        near = table[ids[rows, 0]] + 0.3 / np.sqrt(SIZE) * rng.standard_normal((len(rows), SIZE), np.float32)
        codes[rows] = near / np.linalg.norm(near, axis=1, keepdims=True)
    labelled = weights.sum(1)
    ones = np.ones(count, np.float32)
    views, total = np.ones(count, np.int32), labelled * 1.1
    shown = np.repeat(labelled[:, None], TOP, axis=1)
    votes = Votes(ids, weights, labelled, total, ones, views, np.int32(0), REGIONS, None, shown)
    points = np.zeros((count, 3), np.float32)
    gaussians = Gaussians(points, points, np.tile(np.float32([1, 0, 0, 0]), (count, 1)), ones, points[:, None])
    camera = Camera(np.eye(4, dtype=np.float32)[None], *(np.ones(1, np.float32) for _ in range(4)), 8, 8)
    regions = Regions(embeddings, np.ones((REGIONS, 1), np.int32))
    codes = Codes(codes, table, None)
    return LanguageField(
        gaussians, votes, regions, camera, embeddings[:4], np.eye(4), ("0",), codes=codes
    )  # fmt: skip


def measure(count: int, repeats: int) -> list[Metric]:
    """All rows."""
    rows = []
    rng = np.random.default_rng(1)
    field = jax.tree.map(jnp.asarray, made_field(count))
    texts = jnp.asarray(np.asarray(field.regions.embeddings)[rng.integers(0, REGIONS, TEXTS)])
    ask = {
        "by votes": jax.jit(lambda field, text: query_anchored(field, text)),
        "by code": jax.jit(lambda field, text: select_by_code(field, match_regions(field, text[None]))),
        "one-step": jax.jit(lambda field, text: query_one_step(field.codes.gaussians, text[:SIZE], 0.8)),
    }
    # Apart from the single ones, whose memory half a gigabyte of answers would push out.
    ms, _ = interleaved({name: functools.partial(f, field, texts[0]) for name, f in ask.items()}, repeats)
    many = {name: jax.jit(jax.vmap(f, in_axes=(None, 0))) for name, f in ask.items()}
    together = {name: functools.partial(f, field, texts) for name, f in many.items()}
    all_ms, _ = interleaved(together, max(repeats // 2, 1))
    for name in ask:
        rows.append(Metric(f"query {name}, {count} Gaussians", ms[name], "ms", "lower", 1.0))
        what, note = f"{TEXTS} queries {name} vmapped against one", f"{all_ms[name]:.1f} ms / {ms[name]:.2f} ms"
        rows.append(Metric(what, all_ms[name] / ms[name], "x", "lower", 0.5, note))
    found = ask["by code"](field, texts[0])
    codes = np.asarray(field.codes.gaussians[:SAMPLE], np.float64)
    exact = codes @ np.asarray(field.codes.regions[found.region], np.float64)
    error = np.abs(np.asarray(found.similarity[:SAMPLE]) - exact).max()
    rows.append(Metric("largest error of a cosine", float(error), "", "lower", 3.0))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    show(measure(arguments.gaussians, arguments.repeats))


if __name__ == "__main__":
    main()
