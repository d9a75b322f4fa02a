"""Markdown that pages are made of: the same content gives the same bytes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from ..claims.evidence import CONTROLS
from .table import escaped, table_line

_ARXIV = re.compile(r"arXiv (\d{4}\.\d{5})")


def prose(text: str) -> str:
    """Return words of ours for Markdown: code in backticks as it is, links for arXiv identifiers."""
    parts = re.split(r"(`[^`]+`)", text)
    return "".join(part if part.startswith("`") else linked(escaped(part)) for part in parts)


def linked(text: str) -> str:
    """Return `text` with links for the arXiv identifiers in it."""
    return _ARXIV.sub(r"[arXiv \1](https://arxiv.org/abs/\1)", text)


def arxiv_ids(text: str) -> list[str]:
    """Return the arXiv identifiers in `text`, each once, in order."""
    return list(dict.fromkeys(_ARXIV.findall(text)))


def grid(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> list[str]:
    """Return the lines of a table whose last `numbers` columns are numbers."""
    under = ["---"] * (len(head) - numbers) + ["--:"] * numbers
    return [table_line(list(head)), table_line(under), *(table_line(list(row)) for row in rows)]


def run_command(scenario: str, *labels: str) -> str:
    """Return the command that makes the records of labels that differ from their method alike."""
    methods = [label.partition("+")[0] for label in labels]
    changes = labels[0].split("+")[1:]
    settings = [f"--set.{name} {value}" for name, _, value in (change.partition("=") for change in changes)]
    folder = [f"--records {CONTROLS.as_posix()}"] if changes else []
    return " ".join(["clbench run", scenario, *methods, *settings, *folder])
