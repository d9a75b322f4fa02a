"""The rule of a task as code: its success condition and its reward, without comments, docstrings and layout.

A few fixed episodes miss a threshold that moves a little; the code does not. It covers the functions and
classes that a rule reaches in its own modules, with the values that they use. A rule begins at the class of
the world. If a suite has a module `rules` with a table by task, only the task's entry counts.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
from collections.abc import Iterator, Mapping
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from clbench.base.entry_points import resolve
from clbench.base.source import names_in
from clbench.spec.task import Task

_PLAIN = (bool, int, float, str, bytes, slice, type(None))


def rule_code(task: Task) -> str:
    """Return the code of a task's rule."""
    world = resolve(task.world)
    module = task.world.partition(":")[0]
    beside = f"{module.rpartition('.')[0]}.rules"
    suite = "." in module and importlib.util.find_spec(beside) is not None
    modules = [importlib.import_module(name) for name in ([module, beside] if suite else [module])]
    tables = {id(one): one for each in modules for one in vars(each).values() if isinstance(one, Mapping)}
    entries = [table[task.name] for table in tables.values() if task.name in table]
    roots = entries if suite and entries else [world, *entries]
    homes = {getattr(root, "__module__", module) for root in roots}
    reached = _Reached(homes | {each.__name__ for each in modules})
    for number, root in enumerate(roots):
        reached.add(f"{task.name} {number}", root)
    return "\n".join(sorted(f"{name}: {text}" for name, text in reached.texts.items()))


def module_code(module: str) -> str:
    """Return the code of a module without its comments, its docstrings and its layout."""
    return ast.unparse(_tree(_source(module)))


class _Reached:
    """The texts of functions and values, by names that say where they were found.

    Args:
        modules: Names of the modules whose functions and classes are read; in others, only names count.
    """

    def __init__(self, modules: set[str]) -> None:
        self.modules, self.texts = modules, dict[str, str]()
        self._objects: list[object] = []
        self._first = dict[str, object]()

    def add(self, name: str, value: Any) -> None:
        """Add a value, found under a name, with all that it reaches."""
        if isinstance(value, FunctionType):
            self._add_function(name, value)
        elif isinstance(value, type):
            self._add_class(value)
        elif isinstance(value, _PLAIN):
            self.texts[name] = repr(value)
        elif isinstance(value, np.ndarray | np.generic):
            self.texts[name] = repr(value.tolist())
        elif isinstance(value, functools.partial | functools.partialmethod):
            self._add_all(name, {"function": value.func, "given": value.args, **value.keywords})
        elif isinstance(value, functools.cached_property):
            self.add(name, value.func)
        elif isinstance(value, functools.singledispatchmethod):
            self.add(name, value.dispatcher.registry)
        elif isinstance(value, Mapping):
            self._add_all(name, {repr(key): one for key, one in value.items()})
        elif isinstance(value, tuple | list):
            self._add_all(name, dict(enumerate(value)))
        elif isinstance(value, set | frozenset):
            self._add_all(name, dict(enumerate(sorted(value, key=repr))))
        elif isinstance(inner := getattr(value, "__wrapped__", None), FunctionType):  # of functools.cache
            self._add_function(name, inner)
        elif type(value).__module__ in self.modules and not any(value is one for one in self._objects):
            self._objects.append(value)  # objects may name each other
            self._add_class(type(value))
            self._add_all(name, getattr(value, "__dict__", {}))

    def _add_all(self, name: str, values: Mapping[Any, Any]) -> None:
        for key, one in values.items():
            self.add(f"{name}.{key}", one)

    def _add_class(self, value: type) -> None:
        name = self._own_name(value.__qualname__, value.__module__, value)
        if value.__module__ not in self.modules or name in self.texts:
            return
        self.texts[name] = ", ".join(base.__qualname__ for base in value.__bases__)
        for base in value.__bases__:
            self._add_class(base)
        for member, one in vars(value).items():
            function = getattr(one, "__func__", getattr(one, "fget", one))
            if isinstance(function, FunctionType) or not member.startswith("__"):
                self.add(f"{name}.{member}", function)

    def _add_function(self, name: str, value: FunctionType) -> None:
        """Add the code of a function, and what it takes from its module and from the function around it."""
        while _is_wrapper(value):
            value = value.__wrapped__  # type: ignore[attr-defined]
        text = _function_code(value) if value.__module__ in self.modules else ""
        if not text or self.texts.get(name) == text:  # of another module or without a file, or known
            return
        self.texts[name] = text
        self._add_all(name, inspect.getclosurevars(value).nonlocals)
        for other in sorted(names_in(value.__code__) & value.__globals__.keys()):
            found = value.__globals__[other]
            self.add(self._own_name(other, value.__module__, found), found)

    def _own_name(self, name: str, module: str, value: object) -> str:
        """Return a unique name of a value: if another value has the name, its module goes before it."""
        return name if self._first.setdefault(name, value) is value else f"{module}.{name}"


def _is_wrapper(function: FunctionType) -> bool:
    """Return whether a decorator of another module made a function, as `numpy.errstate` does."""
    wrapped = getattr(function, "__wrapped__", None)
    return isinstance(wrapped, FunctionType) and function.__globals__ is not wrapped.__globals__


def _function_code(function: FunctionType) -> str:
    """Return the code of a function; for a lambda, the code of all lambdas on its line."""
    found = _functions(_source(function.__module__)).get(function.__code__.co_firstlineno, ())
    return "; ".join(found)


def _source(module: str) -> str:
    """Return the source of a module, empty for a module without a file, such as a prompt."""
    try:
        return _text(importlib.import_module(module))
    except (ImportError, OSError, TypeError):
        return ""


@functools.cache  # a rule asks for each of its functions
def _text(module: ModuleType) -> str:
    return inspect.getsource(module)


@functools.cache
def _functions(source: str) -> Mapping[int, list[str]]:
    """Return the code of the functions of a module by their first line, as code objects count them."""
    found: dict[int, list[str]] = {}
    for node in ast.walk(_tree(source)):
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            decorators = getattr(node, "decorator_list", [])
            first = min([node.lineno, *(one.lineno for one in decorators)])
            found.setdefault(first, []).append(ast.unparse(node))
    return found


def _tree(source: str) -> ast.Module:
    """Return the syntax of a module without its docstrings."""
    tree = ast.parse(source)
    for node, body in _bodies(tree):
        node.body = [one for one in body if not _is_text(one)] or [ast.Pass()]
    return tree


def _bodies(tree: ast.Module) -> Iterator[tuple[Any, list[ast.stmt]]]:
    """Yield the nodes of a module that have statements, each with its statements."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # the body of a lambda is an expression
            yield node, body


def _is_text(node: ast.stmt) -> bool:
    """Return whether a statement is only a string, as a docstring is."""
    constant = node.value if isinstance(node, ast.Expr) else None
    return isinstance(constant, ast.Constant) and isinstance(constant.value, str)
