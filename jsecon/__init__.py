"""Find things in 3D Gaussian scenes by text, at the level of points, in functional JAX on a plain CPU.

The table of contents is __init__.pyi, which type checkers and this file read alike. A name is imported when it is first
used, so `import jsecon` costs nothing and jax starts only when something needs it.
"""

import ast
import importlib
from pathlib import Path

__version__ = "0.1.0"

_HOME = {
    alias.asname or alias.name: str(node.module)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll] (the stub has the names)


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'jsecon' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
