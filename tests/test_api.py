"""The package's manners: its names, its laziness, and what the program sets before jax starts."""

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import jsecon

PACKAGE = Path(jsecon.__file__).parent


def test_every_public_name_can_be_had():
    for name in jsecon.__all__:
        assert getattr(jsecon, name) is not None
        assert name in dir(jsecon)


def test_names_that_outside_code_relies_on_are_there():
    promised = """Gaussians Camera load_ply save_ply project render render_rgb region_votes distill_votes distill_l1
        train_autoencoder masklets region_embeddings query_one_step query_canonical query_anchored remove_outliers iou
        mean_iou accuracy_at localization_accuracy load_field save_field check_backend"""
    assert set(promised.split()) <= set(jsecon.__all__)


def test_what_type_checkers_read_is_what_runs():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    typed = {
        (node.module, alias.name) for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert typed == {(module, name) for module, names in jsecon._CONTENTS.items() for name in names}


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        jsecon.no_such_name  # noqa: B018


def test_importing_the_package_starts_nothing_and_changes_no_environment():
    code = (
        "import os, sys; before = dict(os.environ); import jsecon; "
        "assert 'jax' not in sys.modules and 'numpy' not in sys.modules; "
        "import jsecon.cli; assert dict(os.environ) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=PACKAGE.parent)


def test_rooms_import_downwards_only():
    """The order of DESIGN section 4: a room may import from rooms above it in this list, never from those below."""
    floors = [
        ("types", "numerics", "errors", "files"),
        ("splat", "vision", "data", "parallel", "backend"),
        ("fit", "language"),
        ("query",),
        ("evaluate",),
    ]
    above = {room: floor for floor, rooms in enumerate(floors) for room in rooms}
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if room not in above or path.name in ("views.py", "geometric.py"):  # tracking through the scene uses the scene
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jsecon."):
                other = node.module.split(".")[1]
                assert other in above, f"{path.name} imports {node.module}, the roof"
                assert above[other] <= above[room], f"{path.name} imports {node.module}, upwards"


def test_modules_are_short_enough_to_be_read_whole():
    for path in PACKAGE.rglob("*.py"):
        lines = len(path.read_text().splitlines())
        assert lines <= 400, f"{path.relative_to(PACKAGE)} has {lines} lines"


def test_no_module_touches_global_configuration():
    for path in PACKAGE.rglob("*.py"):
        if path.name == "process.py":
            continue
        text = path.read_text()
        assert "jax.config.update" not in text, path
        assert "os.environ[" not in text, path


def test_help_runs_as_a_program():
    environ = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    text = subprocess.run(
        [sys.executable, "-m", "jsecon", "--help"], check=True, capture_output=True, text=True, env=environ
    )
    for verb in ("demo", "run", "query", "eval"):
        assert verb in text.stdout
    importlib.import_module("jsecon.cli")
