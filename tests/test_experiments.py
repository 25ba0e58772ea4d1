"""The adapters of the experiments: the layouts that are one of a kind, and what the real captures say about
conventions."""

import dataclasses

import cv2
import jax
import numpy as np
import pytest
from scipy import sparse
from small_field import make_field

from experiments import (
    apc_bin,
    beyond,
    default_vision,
    outliers,
    replica_apartment_0 as replica,
    scenes,
    state,
    thresholds,
)
from jsecon.errors import InputError
from jsecon.fit.initialise import gaussians_from_points, points_from_depth
from jsecon.types import Camera, Capture
from jsecon.vision.simulated import SimulatedMasks

CAMERAS = """# Environment: shelf
# Color camera intrinsic matrix
 600 0 31.5
 0 601 23.5
 0 0 1

# Depth camera intrinsic matrix
 1 0 0
 0 1 0
 0 0 1

# Camera-to-world extrinsic matrix (camera pose) for frame-000000
 1 0 0 0.5
 0 1 0 0
 0 0 1 -1
 0 0 0 1

# Camera-to-world extrinsic matrix (camera pose) for frame-000001
 0 0 1 2
 0 1 0 0
 -1 0 0 0
 0 0 0 1
"""


def encode_depth(metres):
    value = np.rint(np.asarray(metres) * 10_000).astype(np.uint16)
    return ((value << 3) | (value >> 13)).astype(np.uint16)


@pytest.fixture
def apc_folder(tmp_path):
    (tmp_path / "segm").mkdir()
    (tmp_path / "cam.info.txt").write_text(CAMERAS)
    for t in range(2):
        name = f"frame-{t:06d}"
        color = np.zeros((48, 64, 3), np.uint8)
        color[..., 2] = 200  # red, as OpenCV writes it
        segment = np.zeros((48, 64), np.uint8)
        segment[10:20, 5:9] = 114
        depth = np.full((48, 64), 1.2345)
        depth[:4] = 0.1
        cv2.imwrite(str(tmp_path / f"{name}.color.png"), color)
        cv2.imwrite(str(tmp_path / f"{name}.depth.png"), encode_depth(depth))
        cv2.imwrite(str(tmp_path / "segm" / f"{name}.segm.png"), segment)
    return tmp_path


def test_apc_scene_is_read_as_documented(apc_folder):
    capture, labels = apc_bin.load_apc(apc_folder, held_out_every=2, nearest_m=0.2)
    assert capture.names == ("frame-000000", "frame-000001")
    np.testing.assert_array_equal(capture.held_out, [False, True])
    np.testing.assert_array_equal(capture.frames[0, 0, 0], [200, 0, 0])
    np.testing.assert_allclose(capture.depths[:, 4:], 1.2345, atol=1e-4)
    assert not capture.depths[:, :4].any()  # nearer than the sensor measures
    np.testing.assert_allclose(capture.cameras.centres, [[0.5, 0, -1], [2, 0, 0]], atol=1e-6)
    np.testing.assert_allclose([capture.cameras.cx[0], capture.cameras.cy[0]], [32, 24])  # integer centres become + 0.5
    assert (labels[0, 10:20, 5:9] == list(apc_bin.OBJECTS).index(114)).all()
    assert (labels == 4).sum() == 2 * (48 * 64 - 40)


def test_apc_depth_survives_its_encoding():
    metres = np.random.default_rng(0).uniform(0, 6.5, 1000)
    np.testing.assert_allclose(apc_bin.decode_depth(encode_depth(metres)), metres, atol=6e-5)


def test_apc_scene_without_cameras_or_images_is_refused(apc_folder):
    with pytest.raises(InputError, match="intrinsic"):
        apc_bin.parse_cameras("# Color camera intrinsic matrix\n 1 0 0\n")
    (apc_folder / "frame-000001.depth.png").unlink()
    with pytest.raises(InputError, match="depth"):
        apc_bin.load_apc(apc_folder, held_out_every=2, nearest_m=0.2)
    with pytest.raises(InputError, match=r"cam\.info"):
        apc_bin.load_apc(apc_folder / "nowhere", held_out_every=2, nearest_m=0.2)


