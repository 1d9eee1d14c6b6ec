# SPDX-License-Identifier: GPL-3.0-or-later
"""Who imports whom, read from source without running it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path


@dataclass(frozen=True)
class Import:
    """`source` imports `name` of the module `target` (dotted, absolute); name is "" where the module itself is meant.

    early: when `source` is imported itself, not in a function or for type checkers; relative: written with dots.
    """

    source: str
    target: str
    name: str
    line: int
    early: bool
    relative: bool


class Tree:
    """All modules of a package, or of a folder of scripts."""

    def __init__(self, folder: Path) -> None:
        """folder: of the package; its name is the first part of all module names."""
        files = sorted(path for path in folder.rglob("*.py") if "__pycache__" not in path.parts)
        self.files = {_module_name(path, folder.parent): path for path in files}
        self.imports = [found for name, path in self.files.items() for found in _imports_of(name, path)]

    def target(self, found: Import) -> str:
        """The module of the tree that an import brings in first: `from .a import b` may mean the module a.b."""
        whole = f"{found.target}.{found.name}" if found.name else found.target
        return whole if whole in self.files else found.target

    def early(self) -> dict[str, set[str]]:
        """For each module the modules of the tree that importing it imports."""
        graph: dict[str, set[str]] = {name: set() for name in self.files}
        for found in self.imports:
            if found.early and self.target(found) in self.files:
                graph[found.source].add(self.target(found))
        return graph

    def brought(self) -> dict[str, set[str]]:
        """For each module the packages outside the tree that importing it imports, itself or by way of others."""
        graph = self.early()
        direct: dict[str, set[str]] = {name: set() for name in self.files}
        for found in self.imports:
            if found.early and found.target not in self.files:
                direct[found.source].add(found.target.split(".")[0])
        brought = {}
        for name in self.files:
            seen, waiting = set(), [name]
            while waiting:
                module = waiting.pop()
                if module not in seen:
                    seen.add(module)
                    # Python imports the packages around a module before it.
                    waiting += [*graph[module], *(part for part in _around(module) if part in self.files)]
            brought[name] = set().union(*(direct[module] for module in seen))
        return brought

    def lacks(self, found: Import) -> bool:
        """Whether the tree should have what is imported and does not."""
        root = next(iter(self.files)).split(".")[0]
        if found.target.split(".")[0] != root or self.target(found) != found.target:
            return False
        if found.target not in self.files:
            return True
        return bool(found.name) and found.name != "*" and found.name not in _names_of(self.files[found.target])


def _module_name(path: Path, above: Path) -> str:
    parts = path.relative_to(above).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _around(module: str) -> Iterator[str]:
    while "." in module:
        module = module.rpartition(".")[0]
        yield module


def _imports_of(module: str, path: Path) -> Iterator[Import]:
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node, early in _walk(ast.parse(path.read_text(encoding="utf-8")), True):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(module, alias.name, "", node.lineno, early, False)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = parts[: len(parts) - node.level + 1] if node.level else []
            target = ".".join([*base, *([node.module] if node.module else [])])
            for alias in node.names:
                yield Import(module, target, alias.name, node.lineno, early, node.level > 0)


def _walk(node: ast.AST, early: bool) -> Iterator[tuple[ast.AST, bool]]:
    """Every node below, with whether it runs when the module is imported."""
    yield node, early
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                later = isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)) and field == "body"
                typing = isinstance(node, ast.If) and field == "body" and "TYPE_CHECKING" in ast.unparse(node.test)
                yield from _walk(child, early and not later and not typing)


@cache
def _names_of(path: Path) -> frozenset[str]:
    """What a module defines or imports outside functions and classes."""
    names: set[str] = set()

    def read(body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                names.add(node.name)
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                names.update(alias.asname or alias.name.split(".")[0] for alias in node.names)
            else:
                for child in ast.walk(node):
                    if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                        names.add(child.id)
                for part in ("body", "orelse", "finalbody"):
                    read(getattr(node, part, []))
                for handler in getattr(node, "handlers", []):
                    read(handler.body)

    read(ast.parse(path.read_text(encoding="utf-8")).body)
    return frozenset(names)
