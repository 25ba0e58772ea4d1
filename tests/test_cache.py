"""The stage cache: what is kept comes back as it was, keys follow what matters, damage costs time and nothing else."""

import os
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from jsecon import Autoencoder, InputError
from jsecon.files import unpack_tree
from jsecon.pipeline import cache
from jsecon.pipeline.stages import StageResult


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


def test_what_is_kept_comes_back_and_equal_values_give_equal_bytes(scene, cameras, tmp_path):
    first, second, again = (tmp_path / f"{name}.safetensors" for name in "abc")
    for path in (first, second):
        cache.save(path, _tree(scene, cameras))
    found, _ = cache.load(first)
    cache.save(again, found)  # which writes types and dtypes too
    assert first.read_bytes() == second.read_bytes() == again.read_bytes()
    assert [type(value) for value in found.values()] == [type(value) for value in _tree(scene, cameras).values()]
    assert found["list"] == [1, 2.5, "x", True]
    np.testing.assert_array_equal(found["scene"].means, scene.means)


def test_fresh_and_cached_are_the_same_numpy_trees(tmp_path):
    path = tmp_path / "stage-0.safetensors"
    fresh = cache.read_or_compute(path, lambda: {"a": jnp.arange(4.0), "b": (jnp.int32(3), "text")})
    again = cache.read_or_compute(path, lambda: pytest.fail("computed twice"))
    assert (fresh[1:], again[1:]) == ((fresh[1], True), (fresh[1], False))
    for value, *_ in (fresh, again):
        assert isinstance(value["a"], np.ndarray)
        assert (value["a"].tolist(), value["b"]) == ([0, 1, 2, 3], (3, "text"))


@pytest.mark.parametrize("damage", [
    lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[:200] + bytes(64) + data[264:],
    lambda data: b"no archive at all",
], ids=["cut", "empty", "overwritten", "other"])  # fmt: skip
def test_a_damaged_file_is_said_and_computed_again(tmp_path, damage):
    value = np.random.default_rng(0).normal(size=500)
    path = tmp_path / "stage-k.safetensors"
    cache.read_or_compute(path, lambda: value)
    path.write_bytes(damage(path.read_bytes()))
    said = []
    kept, _, fresh = cache.read_or_compute(path, lambda: value, note=said.append)
    assert fresh
    np.testing.assert_array_equal(kept, value)
    assert ["stage is computed again" in note for note in said] == [True]
    assert not cache.read_or_compute(path, lambda: value)[2]


def test_pickles_are_neither_written_nor_read_and_only_records_of_jsecon_are_made(tmp_path):
    with pytest.raises(ValueError, match=r"root\.a: got builtins\.object .* expected plain numbers"):
        cache.save(tmp_path / "x.safetensors", {"a": object()})
    np.savez(tmp_path / "y.npz", a=np.array([object()], object), allow_pickle=True)
    with pytest.raises(InputError):
        cache.load(tmp_path / "y.npz")
    for record in ("os:system", "jsecon.pipeline.cache:read_or_compute", "jsecon.files:Path"):
        with pytest.raises((ValueError, AttributeError)):
            unpack_tree({"record": record, "fields": {}}, {})


def test_files_digest_follows_names_sizes_and_times(tmp_path):
    a, b = tmp_path / "images" / "a.png", tmp_path / "images" / "b.png"
    a.parent.mkdir()
    a.write_bytes(b"one")
    digests = [cache.files_digest([tmp_path]), cache.files_digest([tmp_path])]
    for change in (lambda: os.utime(a, ns=(0, 1)), lambda: a.write_bytes(b"four"), lambda: b.write_bytes(b"one")):
        change()
        digests.append(cache.files_digest([tmp_path]))
    assert digests[0] == digests[1]
    assert len(set(digests)) == 4


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
    odd = tmp_path / os.fsdecode(b"Gr\xf6\xdfe.png")
    odd.write_bytes(b"one")
    (tmp_path / "elsewhere" / "deep").mkdir(parents=True)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "images").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "deep" / "round").symlink_to(tmp_path / "elsewhere")
    before = cache.files_digest([tmp_path / "capture"])
    assert cache.files_digest([odd]) != before
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

    for file in ("app/viewer/page.py", "query/answer.py", "evaluate/lerf.py", "app/running.py"):
        assert not changed(file), file
    for file in ("association/consensus.py", "networks/sam2.py", "read/captures/colmap.py", "types.py"):
        assert changed(file), file


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
