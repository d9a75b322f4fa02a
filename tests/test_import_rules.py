"""Import rules: which package may import which, and how large a module and a package may be.

The imports are read from the source, at the top of modules and inside functions. Imports below
`if TYPE_CHECKING` serve only type checkers and do not count. A name in a string, such as the entry point of
a world, is not an import: the core finds its parts by such names.
"""

from __future__ import annotations

import ast
import functools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers import output_of

import clbench

ROOT = Path(__file__).parents[1]

FLOORS = (
    ("base",),
    ("spec",),
    ("records", "policy", "worlds"),
    ("scoring", "data"),
    ("evaluation", "learning", "metrics"),
    ("runs",),
    ("exchange", "jobs", "serving", "testing"),
    ("cli",),
)
"""Packages of the core from the ground up. A package imports itself and those below it."""

SIDEWAYS: frozenset[tuple[str, str]] = frozenset()
"""Imports between two packages of one floor, (importing, imported). There are none."""

PARTS = ("envs", "methods", "leaderboard")
"""Packages outside the core: they import it, and it never imports them."""

USERS_OF_THE_COMMAND_LINE = (
    "clbench.cli",
    "clbench.leaderboard.cli",
    "clbench.leaderboard.pages.cli",
    "clbench.envs.dm_control.expert_training.cli",
)
"""The modules and packages that define commands: nothing else imports `clbench.cli`."""

FORBIDDEN = {
    "clbench.scoring": ("torch", "mujoco", "minari"),
    "clbench.records": ("torch", "mujoco", "minari"),
    "clbench.worlds": ("torch", "clbench.policy"),
}
"""Modules that a package must not import, neither in a function nor by way of the modules that it imports."""

LIGHT = ("clbench.scoring.metrics", "clbench.metrics", "clbench.records.reader", "clbench.leaderboard")
"""Modules that read scores: they need neither PyTorch nor a simulator."""

MOST_LINES = 450
MOST_MODULES = 12


@dataclass(frozen=True)
class Module:
    """The imports of one module, by full names."""

    name: str
    top: frozenset[str]
    """Names that it imports when it is imported itself."""
    inside: frozenset[str]
    """Names that its functions import."""

    @property
    def imports(self) -> frozenset[str]:
        return self.top | self.inside

    @property
    def package(self) -> str:
        """Package of the core, or part outside it, that holds the module; empty for the front door."""
        return (self.name + "..").split(".")[1]


