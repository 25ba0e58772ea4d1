"""The catalogue of a small field of known regions: rows, names, parts, files, and exports that follow it."""

import dataclasses
import json
import re

import numpy as np
import pytest
from capture_files import refused, run_cli
from small_field import REGIONS, make_field, shares, true_regions, votes_of
from table_field import UP, table_field

import jsecon
from jsecon import Regions, load_gaussians, save_field
from jsecon.read.splats.ply import read_vertices
from jsecon.vision.colours import ColourEmbedder

EMBEDDER = ColourEmbedder()
COLOURS = ["red", "green", "blue", "orange", "pink"]


@pytest.fixture(scope="module")
def field(scene, cameras):
    """Five slabs of plain colours; a fifth of each lies in the masks of the next one."""
    field, _ = make_field(scene, cameras, dim=EMBEDDER.dim)
    own = true_regions(scene)
    votes = votes_of(np.stack([own, (own + 1) % REGIONS], axis=1), np.tile([8.0, 2.0], (len(own), 1)), REGIONS)
    regions = Regions(EMBEDDER.embed_text([f"plain {colour} thing" for colour in COLOURS]), field.regions.pixel_counts)
    changes = {"embedder": EMBEDDER.name, "unrelated_words": EMBEDDER.unrelated_words.astype(np.float16)}
    field = dataclasses.replace(field, votes=votes, regions=regions, **changes)
    return with_overlap(field)


def with_overlap(field, first=0, second=0, share=1.0):
    """The field, of which a share of two regions is the same."""
    overlap = np.eye(REGIONS, dtype=np.float32)
    overlap[first, second] = overlap[second, first] = share
    return dataclasses.replace(field, votes=dataclasses.replace(field.votes, overlap=overlap))


@pytest.fixture
def file(field, tmp_path):
    save_field(tmp_path / "field.safetensors", field)
    return tmp_path / "field.safetensors"


def test_each_region_is_an_object_with_its_gaussians_and_its_colour(field):
    catalogue = jsecon.objects(field)
    assert sorted(catalogue.names) == sorted(COLOURS[r] for r in range(REGIONS) if catalogue.regions[r] >= 0)
    share = np.stack([shares(field, [r]) for r in range(REGIONS)])
    best = np.where(share.max(0) >= 0.5, catalogue.regions[share.argmax(0)], -1)
    np.testing.assert_array_equal(catalogue.labels, best)
    np.testing.assert_array_equal(catalogue.shapes.count, np.bincount(best[best >= 0]))
    assert (np.diff(catalogue.shapes.count) <= 0).all()
    assert (catalogue.parent == -1).all()
    seen = np.asarray(field.regions.pixel_counts)[int(np.flatnonzero(catalogue.regions == 0)[0])]
    first = catalogue.records()[0]
    assert (first["views"], first["frames"][0]) == ((seen > 0).sum(), field.names[seen.argmax()])


