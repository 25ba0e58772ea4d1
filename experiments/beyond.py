"""Each idea beyond the paper on and off: point-level mIoU of text queries under vision with realistic faults.

    python -m experiments.beyond [FOLDER_OF_DEMOS]

Scenes: demo rooms of five seeds and replica_apartment_0 (where it lies beside the checkout), each seen by simulated
vision (experiments.simulated_vision) at three levels of noise. One query per object, by its class; a class's selection
is compared with the Gaussians whose true object it is. All ideas work on one pass of votes, kept view by view. The
letters name the ideas: A evidence hygiene, C neutral Gaussians, D object posterior over the views that
show it, E consensus of views, F masks that disagree, several descriptors, G neighbours, H threshold by the largest gap.
A text's region is the one with the largest cosine, "by contrast" the one that jsecon.query.match finds."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.spatial import KDTree
from sklearn.cluster import KMeans

from experiments import results
from experiments.ideas import scenes
from experiments.ideas.scenes import rooms_of
from experiments.ideas.state import State, agree, consensus, point_miou, tracked, unit
from jsecon.language.codes import CODE_THRESHOLD, encode, region_codes


@dataclasses.dataclass(frozen=True)
class Options(scenes.Places):
    """What the experiment can vary."""

    levels: tuple[str, ...] = ("low", "medium", "high")
    latents: tuple[int, ...] = (3, 8, 16, 32)
    share: float = 0.5
    """threshold on shares of votes and posteriors."""
    out: str = str(results.HOME / "results" / "beyond")


def consistent(sight: scenes.Sight, state: State, *, part: float = 0.7, rounds: int = 2) -> State:
    """F: masks whose IoU with their region's reprojection is below `part` of the region's median are left out."""
    here = sight.pixels.reshape(-1) > 0
    for _ in range(rounds):
        inside, everywhere = state.overlap()
        iou = inside / np.maximum(sight.pixels.reshape(-1) + everywhere - inside, 1e-9)
        median = np.array([np.median(iou[state.ok & (state.ids == r)]) if (state.ok & (state.ids == r)).any() else 0
                           for r in range(state.regions)])  # fmt: skip
        state = State(sight, state.proof, state.ids, here & (iou >= part * median[state.ids]), state.regions)
    return state


def by_code(state: State, codes: np.ndarray, wanted: np.ndarray, reduce: str, threshold: float) -> list[np.ndarray]:
    """The Gaussians whose reduced code has a cosine of at least `threshold` with each of the codes wanted."""
    if reduce == "mean":
        points = unit(state.votes @ codes)
    else:
        points = codes[state.votes.argmax(1)] * state.votes.any(1)[:, None]
    labelled = state.votes.sum(1) >= 0.5 * state.total
    return [labelled & (points @ code >= threshold) for code in wanted]


def neighbours_vote(state: State, means: np.ndarray, groups: list[np.ndarray], *, count: int = 8) -> list[np.ndarray]:
    """G: posteriors averaged over a Gaussian and its neighbours, by how much is seen of each and how near it is."""
    distance, near = KDTree(means).query(means, k=count + 1)
    effective = state.proof.seen.sum(1) ** 2 / np.maximum((state.proof.seen**2).sum(1), 1e-12)
    weight = np.exp(-0.5 * (distance / np.maximum(np.median(distance[:, 1:]), 1e-9)) ** 2)
    weight *= (effective / (effective + 1))[near]
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-12)
    return [(weight * posterior[near]).sum(1) for posterior in state.posteriors(groups)]


def several_descriptors(sight: scenes.Sight, state: State, *, most: int = 3) -> np.ndarray:
    """F: (K,) anchors by the best of a few centres of each region's masks (LaGa's), weighted by their compactness."""
    scores = np.full((state.regions, len(sight.texts)), -np.inf)
    flat = sight.embeddings.reshape(len(state.ids), -1)
    for r in range(state.regions):
        own = flat[state.ok & (state.ids == r)]
        if len(own):
            fit = KMeans(min(most, len(own)), n_init=1, random_state=0).fit(own)
            weight = fit.cluster_centers_ @ unit(own.mean(0))
            scores[r] = (weight[:, None] * (unit(fit.cluster_centers_) @ sight.texts.T)).max(0)
    return scores.argmax(0)


def by_gap(state: State, texts: np.ndarray) -> list[np.ndarray]:
    """H: all regions above the largest gap among the sorted scores of the upper half."""
    groups = []
    known = np.flatnonzero(np.any(state.embeddings != 0, 1))
    for score in (state.embeddings[known] @ texts.T).T:
        order = np.argsort(-score)
        upper = score[order[: max(len(order) // 2, 2)]]
        groups.append(known[order[: int(np.argmax(upper[:-1] - upper[1:])) + 1]])
    return groups


def ambiguous(state: State, groups: list[np.ndarray]) -> list[np.ndarray]:
    """C: (N,) per group: the entropy of "inside" over the views that show the group is above 0.9 bit."""
    found = []
    for g in groups:
        views = np.flatnonzero(state.shows[:, g].any(1))
        masks = np.flatnonzero(state.ok & np.isin(state.ids, g))
        to_view = sparse.csr_matrix(
            (np.ones(len(masks)), (masks, state.view[masks])), shape=(len(state.ids), len(state.shows))
        )
        votes, seen = (state.proof.votes @ to_view).toarray()[:, views], state.proof.seen[:, views]
        looks = seen > 1e-6
        part = ((votes > 0.5 * seen) & looks).sum(1) / np.maximum(looks.sum(1), 1)
        entropy = -sum(p * np.log2(np.maximum(p, 1e-9)) for p in (part, 1 - part))
        found.append(entropy > 0.9)
    return found


def selections(scene: scenes.Scene, sight: scenes.Sight, proof: scenes.Evidence, options: Options, told: Callable):
    """Calls told(name, masks of the K queries, CPU seconds) for each method."""
    began = time.process_time()

    def tell(name: str, masks: list[np.ndarray]) -> None:
        nonlocal began
        told(name, masks, time.process_time() - began)
        began = time.process_time()

    share, texts = options.share, sight.texts
    means = np.asarray(scene.gaussians.means)
    opacity = np.asarray(jax.nn.sigmoid(scene.gaussians.opacity_logits))
    plain = tracked(sight, proof)
    here = plain.ok
    anchors = plain.anchors(texts)
    groups = plain.joined(anchors)

    for latent in options.latents:
        key = jax.random.key(scene.seed)
        table, coder, _ = region_codes(jnp.asarray(plain.embeddings, jnp.float32), latent=latent, key=key)
        table, asked = np.asarray(table), np.asarray(encode(coder, jnp.asarray(texts)))
        for reduce in ("mean", "mode"):
            for threshold in (0.5, 0.7, 0.9) if reduce == "mean" else ():
                tell(f"one-step, {reduce}, d={latent}, {threshold}", by_code(plain, table, asked, reduce, threshold))
            tell(
                f"anchored by code, {reduce}, d={latent}",
                by_code(plain, table, table[anchors], reduce, CODE_THRESHOLD),
            )
    shares = plain.shares(groups)
    tell("anchored by votes", [s >= share for s in shares])
    tell("anchored by lead", plain.leads(groups))
    for alike in (0.9, 0.85):
        tell(f"by votes, alike {alike}", [s >= share for s in plain.shares(plain.joined(anchors, alike))])
    for peak in (0.02, 0.1):
        tell(f"A peak >= {peak}", [(s >= share) & (proof.peak >= peak) for s in shares])
    unclear = ambiguous(plain, groups)
    tell("C entropy", [(s >= share) & ~u for s, u in zip(shares, unclear)])
    tell("C entropy and opacity <= 0.1", [(s >= share) & ~(u & (opacity <= 0.1)) for s, u in zip(shares, unclear)])
    tell("D views that show it", [p >= share for p in plain.posteriors(groups)])
    found = plain.joined(plain.anchors(texts, sight.canonical))
    tell("D, by contrast", [p >= share for p in plain.posteriors(found)])
    tell("D + G neighbours", [p >= share for p in neighbours_vote(plain, means, groups)])
    kept = consistent(sight, plain)
    tell("F masks dropped", [s >= share for s in kept.shares(kept.joined(kept.anchors(texts)))])
    tell("F masks dropped + D", [p >= share for p in kept.posteriors(kept.joined(kept.anchors(texts)))])
    described = plain.joined(several_descriptors(sight, plain))
    tell("F several descriptors", [s >= share for s in plain.shares(described)])
    tell("H largest gap", [s >= share for s in plain.shares(by_gap(plain, texts))])
    grouped = consensus(sight, proof, means)
    found = grouped.joined(grouped.anchors(texts))
    tell("E consensus", [s >= share for s in grouped.shares(found)])
    tell("E consensus, by lead", grouped.leads(found))
    tell("E + D", [p >= share for p in grouped.posteriors(found)])
    found = grouped.joined(grouped.anchors(texts, sight.canonical))
    tell("E + D, by contrast", [p >= share for p in grouped.posteriors(found)])

    ids = plain.ids.copy()
    ids[here] = agree(proof.votes[:, np.flatnonzero(here)], ids[here])
    agreed = State(sight, proof, ids, here, plain.regions)
    anchors = agreed.anchors(texts)
    found = agreed.joined(anchors)
    tell("F masks reconciled", [s >= share for s in agreed.shares(found)])
    tell("F reconciled + D", [p >= share for p in agreed.posteriors(found)])
    by_contrast = agreed.joined(agreed.anchors(texts, sight.canonical))
    tell("F reconciled + D, by contrast", [p >= share for p in agreed.posteriors(by_contrast)])
    tell("F reconciled + D, alike 0.9", [p >= share for p in agreed.posteriors(agreed.joined(anchors, 0.9))])
    tell("F reconciled + D + G", [p >= share for p in neighbours_vote(agreed, means, found)])
    tell("F reconciled + D + H", [p >= share for p in agreed.posteriors(by_gap(agreed, texts))])
    described = agreed.joined(several_descriptors(sight, agreed))
    tell("F reconciled + several descriptors + D", [p >= share for p in agreed.posteriors(described)])
    tell("F reconciled, by lead", agreed.leads(found))
    tell("F reconciled + D, by lead", [m & (p >= share) for m, p in zip(agreed.leads(found), agreed.posteriors(found))])


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    space = options.space()
    found: dict[str, dict[tuple[str, str], float]] = {}
    seconds: dict[str, list[float]] = {}
    passes = {}

    def one_scene(scene: scenes.Scene) -> None:
        for level in options.levels:
            sight = scenes.look(scene, level, space)
            proof = scenes.evidence(scene, sight.masks.labels, len(sight.masks.origin))
            passes[f"{scene.name}, {level}"] = round(proof.seconds, 2)

            def told(name, masks, spent, level=level):
                found.setdefault(name, {})[scene.name, level] = point_miou(masks, scene.truth)
                seconds.setdefault(name, []).append(spent)

            selections(scene, sight, proof, options, told)

    for make in options.scenes().values():
        one_scene(make())

    rows = []
    for name, values in found.items():
        by_level = [np.mean([v for (_, at), v in values.items() if at == level]) for level in options.levels]
        demos = [v for (scene, _), v in values.items() if scene.startswith("demo")]
        others = [v for (scene, _), v in values.items() if not scene.startswith("demo")]
        rows.append(
            {
                "method": name,
                **{level: float(mean) for level, mean in zip(options.levels, by_level)},
                "demos": float(np.mean(demos)) if demos else float("nan"),
                "replica": float(np.mean(others)) if others else float("nan"),
                "mean": float(np.mean(list(values.values()))),
                "deviation": float(np.std(list(values.values()))),
                "seconds": float(np.mean(seconds[name])),
            }
        )
    metrics = {
        "rows": rows,
        "seconds_of_votes": passes,
        "by_scene": {
            name: {f"{scene}, {level}": v for (scene, level), v in values.items()} for name, values in found.items()
        },
    }
    table = results.table(tuple(rows[0]), [tuple(row.values()) for row in rows])
    results.save(Path(options.out), options, metrics, table, draw(rows))
    print(table)
    return metrics


def draw(rows: list[dict]):
    """A bar per method: mean and deviation."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 0.24 * len(rows) + 0.8))
    axes = figure.add_subplot()
    place = np.arange(len(rows))[::-1]
    axes.barh(place, [r["mean"] for r in rows], 0.8, xerr=[r["deviation"] for r in rows], ecolor="0.6")
    axes.set_yticks(place, [r["method"] for r in rows], fontsize=8)
    axes.set_xlim(0, 1)
    axes.set_xlabel("point-level mIoU, mean and deviation over scenes and levels")
    return figure


if __name__ == "__main__":
    main(rooms_of(Options()))
