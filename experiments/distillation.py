"""Codes of the Gaussians by every path and start: rendered L1, point accuracy and IoU against seconds.

    python -m experiments.distillation [--quick] [FOLDER_OF_DEMOS]

Scenes: replica_apartment_0 (where it lies beside the checkout) and demo rooms, their true masks disturbed by simulated
vision (jsecon.vision.simulated). Regions get random unit codes. Paths: votes reduced by mean, median, geometric median
and mode; the L1 solver from the mode; and the paper's Adam on the rendered L1 (REFERENCE B.6, B.7) from zero, random
codes and the mode, looked at several times on its way. Points are compared through the nearest region's true object.
Seconds are wall time without compilation, what a start costs included. Each path is kept as soon as it is done, Adam's
every few minutes: a run that was stopped goes on where it was.
"""

import argparse
import dataclasses
import functools
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results, scenes
from jsecon import cache
from jsecon.errors import InputError
from jsecon.evaluate.metrics import point_accuracy, point_class_means
from jsecon.files import write_text
from jsecon.language.distill import descend, descent, distill_votes
from jsecon.language.solve_l1 import solve_l1
from jsecon.language.votes import region_votes
from jsecon.numerics import cosine_matrix, normalize
from jsecon.splat.render import render
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Votes
from jsecon.vision.simulated import LEVELS, simulated_masks

CHECKPOINT_SECONDS = 120.0
"""between two records of a descent"""
RESTS = 60
"""steps of Adam between two looks at the clock"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    demos: str = str(results.HOME.parent / "demos")
    """holds demo0 .. demo4, as `jsecon demo --seed K --out demoK` leaves them; made where missing."""
    replica: str = str(results.CAPTURES / "replica_apartment_0")
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    level: str = "medium"
    """of the masks' faults."""
    latent: int = 3
    steps: int = 30_000
    """of Adam."""
    looks: tuple[float, ...] = (0.02, 0.1, 0.3, 1.0)
    """at which parts of Adam's way it is measured."""
    loyalties: tuple[float, ...] = (0.5, 0.1, 0.02)
    """of the solver."""
    sweeps: tuple[int, ...] = (4, 24)
    """most passes over the views that the solver takes."""
    views: int | None = None
    """at most so many views of a scene, evenly spaced; None: all."""
    shrink: int = 1
    """frames are made so many times smaller."""
    out: str = str(results.HOME / "results" / "distillation")


QUICK = Options(
    seeds=(), steps=60, looks=(0.5, 1.0), loyalties=(0.1,), sweeps=(4,), views=6, shrink=8,
    out=str(results.HOME / "results" / "distillation_quick"),
)  # fmt: skip


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
    origin: np.ndarray
    """(R,) the true object of each region."""
    truth: np.ndarray
    """(N,) the true object of each Gaussian, -1 = none."""
    capacity: int