def in_a_row(field, gap, same):
    """The slabs as bricks of length 1 in a row with gaps, of which those of the ids `same` look the same."""
    own = true_regions(field.gaussians)
    embeddings, means = np.array(field.regions.embeddings), np.zeros((len(own), 3), np.float32)
    embeddings[list(same)] = embeddings[same[0]]
    for r in range(REGIONS):
        k = np.arange((own == r).sum())
        along = k // 2 / (k.max() // 2)  # two at each end, so that none is a stray
        means[own == r] = np.stack([r * (1 + gap) + along, 0.05 * (-1.0) ** k, 0.05 * (-1.0) ** (k // 2)], axis=1)
    small = np.full_like(field.gaussians.log_scales, -5)
    gaussians = dataclasses.replace(field.gaussians, means=means, log_scales=small)
    regions = dataclasses.replace(field.regions, embeddings=embeddings)
    return dataclasses.replace(field, gaussians=gaussians, regions=regions)


def test_pieces_are_joined_and_two_of_a_kind_are_not(field):
    field = in_a_row(field, 0.4, (0, 2))
    apart = jsecon.objects(field)
    assert len(set(apart.regions)) == REGIONS
    joined = jsecon.objects(with_overlap(field, 0, 2, 0.4))
    assert joined.regions[0] == joined.regions[2]
    assert len(joined) == len(apart) - 1
    np.testing.assert_array_equal(joined.mask(joined.regions[0]), shares(field, [0, 2]) >= 0.5)


@pytest.mark.parametrize(("gap", "count"), [(0.02, 1), (0.4, 2)])
def test_two_that_look_the_same_and_touch_are_one(field, gap, count):
    catalogue = jsecon.objects(in_a_row(field, gap, (0, 1)))
    assert len(set(catalogue.regions[:2])) == count


def test_a_region_inside_another_is_a_part_and_its_gaussians_are_those_of_the_whole(field):
    plain = jsecon.objects(field)
    found = jsecon.objects(with_overlap(field, 0, 1, 0.35))
    part, whole = found.regions[:2]  # the first has a little less of all masks than the second
    assert found.parent[part] == whole == part - 1
    assert found.parent[whole] == -1
    assert not found.surroundings.any()
    np.testing.assert_array_equal(found.mask(part), plain.mask(plain.regions[0]))
    np.testing.assert_array_equal(found.mask(whole), np.isin(plain.labels, plain.regions[:2]))


def test_what_most_frames_show_whole_comes_first_and_what_few_show_last():
    things = (
        ("red box", (-0.3, 0, 0.1)),
        ("green box", (0.3, 0, 0.1)),
        ("blue box", (1.95, 0, 0.1)),
        ("red box", (0, 0, 0.5)),
    )
    directions = ((0, -2, 0.8), (0.1, -2, 0.8), (-0.1, -2, 0.8), (0, -2.1, 0.8))
    field, embedder = table_field([(*thing, (0.1,) * 3) for thing in things], directions=directions, up=UP)
    pixels = np.array(field.regions.pixel_counts)
    pixels[1, :2], pixels[3, 1:] = 0, 0  # the fourth is shown by one of four frames that see it
    field = dataclasses.replace(field, regions=Regions(field.regions.embeddings, pixels))
    scene = jsecon.Scene(field, embedder)
    catalogue = scene.objects()
    assert catalogue.regions.tolist() == [0, 1, 2, 3]  # the frames' border cuts the third
    assert catalogue.sure.tolist() == [True, True, True, False]
    answer = scene.relate("how many red boxes are there?")
    assert "1 object, perhaps 2" in str(answer)
    assert sorted(found["sure"] for found in answer.as_dict()["relation"]["objects"]) == [False, True]


@pytest.mark.parametrize(("side", "is_background"), [(0.3, [False] * 4), (3.0, [True] * 4)])
def test_what_is_small_beside_the_scene_is_no_background_however_near_the_frames(field, side, is_background):
    """Four cubes around the middle of a floor, whose embeddings say that they fill the frames."""
    own, rng = true_regions(field.gaussians), np.random.default_rng(0)
    means = rng.uniform(-0.5, 0.5, (len(own), 3)) * np.where((own == 4)[:, None], [6.0, 6.0, 0.01], side)
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, -side / 2]], np.float32)
    small = np.full_like(field.gaussians.log_scales, -5)
    gaussians = dataclasses.replace(field.gaussians, means=(means + corners[own]).astype(np.float32), log_scales=small)
    names = [f"{colour} background" for colour in COLOURS]
    regions = dataclasses.replace(field.regions, embeddings=EMBEDDER.embed_text(names))
    found = jsecon.objects(dataclasses.replace(field, gaussians=gaussians, regions=regions))
    wanted = dict(zip(COLOURS, [*is_background, True]))
    assert {str(name).split()[0]: bool(flag) for name, flag in zip(found.names, found.surroundings)} == wanted


