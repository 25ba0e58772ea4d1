"""The field's file: what goes in comes out, and every broken file is told apart with one clear message."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from small_field import REGIONS, unit_rows

from jsecon import InputError, Regions, check_field, load_field, save_field, train_autoencoder
from jsecon.field import field as module
from jsecon.field.membership import with_overlap
from jsecon.files import read_arrays, write_arrays


@pytest.fixture(scope="module")
def field(field):
    return dataclasses.replace(field, votes=with_overlap(field.votes))


@pytest.fixture
def path(field, tmp_path):
    save_field(tmp_path / "scene.field", field)
    return tmp_path / "scene.field"


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)  # static fields included
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).dtype == np.asarray(y).dtype
        np.testing.assert_array_equal(x, y)


def test_what_goes_in_comes_out_in_equal_bytes_and_without_a_pickle(field, path, tmp_path):
    assert_same(load_field(path), field)
    save_field(tmp_path / "again.field", field)
    assert (tmp_path / "again.field").read_bytes() == path.read_bytes()
    others = load_file(path)
    np.testing.assert_array_equal(others["gaussians.means"], field.gaussians.means)
    assert all(array.dtype.kind in "biuf" for array in others.values())


def with_coder(field):
    coder = train_autoencoder(unit_rows(np.random.default_rng(0), 1, 12), latent=5, key=jax.random.key(0), epochs=1)
    return dataclasses.replace(field, codes=dataclasses.replace(field.codes, autoencoder=coder))


def empty(field):
    def none(a):
        return np.asarray(a)[:0] if np.ndim(a) else np.asarray(a)

    names = "gaussians", "votes", "codes", "regions"
    parts = {name: jax.tree.map(none, getattr(field, name)) for name in names}
    votes = dataclasses.replace(parts["votes"], num_regions=0, overlap=np.zeros((0, 0), np.float32))
    return dataclasses.replace(field, **parts | {"votes": votes})


def bare(field):
    gaussians = dataclasses.replace(field.gaussians, sh=None)
    return dataclasses.replace(field, codes=None, gaussians=gaussians)


def with_tree(field):
    """Of a union and a part."""
    leaf = np.arange(field.gaussians.count, dtype=np.int32) % REGIONS
    tree = np.array([REGIONS, REGIONS, *[-1] * (REGIONS - 1), 0], np.int32)
    of_part = Regions(field.regions.embeddings[:1], field.regions.pixel_counts[:1])
    nodes = np.array([REGIONS + 1], np.int32)
    return dataclasses.replace(field, tree=tree, leaf=leaf, part_regions=of_part, part_nodes=nodes)


@pytest.mark.parametrize("changed", [with_coder, with_tree, empty, bare])
def test_what_a_field_may_have_or_lack_comes_out(field, changed, tmp_path):
    whole = changed(field)
    save_field(tmp_path / "a.field", whole)
    check_field(tmp_path / "a.field")
    assert_same(load_field(tmp_path / "a.field"), whole)


def test_jit_compiles_once_for_fields_of_the_same_shapes(field):
    """Their texts are not compiled for, stay where no trace is, and are not handed on by a compiled function."""
    other = dataclasses.replace(field, names=tuple(f"other {name}" for name in field.names), embedder="another")
    traces = []

    @jax.jit
    def moved(field):
        traces.append((field.names, field.embedder, field.provenance))
        return jax.tree.map(lambda a: a + 1, field)

    results = [moved(field), moved(other)]
    assert traces == [((), "", "{}")]
    assert [(result.names, result.embedder) for result in results] == [((), "")] * 2
    same = jax.tree.map(lambda a: a, other)
    assert (same.names, same.embedder, same.provenance) == (other.names, other.embedder, other.provenance)


def test_fields_that_do_not_fit_together_are_not_written(field, tmp_path):
    votes, codes = field.votes, field.codes
    for match, wrong in (
        ("save_field", {"codes": dataclasses.replace(codes, gaussians=codes.gaussians[:-1])}),
        ("save_field", {"codes": dataclasses.replace(codes, regions=codes.regions[:, :2])}),
        ("save_field", {"names": ("one",)}),
        ("part_nodes", {"part_nodes": np.array([9], np.int32)}),
        ("save_field", {"votes": dataclasses.replace(votes, overlap=np.eye(REGIONS - 1))}),
        ("bfloat16", {"codes": dataclasses.replace(codes, autoencoder=jnp.ones(3, jnp.bfloat16))}),
    ):
        with pytest.raises(ValueError, match=match):
            save_field(tmp_path / "a.field", dataclasses.replace(field, **wrong))
    assert not list(tmp_path.iterdir())  # neither the file nor a temporary one


def fails(path, match, **options):
    with pytest.raises(InputError, match=match) as caught:
        load_field(path, **options)
    assert caught.value.remedy
    assert str(path) in str(caught.value)


def test_a_folder_and_files_of_other_kinds(tmp_path):
    fails(tmp_path, "a folder")
    save_file({"a": np.ones(3)}, tmp_path / "other.safetensors")
    fails(tmp_path / "other.safetensors", "another program")
    for description in ({"format": "something"}, [1, 2], None):
        write_arrays(tmp_path / "foreign.safetensors", {"a": np.ones(3)}, description)
        fails(tmp_path / "foreign.safetensors", "no field")


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.9, 0.9999])
def test_a_file_cut_short(path, share, mapped, monkeypatch):
    monkeypatch.setattr(module, "MAPPED", 0)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    fails(path, "damaged", mapped=mapped)


def rewritten(path, change):
    """The file with its header and arrays changed by `change(header, arrays)`."""
    header, arrays = read_arrays(path)
    change(header, arrays)
    write_arrays(path, arrays, header)


def exchanged(header, record, name, other):
    """A field of one of the header's records is another of its records, whole."""
    fields = header["field"]["fields"]
    fields[record]["fields"][name] = fields[other]


