"""Pure public functions at the ends of their input (no Gaussian or one, no region, no frame or one, one dimension,
unsigned labels), and inside of a trace. A row of CALLS is a function, the ends that apply to it, and the shapes of what
it must return.

To add a function, add a row: `name: (ends, call)`, where `call(world)` returns pairs (array, expected shape)."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import gaussians_at, look_at
from small_field import unit_rows

import jsecon
from jsecon import Camera, Gaussians, LanguageField, Regions, Votes

HEIGHT, WIDTH = 12, 16


@dataclasses.dataclass(frozen=True)
class World:
    """A scene of `n` Gaussians with `t` views, `r` regions and vectors of `d` numbers."""

    n: int = 3
    t: int = 2
    r: int = 2
    d: int = 4
    dtype: Any = np.int16

    def rows(self, count: int) -> np.ndarray:
        """(count, d) unit vectors."""
        return unit_rows(np.random.default_rng(count), count, self.d)

    @property
    def ones(self) -> np.ndarray:
        """A selection of all Gaussians."""
        return np.ones(self.n, bool)

    @property
    def gaussians(self) -> Gaussians:
        means = np.random.default_rng(1).uniform(-0.5, 0.5, (self.n, 3))
        return gaussians_at(means, 0.2, sh=np.zeros((4, 3)))

    @property
    def cameras(self) -> Camera:
        poses = np.array([look_at((0.2 * k, -0.3, -2.5)) for k in range(self.t)], np.float32).reshape(-1, 4, 4)
        return Camera(poses, *(np.full(self.t, v, np.float32) for v in (16, 16, 8, 6)), width=WIDTH, height=HEIGHT)

    @property
    def camera(self) -> Camera:
        return dataclasses.replace(self, t=1).cameras[0]

    @property
    def labels(self) -> np.ndarray:
        """Each row of pixels one region in turn; unsigned labels have no -1."""
        least = -1 if np.dtype(self.dtype).kind == "i" else 0
        rows = np.arange(HEIGHT) % max(self.r - least, 1) + least if self.r else np.full(HEIGHT, -1)
        return np.broadcast_to(rows[:, None], (self.t, HEIGHT, WIDTH)).astype(self.dtype)

    @property
    def votes(self) -> Votes:
        """All Gaussians of region 0, seen in every view."""
        ones = np.ones(self.n, np.float32) * (self.r > 0)
        regions = np.full((self.n, 2), -1, np.int32)
        regions[:, 0] = min(self.r, 1) - 1
        weights = np.stack([ones, 0 * ones], axis=1)
        views = np.full(self.n, self.t, np.int32)
        by_view = np.broadcast_to(ones / max(self.t, 1), (self.t, self.n))
        return Votes(regions, weights, ones, ones, 0.5 * ones, views, np.int32(0), self.r, by_view)

    @property
    def regions(self) -> Regions:
        return Regions(self.rows(self.r), np.full((self.r, self.t), 50, np.int32))

    @functools.cached_property
    def field(self) -> LanguageField:
        votes = jsecon.normalise_votes(self.votes, self.regions)
        names = tuple(f"f{t}" for t in range(self.t))
        canonical, words = self.rows(4), self.rows(8)
        given = (self.gaussians, votes, self.regions, self.cameras, canonical, np.eye(4), names)
        return jax.tree.map(np.asarray, LanguageField(*given, unrelated_words=words))


def image(rendering, channels: int) -> list:
    return [(rendering.features, (HEIGHT, WIDTH, channels)), (rendering.alpha, (HEIGHT, WIDTH))]


def selected(selection, world: World) -> list:
    return [(selection.mask, (world.n,)), (selection.similarity, (world.n,))]


def planned(w: World) -> list:
    rendered = jsecon.render_plan(
        jsecon.plan_view(w.gaussians, w.camera), w.rows(w.n), background=np.ones(w.d, np.float32)
    )
    return image(rendered, w.d)


def accumulated(votes: Votes, w: World) -> list:
    kept, total = min(8, max(w.r, 1)), jnp.where(votes.overflow == 0, votes.total, jnp.nan)
    return [(votes.weights[:, :kept], (w.n, min(kept, votes.weights.shape[1]))), (total, (w.n,))]


def embedded(w: World) -> list:
    frames = np.zeros((w.t, HEIGHT, WIDTH, 3), np.uint8)
    regions = jsecon.region_embeddings(frames, w.labels, lambda _, masks: w.rows(len(masks)), num_regions=w.r)
    return [(regions.pixel_counts, (w.r, w.t))]


def tracked(w: World) -> list:
    halves = np.broadcast_to(np.arange(HEIGHT)[None, :, None] // 6 == np.arange(2)[:, None, None], (2, HEIGHT, WIDTH))
    frames = np.zeros((w.t, HEIGHT, WIDTH, 3), np.uint8)
    labels = jsecon.masklets(frames, lambda frame, index: halves, lambda frames, *_: np.zeros(frames.shape[:3], int))
    return [(labels, (w.t, HEIGHT, WIDTH))]


def distilled(w: World) -> list:
    codes = w.rows(w.r)
    result = jsecon.distill_l1(w.gaussians, w.cameras, w.labels, codes, steps=2, key=jax.random.key(0))
    return [(result.codes, (w.n, w.d))]


def encoded(w: World) -> list:
    coder = jsecon.train_autoencoder(w.rows(5), latent=1, key=jax.random.key(0), epochs=1)
    return [(jsecon.encode(coder, w.rows(5)), (5, 1))]


def shapes(w: World) -> list:
    labels = np.zeros(w.n, np.int32) if w.r else np.full(w.n, -1, np.int32)
    found = jsecon.object_shapes(np.asarray(w.gaussians.means), labels)
    return [(found.center, (int(w.n * w.r > 0), 3))]


def lifted(w: World) -> list:
    return selected(jsecon.lift(w.field, np.ones((w.t, HEIGHT, WIDTH), bool), list(range(w.t))), w)


def located(_: World) -> list:
    return [(jnp.asarray(jsecon.localization_accuracy([(1.0, 1.0)], [np.array([[0.0, 0.0, 2.0, 2.0]])])), ())]


def voted(w: World) -> list:
    votes = jsecon.region_votes(w.gaussians, w.cameras, w.labels, w.r, by_view=True)
    return [*accumulated(votes, w), (votes.by_view, (w.t, w.n))]


def matched(w: World) -> list:
    match = jsecon.match_regions(w.field, w.rows(2))
    return [(match.chosen, (w.r,)), *selected(jsecon.select_gaussians(w.field, match), w)]


SCENE, FIELD = "n1 n0 d1", "n1 n0 t1 t0 r0 d1"
CALLS: dict[str, tuple[str, Callable[[World], list]]] = {
    "project": ("n1 n0", lambda w: [(jsecon.project(w.gaussians, w.camera).means_px, (w.n, 2))]),
    "render": (SCENE, lambda w: image(jsecon.render(w.gaussians, w.camera, w.rows(w.n), depth=True), w.d)),
    "render_rgb": ("n1 n0", lambda w: image(jsecon.render_rgb(w.gaussians, w.camera, background=w.rows(3)[0, :3]), 3)),
    "render_depth": ("n1 n0", lambda w: [(jsecon.render_depth(w.gaussians, w.camera)[0], (HEIGHT, WIDTH))]),
    "plan_view": (SCENE, planned),
    "plan_capacity": ("n1 n0 t1 t0", lambda w: [(np.asarray(jsecon.plan_capacity(w.gaussians, w.cameras)), ())]),
    "region_votes": ("n1 n0 t1 t0 r0 uint8 uint16", voted),
    "region_embeddings": ("t1 t0 r0 d1 uint8 uint16", embedded),
    "normalise_votes": ("n1 n0 t1 t0 r0", lambda w: accumulated(jsecon.normalise_votes(w.votes, w.regions), w)),
    "distill_votes": ("n1 n0 r0 d1", lambda w: [(jsecon.distill_votes(w.votes, w.rows(w.r)), (w.n, w.d))]),
    "distill_l1": ("n1 n0 t1 d1 uint8", distilled),
    "query_anchored": (FIELD, lambda w: selected(jsecon.query_anchored(w.field, w.rows(1)[0]), w)),
    "query_several": (FIELD, lambda w: selected(jsecon.query_several(w.field, w.rows(2)), w)),
    "query_region": (FIELD, lambda w: selected(jsecon.query_region(w.field, 0), w)),
    "query_classes": ("n1 n0 t1 r0 d1", lambda w: [(jsecon.query_classes(w.field, w.rows(3)).labels, (w.n,))]),
    "match_regions": (FIELD, matched),
    "membership_probability": ("n1 n0", lambda w: [(jsecon.membership_probability(w.votes.total, w.votes), (w.n,))]),
    "mean_iou": ("", lambda _: [(jnp.asarray(jsecon.mean_iou([0.5, None])), ())]),
    "accuracy_at": ("", lambda _: [(jnp.asarray(jsecon.accuracy_at([0.5, None])), ())]),
    "localization_accuracy": ("", located),
    "query_one_step": ("n1 n0 d1", lambda w: selected(jsecon.query_one_step(w.rows(w.n), w.rows(1)[0], 0.5), w)),
    "query_canonical": (
        "n1 n0 d1",
        lambda w: selected(jsecon.query_canonical(w.rows(w.n), w.rows(1)[0], w.rows(4), 0.5), w),
    ),
    "lift": ("n1 n0 t1 r0 d1", lifted),
    "region_at": ("n1 n0 t1 r0 d1", lambda w: [(np.asarray(jsecon.region_at(w.field, 0, 8, 6)), ())]),
    "selection_mask": ("n1 n0", lambda w: [(jsecon.selection_mask(w.gaussians, w.camera, w.ones), (HEIGHT, WIDTH))]),
    "remove_outliers": ("n1 n0", lambda w: [(jsecon.remove_outliers(w.gaussians.means, w.ones), (w.n,))]),
    "object_shapes": ("n1 n0 r0", shapes),
    "iou": ("n1 n0", lambda w: [(jsecon.iou(w.ones, w.ones), ())]),
    "train_autoencoder": ("d1", encoded),
    "masklets": ("t1 t0", tracked),
}
ENDS = {f"{axis}{size}": {axis: size} for axis in "ntrd" for size in (0, 1)}
ENDS |= {name: {"dtype": np.dtype(name)} for name in ("uint8", "uint16")}


@pytest.mark.parametrize(("name", "end"), [(name, end) for name, (ends, _) in CALLS.items() for end in ends.split()])
def test_a_function_takes_the_ends_of_its_input(name, end):
    for array, shape in CALLS[name][1](World(**ENDS[end])):
        assert np.shape(array) == shape
        assert np.isfinite(np.asarray(array, np.float64)).all()


def test_the_table_has_every_pure_function():
    """Those that are left out read or write files, print, or are called in the row of another."""
    others = {
        *("objects", "locate", "open_scene", "check_backend", "host_mesh", "render_plan", "encode"),
        *("check_field", "load_field", "save_field", "load_capture", "load_gaussians", "save_gaussians"),
        "select_gaussians",
    }
    functions = {name for name in jsecon.__all__ if not isinstance(getattr(jsecon, name), type)}
    assert functions == CALLS.keys() | others


HOST = {"region_embeddings", "lift", "region_at", "plan_capacity", "remove_outliers", "object_shapes", "masklets"}
"""functions that need numbers, as they say"""


@pytest.mark.parametrize("name", sorted(CALLS.keys() - HOST))
def test_a_function_is_traced_on_arrays_that_are_closed_over(name):
    """As inside of a jit, without the compilation: all that it computes there is traced, its arguments are not."""
    world = World()
    assert world.field.gaussians.count == world.n  # made outside of the trace
    jax.eval_shape(lambda: [array for array, _ in CALLS[name][1](world)])


def test_labels_that_are_no_regions_are_refused():
    w, frames, key = World(), np.zeros((2, HEIGHT, WIDTH, 3), np.uint8), jax.random.key(0)
    for call in (
        lambda labels, count: jsecon.region_votes(w.gaussians, w.cameras, labels, count),
        lambda labels, count: jsecon.distill_l1(w.gaussians, w.cameras, labels, w.rows(count), steps=1, key=key),
        lambda labels, count: jsecon.region_embeddings(frames, labels, lambda _, masks: masks, num_regions=count),
    ):
        with pytest.raises(ValueError, match="labels: got a label of 1, expected labels below 1"):
            call(w.labels, 1)
        with pytest.raises(ValueError, match="labels: got float32, expected integers"):
            call(w.labels.astype(np.float32), 2)


def test_a_background_of_another_size_is_refused():
    w = World(d=2)
    plan, features = jsecon.plan_view(w.gaussians, w.camera), w.rows(w.n)
    for call, expected in (
        (lambda: jsecon.render(w.gaussians, w.camera, features, background=jnp.ones(3)), r"\(3,\), expected \(2,\)"),
        (lambda: jsecon.render_plan(plan, features, background=jnp.ones((2, 1))), r"\(2, 1\), expected \(2,\)"),
        (lambda: jsecon.render_rgb(w.gaussians, w.camera, background=jnp.ones(4)), r"\(4,\), expected \(3,\)"),
    ):
        with pytest.raises(ValueError, match=f"background: got {expected}"):
            call()
