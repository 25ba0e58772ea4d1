"""The stage cache: what is kept comes back as it was, keys follow what matters, damage costs time and nothing else."""

import dataclasses
import os
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jsecon import Autoencoder, InputError
from jsecon.files import unpack_tree
from jsecon.pipeline import cache
from jsecon.pipeline.results import Stage, StageResult


def _tree(scene, cameras):
    return {
        "scene": scene,
        "cameras": cameras,
        "pair": (np.arange(3, dtype=np.int16), None),
        "list": [1, 2.5, "x", True],
        "coder": Autoencoder({"params": {"Dense_0": {"kernel": np.ones((4, 2), np.float32)}}}, {}),
        "nan": float("nan"),
        "empty": np.zeros((0, 3)),
        "outcome": StageResult(np.ones(2, bool), ("a note",)),
    }


def _same(a, b):
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            _same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for name in a:
            _same(a[name], b[name])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            _same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b or (a != a and b != b)


def test_what_is_kept_comes_back_and_equal_values_give_equal_bytes(scene, cameras, tmp_path):
    tree = _tree(scene, cameras)
    for name in ("a.safetensors", "b.safetensors"):
        cache.save(tmp_path / name, _tree(scene, cameras))
    _same(cache.load(tmp_path / "a.safetensors")[0], tree)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_fresh_and_cached_are_the_same_numpy_trees(tmp_path):
    def compute():
        return {"a": jnp.arange(4.0), "b": (jnp.int32(3), "text")}

    fresh = cache.fetch(tmp_path / "stage-0.safetensors", compute)
    again = cache.fetch(tmp_path / "stage-0.safetensors", lambda: pytest.fail("computed twice"))
    assert (fresh[2], again[2]) == (True, False)
    assert isinstance(fresh[0]["a"], np.ndarray)
    _same(fresh[:2], again[:2])


@pytest.mark.parametrize("damage", [
    lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[:200] + bytes(64) + data[264:],
    lambda data: b"no archive at all",
], ids=["cut", "empty", "overwritten", "other"])  # fmt: skip
def test_a_damaged_file_is_said_and_computed_again(tmp_path, damage):
    value = np.random.default_rng(0).normal(size=500)
    cache.fetch(tmp_path / "stage-k.safetensors", lambda: value)
    path = tmp_path / "stage-k.safetensors"
    path.write_bytes(damage(path.read_bytes()))
    said = []
    kept, _, fresh = cache.fetch(tmp_path / "stage-k.safetensors", lambda: value, note=said.append)
    assert fresh
    np.testing.assert_array_equal(kept, value)
    assert len(said) == 1
    assert "stage is computed again" in said[0]
    assert not cache.fetch(tmp_path / "stage-k.safetensors", lambda: value)[2]


def test_a_failed_computation_leaves_nothing_behind(tmp_path):
    def fail():
        raise InputError("x", problem="a", expected="b", remedy="c")

    with pytest.raises(InputError):
        cache.fetch(tmp_path / "stage-k.safetensors", fail)
    assert list(tmp_path.iterdir()) == []


def test_pickles_are_neither_written_nor_read_and_only_records_of_jsecon_are_made(tmp_path):
    with pytest.raises(ValueError, match=r"root\.a: got builtins\.object .* expected plain numbers"):
        cache.save(tmp_path / "x.safetensors", {"a": object()})
    np.savez(tmp_path / "y.npz", a=np.array([object()], object), allow_pickle=True)
    with pytest.raises(cache.CorruptCacheError):
        cache.load(tmp_path / "y.npz")
    for record in ("os:system", "jsecon.pipeline.cache:fetch", "jsecon.files:Path"):
        with pytest.raises((ValueError, AttributeError)):
            unpack_tree({"record": record, "fields": {}}, {})


def test_keys_follow_stage_and_parts():
    def key(name, **options):
        return Stage(name, "", lambda given: StageResult(None), key_options=options).key({}, Path())

    assert key("votes", a=1, b=[2, None]) == key("votes", b=[2, None], a=1)
    assert len({key("votes", a=1, b=[2, None]), key("codes", a=1, b=[2, None]), key("votes", a=1, b=[3, None])}) == 3


def test_files_digest_follows_names_sizes_and_times(tmp_path):
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "a.png").write_bytes(b"one")
    first = cache.files_digest([folder])
    assert first == cache.files_digest([folder])
    os.utime(folder / "images" / "a.png", ns=(0, 1))
    second = cache.files_digest([folder])
    (folder / "images" / "a.png").write_bytes(b"four")
    third = cache.files_digest([folder])
    (folder / "images" / "b.png").write_bytes(b"one")
    assert len({first, second, third, cache.files_digest([folder])}) == 4


