"""Every public function says what goes in and what comes out."""

import ast
from pathlib import Path

import jsecon

HOME = Path(jsecon.__file__).parent
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def public_functions(body, method=False):
    """(function, names of its arguments) of a module or class, without properties and private names."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node.body, method=True)
        if isinstance(node, FUNCTIONS) and not node.name.startswith("_"):
            decorators = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
            given = node.args
            names = [argument.arg for argument in given.posonlyargs + given.args + given.kwonlyargs]
            names += [argument.arg for argument in (given.vararg, given.kwarg) if argument]
            if "property" not in decorators:
                yield node, names[1:] if method and "staticmethod" not in decorators else names


def test_public_functions_describe_arguments_and_results():
    missing = []
    for path in sorted(HOME.rglob("*.py")):
        for function, names in public_functions(ast.parse(path.read_text(encoding="utf-8")).body):
            text = ast.get_docstring(function) or ""
            sections = [line.strip().lstrip("*") for line in text.splitlines()]
            what = [f"argument {name}" for name in names if not any(line.startswith(f"{name}: ") for line in sections)]
            if names and "Args:" not in sections:
                what.append("Args")
            returned = ast.unparse(function.returns) if function.returns else "None"
            if returned not in ("None", "NoReturn") and not {"Returns:", "Yields:"} & set(sections):
                what.append("Returns")
            if what:
                missing.append(f"{path.relative_to(HOME)}:{function.lineno} {function.name}: {', '.join(what)}")
    assert not missing, "\n".join(missing)
