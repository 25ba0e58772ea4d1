"""Stiff and extreme scenes, each with the error that float32 allows it: what experiments/stability.py tabulates and
tests/test_stability.py holds.

Scenes are stated in camera axes (x right, y down, z forward, metres) and carried into the world by a turned pose,
unless exact arithmetic is the point. All are float32, padded with Gaussians behind the camera to a few sizes, so that
the compiled programs are shared.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from jsecon.types import Camera, Gaussians

COUNT = 64
"""Gaussians in a case, with the padding"""
FACING = (1.0, 0.0, 0.0, 0.0)
ARGUMENTS = ("means", "log_scales", "quaternions", "opacity_logits", "pose", "intrinsics", "features")
"""what gradients are taken with respect to"""
VALUE = 1e-5
"""bound on the largest error of image (in units of the largest feature) and alpha, where no cut is in doubt"""
GRADIENT = 5e-5
"""bound on the relative L2 error of the gradient with respect to each argument"""


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: a scene, and the largest errors that it may show."""

    name: str
    gaussians: Gaussians
    camera: Camera
    features: np.ndarray
    """(N, 3) float32."""
    bounds: dict[str, float] = dataclasses.field(default_factory=dict)
    """wider bounds than VALUE and GRADIENT, for "value" or an argument's gradient; never above a few times what one
    rounding of the inputs does to the float64 result"""
    why: str = ""
    """what makes the wider bound the best that float32 can do"""
    exact: tuple[Gaussians, Camera] | None = None
    """the float64 scene that the case stands for, where float32 can't hold it as it is"""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """where in the world of `exact` this scene's own origin lies"""
    bad: int = 0
    """Gaussians that must be counted as not finite"""


def _turned(seed: int = 0) -> np.ndarray:
    """(4, 4) float32 rigid pose at no special angle."""
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = matrix * np.sign(np.linalg.det(matrix))
    pose[:3, 3] = 0.3, -0.2, 0.5
    return pose.astype(np.float32)


TURNED, STRAIGHT = _turned(), np.eye(4, dtype=np.float32)


def _camera(pose=TURNED, width=48, height=40, f=45.0, cx=None, cy=None) -> Camera:
    numbers = (f, f, width * 0.53 if cx is None else cx, height * 0.47 if cy is None else cy)
    return Camera(pose, *(np.float32(v) for v in numbers), width, height)


def _quaternion_onto(axis: np.ndarray) -> np.ndarray:
    """(N, 4) wxyz that turn the x axis onto each unit `axis` (N, 3)."""
    half = np.stack([1 + axis[:, 0], 0 * axis[:, 0], -axis[:, 2], axis[:, 1]], axis=1)
    half[axis[:, 0] < -1 + 1e-12] = 0, 0, 1, 0
    return half / np.linalg.norm(half, axis=1, keepdims=True)


def _product(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return r @ np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])


def _pose_quaternion(rotation: np.ndarray) -> np.ndarray:
    from jsecon.splat.transform import quaternion_of

    return quaternion_of(rotation)


CANCELS = (
    "the gradient of the camera is a sum over the stack that cancels: each Gaussian's own gradient is within 5e-6, and "
    "as large errors come at every opacity from 0.5 to 1 (2e-5 to 9e-5)"
)
"""rounding of terms, not of inputs: the one-ulp figure does not show it"""


def _case(name, points, scales, quaternions=FACING, logits=1.0, *, camera=None, features=None, count=COUNT, **rest):
    """A Case from camera-frame `points` (n, 3), `scales` (metres, no logarithms) and quaternions, padded to `count`."""
    camera = _camera() if camera is None else camera
    points = np.asarray(points, np.float64).reshape(-1, 3)
    n = len(points)
    pose = np.asarray(camera.world_to_camera, np.float64)
    rng = np.random.default_rng(7)
    with np.errstate(divide="ignore"):
        log_scales = np.log(np.broadcast_to(np.asarray(scales, np.float64), (n, 3)))
    turned = np.broadcast_to(np.asarray(quaternions, np.float64), (n, 4))
    if not np.array_equal(pose[:3, :3], np.eye(3)):
        turned = _product(_pose_quaternion(pose[:3, :3].T), turned)
    behind = np.array([0.0, 0.0, -5.0])
    points = np.concatenate([points, np.tile(behind, (count - n, 1))])
    means = (points - pose[:3, 3]) @ pose[:3, :3]
    gaussians = Gaussians(
        *(
            a.astype(np.float32)
            for a in (
                means,
                np.concatenate([log_scales, np.full((count - n, 3), -3.0)]),
                np.concatenate([turned, np.tile(FACING, (count - n, 1))]),
                np.concatenate([np.broadcast_to(np.asarray(logits, np.float64), n), np.zeros(count - n)]),
                np.zeros((count, 1, 3)),
            )
        )
    )
    if features is None:
        features = rng.uniform(-1, 1, (count, 3))
    return Case(name, gaussians, camera, np.asarray(features, np.float32), **rest)


