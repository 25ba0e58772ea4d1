"""Stiff and extreme scenes: is every number finite, and how far from float64?

    python -m experiments.stability

Each row of stability_cases is rendered in float32 and held against brute force in float64 (jsecon/splat/reference.py);
its gradients, with respect to every array and the camera, against automatic differentiation of a dense float64
compositor that shares no code with the engine. A pixel where a cut (alpha at 1/255, transmittance at 1e-4, the cap at
0.99) is decided by less than float32 can tell is left out of both, counted, and bounded by what the cut can cause.

"one ulp" is the yardstick: how far the float64 image and gradient move when every input moves by one float32 rounding.
No float32 engine can promise to be closer than that.
"""

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.stability_cases import ARGUMENTS, GRADIENT, VALUE, Case, cases
from jsecon.numerics import BLUR_PX2, FRUSTUM_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR
from jsecon.splat.reference import project_reference, render_reference
from jsecon.splat.render import render
from jsecon.types import Camera, Gaussians

TILE_PAIRS_PX = 8
"""capacity: every Gaussian in every tile of this edge; `overflow` is checked"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    only: str = ""
    """rows whose name contains this"""
    out: str = str(results.HOME / "results" / "stability")


@dataclasses.dataclass(frozen=True)
class Row:
    """What was measured of a case."""

    value_finite: bool
    """every pixel, those that a bad feature touches left out"""
    contained: bool
    """the pixels that are not finite are those that a Gaussian with a bad feature touches, and no other"""
    value_error: float
    """largest error of image (in units of the largest feature) and alpha, over pixels where no cut is in doubt"""
    in_doubt: float
    """share of pixels where a cut is in doubt"""
    doubtful_error: float
    """largest error there beyond what the cut in doubt can cause"""
    gradient_finite: bool
    gradient_errors: dict[str, float]
    """relative L2 error of each argument's gradient"""
    value_ulp: float
    """change of the float64 image by one rounding of the inputs"""
    gradient_ulps: dict[str, float]
    """relative change of each argument's float64 gradient by the same"""
    overflow: int


def to64(tree: Any) -> Any:
    """Float64 of what float32 arithmetic sees: XLA counts denormal numbers as zero."""

    def widen(a):
        a = np.asarray(a)
        tiny = np.finfo(np.float32).tiny
        return np.where(np.abs(a) < tiny, 0.0, a.astype(np.float64)) if a.dtype == np.float32 else a

    return jax.tree.map(widen, tree)


def meant(case: Case) -> tuple[Gaussians, Camera, np.ndarray, np.ndarray]:
    """The float64 scene that a case stands for: unusable Gaussians moved out of sight, infinite sizes made finite.
    With it the Gaussians (N,) whose features are not finite."""
    gaussians, camera = to64(case.exact if case.exact is not None else (case.gaussians, case.camera))
    features = to64(case.features)
    usable = np.isfinite(gaussians.means).all(1) & np.isfinite(gaussians.quaternions).all(1)
    usable &= ~(np.isnan(gaussians.log_scales) | np.isposinf(gaussians.log_scales)).any(1)
    usable &= ~np.isnan(gaussians.opacity_logits)
    behind = np.linalg.inv(camera.world_to_camera) @ (0, 0, -5, 1)
    cleaned = Gaussians(
        np.where(usable[:, None], gaussians.means, behind[None, :3]),
        np.where(usable[:, None], np.maximum(gaussians.log_scales, -200), 0.0),
        np.where(usable[:, None], gaussians.quaternions, (1.0, 0, 0, 0)),
        np.where(usable, np.clip(gaussians.opacity_logits, -1e5, 1e5), 0.0),
        gaussians.sh,
    )
    bad = usable & ~np.isfinite(features).all(1)
    return cleaned, camera, np.where(np.isfinite(features), features, 0.0), bad


