"""How much does the answer depend on the threshold? mIoU over thresholds 0.5 to 0.95, one-step, canonical, anchored.

    python -m experiments.thresholds [FOLDER_OF_DEMOS]

The paper's Fig. 2, on demo rooms with their true masks and simulated CLIP embeddings at the medium level
(experiments.simulated_vision): what differs between the queries is only how they cross the gap between text and image.
Protocol: point level, rendered (the selected Gaussians alone, alpha > 0.7) on the held-out views' labels, one text an
object; a view counts where the object has at least 40 px there.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.ideas import scenes
from experiments.ideas.scenes import rooms_of
from experiments.simulated_vision.embeddings import SimulatedEmbedder
from experiments.simulated_vision.masks import LEVELS
from experiments.tables.memberships import by_lead
from jsecon.evaluate.metrics import iou, mean_iou
from jsecon.language.codes import Spread, encode, region_codes, spread_codes
from jsecon.language.distill import distill_votes
from jsecon.language.field import load_field
from jsecon.language.membership import membership_probability, with_shown
from jsecon.language.regions import region_embeddings
from jsecon.language.votes import region_votes
from jsecon.query.anchored import query_anchored
from jsecon.query.baselines import query_canonical, query_one_step
from jsecon.query.render import selection_mask
from jsecon.types import Camera, Gaussians, LanguageField


@dataclasses.dataclass(frozen=True)
class Options(scenes.Rooms):
    """What the experiment can vary."""

    latents: tuple[int, ...] = (3, 16)
    """of LangSplat's autoencoder."""
    spread_latent: int = 16
    """of codes placed on the sphere so that no two have a cosine above `separation`."""
    separation: float = 0.4
    thresholds: tuple[float, ...] = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
    level: str = "medium"
    """of the embeddings' noise; the masks are true."""
    least_pixels: int = 40
    out: str = str(results.HOME / "results" / "thresholds")


def ask(field: LanguageField, coded: str, texts, asked, phrases, threshold: float) -> dict[str, np.ndarray]:
    """(K, N) bool the selections of K texts (K, E), with codes `asked` (K, d), by each kind of query; `coded` names the
    kind of code."""
    kinds = {
        f"one-step, {coded}": lambda text, code: query_one_step(field.codes, code, threshold),
        f"canonical, {coded}": lambda text, code: query_canonical(field.codes, code, phrases, threshold),
        f"anchored by code, {coded}": lambda text, code: query_anchored(
            field, text, similarity_threshold=threshold, by="code"
        ),
    }
    kinds["anchored by votes"] = lambda text, code: query_anchored(field, text, similarity_threshold=threshold)
    kinds["anchored by lead"] = lambda text, code: by_lead(field, query_anchored(field, text), threshold=threshold)

    def sure(text, code):
        found = query_anchored(field, text)
        probability = membership_probability(found.similarity, field.votes)
        return dataclasses.replace(found, mask=(found.region >= 0) & (probability >= threshold))

    kinds["anchored by votes, probability"] = sure
    return {
        name: np.stack([np.asarray(way(text, code).mask) for text, code in zip(texts, asked)])
        for name, way in kinds.items()
    }


