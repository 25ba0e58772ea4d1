"""Query speed with its error beside it.

    python benchmarks/query.py [--gaussians 1000000] [--repeats 7]

A made field: random votes over 40 regions, unit codes of 3 and of 512 numbers, one query compiled, and 100 queries
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

from jsecon.field.similarity import unit_codes
from jsecon.paper.baselines import query_one_step
from jsecon.query.answer import match_regions, query_anchored
from jsecon.query.select import select_by_code
from jsecon.types import Camera, Gaussians, LanguageField, Regions, Votes

REGIONS, TOP, TEXTS, SAMPLE = 40, 8, 100, 20_000


def made_field(count: int, size: int, seed: int = 0) -> LanguageField:
    """A field of random votes; a Gaussian's code is that of its strongest region, turned a little."""
    rng = np.random.default_rng(seed)
    embeddings = rng.normal(size=(REGIONS, 512)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    table = embeddings[:, :size] / np.linalg.norm(embeddings[:, :size], axis=1, keepdims=True)
    ids = rng.integers(0, REGIONS, (count, TOP), dtype=np.int32)
    weights = -np.sort(-rng.exponential(size=(count, TOP)).astype(np.float32), axis=1)
    codes = np.empty((count, size), np.float32)
    for rows in np.array_split(np.arange(count), max(1, count // 50_000)):
        near = table[ids[rows, 0]] + 0.3 / np.sqrt(size) * rng.standard_normal((len(rows), size), np.float32)
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
    return LanguageField(
        gaussians, codes, votes, regions, table, None, camera, embeddings[:4], np.eye(4), ("0",)
    )  # fmt: skip


def measure(count: int, repeats: int) -> list[Metric]:
    """All rows."""
    rows = []
    rng = np.random.default_rng(1)
    for size in (3, 512):
        field = jax.tree.map(jnp.asarray, made_field(count, size))
        units = jax.block_until_ready(unit_codes(field.codes))
        texts = jnp.asarray(np.asarray(field.regions.embeddings)[rng.integers(0, REGIONS, TEXTS)])
        ask = {
            "by votes": jax.jit(lambda field, units, text: query_anchored(field, text)),
            "by code": jax.jit(
                lambda field, units, text: select_by_code(field, match_regions(field, text[None]), codes=units)
            ),
        }
        if size == 512:
            ask["one-step"] = jax.jit(lambda field, units, text: query_one_step(units, text, 0.8))
        calls = {name: functools.partial(f, field, units, texts[0]) for name, f in ask.items()}
        # Apart from the single ones, whose memory half a gigabyte of answers would push out.
        several = tuple(ask) if size == 3 else ("by code",)  # the votes are the same ones
        many = {name: jax.jit(jax.vmap(ask[name], in_axes=(None, None, 0))) for name in several}
        together = {name: functools.partial(f, field, units, texts) for name, f in many.items()}
        ms, _ = interleaved(calls, repeats)
        all_ms, _ = interleaved(together, max(repeats // 2, 1))
        for name in ask:
            rows.append(Metric(f"query {name}, d={size}, {count} Gaussians", ms[name], "ms", "lower", 1.0))
        for name in several:
            what, note = f"{TEXTS} queries {name} vmapped against one", f"{all_ms[name]:.1f} ms / {ms[name]:.2f} ms"
            rows.append(Metric(f"{what}, d={size}", all_ms[name] / ms[name], "x", "lower", 0.5, note))
        found = ask["by code"](field, units, texts[0])
        exact = np.asarray(field.codes[:SAMPLE], np.float64) @ np.asarray(field.region_codes[found.region], np.float64)
        error = np.abs(np.asarray(found.similarity[:SAMPLE]) - exact).max()
        rows.append(Metric(f"largest error of a cosine, d={size}", float(error), "", "lower", 3.0))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    show(measure(arguments.gaussians, arguments.repeats))


if __name__ == "__main__":
    main()
