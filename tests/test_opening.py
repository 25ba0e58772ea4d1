"""What is given for a field: its file, its folder, or a splat; anything else is named by what it is."""

import pytest
from capture_files import refused, run_cli
from small_field import colour_field

import jsecon
from jsecon import InputError, save_field
from jsecon.app.opening import locate_field, name_fields
from jsecon.pipeline import run as pipeline


@pytest.fixture(scope="module")
def folder(scene, cameras, tmp_path_factory):
    """A run's folder with its field."""
    folder = tmp_path_factory.mktemp("desk")
    save_field(folder / "field.safetensors", colour_field(scene, cameras))
    return folder


@pytest.mark.parametrize(("name", "content", "words"), [
    ("report.html", b"<!DOCTYPE html><html>", "a page of HTML"), ("a.json", b' {"frames": []}', "of another kind"),
    ("field.npz", b"PK\3\4" + bytes(99), "a zip archive"), ("scene.dat", b"ply\nformat", "a file of another kind"),
    ("a.bin", b"", "an empty file"),
    ("field.safetensors", b"version https://git-lfs.github.com/spec/v1\noid", "a Git LFS pointer"),
])  # fmt: skip
def test_what_is_no_field_is_named_by_what_it_is(tmp_path, capsys, name, content, words):
    (tmp_path / name).write_bytes(content)
    with refused(tmp_path / name, words):
        locate_field(tmp_path / name)
    assert run_cli("objects", tmp_path / name) == 2
    told = capsys.readouterr().err
    assert words in told
    assert "damaged" not in told


def test_what_is_missing_is_told(tmp_path):
    (tmp_path / "capture" / "images").mkdir(parents=True)
    with refused(tmp_path / "capture", "a folder without field.safetensors", "jsecon run"):
        locate_field(tmp_path / "capture")
    for name in ("nowhere.safetensors", "nowhere.ply"):
        with refused(tmp_path / name, "no such file"):
            jsecon.open_scene(tmp_path / name)


def test_fields_of_one_name_have_names_that_tell_them_apart(folder, tmp_path):
    paths = []
    for name in ("a/field", "b/field", "c"):
        (tmp_path / name).mkdir(parents=True)
        save_field(tmp_path / name / "field.safetensors", jsecon.load_field(folder / "field.safetensors"))
        paths.append(tmp_path / name)
    for name in ("d/point_cloud.ply", "e/point_cloud.ply", "f/garden.splat"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_bytes(b"ply")
        paths.append(tmp_path / name)
    named = name_fields(paths)
    assert list(named) == ["a/field", "b/field", "c", "d/point_cloud", "e/point_cloud", "garden"]
    assert list(named.values()) == paths
    with pytest.raises(InputError, match="given twice"):
        name_fields([paths[0], paths[0] / "field.safetensors"])


@pytest.mark.parametrize("given", ["folder", "splat"])
def test_every_verb_takes_a_folder_or_a_splat(folder, tmp_path, capsys, monkeypatch, given):
    """The field of a splat is made once, beside it, as query makes it."""
    field = jsecon.load_field(folder / "field.safetensors")
    jsecon.save_gaussians(tmp_path / "desk.ply", field.gaussians)
    made = []

    def run(options, out, console):
        made.append(options.capture)
        save_field(out / "field.safetensors", field)

    monkeypatch.setattr(pipeline, "run", run)
    monkeypatch.setattr(pipeline, "current_field", lambda options, out: out / "field.safetensors" if made else None)
    path, home = (folder, folder) if given == "folder" else (tmp_path / "desk.ply", tmp_path / "desk_field")
    (tmp_path / "labels").mkdir()
    assert run_cli("objects", path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert run_cli("export", path, "--objects", tmp_path / "objects") == 0
    files = list((tmp_path / "objects").glob("*.ply"))
    assert len(files) == sum("Gaussians" in line for line in lines if " at (" in line)
    assert run_cli("view", path, "--export", tmp_path / "page.html") == 0
    assert run_cli("eval", path, "--labels", tmp_path / "labels") == 2
    assert "labels" in capsys.readouterr().err
    assert (home / "field.safetensors").is_file()
    assert made == ([] if given == "folder" else [path])
    assert jsecon.open_scene(path).name == (folder.name if given == "folder" else "desk")