def test_palette_is_forty_colours_read_back_exactly():
    assert len(set(replica.PALETTE)) == 40
    ids = np.random.default_rng(0).integers(0, 40, (30, 40))
    rgb = np.stack([replica.PALETTE[ids] >> 16, replica.PALETTE[ids] >> 8 & 255, replica.PALETTE[ids] & 255], -1)
    np.testing.assert_array_equal(replica.ids_of_colors(rgb.astype(np.uint8), "x"), ids)
    rgb[3, 4] = [1, 2, 3]
    with pytest.raises(InputError, match="010203"):
        replica.ids_of_colors(rgb.astype(np.uint8), "x")


def test_replica_poses_turn_from_opengl_to_opencv():
    half = np.sqrt(0.5)
    poses = np.array([[1.0, 2, 3, 1, 0, 0, 0], [1, 2, 3, half, 0, half, 0]])  # the second turned 90 degrees about y
    w2c = replica.world_to_camera(poses)
    ahead = np.array([[1.0, 2, 1, 1], [-1, 2, 3, 1]])  # an OpenGL camera looks along -z; turned about y, along -x
    for matrix, point in zip(w2c, ahead, strict=True):
        np.testing.assert_allclose(matrix @ point, [0, 0, 2, 1], atol=1e-6)
        np.testing.assert_allclose((matrix @ (point + np.array([0, 1, 0, 0])))[:3], [0, -1, 2], atol=1e-6)  # up is -y


def test_replica_views_agree_on_depth_and_label(shared):
    """Half a pixel, the sign of an axis or the order of a quaternion would show here."""
    folder = shared / "captures" / "replica_apartment_0"
    poses = np.load(folder / "GT_pose.npy")
    few = np.array([0, 3, 6])
    w2c = replica.world_to_camera(poses[few]).astype(np.float64)
    depth = [cv2.imread(str(folder / "depth" / f"{t + 1}.png"), -1) / 25.5 for t in few]
    labels = [replica.ids_of_colors(cv2.imread(str(folder / "semantic" / f"{t + 1}.png"))[..., ::-1], t) for t in few]
    row, column = np.divmod(np.arange(0, 512 * 512, 37), 512)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        z = depth[a][row, column]
        camera = np.stack([(column + 0.5 - 256) / 256 * z, (row + 0.5 - 256) / 256 * z, z], axis=1)
        world = (camera - w2c[a, :3, 3]) @ w2c[a, :3, :3]
        seen = world @ w2c[b, :3, :3].T + w2c[b, :3, 3]
        x, y = (256 * seen[:, i] / np.maximum(seen[:, 2], 1e-9) + 256 for i in (0, 1))
        inside = (z > 0) & (seen[:, 2] > 0.1) & (x >= 0) & (x < 512) & (y >= 0) & (y < 512)
        x, y = x[inside].astype(int), y[inside].astype(int)
        near = np.abs(depth[b][y, x] - seen[inside, 2]) < 0.05
        assert inside.sum() > 500
        assert near.mean() > 0.9
        assert (labels[b][y, x] == labels[a][row, column][inside])[near].mean() > 0.97


@pytest.mark.slow
def test_apc_small_voxels_select_an_object(shared):
    """The whole chain on five views of the real bin, coarse enough to be quick; the figure itself is the
    experiment's."""
    options = apc_bin.Options(voxel_m=0.008, scale=0.8)
    folder = shared / "captures" / "apc_bin" / "scene-0000"
    capture, labels = apc_bin.load_apc(folder, held_out_every=options.held_out_every, nearest_m=options.nearest_m)
    few = np.array([5, 6, 7, 8, 9])
    capture = dataclasses.replace(
        capture,
        frames=capture.frames[few],
        cameras=capture.cameras[few],
        depths=capture.depths[few],
        held_out=few == 7,
        names=tuple(capture.names[t] for t in few),
    )
    gaussians = apc_bin.build_gaussians(capture, options)
    field = apc_bin.build_field(gaussians, capture, labels[few])
    rows, _ = apc_bin.evaluate(field, capture, labels[few], options, ways=("votes",))
    assert [r["object"] for r in rows] == list(apc_bin.OBJECTS.values())
    assert np.mean([r["iou"] for r in rows]) > 0.5
    assert all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(gaussians))


