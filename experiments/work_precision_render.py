"""Error against run time of a render: one curve for each knob, the definition in float64 as the reference.

    python -m experiments.work_precision_render

Knobs are constants of the engine, on purpose: the defaults are the recommended setting, and this is where they are held
against the alternatives. Each setting is compiled with the constants in place; all are then timed in turn,
one after the other, again and again, on one device. Error is that of features in [-1, 1]: the median, and what 99.9 %
of numbers stay below.

Scenes: "deep", in which Gaussians lie tens deep, and "sparse", in which there is nothing to win, of few small Gaussians
that hardly overlap; both against the brute force in float64. Where ../shared/splats/garden is at hand, its view 0,
against the image in reference.npz.
"""

import contextlib
import dataclasses
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.scenes import ball, garden
from experiments import results
from jsecon.splat import autodiff, composite, gradient, project, tiles, walk
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.reference import render_reference
from jsecon.splat.render import render
from jsecon.types import Camera, Gaussians

SCENES = {
    "deep": ball(2000, (0.05, 0.25), 160, 120, 150),
    "sparse: nothing to win": ball(150, (0.005, 0.02), 160, 120, 150),
}
MODULES = (autodiff, composite, gradient, project, tiles, walk)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is varied, and how often it is timed."""

    repeats: int = 9
    garden: Path = results.CAPTURES.parent / "splats" / "garden"
    out: Path = results.HOME / "results" / "work_precision_render"


@dataclasses.dataclass(frozen=True)
class Setting:
    """One point of a curve."""

    knob: str
    label: str
    constants: dict[str, Any]
    """name -> value, in every module that has the name."""
    features: str = "float32"
    extents: float = 1.0
    """factor on the splats' boxes."""


def settings() -> list[Setting]:
    """The recommended setting, and each knob's others."""
    found = [Setting("recommended", "8 px, chunk 16, batch 64", {})]
    found += [Setting("tile edge, px", str(edge), {"TILE": edge}) for edge in (4, 16)]
    found += [Setting("chunk", str(size), {"CHUNK": size}) for size in (8, 32)]
    found += [Setting("batch of tiles", str(size), {"BATCH": size}) for size in (16, 256)]
    found += [
        Setting("transmittance cut", f"{cut:g}", {"MIN_TRANSMITTANCE": cut}) for cut in (1e-1, 1e-2, 1e-3, 1e-5, 1e-6)
    ]
    found += [Setting("alpha cut", f"{cut:.2g}", {"MIN_ALPHA": cut}) for cut in (16 / 255, 4 / 255, 0.25 / 255)]
    found += [Setting("features", "bfloat16", {}, features="bfloat16")]
    found += [Setting("extents", f"{factor:g} x", {}, extents=factor) for factor in (0.7, 0.85, 1.3)]
    return found


@contextlib.contextmanager
def in_place(setting: Setting) -> Iterator[None]:
    """The engine with a setting's constants, and nothing of it remembered before or after."""
    before, own_project = [], autodiff.view_lists
    for module in MODULES:
        for name, value in setting.constants.items():
            if hasattr(module, name):
                before.append((module, name, getattr(module, name)))
                setattr(module, name, value)

    def widened(projection, *rest, **options):
        return own_project(
            dataclasses.replace(projection, extents=projection.extents * setting.extents), *rest, **options
        )

    import jsecon.splat.plan as plan

    if "TILE" in setting.constants or setting.extents != 1.0:
        listed = widened if setting.extents != 1.0 else own_project
        edge = setting.constants.get("TILE", tiles.TILE)
        before.append((plan, "view_lists", plan.view_lists))
        plan.view_lists = lambda *rest, **options: listed(*rest, tile=edge, **options)
    jax.clear_caches()
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)
        jax.clear_caches()