def task_of(scene: scenes.Scene, options: Options) -> Task:
    """The scene under disturbed masks, at the size that the options ask for."""
    count = len(scene.labels)
    few = (
        np.arange(count) if options.views is None else np.linspace(0, count - 1, min(options.views, count)).astype(int)
    )
    masks = simulated_masks(scene.labels[few], LEVELS[options.level], seed=scene.seed)
    k = options.shrink
    labels = masks.labels[:, k // 2 :: k, k // 2 :: k]
    cameras = scene.cameras[few]
    cameras = dataclasses.replace(
        cameras,
        **{name: getattr(cameras, name) / k for name in ("fx", "fy", "cx", "cy")},
        width=labels.shape[2],
        height=labels.shape[1],
    )
    codes = np.random.default_rng(scene.seed).normal(size=(len(masks.origin), options.latent)).astype(np.float32)
    capacity = plan_capacity(scene.gaussians, cameras, margin=1.0)
    return Task(
        scene.name,
        scene.gaussians,
        cameras,
        jnp.asarray(labels),
        normalize(jnp.asarray(codes)),
        masks.origin,
        scene.truth,
        capacity,
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


@functools.partial(jax.jit, static_argnames="capacity")
def rendered_l1(gaussians, cameras, labels, table, codes, capacity):
    """Mean over all T H W d numbers of the masked |rendered - target|."""

    def one(view):
        camera, image = view
        error = render(gaussians, camera, codes, capacity=capacity).features - table[jnp.clip(image, 0)]
        return jnp.mean(jnp.where((image >= 0)[..., None], jnp.abs(error), 0.0))

    return jnp.mean(jax.lax.map(one, (cameras, labels)))


def score(task: Task, codes: Any) -> dict[str, float]:
    """Rendered L1 of unit codes, and the points' accuracy and mIoU through the nearest region's object."""
    nearest = np.asarray(jnp.argmax(cosine_matrix(codes, task.codes), -1))
    found = np.where(np.asarray(codes).any(-1), task.origin[nearest], -2)
    loss = rendered_l1(task.gaussians, task.cameras, task.labels, task.codes, codes, task.capacity)
    return {
        "l1": float(loss),
        "accuracy": point_accuracy(found, task.truth),
        "miou": point_class_means(found, task.truth)[0],
    }


def timed(call) -> tuple[Any, float]:
    """The result of the second call, and its seconds: the first compiles."""
    jax.block_until_ready(call())
    began = time.perf_counter()
    out = jax.block_until_ready(call())
    return out, time.perf_counter() - began


def votes_paths(task: Task, options: Options) -> list[dict]:
    """Reductions of the votes, and the solver from the mode."""
    votes, spent = timed(
        lambda: region_votes(task.gaussians, task.cameras, task.labels, len(task.origin), capacity=task.capacity)
    )
    rows = []
    ways = {r: functools.partial(distill_votes, votes, task.codes, r, least_labelled=0.0) for r in ("mean", "median")}
    ways["geometric median"] = functools.partial(jax.jit(geometric_median), votes, task.codes)
    ways["mode"] = functools.partial(distill_votes, votes, task.codes, "mode", least_labelled=0.0)
    for name, way in ways.items():
        codes, own = timed(way)
        rows.append({"path": f"votes, {name}", "seconds": spent + own, **score(task, codes)})
    start, before = codes, spent + own
    given = (task.gaussians, task.cameras, task.labels, task.codes, start)
    for loyalty in options.loyalties:
        for sweeps in options.sweeps:
            solve = functools.partial(
                solve_l1, *given, loyalty=loyalty, sweeps=sweeps, tolerance=1e-3, capacity=task.capacity
            )
            found, own = timed(solve)
            rows.append(
                {
                    "path": f"solver from mode, loyalty {loyalty:g}, {int(found.sweeps)} sweeps",
                    "seconds": before + own,
                    **score(task, found.codes),
                    "gap": float(found.gap),
                    "converged": bool(found.converged),
                }
            )
    return rows


def adam_path(task: Task, options: Options, start: str, record: Path) -> list[dict]:
    """The paper's path from one start, gone on with from `record` where there is one."""
    before, init = 0.0, start
    if start == "votes":
        make = lambda: distill_votes(
            region_votes(task.gaussians, task.cameras, task.labels, len(task.origin), capacity=task.capacity),
            task.codes,
            "mode",
            least_labelled=0.0,
        )
        init, before = timed(make)
    given = (task.gaussians, task.cameras, task.labels, task.codes)
    state = descent(*given, steps=options.steps, key=jax.random.key(0), init=init)
    seconds, rows = before, []
    go = functools.partial(descend, capacity=task.capacity)
    jax.block_until_ready(go(state, *given, until=1))  # compiles
    if record.exists():
        leaves, seconds, rows = cache.load(record)
        state, rows = jax.tree.unflatten(jax.tree.structure(state), leaves), json.loads(rows)
    looks = sorted({max(1, round(part * options.steps)) for part in options.looks})
    last = time.monotonic()
    for look in looks:
        while int(state.step) < look:
            began = time.perf_counter()
            state = jax.block_until_ready(go(state, *given, until=min(int(state.step) + RESTS, look)))
            seconds += time.perf_counter() - began
            if time.monotonic() - last > CHECKPOINT_SECONDS:
                cache.save(record, (jax.tree.leaves(state), seconds, json.dumps(rows)))
                last = time.monotonic()
        if not any(row["steps"] == look for row in rows):
            codes = normalize(state.features)
            rows.append({"path": f"Adam from {start}", "steps": look, "seconds": seconds, **score(task, codes)})
    return rows


def main(options: Options = Options()) -> dict:
    """Runs the experiment, or what is left of it, writes its results and returns the metrics."""
    out = Path(options.out)
    rows = []
    made = {f"demo {seed}": functools.partial(_demo, options, seed) for seed in options.seeds}
    if Path(options.replica).is_dir():
        made["replica_apartment_0"] = lambda: scenes.replica_scene(options.replica)
    if not made:
        raise InputError(
            options.replica,
            found="no capture there, and no demo seeds",
            expected="a scene to measure on",
            remedy="Give a folder of demos, or put replica_apartment_0 beside the checkout.",
        )
    # Only what an option changes makes a path be taken again.
    given = {k: v for k, v in dataclasses.asdict(options).items() if k not in ("out", "seeds", "demos", "replica")}
    digest = hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:10]
    for name, make in made.items():
        task = None
        for path in ("votes", "Adam from zero", "Adam from random", "Adam from votes"):
            kept = out / "paths" / f"{name}-{path}-{digest}.json".replace(" ", "_")
            if not kept.exists():
                task = task_of(make(), options) if task is None else task
                record = kept.with_suffix(".npz")
                record.parent.mkdir(parents=True, exist_ok=True)
                if path == "votes":
                    found = votes_paths(task, options)
                else:
                    found = adam_path(task, options, path.rpartition(" ")[2], record)
                write_text(kept, json.dumps(found, indent=1) + "\n")
                record.unlink(missing_ok=True)
            rows += [{"scene": name, **row} for row in json.loads(kept.read_text())]
    metrics = {"rows": rows, "speed": speed(rows)}
    header = ("scene", "path", "steps", "seconds", "rendered L1", "point accuracy", "point mIoU", "gap")
    lines = [
        (
            r["scene"],
            r["path"],
            r.get("steps", ""),
            f"{r['seconds']:.2f}",
            f"{r['l1']:.4f}",
            r["accuracy"],
            r["miou"],
            f"{r['gap']:.1e}" if "gap" in r else "",
        )
        for r in rows
    ]
    table = results.table(header, lines) + "\n\n" + results.table(
        ("scene", "Adam, last L1", "Adam, s", "first other path at that L1", "its s", "times fewer"),
        [tuple(row.values()) for row in metrics["speed"]],
    )  # fmt: skip
    results.save(out, options, metrics, table, draw(rows))
    print(table)
    return metrics


def _demo(options: Options, seed: int) -> scenes.Scene:
    return scenes.demo_scene(Path(options.demos) / f"demo{seed}", seed)


def speed(rows: list[dict]) -> list[dict]:
    """For each scene the rendered L1 that the paper's path (from zero) ends at, and the fewest seconds of a path from
    votes to it; None where none reaches it."""
    told = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        adam = max((r for r in own if r["path"] == "Adam from zero"), key=lambda r: r["steps"])
        others = [r for r in own if r["l1"] <= adam["l1"] and r["path"] not in ("Adam from zero", "Adam from random")]
        first = min(others, key=lambda r: r["seconds"], default=None)
        told.append(
            {
                "scene": scene,
                "l1": round(adam["l1"], 4),
                "seconds": round(adam["seconds"], 1),
                "path": first and first["path"],
                "its_seconds": first and round(first["seconds"], 2),
                "times": first and round(adam["seconds"] / first["seconds"], 1),
            }
        )
    return told


def draw(rows: list[dict]):
    """Rendered L1 and point accuracy against seconds, a curve a path; all scenes' means at equal places."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4))
    kinds: dict[str, dict[int, list[dict]]] = {}
    for row in rows:
        kind, place = (row["path"], row["steps"]) if "steps" in row else (row["path"], 0)
        kinds.setdefault(kind, {}).setdefault(place, []).append(row)
    for column, (key, title) in enumerate((("l1", "rendered L1"), ("accuracy", "point accuracy"))):
        axes = figure.add_subplot(1, 2, column + 1)
        for kind, places in kinds.items():
            x, y = (
                [float(np.mean([r[name] for r in found])) for _, found in sorted(places.items())]
                for name in ("seconds", key)
            )
            axes.plot(x, y, marker="o" if len(x) == 1 else ".", linestyle="-" if len(x) > 1 else "none", label=kind)
        axes.set_xscale("log")
        axes.set_xlabel("seconds")
        axes.set_ylabel(title)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("demos", nargs="?")
    parser.add_argument("--quick", action="store_true", help="six small views of one scene: two minutes at most")
    arguments = parser.parse_args()
    chosen = QUICK if arguments.quick else Options()
    if arguments.quick and not Path(chosen.replica).is_dir():
        chosen = dataclasses.replace(chosen, seeds=(0,))
    main(dataclasses.replace(chosen, **({"demos": arguments.demos} if arguments.demos else {})))
