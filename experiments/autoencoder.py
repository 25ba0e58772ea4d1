"""What does a small code keep? Reconstruction and retrieval accuracy against latent size and seconds.

    python -m experiments.autoencoder [--quick]

Regions are drawn from 1,203 classes of a real text space (CLIP ViT-B/32 of LVIS, ../shared/text; a made one of the same
statistics where it is missing): an image embedding each, as simulated vision makes them at the medium level, and its
class's text to ask with. Coders: LangSplat's autoencoder, a rotation (principal directions), spread codes, and none.
Reconstruction: the mean cosine of an embedding with its decoded code. Retrieval: how often the text's code is nearest
to its own region's code, beside the same with the embeddings themselves. Apart: the share of pairs of distinct regions
whose codes have a cosine below the query's threshold, 0.9.
"""

import argparse
import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.ideas import scenes
from experiments.simulated_vision.embeddings import SimulatedEmbedder
from experiments.simulated_vision.masks import LEVELS
from jsecon.language.autoencoder import train_autoencoder
from jsecon.language.codes import Spread, confused_pairs, distinct_pairs, encode, principal_rotation, spread_codes
from jsecon.numerics import cosine, cosine_matrix, normalize


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    texts: str = str(results.CAPTURES.parent / "text")
    regions: tuple[int, ...] = (40, 200)
    latents: tuple[int, ...] = (3, 8, 16, 32, 64)
    seeds: tuple[int, ...] = (0, 1, 2)
    level: str = "medium"
    pixels: int = 4000
    """of a region's mask, which sets its embedding's noise."""
    epochs: int | None = None
    """of the autoencoder; None: as `train_autoencoder` chooses."""
    out: str = str(results.HOME / "results" / "autoencoder")


QUICK = Options(
    regions=(12,), latents=(3, 8), seeds=(0,), epochs=20, out=str(results.HOME / "results" / "autoencoder_quick")
)


def embeddings_of(space, count: int, seed: int, options: Options) -> tuple[np.ndarray, np.ndarray]:
    """(R, E) image embeddings of `count` regions of classes of their own, and (R, E) the classes' texts."""
    chosen = np.random.default_rng(seed).choice(len(space.names), count, replace=False)
    classes = [space.names[i] for i in chosen]
    side = int(options.pixels**0.5)
    labels = np.arange(count)[:, None, None] * np.ones((1, side, side), int)
    frames = np.zeros((count, side, side, 3), np.uint8)
    frames[:, 0, 0] = np.stack([np.arange(count) // 256, np.arange(count) % 256, np.zeros(count)], 1)  # no two alike
    embedder = SimulatedEmbedder(frames, labels, classes, space, LEVELS[options.level], seed=seed)
    whole = np.ones((1, side, side), bool)
    return np.concatenate([embedder.embed_regions(frame, whole) for frame in frames]), embedder.embed_text(classes)


def made(kind: str, units, latent: int, seed: int, options: Options):
    """(coder, seconds): the second of two trainings, as the first compiles."""

    def train():
        if kind == "none":
            return None
        if kind == "rotation":
            return principal_rotation(units, latent)
        if kind == "spread":
            return Spread(units, spread_codes(units, latent))
        return train_autoencoder(units, latent=latent, key=jax.random.key(seed), epochs=options.epochs)

    jax.block_until_ready(jax.tree.leaves(train()))
    began = time.perf_counter()
    coder = train()
    jax.block_until_ready(jax.tree.leaves(coder))
    return coder, time.perf_counter() - began


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    space = scenes.text_space(Path(options.texts))
    found: dict[tuple, list[tuple[float, ...]]] = {}
    for count in options.regions:
        for seed in options.seeds:
            images, texts = embeddings_of(space, count, seed, options)
            units = normalize(jnp.asarray(images))
            ways = [("none", units.shape[1])]
            ways += [(kind, d) for kind in ("autoencoder", "rotation", "spread") for d in options.latents]
            for kind, latent in ways:
                coder, spent = made(kind, units, latent, seed, options)
                codes = encode(coder, units)
                decoded = units if coder is None else coder.decode(codes)
                nearest = np.asarray(jnp.argmax(cosine_matrix(encode(coder, jnp.asarray(texts)), codes), -1))
                pairs = max(int(distinct_pairs(units).sum()) // 2, 1)
                found.setdefault((count, kind, latent), []).append(
                    (
                        float(jnp.mean(cosine(decoded, units))),
                        float((nearest == np.arange(count)).mean()),
                        1 - confused_pairs(units, codes) / pairs,
                        spent,
                    )
                )
    names = ("reconstruction", "retrieval", "apart", "seconds")
    rows = [
        {"regions": count, "coder": kind, "latent": latent}
        | {n: float(np.mean([v[i] for v in values])) for i, n in enumerate(names)}
        | {f"{n}_deviation": float(np.std([v[i] for v in values])) for i, n in enumerate(names)}
        for (count, kind, latent), values in found.items()
    ]
    shown = ("regions", "coder", "latent", *names)
    header = ("regions", "coder", "latent", "cosine of the reconstruction", "text finds its region", "apart", "seconds")
    table = results.table(header, [tuple(row[name] for name in shown) for row in rows])
    results.save(Path(options.out), options, {"rows": rows}, table, draw(rows))
    print(table)
    return {"rows": rows}


def draw(rows: list[dict]):
    """Retrieval and reconstruction against the latent size, a curve per coder, for the largest number of regions."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6))
    most = max(row["regions"] for row in rows)
    for column, name in enumerate(("retrieval", "reconstruction")):
        axes = figure.add_subplot(1, 2, column + 1)
        for kind in dict.fromkeys(row["coder"] for row in rows):
            own = [row for row in rows if row["coder"] == kind and row["regions"] == most]
            if kind == "none":
                axes.axhline(own[0][name], color="0.5", linestyle="--", label="none")
            else:
                error = [r[f"{name}_deviation"] for r in own]
                axes.errorbar([r["latent"] for r in own], [r[name] for r in own], error, marker=".", label=kind)
        axes.set_xscale("log", base=2)
        axes.set_xlabel("latent size")
        axes.set_ylabel(f"{name}, {most} regions")
        axes.set_ylim(0, 1.02)
    axes.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="twelve regions, few epochs: a minute")
    main(QUICK if parser.parse_args().quick else Options())