def _with(case: Case, name: str, where=(), **changes) -> Case:
    """`case` with other numbers: `where` holds (field of Gaussians or "features", index, value)."""
    arrays = {f.name: getattr(case.gaussians, f.name).copy() for f in dataclasses.fields(Gaussians)}
    arrays["features"] = case.features.copy()
    for field, index, value in where:
        arrays[field][index] = value
    features = arrays.pop("features")
    return dataclasses.replace(case, name=name, gaussians=Gaussians(**arrays), features=features, **changes)


def _directions(n: int) -> np.ndarray:
    """(n, 3) unit vectors all round: the axes, then a Fibonacci spiral."""
    k = np.arange(n - 3) + 0.5
    z, angle = 1 - 2 * k / (n - 3), np.pi * (1 + 5**0.5) * k
    spiral = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return np.concatenate([np.eye(3), spiral])


def _cloud(n: int, seed: int, depth=(1.5, 4.0), spread=0.45) -> np.ndarray:
    """(n, 3) points inside the view."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    return np.stack([rng.uniform(-spread, spread, n) * z, rng.uniform(-spread, spread, n) * z, z], axis=1)


def ordinary(name: str = "ordinary scene", n: int = 48, **rest) -> Case:
    """A scene without anything special: the measure for the others, and what bad numbers are put into."""
    rng = np.random.default_rng(3)
    return _case(
        name, _cloud(n, 2), rng.uniform(0.03, 0.3, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(-2, 4, n), **rest
    )


def shapes() -> Iterator[Case]:
    """Needles, discs, the very small and the very large."""
    axes = _directions(48)
    turns, points = _quaternion_onto(axes), _cloud(48, 1)
    yield _case("needles, aspect 1e6, 9 px long", points, (0.5, 5e-7, 5e-7), turns)
    yield _case("needles, aspect 1e6, 1 px wide", points, (5e4, 0.05, 0.05), turns)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    yield _case(
        "needles, aspect 1e6, along the ray",
        points,
        (1.0, 1e-6, 1e-6),
        _quaternion_onto(ray),
        bounds={"log_scales": 5e-3, "quaternions": 5.0},
        why="seen end on, the image grows with the square of the angle off the ray, which float32 knows to 1e-7 only",
    )
    normal = np.cross(ray, axes)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    yield _case("discs, aspect 1e6, edge-on", points, (3e-7, 0.3, 0.3), _quaternion_onto(normal))
    tilted = normal + 1e-4 * ray
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    yield _case(
        "discs, aspect 1e6, 1e-4 rad off edge-on",
        points,
        (3e-5, 30.0, 30.0),
        _quaternion_onto(tilted),
        bounds={"value": 5e-5, **dict.fromkeys(("means", "log_scales", "quaternions", "pose"), 3e-3)},
        why="the 1e-4 rad, and so the width of 0.1 px, are known to 1e-3",
    )
    rng = np.random.default_rng(5)
    unequal, turns = rng.uniform(0.5, 2.0, (48, 3)), rng.normal(size=(48, 4))
    yield _case("sub-pixel, 2e-4 px", points, 1e-5 * unequal, turns, 2.0)
    yield _case("screen-filling, 2e4 px", points, 1e3 * unequal, turns, -1.0)
    scales = np.full((48, 3), np.exp(-3.0))
    for name, exponents in (
        ("log scales 80", (80, 80, 80)),
        ("log scales -80", (-80, -80, -80)),
        ("log scales 80, -3, -3", (80, -3, -3)),
        ("log scales 80, 80, -80", (80, 80, -80)),
        ("log scales -inf: the logarithm of 0", (-np.inf, -2, -3)),
    ):
        yield _with(_case(name, points, scales, turns), name, [("log_scales", slice(0, 48), exponents)])


def opacities() -> Iterator[Case]:
    """Saturated logits and long stacks."""
    both = np.where(np.arange(48) % 2, 1.0, -1.0)
    for size, name in ((30.0, "30"), (1e4, "1e4"), (np.inf, "inf: the logits of 1 and 0")):
        yield _with(ordinary(), f"opacity logits +-{name}", [("opacity_logits", slice(0, 48), size * both)])
    rng = np.random.default_rng(11)
    n = 10_000
    points = rng.normal(scale=(0.02, 0.02, 0), size=(n, 3))
    points[:, 2] = 2 + rng.permutation(n) / n
    small = _camera(width=17, height=13)
    turns, sizes = rng.normal(size=(n, 4)), rng.uniform(0.1, 0.3, (n, 3))
    limit = {"bounds": {"intrinsics": 2e-4, "pose": 2e-4}, "why": CANCELS}
    for name, logits, rest in (
        ("opaque", 10.0, limit),
        ("faint", rng.uniform(-5.4, -5.0, n), {}),
        ("faint below the cut", -5.6, {}),
    ):
        name = f"10,000 {name} in a stack, image of 17x13"
        yield _case(name, points, sizes, turns, logits, camera=small, count=n, **rest)


def depths() -> Iterator[Case]:
    """Ties, the near plane, the edge of the clamp, far away."""
    straight = _camera(STRAIGHT)
    rng = np.random.default_rng(13)
    ties = _cloud(48, 4)
    ties[:, 2] = 2.0
    yield _case("equal depths", ties, rng.uniform(0.1, 0.4, (48, 3)), rng.normal(size=(48, 4)), 2.0, camera=straight)
    near = np.float32(0.01)
    steps = [near, np.nextafter(near, np.float32(1)), np.nextafter(near, np.float32(0)), 0.0, -0.01, -1.0, -1e6, 1e-30]
    z = np.array([*steps, *(near * np.float32(1.0) + np.float32(k) * np.float32(1e-3) for k in range(1, 17))])
    points = np.stack([rng.uniform(-0.4, 0.4, len(z)) * np.abs(z), rng.uniform(-0.4, 0.4, len(z)) * np.abs(z), z], 1)
    sizes, turns = rng.uniform(0.001, 0.01, (len(z), 3)), rng.normal(size=(len(z), 4))
    yield _case("on, behind and just before the near plane", points, sizes, turns, 0.0, camera=straight)
    sizes, turns = rng.uniform(0.2, 0.6, (32, 3)), rng.normal(size=(32, 4))
    beside, on = (_clamp_edge(straight, factors) for factors in ((1 - 1e-4, 1 + 1e-4), (1.0, 1.0)))
    yield _case("beside the clamp's edge", beside, sizes, turns, 0.0, camera=straight)
    yield _case(
        "on the clamp's edge",
        on,
        sizes,
        turns,
        0.0,
        camera=straight,
        bounds={"means": 0.2, "pose": 0.5, "intrinsics": 0.5},
        why="a kink: rounding chooses between the derivatives of its two sides",
    )
    yield _case("1e15 m away", 1e15 * _cloud(48, 6), 1e14 * rng.uniform(0.3, 1, (48, 3)), rng.normal(size=(48, 4)))
    sideways = np.concatenate([_cloud(24, 6), _cloud(24, 6) * (2e38, -2e38, 1)])
    yield _case("half of them 2e38 m aside", sideways, rng.uniform(0.1, 0.3, (48, 3)), rng.normal(size=(48, 4)))


def _clamp_edge(camera: Camera, factors: tuple[float, float]) -> np.ndarray:
    """(32, 3) points whose x/z or y/z is `factors` times the clamp's limit, on all four sides."""
    rows = []
    f, cx, cy = float(camera.fx), float(camera.cx), float(camera.cy)
    low = (-cx / f - 0.15 * camera.width / f, -cy / f - 0.15 * camera.height / f)
    high = ((camera.width - cx) / f + 0.15 * camera.width / f, (camera.height - cy) / f + 0.15 * camera.height / f)
    for k in range(32):
        limit, axis = (low, high)[k % 2], k // 2 % 2
        ratio = np.zeros(2)
        ratio[axis] = limit[axis] * factors[k // 4 % 2]
        ratio[1 - axis] = np.linspace(-0.4, 0.4, 8)[k // 4]
        z = 1.5 + 0.05 * k
        rows.append([*(ratio * z), z])
    return np.array(rows)


def cameras() -> Iterator[Case]:
    """Focal lengths, sizes, principal points."""
    rng = np.random.default_rng(17)
    sizes, turns = rng.uniform(0.03, 0.3, (48, 3)), rng.normal(size=(48, 4))
    wide = _cloud(48, 8, spread=20.0)
    yield _case("focal length 1 px", wide, 20 * sizes, turns, camera=_camera(f=1.0))
    narrow = _cloud(48, 8, spread=0.45 * 45e-5)
    yield _case("focal length 1e5 px, straight pose", narrow, 45e-5 * sizes, turns, camera=_camera(STRAIGHT, f=1e5))
    yield _case(
        "focal length 1e5 px, turned pose",
        narrow,
        45e-5 * sizes,
        turns,
        camera=_camera(f=1e5),
        bounds={"value": 1e-3, **dict.fromkeys(ARGUMENTS, 1e-3)},
        why="a position of metres is known to 1e-7 m, at this focal length 0.01 px",
    )
    aside = _cloud(48, 8) + np.array([1.0, -1.0, 0]) * _cloud(48, 8)[:, 2:] * (100 / 45.0)
    yield _case("principal point outside the image", aside, sizes, turns, camera=_camera(cx=-75.0, cy=119.0))
    for width, height in ((1, 1), (9, 7)):
        yield ordinary(f"image of {width}x{height}", camera=_camera(width=width, height=height))
    yield ordinary("one Gaussian", 1, count=1)
    yield _case("no Gaussian", np.zeros((0, 3)), 1.0, count=0)


def numbers() -> Iterator[Case]:
    """Quaternions and features at the ends of the float range; numbers that are none."""
    length = lambda name, factor: _with(
        ordinary(), name, [("quaternions", slice(0, 48), ordinary().gaussians.quaternions[:48] * np.float32(factor))]
    )
    yield length("quaternions of length 0", 0.0)
    yield length("denormal quaternions, 1e-40", 1e-40)
    yield length("quaternions of length 1e-30", 1e-30)
    yield length("quaternions of length 1e30", 1e30)
    for factor in (1e30, 1e-30, 0.0):
        yield dataclasses.replace(
            ordinary(f"features of {factor:g}"), features=ordinary().features * np.float32(factor)
        )
    bad = [(5, np.nan), (9, np.inf), (14, -np.inf)]
    yield _with(ordinary(), "NaN and infinite means", [("means", (i, i % 3), v) for i, v in bad], bad=3)
    yield _with(ordinary(), "NaN and infinite log scales", [("log_scales", (i, i % 3), v) for i, v in bad[:2]], bad=2)
    yield _with(ordinary(), "NaN and infinite quaternions", [("quaternions", (i, i % 4), v) for i, v in bad], bad=3)
    yield _with(ordinary(), "NaN opacity logit", [("opacity_logits", 5, np.nan)], bad=1)
    everything = ("means", "log_scales", "quaternions", "opacity_logits")
    yield _with(ordinary(), "every second one NaN", [(k, slice(0, 48, 2), np.nan) for k in everything], bad=24)
    yield _with(ordinary(), "NaN and infinite features", [("features", (i, i % 3), v) for i, v in bad], bad=3)


def offsets() -> Iterator[Case]:
    """A scene 1e6 m from the origin: as it is, recentred after float32 took its toll, and recentred before."""
    from jsecon.splat.transform import recentred

    base = ordinary()
    shift = np.array([1e6, -1e6, 1e6])
    gaussians, camera = base.gaussians, base.camera
    pose = np.asarray(camera.world_to_camera, np.float64)
    pose[:3, 3] -= pose[:3, :3] @ shift
    far = dataclasses.replace(gaussians, means=gaussians.means.astype(np.float64) + shift)
    far_camera = dataclasses.replace(camera, world_to_camera=pose)
    stored = dataclasses.replace(far, means=far.means.astype(np.float32))
    stored_camera = dataclasses.replace(far_camera, world_to_camera=pose.astype(np.float32))
    yield dataclasses.replace(
        base,
        name="1e6 m off, as it is",
        gaussians=stored,
        camera=stored_camera,
        bounds={"value": 1.0, **dict.fromkeys(ARGUMENTS, 2.0)},
        why="float32 has steps of 0.06 m at 1e6 m: nothing can be promised; recentre (the next rows)",
    )
    for name, exact in (
        ("1e6 m off, stored in float32, then recentred", (stored, stored_camera)),
        ("1e6 m off, recentred from float64", (far, far_camera)),
    ):
        gaussians, camera, back = recentred(*exact)
        yield dataclasses.replace(
            base, name=name, gaussians=gaussians, camera=camera, exact=exact, origin=tuple(back[:3, 3])
        )


def cases() -> list[Case]:
    """Every row, in the order of the table."""
    return [ordinary(), *shapes(), *opacities(), *depths(), *cameras(), *numbers(), *offsets()]