def score(gaussians: Gaussians, cameras: Camera, masks: np.ndarray, true: np.ndarray, options: Options) -> float:
    """mIoU of K selections (K, N) with the true labels (V, H, W) of the views `cameras`."""
    ious = []
    for k, mask in enumerate(masks):
        for view in range(len(true)):
            if (true[view] == k).sum() >= options.least_pixels:
                rendered = selection_mask(gaussians, cameras[view], jnp.asarray(mask)) if mask.any() else None
                ious.append(None if rendered is None else float(iou(np.asarray(rendered), true[view] == k)))
    return mean_iou(ious)


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    space = options.space()
    found: dict[str, dict[float, list[float]]] = {}
    hits = []
    for seed in options.seeds:
        folder = options.folder(seed)
        scene, whole = scenes.demo_scene(folder, seed), load_field(folder / "field.safetensors")
        views, true = scenes.held_out_labels(folder, whole.names)
        cameras = jax.tree.map(jnp.asarray, whole.cameras[views])
        chosen = np.random.default_rng(seed).choice(len(space.names), scene.count, replace=False)
        classes = [space.names[i] for i in chosen]
        embedder = SimulatedEmbedder(scene.frames, scene.labels, classes, space, LEVELS[options.level], seed=seed)
        regions = region_embeddings(scene.frames, scene.labels, embedder.embed_regions, num_regions=scene.count)
        votes = region_votes(scene.gaussians, scene.cameras, jnp.asarray(scene.labels), scene.count, by_view=True)
        votes = with_shown(votes, regions)
        texts = embedder.embed_text(classes)
        hits += list((texts @ np.asarray(regions.embeddings).T).argmax(1) == np.arange(scene.count))

        units = jnp.asarray(regions.embeddings)
        coders = {f"d={d}": region_codes(units, latent=d, key=jax.random.key(seed))[:2] for d in options.latents}
        spread = spread_codes(units, options.spread_latent, separation=options.separation)
        coders[f"spread d={options.spread_latent}"] = spread, Spread(units, spread)
        for coded, (table, coder) in coders.items():
            codes = distill_votes(votes, table)
            asked, phrases = encode(coder, jnp.asarray(texts)), encode(coder, jnp.asarray(embedder.canonical))
            field = LanguageField(
                scene.gaussians, codes, votes, regions, table, coder, scene.cameras, embedder.canonical,
                np.eye(4), tuple(f"{t}" for t in range(len(scene.frames))),
            )  # fmt: skip
            once = {}
            for threshold in options.thresholds:
                for name, masks in ask(field, coded, texts, asked, phrases, threshold).items():
                    if name.endswith(("votes", "lead", "probability")) and "spread" not in coded:
                        continue  # they do not look at codes: once is enough
                    # Selections that did not change need not be rendered again.
                    if once.get(name, (None,))[0] != masks.tobytes():
                        once[name] = masks.tobytes(), score(scene.gaussians, cameras, masks, true, options)
                    found.setdefault(name, {}).setdefault(threshold, []).append(once[name][1])

    means = {name: {t: float(np.mean(v)) for t, v in curve.items()} for name, curve in found.items()}
    rows = [
        (name, *curve.values(), max(curve.values()) - min(curve.values()), float(np.mean(
            [np.ptp([found[name][t][s] for t in options.thresholds]) for s in range(len(options.seeds))]
        )))
        for name, curve in means.items()
    ]  # fmt: skip
    metrics = {
        "miou": {name: {str(t): v for t, v in curve.items()} for name, curve in means.items()},
        "deviation": {n: {str(t): float(np.std(v)) for t, v in curve.items()} for n, curve in found.items()},
        "spread": {row[0]: row[-2] for row in rows},
        "mean_spread_of_a_room": {row[0]: row[-1] for row in rows},
        "text_finds_its_region_by_cosine": float(np.mean(hits)),
    }
    table = results.table(("query", *(str(t) for t in options.thresholds), "spread", "spread in a room"), rows)
    results.save(Path(options.out), options, metrics, table, draw(means))
    print(table)
    print(f"text finds its region by the cosine: {metrics['text_finds_its_region_by_cosine']:.3f}")
    return metrics


def draw(means: dict[str, dict[float, float]]):
    """A curve per query."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.8))
    axes = figure.add_subplot()
    colours = {
        "one-step": "C3",
        "canonical": "C1",
        "anchored by code": "C0",
        "anchored by votes": "C2",
        "anchored by lead": "C4",
    }
    for name, curve in means.items():
        kind, _, size = name.partition(", ")
        line = {"d=3": "--", "d=16": "-"}.get(size, ":" if size else "-")
        axes.plot(list(curve), list(curve.values()), line, marker=".", color=colours[kind], label=name)
    axes.set_xlabel("threshold")
    axes.set_ylabel("mIoU, point level, rendered")
    axes.set_ylim(0, 1)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


if __name__ == "__main__":
    main(rooms_of(Options()))