def dense_image(gaussians, camera, features):
    """(H, W, D + 1) image and alpha by automatic differentiation's leave: every Gaussian at every pixel, in a scan."""
    w2c, means = camera.world_to_camera, gaussians.means
    x, y, z = jnp.moveaxis(means @ w2c[:3, :3].T + w2c[:3, 3], 1, 0)
    in_front = z > NEAR
    x, y, z = (jnp.where(in_front, a, 1.0) for a in (x, y, z))
    margin_x, margin_y = (FRUSTUM_MARGIN - 1) / 2 * camera.width, (FRUSTUM_MARGIN - 1) / 2 * camera.height
    u, v = camera.fx * x / z, camera.fy * y / z
    u_kept = jnp.clip(u, -camera.cx - margin_x, camera.width - camera.cx + margin_x)
    v_kept = jnp.clip(v, -camera.cy - margin_y, camera.height - camera.cy + margin_y)
    squared = (gaussians.quaternions**2).sum(1)
    unit = jnp.where(squared > 0, 1.0, 0.0)[:, None] * gaussians.quaternions
    a, b, c, d = jnp.moveaxis(unit / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[:, None], 1, 0)
    rotation = jnp.array(
        [
            [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
        ]
    )
    axes = jnp.einsum("ij,jkn,nk->nik", w2c[:3, :3], rotation, jnp.exp(gaussians.log_scales))
    row_x = (camera.fx * axes[:, 0] - u_kept[:, None] * axes[:, 2]) / z[:, None]
    row_y = (camera.fy * axes[:, 1] - v_kept[:, None] * axes[:, 2]) / z[:, None]
    xx, xy, yy = (row_x**2).sum(1), (row_x * row_y).sum(1), (row_y**2).sum(1)
    determinant = (jnp.cross(row_x, row_y) ** 2).sum(1) + BLUR_PX2 * (xx + yy) + BLUR_PX2**2
    inverse = jnp.stack([yy + BLUR_PX2, -xy, xx + BLUR_PX2], 1) / determinant[:, None]
    rows, columns = jnp.mgrid[: camera.height, : camera.width] + 0.5
    opacities = jnp.exp(-jnp.logaddexp(0.0, -gaussians.opacity_logits))

    def one(carry, item):
        transmittance, running, total = carry
        centre_x, centre_y, (p, q, r), opacity, seen, feature = item
        dx, dy = columns - centre_x, rows - centre_y
        alpha = opacity * jnp.exp(-0.5 * (p * dx * dx + 2 * q * dx * dy + r * dy * dy))
        alpha = jnp.where(seen & (alpha >= MIN_ALPHA), jnp.minimum(alpha, MAX_ALPHA), 0.0)
        running &= transmittance * (1 - alpha) > MIN_TRANSMITTANCE
        weight = jnp.where(running, alpha * transmittance, 0.0)
        return (transmittance - weight, running, total + weight[..., None] * feature), None

    order = jnp.argsort(jax.lax.stop_gradient(z), stable=True)
    items = (u + camera.cx, v + camera.cy, inverse, opacities, in_front, features)
    clear = jnp.ones((camera.height, camera.width))
    initial = (clear, clear > 0, jnp.zeros((*clear.shape, features.shape[1])))
    left, _, total = jax.lax.scan(one, initial, jax.tree.map(lambda a: a[order], items))[0]
    return jnp.concatenate([total, 1 - left[..., None]], axis=-1)


def engine_image(gaussians, camera, features, *, capacity: int):
    rendering = render(gaussians, camera, features, capacity=capacity)
    return jnp.concatenate([rendering.features, rendering.alpha[..., None]], axis=-1), rendering.overflow


def image_and_gradients(image_of, gaussians, camera, features, cotangent):
    """The image, what came with it, and a gradient for each of ARGUMENTS of <image, cotangent>."""

    def loss(gaussians, camera, features):
        image = image_of(gaussians, camera, features)
        image, extra = image if isinstance(image, tuple) else (image, 0)
        # A pixel that is not finite has no gradient to give; the others must not suffer from it.
        return jnp.where(jnp.isfinite(image), image * cotangent, 0.0).sum(), (image, extra)

    (_, (image, extra)), (g, c, f) = jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(
        gaussians, camera, features
    )
    intrinsics = jnp.stack([c.fx, c.fy, c.cx, c.cy])
    parts = (g.means, g.log_scales, g.quaternions, g.opacity_logits, c.world_to_camera[:3], intrinsics, f)
    return image, extra, dict(zip(ARGUMENTS, parts))


@functools.cache
def _compiled(image_of, **options):
    return jax.jit(functools.partial(image_and_gradients, image_of), compiler_options=options)


@functools.cache
def _engine(capacity: int):
    return functools.partial(engine_image, capacity=capacity)


def engine(case: Case, cotangent: np.ndarray):
    down, across = -(-case.camera.height // TILE_PAIRS_PX), -(-case.camera.width // TILE_PAIRS_PX)
    capacity = max(case.gaussians.count * down * across, 64)
    arguments = jax.tree.map(jnp.asarray, (case.gaussians, case.camera, case.features, cotangent.astype(np.float32)))
    return jax.tree.map(np.asarray, _compiled(_engine(capacity))(*arguments))


def dense(gaussians, camera, features, cotangent):
    with jax.enable_x64(True):
        arguments = jax.tree.map(jnp.asarray, (gaussians, camera, features, cotangent))
        # Compiled without optimisation: several times as soon ready, and it runs but a few times.
        run = _compiled(dense_image, xla_backend_optimization_level=0, xla_cpu_use_fusion_emitters=False)
        return jax.tree.map(np.asarray, run(*arguments))


def cuts_in_doubt(gaussians: Gaussians, camera: Camera, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) what a cut in doubt can change there, in units of a feature, 0 where none is in doubt; and bool (H, W, N)
    the pixels that each Gaussian touches."""
    splats = project_reference(gaussians, camera)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    left = np.ones_like(x)
    running = np.ones_like(x, bool)
    jump, touched = np.zeros_like(x), np.zeros((*x.shape, gaussians.count), bool)
    for i in np.argsort(splats["depths"], kind="stable"):
        if not splats["in_front"][i]:
            continue
        (a, b, c), dx, dy = splats["conics"][i], x - splats["means_px"][i, 0], y - splats["means_px"][i, 1]
        alpha = splats["opacities"][i] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        faint = running & (np.abs(alpha / MIN_ALPHA - 1) < tolerance)
        capped = running & (np.abs(alpha / MAX_ALPHA - 1) < 1e-4)
        alpha = np.where(alpha < MIN_ALPHA, 0.0, np.minimum(alpha, MAX_ALPHA))
        last = running & (np.abs(left * (1 - alpha) / MIN_TRANSMITTANCE - 1) < 1e-3) & (alpha > 0)
        # What is behind changes with it: at most by the transmittance itself.
        jump = np.maximum(jump, left * np.where(faint, 2 * MIN_ALPHA, 0.0))
        jump = np.maximum(jump, np.where(last, 2 * left * alpha, 0.0))
        jump = np.maximum(jump, np.where(capped, 1e-3 * left, 0.0))
        running &= left * (1 - alpha) > MIN_TRANSMITTANCE
        touched[..., i] = running & (alpha > 0)
        left = np.where(running, left * (1 - alpha), left)
    return np.where(jump > 1e-6, jump, 0.0), touched


def _relative(got: np.ndarray, expected: np.ndarray, floor: float) -> float:
    if not got.size:
        return 0.0
    if not np.isfinite(got).all():
        return float("inf")
    return float(np.linalg.norm(got - expected) / max(np.linalg.norm(expected), floor))


def _rounded(tree: Any, seed: int) -> Any:
    """Every number moved by one float32 rounding, up or down."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: a * (1 + 2.0**-24 * rng.choice([-1.0, 1.0], np.shape(a))), tree)


def evaluate(case: Case, *, ulp: bool = True) -> Row:
    """All columns of one row; `ulp` False leaves the yardstick out (NaN)."""
    gaussians, camera, features, bad = meant(case)
    expected, alpha = render_reference(gaussians, camera, features)
    expected = np.concatenate([expected, alpha[..., None]], axis=-1)
    jump, touched = cuts_in_doubt(gaussians, camera, min(1e-2, 10 * case.bounds.get("value", VALUE)))
    poisoned = touched[..., bad].any(-1)
    clear = (jump == 0) & ~poisoned
    unit = np.array([*[np.abs(features).max(initial=0.0) or 1.0] * features.shape[1], 1.0])
    cotangent = np.random.default_rng(1).normal(size=expected.shape) * clear[..., None] / unit
    image, overflow, gradients = engine(case, cotangent)

    def twin_of(*scene):
        image, _, gradients = dense(*scene, cotangent)
        # The pose of a recentred scene moves with R about another origin: t' = R origin + t.
        moment = gradients["pose"][:, 3:] * np.array(case.origin)
        gradients["pose"] = gradients["pose"] - np.concatenate([moment, np.zeros((3, 1))], axis=1)
        gradients["features"] = np.where(np.isfinite(case.features), gradients["features"], 0)
        return image, gradients

    twin, exact = twin_of(gaussians, camera, features)
    np.testing.assert_allclose(twin / unit, expected / unit, atol=1e-9, err_msg=f"{case.name}: the two float64 twins")

    finite = np.isfinite(image).all(-1)
    error = (np.abs(np.where(finite[..., None], image, 0) - expected) / unit).max(-1)
    undoubted_poison = poisoned & (jump == 0)
    everything = np.sqrt(sum(np.linalg.norm(g) ** 2 for g in exact.values()))
    relative = lambda got, k: _relative(got[k], exact[k], 1e-20 * everything + 1e-30)
    value_ulp, gradient_ulps = float("nan"), dict.fromkeys(ARGUMENTS, float("nan"))
    if ulp and case.gaussians.count:
        moved = [twin_of(*_rounded((gaussians, camera, features), seed)) for seed in range(3)]
        value_ulp = max(float((np.abs(m[0] - twin) / unit)[clear].max(initial=0)) for m in moved)
        gradient_ulps = {k: max(relative(m[1], k) for m in moved) for k in ARGUMENTS}
    return Row(
        value_finite=bool(finite[~poisoned].all()),
        contained=bool((~finite)[undoubted_poison].all() and finite[~poisoned & (jump == 0)].all()),
        value_error=float(error[clear].max(initial=0)),
        in_doubt=float((jump > 0).mean()),
        doubtful_error=float((error - jump)[(jump > 0) & ~poisoned].max(initial=0)),
        gradient_finite=all(bool(np.isfinite(g).all()) for g in gradients.values()),
        gradient_errors={k: relative(gradients, k) for k in ARGUMENTS},
        value_ulp=value_ulp,
        gradient_ulps=gradient_ulps,
        overflow=int(overflow),
    )


def main(options: Options) -> dict[str, Row]:
    """Measures every row and writes the table."""
    start, rows = time.process_time(), {}
    header = ("scene", "finite", "error", "one ulp", "cuts in doubt", "gradient error: worst", "one ulp", "wider bound")
    lines = []
    for case in cases():
        if options.only not in case.name:
            continue
        row = rows[case.name] = evaluate(case)
        worst = max(row.gradient_errors, key=row.gradient_errors.__getitem__)
        lines.append(
            (
                case.name,
                ", ".join(
                    f"{what} {'yes' if good else 'NO'}"
                    for what, good in (("value", row.value_finite and row.contained), ("gradient", row.gradient_finite))
                ),
                f"{row.value_error:.1e}",
                f"{row.value_ulp:.1e}",
                f"{100 * row.in_doubt:.1f} %",
                f"{row.gradient_errors[worst]:.1e} {worst}",
                f"{row.gradient_ulps[worst]:.1e}",
                ", ".join(f"{k} {v:.0e}" for k, v in case.bounds.items()) + (f": {case.why}" if case.why else ""),
            )
        )
        print("|".join(lines[-1]), {k: f"{v:.0e}" for k, v in row.gradient_errors.items() if v > GRADIENT}, flush=True)
    seconds = time.process_time() - start
    metrics = {"cpu_s": round(seconds, 1), "rows": {k: dataclasses.asdict(r) for k, r in rows.items()}}
    results.save(Path(options.out), options, metrics, results.table(header, lines))
    return rows


if __name__ == "__main__":
    main(Options())
