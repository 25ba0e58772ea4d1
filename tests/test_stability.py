"""Scenes that are stiff or extreme in one way each: images and gradients are those of float64, within stated bounds.

The image is held against brute force (reference.py), the gradients, with respect to every array and the camera, against
automatic differentiation of a dense float64 compositor. A pixel where a cut (alpha at 1/255, transmittance at 1e-4, the
cap at 0.99) is decided by less than float32 can tell is left out of both, and bounded by what the cut can cause. All
scenes are float32, and padded with Gaussians behind the camera to a few sizes, so that compiled programs are shared.
"""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import gaussians_at
from reference import alphas_reference, project_reference, render_reference, weights_reference
from scipy.spatial.transform import Rotation

from jsecon.numerics import BLUR_PX2, FRUSTUM_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR
from jsecon.splat.render import render, render_depth, render_rgb
from jsecon.types import Camera, Gaussians

COUNT = 64
"""Gaussians of a case, with the padding"""
CAPACITY = COUNT * 30
FACING = (1.0, 0.0, 0.0, 0.0)
ARGUMENTS = ("means", "log_scales", "quaternions", "opacity_logits", "pose", "intrinsics", "features")
"""what gradients are taken with respect to"""
VALUE = 1e-5
"""bound on the largest error of image (in units of the largest feature) and alpha"""
GRADIENT = 5e-5
"""bound on the relative L2 error of the gradient with respect to each argument"""


@dataclasses.dataclass(frozen=True)
class Case:
    name: str
    gaussians: Gaussians
    camera: Camera
    features: np.ndarray
    bounds: dict[str, float] = dataclasses.field(default_factory=dict)
    """wider bounds than VALUE and GRADIENT, for "value" or an argument; what a rounding of the inputs does"""
    exact: tuple[Gaussians, Camera] | None = None
    """the float64 scene that the case stands for, where float32 can't hold it as it is"""
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    """where in the world of `exact` this scene's own origin lies"""
    bad: int = 0
    """Gaussians that must be counted as not finite"""


# What scenes are built with, in camera axes.


def turned_pose() -> np.ndarray:
    """(4, 4) float32 rigid pose at no special angle."""
    matrix = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = matrix * np.sign(np.linalg.det(matrix))
    pose[:3, 3] = 0.3, -0.2, 0.5
    return pose.astype(np.float32)


TURNED, STRAIGHT = turned_pose(), np.eye(4, dtype=np.float32)


def camera_of(pose=TURNED, f=45.0, cx=25.44, cy=18.8) -> Camera:
    return Camera(pose, *(np.float32(v) for v in (f, f, cx, cy)), 48, 40)


def padded(rows, n: int, fill) -> np.ndarray:
    """Rows of each or of all of `n`, then `fill` up to COUNT."""
    rows = np.broadcast_to(np.float64(rows), (n, *np.shape(fill)))
    return np.concatenate([rows, np.broadcast_to(np.float64(fill), (COUNT - n, *np.shape(fill)))])


def case_of(name, points, scales, turns=FACING, logits=1.0, *, camera=None, **rest) -> Case:
    """A Case of camera-frame `points` (n, 3), scales in metres and quaternions, carried into the camera's world."""
    camera = camera_of() if camera is None else camera
    pose, n = np.float64(camera.world_to_camera), len(points)
    turns = padded(turns, n, FACING)
    lengths = np.linalg.norm(turns, axis=1, keepdims=True)
    turns = Rotation.from_matrix(pose[:3, :3].T) * Rotation.from_quat(turns, scalar_first=True)
    means = (padded(points, n, (0.0, 0.0, -5.0)) - pose[:3, 3]) @ pose[:3, :3]
    quaternions = turns.as_quat(scalar_first=True) * lengths
    scales, logits = padded(scales, n, np.full(3, 0.05)), padded(logits, n, 0.0)
    gaussians = gaussians_at(means, scales, turns=quaternions, logit=logits)
    features = np.random.default_rng(7).uniform(-1, 1, (COUNT, 3)).astype(np.float32)
    return Case(name, gaussians, camera, features, **rest)


