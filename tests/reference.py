"""Slow, readable reference: brute force over all Gaussians in NumPy float64. It defines the image."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.numerics import BLUR_PX2, FRUSTUM_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR
from jsecon.types import Camera, Gaussians


def project_reference(gaussians: Gaussians, camera: Camera) -> dict[str, np.ndarray]:
    """Projects Gaussians, one at a time.

    Returns:
      means_px (N, 2), covariances (N, 2, 2) px^2, conics (N, 3) a, b, c of their inverses, depths (N,), opacities (N,)
      and in_front (N,) bool.
    """
    means, log_scales, quaternions, logits = (
        np.asarray(a, np.float64)
        for a in (gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.opacity_logits)
    )
    w2c = np.asarray(camera.world_to_camera, np.float64)
    fx, fy, cx, cy = (float(a) for a in (camera.fx, camera.fy, camera.cx, camera.cy))
    shapes = {"means_px": (2,), "covariances": (2, 2), "conics": (3,), "depths": (), "opacities": ()}
    out = {name: np.zeros((len(means), *shape)) for name, shape in shapes.items()}
    out["in_front"] = np.zeros(len(means), bool)
    for i in range(len(means)):
        x, y, z = w2c[:3, :3] @ means[i] + w2c[:3, 3]
        out["depths"][i], out["in_front"][i] = z, z > NEAR
        out["opacities"][i] = 0.5 * (1 + np.tanh(0.5 * logits[i]))
        if not z > NEAR:
            continue
        out["means_px"][i] = fx * x / z + cx, fy * y / z + cy
        margin_x = (FRUSTUM_MARGIN - 1) * 0.5 * camera.width / fx
        margin_y = (FRUSTUM_MARGIN - 1) * 0.5 * camera.height / fy
        tx = z * np.clip(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
        ty = z * np.clip(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
        jacobian = np.array([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]])
        turned = quaternions[i] if quaternions[i].any() else (1, 0, 0, 0)  # zero turns nothing
        rotation = Rotation.from_quat(turned, scalar_first=True).as_matrix()
        scaled = jacobian @ w2c[:3, :3] @ rotation @ np.diag(np.exp(log_scales[i]))
        covariance = out["covariances"][i] = scaled @ scaled.T + BLUR_PX2 * np.eye(2)
        # det(M M^T + e I) as a sum of positive terms: the width of a needle would cancel, even in float64.
        squares = (np.cross(*scaled) ** 2).sum() + BLUR_PX2 * (scaled**2).sum() + BLUR_PX2**2
        out["conics"][i] = covariance[1, 1] / squares, -covariance[0, 1] / squares, covariance[0, 0] / squares
    return out


def alphas_reference(splats: dict[str, np.ndarray], camera: Camera) -> Iterator[tuple[int, np.ndarray]]:
    """Gives each Gaussian before the camera, front to back, with its alpha (H, W) before any cut."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    for i in np.argsort(splats["depths"], kind="stable"):
        if not splats["in_front"][i]:
            continue
        a, b, c = splats["conics"][i]
        dx, dy = x - splats["means_px"][i, 0], y - splats["means_px"][i, 1]
        yield i, splats["opacities"][i] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))


def weights_reference(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Computes the weight alpha T of every Gaussian at every pixel, (H, W, N); equal depths in index order."""
    splats = project_reference(gaussians, camera)
    weights = np.zeros((camera.height, camera.width, len(splats["depths"])))
    transmittance = np.ones((camera.height, camera.width))
    running = np.ones((camera.height, camera.width), bool)
    for i, alpha in alphas_reference(splats, camera):
        alpha = np.minimum(MAX_ALPHA, alpha)
        alpha = np.where(alpha < MIN_ALPHA, 0.0, alpha)
        running &= transmittance * (1 - alpha) > MIN_TRANSMITTANCE
        weights[..., i] = np.where(running, alpha * transmittance, 0.0)
        transmittance = transmittance - weights[..., i]
    return weights


def render_reference(gaussians: Gaussians, camera: Camera, features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renders features (N, D): the image (H, W, D) and alpha (H, W), float64."""
    weights = weights_reference(gaussians, camera)
    return weights @ np.asarray(features, np.float64), weights.sum(-1)
