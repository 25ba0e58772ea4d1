"""Point clouds: read in every format at coordinates of a map, given to a capture, and written back with labels."""

import sys

import laspy
import numpy as np
import pytest
from capture_files import compute_stage, context_of, refused, run_cli, small_capture, write_transforms
from point_files import OFFSET, WRITERS, las, points_of
from splat_files import write_ply
from test_capture import moved

from jsecon import InputError, load_gaussians
from jsecon.read.splats import point_clouds as cloud_files
from jsecon.read.splats.formats import read_gaussians
from jsecon.read.splats.point_clouds import load_point_cloud, read_crs, save_point_cloud
from jsecon.read.splats.writing import require_writable_format
from jsecon.splat.points import nearest_gaussians
from jsecon.splat.sh import C0


@pytest.mark.parametrize("name", WRITERS)
def test_points_come_where_they_are_in_every_format(tmp_path, name):
    points, colours = points_of()
    step = 2e-6 if name == "a.e57" else 2e-9  # that of its float32; and of a product of whole numbers
    for given in (colours, None):
        WRITERS[name](tmp_path / name, points, given)
        found = load_point_cloud(tmp_path / name)
        np.testing.assert_allclose(found.points, points, rtol=0, atol=step)
        np.testing.assert_array_equal(found.colors, 128 if given is None else given)
        gaussians, notes = read_gaussians(tmp_path / name)
        np.testing.assert_allclose(gaussians.means, points, rtol=0, atol=step)
        np.testing.assert_allclose(0.5 + C0 * gaussians.sh[:, 0], found.colors / 255, atol=1e-6)
        assert notes == ()
    assert read_crs(tmp_path / name) == ("EPSG:25832" if name.endswith(("las", "laz")) else "")


def test_colours_of_other_kinds_and_intensities(tmp_path):
    draw = np.random.default_rng(0)
    xyz, rgb = dict(zip("xyz", draw.normal(size=(3, 50)))), draw.integers(0, 256, (3, 50))
    for kind, factor in (("float", 1 / 255), ("ushort", 257)):
        columns = dict(zip(("red", "green", "blue"), rgb * factor))
        write_ply(tmp_path / "a.ply", xyz | columns, types=dict.fromkeys(columns, kind))
        np.testing.assert_array_equal(load_point_cloud(tmp_path / "a.ply").colors, rgb.T)
    for n, columns in ((4, [rgb[0]]), (6, rgb), (7, [draw.random(50), *rgb])):
        np.savetxt(tmp_path / f"{n}.xyz", np.column_stack([*xyz.values(), *columns]))
        colours = load_point_cloud(tmp_path / f"{n}.xyz").colors
        expected = rgb.T
        if n == 4:
            low, high = np.quantile(rgb[0], [0.01, 0.99])
            grey = np.rint(255 * np.clip((rgb[0] - low) / (high - low), 0, 1))
            expected = np.repeat(grey[:, None], 3, axis=1)
        np.testing.assert_array_equal(colours, expected)
    np.savetxt(tmp_path / "normals.xyz", np.column_stack([*xyz.values(), *draw.normal(size=(3, 50))]))
    np.testing.assert_array_equal(load_point_cloud(tmp_path / "normals.xyz").colors, 128)


def test_many_points_are_thinned_and_each_finds_its_gaussian(tmp_path, monkeypatch):
    monkeypatch.setattr(cloud_files, "MAX_GAUSSIANS", 300)
    side = np.linspace(0, 1, 60)
    points = np.stack([*np.meshgrid(side, side), np.zeros((60, 60))], axis=-1).reshape(-1, 3) + OFFSET
    las(tmp_path / "a.las", points, np.where(points[:, :1] < OFFSET[0] + 0.5, [[255, 0, 0]], [[0, 0, 255]]))
    gaussians, notes = cloud_files.gaussians_of_cloud(tmp_path / "a.las", 300)
    assert 200 < gaussians.count <= 300
    assert "3,600 points of a.las became" in notes[0]
    far = np.append(points, [OFFSET + 9, OFFSET * np.nan], axis=0)
    nearest = nearest_gaussians(far, gaussians)
    assert (nearest[:-2] >= 0).all()
    assert (nearest[-2:] == -1).all()
    assert np.linalg.norm(gaussians.means[nearest[:-2]] - points, axis=1).max() < 0.08


