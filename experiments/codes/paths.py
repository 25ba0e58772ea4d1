"""A scene's problem for distillation, and the paths to its Gaussians' codes, each timed (CPU seconds) and scored."""

import dataclasses
import functools
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.codes.solve_l1 import solve_l1
from experiments.ideas import scenes
from experiments.protocols.points import point_accuracy, point_class_means
from experiments.simulated_vision.embeddings import TextSpace
from jsecon.language.autoencoder import train_autoencoder
from jsecon.language.distill import continue_distillation, distill_votes, start_distillation
from jsecon.language.membership import with_shown
from jsecon.language.votes import region_votes
from jsecon.numerics import cosine_matrix, normalize
from jsecon.pipeline import cache
from jsecon.query.anchored import query_anchored
from jsecon.splat.plan import plan_views
from jsecon.splat.render import render
from jsecon.types import LanguageField, Regions, Votes

CHECKPOINT_SECONDS = 120.0
"""between two records of a descent"""
RESTS = 60
"""steps of Adam between two looks at the clock"""


@dataclasses.dataclass(frozen=True)
class Task:
    """One scene's problem."""

    name: str
    gaussians: Any
    cameras: Any
    labels: Any
    """(T, H, W) regions of the disturbed masks."""
    codes: Any
    """(R, d) unit."""
    regions: Regions
    """their embeddings and pixels."""
    texts: np.ndarray
    """(K, E) of the true objects."""
    origin: np.ndarray
    """(R,) the true object of each region."""
    truth: np.ndarray
    """(N,) the true object of each Gaussian, -1 = none."""


