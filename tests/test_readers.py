"""All readers in one table: odd names, empty files, and rows that other packages register."""

import json

import cv2
import numpy as np
import pytest
from capture_files import refused, small_capture, transforms, write_images, write_transforms
from fuzz_readers import READERS, Case
from splat_files import scene

from jsecon import Gaussians, InputError, load_capture, load_gaussians
from jsecon.read.captures.images import image_header
from jsecon.read.masks.masks import load_labels, load_proposals
from jsecon.read.registry import Reader

FILE_READERS = (
    *("ply", "splats", "points", "colmap", "nerfstudio", "rgbd", "image", "masks", "langsplat"),
    *("proposals", "labels", "videos"),
)
ODD_NAME = "Gr\xf6\xdfe [1] * 50%, \u6e2c\u8a66 'x'"
"""with signs of patterns, of lists and of other alphabets; names that are not UTF-8: test_names"""


def cases(name: str, folder) -> list[Case]:
    folder.mkdir()
    return list(READERS[name](folder))


@pytest.mark.parametrize("name", FILE_READERS)
def test_a_folder_may_have_any_name(tmp_path, name):
    for case in cases(name, tmp_path / ODD_NAME):
        case.whole(case.read())


@pytest.mark.parametrize("name", FILE_READERS)
def test_an_empty_file_is_one_clear_error_or_nothing(tmp_path, name):
    for case in cases(name, tmp_path / "plain"):
        for file in dict.fromkeys(case.files):
            intact = file.read_bytes()
            file.write_bytes(b"")
            try:
                case.whole(case.read())
            except InputError as error:
                assert error.remedy, file  # noqa: PT017
                assert len(str(error)) < 700  # noqa: PT017
            file.write_bytes(intact)


PLUGIN = """
import json
import numpy as np
from jsecon import Gaussians
from jsecon.read.captures.nerfstudio import READERS
from jsecon.read.registry import Reader

capture = Reader("Rig", ("rig.txt", "poses"), lambda path: READERS[0].read(path / "poses" / "cameras.json"))
masks = Reader("runs", (".runs",), lambda path, size, level: np.array(json.loads(path.read_text())))

def read_numbers(path):
    means = np.array(path.read_text().split(), np.float32).reshape(-1, 3)
    n = len(means)
    turns = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(means, means * 0, turns, means[:, 0], means[:, None] * 0), ("read by a plugin",)

splat = Reader("numbers", (".xyzs",), read_numbers)
not_one = 3
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """Installs a package with an entry point for each registry, as pip would lay it out."""
    site = tmp_path / "site"
    info = site / "jsecon_rig-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "jsecon_rig.py").write_text(PLUGIN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: jsecon-rig\nVersion: 1.0\n")
    rows = {"captures": "capture", "masks": "masks", "splats": "splat"}

    def install(**more: str) -> None:
        lines = (f"[jsecon.{group}]\n{group} = jsecon_rig:{value}\n" for group, value in (rows | more).items())
        (info / "entry_points.txt").write_text("\n".join(lines))

    install()
    monkeypatch.syspath_prepend(site)
    return install


def test_other_packages_add_rows_by_entry_points(tmp_path, plugin):
    capture, folder = small_capture(), tmp_path / "scene"
    write_images(capture, folder / "poses" / "images")
    (folder / "poses" / "cameras.json").write_text(json.dumps(transforms(capture)))
    with refused("scene", "without poses"):
        load_capture(folder)
    (folder / "rig.txt").write_text("a rig")
    np.testing.assert_array_equal(load_capture(folder).frames, capture.frames)

    (tmp_path / "masks").mkdir()
    ids = np.arange(12).reshape(3, 4) // 4
    (tmp_path / "masks" / "a.runs").write_text(json.dumps(ids.tolist()))
    labels, found, _ = load_labels(tmp_path / "masks", ("a",), (3, 4))
    np.testing.assert_array_equal(labels[0], ids - 1)
    assert found == (1, 2)
    np.testing.assert_array_equal(load_proposals(tmp_path / "masks", ("a",), (3, 4))[0](0), [ids == 1, ids == 2])
    (tmp_path / "masks" / "a.runs").write_text("[[")
    with refused("a.runs", "cannot be read"):
        load_labels(tmp_path / "masks", ("a",), (3, 4))

    (tmp_path / "a.xyzs").write_text("1 2 3 4 5 6")
    with pytest.warns(UserWarning, match="read by a plugin"):
        np.testing.assert_array_equal(load_gaussians(tmp_path / "a.xyzs").means, [[1, 2, 3], [4, 5, 6]])
    (tmp_path / "a.xyzs").write_text("1 2 three")
    with refused("a.xyzs", "three"):
        load_gaussians(tmp_path / "a.xyzs")


@pytest.mark.parametrize(("value", "words"), [("not_one", "is a int"), ("gone", "cannot be loaded")])
def test_an_entry_point_that_is_no_reader_is_named(tmp_path, plugin, value, words):
    plugin(splats=value)
    (tmp_path / "a.xyzs").write_text("1 2 3")
    with refused("jsecon.splats:splats", words, "package"):
        load_gaussians(tmp_path / "a.xyzs")


def test_an_image_says_its_size_by_its_header_alone(tmp_path):
    """Cut behind the header, it has a size but no pixels."""
    for suffix in (".png", ".jpg", ".bmp"):
        file = tmp_path / f"a{suffix}"
        cv2.imwrite(str(file), np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8))
        whole = file.read_bytes()
        file.write_bytes(whole[:1200])
        assert len(whole) > 100_000
        assert image_header(file).upright == (640, 480), suffix


def test_frames_are_read_on_the_cores_that_the_process_may_use(tmp_path, monkeypatch):
    """As under `taskset -c 0`: the pool has as many threads as the process has cores."""
    write_transforms(small_capture(), tmp_path)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0}, raising=False)
    threads = set()
    load_capture(tmp_path, progress=lambda done, total: threads.update(_readers()))
    assert len(threads) <= 1


def _readers() -> list[str]:
    import threading

    return [thread.name for thread in threading.enumerate() if thread.name.startswith("ThreadPoolExecutor")]


def test_a_row_fits_files_by_their_ends_and_folders_by_all_marks(tmp_path):
    folder = Reader("Folder", ("rgb.txt", "sub/*/cameras.bin"), Gaussians)
    assert not folder.fits(tmp_path)
    (tmp_path / "rgb.txt").write_text("")
    (tmp_path / "sub" / "0").mkdir(parents=True)
    assert not folder.fits(tmp_path)
    (tmp_path / "sub" / "0" / "cameras.bin").write_text("")
    assert folder.fits(tmp_path)
    assert not folder.fits(tmp_path / "rgb.txt")
    file = Reader("File", (".spz", "_s.npy"), scene)
    assert file.fits(tmp_path / "A.SPZ")
    assert file.fits(tmp_path / "frame_s.npy")
    assert not file.fits(tmp_path / "frame.npy")
    assert not file.fits(tmp_path)
