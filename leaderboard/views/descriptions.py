"""Descriptions of methods from their code: docstrings, hyper-parameters, the prior data that they may use."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from clbench.base.text import field_docstrings
from clbench.learning.method import Method
from clbench.learning.registry import load_method
from clbench.spec.identifiers import built_in_methods

from ..board.runs import division_of
from ..board.summary import DIVISIONS

_ITEM = re.compile(r"\d+\. +(.*)")


COMMON: dict[str, Any] = {field.name: field.default for field in dataclasses.fields(Method)}
"""Hyper-parameters of every method with their defaults: the pages of methods list only other defaults."""

RULES: Mapping[str, str] = dict(
    zip(
        DIVISIONS,
        (
            "may read no prior data",
            "may read prior questions, but no demonstrations",
            "may read prior demonstrations",
            "learn by trial and error, in as many steps as they choose: not comparable with methods",
            "were fine-tuned elsewhere, on what their authors declare: not comparable with methods",
            "do not compete: training on all data together, doing nothing, and learning from scratch",
        ),
        strict=True,
    )
)
"""What the methods of each division may do."""


@dataclass(frozen=True)
class HyperParameter:
    """A field of a method's dataclass."""

    name: str
    """Name of the field."""
    default: str
    """Default value, as Python writes it."""
    meaning: str
    """Docstring under the field; a subclass's own docstring follows its base class's."""


@dataclass(frozen=True)
class Text:
    """The parts of a module's docstring."""

    idea: str
    """First line."""
    rule: tuple[str, ...]
    """Paragraphs before the line "Details:", and those after the list that follows it."""
    details: tuple[str, ...]
    """Items of that list."""


@dataclass(frozen=True)
class Description:
    """Description of a method, without any record."""

    name: str
    """Name under which the method is installed."""
    cls: type[Method]
    """Class of the method."""
    text: Text
    """Parts of the docstring of its module."""
    hyper_parameters: tuple[HyperParameter, ...]
    """Hyper-parameters in the order of the fields, without those of every method."""

    @property
    def summary(self) -> str:
        """First line of the class's docstring."""
        return (self.cls.__doc__ or "").strip().partition("\n")[0]

    @property
    def division(self) -> str:
        """Division in which the method competes."""
        return division_of(dataclasses.asdict(self.cls.uses))

    def hook(self, name: str) -> list[str]:
        """Return the paragraphs on what a hook returns, empty if the method does not override the hook."""
        function = getattr(self.cls, name)
        if function is getattr(Method, name):
            return []
        text = inspect.cleandoc(function.__doc__ or "").removeprefix("Return ")
        return paragraphs((text[:1].upper() + text[1:]).splitlines())


def built_in_descriptions() -> list[Description]:
    """Return the descriptions of the methods that come with clbench, by name."""
    return [describe(name, load_method(name)) for name in sorted(built_in_methods())]


def common_hyper_parameters() -> list[HyperParameter]:
    """Return the hyper-parameters that every method has."""
    meanings = field_docstrings(Method)
    return [HyperParameter(name, repr(default), meanings[name]) for name, default in COMMON.items()]


def describe(name: str, cls: type[Method]) -> Description:
    """Return the description of a method's class."""
    text = read_docstring(sys.modules[cls.__module__].__doc__ or "")
    return Description(name, cls, text, tuple(_hyper_parameters(cls)))


def read_docstring(docstring: str) -> Text:
    """Return the parts of a module's docstring."""
    idea, *lines = inspect.cleandoc(docstring).splitlines() or [""]
    end = lines.index("Details:") if "Details:" in lines else len(lines)
    details: list[str] = []
    after: list[str] = []
    for line in lines[end + 1 :]:
        item = _ITEM.match(line)
        if after or not (item or not line or line.startswith(" ")):
            after.append(line)
        elif item:
            details.append(item[1])
        elif line and details:
            details[-1] += f" {line.strip()}"
    return Text(idea, (*paragraphs(lines[:end]), *paragraphs(after)), tuple(details))


def paragraphs(lines: Iterable[str]) -> list[str]:
    """Return the paragraphs between blank lines, each on one line."""
    groups = groupby(lines, key=lambda line: bool(line.strip()))
    return [" ".join(line.strip() for line in group) for filled, group in groups if filled]


def _hyper_parameters(cls: type[Method]) -> list[HyperParameter]:
    meanings: dict[str, list[str]] = {}
    for base in reversed(cls.__mro__):
        if issubclass(base, Method):
            for name, meaning in field_docstrings(base).items():
                meanings.setdefault(name, []).append(meaning)
    return [
        HyperParameter(field.name, _default(field), " ".join(meanings.get(field.name, [])))
        for field in dataclasses.fields(cls)
        if field.name not in COMMON or field.default != COMMON[field.name]
    ]


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return repr(field.default)
    if field.default_factory is not dataclasses.MISSING:
        return repr(field.default_factory())
    return "must be given"
