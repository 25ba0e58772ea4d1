"""All readers in one table: damage that each names, and rows that other packages register."""

import json
import shutil

import cv2
import numpy as np
import pytest
from capture_files import edit, numbers, refused, small_capture, transforms, write_images
from fuzz_readers import MASK_SIZE, READERS, cases
from splat_files import ply_columns, scene, sog, spz, spz_record, write_ply

from jsecon import InputError, load_capture, load_gaussians
from jsecon.read.captures.images import image_header
from jsecon.read.masks.masks import load_labels, load_proposals


def put(name, content):
    """Damage: this text, bytes or array in place of the file `name` of a folder, or of a file itself (""); None: no
    file."""

    def damage(entry):
        file = entry / name
        if content is None:
            file.unlink()
        elif isinstance(content, np.ndarray):
            np.save(file, content) if file.suffix == ".npy" else cv2.imwrite(str(file), content)
        else:
            file.write_bytes(content if isinstance(content, bytes) else content.encode())

    return damage


def swap(name, old, new):
    return edit(name, lambda data: data.replace(old, new))


def emptied(entry):
    """Damage: no file in a folder."""
    for file in entry.iterdir():
        file.unlink()


def replace(tree, value, *path):
    """Puts a value into a tree of JSON, in place; GONE takes the key away."""
    for step in path[:-1]:
        tree = tree[step]
    tree[path[-1]] = value
    if value is GONE:
        del tree[path[-1]]


def key(name, value, *path):
    def change(data):
        tree = json.loads(data)
        replace(tree, value, *path)
        return json.dumps(tree).encode()

    return edit(name, change)


def columns(rest=0, **changes):
    """Damage: other columns of a .ply; of (row, value) a number, None for no such column."""

    def damage(file):
        own = ply_columns(rest=rest)
        for name, change in changes.items():
            if isinstance(change, tuple):
                own[name][change[0]] = change[1]
            else:
                own[name] = change
        write_ply(file, {name: column for name, column in own.items() if column is not None})

    return damage


def header(lines):
    return put("", f"ply\nformat ascii 1.0\nelement {lines}\nend_header\n\n")