@pytest.mark.parametrize(("change", "match"), [
    (lambda h, a: h.update(version=2), "another version of jsecon"), (lambda h, a: h.pop("field"), "damaged"),
    (lambda h, a: a.update({"codes.regions": a["codes.regions"][:-1]}), "damaged"),
    (lambda h, a: h["field"]["fields"].pop("votes"), "damaged"),
    (lambda h, a: h["field"].update(record="Popen"), "damaged"),
    (lambda h, a: h.update(field={"value": 3}), "no field at its root"),
    (lambda h, a: exchanged(h, "gaussians", "sh", "cameras"), "damaged"),
    (lambda h, a: exchanged(h, "cameras", "fy", "gaussians"), "damaged"),
    (lambda h, a: h["field"]["fields"]["names"].update(value=["one"]), "1 frame names"),
    (lambda h, a: h["field"]["fields"]["votes"]["fields"]["num_regions"].update(value=4), "votes over 4 regions"),
])  # fmt: skip
def test_a_header_that_does_not_fit(path, change, match):
    rewritten(path, change)
    fails(path, match)


def test_what_another_version_has_is_passed_over_and_what_it_lacks_is_none(field, path):
    def add(header, arrays):
        arrays["votes.novel"] = np.ones(7)
        parts = header["field"]["fields"]["votes"]["fields"]
        parts["novel"] = {"array": "votes.novel", "shape": [7], "dtype": "float64"}
        header["field"]["fields"]["meaning"] = {"record": "Meaning", "fields": {"of": {"value": "life"}}}
        arrays["parts.weight"] = np.ones(3, np.float32)  # of `jsecon run --parts` before 0.3.0
        weight = {"array": "parts.weight", "shape": [3], "dtype": "float32"}
        header["field"]["fields"]["parts"] = {"record": "Parts", "fields": {"weight": weight}}

    rewritten(path, add)
    assert_same(load_field(path), field)
    rewritten(path, lambda header, _: header["field"]["fields"]["votes"]["fields"].pop("overlap"))
    assert_same(load_field(path), dataclasses.replace(field, votes=dataclasses.replace(field.votes, overlap=None)))


def test_mapped_columns_are_not_read_until_they_are_asked_for(field, path, monkeypatch):
    monkeypatch.setattr(module, "MAPPED", 0)
    back = load_field(path, mapped=True)
    for x, y in zip(jax.tree.leaves(back), jax.tree.leaves(field), strict=True):
        if y.size == 0:
            continue
        assert isinstance(x, np.memmap)
        assert not x.flags.writeable
        assert x.ctypes.data % x.itemsize == 0
        np.testing.assert_array_equal(x, y)
    check_field(path)
    content = bytearray(path.read_bytes())
    place = content.find(np.asarray(field.votes.weights).tobytes())
    content[place + 5] ^= 0x10
    path.write_bytes(content)
    load_field(path, mapped=True)  # opens: nobody has read that column
    fails(path, "damaged")
    with pytest.raises(InputError, match="damaged"):
        check_field(path)


def test_numbers_that_are_not_finite_are_found_a_piece_at_a_time(path, monkeypatch):
    for name in ("MAPPED", "ROWS"):
        monkeypatch.setattr(module, name, 10)
    rewritten(path, lambda header, arrays: arrays["gaussians.means"].__setitem__((63, 2), np.nan))
    with pytest.raises(InputError, match=r"gaussians\.means with numbers that are not finite"):
        check_field(path)


ALONE = [-1] * REGIONS


@pytest.mark.parametrize(("tree", "leaf", "problem"), [
    (ALONE[1:], -1, "a tree whose nodes"), ([1, *ALONE[1:]], -1, "a tree whose nodes"),
    ([REGIONS, *ALONE[1:]], -1, "a tree whose nodes"), ([-1.0] * REGIONS, -1, "a tree whose nodes"),
    ([REGIONS, *ALONE[1:], 0], -1, "a tree whose nodes"),
    (ALONE, None, "a tree without the smallest nodes"), (ALONE, REGIONS, "beyond"),
])  # fmt: skip
def test_a_tree_that_is_not_of_its_gaussians_is_refused(field, tmp_path, tree, leaf, problem):
    leaf = None if leaf is None else np.full(field.gaussians.count, leaf, np.int32)
    with pytest.raises(ValueError, match=problem):
        save_field(tmp_path / "field.safetensors", dataclasses.replace(field, tree=np.array(tree), leaf=leaf))
