"""What is measured of a case: whether every number is finite, and how far image and gradients are from float64.

The image is held against brute force in float64 (tests/reference.py), the gradients, with respect to every array
and the camera, against automatic differentiation of a dense float64 compositor. A pixel where a cut (alpha at 1/255,
transmittance at 1e-4, the cap at 0.99) is decided by less than float32 can tell is left out of both, counted, and
bounded by what the cut can cause.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from reference import project_reference, render_reference

from jsecon.numerics import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from jsecon.types import Camera, Gaussians
from stability.case import ARGUMENTS, VALUE, Case
from stability.render import dense, engine


@dataclasses.dataclass(frozen=True)
class Row:
    """What was measured of a case."""

    value_finite: bool
    """every pixel, those that a bad feature touches left out"""
    contained: bool
    """the pixels that are not finite are those that a Gaussian with a bad feature touches, and no other"""
    value_error: float
    """largest error of image (in units of the largest feature) and alpha, over pixels where no cut is in doubt"""
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

    def relative(got, k):
        return _relative(got[k], exact[k], 1e-20 * everything + 1e-30)

    value_ulp, gradient_ulps = float("nan"), dict.fromkeys(ARGUMENTS, float("nan"))
    if ulp and case.gaussians.count:
        moved = [twin_of(*_rounded((gaussians, camera, features), seed)) for seed in range(3)]
        value_ulp = max(float((np.abs(m[0] - twin) / unit)[clear].max(initial=0)) for m in moved)
        gradient_ulps = {k: max(relative(m[1], k) for m in moved) for k in ARGUMENTS}
    return Row(
        value_finite=bool(finite[~poisoned].all()),
        contained=bool((~finite)[undoubted_poison].all() and finite[~poisoned & (jump == 0)].all()),
        value_error=float(error[clear].max(initial=0)),
        doubtful_error=float((error - jump)[(jump > 0) & ~poisoned].max(initial=0)),
        gradient_finite=all(bool(np.isfinite(g).all()) for g in gradients.values()),
        gradient_errors={k: relative(gradients, k) for k in ARGUMENTS},
        value_ulp=value_ulp,
        gradient_ulps=gradient_ulps,
        overflow=int(overflow),
    )