@pytest.mark.parametrize("source", ["a.las", "old.las", "a.laz", "a.e57", "binary.pcd", "a.xyz", "points.ply"])
def test_labels_go_back_in_order_and_place(tmp_path, source):
    points, colours = points_of()
    source = tmp_path / source
    WRITERS[source.name](source, points, colours)
    crs, rows = read_crs(source), np.arange(60)
    ids = {"object_id": rows.astype(np.int32) * 1000 - 1, "class_id": (rows % 4 - 1).astype(np.int32)}
    is_las = source.suffix in (".las", ".laz")
    if not is_las:
        with refused("out.laz", source.name, "Write a .ply"):
            save_point_cloud(tmp_path / "out.laz", source, rows, ids)
    for out in (tmp_path / f"out{suffix}" for suffix in ((".las", ".laz", ".ply") if is_las else (".ply",))):
        save_point_cloud(out, source, rows, ids)
        before, after = load_point_cloud(source), load_point_cloud(out)
        np.testing.assert_allclose(after.points, before.points, rtol=0, atol=0)
        np.testing.assert_array_equal(after.colors, colours)
        assert read_crs(out) == (crs if out.suffix != ".ply" else "")
        if out.suffix == ".ply":
            continue
        written = laspy.read(out)
        for name, column in ids.items():
            np.testing.assert_array_equal(written[name], column)
        given = laspy.read(source)
        np.testing.assert_array_equal(written.points.array["X"], given.points.array["X"])
        np.testing.assert_array_equal(written.gps_time, given.gps_time)
        if source.name != "old.las":  # whose classes have 5 bits
            expected = np.where(ids["class_id"] < 0, 2, 64 + ids["class_id"])
            np.testing.assert_array_equal(written.classification, expected)


def test_a_cloud_gives_a_capture_its_points_and_their_depth(tmp_path):
    """A ball of radius 1 at the middle of a ring of cameras of radius 3, at coordinates of a map."""
    capture, draw = small_capture(4, 48, 32), np.random.default_rng(0)
    write_transforms(moved(capture, 1, OFFSET), tmp_path / "capture")
    ball = draw.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    las(tmp_path / "ball.laz", ball + OFFSET, np.full((4000, 3), (200, 0, 0), np.uint8))
    work = context_of(tmp_path / "capture", tmp_path / "out", points=tmp_path / "ball.laz")
    found = compute_stage(work, "load")[0].value
    centre = np.linalg.inv(found.source_from_scene)[:3, 3] + np.linalg.inv(found.source_from_scene)[:3, :3] @ OFFSET
    np.testing.assert_allclose(np.linalg.norm(found.points - centre, axis=1), 1, atol=2e-3)
    np.testing.assert_array_equal(found.point_colors, np.full((4000, 3), (200, 0, 0)))
    assert found.depths is not None
    train = ~np.asarray(found.held_out)
    np.testing.assert_allclose(found.depths[train, 8, 11], 2, atol=0.1)
    assert not found.depths[~train].any()
    las(tmp_path / "ball.laz", ball + 2 * OFFSET)
    with refused("ball.laz", "in the view of two or more"):
        compute_stage(work, "load")
    assert run_cli("run", tmp_path / "ball.laz", "--points", tmp_path / "ball.laz", "--out", tmp_path / "field") == 2


def test_labels_replace_older_ones_and_points_without_a_place_are_kept_in_a_ply(tmp_path):
    points, colours = points_of()
    las(tmp_path / "a.las", points, colours)
    for n in (1, 2):
        ids = {"object_id": np.full(60, n, np.int32)}
        save_point_cloud(tmp_path / "a.las", tmp_path / "a.las", np.arange(60), ids)
        np.testing.assert_array_equal(laspy.read(tmp_path / "a.las").object_id, n)
    points[3] = np.nan
    WRITERS["binary.pcd"](tmp_path / "a.pcd", points, colours)
    assert read_gaussians(tmp_path / "a.pcd")[0].count == 59
    save_point_cloud(tmp_path / "b.ply", tmp_path / "a.pcd", np.arange(60), ids)
    np.testing.assert_array_equal(load_point_cloud(tmp_path / "b.ply").points, points)
    with refused("a.las", "near the Gaussians"):
        save_point_cloud(tmp_path / "b.las", tmp_path / "a.las", np.arange(0), {})


def test_what_cannot_be_read_is_said(tmp_path, monkeypatch):
    points, colours = points_of()
    for name in ("a.laz", "a.e57", "binary.pcd", "compressed.pcd", "points.ply"):
        file = tmp_path / name
        WRITERS[name](file, points, colours)
        file.write_bytes(file.read_bytes()[: -len(file.read_bytes()) // 3])
        with pytest.raises(InputError, match=f"{name}.*(cut short|damaged)"):
            load_gaussians(file)
    las(tmp_path / "none.las", points, epsg=None)
    for name, content in (("words.txt", "no point\nat all\n"), ("a.xyz", "1 2 3\n4 5\n")):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputError, match=name):
            load_gaussians(tmp_path / name)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(InputError, match=r"needs the package laspy.*jsecon\[formats\]"):
        load_gaussians(tmp_path / "none.las")
    with pytest.raises(InputError, match=r"\.las or \.laz or \.ply"):
        require_writable_format(tmp_path / "a.e57", True)