def test_names_come_from_the_vocabulary_that_is_given(field):
    catalogue = jsecon.objects(field, ["red floor", "green mug"])
    floor = catalogue.regions[0]
    assert catalogue.names[floor] == "red floor"
    assert catalogue.surroundings[floor]
    assert floor >= (~catalogue.surroundings).sum()
    assert ((catalogue.probability >= 0.5) & (catalogue.probability <= 1)).all()
    for names, words in (([], "no names"), (["mug"], "no colour word")):
        with refused(words):
            jsecon.objects(field, names)


@pytest.mark.parametrize("things", [
    ("dark blue", "light blue", "white"),
    ("purple", "dark purple", "light pink", "grey", "brown", "turquoise", "light green", "black"),
])  # fmt: skip
def test_a_query_selects_what_the_catalogue_names(things):
    """The things' colours are off, as those of masks that reach over the edges are."""
    field, embedder = table_field([(f"{name} box", (0.5 * k, 0, 0.1), (0.1,) * 3) for k, name in enumerate(things)])
    mixed = np.asarray(field.regions.embeddings) + 0.3 * embedder.embed_text(["light grey background"])
    for part in (0.0, 0.6):  # of a neighbour's colour
        rows = mixed + part * np.roll(mixed, 1, axis=0)
        regions = Regions(rows / np.linalg.norm(rows, axis=1, keepdims=True), field.regions.pixel_counts)
        scene = jsecon.Scene(dataclasses.replace(field, regions=regions), embedder)
        answers = {name: scene.ask(name) for name in embedder.vocabulary}
        catalogue = scene.objects()
        names = [str(name) for name, sure in zip(catalogue.names, catalogue.probability) if sure >= 0.5]
        assert len(names) >= (len(things) // 2 if part == 0 else 1)
        assert "absent" not in [answers[name].state for name in names]
        assert [answer.state for answer in answers.values()].count("absent") >= 10
        assert all((answer.state == "absent") == (not answer.mask.any()) for answer in answers.values())
        assert all(answer.as_dict()["state"] == answer.state for answer in answers.values())
        assert all(("it may be absent" in str(answer)) == (answer.state == "unsure") for answer in answers.values())


def test_a_name_that_a_query_finds_absent_is_no_name(field):
    """The one thing among them is nothing like any of the names, so the nearest of them is none of its own."""
    catalogue = jsecon.objects(field, ["black", "dark brown"], EMBEDDER)
    states = [jsecon.Scene(field, EMBEDDER).ask(text).state for text in ("black", "dark brown")]
    assert states == ["absent", "absent"]
    assert (catalogue.probability == 0).all()
    assert set(catalogue.names) <= {"black", "dark brown"}


def test_a_field_without_regions_has_an_empty_catalogue(field):
    none = np.full_like(field.votes.regions, -1)
    votes = dataclasses.replace(field.votes, regions=none, num_regions=0, overlap=np.zeros((0, 0), np.float32))
    regions = Regions(np.zeros((0, EMBEDDER.dim), np.float32), np.zeros((0, 4), np.int32))
    empty = jsecon.objects(dataclasses.replace(field, votes=votes, regions=regions))
    assert (empty.labels == -1).all()
    assert empty.records() == []


def test_the_command_line_writes_a_table_records_and_a_page(field, file, tmp_path, capsys):
    out, names = tmp_path / "out", ["red mug", "green mug", "blue background", "orange mug", "pink mug"]
    regions = dataclasses.replace(field.regions, embeddings=EMBEDDER.embed_text(names))
    field = dataclasses.replace(field, regions=regions)
    save_field(file, field)
    assert run_cli("objects", file, "--out", out) == 0
    printed, page = capsys.readouterr().out, (out / "catalogue.html").read_text()
    listed = json.loads((out / "objects.json").read_text())["objects"]
    catalogue = jsecon.objects(field)
    assert listed == json.loads(json.dumps(catalogue.records()))
    assert listed[-1]["surroundings"]
    assert page.count('class="card"') == len(catalogue)
    assert page.index("<summary>1 more") < page.index(listed[-1]["name"])  # it is folded
    assert all(row["name"] in printed and row["frames"][0] in page for row in listed)


def test_exported_objects_and_labels_are_those_of_the_catalogue(field, file, tmp_path):
    scene, folder = tmp_path / "scene.ply", tmp_path / "objects"
    assert run_cli("export", file, "--out", scene, "--objects", folder) == 0
    catalogue = jsecon.objects(field)
    labels = catalogue.labels
    np.testing.assert_array_equal(read_vertices(scene)["object_id"], labels)
    whole = load_gaussians(scene)
    np.testing.assert_array_equal(whole.means, field.gaussians.means)
    files = sorted(folder.glob("*.ply"))
    assert len(files) == len(catalogue)
    records = json.loads((folder / "labels.json").read_text())["objects"]
    assert (tmp_path / "labels.json").read_text() == (folder / "labels.json").read_text()
    classes = np.array([record["class_id"] for record in records])
    np.testing.assert_array_equal(read_vertices(scene)["class_id"], np.append(classes, -1)[labels])
    assert [record["name"] for record in records] == catalogue.names.tolist()
    assert len({tuple(record["colour"]) for record in records}) == len(records)
    for n, path in enumerate(files):
        assert path.name.startswith(f"{n:03d}-{catalogue.names[n]}")
        np.testing.assert_array_equal(load_gaussians(path).means, np.asarray(whole.means)[labels == n])


def test_a_usda_has_a_prim_for_each_object_to_the_bit(field, file, tmp_path):
    assert run_cli("export", file, "--out", tmp_path / "scene.usda") == 0
    catalogue, found = jsecon.objects(field), {}
    for prim in (tmp_path / "scene.usda").read_text().split("def ParticleField3DGaussianSplat ")[1:]:
        number = int(re.search(r"int object_id = (-?\d+)", prim)[1])
        columns = (re.search(rf"{name} = \[(.*)\]", prim)[1] for name in ("positions", "Coefficients", "opacities"))
        found[number] = [np.array(re.findall(r"[-+.\de]+", column), np.float32) for column in columns]
        if number >= 0:
            name = catalogue.names[number]
            assert prim.startswith(f'"object_{number:03d}_{name}"')
            assert f'string name = "{name}"' in prim
    assert set(found) == set(catalogue.labels)
    for number, (positions, harmonics, opacities) in found.items():
        rows = np.flatnonzero(catalogue.labels == number)
        np.testing.assert_array_equal(positions.reshape(-1, 3), np.asarray(field.gaussians.means)[rows])
        np.testing.assert_array_equal(harmonics.reshape(len(rows), -1, 3), np.asarray(field.gaussians.sh)[rows])
        logits = np.asarray(field.gaussians.opacity_logits, np.float64)[rows]
        np.testing.assert_allclose(opacities, 1 / (1 + np.exp(-logits)), rtol=1e-6)


def test_an_export_of_objects_replaces_those_of_the_last_one_and_nothing_else(field, file, tmp_path):
    folder = tmp_path / "objects"
    assert run_cli("export", file, "--objects", folder) == 0
    assert len(list(folder.glob("*.ply"))) == REGIONS
    first = sorted(folder.glob("*.ply"))[0]
    mine = {"001-scan.ply": b"ply\n", "copy of it.ply": first.read_bytes(), "notes.txt": b"mine"}
    for name, content in mine.items():
        (folder / name).write_bytes(content)
    votes = dataclasses.replace(field.votes, regions=np.where(field.votes.regions > 1, -1, field.votes.regions))
    save_field(file, dataclasses.replace(field, votes=votes))
    assert run_cli("export", file, "--objects", folder) == 0
    written = {path.name for path in folder.glob("*.ply")} - set(mine)
    assert len(written) == 2
    assert set(mine) <= {path.name for path in folder.iterdir()}


def test_options_of_an_export_that_do_not_fit_are_refused(file, tmp_path, capsys):
    for wrong in (
        ["--only", "red", "--without", "red", "--out", tmp_path / "only.ply"],
        ["--only", "red", "--objects", tmp_path / "objects"], [],
    ):  # fmt: skip
        assert run_cli("export", file, *wrong) == 2
        assert "jsecon:" in capsys.readouterr().err