def _name(path: Path) -> str:
    """Return the full name of a module; a wheel has the parts inside `clbench`, a checkout next to it."""
    relative = path.relative_to(ROOT).with_suffix("")
    parts = relative.parts if relative.parts[0] == "clbench" else ("clbench", *relative.parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def _statements(node: ast.AST, inside: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Yield each import below a node, and whether it is inside a function."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.Import, ast.ImportFrom)):
            yield child, inside
        elif isinstance(child, ast.If) and _is_for_type_checkers(child):
            for other in child.orelse:
                yield from _statements(ast.Module([other], []), inside)
        else:
            function = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            yield from _statements(child, inside or function)


def _imported(statement: ast.Import | ast.ImportFrom, package: str, known: frozenset[str]) -> Iterator[str]:
    """Yield the modules that a statement imports; `from a import b` imports a.b if that is a module."""
    if isinstance(statement, ast.Import):
        yield from (alias.name for alias in statement.names)
        return
    source = statement.module or ""
    if statement.level:
        above = package.split(".")
        above = above[: len(above) - statement.level + 1]
        source = ".".join([*above, *([source] if source else [])])
    for alias in statement.names:
        full = f"{source}.{alias.name}"
        yield full if full in known else source


@functools.cache
def _modules() -> Mapping[str, Module]:
    """Return all modules of the core and its parts by name."""
    paths = [path for folder in ("clbench", *PARTS) for path in sorted((ROOT / folder).rglob("*.py"))]
    paths = [path for path in paths if path.parent.name != "templates"]  # `clbench new-method` copies them
    known = frozenset(map(_name, paths))
    modules = {}
    for path in paths:
        name = _name(path)
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        found: dict[bool, set[str]] = {False: set(), True: set()}
        for statement, inside in _statements(ast.parse(path.read_text(encoding="utf-8"))):
            found[inside].update(_imported(statement, package, known))
        modules[name] = Module(name, frozenset(found[False]), frozenset(found[True]))
    return modules


def _is_in(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def _cycle(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the nodes of a cycle in their order, an empty list if there is none."""
    done: set[str] = set()
    for start in sorted(graph):
        path, pending = [start], [iter(sorted(graph[start]))]
        while path and start not in done:
            after = next(pending[-1], None)
            if after is None:
                done.add(path.pop())
                pending.pop()
            elif after in path:
                return [*path[path.index(after) :], after]
            elif after not in done:
                path.append(after)
                pending.append(iter(sorted(graph.get(after, ()))))
            if not path:
                break
    return []


def _floor(package: str) -> int:
    return next(number for number, packages in enumerate(FLOORS) if package in packages)


def test_every_package_of_the_core_has_a_floor() -> None:
    packages = {path.parent.name for path in (ROOT / "clbench").glob("*/__init__.py")}
    assert packages == {package for floor in FLOORS for package in floor}


@pytest.mark.long
def test_packages_of_the_core_import_only_what_is_below_them() -> None:
    wrong = []
    for module in _modules().values():
        for name in sorted(module.imports):
            here, there = module.package, (name + "..").split(".")[1]
            if not _is_in(name, "clbench") or not here or here in (*PARTS, "__main__") or there in PARTS:
                continue
            if not there:  # the public names come from every floor
                if here != "cli":
                    wrong.append(f"{module.name} imports the front door {name}")
            elif _floor(here) <= _floor(there) and here != there and (here, there) not in SIDEWAYS:
                wrong.append(f"{module.name} imports {name}")
    assert wrong == []


def test_the_core_never_imports_its_parts() -> None:
    wrong = [
        f"{module.name} imports {name}"
        for module in _modules().values()
        for name in sorted(module.imports)
        if module.package not in PARTS and any(_is_in(name, f"clbench.{part}") for part in PARTS)
    ]
    assert wrong == []


def test_parts_import_neither_each_other_nor_the_front_door() -> None:
    wrong = [
        f"{module.name} imports {name}"
        for module in _modules().values()
        for name in sorted(module.imports)
        if module.package in PARTS
        and (
            name == "clbench"
            or any(_is_in(name, f"clbench.{part}") for part in PARTS if part != module.package)
        )
    ]
    assert wrong == []


def test_only_the_command_line_imports_the_command_line() -> None:
    wrong = [
        f"{module.name} imports {name}"
        for module in _modules().values()
        for name in sorted(module.imports)
        if _is_in(name, "clbench.cli")
        and module.name != "clbench.__main__"
        and not any(_is_in(module.name, user) for user in USERS_OF_THE_COMMAND_LINE)
    ]
    assert wrong == []


def test_no_module_imports_itself_by_way_of_others() -> None:
    modules = _modules()
    graph = {
        name: {other for other in module.imports if other in modules} for name, module in modules.items()
    }
    assert _cycle(graph) == []


def test_no_package_imports_itself_by_way_of_others() -> None:
    modules, graph = _modules(), defaultdict[str, set[str]](set)
    for module in modules.values():
        package = _package(module.name)
        graph[package] |= {_package(name) for name in module.imports if name in modules} - {package}
    assert _cycle(graph) == []


def _package(name: str) -> str:
    """Return the package of a module, which is itself if it is one."""
    if name == "clbench.__main__":  # the command `python -m clbench`
        return "clbench.cli"
    folders = (folder.joinpath(*name.split(".")[1:]) for folder in (ROOT / "clbench", ROOT))
    return name if any((folder / "__init__.py").exists() for folder in folders) else name.rpartition(".")[0]


@pytest.mark.parametrize("package", FORBIDDEN)
def test_a_light_package_reaches_no_heavy_one(package: str) -> None:
    modules = _modules()
    ways = {name: name for name in modules if _is_in(name, package)}
    pending = list(ways)
    wrong = []
    while pending:
        name = pending.pop()
        module = modules[name]
        for other in sorted(module.imports if _is_in(name, package) else module.top):
            way = f"{ways[name]} > {other}"
            if any(_is_in(other, heavy) for heavy in FORBIDDEN[package]):
                wrong.append(way)
            elif other in modules and other not in ways:
                ways[other] = way
                pending.append(other)
    assert wrong == []


@pytest.mark.parametrize("imported", [*LIGHT, ", ".join(LIGHT)])
def test_reading_scores_imports_neither_pytorch_nor_a_simulator(imported: str) -> None:
    heavy = "{'torch', 'mujoco', 'minari', 'gymnasium_robotics'}"
    assert output_of(f"import sys, {imported}; print({heavy} & set(sys.modules))") == "set()"


def test_no_module_has_more_than_450_lines() -> None:
    folders = ("clbench", *PARTS, "benchmarks", "tests")
    lengths = {
        path.relative_to(ROOT).as_posix(): len(path.read_text(encoding="utf-8").splitlines())
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
    }
    assert {name: lines for name, lines in lengths.items() if lines > MOST_LINES} == {}


def test_no_package_has_more_than_12_modules() -> None:
    """`methods` is exempt: it has one module for each method."""
    found = {}
    for folder in ("clbench", "envs", "leaderboard"):
        for package in (ROOT / folder).rglob("__init__.py"):
            only_a_docstring = len(ast.parse(package.read_text(encoding="utf-8")).body) <= 1
            count = len(list(package.parent.glob("*.py"))) - only_a_docstring
            if count > MOST_MODULES:
                found[package.parent.relative_to(ROOT).as_posix()] = count
    assert found == {}


def test_the_front_door_shows_its_public_names_alone() -> None:
    assert dir(clbench) == sorted(clbench.__all__)
