"""The film: a WebP of a quarter of a minute, on a way around what the cameras look at, in which answers light up."""

import numpy as np
from conftest import cameras_of, look_at
from PIL import Image
from small_field import answer_of, make_field, true_regions

from experiments.rooms import film


def ring(angles, radius=2.0, height=0.5):
    poses = [look_at((radius * np.cos(a), radius * np.sin(a), height), (0.1, 0.0, 0.0), up=(0, 0, 1)) for a in angles]
    return cameras_of(poses, (40, 40, 16, 12), 32, 24)


def angles_of(cameras):
    away = np.asarray(cameras.centres) - [0.1, 0, 0]
    return np.unwrap(np.arctan2(away[:, 1], away[:, 0])), away


def test_the_way_is_a_whole_turn_around_what_the_cameras_look_at():
    path = film.orbit(ring(np.linspace(0, 2 * np.pi, 12, endpoint=False) + 2.0), 60)
    turn, away = angles_of(path)
    assert np.abs(np.abs(np.diff(turn)).sum() - 2 * np.pi * 59 / 60) < 0.35
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), np.linalg.norm(away[0]), rtol=0.1)
    rotations = np.asarray(path.world_to_camera)[:, :3, :3]
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-4)
    aim = np.einsum("tij,j->ti", rotations, np.array([0.1, 0, 0])) + np.asarray(path.world_to_camera)[:, :3, 3]
    assert (np.abs(aim[:, :2]) < 0.15 * aim[:, 2:]).all()
    assert (rotations[:, 1, 2] < 0).all()  # upright: the image's y goes down


def test_an_answer_is_dark_before_its_turn_and_bright_after(scene, cameras, tmp_path, monkeypatch):
    monkeypatch.setattr(film, "SECONDS", 2)
    field, _ = make_field(scene, cameras)
    answers = [answer_of(field, f"slab {region}", true_regions(scene) == region) for region in (1, 3)]
    size = film.write_film(field, answers, tmp_path / "film.webp")
    assert size == (tmp_path / "film.webp").stat().st_size < 2 * 2**20
    with Image.open(tmp_path / "film.webp") as found:
        assert (found.n_frames, found.size) == (16, (96, 80))  # twice the frames' size
        frames = []
        for t in range(found.n_frames):
            found.seek(t)
            frames.append(np.asarray(found.convert("RGB"), float).mean())
    # Bright at first, dark but for nothing as the first answer's turn comes, then brighter with each.
    assert frames[0] > frames[-1] > frames[5]