@pytest.fixture
def two_objects():
    """Two objects of 30 Gaussians and 20 of the wall in six views; the tracker gave their masks each other's id in the
    last view. (sight, evidence, truth)"""
    truth = np.repeat([0, 1, -1], [30, 30, 20])
    votes, pixels = np.zeros((80, 12)), np.full((6, 2), 100)
    embeddings = np.zeros((6, 2, 3))
    for t in range(6):
        ids = (1, 0) if t == 5 else (0, 1)
        for k, r in enumerate(ids):
            votes[truth == k, 2 * t + r] = 1
            embeddings[t, r] = np.eye(3)[k]
    sight = scenes.Sight(
        SimulatedMasks(np.zeros((6, 1, 1), np.int16), np.arange(2)), embeddings, pixels, np.eye(3)[:2], np.eye(3)
    )
    return sight, scenes.Evidence(sparse.csr_matrix(votes), np.ones((80, 6)), np.ones(80), 0.0), truth


def test_ideas_answer_what_the_votes_say(two_objects):
    sight, proof, truth = two_objects
    ids, ok = np.tile([0, 1], 6), np.ones(12, bool)
    plain = state.State(sight, proof, ids, ok, 2)
    groups = plain.joined(plain.anchors(sight.texts))
    assert [list(g) for g in groups] == [[0], [1]]
    assert plain.anchors(sight.texts, sight.canonical).tolist() == [0, 1]
    np.testing.assert_allclose(plain.shares(groups)[0][[0, 30, 60]], [5 / 6, 1 / 6, 0])
    assert state.point_miou(plain.leads(groups), truth) == 1
    assert not any(u.any() for u in beyond.ambiguous(plain, groups))
    kept = beyond.consistent(sight, plain)
    assert not kept.ok[10:].any()
    assert kept.ok[:10].all()  # F drops the two masks that were swapped
    np.testing.assert_allclose(kept.posteriors(groups)[0][[0, 30, 60]], [1, 0, 0])
    agreed = state.State(sight, proof, beyond.agree(proof.votes, ids), ok, 2)
    np.testing.assert_allclose(agreed.shares(groups)[0][[0, 30, 60]], [1, 0, 0])
    assert [list(g) for g in beyond.by_gap(plain, sight.texts)] == [[0], [1]]


def test_point_miou_is_over_the_objects_that_points_belong_to():
    truth = np.array([0, 0, 1, -1])
    masks = [np.array([1, 0, 0, 1], bool), truth == 1, np.ones(4, bool)]
    assert state.point_miou(masks, truth) == pytest.approx((1 / 3 + 1) / 2)


def test_higher_thresholds_select_less(scene, cameras):
    field, _ = make_field(scene, cameras)
    texts = field.regions.embeddings
    asked = field.region_codes
    low, high = (thresholds.ask(field, "d=8", texts, asked, asked[:2], t) for t in (0.4, 0.7))
    assert len(low) == 6
    for name, masks in low.items():
        assert (high[name] <= masks).all()
        assert masks.any()


def test_outlier_options_only_take_away():
    points = outliers.made_points(3000)
    np.testing.assert_array_equal(points, outliers.made_points(3000))
    mask = np.arange(3000) % 3 == 0
    for clean in outliers.cleaners(points.astype(np.float32), outliers.Options()).values():
        assert (clean(mask) <= mask).all()


@pytest.fixture
def flat_capture():
    """Two views, one beside the other, of a plane at 1 m; no depth in a corner of the first."""
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    poses[1, 1, 3] = 0.02
    lens = [np.full(2, number, np.float32) for number in (40, 40, 20, 20)]
    depths = np.ones((2, 40, 40), np.float32)
    depths[0, 36:, 36:] = 0
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    frames = np.zeros((2, 40, 40, 3), np.uint8)
    cameras = Camera(poses, *lens, width=40, height=40)
    return Capture(frames, cameras, *nothing, np.zeros(2, bool), depths, np.eye(4), ("a", "b"))