def changed(case: Case, name: str, where=(), **changes) -> Case:
    """`case` with other numbers: `where` holds (field of Gaussians or "features", index, value)."""
    arrays = {f.name: getattr(case.gaussians, f.name).copy() for f in dataclasses.fields(Gaussians)}
    arrays["features"] = case.features.copy()
    for field, index, value in where:
        arrays[field][index] = value
    features = arrays.pop("features")
    return dataclasses.replace(case, name=name, gaussians=Gaussians(**arrays), features=features, **changes)


def cloud(n: int, seed: int, depth=(1.5, 4.0), spread=0.45) -> np.ndarray:
    """(n, 3) points inside the view."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    return np.stack([rng.uniform(-spread, spread, n) * z, rng.uniform(-spread, spread, n) * z, z], axis=1)


def ordinary(name: str = "ordinary scene") -> Case:
    """A scene without anything special: what bad numbers are put into."""
    rng = np.random.default_rng(3)
    scales, turns, logits = rng.uniform(0.03, 0.3, (48, 3)), rng.normal(size=(48, 4)), rng.uniform(-2, 4, 48)
    return case_of(name, cloud(48, 2), scales, turns, logits)


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def onto(axis: np.ndarray) -> np.ndarray:
    """(N, 4) wxyz that turn the x axis onto each unit `axis` (N, 3)."""
    half = np.stack([1 + axis[:, 0], 0 * axis[:, 0], -axis[:, 2], axis[:, 1]], axis=1)
    return unit(half)


def shapes() -> Iterator[Case]:
    """Needles, discs, the very small and the very large."""
    rng, points = np.random.default_rng(5), cloud(48, 1)
    axes, ray = np.concatenate([np.eye(3), unit(rng.normal(size=(45, 3)))]), unit(points)
    across = unit(np.cross(ray, axes))
    unequal, turns = rng.uniform(0.5, 2.0, (48, 3)), rng.normal(size=(48, 4))
    yield case_of("needles, aspect 1e6, 9 px long", points, (0.5, 5e-7, 5e-7), onto(axes))
    yield case_of("needles, aspect 1e6, 1 px wide", points, (5e4, 0.05, 0.05), onto(axes))
    # Seen end on, the image grows with the square of the angle off the ray, which float32 knows to 1e-7 only.
    bounds = {"log_scales": 5e-3, "quaternions": 5.0}
    yield case_of("needles, aspect 1e6, along the ray", points, (1.0, 1e-6, 1e-6), onto(ray), bounds=bounds)
    yield case_of("discs, aspect 1e6, edge-on", points, (3e-7, 0.3, 0.3), onto(across))
    yield case_of("sub-pixel, 2e-4 px", points, 1e-5 * unequal, turns, 2.0)
    yield case_of("screen-filling, 2e4 px", points, 1e3 * unequal, turns, -1.0)
    for exponents in ((80, 80, 80), (-80, -80, -80), (80, 80, -80), (-np.inf, -2, -3)):
        log_scales = [("log_scales", slice(0, 48), exponents)]
        yield changed(case_of("", points, 0.05, turns), f"log scales {exponents}", log_scales)


def opacities() -> Iterator[Case]:
    """Saturated logits."""
    both = np.where(np.arange(48) % 2, 1.0, -1.0)
    for size in (30.0, 1e4, np.inf):
        yield changed(ordinary(), f"opacity logits +-{size:g}", [("opacity_logits", slice(0, 48), size * both)])


def depths() -> Iterator[Case]:
    """Ties, the near plane, the edge of the clamp, far away."""
    straight, rng = camera_of(STRAIGHT), np.random.default_rng(13)
    ties, turns = cloud(48, 4), rng.normal(size=(48, 4))
    ties[:, 2] = 2.0
    yield case_of("equal depths", ties, rng.uniform(0.1, 0.4, (48, 3)), turns, 2.0, camera=straight)
    near = np.float32(NEAR)
    steps = [near, np.nextafter(near, np.float32(1)), np.nextafter(near, np.float32(0)), 0.0, -0.01, -1.0, -1e6, 1e-30]
    z = np.array([*steps, *(near + np.arange(1, 17, dtype=np.float32) * np.float32(1e-3))], np.float64)
    points = np.stack([*rng.uniform(-0.4, 0.4, (2, len(z))) * np.abs(z), z], 1)
    sizes = rng.uniform(0.001, 0.01, (len(z), 3))
    yield case_of("on and about the near plane", points, sizes, turns[: len(z)], 0.0, camera=straight)
    beside, sizes = beside_clamp(straight), rng.uniform(0.2, 0.6, (32, 3))
    yield case_of("beside the clamp's edge", beside, sizes, turns[:32], 0.0, camera=straight)
    yield case_of("1e15 m away", 1e15 * cloud(48, 6), 1e14 * rng.uniform(0.3, 1, (48, 3)), turns)
    sideways = np.concatenate([cloud(24, 6), cloud(24, 6) * (2e38, -2e38, 1)])
    yield case_of("half of them 2e38 m aside", sideways, rng.uniform(0.1, 0.3, (48, 3)), turns)


def beside_clamp(camera: Camera) -> np.ndarray:
    """(32, 3) points whose x/z or y/z is just within or beyond the clamp's limit, on all four sides."""
    centre, size = np.float64([camera.cx, camera.cy]), np.array([camera.width, camera.height])
    limits = (-centre - 0.15 * size) / camera.fx, (1.15 * size - centre) / camera.fx
    rows = []
    for k in range(32):
        axis, z = k // 2 % 2, 1.5 + 0.05 * k
        ratio = np.full(2, np.linspace(-0.4, 0.4, 8)[k // 4])
        ratio[axis] = limits[k % 2][axis] * (1 - 1e-4, 1 + 1e-4)[k // 4 % 2]
        rows.append([*(ratio * z), z])
    return np.array(rows)


def cameras() -> Iterator[Case]:
    """Focal lengths, principal points; a scene 1e6 m from the origin that is recentred."""
    rng = np.random.default_rng(17)
    sizes, turns = rng.uniform(0.03, 0.3, (48, 3)), rng.normal(size=(48, 4))
    yield case_of("focal length 1 px", cloud(48, 8, spread=20.0), 20 * sizes, turns, camera=camera_of(f=1.0))
    narrow, tele = cloud(48, 8, spread=0.45 * 45e-5), camera_of(STRAIGHT, f=1e5)
    yield case_of("focal length 1e5 px, straight pose", narrow, 45e-5 * sizes, turns, camera=tele)
    # A position of metres is known to 1e-7 m, at this focal length 0.01 px.
    bounds, tele = {"value": 1e-3, **dict.fromkeys(ARGUMENTS, 1e-3)}, camera_of(f=1e5)
    yield case_of("focal length 1e5 px, turned pose", narrow, 45e-5 * sizes, turns, camera=tele, bounds=bounds)
    aside = cloud(48, 8) + np.array([1.0, -1.0, 0]) * cloud(48, 8)[:, 2:] * (100 / 45.0)
    yield case_of("principal point outside the image", aside, sizes, turns, camera=camera_of(cx=-75.0, cy=119.0))

    base, shift = ordinary("1e6 m off, recentred from float64"), np.array([1e6, -1e6, 1e6])
    pose = np.float64(base.camera.world_to_camera)
    pose[:3, 3] -= pose[:3, :3] @ shift
    far = dataclasses.replace(base.gaussians, means=np.float64(base.gaussians.means) + shift)
    origin, moved = np.median(far.means, axis=0), pose.copy()
    moved[:3, 3] += pose[:3, :3] @ origin
    gaussians = dataclasses.replace(far, means=(far.means - origin).astype(np.float32))
    camera = dataclasses.replace(base.camera, world_to_camera=moved.astype(np.float32))
    exact = far, dataclasses.replace(base.camera, world_to_camera=pose)
    yield dataclasses.replace(base, gaussians=gaussians, camera=camera, exact=exact, origin=tuple(origin))


def numbers() -> Iterator[Case]:
    """Quaternions and features at the ends of the float range; numbers that are none."""
    base = ordinary()
    turns = base.gaussians.quaternions[:48]
    for length in (0.0, 1e-40, 1e-30, 1e30):
        new = [("quaternions", slice(0, 48), turns * np.float32(length))]
        yield changed(base, f"quaternions of length {length:g}", new)
    for factor in (1e30, 1e-30, 0.0):
        features = base.features * np.float32(factor)
        yield dataclasses.replace(base, name=f"features of {factor:g}", features=features)
    bad = [(5, np.nan), (9, np.inf), (14, -np.inf)]
    for name, width, count in (("means", 3, 3), ("log_scales", 3, 2), ("quaternions", 4, 3), ("features", 3, 3)):
        new = [(name, (i, i % width), value) for i, value in bad[:count]]
        yield changed(base, f"NaN and infinite {name}", new, bad=count)
    yield changed(base, "NaN opacity logit", [("opacity_logits", 5, np.nan)], bad=1)
    everything = [(k, slice(0, 48, 2), np.nan) for k in ARGUMENTS[:4]]
    yield changed(base, "every second one NaN", everything, bad=24)


# The image and its gradients, by the renderer and by a dense float64 twin.


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
    turns = jnp.where(squared > 0, 1.0, 0.0)[:, None] * gaussians.quaternions
    a, b, c, d = jnp.moveaxis(turns / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[:, None], 1, 0)
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
    return jnp.concatenate([total, 1 - left[..., None]], axis=-1), 0


def rendered_image(gaussians, camera, features):
    """The renderer's image and alpha, and its overflow; every Gaussian has room in every 8 px tile."""
    rendering = render(gaussians, camera, features, capacity=CAPACITY)
    return jnp.concatenate([rendering.features, rendering.alpha[..., None]], axis=-1), rendering.overflow


def image_and_gradients(image_of, gaussians, camera, features, cotangent):
    """The image, its overflow, and a gradient for each of ARGUMENTS of <image, cotangent>."""

    def loss(gaussians, camera, features):
        image, overflow = image_of(gaussians, camera, features)
        # A pixel that is not finite has no gradient to give; the others must not suffer from it.
        return jnp.where(jnp.isfinite(image), image * cotangent, 0.0).sum(), (image, overflow)

    gradient = jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)
    (_, (image, overflow)), (g, c, f) = gradient(gaussians, camera, features)
    intrinsics = jnp.stack([c.fx, c.fy, c.cx, c.cy])
    parts = (g.means, g.log_scales, g.quaternions, g.opacity_logits, c.world_to_camera[:3], intrinsics, f)
    return image, overflow, dict(zip(ARGUMENTS, parts))


by_renderer = jax.jit(functools.partial(image_and_gradients, rendered_image))
# Compiled without optimisation: several times as soon ready, and it runs but a few times.
by_dense = jax.jit(
    functools.partial(image_and_gradients, dense_image), compiler_options={"xla_backend_optimization_level": 0}
)


def to64(tree):
    """Float64 of what float32 arithmetic sees: XLA counts denormal numbers as zero."""

    def widen(a):
        a = np.asarray(a)
        tiny = np.finfo(np.float32).tiny
        return np.where(np.abs(a) < tiny, 0.0, a.astype(np.float64)) if a.dtype == np.float32 else a

    return jax.tree.map(widen, tree)


def meant(case: Case) -> tuple[Gaussians, Camera, np.ndarray, np.ndarray]:
    """The float64 scene that a case stands for: unusable Gaussians moved out of sight, infinite sizes made finite.
    With it the Gaussians (N,) whose features are not finite."""
    gaussians, camera = to64(case.exact or (case.gaussians, case.camera))
    features = to64(case.features)
    usable = np.isfinite(gaussians.means).all(1) & np.isfinite(gaussians.quaternions).all(1)
    usable &= ~(np.isnan(gaussians.log_scales) | np.isposinf(gaussians.log_scales)).any(1)
    usable &= ~np.isnan(gaussians.opacity_logits)
    behind = np.linalg.inv(camera.world_to_camera) @ (0, 0, -5, 1)
    cleaned = Gaussians(
        np.where(usable[:, None], gaussians.means, behind[None, :3]),
        np.where(usable[:, None], np.maximum(gaussians.log_scales, -200), 0.0),
        np.where(usable[:, None], gaussians.quaternions, FACING),
        np.where(usable, np.clip(gaussians.opacity_logits, -1e5, 1e5), 0.0),
        gaussians.sh,
    )
    bad = usable & ~np.isfinite(features).all(1)
    return cleaned, camera, np.where(np.isfinite(features), features, 0.0), bad


def cuts_in_doubt(gaussians: Gaussians, camera: Camera, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) what a cut in doubt can change there, in units of a feature, 0 where none is in doubt; and bool (H, W, N)
    the pixels that each Gaussian touches."""
    splats = project_reference(gaussians, camera)
    left, running = np.ones((camera.height, camera.width)), np.ones((camera.height, camera.width), bool)
    jump, touched = np.zeros_like(left), np.zeros((*left.shape, gaussians.count), bool)
    for i, alpha in alphas_reference(splats, camera):
        faint = running & (np.abs(alpha / MIN_ALPHA - 1) < tolerance)
        capped = running & (np.abs(alpha / MAX_ALPHA - 1) < 1e-4)
        alpha = np.where(alpha < MIN_ALPHA, 0.0, np.minimum(alpha, MAX_ALPHA))
        last = running & (np.abs(left * (1 - alpha) / MIN_TRANSMITTANCE - 1) < 1e-3) & (alpha > 0)
        # What is behind changes with it: at most by the transmittance itself.
        for doubt, change in ((faint, 2 * MIN_ALPHA * left), (last, 2 * left * alpha), (capped, 1e-3 * left)):
            jump = np.maximum(jump, np.where(doubt, change, 0.0))
        running &= left * (1 - alpha) > MIN_TRANSMITTANCE
        touched[..., i] = running & (alpha > 0)
        left = np.where(running, left * (1 - alpha), left)
    return np.where(jump > 1e-6, jump, 0.0), touched


CASES = [ordinary(), *shapes(), *opacities(), *depths(), *cameras(), *numbers()]


@pytest.mark.as_shipped  # the cases share their programs, which are compiled as users run them
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_row(case):
    gaussians, camera, features, bad = meant(case)
    allowed = case.bounds.get("value", VALUE)
    jump, touched = cuts_in_doubt(gaussians, camera, min(1e-2, 10 * allowed))
    poisoned = touched[..., bad].any(-1)
    clear = (jump == 0) & ~poisoned
    units = np.array([*[np.abs(features).max(initial=0.0) or 1.0] * features.shape[1], 1.0])
    cotangent = np.random.default_rng(1).normal(size=(*jump.shape, len(units))) * clear[..., None] / units
    arguments = jax.tree.map(jnp.asarray, (case.gaussians, case.camera, case.features, np.float32(cotangent)))
    image, overflow, gradients = jax.tree.map(np.asarray, by_renderer(*arguments))
    with jax.enable_x64(True):
        arguments = jax.tree.map(jnp.asarray, (gaussians, camera, features, cotangent))
        expected, _, exact = jax.tree.map(np.array, by_dense(*arguments))
    slow, alpha = render_reference(gaussians, camera, features)
    np.testing.assert_allclose(expected / units, np.concatenate([slow, alpha[..., None]], -1) / units, atol=1e-9)

    assert overflow == 0
    finite = np.isfinite(image).all(-1)
    assert finite[~poisoned].all()
    assert not finite[poisoned & (jump == 0)].any()  # what a bad feature touches, and nothing else
    error = (np.abs(np.where(finite[..., None], image, 0) - expected) / units).max(-1)
    assert error[clear].max(initial=0) <= allowed
    assert (error - jump)[(jump > 0) & ~poisoned].max(initial=0) <= allowed

    # The pose of a recentred scene moves with R about another origin: t' = R origin + t.
    exact["pose"][:, :3] -= exact["pose"][:, 3:] * np.array(case.origin)
    exact["features"][~np.isfinite(case.features)] = 0
    floor = 1e-20 * np.sqrt(sum(np.linalg.norm(g) ** 2 for g in exact.values())) + 1e-30
    for name, gradient in gradients.items():
        assert np.isfinite(gradient).all(), name
        distance = np.linalg.norm(gradient - exact[name]) / max(np.linalg.norm(exact[name]), floor)
        assert distance <= case.bounds.get(name, GRADIENT), name


@pytest.fixture(scope="module")
def touched():
    """A scene, and bool (H, W) the pixels that its sixth Gaussian touches, by brute force."""
    case = ordinary()
    covered = weights_reference(case.gaussians, case.camera)[..., 5] > 0
    assert 20 < covered.sum() < covered.size / 2
    return case, covered


def nan_pixels(image) -> np.ndarray:
    """(H, W) pixels that are NaN, which must be so in all channels or in none."""
    wrong = np.isnan(np.asarray(image))
    np.testing.assert_array_equal(wrong.any(-1), wrong.all(-1))
    return wrong.any(-1)


@pytest.mark.long
def test_a_bad_feature_stays_where_it_is_seen_however_wide_and_in_its_own_set_under_vmap(touched):
    case, covered = touched
    sets = np.random.default_rng(0).normal(size=(2, 64, 12)).astype(np.float32)
    broken = sets.copy()
    broken[1, 5, 0] = np.nan

    def loss(f):
        image = render(case.gaussians, case.camera, f, capacity=CAPACITY).features
        return jnp.nan_to_num(image).sum(), image

    compiled = jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True)))
    ((_, clean), _), ((_, image), gradient) = compiled(sets), compiled(broken)
    np.testing.assert_array_equal(image[0], clean[0])
    np.testing.assert_array_equal(nan_pixels(image[1]), covered)
    np.testing.assert_array_equal(np.asarray(image[1])[~covered], np.asarray(clean[1])[~covered])
    assert bool(jnp.isfinite(gradient).all())


@pytest.mark.long
def test_colour_and_depth_of_bad_gaussians(touched):
    """In every run the rows have features of such Gaussians."""
    case, covered = touched
    coefficients = np.random.default_rng(1).normal(scale=0.2, size=(64, 4, 3)).astype(np.float32)
    means, sh = case.gaussians.means.copy(), coefficients.copy()
    means[7], sh[5, 2, 1] = np.nan, np.nan
    broken = dataclasses.replace(case.gaussians, means=means, sh=sh)

    def loss(gaussians, camera):
        image = render_rgb(gaussians, camera, capacity=CAPACITY).features
        return jnp.nansum(image), image

    compiled = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))
    (_, image), gradients = compiled(broken, case.camera)
    assert all(bool(jnp.isfinite(g).all()) for g in jax.tree.leaves(gradients))
    missing = nan_pixels(image)
    assert not (missing & ~covered).any()
    assert bool(jnp.isfinite(render_depth(broken, case.camera)[0]).all())


@pytest.mark.as_shipped  # so are the rows whose program it shares
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_camera_that_is_not_finite_sees_nan_and_has_no_gradient(number):
    case = ordinary()
    pose = case.camera.world_to_camera.copy()
    pose[1, 2] = number
    camera = dataclasses.replace(case.camera, world_to_camera=pose)
    arguments = case.gaussians, camera, case.features, np.ones((40, 48, 4), np.float32)
    image, _, gradients = by_renderer(*jax.tree.map(jnp.asarray, arguments))
    assert np.isnan(image).all()
    for name, gradient in gradients.items():
        np.testing.assert_array_equal(gradient, 0, err_msg=name)