def task_of(
    scene: scenes.Scene,
    space: TextSpace,
    *,
    level: str,
    latent: int,
    views: int | None = None,
    shrink: int = 1,
) -> Task:
    """The scene under simulated vision of a named level, its regions coded as in the paper: embeddings averaged over
    the views by their pixels, LangSplat's autoencoder to `latent` numbers. At most so many views, evenly spaced, and
    frames so many times smaller."""
    count = len(scene.labels)
    few = np.arange(count) if views is None else np.linspace(0, count - 1, min(views, count)).astype(int)
    few_of = {"frames": scene.frames[few], "labels": scene.labels[few], "cameras": scene.cameras[few]}
    sight = scenes.look(dataclasses.replace(scene, **few_of), level, space)
    embeddings = normalize(jnp.asarray(np.einsum("tr,tre->re", sight.pixels, sight.embeddings), jnp.float32))
    coder = train_autoencoder(embeddings, latent=latent, key=jax.random.key(scene.seed))
    labels = sight.masks.labels[:, shrink // 2 :: shrink, shrink // 2 :: shrink]
    cameras = few_of["cameras"]
    cameras = dataclasses.replace(
        cameras,
        **{name: getattr(cameras, name) / shrink for name in ("fx", "fy", "cx", "cy")},
        width=labels.shape[2],
        height=labels.shape[1],
    )
    return Task(
        scene.name,
        scene.gaussians,
        cameras,
        jnp.asarray(labels),
        normalize(coder.encode(embeddings)),
        Regions(np.asarray(embeddings), sight.pixels.T.astype(np.int32)),
        sight.texts,
        sight.masks.origin,
        scene.truth,
    )


def geometric_median(votes: Votes, codes: Any, *, rounds: int = 30) -> Any:
    """(N, d) unit codes of least weighted distance to the voted regions' codes (Weiszfeld's iteration, from the mean);
    zero where there are no votes."""
    values, weight = codes[jnp.clip(votes.regions, 0)], jnp.where(votes.regions >= 0, votes.weights, 0.0)

    def step(_, middle):
        near = weight / jnp.maximum(jnp.linalg.norm(values - middle[:, None], axis=-1), 1e-6)
        return (near[..., None] * values).sum(1) / jnp.maximum(near.sum(1, keepdims=True), 1e-30)

    mean = (weight[..., None] * values).sum(1) / jnp.maximum(weight.sum(1, keepdims=True), 1e-30)
    return normalize(jax.lax.fori_loop(0, rounds, step, mean))


@jax.jit
def rendered_l1(gaussians, cameras, labels, table, codes):
    """Mean over all T H W d numbers of the masked |rendered - target|; NaN where a view overflowed."""

    def one(view):
        camera, image = view
        rendering = render(gaussians, camera, codes)
        error = jnp.where(rendering.overflow > 0, jnp.nan, rendering.features) - table[jnp.clip(image, 0)]
        return jnp.mean(jnp.where((image >= 0)[..., None], jnp.abs(error), 0.0))

    return jnp.mean(jax.lax.map(one, (cameras, labels)))


def score(task: Task, codes: Any, votes: Votes) -> dict[str, float]:
    """Of unit codes: rendered L1; the points' accuracy and mIoU through the nearest region's object; and the mIoU of
    the selections that the texts anchor, by code."""
    nearest = np.asarray(jnp.argmax(cosine_matrix(codes, task.codes), -1))
    found = np.where(np.asarray(codes).any(-1), task.origin[nearest], -2)
    loss = rendered_l1(task.gaussians, task.cameras, task.labels, task.codes, codes)
    return {
        "l1": float(loss),
        "accuracy": point_accuracy(found, task.truth),
        "miou": point_class_means(found, task.truth)[0],
        "anchored": anchored(task, codes, votes, by="code"),
    }


def anchored(task: Task, codes: Any, votes: Votes, *, by: str) -> float:
    """Mean over the texts of objects that some Gaussian belongs to: IoU of the anchored selection with those."""
    names, phrases = tuple(map(str, range(len(task.labels)))), np.zeros((0, task.texts.shape[1]), np.float32)
    field = LanguageField(
        task.gaussians, codes, votes, task.regions, task.codes, None, task.cameras, phrases, np.eye(4), names
    )
    ious = []
    for k, text in enumerate(task.texts):
        true = task.truth == k
        if true.any():
            mask = np.asarray(query_anchored(field, jnp.asarray(text), by=by, retrieval="cosine").mask)
            ious.append((mask & true).sum() / (mask | true).sum())
    return float(np.mean(ious))


def votes_of(task: Task) -> Votes:
    """The regions' votes, with the views that show each region."""
    given = task.gaussians, task.cameras, task.labels, len(task.origin)
    return with_shown(region_votes(*given, by_view=True), task.regions)


def timed(call, *, compile: Any = None) -> tuple[Any, float]:
    """The result of the second call, and its CPU seconds: the first, or the call of `compile`, compiles."""
    jax.block_until_ready((compile or call)())
    began = time.process_time()
    out = jax.block_until_ready(call())
    return out, time.process_time() - began


def votes_paths(task: Task, *, loyalties: tuple[float, ...], sweeps: tuple[int, ...]) -> list[dict]:
    """Reductions of the votes, and the solver from the mode, with each loyalty and each most number of sweeps."""
    votes, spent = timed(lambda: votes_of(task))
    rows = []
    ways = {r: functools.partial(distill_votes, votes, task.codes, r, min_labelled=0.0) for r in ("mean", "median")}
    ways["geometric median"] = functools.partial(jax.jit(geometric_median), votes, task.codes)
    ways["mode"] = functools.partial(distill_votes, votes, task.codes, "mode", min_labelled=0.0)
    for name, way in ways.items():
        codes, own = timed(way)
        rows.append({"path": f"votes, {name}", "seconds": spent + own, **score(task, codes, votes)})
    rows[-1]["anchored_by_votes"] = anchored(task, codes, votes, by="votes")
    start, before = codes, spent + own
    given = (task.gaussians, task.cameras, task.labels, task.codes, start)
    for loyalty in loyalties:
        for most in sweeps:
            solve = functools.partial(solve_l1, *given, loyalty=loyalty, sweeps=most, tolerance=1e-3)
            found, own = timed(solve, compile=functools.partial(solve, tolerance=np.inf))  # takes no sweep
            rows.append(
                {
                    "path": f"solver from mode, loyalty {loyalty:g}, {int(found.sweeps)} sweeps",
                    "seconds": before + own,
                    **score(task, found.codes, votes),
                    "gap": float(found.gap),
                    "converged": bool(found.converged),
                }
            )
    return rows


def adam_path(task: Task, start: str, record: Path, *, steps: int, looks: tuple[float, ...]) -> list[dict]:
    """The paper's path from one start, measured at each of the parts `looks` of its way; gone on with from `record`
    where there is one."""
    before, init, votes = 0.0, start, votes_of(task)
    if start == "votes":
        init, before = timed(lambda: distill_votes(votes_of(task), task.codes, "mode", min_labelled=0.0))
    given = (task.gaussians, task.cameras, task.labels, task.codes)
    state = start_distillation(*given, steps=steps, key=jax.random.key(0), init=init)
    seconds, rows = before, []
    plans, own = timed(lambda: plan_views(task.gaussians, task.cameras))
    seconds += own
    go = functools.partial(continue_distillation, plans=plans)
    jax.block_until_ready(go(state, *given, until=1))  # compiles
    if record.exists():
        leaves, seconds, rows = cache.load(record)
        state, rows = jax.tree.unflatten(jax.tree.structure(state), leaves), json.loads(rows)
    last = time.monotonic()
    for look in sorted({max(1, round(part * steps)) for part in looks}):
        while int(state.step) < look:
            began = time.process_time()
            state = jax.block_until_ready(go(state, *given, until=min(int(state.step) + RESTS, look)))
            seconds += time.process_time() - began
            if time.monotonic() - last > CHECKPOINT_SECONDS:
                cache.save(record, (jax.tree.leaves(state), seconds, json.dumps(rows)))
                last = time.monotonic()
        if not any(row["steps"] == look for row in rows):
            codes = normalize(state.features)
            rows.append({"path": f"Adam from {start}", "steps": look, "seconds": seconds, **score(task, codes, votes)})
    return rows