def compiled(setting: Setting, gaussians: Gaussians, camera: Camera, features: np.ndarray):
    """A call that renders (H, W, D) under a setting, compiled for good."""
    with in_place(setting):
        # Pairs are planned for the widest boxes and the lowest cut of all, so that nothing overflows.
        capacity = 3 * plan_capacity(gaussians, camera) + 4096
        given = jnp.asarray(features, jnp.dtype(setting.features))
        draw = lambda g, f: render(g, camera, f, capacity=capacity)
        ready = jax.jit(draw).lower(gaussians, given).compile()
        out = ready(gaussians, given)
        assert int(out.overflow) == 0, setting
    return lambda: ready(gaussians, given).features


def measure(name: str, gaussians, camera, features, expected, repeats: int) -> list[dict]:
    """A row per setting: ms (median, in turn), ratio to the recommended setting, errors."""
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, camera))
    calls = {(s.knob, s.label): compiled(s, gaussians, camera, features) for s in settings()}
    taken: dict[Any, list[float]] = {setting: [] for setting in calls}
    for _ in range(repeats):
        for setting, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            taken[setting].append(1e3 * (time.perf_counter() - start))
    recommended = statistics.median(next(iter(taken.values())))
    rows = []
    for (knob, label), call in calls.items():
        error = np.abs(np.asarray(call(), np.float64) - expected)
        ms = statistics.median(taken[knob, label])
        rows.append(
            {
                "scene": name,
                "knob": knob,
                "setting": label,
                "ms": ms,
                "ratio": ms / recommended,
                "median": float(np.median(error)),
                "p999": float(np.quantile(error, 0.999)),
                "largest": float(error.max()),
            }
        )
    return rows


def picture(rows: list[dict]):
    """Error below which 99.9 % of numbers stay, against ms, a panel per scene and a curve per knob."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(5.2 * len(scenes), 4.6))
    for n, scene in enumerate(scenes):
        axes = figure.add_subplot(1, len(scenes), n + 1)
        own = [row for row in rows if row["scene"] == scene]
        best = own[0]
        for knob in dict.fromkeys(row["knob"] for row in own[1:]):
            curve = sorted([best, *(row for row in own if row["knob"] == knob)], key=lambda row: row["ms"])
            points = axes.plot([r["ms"] for r in curve], [max(r["p999"], 1e-9) for r in curve], "o-", label=knob, ms=4)
            for r in curve:
                if r is not best:
                    where = (r["ms"], max(r["p999"], 1e-9))
                    axes.annotate(r["setting"], where, fontsize=6, color=points[0].get_color(), xytext=(3, 3),
                                  textcoords="offset points")  # fmt: skip
        axes.plot(best["ms"], best["p999"], "k*", ms=14, label="recommended")
        axes.set(yscale="log", xlabel="ms", title=scene)
        if n == 0:
            axes.set_ylabel("99.9 % of numbers are off by less")
            axes.legend(fontsize=7)
    return figure


def main(options: Options = Options()) -> dict:
    """Measures every setting in every scene and writes config.json, metrics.json, table.md and figure.png."""
    rng, rows = np.random.default_rng(1), []
    for name, (gaussians, camera) in SCENES.items():
        features = rng.uniform(-1, 1, (gaussians.count, 3)).astype(np.float32)
        expected = render_reference(gaussians, camera, features)[0]
        rows += measure(name, gaussians, camera, features, expected, options.repeats)
    scene, reference = garden(options.garden), options.garden / "reference.npz"
    if scene is not None and reference.exists():
        expected = np.load(reference)["image"].astype(np.float64)
        rows += measure("garden, view 0", *scene, expected, options.repeats)
    header = ("scene", "knob", "setting", "ms", "x recommended", "median error", "99.9 % below", "largest")
    told = [
        (
            row["scene"],
            row["knob"],
            row["setting"],
            f"{row['ms']:.1f}",
            f"{row['ratio']:.2f}",
            *(f"{row[key]:.1e}" for key in ("median", "p999", "largest")),
        )
        for row in rows
    ]
    results.save(options.out, options, {"rows": rows}, results.table(header, told), picture(rows))
    return {"rows": rows}


if __name__ == "__main__":
    main()