def cut_behind_a_thumbnail(data):
    """A JPEG cut short; the thumbnail in its header ends like a whole one."""
    return (data[:2] + b"\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data + data[2:])[:-40]


def runs(counts):
    return put("a.json", json.dumps([{"segmentation": {"size": [9, 10], "counts": counts}}]))


GONE = object()
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345\n"
JSON, CAMERAS, LABEL = "transforms.json", "sparse/0/cameras.txt", "frame_1.json"
IMAGES, POINTS = "sparse/0/images.bin", "sparse/0/points3D.bin"
POSE, OUTLINE = ("frames", 1, "transform_matrix"), ("objects", 0, "segmentation")
MIRROR, SCALED = np.diag([1.0, 1, -1, 1]).tolist(), np.diag([2.0, 2, 2, 1]).tolist()
AT_ORIGIN = scene(30) | {"means": np.zeros((30, 3))}
IDS = np.arange(864, dtype=np.uint8).reshape(MASK_SIZE) % 4
DAMAGE = {
    "colmap/text": [
        (put(CAMERAS, "1 EQUIRECTANGULAR 24 16 24 16"), "cameras.txt", "24x16", "twice as wide as high"),
        *((put(CAMERAS, f"1 {name} 24 16 24 16"), name, "image_undistorter") for name in ("NEW_FISHEYE", "FOV")),
    ],
    "colmap/binary": [
        (numbers("sparse/0/cameras.bin", 12, "<i", 99), "cameras.bin", "99", "image_undistorter"),
        (numbers("sparse/0/cameras.bin", 32, "<4d", 0.9, 0.9, 0.5, 0.5), "cameras.bin", "give them in pixels"),
        (put(IMAGES, None), "images.txt", "No such file"),
        (swap(IMAGES, b"frame_000.png\0", b"../me_000.png\0"), "leads out"),
        (put("images/frame_000.png", POINTER), "frame_000.png"),
    ],
    "nerfstudio/plain": [
        (key(JSON, GONE, *POSE), "frame_001.png) cannot be read ('transform_matrix' is"),
        (key(JSON, [], "frames"), "of its 0 frames"), (key(JSON, "wide", "w"), "wide"),
        (key(JSON, MIRROR, *POSE), "not rigid"), (key(JSON, SCALED, *POSE), "not rigid"),
        (key(JSON, [[1, 2], [3, 4]], *POSE), "shape (2, 2)"), (key(JSON, [0, 0, 0], "up"), "not all 0"),
        (key(JSON, GONE, "camera_angle_x"), "no focal length", "camera_angle_x"),
        (key(JSON, 4.0, "camera_angle_x"), "camera_angle_x = 4.0"), (key(JSON, 0.1, "k4"), JSON, "k4"),
        (key(JSON, "EQUIRECTANGULAR", "camera_model"), "twice as wide"),
        (key(JSON, 0.1, "ftheta_p0"), JSON, "ftheta_p0"),
        (lambda entry: shutil.rmtree(entry / "images"), JSON, "none has its image"),
        (swap(JSON, b'"cx": 11.75, "cy": 8.5', b'"cx": 0.1175, "cy": 0.085'), "give them in pixels"),
        (key(JSON, "missing.png", "frames", 0, "mask_path"), "missing.png", "No such file"),
    ],
    "nerfstudio/deep": [
        (key(JSON, 0.0, "applied_scale"), "scale of its world"), (key(JSON, "gone.ply", "ply_file_path"), "gone.ply"),
        (put("depth/depth1.png", np.ones((24, 16), np.uint16)), "depth1.png", "16x24"),
        (put("depth/depth1.png", None), "depth1.png", "No such file"),
    ],
    "rgbd/scannet": [
        (put("pose/3.txt", "1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n"), "not rigid"),
        (put("intrinsic/intrinsic_color.txt", ""), "intrinsic_color.txt"),
    ],
    "rgbd/tum": [
        (put("groundtruth.txt", "1305031102.17 0 0 0 0 0 0 0\n"), "zero norm"),
        (put("intrinsics.txt", "500 500 12 8" + 9 * " 0.01"), "distortion"),
        (put("intrinsics.txt", None), "intrinsics.txt", "fx fy cx cy"),
    ],
    "rgbd/arkitscenes": [(put("lowres_wide.traj", "1 2 3\n"), "lowres_wide.traj")],
    "rgbd/polycam": [(put("keyframes/corrected_cameras/101.json", '{"fx": 3}'), "'fy'")],
    "rgbd/record3d": [(put("metadata.json", '{"poses": [[0, 0, 0]]}'), "metadata.json")],
    "ply/9.ply": [
        (put("", POINTER), "git lfs pull"), (columns(opacity=None), "no opacity"), (columns(x=None), "no x"),
        (columns(y=(4, np.nan)), "means of 1 of 6 Gaussians", "the first: 4"),
        (columns(opacity=(4, np.nan)), "opacity_logits of 1 of 6"), (columns(f_dc_2=(4, -np.inf)), "sh of 1 of 6"),
        (columns(**{f"rot_{n}": (3, 0) for n in range(4)}), "quaternions of 1 of 6", "zero", "the first: 3"),
        (columns(filter_3D=np.arange(6) - 1), "filter_3D are negative"),
        *((columns(rest), f"{rest} properties f_rest", "degree") for rest in (1, 3, 6, 12, 44, 48, 72)),
        (header("face 0"), "elements are face"), (header("vertex many"), "element vertex many"),
        (header("vertex -1\nproperty float x"), "element vertex -1"),
        (header("vertex 99999999999\nproperty float x"), "cut short"),
        (header("vertex 0\nproperty list uchar int x"), "has lists"),
        (header("vertex 0\nproperty float x\nproperty float x"), "more than once"),
    ],
    "clouds/ascii-None.ply": [(columns(z=None), "no z")],
    "clouds/old.las": [(numbers("", 100, "<I", 2**31), "claims 2147483648 records")],
    "clouds/a.laz": [(edit("", lambda data: data[:-9] + b"\xff" * 4 + data[-5:]), "claims 4294967295 records")],
    "splats/c.ply": [
        (swap("", b"element chunk 2", b"element chunk 1"), "damaged"),
        (swap("", b"float min_scale_x", b"float odd_scale_x"), "SuperSplat 2"),
        (swap("", b"float min_r", b"float odd_r"), "SuperSplat 2"),
        (swap("", b"element sh 300", b"element sh 299"), "299 rows of harmonics for 300 Gaussians"),
    ],
    "splats/s.sog": [
        (put("", sog(scene(40, 1), change=lambda meta: meta["scales"]["codebook"].pop())), "fewer than 256"),
    ],
    "splats/v4.spz": [
        (put("", spz(scene(30), 4, degree=4)), "degree 4"), (put("", spz(scene(30), 5)), "version 5"),
        (put("", spz(scene(30), 4, records=spz_record(0xADBE0003, b"\x11\0\0\0"))), "unknown number 17"),
        (put("", spz(scene(30), 4, records=spz_record(0xADBE0003, b"")[:-1] + b"\1")), "damaged"),
        (put("", spz(AT_ORIGIN, 4, fraction=31)), "fractional_bits"),
    ],
    "images/plain.png": [(numbers("", 2000, "4B", 1, 2, 3, 4), "checksum"), (put("", None), "No such file")],
    "images/plain.jpg": [(edit("", cut_behind_a_thumbnail), "truncated")],
    "depths/depth.png": [(put("", np.ones((4, 5, 3), np.uint8)), "uint8")],
    "masks/grey": [
        (shutil.rmtree, "no such folder"), (emptied, "no mask", "a.png"),
        (lambda entry: [file.rename(entry / f"0{file.name}") for file in [*entry.iterdir()]], "called like a frame"),
        (edit("a.png", lambda data: data[:-20]), "a.png", "cannot be read"),
        (put("a.png", IDS.T), "a.png", "24x36", "36x24"), (put("a.png", np.dstack([IDS] * 4)), "4 channels"),
        (put("a.png", np.dstack([IDS.astype(np.uint16)] * 3)), "16 bits"),
    ],
    "proposals/levels": [
        (put("a_s.npy", np.zeros((3, *MASK_SIZE))), "a_s.npy", "shape is (3, 24, 36)"),
        (put("a_s.npy", np.full((4, *MASK_SIZE), 0.5)), "a_s.npy", "no whole numbers"),
        (edit("a_s.npy", lambda data: data[:300]), "a_s.npy", "cannot be read"),
    ],
    "masks/objects": [(put("001/a.png", IDS), "a.png", "3 values")],
    "proposals/sam": [
        (put("a.json", "[{"), "a.json", "not JSON"),
        (put("a.json", '[{"bbox": [1, 2, 3, 4]}]'), "a.json", "'segmentation' is missing"),
        (put("a.json", '{"info": 1}'), "a.json", "'annotations' is missing"),
        (put("a.json", '[{"segmentation": [[1, 2, 3, 4]]}]'), "a.json, mask 0"),
        (runs("61X13mN000"), "a.json, mask 0", "69 of 9x10"), (runs("61X13mN000`"), "breaks off"),
        (runs([-10, 100]), "90 of 9x10"), (runs("61 X"), "is not a digit"), (runs("abc\u00e9"), "is not a digit"),
    ],
    "labels/lerf": [
        (emptied, "no .json file"),
        (key(LABEL, [], *OUTLINE), LABEL, "of 0 corners"), (key(LABEL, [[1, 2, 3]], *OUTLINE), "object 0"),
        (key(LABEL, [[1, np.nan], [2, 3], [4, 5]], *OUTLINE), LABEL, "out of all range"),
        (key(LABEL, [1, 2, 3], "objects", 0, "bbox"), LABEL, "object 0"), (key(LABEL, "mug", "objects", 0), "object 0"),
        (key(LABEL, 7, "objects", 0, "category"), "category is 7"), (key(LABEL, "wide", "info", "width"), "wide"),
        (key(LABEL, GONE, *OUTLINE), "'segmentation' is missing"), (key(LABEL, 0, "info", "height"), LABEL, "30x0"),
    ],
    "videos/a.avi": [(put("", b"no video" * 100), "no frame")],
}  # fmt: skip
"""reader and one of its files or folders -> (what is done to it, words of the message)"""
ROWS = [(entry, *row) for entry, rows in DAMAGE.items() for row in rows]


@pytest.mark.parametrize("row", ROWS, ids=[f"{row[0]}: {row[-1]}" for row in ROWS])
def test_damage_is_named(tmp_path, row):
    entry, damage, *words = row
    reader, _, name = entry.partition("/")
    write, read, _ = READERS[reader]
    write(tmp_path)
    damage(tmp_path / name)
    with refused(*words, *([name] if (tmp_path / name).suffix else [])):
        read(tmp_path / name)


SUBSTITUTES = {
    "Git LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345678\n",
    "page of HTML": b"\n<!DOCTYPE html><html><body>404 Not Found</body></html>",
}


@pytest.mark.parametrize("name", [
    *("ply", "splats", "clouds", "colmap", "nerfstudio", "rgbd", "images", "depths"),
    *("masks", "proposals", "labels", "field", "videos"),
])  # fmt: skip
def test_what_stands_in_place_of_a_file_is_named(tmp_path, name):
    """Where a file may be missing or hold anything, reading goes on."""
    named = 0
    for files, read in cases(name, tmp_path / "plain"):
        for number, file in enumerate(files):
            intact = file.read_bytes()
            what, head = [*SUBSTITUTES.items()][number % len(SUBSTITUTES)]
            file.write_bytes(head)
            try:
                read()
            except InputError as error:
                assert f"{what} in place of the file" in str(error), file  # noqa: PT017
                named += 1
            file.write_bytes(intact)
    assert named


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
    (tmp_path / "a.xyzs").write_text("1 2 3 4 5 6")
    with pytest.warns(UserWarning, match="read by a plugin"):
        np.testing.assert_array_equal(load_gaussians(tmp_path / "a.xyzs").means, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(("value", "words"), [("not_one", "is a int"), ("gone", "cannot be loaded")])
def test_an_entry_point_that_is_no_reader_is_named(tmp_path, plugin, value, words):
    plugin(splats=value)
    (tmp_path / "a.xyzs").write_text("1 2 3")
    with refused("jsecon.splats:splats", words, "package"):
        load_gaussians(tmp_path / "a.xyzs")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_an_image_says_its_size_by_its_header_alone(tmp_path, suffix):
    """Cut behind the header, it has a size but no pixels."""
    file = tmp_path / f"a{suffix}"
    cv2.imwrite(str(file), np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8))
    file.write_bytes(file.read_bytes()[:1200])
    assert image_header(file).upright == (640, 480)
