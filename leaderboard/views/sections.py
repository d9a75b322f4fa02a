"""Sections of a generated page: each asks one question, and answers it in sentences, tables and a picture."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A table of a section."""

    head: tuple[str, ...]
    """Heads of the columns."""
    lines: tuple[tuple[str, ...], ...]
    """Cells of each line."""


@dataclass(frozen=True)
class Section:
    """One question with its answers."""

    question: str
    """The heading."""
    answers: tuple[str, ...]
    """Sentences with figures."""
    tables: tuple[Table, ...] = ()
    """Tables with the other figures."""
    notes: tuple[str, ...] = ()
    """Sentences that say how to read the tables."""
    picture: str = ""
    """Stem of the name of the picture, empty without one."""


def short(scenario: str) -> str:
    """Return the name of a scenario without `clbench/`, which would fill the tables of a page."""
    return scenario.removeprefix("clbench/")
