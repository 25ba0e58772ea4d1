"""Selections grown, shrunk and combined: laws that any mask obeys, and the options of the command line."""

import dataclasses
import json

import numpy as np
from small_field import make_field

from jsecon.app import cli
from jsecon.field.field import save_field
from jsecon.query import edits
from jsecon.vision.colours import ColourEmbedder


def test_growing_and_shrinking_obey_their_laws():
    rng = np.random.default_rng(0)
    near = edits.mutual_neighbours(rng.normal(size=(300, 3)))
    for _ in range(20):
        mask = rng.random(300) < rng.random()
        grown = np.asarray(edits.grow(mask, near, 2))
        np.testing.assert_array_equal(grown, edits.grow(edits.grow(mask, near), near))
        assert (grown >= mask).all()
        assert (np.asarray(edits.shrink(mask, near)) <= mask).all()
        assert (np.asarray(edits.shrink(grown, near, 2)) >= mask).all()
        assert (np.asarray(edits.grow(edits.shrink(mask, near), near)) <= mask).all()
        np.testing.assert_array_equal(edits.grow(~mask, near), ~np.asarray(edits.shrink(mask, near)))
    np.testing.assert_array_equal(edits.grow(mask, near, 0), mask)


def test_a_shell_is_one_of_neighbours_and_a_floater_has_none():
    line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], axis=1)
    near = edits.mutual_neighbours(np.concatenate([line, [[50, 300, 0]]]))
    mask = np.arange(101) < 20
    grown = np.flatnonzero(edits.grow(mask, near))
    np.testing.assert_array_equal(grown, np.arange(25))  # ten neighbours: five on each side
    assert not np.asarray(edits.grow(np.arange(101) < 100, near))[100]


def test_answers_are_edited_from_the_command_line(scene, cameras, tmp_path, capsys):
    embedder = ColourEmbedder()
    field = dataclasses.replace(make_field(scene, cameras, dim=embedder.dim)[0], embedder=embedder.name)
    save_field(tmp_path / "field.safetensors", field)
    count = {}
    for options in ("", "--grow 1", "--grow 1 --shrink 1", "--shrink 9", "--invert"):
        line = ["query", str(tmp_path / "field.safetensors"), "red", "--out", str(tmp_path / "out"), "--views", "0"]
        assert cli.main([*line, *options.split()]) == 0
        count[options] = json.loads((tmp_path / "out" / "red.json").read_text())["count"]
    assert count["--grow 1"] > count["--grow 1 --shrink 1"] >= count[""] > count["--shrink 9"] == 0
    assert count["--invert"] == field.gaussians.count - count[""]
    assert cli.main([*line, "--grow", "-1"]) == 2
    assert "--grow" in capsys.readouterr().err
