"""The package's manners: its names, its laziness, and what the program sets before jax starts."""

import ast
import graphlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import jsecon

PACKAGE = Path(jsecon.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {path: ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in FILES}


def test_every_public_name_can_be_had_and_none_is_hidden_by_a_room():
    """Once imported, a room becomes an attribute of the package, in the place of a public name that is called alike."""
    for path, module in MODULES.items():
        if path.stem not in ("__init__", "__main__"):
            importlib.import_module(module)
        if path.name != "process.py":  # global configuration is its alone
            assert "jax.config.update" not in path.read_text(), path
            assert "os.environ[" not in path.read_text(), path
    for name in jsecon.__all__:
        assert callable(getattr(jsecon, name)), name
        assert name in dir(jsecon)
    with pytest.raises(AttributeError, match="no_such_name"):
        jsecon.no_such_name  # noqa: B018


def test_importing_the_package_starts_nothing_and_changes_no_environment():
    code = (
        "import os, sys; before = dict(os.environ); import jsecon; "
        "assert 'jax' not in sys.modules and 'numpy' not in sys.modules; "
        "import jsecon.types; assert not any(name.startswith('jsecon.app') for name in sys.modules); "
        "import jsecon.app.cli; assert dict(os.environ) == before"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=PACKAGE.parent)


def jsecon_imports(path: Path) -> set[str]:
    """The modules of jsecon that a file imports, at the top or inside a function."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jsecon":
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "jsecon"}
    return found


GROUND = ("types", "numerics", "errors", "files", "parallel", "process", "programs", "backend")
LAYERS = (
    "splat", "vision", "read", "fit", "poses", "networks", "field", "association", "paper", "query", "evaluate",
    "views", "change", "pipeline", "app",
)  # fmt: skip
"""packages, lowest first: each imports the modules of the root, itself, and packages before it"""


def test_packages_import_downwards_only():
    packages = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert packages == set(LAYERS)
    for path in MODULES:
        package = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if package in ("__init__", "__main__"):  # the table of contents, and the program
            continue
        lower = LAYERS[: LAYERS.index(package) + 1] if package in LAYERS else ()
        allowed = {*GROUND, "__version__", *lower}
        for name in jsecon_imports(path):
            other = [*name.split("."), "__version__"][1]
            assert other in allowed, f"{path.relative_to(PACKAGE)} imports {name}, upwards"


def test_modules_import_without_circles():
    """No module imports itself by way of others, imports inside functions included."""
    known, graph = set(MODULES.values()), {}
    for path, name in MODULES.items():
        found = {n if n in known else n.rpartition(".")[0] for n in jsecon_imports(path)}
        graph[name] = (found & known) - {"jsecon.__init__", name}
    graphlib.TopologicalSorter(graph).prepare()
