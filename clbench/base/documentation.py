"""Docstrings of fields in `help`."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from typing import TypeVar

T = TypeVar("T")

_HEADING = "Attributes:"


def with_fields(cls: type[T]) -> type[T]:
    """Append the fields of a class and their docstrings to the docstring of the class, and return the class.

    Editors and builders of documentation read the text below a field in the source. Python forgets it, so
    that `help` and `?` would show the class without it.
    """
    own = cls.__dict__.get("__doc__") or ""
    fields = [] if _HEADING in own else [*_documented_fields(cls)]
    if fields:
        lines = [f"    {name}: {' '.join(text.split())}" for name, text in fields]
        wrapped = [textwrap.fill(line, 100, subsequent_indent=" " * 8) for line in lines]
        cls.__doc__ = "\n".join([inspect.cleandoc(own), "", _HEADING, *wrapped])
    return cls


def _documented_fields(cls: type) -> Iterator[tuple[str, str]]:
    """Yield the name and the docstring of each field in the body of a class."""
    try:
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    except (OSError, TypeError):  # the source is not there, as in a frozen program
        return
    assert isinstance(tree, ast.ClassDef)
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        match field, text:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(words))),
            ) if not name.startswith("_"):
                yield name, words
