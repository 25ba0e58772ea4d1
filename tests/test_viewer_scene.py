"""A field in the viewer's window: what viser holds of it, and what is sent."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra viewer is not installed")
import viser
from small_field import make_field

from jsecon.app.viewer.layer import MAX_STD, SplatLayer


@pytest.fixture(scope="module")
def field(scene, cameras):
    return make_field(scene, cameras)[0]


@pytest.fixture(scope="module")
def server():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def with_gaussians(field, **changes):
    return dataclasses.replace(field, gaussians=dataclasses.replace(field.gaussians, **changes))


def colours(layer, count=64):
    """(N, 4) RGBA as the window has them."""
    told = np.zeros((count, 4), np.uint8)
    for rows, handle in layer._groups:
        told[rows] = np.ascontiguousarray(handle.buffer[:, 7]).view(np.uint8).reshape(-1, 4)
    return told


@pytest.mark.parametrize("size", [1e-4, 1, 300])
def test_the_window_holds_the_field_at_any_size(field, server, size):
    logs = np.asarray(field.gaussians.log_scales) + np.float32(np.log(size))
    layer = SplatLayer(server, with_gaussians(field, means=np.asarray(field.gaussians.means) * size, log_scales=logs))
    seen = np.zeros(64, int)
    for rows, handle in layer._groups:
        seen[rows] += 1
        centres = np.asarray(field.gaussians.means)[rows] * size
        np.testing.assert_allclose(handle.centers / layer.scale, centres, rtol=1e-5)
        spread = handle.covariances.astype(np.float64) / layer.scale**2
        sizes = np.sort(np.exp(2 * logs[rows].astype(np.float64)), axis=1)
        np.testing.assert_allclose(np.linalg.eigvalsh(spread), sizes, rtol=0.03, atol=2e-5 * size**2)
    assert (seen == 1).all()


def test_huge_and_tiny_gaussians_stay_within_what_viser_holds_and_those_not_finite_are_left_out(field, server):
    logs, means = np.array(field.gaussians.log_scales), np.array(field.gaussians.means)
    logs[0], logs[1], means[3] = 20, -40, np.nan
    layer = SplatLayer(server, with_gaussians(field, log_scales=logs, means=means))
    for _, handle in layer._groups:
        assert np.isfinite(handle.centers).all()
        assert np.isfinite(handle.covariances).all()
        assert np.abs(handle.covariances).max() <= 1.001 * MAX_STD**2
    assert layer.scale * np.exp(np.median(logs[np.isfinite(means).all(1)])) == pytest.approx(1, rel=1e-3)
    np.testing.assert_array_equal(np.flatnonzero(colours(layer)[:, 3] == 0), [3])


def test_only_the_groups_that_change_are_sent(field, server, monkeypatch):
    layer = SplatLayer(server, field)
    base, all_seen = layer.photo, np.ones(64, bool)
    sent = []
    layer.paint(base, all_seen)
    queue = server._websock_server.queue_message
    monkeypatch.setattr(server._websock_server, "queue_message", lambda m: (sent.append(m), queue(m))[1])
    layer.paint(base, all_seen)
    assert not [m for m in sent if "Update" in type(m).__name__]
    changed, (rows, _) = base.copy(), layer._groups[2]
    changed[rows[0]] = 255 - changed[rows[0]]
    layer.paint(changed, all_seen)
    assert len([m for m in sent if "Update" in type(m).__name__]) == 1
    np.testing.assert_array_equal(colours(layer)[:, :3], changed)
    layer.paint(base, ~all_seen)
    assert not colours(layer)[:, 3].any()


def test_the_window_starts_at_the_first_frame(field, server):
    layer = SplatLayer(server, field)
    centres = np.asarray(field.cameras.centres) * layer.scale
    assert server.initial_camera.fov == pytest.approx(2 * np.arctan(20 / 43))
    np.testing.assert_allclose(server.initial_camera.position, centres[0], rtol=1e-5)