def test_masklets_are_scored_by_outline_and_by_how_long_an_id_lasts():
    truth = np.full((3, 10, 10), -1, np.int32)
    truth[:, :5, :4], truth[:, 5:, :] = 0, 1
    assert default_vision.score(truth, truth) == (1.0, 1.0)
    renamed = truth.copy()
    renamed[2][truth[2] == 0] = 7  # object 0: the id lasts in two of three views
    assert default_vision.score(renamed, truth) == (1.0, pytest.approx((2 / 3 + 1) / 2))
    half = truth.copy()
    half[:, 5:, 5:] = -1  # object 1: half of it, in every view
    assert default_vision.score(half, truth) == (pytest.approx(0.75), 1.0)
    assert default_vision.score(np.full_like(truth, -1), truth) == (0.0, 0.0)


def test_an_id_in_two_places_is_two_objects(flat_capture):
    ids = np.zeros((2, 40, 40), np.int16)
    ids[:, :, :10] = ids[:, :, 30:] = 1
    ids[0, 20, 12] = 1  # a speck: of the part next to it
    ids[1, 5, 5] = -1
    parts = default_vision.connected_parts(flat_capture, ids, voxel=0.1)
    assert len(np.unique(parts[parts >= 0])) == 3
    assert parts[1, 5, 5] == parts[0, 39, 39] == -1  # no id, no depth
    for t in range(2):
        left, middle, right = parts[t, 20, 3], parts[t, 20, 20], parts[t, 20, 35]
        np.testing.assert_array_equal(parts[t][2:35, :10][ids[t][2:35, :10] == 1], left)
        np.testing.assert_array_equal(parts[t][:, 13:30], middle)
        np.testing.assert_array_equal(parts[t][:30, 30:], right)
    assert parts[0, 20, 12] == parts[1, 20, 3]


@pytest.mark.slow
def test_a_stopped_measurement_goes_on(flat_capture, tmp_path, monkeypatch, capsys):
    """The cells that are there are read; what is measured is two views of a plane, half of it another colour."""
    truth = np.zeros((2, 40, 40), np.int32)
    truth[:, :, 20:] = 1
    flat_capture.frames[..., 0] = np.where(truth, 250, 20)
    seen = []

    def scene(folder):
        seen.append(folder)
        points = points_from_depth(flat_capture, voxel=0.05)
        return flat_capture, gaussians_from_points(points.points, points.colors), {"objects": truth}

    monkeypatch.setattr(default_vision, "replica", scene)
    options = default_vision.Options(seeds=(), capture=str(tmp_path), out=str(tmp_path / "out"))
    found = default_vision.main(options)
    assert len(seen) == 2  # Algorithm 1 after the others
    for cell in found["replica_apartment_0"].values():
        assert cell["objects"]["best_iou"] > 0.8
    default_vision.cell_of(options, "replica_apartment_0", default_vision.FLOW).unlink()
    again = default_vision.main(options)
    assert len(seen) == 3
    assert {way: cell["objects"] for way, cell in again["replica_apartment_0"].items()} == {
        way: cell["objects"] for way, cell in found["replica_apartment_0"].items()
    }
    assert "replica_apartment_0" in (tmp_path / "out" / "table.md").read_text()


def test_optical_flow_carries_an_id_along():
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(rng.integers(0, 255, (60, 120, 3)).astype(np.uint8), (0, 0), 1.5)
    frames = np.stack([wide[:, t : t + 80] for t in (0, 3, 6)])
    single = np.full((3, 60, 80), -1, np.int32)
    for t, left in enumerate((40, 37, 34)):
        single[t, 20:40, left : left + 20] = t
    labels = default_vision.by_flow(frames, single)
    assert [np.unique(labels[t][single[t] >= 0]).tolist() for t in range(3)] == [[0]] * 3
    away = single.copy()
    away[2] = np.where(np.roll(single[2], -30, axis=1) >= 0, 2, -1)  # somewhere else: another thing
    assert np.unique(default_vision.by_flow(frames, away)[2]).tolist() == [-1, 3]
