"""Packages import downwards, and no circle of modules exists; imports under TYPE_CHECKING and inside functions count."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from product_sources import PACKAGES, ROOT, import_statements

ROOMS = ("training", "training.environment", "training.algorithms", "training.tasks", "training.run", "training.sweep")


@cache
def modules() -> dict[str, Path]:
    """Return the file of every module; read when a test asks, and not by every worker that collects the tests."""
    files = {file.relative_to(ROOT).with_suffix("").parts: file for file in import_statements()}
    return {".".join(parts[:-1] if parts[-1] == "__init__" else parts): file for parts, file in files.items()}


@cache
def imports(module: str) -> set[str]:
    """Modules of the package that a module imports."""
    found, here = set(), (*module.split("."), "")[: None if modules()[module].name == "__init__.py" else -1]
    for node in import_statements()[modules()[module]]:
        if isinstance(node, ast.ImportFrom) and node.level:
            base = ".".join(filter(None, (*here[: len(here) - node.level], node.module)))
            found |= {f"{base}.{a.name}" if f"{base}.{a.name}" in modules() else base for a in node.names}
    return (found & modules().keys()) - {module}


def room(module: str) -> str:
    return module if modules()[module].name == "__init__.py" else module.rpartition(".")[0]


def test_packages_and_the_rooms_of_training_import_downwards():
    pairs = [(module, used) for module in modules() for used in imports(module)]
    assert len(pairs) > 1000
    assert [p for p in pairs if PACKAGES.index(p[0].split(".")[0]) < PACKAGES.index(p[1].split(".")[0])] == []
    inside = [pair for pair in pairs if all(module.startswith("training") for module in pair)]
    assert [p for p in inside if ROOMS.index(room(p[0])) < ROOMS.index(room(p[1]))] == []


def test_no_modules_import_each_other_in_a_circle():
    TopologicalSorter({module: imports(module) for module in modules()}).prepare()