def test_files_digest_passes_over_what_goes_while_it_looks(tmp_path, monkeypatch):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"one")
    left, is_file = cache.files_digest([tmp_path / "b.png"]), Path.is_file

    def goes(path):
        found = is_file(path)
        if path.name == "a.png":
            path.unlink(missing_ok=True)
        return found

    monkeypatch.setattr(Path, "is_file", goes)
    assert cache.files_digest([tmp_path]) == left


def test_files_digest_leaves_out_the_output_and_hidden_files_but_not_a_capture_in_the_output(tmp_path):
    capture, out = tmp_path / "out" / "capture", tmp_path / "out"
    (tmp_path / "a.png").write_bytes(b"one")
    before = cache.files_digest([tmp_path], exclude=out)
    capture.mkdir(parents=True)
    (capture / "a.png").write_bytes(b"one")
    (tmp_path / ".DS_Store").write_bytes(b"x")
    assert cache.files_digest([tmp_path], exclude=out) == before
    before = cache.files_digest([capture], exclude=out)
    assert before == cache.files_digest([capture], exclude=tmp_path / "elsewhere")
    (capture / "a.png").write_bytes(b"other")
    assert cache.files_digest([capture], exclude=out) != before


def test_files_digest_of_names_that_are_no_utf8_and_of_linked_folders(tmp_path):
    for name in (b"Gr\xf6\xdfe.png", "Größe #1 50% 🐱.png".encode()):
        (tmp_path / os.fsdecode(name)).write_bytes(b"one")
    before = cache.files_digest([tmp_path])
    assert cache.files_digest([tmp_path / os.fsdecode(b"Gr\xf6\xdfe.png")]) != before
    (tmp_path / "elsewhere" / "deep").mkdir(parents=True)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "images").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "deep" / "round").symlink_to(tmp_path / "elsewhere")
    before = cache.files_digest([tmp_path / "capture"])
    (tmp_path / "elsewhere" / "deep" / "a.png").write_bytes(b"one")
    assert cache.files_digest([tmp_path / "capture"]) != before


def test_a_key_follows_the_source_that_a_stage_can_import_and_no_other(tmp_path, monkeypatch, request):
    package = shutil.copytree(cache.PACKAGE, tmp_path / "jsecon", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(cache, "PACKAGE", package)
    request.addfinalizer(cache.source_digest.cache_clear)

    def digest():
        cache.source_digest.cache_clear()
        return cache.source_digest()

    before = digest()
    assert digest() == before

    def changed(file):
        """Whether the digest differs when a file has one more line."""
        text = (package / file).read_bytes()
        (package / file).write_bytes(text + b"# more\n")
        differs = digest() != before
        (package / file).write_bytes(text)
        return differs

    behind = ("app/viewer/window.py", "query/answer.py", "evaluate/lerf.py", "demo/demo.py")
    assert not any(changed(file) for file in behind)
    ahead = (
        "association/consensus.py",
        "networks/sam2.py",
        "read/captures/colmap.py",
        "types.py",
        "pipeline/stages.py",
    )
    assert all(changed(file) for file in ahead)


def test_prepare_marks_the_folder_and_sweeps_what_killed_writers_left(tmp_path):
    old, young = tmp_path / ".a.0.partial.safetensors", tmp_path / ".b.0.partial.safetensors"
    to_come = tmp_path / ".c.0.partial.safetensors"  # written before the clock was set back
    for path in (old, young, to_come):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    os.utime(to_come, (2**32, 2**32))
    cache.prepare(tmp_path)
    assert not old.exists()
    assert not to_come.exists()
    assert young.exists()
    assert (tmp_path / "CACHEDIR.TAG").read_text().startswith("Signature: 8a477f597d28d172789f06886806bc55")


def test_large_arrays_are_mapped_and_a_damaged_one_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "MAPPED", 1000)
    value = {"large": np.arange(3000, dtype=np.float32).reshape(30, 100), "small": np.arange(5)}
    cache.save(tmp_path / "kept.safetensors", value)
    found, _ = cache.load(tmp_path / "kept.safetensors")
    assert isinstance(found["large"], np.memmap)
    assert not isinstance(found["small"], np.memmap)
    for name, array in value.items():
        np.testing.assert_array_equal(found[name], array)
    content = bytearray((tmp_path / "kept.safetensors").read_bytes())
    content[content.index(value["large"].tobytes()) + 500] ^= 1
    (tmp_path / "kept.safetensors").write_bytes(content)
    with pytest.raises(cache.CorruptCacheError):
        cache.load(tmp_path / "kept.safetensors")
