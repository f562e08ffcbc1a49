"""No module of the package imports, directly or indirectly, a module that imports it."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "casadi_ik"


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path, modules: set[str]) -> set[str]:
    """Return the modules of the package that a file imports.

    Imports inside functions and below `TYPE_CHECKING` count.
    """

    def imports(node: ast.AST) -> set[str]:
        imports_found: set[str] = set()
        if isinstance(node, ast.Import):
            imports_found = {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & modules
            imports_found = submodules or {node.module}
        return imports_found.union(*map(imports, ast.iter_child_nodes(node)))

    return imports(ast.parse(path.read_text(encoding="utf-8"))) & modules - {module_name(path)}


def test_no_circles():
    paths = {module_name(path): path for path in ROOT.rglob("*.py")}
    graph = {name: imported_modules(path, set(paths)) for name, path in paths.items()}
    assert "casadi_ik.app.cli.inputs" in graph["casadi_ik.app.cli.batch"]
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
